"""One line at the foot of a terminal that is rewritten in place, under lines that stay."""

import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

Say = Callable[[str], None]
ERASED = "\r\x1b[K"
ROOM = 3  # columns for the ^C of an interrupt: a full line would wrap, and could not be erased
# mpirun gives even a single rank a terminal of its own, whatever stands behind it
LAUNCHERS = {"OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "PMIX_RANK"}


@contextmanager
def live_line(ranks: int, say: Say) -> Iterator[tuple[Say, Say | None]]:
    """Two functions: one that prints a line that stays, one that rewrites the line at the foot.

    Where standard output is no terminal, or a run on several ranks, they are `say` and None. Nothing of the line
    is left after `with`, nor after a SIGTERM that ends the process.
    """
    if ranks > 1 or LAUNCHERS & os.environ.keys() or not sys.stdout.isatty() or os.environ.get("TERM") == "dumb":
        yield say, None
        return
    foot = ""

    def stay(line: str) -> None:
        print(f"{ERASED}{line}\n{foot}", end="", flush=True)

    def rewrite(line: str) -> None:
        nonlocal foot
        foot = line[: max(0, shutil.get_terminal_size().columns - ROOM)]
        print(f"{ERASED}{foot}", end="", flush=True)

    def end(number: int, frame: FrameType | None) -> None:
        os.write(sys.stdout.fileno(), ERASED.encode())  # the stream may be in the middle of a line
        signal.signal(number, before)
        signal.raise_signal(number)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield stay, rewrite
    finally:
        signal.signal(signal.SIGTERM, before)
        print(ERASED, end="", flush=True)

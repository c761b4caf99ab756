"""A status line at the foot of a terminal, rewritten in place below the printed lines."""

import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

Say = Callable[[str], None]
ERASED = "\r\x1b[K"
ROOM = 3  # columns for the ^C of an interrupt; a full line would wrap and could not be erased
# mpirun gives every rank a terminal, even if its own output is a file
LAUNCHERS = {"OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "PMIX_RANK"}


def print_line(line: str) -> None:
    """Print a line at once, also into a file."""
    print(line, flush=True)


@contextmanager
def live_line(ranks: int, say: Say) -> Iterator[tuple[Say, Say | None]]:
    """Two functions: the first prints a line, the second rewrites the status line.

    They are `say` and None if standard output is no terminal or there are several ranks. The status line is erased
    after `with`, and also when SIGTERM ends the process.
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
        os.write(sys.stdout.fileno(), ERASED.encode())  # the stream may be in use
        signal.signal(number, before)
        signal.raise_signal(number)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield stay, rewrite
    finally:
        signal.signal(signal.SIGTERM, before)
        print(ERASED, end="", flush=True)

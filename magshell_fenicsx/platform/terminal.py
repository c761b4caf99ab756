"""A status line at the foot of a terminal, rewritten in place below the printed lines."""

import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

Say = Callable[[str], None]
ERASED = "\r\x1b[K"
ROOM = 3  # columns for the ^C of an interrupt; a full line would wrap and could not be erased
lost: list[str] = []  # why standard output is not written
# mpirun gives every rank a terminal, even if its own output is a file
LAUNCHERS = {"OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "PMIX_RANK"}


def print_line(line: str) -> None:
    """Print a line at once, also into a file."""
    write(f"{line}\n")


def write(text: str) -> None:
    """Write to standard output at once. If that fails, as on a full disk, say so once, and go on without it."""
    try:
        print(text, end="", flush=True)
    except BrokenPipeError:
        raise
    except OSError as e:
        lost.append(f"standard output cannot be written: {e.strerror}")
        with suppress(OSError, ValueError):  # what it has buffered would fail again at the end
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)
            print(f"warning: {lost[-1]}; nothing more is printed", file=sys.stderr, flush=True)


def open_standard_streams() -> None:
    """Give the process those of the descriptors 0 to 2 that its parent has closed: files would take their numbers."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this
            setattr(sys, name, os.fdopen(number, mode, closefd=False))


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
        write(f"{ERASED}{line}\n{foot}")

    def rewrite(line: str) -> None:
        nonlocal foot
        foot = line[: max(0, shutil.get_terminal_size().columns - ROOM)]
        write(f"{ERASED}{foot}")

    def end(number: int, frame: FrameType | None) -> None:
        os.write(sys.stdout.fileno(), ERASED.encode())  # the stream may be in use
        signal.signal(number, before)
        signal.raise_signal(number)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield stay, rewrite
    finally:
        signal.signal(signal.SIGTERM, before)
        write(ERASED)

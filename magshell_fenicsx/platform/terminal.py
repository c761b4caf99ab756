"""A status line at the foot of a terminal, rewritten in place below the printed lines."""

import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType

Say = Callable[[str], None]
ERASED = "\r\x1b[K"
ROOM = 3  # columns for the ^C of an interrupt; a full line would wrap and could not be erased
COLUMNS = 79  # of a line that stays, in the narrowest usual terminal
EACH = 30.0  # seconds without a line after which a pipe gets one
LOOKS = 0.1  # of that, between two looks whether it is time
lost: list[str] = []  # why standard output is not written
# mpirun gives every rank a terminal, even if its own output is a file
LAUNCHERS = {"OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "PMIX_RANK"}


def print_line(line: str) -> None:
    """Print a line at once, also into a file."""
    write(f"{line}\n")


def write(text: str) -> None:
    """Write to standard output at once.

    If that fails, as on a full disk, say so once, and go on without it.
    """
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
    """Give the process those of the descriptors 0 to 2 that its parent has closed: files would take
    their numbers.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this
            setattr(sys, name, os.fdopen(number, mode, closefd=False))


def plain(ranks: int) -> bool:
    """Whether no line can be rewritten: standard output is no terminal, or there are several ranks."""
    return (
        ranks > 1
        or bool(LAUNCHERS & os.environ.keys())
        or not sys.stdout.isatty()
        or os.environ.get("TERM") == "dumb"
    )


@contextmanager
def live_line(ranks: int, say: Say) -> Iterator[tuple[Say, Say]]:
    """Two functions: the first prints a line, the second rewrites the status line.

    If standard output is no terminal, or there are several ranks, the second prints a line where
    EACH seconds have passed without one, and again after as many more. The status line is erased
    after `with`, and also when SIGTERM ends the process.
    """
    if plain(ranks):
        yield from _plain(say)
        return
    foot = ""

    def stay(line: str) -> None:
        write(f"{ERASED}{line}\n{foot}")

    def rewrite(line: str) -> None:
        nonlocal foot
        foot = fitting(line.split("  "), max(0, shutil.get_terminal_size().columns - ROOM))
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


def _plain(say: Say) -> Iterator[tuple[Say, Say]]:
    """Both functions print lines, the second seldom; the last status is repeated while nothing else
    is said."""
    last, status, lock, ended = time.monotonic(), ("", 0.0), threading.Lock(), threading.Event()

    def stay(line: str) -> None:
        nonlocal last
        with lock:
            last = time.monotonic()
            say(line)

    def seldom(line: str) -> None:
        nonlocal status
        status = line, (now := time.monotonic())
        if now - last >= EACH:
            stay(line)

    def repeat() -> None:
        with suppress(BrokenPipeError):  # which ends the program where it prints next
            while not ended.wait(LOOKS * EACH):
                (line, told), now = status, time.monotonic()
                if line and now - last >= (1 - LOOKS) * EACH:
                    stay(f"{line}  (for {now - told:.0f} s)")

    repeating = threading.Thread(target=repeat, daemon=True)
    repeating.start()
    try:
        yield stay, seldom
    finally:
        ended.set()
        repeating.join()


def fitting(parts: Sequence[str], columns: int) -> str:
    """The first parts of a line that fit, two spaces between them; none is cut but a first one that
    is too long.

    Examples
    --------
    >>> fitting(["5 points", "w/h 14 -> 20", "1:50, about 0:30 left", "du/h 0.1"], 50)
    '5 points  w/h 14 -> 20  1:50, about 0:30 left'
    """
    first, *others = parts
    line = first[:columns]
    for part in others:
        if len(line) + 2 + len(part) > columns:
            break
        line += f"  {part}"
    return line

"""A status line at the foot of a terminal, rewritten in place below the printed lines.

A line stays, or is a status that the next one replaces. Where the output is a file, a pipe or that
of several ranks (processes of one run), a line cannot be rewritten: in this plain output a status
is printed seldom, as a line that stays.
"""

import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from types import FrameType

Say = Callable[[str], None]
ERASE_LINE = "\r\x1b[K"

# For the ^C of an interrupt: a full line would wrap and could not be erased.
RESERVED_COLUMNS = 3

LINE_COLUMNS = 79  # of a line that stays, in the narrowest usual terminal
# without a line, after which a pipe gets one: the longest silence is ten seconds
STATUS_SECONDS = 9.0
POLL_FRACTION = 0.1  # of that, between two checks whether it is time
output_failures: list[str] = []  # why standard output is not written

# Environment variables of launchers: mpirun gives every rank a terminal, even if its own output
# is a file.
LAUNCHER_VARIABLES = {"OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "PMIX_RANK"}


def print_line(line: str) -> None:
    """Print a line at once, also into a file."""
    write(f"{line}\n")


def write(text: str) -> None:
    """Write to standard output at once.

    If writing fails, as on a full disk, warn once on standard error, and write nothing any more.
    """
    try:
        print(text, end="", flush=True)
    except BrokenPipeError:
        raise  # the reader has gone: the program ends
    except OSError as e:
        output_failures.append(f"standard output cannot be written: {e.strerror}")
        with suppress(OSError, ValueError):  # what it has buffered would fail again at the end
            # from here on standard output goes nowhere
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)
            print(
                f"warning: {output_failures[-1]}; nothing more is printed",
                file=sys.stderr,
                flush=True,
            )


def open_standard_streams() -> None:
    """Open those of the descriptors 0 to 2 that the parent process has closed.

    Otherwise the next files that are opened would take these numbers.
    """
    for descriptor, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this
            setattr(sys, name, os.fdopen(descriptor, mode, closefd=False))


def is_plain_output(ranks: int) -> bool:
    """Return whether lines of standard output cannot be rewritten.

    That is so if standard output is no terminal, or if there are several ranks.
    """
    may_have_several_ranks = ranks > 1 or bool(LAUNCHER_VARIABLES & os.environ.keys())
    if may_have_several_ranks or not sys.stdout.isatty():
        return True
    return os.environ.get("TERM") == "dumb"


@contextmanager
def live_line(ranks: int, say: Say) -> Iterator[tuple[Say, Say]]:
    """Yield two functions of a line: one prints it, the other shows it as the status line.

    In plain output the second one prints a line only after STATUS_SECONDS without one, and again
    after as many more. On a terminal, a status that has stayed for so long says for how long. The
    status line is erased after `with`, and when SIGTERM ends the process.

    Parameters
    ----------
    ranks
        Number of ranks.
    say
        Function that prints a line in plain output.
    """
    if is_plain_output(ranks):
        yield from _plain_output(say)
        return
    status_line = ""
    status = LatestStatus()
    lock = threading.Lock()  # the thread of `repeated` writes too

    def stay(line: str) -> None:
        with lock:
            write(f"{ERASE_LINE}{line}\n{status_line}")

    def rewrite(line: str) -> None:
        """Show a line of parts, separated by two spaces, as far as it fits, as the status line."""
        nonlocal status_line
        columns = max(0, shutil.get_terminal_size().columns - RESERVED_COLUMNS)
        with lock:
            status_line = fit_to_columns(line.split("  "), columns)
            write(f"{ERASE_LINE}{status_line}")

    def show(line: str) -> None:
        """Note a status, and show it."""
        status.note(line)
        status.shown_at = status.noted_at
        rewrite(line)

    def end(number: int, frame: FrameType | None) -> None:
        """Erase the status line, and let the earlier handler of the signal end the process."""
        os.write(sys.stdout.fileno(), ERASE_LINE.encode())  # the stream may be in use
        signal.signal(number, previous_handler)
        signal.raise_signal(number)

    previous_handler = signal.signal(signal.SIGTERM, end)
    try:
        with repeated(status, rewrite):
            yield stay, show
    finally:
        signal.signal(signal.SIGTERM, previous_handler)
        write(ERASE_LINE)


def _plain_output(say: Say) -> Iterator[tuple[Say, Say]]:
    """Yield two functions of a line of text: the first prints it, the second prints it seldom.

    The second is for statuses. A thread repeats the last status while nothing else is printed.
    """
    status = LatestStatus()
    lock = threading.Lock()  # the thread prints too

    def stay(line: str) -> None:
        with lock:
            status.shown_at = time.monotonic()
            say(line)

    def seldom(line: str) -> None:
        """Note a status, and print it if no line was printed for STATUS_SECONDS."""
        status.note(line)
        if status.noted_at - status.shown_at >= STATUS_SECONDS:
            stay(line)

    with repeated(status, stay):
        yield stay, seldom


@dataclass
class LatestStatus:
    """The last status of a run, and when something was shown last.

    Attributes
    ----------
    line
        The status; empty before the first.
    noted_at, shown_at
        When it was noted, and when a line or status was shown last, by `time.monotonic`.
    """

    line: str = ""
    noted_at: float = 0.0
    shown_at: float = field(default_factory=lambda: time.monotonic())

    def note(self, line: str) -> None:
        """Note a status."""
        self.line, self.noted_at = line, time.monotonic()


@contextmanager
def repeated(status: LatestStatus, show: Say) -> Iterator[None]:
    """Show the last status again and again while nothing else is shown, until the end of `with`.

    A thread does so, each time with how long the status has stayed.
    """
    ended = threading.Event()

    def repeat() -> None:
        with suppress(BrokenPipeError):  # which ends the program where it prints next
            while not ended.wait(POLL_FRACTION * STATUS_SECONDS):
                time_now = time.monotonic()
                is_due = time_now - status.shown_at >= (1 - POLL_FRACTION) * STATUS_SECONDS
                if status.line and is_due:
                    show(f"{status.line}  (for {time_now - status.noted_at:.0f} s)")

    repeating = threading.Thread(target=repeat, daemon=True)
    repeating.start()
    try:
        yield
    finally:
        ended.set()
        repeating.join()


def fit_to_columns(parts: Sequence[str], columns: int) -> str:
    """Return the first parts of a line that fit into a width, two spaces between them.

    Only a first part that is too long is cut.

    Examples
    --------
    >>> fit_to_columns(["5 points", "w/h 14 -> 20", "1:50, about 0:30 left", "du/h 0.1"], 50)
    '5 points  w/h 14 -> 20  1:50, about 0:30 left'
    """
    first, *further_parts = parts
    line = first[:columns]
    for part in further_parts:
        if len(line) + 2 + len(part) > columns:
            break
        line += f"  {part}"
    return line

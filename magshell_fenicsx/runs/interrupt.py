"""Stopping a run between two solves or two steps in time, by a signal or a time limit."""

import signal
import threading
import time
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self

from mpi4py import MPI

from magshell_fenicsx.continuation.point import Journal, Point

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)  # mpirun passes SIGUSR1 on to the ranks and waits


class Interrupted(RuntimeError):
    """The run was asked to stop; the message names the signal or the limit."""


class Watch:
    """Records requests to stop; inside `with`, signals are recorded instead of obeyed.

    Parameters
    ----------
    start
        Start of the run, in seconds of `time.perf_counter`.
    limit
        Seconds after which the run stops; None sets no limit.
    signals
        Whether `SIGNALS` are recorded. A second SIGINT is obeyed.
    """

    def __init__(self, comm: MPI.Comm, start: float, limit: float | None, signals: bool) -> None:
        self._comm, self._start, self._limit = comm, start, limit
        # Python allows signal handlers only in the main thread
        self._signals = SIGNALS if signals and threading.current_thread() is threading.main_thread() else ()
        self._reason: str | None = None

    def __enter__(self) -> Self:
        self._before: dict[signal.Signals, Callable[[int, FrameType | None], Any] | int | None] = {
            number: signal.signal(number, self._note) for number in self._signals
        }
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def check(self, *, limited: bool = True) -> None:
        """Stop if a rank has been asked to, or at the time limit if `limited`; collective.

        Raises
        ------
        Interrupted
            On every rank, if any has been asked to stop.
        """
        if limited and self._limit is not None and time.perf_counter() - self._start >= self._limit:
            self._reason = self._reason or f"the time limit of {self._limit:g} s"
        reason = next(filter(None, self._comm.allgather(self._reason)), None)
        if reason:
            raise Interrupted(f"interrupted by {reason}")

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._reason = signal.Signals(number).name
        if number == signal.SIGINT:
            signal.signal(number, self._before[signal.SIGINT])


class Stoppable:
    """A journal that stops the run before a new solve if the watch requests it."""

    def __init__(self, journal: Journal, watch: Watch) -> None:
        self._journal, self._watch = journal, watch

    def replay(self) -> Point | str | None:
        known = self._journal.replay()
        if known is None:
            self._watch.check()
        return known

    def record(self, found: Point | str) -> None:
        self._journal.record(found)

    def check(self, known: bool) -> None:
        self._watch.check(limited=not known)  # a way that is only computed again must end, or no resumed run gets on

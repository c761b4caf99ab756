"""Stopping a run between two solves: a signal, or a limit of time."""

import signal
import threading
import time
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self

from mpi4py import MPI

from magshell_fenicsx.continuation.journal import Journal
from magshell_fenicsx.continuation.point import Point

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)  # of them mpirun passes the last on, and waits


class Interrupted(RuntimeError):
    """The run was asked to stop; the message says by what."""


class Watch:
    """Notes what asks a run to stop; inside `with`, signals are noted instead of obeyed.

    Parameters
    ----------
    start
        When the run began, in seconds of the clock.
    limit
        Seconds after which it shall stop; None sets no limit.
    signals
        Whether `SIGNALS` are noted. A second SIGINT is obeyed.
    """

    def __init__(self, comm: MPI.Comm, start: float, limit: float | None, signals: bool) -> None:
        self._comm, self._start, self._limit = comm, start, limit
        # Python allows handlers in its main thread alone
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

    def check(self) -> None:
        """Collective.

        Raises
        ------
        Interrupted
            On every rank, if any has been asked to stop.
        """
        if self._limit is not None and time.perf_counter() - self._start >= self._limit:
            self._reason = self._reason or f"the time limit of {self._limit:g} s"
        reason = next(filter(None, self._comm.allgather(self._reason)), None)
        if reason:
            raise Interrupted(f"interrupted by {reason}")

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._reason = signal.Signals(number).name
        if number == signal.SIGINT:
            signal.signal(number, self._before[signal.SIGINT])


class Stoppable:
    """A journal that ends a history before a new solve begins, if the watch says so."""

    def __init__(self, journal: Journal, watch: Watch) -> None:
        self._journal, self._watch = journal, watch

    def replay(self) -> Point | str | None:
        known = self._journal.replay()
        if known is None:
            self._watch.check()
        return known

    def record(self, found: Point | str) -> None:
        self._journal.record(found)

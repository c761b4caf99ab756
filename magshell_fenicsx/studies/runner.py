"""One runner for many runs: it deals tasks to the ranks, and says how far they are.

A study is any command that runs a case many times, such as a sweep. A point is one of its cases. An
outcome is what is computed at a point; it is kept as soon as it is there (`OutcomeStore`), so that
an interrupted study goes on. A task is a point, or several that belong together. `say` prints a
line.
"""

import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Generic, TypeVar

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.folder import DiskError
from magshell_fenicsx.platform import terminal
from magshell_fenicsx.runs.status import clock
from magshell_fenicsx.studies.store import OutcomeStore, OutcomeType, PointType

Say = Callable[[str], None]
Task = TypeVar("Task")
LEAST_LEFT = 10.0  # s; a shorter rest is not said
SECONDS_BETWEEN_LINES = terminal.STATUS_SECONDS  # s
# tasks that an executor gets together: within them a process goes on from what it has found
TASKS_OF_BATCH = 4


def _are_of_part(first: str, number: str, count: int) -> bool:
    """Return whether two texts are numbers i and n of a part, with 1 <= i <= n <= count."""
    if not (first.isdecimal() and number.isdecimal()):
        return False
    return 1 <= int(first) <= int(number) <= count


def part_of(part: str | None, count: int, items: str) -> tuple[int, int]:
    """Return the numbers i and n of a part "i/n", one of n jobs; None is the only part of one job.

    Parameters
    ----------
    count
        Number of items that the jobs share; n must not be larger.
    items
        Name of the items, for the message.

    Raises
    ------
    CaseError
        If the text has another form.

    Examples
    --------
    >>> part_of("2/3", 5, "points"), part_of(None, 5, "points")
    ((2, 3), (1, 1))
    """
    first, _, number = (part or "1/1").partition("/")
    if not _are_of_part(first, number, count):
        raise CaseError(
            f"--part {part}: write it as i/n with 1 <= i <= n, and n at most the number of {items}"
        )
    return int(first), int(number)


def compute(
    tasks: Sequence[Task],
    do: Callable[[Task], Iterable[str]],
    comm: MPI.Intracomm,
    say: Say = lambda line: None,
    executor: Executor | None = None,
) -> None:
    """Compute tasks, each on the next free rank, or in the processes of an executor; collective.

    An error on one of several ranks ends all ranks.

    Parameters
    ----------
    do
        Called with a task, on one rank. It computes the task, keeps the outcome of each of its
        runs, and yields a line of text for each. For an executor it can be pickled, as the tasks.
    say
        Called with each line and the remaining time, on the rank of the task.
    executor
        Processes of another kind than ranks; see `concurrent.futures`.

    Raises
    ------
    CaseError
        If there are an executor and several ranks.
    """
    start_time, done_count = time.perf_counter(), 0

    def remaining_text() -> str:
        """Return the remaining time in words; "" before the first outcome."""
        return (
            _remaining_by_count(time.perf_counter() - start_time, done_count, len(tasks))
            if done_count
            else ""
        )

    # `progress` says lines, and after a long silence that the work goes on
    with _wait_for_all(comm), reporting_progress(comm, say, remaining_text) as progress:
        if executor:
            for lines, count in _results_of_executor(tasks, do, comm, executor):
                done_count += count
                for line in lines:
                    progress(line + remaining_text())
            return
        for i in deal(len(tasks), comm):
            for line in do(tasks[i]):
                done_count = i + 1  # on all ranks together, since tasks are dealt in order
                progress(line + remaining_text())


def _results_of_executor(
    tasks: Sequence[Task],
    do: Callable[[Task], Iterable[str]],
    comm: MPI.Intracomm,
    executor: Executor,
) -> Iterator[tuple[list[str], int]]:
    """Compute tasks in the processes of an executor; yield lines of text, of how many tasks."""
    if comm.size > 1:
        raise CaseError("jobs: take either ranks of mpirun or the processes of an executor")
    batches = [tasks[i : i + TASKS_OF_BATCH] for i in range(0, len(tasks), TASKS_OF_BATCH)]
    sizes = {executor.submit(_lines_of_batch, batch, do): len(batch) for batch in batches}
    try:
        for future in as_completed(sizes):
            yield future.result(), sizes[future]
    finally:  # those that have not begun, after an error or an interrupt
        for future in sizes:
            future.cancel()


def _lines_of_batch(tasks: Sequence[Task], do: Callable[[Task], Iterable[str]]) -> list[str]:
    """Compute tasks one after the other in this process, and return their lines of text."""
    return [line for task in tasks for line in do(task)]


@contextmanager
def local_processes(count: int) -> Iterator[Executor | None]:
    """Yield an executor with new processes of one thread each; None for one process."""
    if count == 1:
        yield None
        return
    threads_before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = threads_before or "1"  # as processes begin with it
    try:
        # not by fork: the processes of MPI cannot be copied
        with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as executor:
            yield executor
    finally:
        if threads_before is None:
            del os.environ["OMP_NUM_THREADS"]


def say_on_first_rank(say: Say, comm: MPI.Comm) -> Say:
    """Return `say` on rank 0, and a function that says nothing on other ranks."""
    return say if comm.rank == 0 else lambda line: None


@dataclass(frozen=True)
class PointRunner(Generic[PointType, OutcomeType]):
    """Computes a point and keeps its outcome; it can be pickled if its attributes can.

    Attributes
    ----------
    compute_point
        Returns the outcome of a point.
    store
        Keeps outcomes.
    words
        Returns an outcome in words.
    numbers
        Key of a point -> its number, from 1.
    """

    compute_point: Callable[[PointType], OutcomeType]
    store: OutcomeStore[OutcomeType]
    words: Callable[[OutcomeType], str]
    numbers: Mapping[str, int]

    def __call__(self, point: PointType) -> Iterator[str]:
        """Compute a point on this rank, keep its outcome, and yield a line of text."""
        outcome = self.compute_point(point)
        self.store.keep(point.key, outcome, point.case)
        number, count = self.numbers[point.key], len(self.numbers)
        yield f"{number:5d}/{count}  {point.label}: {self.words(outcome)}"


def compute_points(
    points: Sequence[PointType],
    compute_point: Callable[[PointType], OutcomeType],
    store: OutcomeStore[OutcomeType],
    comm: MPI.Intracomm,
    say: Say,
    words: Callable[[OutcomeType], str] = str,
    executor: Executor | None = None,
) -> None:
    """Compute points, each on the next free rank, and keep their outcomes; collective.

    Parameters
    ----------
    points
        Points with different keys, such as those that a store is missing.
    compute_point
        Returns the outcome of a point; called on one rank.
    say
        Called with a line for each point, on the rank that computed it.
    words
        Returns an outcome in words, for this line.
    executor
        Processes of another kind than ranks; all that it gets must be picklable.
    """
    numbers = {point.key: number for number, point in enumerate(points, 1)}
    compute(points, PointRunner(compute_point, store, words, numbers), comm, say, executor)


class ProgressReporter:
    """Passes lines on; after a long silence it says that the work goes on.

    Reminders are written by `remind`, which runs in a thread of its own.

    Attributes
    ----------
    _say, _rest
        The parameters `say` and `remaining_text`.
    _begun, _last
        Time of the begin, and of the last line, of `time.perf_counter`.
    _ended
        Event that ends the thread.

    Parameters
    ----------
    say
        Called with each line.
    remaining_text
        Returns the remaining time in words, for a reminder.
    """

    def __init__(self, say: Say, remaining_text: Callable[[], str] = str) -> None:
        self._say, self._rest, self._ended = say, remaining_text, threading.Event()
        self._begun = self._last = time.perf_counter()

    def __call__(self, line: str) -> None:
        """Say a line, from which the silence counts anew."""
        self._last = time.perf_counter()
        self._say(line)

    def remind(self) -> None:
        """Say a reminder after each long silence, until `end` is called."""
        # wait until the silence since the last line would be long; `wait` returns True at the end
        while not self._ended.wait(
            max(0.01, self._last + SECONDS_BETWEEN_LINES - time.perf_counter())
        ):
            # if a line was said meanwhile, go on waiting
            if (time_now := time.perf_counter()) - self._last >= SECONDS_BETWEEN_LINES:
                self(f"still computing, {clock(time_now - self._begun)} so far{self._rest()}")

    def end(self) -> None:
        """End the reminders."""
        self._ended.set()


@contextmanager
def reporting_progress(
    comm: MPI.Comm, say: Say, remaining_text: Callable[[], str] = str
) -> Iterator[Say]:
    """Yield a `ProgressReporter`, which reminds on rank 0 alone while the `with` block runs.

    On other ranks, and if `say` is a `ProgressReporter` already, `say` itself is yielded.
    """
    if isinstance(say, ProgressReporter) or comm.rank:
        yield say
        return
    progress = ProgressReporter(say, remaining_text)
    thread = threading.Thread(target=progress.remind, daemon=True)
    thread.start()
    try:
        yield progress
    finally:
        progress.end()
        thread.join()


def remaining_time_text(seconds: float, prefix: str = "about ") -> str:
    """Return the remaining time in words; "" if it is short.

    Parameters
    ----------
    seconds
        The remaining time.
    prefix
        Words before the time.

    Examples
    --------
    >>> remaining_time_text(600.0), remaining_time_text(8.0)
    (', about 10 min left', '')
    >>> remaining_time_text(30.0, "at most about ")
    ', at most about 30 s left'
    """
    if seconds < LEAST_LEFT:
        return ""
    # the largest unit of which there are 1.5 or more
    size, unit = next(
        (size, unit) for size, unit in ((3600, "h"), (60, "min"), (1, "s")) if seconds >= 1.5 * size
    )
    return f", {prefix}{seconds / size:.0f} {unit} left"


def _remaining_by_count(seconds: float, done_count: int, count: int) -> str:
    """Return the remaining time in words, if each remaining item takes as long as those before.

    Parameters
    ----------
    seconds
        Time that the first `done_count` of `count` items took.

    Examples
    --------
    >>> _remaining_by_count(60.0, 1, 11), _remaining_by_count(60.0, 10, 11)
    (', about 10 min left', '')
    >>> _remaining_by_count(90.0, 4, 5)
    ', about 22 s left'
    """
    return remaining_time_text(seconds * (count / done_count - 1))


def deal(count: int, comm: MPI.Intracomm) -> Iterator[int]:
    """Yield numbers from 0 to count - 1, each on one rank: the next free rank gets the next number.

    Collective. All ranks increase a counter in the memory of rank 0 (one-sided MPI), so that rank 0
    can work like the others.
    """
    if comm.size == 1:
        yield from range(count)
        return
    counter = np.zeros(1, dtype=np.int64)
    window = MPI.Win.Allocate(counter.nbytes if comm.rank == 0 else 0, counter.itemsize, comm=comm)
    if comm.rank == 0:
        window.tomemory()[:] = counter.tobytes()
    comm.Barrier()
    # `number` gets the value of the counter
    increment, number = np.ones(1, dtype=np.int64), np.zeros(1, dtype=np.int64)
    while True:
        # add one to the counter, and get its value before
        window.Lock(0)
        window.Fetch_and_op(increment, number, 0)
        window.Unlock(0)
        if number[0] >= count:
            break
        yield int(number[0])
    window.Free()


@contextmanager
def _wait_for_all(comm: MPI.Intracomm) -> Iterator[None]:
    """Wait for all ranks at the end of the `with` block; collective.

    An error on one of several ranks aborts all ranks, since the others would wait for ever.
    """
    try:
        yield
    except BaseException as e:
        if comm.size == 1:
            raise
        # exit codes: 2 input, 3 disk, 1 anything else, which is told with its traceback
        code = 2 if isinstance(e, CaseError) else 3 if isinstance(e, DiskError) else 1
        print(
            f"rank {comm.rank}: {e if code > 1 else traceback.format_exc()}",
            file=sys.stderr,
            flush=True,
        )
        comm.Abort(code)
    comm.Barrier()

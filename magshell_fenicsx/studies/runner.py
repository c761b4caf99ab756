"""One runner for many runs: cases in, outcomes and a table out.

A study says which runs there are. The runner opens its folder, keeps every outcome in a file as
soon as it is there, deals the missing runs to the ranks, and says how far it is. What these sources
have kept is not computed again.

A study is any command that runs a case many times, such as a sweep. A case is what the front end
makes of a source (a case file with settings). An outcome is what a run leaves; it is found along
its path, or as a fold that is followed from another run. A knockdown k_d is the pressure of the
first fold over the classical one. A scalar is a named number of a run. A task is a run, or several
that belong together. `say` prints a line.
"""

import json
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar
from uuid import uuid4

import numpy as np
from mpi4py import MPI
from pydantic import TypeAdapter

from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.output.store.durable import write_object
from magshell_fenicsx.output.store.folder import (
    DiskError,
    locked_folder,
    prepare_folder,
    refuse_other_tables,
)
from magshell_fenicsx.output.store.table import COLUMNS, Row
from magshell_fenicsx.platform import terminal
from magshell_fenicsx.platform.environment import code_version
from magshell_fenicsx.runs.status import clock
from magshell_fenicsx.runs.summary import Result, in_units, snaps
from magshell_fenicsx.studies.results import Scalar

# what the front end makes of a source; `problem()` makes its problem: a study does not know its
# class
Case = Any
MakeCase = Callable[[Source], Case]
Say = Callable[[str], None]
OutcomeType = TypeVar("OutcomeType")
Task = TypeVar("Task")
OutcomeOrigin = Literal["path", "fold"]
FAILED = "failed: "  # what `stopped` begins with if an error ended the run
LEAST_LEFT = 10.0  # s; a shorter rest is not said
SECONDS_BETWEEN_LINES = terminal.STATUS_SECONDS  # s


@dataclass(frozen=True)
class Folder:
    """The files of a kind of study, such as a sweep, in its folder.

    Attributes
    ----------
    what
        Its name in messages: "an ensemble".
    tables
        Names of the files that the study writes; the first is a JSON object.
    keys
        Keys of that object, by which a folder of such a study is recognised.
    points
        Subfolder of the outcomes.
    first
        A table that is created empty at the start, so that an unwritable folder is refused at once.
    """

    what: str
    tables: tuple[str, ...]
    keys: tuple[str, ...]
    points: str = "points"
    first: str = ""

    def prepare(self, out: Path, comm: MPI.Comm, case: str = "") -> Path:
        """Make the folder, and return its path; collective. Several jobs may prepare the same one.

        Parameters
        ----------
        case
            Name of the case file; "" if it does not matter.

        Raises
        ------
        CaseError
            On every rank, if the folder has files of others or tables of another case file, or
            cannot be written.
        """

        def make(folder: Path) -> None:
            """Check the folder and make it; called on rank 0."""
            refuse_other_tables(folder, self.tables, self.keys, self.what, case)
            for directory in (folder, folder / self.points):
                directory.mkdir(parents=True, exist_ok=True)
            if self.first:
                (folder / self.first).touch()

        return prepare_folder(out, comm, make)

    @contextmanager
    def locked(self, out: Path, comm: MPI.Comm, case: str) -> Iterator[None]:
        """Prepare the folder and lock it for this job inside `with`; collective."""
        with locked_folder(out, comm, make=True):
            self.prepare(out, comm, case)
            yield


def keep(file: Path, content: Mapping[str, Any]) -> None:
    """Write an outcome as a JSON file.

    A killed study leaves the complete file or none: it is written under another name, and renamed.
    Two processes may write the same file.

    Raises
    ------
    DiskError
        For instance if the disk is full; earlier files are kept.
    """
    unfinished = file.with_suffix(f".{uuid4().hex}")
    try:
        write_object(unfinished, content)
        unfinished.replace(file)
    except OSError as e:
        raise DiskError(f"{file} cannot be written: {e.strerror}") from e


def stored_outcome(
    file: Path, kind: TypeAdapter[OutcomeType], key: str = "", **same: Any
) -> OutcomeType | None:
    """Return the outcome in a JSON file, validated as `kind`.

    None if there is no file, it is damaged, or it has other values than `same`.

    Parameters
    ----------
    key
        Key of the outcome in the file; "" for the whole content.
    same
        Keys of the file with the values that they must have.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if any(content[name] != value for name, value in same.items()):
            return None
        return kind.validate_python(content[key] if key else content)
    except (OSError, ValueError, KeyError, TypeError):
        return None


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
) -> None:
    """Compute tasks, each on the next free rank; collective.

    An error on one of several ranks ends all ranks.

    Parameters
    ----------
    do
        Called with a task, on one rank. It computes the task, keeps the outcome of each of its
        runs, and yields a line of text for each.
    say
        Called with each line and the remaining time, on the rank of the task.
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
    with _wait_for_all(comm), heard(comm, say, remaining_text) as progress:
        for i in deal(len(tasks), comm):
            for line in do(tasks[i]):
                done_count = i + 1  # on all ranks together, since tasks are dealt in order
                progress(line + remaining_text())


class Heard:
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
def heard(comm: MPI.Comm, say: Say, remaining_text: Callable[[], str] = str) -> Iterator[Say]:
    """Yield a `Heard`, which reminds on rank 0 alone while the `with` block runs.

    On other ranks, and if `say` is a `Heard` already, `say` itself is yielded.
    """
    if isinstance(say, Heard) or comm.rank:
        yield say
        return
    progress = Heard(say, remaining_text)
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


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run, or of a fold that was followed from another run.

    Attributes
    ----------
    knockdown
        k_d; None if there is no instability under pressure.
    limit
        The first limit point (the one of k_d) as in summary.json, or the event that ends a motion;
        None without.
    stopped
        Why the run ended before its target; None if it reached it.
    dofs
        Number of unknowns; None for a run that failed.
    wall_s
        Wall time.
    curve
        Every accepted point, with the columns of path.csv.
    found
        "path": the full path was computed; "fold": the fold of another run was followed, and the
        curve has only this point.
    factorisations
        Factorisations of the model's tangent, including failed attempts; without those for excluded
        modes.
    barrier
        The energy barrier over E h R²; None if the case does not ask for one.
    cpu_s
        CPU time of a sample of an ensemble.
    in_units
        Numbers of a case with units, as in summary.json.
    snaps
        As in summary.json.
    """

    knockdown: float | None
    limit: dict[str, Any] | None
    stopped: str | None
    dofs: int | None
    wall_s: float
    curve: list[Row]
    found: OutcomeOrigin
    factorisations: int
    barrier: float | None = None
    cpu_s: float = 0.0
    in_units: dict[str, float] = field(default_factory=dict)
    snaps: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def failed(cls, why: str, wall_s: float = 0.0, factorisations: int = 0) -> "Outcome":
        """Return the outcome of a run without a result, for a reason."""
        return cls(None, None, why, None, wall_s, [], "path", factorisations)

    def value(self, scalar: Scalar) -> float | None:
        """Return a named number of the run; None if the run does not have it."""
        if not self.curve:  # a failed run
            return None
        # summary.json, as far as a scalar reads it
        summary = {
            "knockdown": self.knockdown,
            "barrier": self.barrier,
            "limit_points": [self.limit] if self.limit else [],
            "snaps": self.snaps,
        }
        # rows as texts, as in path.csv
        rows = [_texts_of(row) for row in self.curve]
        return scalar.value_in(summary, rows)

    def serves(self, scalar: Scalar) -> bool:
        """Return whether the outcome is enough for a number.

        A fold alone has the knockdown only. A path must have the columns of the number.
        """
        if scalar.name == "knockdown":
            return True
        if self.found != "path":
            return False
        needed = {scalar.column, scalar.at} & set(COLUMNS)  # those that an outcome may leave out
        return not self.curve or needed <= self.curve[0].keys()


OUTCOME = TypeAdapter(Outcome)


def _texts_of(row: Mapping[str, Any]) -> dict[str, str]:
    """Return the values of a row as texts."""
    return {key: str(v) for key, v in row.items()}


def _kept_part(row: Row, kept_columns: Iterable[str]) -> Row:
    """Return those of some columns that a row has, without numbers of numpy."""
    return {
        key: v if isinstance(v := row[key], str | int) else float(v)
        for key in kept_columns
        if key in row
    }


def outcome_of(
    result: Result,
    origin: OutcomeOrigin,
    factorisations: int,
    wall_s: float = 0.0,
    columns: Sequence[str] = COLUMNS,
) -> Outcome:
    """Return the outcome of a run, or of a fold in the form of a run.

    Parameters
    ----------
    origin
        "path" for a run, "fold" for a fold that was followed.
    columns
        Columns of path.csv that the curve keeps, beside those that the scene adds.
    """
    # the limit point of k_d first, as `False` is sorted before `True`; the others stay in order
    limit_points = sorted(
        result.limit_points,
        key=lambda p: p["amplitude"] != "pressure" or p["value"] != result.knockdown,
    )
    # columns of the curve, each once and in order
    kept_columns = dict.fromkeys((*columns, *result.scene.extra_columns))
    return Outcome(
        knockdown=result.knockdown,
        limit=next(iter(limit_points), None) or _event(result),
        stopped=result.stopped,
        dofs=result.scene.model.system.dofs,
        wall_s=round(wall_s, 3),
        curve=[_kept_part(row, kept_columns) for row in result.rows],
        found=origin,
        factorisations=factorisations,
        barrier=result.barrier,
        in_units=in_units(result),
        snaps=snaps(result.rows) if origin == "path" else [],  # a fold alone has no path
    )


def _event(result: Result) -> dict[str, Any] | None:
    """Return the point at which an event or an instability ended a motion, as a limit point.

    None if the run ended otherwise.
    """
    last_row, steps = result.rows[-1], result.scene.problem.programme
    # what ends the last step; only a motion in time has the amplitude "time"
    until = getattr(steps[-1].load, "until", "") if steps else ""
    if result.stopped or last_row["amplitude"] != "time":
        return None
    if until not in ("event", "instability"):
        return None
    common = {key: last_row[key] for key in ("p_over_pc", "w_pole_over_h", "amplitude")}
    return {**common, "kind": until, "mode": "", "value": last_row["time"]}


def keep_outcome(outcome: Outcome, case: Case, file: Path) -> None:
    """Write the outcome of a case, with the case and the version of the sources."""
    origin = {
        "case": case.model_dump(mode="json", exclude_none=True),
        **case.outside,
        "sources": code_version(),
    }
    keep(file, {**origin, "outcome": asdict(outcome)})


def stored_outcome_of_case(file: Path) -> Outcome | None:
    """Return the outcome in a file of a case; None unless the present sources have computed it."""
    return stored_outcome(file, OUTCOME, "outcome", sources=code_version())

"""One runner for many runs: cases in, outcomes and a table out.

A study says which runs there are. The runner opens its folder, keeps every outcome in a file as
soon as it is there, deals the missing runs to the ranks, and says how far it is. What these sources
have kept is not computed again.
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
    """The files of a kind of study in its folder.

    Attributes
    ----------
    what
        Its name in messages: "an ensemble".
    tables
        The files that it writes; the first is a JSON object.
    keys
        What that object has.
    points
        The folder within, of the outcomes.
    first
        A table that is there from the start, empty, so that a folder which cannot be written is
        refused.
    """

    what: str
    tables: tuple[str, ...]
    keys: tuple[str, ...]
    points: str = "points"
    first: str = ""

    def prepare(self, out: Path, comm: MPI.Comm, case: str = "") -> Path:
        """Make it, unless it has files of others, or tables of another case file; several jobs may.

        Collective.
        """

        def make(folder: Path) -> None:
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
    """Write an outcome; a killed study leaves the complete file or none, and two may write the same
    one.

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
    """The outcome in a file.

    None if there is none, it is damaged, or the file has other values than `same`.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if any(content[name] != value for name, value in same.items()):
            return None
        return kind.validate_python(content[key] if key else content)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def part_of(part: str | None, count: int, items: str) -> tuple[int, int]:
    """The numbers i and n of a part "i/n", one of n jobs.

    Examples
    --------
    >>> part_of("2/3", 5, "points"), part_of(None, 5, "points")
    ((2, 3), (1, 1))
    """
    first, slash, number = (part or "1/1").partition("/")
    if not (
        slash
        and first.isdecimal()
        and number.isdecimal()
        and 1 <= int(first) <= int(number) <= count
    ):
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
    """Deal tasks to the ranks; collective.

    Parameters
    ----------
    do
        Computes a task, keeps the outcome of each of its runs, and yields a line of text for it.
    """
    start_time, done_count = time.perf_counter(), 0

    def remaining_text() -> str:
        return (
            _remaining_by_count(time.perf_counter() - start_time, done_count, len(tasks))
            if done_count
            else ""
        )

    with _wait_for_all(comm), heard(comm, say, remaining_text) as progress:
        for i in deal(len(tasks), comm):
            for line in do(tasks[i]):
                done_count = i + 1
                progress(line + remaining_text())


class Heard:
    """Says lines; and while it is silent for long inside `with`, that work goes on.

    Parameters
    ----------
    rest
        What is added then: the rest of the time in words.
    """

    def __init__(self, say: Say, remaining_text: Callable[[], str] = str) -> None:
        self._say, self._rest, self._ended = say, remaining_text, threading.Event()
        self._begun = self._last = time.perf_counter()

    def __call__(self, line: str) -> None:
        self._last = time.perf_counter()
        self._say(line)

    def remind(self) -> None:
        """Until `end`."""
        while not self._ended.wait(
            max(0.01, self._last + SECONDS_BETWEEN_LINES - time.perf_counter())
        ):
            if (time_now := time.perf_counter()) - self._last >= SECONDS_BETWEEN_LINES:
                self(f"still computing, {clock(time_now - self._begun)} so far{self._rest()}")

    def end(self) -> None:
        self._ended.set()


@contextmanager
def heard(comm: MPI.Comm, say: Say, remaining_text: Callable[[], str] = str) -> Iterator[Say]:
    """A `Heard`, whose reminders rank 0 says; what is one already stays the only one."""
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
    """The rest of the time in words; empty if it is short.

    Examples
    --------
    >>> remaining_time_text(600.0), remaining_time_text(8.0)
    (', about 10 min left', '')
    >>> remaining_time_text(30.0, "at most about ")
    ', at most about 30 s left'
    """
    if seconds < LEAST_LEFT:
        return ""
    size, unit = next(
        (size, unit) for size, unit in ((3600, "h"), (60, "min"), (1, "s")) if seconds >= 1.5 * size
    )
    return f", {prefix}{seconds / size:.0f} {unit} left"


def _remaining_by_count(seconds: float, done_count: int, count: int) -> str:
    """How long the others take if they go on as those before.

    Examples
    --------
    >>> _remaining_by_count(60.0, 1, 11), _remaining_by_count(60.0, 10, 11)
    (', about 10 min left', '')
    >>> _remaining_by_count(90.0, 4, 5)
    ', about 22 s left'
    """
    return remaining_time_text(seconds * (count / done_count - 1))


def deal(count: int, comm: MPI.Intracomm) -> Iterator[int]:
    """Distribute the numbers 0 to count - 1; the next free rank gets the next number. Collective.

    All ranks increase a counter in the memory of rank 0, which works like the others.
    """
    if comm.size == 1:
        yield from range(count)
        return
    counter = np.zeros(1, dtype=np.int64)
    window = MPI.Win.Allocate(counter.nbytes if comm.rank == 0 else 0, counter.itemsize, comm=comm)
    if comm.rank == 0:
        window.tomemory()[:] = counter.tobytes()
    comm.Barrier()
    increment, number = np.ones(1, dtype=np.int64), np.zeros(1, dtype=np.int64)
    while True:
        window.Lock(0)
        window.Fetch_and_op(increment, number, 0)
        window.Unlock(0)
        if number[0] >= count:
            break
        yield int(number[0])
    window.Free()


@contextmanager
def _wait_for_all(comm: MPI.Intracomm) -> Iterator[None]:
    """Wait at the end for all ranks; an error on one of several ends all, which would wait for it
    for ever.
    """
    try:
        yield
    except BaseException as e:
        if comm.size == 1:
            raise
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
    """The outcome of a run.

    Attributes
    ----------
    knockdown
        k_d; None if there is no instability under pressure.
    barrier
        The energy barrier over E h R²; None if the case does not ask for one.
    limit
        The first limit point (the one of k_d) as in summary.json, or the event that ends a motion;
        None without.
    stopped
        Why the run ended before its target; None if it reached it.
    curve
        Every accepted point, with the columns of path.csv.
    found
        "path": the full path was computed; "fold": the fold of another run was followed, and the
        curve has only this point.
    factorisations
        Factorisations of the model's tangent, including failed attempts; without those for excluded
        modes.
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
        """Return the outcome of a run without a result."""
        return cls(None, None, why, None, wall_s, [], "path", factorisations)

    def value(self, scalar: Scalar) -> float | None:
        """A named number of the run; None if it does not have it."""
        if not self.curve:
            return None
        limits = [self.limit] if self.limit else []
        summary = {
            "knockdown": self.knockdown,
            "barrier": self.barrier,
            "limit_points": limits,
            "snaps": self.snaps,
        }
        return scalar.value_in(
            summary, [{key: str(v) for key, v in row.items()} for row in self.curve]
        )

    def serves(self, scalar: Scalar) -> bool:
        """Whether it has what a number needs: of a fold alone only the knockdown is known."""
        needed = {scalar.column, scalar.at} & set(COLUMNS)
        has_path = self.found == "path" and (not self.curve or needed <= self.curve[0].keys())
        return has_path or scalar.name == "knockdown"


OUTCOME = TypeAdapter(Outcome)


def outcome_of(
    result: Result,
    origin: OutcomeOrigin,
    factorisations: int,
    wall_s: float = 0.0,
    columns: Sequence[str] = COLUMNS,
) -> Outcome:
    """The outcome of a run, or of a fold in the form of a run; its curve has some columns of every
    run, and its own.
    """
    limits = sorted(
        result.limit_points,
        key=lambda p: p["amplitude"] != "pressure" or p["value"] != result.knockdown,
    )
    kept_columns = dict.fromkeys((*columns, *result.scene.extra_columns))
    return Outcome(
        knockdown=result.knockdown,
        limit=next(iter(limits), None) or _event(result),
        stopped=result.stopped,
        dofs=result.scene.model.system.dofs,
        wall_s=round(wall_s, 3),
        curve=[
            {
                key: v if isinstance(v := row[key], str | int) else float(v)
                for key in kept_columns
                if key in row
            }
            for row in result.rows
        ],
        found=origin,
        factorisations=factorisations,
        barrier=result.barrier,
        in_units=in_units(result),
        snaps=snaps(result.rows) if origin == "path" else [],
    )


def _event(result: Result) -> dict[str, Any] | None:
    """The point at which a motion has ended by an event or an instability, in the form of a limit
    point.
    """
    last, steps = result.rows[-1], result.scene.problem.programme
    until = getattr(steps[-1].load, "until", "") if steps else ""
    if result.stopped or last["amplitude"] != "time" or until not in ("event", "instability"):
        return None
    common = {key: last[key] for key in ("p_over_pc", "w_pole_over_h", "amplitude")}
    return {**common, "kind": until, "mode": "", "value": last["time"]}


def keep_outcome(outcome: Outcome, case: Case, file: Path) -> None:
    """Write the outcome of a case."""
    origin = {
        "case": case.model_dump(mode="json", exclude_none=True),
        **case.outside,
        "sources": code_version(),
    }
    keep(file, {**origin, "outcome": asdict(outcome)})


def stored_outcome_of_case(file: Path) -> Outcome | None:
    """The outcome of a case in a file, if these sources have computed it; see `stored_outcome`."""
    return stored_outcome(file, OUTCOME, "outcome", sources=code_version())

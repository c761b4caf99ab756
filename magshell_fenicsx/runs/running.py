"""Run a case: follow its history, write every accepted point, summarise.

A signal or a time limit stops a run between two solves or two steps in time.
"""

import signal
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, Self

from mpi4py import MPI

from magshell_fenicsx.assembly.kernels import reporting_progress_to
from magshell_fenicsx.continuation.factor import has_cholmod
from magshell_fenicsx.continuation.fold import FoldLost
from magshell_fenicsx.continuation.modes import NoEigenpair
from magshell_fenicsx.continuation.point import NoJournal, Point, RecordedValues, SolverJournal
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.output.report.report import write_report
from magshell_fenicsx.output.store import checkpoint
from magshell_fenicsx.output.store.durable import Damaged, read_result
from magshell_fenicsx.output.store.folder import DiskError, by_first, given_folder, held_folder
from magshell_fenicsx.output.store.table import LOCATED, SOLUTION, Row
from magshell_fenicsx.output.store.written import MESH
from magshell_fenicsx.platform.environment import fast_blas
from magshell_fenicsx.platform.terminal import LINE_COLUMNS, fit_to_columns, is_plain_output
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.quantities.quantity import format_number
from magshell_fenicsx.quantities.registry import amplitude, shown_quantity
from magshell_fenicsx.runs.files import RunFiles, open_folder
from magshell_fenicsx.runs.modes import frequencies_after, modes_after, wanted
from magshell_fenicsx.runs.rows import RowMaker, departures, imbalances
from magshell_fenicsx.runs.status import RunProgress, waiting
from magshell_fenicsx.runs.summary import Result, summary
from magshell_fenicsx.simulate.adapt.ending import NoResult
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.perfect import with_modes
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.simulate.scene import Scene

if TYPE_CHECKING:  # a run imports what its case asks for
    from magshell_fenicsx.simulate.adapt.choice import Adapted

# mpirun passes SIGUSR1 on to the ranks and waits; SIGHUP is that of a terminal that is closed
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1, signal.SIGHUP)
__all__ = ["Result", "run"]

Say = Callable[[str], None]
OF_THE_FIRST = (
    "mesh.tolerance and the estimated error are of the bifurcation in the first model, and not of what follows in the "
    "larger one"
)
OF_BOTH = "at the end of the branch the estimated relative error is {:.2g}, on a mesh of the larger model's own"
ROUNDING = 1e-9  # a displacement over h as small as this is printed as zero


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
        self._signals = (
            SIGNALS if signals and threading.current_thread() is threading.main_thread() else ()
        )
        self._reason: str | None = None

    def __enter__(self) -> Self:
        self._before: dict[signal.Signals, Callable[[int, FrameType | None], Any] | int | None] = {
            number: signal.signal(number, signal.SIG_IGN if self._ignored(number) else self._note)
            for number in self._signals
        }
        return self

    def _ignored(self, number: signal.Signals) -> bool:
        """Whether `nohup` has it ignored; PETSc would end the process."""
        return number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
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

    def __init__(self, journal: SolverJournal, watch: Watch) -> None:
        self._journal, self._watch = journal, watch

    def replay(self) -> Point | str | None:
        kept = self._journal.replay()
        if kept is None:
            self._watch.check()
        return kept

    def record(self, result: Point | str) -> None:
        self._journal.record(result)

    def recorded_values(self, find: Callable[[], RecordedValues]) -> RecordedValues:
        return self._journal.recorded_values(find)

    def begin(self, space: object) -> None:
        self._journal.begin(space)

    def check(self, known: bool) -> None:
        self._watch.check(
            limited=not known
        )  # a way that is only computed again must end, or no resumed run gets on


def run(
    problem: Problem,
    out: Path | str | None = None,
    comm: MPI.Comm = MPI.COMM_WORLD,
    say: Say = lambda line: None,
    *,
    tell: Say | None = None,
    resume: bool = False,
    overwrite: bool = False,
    time_limit: float | None = None,
    pictures: bool = True,
) -> Result:
    """Run a problem, of which `case` of `public.run` is one form; see there for all else."""
    start = time.perf_counter()
    folder = None if out is None else given_folder(out)
    if time_limit is not None and not time_limit >= 0:
        raise CaseError(f"--time-limit {time_limit}: must be a number of seconds, 0 or more")
    if folder and not problem.document.data:
        raise CaseError(
            "out: a run is known again by what it writes of its case: give the problem a 'document'"
        )
    watch = Watch(comm, start, time_limit, signals=out is not None)
    listened = tell is not None
    say, tell = (say, tell or _ignored) if comm.rank == 0 else (_ignored, _ignored)
    with (
        reporting_progress_to(_of_kernels(say, tell, start, apart=is_plain_output(comm.size)))
        if listened
        else nullcontext()
    ):
        if pictures and folder and comm.rank == 0:
            from magshell_fenicsx.output.pictures.view import library

            library()  # before anything is solved: there may be no compiler
        if folder is None:
            return _run(problem, None, comm, say, tell, watch, start, pictures, resume=False)
        with held_folder(folder, comm, make=not resume):
            open_folder(folder, problem.document, comm, resume, overwrite)
            return _run(problem, folder, comm, say, tell, watch, start, pictures, resume=resume)


def _of_kernels(say: Say, tell: Say, start: float, *, apart: bool) -> Say:
    """Tells how far kernels are; if `apart`, the first time in a line that stays: a pipe gets a
    status late.
    """
    stays = iter([say] if apart else [])

    def told(what: str) -> None:
        next(stays, tell)(waiting(what, time.perf_counter() - start))

    return told


def _ignored(line: str) -> None:
    """Print nothing."""


def _run(
    problem: Problem,
    folder: Path | None,
    comm: MPI.Comm,
    say: Say,
    tell: Say,
    watch: Watch,
    start: float,
    pictures: bool,
    *,
    resume: bool,
) -> Result:
    """Run a problem in a prepared folder; `start` is in seconds of `time.perf_counter`."""

    def doing(what: str) -> None:
        tell(waiting(what, time.perf_counter() - start))

    begun = (
        by_first(comm, partial(checkpoint.begun, problem.document), "cannot be read")
        if folder
        else b""
    )
    try:
        problem = with_modes(problem, comm)
        chosen = _mesh_for_tolerance(problem, folder if resume else None, comm, say, doing)
        doing("mesh and kernels")
        scene = chosen.choice.scene(problem, comm) if chosen else Scene(problem, comm)
        if problem.gradients is not None:
            from magshell_fenicsx.runs.gradients import refuse_unknown

            refuse_unknown(scene)
    except (CaseError, MeshError) as e:
        raise type(e)(problem.document.placed(str(e))) from None
    if chosen and chosen.branch:
        scene.meshed = chosen.branch.choice.applied
    result = Result(scene, scene.unloaded(), adapted=chosen)
    say(
        f"{', '.join(scene.problem.included)}: {scene.cells} cells, {scene.model.system.dofs} unknowns"
    )
    for warning in (*scene.warnings, *scene.unshown):
        say(f"warning: {warning}")
    if fast_blas() is None:
        say("warning: PETSc uses the reference BLAS; install OpenBLAS to factor seven times faster")
    if comm.size == 1 and not has_cholmod():
        say(
            "warning: PETSc has no CHOLMOD, which factors tangents that are positive definite in half of the time"
        )
    mesh = chosen.to_json() if chosen else None
    files = RunFiles(folder, scene, begun, resume=resume, mesh=mesh) if folder else None
    if files and files.kept:
        start -= files.elapsed
        say(f"resuming after {files.kept} points")
    interrupted: RuntimeError | None = None
    scene.progress = progress = RunProgress(scene, tell, start)
    with watch:
        scene.journal = Stoppable(NoJournal(), watch)
        try:
            _follow(result, files, say, progress, start, watch)
            if chosen and result.elsewhere:
                result.branch_error = _branch_error(result)
                known = result.branch_error is not None
                result.remarks.append(
                    OF_BOTH.format(result.branch_error) if known else OF_THE_FIRST
                )
            for step in scene.problem.programme:
                if step.load.search and not any(
                    int(result.rows[i]["step"]) == step.number for i in result.found
                ):
                    say(
                        f"warning: the search at the end of step {step.number} has found no further solution"
                    )
            steps = scene.problem.programme
            for said in (
                *imbalances(steps, result.rows, scene.model.system.length),
                *departures(steps, result.rows),
            ):
                say(f"warning: {said}")
            result.sensitivities = _sensitivities(result)
            result.barrier = _barrier(result)
        except (Stopped, NoEigenpair) as e:
            result.stopped = str(e)
        except (Interrupted, DiskError) as e:
            interrupted, result.stopped = e, str(e)
        if files and folder and files.journal:
            result.replayed = files.journal.replayed
            try:
                files.summarise(summary(result, time.perf_counter() - start))
                if not interrupted:  # an interrupted run draws no pictures
                    progress.doing("modes and pictures")
                    with result.output:
                        modes_after(result, folder, say)
                        frequencies_after(result, folder, say)
                        if problem.gradients is not None:
                            from magshell_fenicsx.runs.gradients import gradients_after

                            gradients_after(result, folder, say)
                        if pictures:
                            by_first(comm, partial(_draw, folder))
                    files.summarise(
                        summary(result, time.perf_counter() - start)
                    )  # with the time of the pictures
                by_first(comm, partial(write_report, folder, playable=pictures and not interrupted))
            except DiskError as e:
                interrupted = interrupted or e
            files.close(complete=not interrupted and not result.stopped)
    if interrupted:
        resumable = files is not None and files.journal is not None
        hint = (
            f"; the results so far are in {folder}/, and --resume continues from there"
            if resumable
            else ""
        )
        result.stopped = f"{interrupted}{hint}"
    return result


def _draw(folder: Path) -> None:
    """Draw the pictures of the folder."""
    from magshell_fenicsx.output.pictures.plot import draw

    draw(folder)


def _mesh_for_tolerance(
    problem: Problem, folder: Path | None, comm: MPI.Comm, say: Say, doing: Say
) -> "Adapted | None":
    """The mesh for the tolerance, that of an interrupted run if its folder has one; None for the
    default.
    """
    if problem.mesh.tolerance is None:
        return None
    from magshell_fenicsx.simulate.adapt.branch import branched
    from magshell_fenicsx.simulate.adapt.choice import Adapted
    from magshell_fenicsx.simulate.adapt.tolerance import adapted

    file = folder / MESH if folder else None
    if file and (
        saved := by_first(
            comm, lambda: read_result(file) if file.exists() else b"", "cannot be read"
        )
    ):
        try:
            return Adapted.from_json(problem, saved)
        except (ValueError, KeyError, TypeError, IndexError) as e:
            raise Damaged(f"{file}: is damaged: {type(e).__name__}: {e}") from None
    try:
        chosen = adapted(problem, comm, say, doing)
    except NoResult as e:
        say(f"warning: mesh.tolerance ignored, this run has no scalar result: {e}")
        return None
    if not any(step.load.follows_branch or step.load.branch_points for step in problem.programme):
        return chosen
    try:
        return replace(chosen, branch=branched(chosen, comm, say, doing))
    except NoResult as e:
        say(f"warning: mesh.tolerance is of the bifurcation alone: {e}")
        return chosen


def _branch_error(result: Result) -> float | None:
    """The estimated error at the end of the branch, of a mesh that was chosen for it; collective."""
    assert result.adapted
    if (
        result.adapted.branch is None
        or result.latest is None
        or result.latest.scene is result.scene
    ):
        return None
    from magshell_fenicsx.simulate.adapt.branch import branch_error

    try:
        return branch_error(result.adapted.branch, result.latest)
    except NoResult:
        return None


def _sensitivities(result: Result) -> dict[str, float]:
    """The sensitivities at the final fold, if the case requests them."""
    scene, last = result.scene, result.rows[result.end]
    step = scene.problem.programme[int(last["step"]) - 1] if last["label"] == "fold" else None
    if step is None or not step.load.wants_sensitivities:
        return {}
    from magshell_fenicsx.simulate.sensitivity import fold_at, sensitivities

    assert result.walked.located
    record = result.walked.located[-1]
    scene = record.scene or scene
    try:
        fold = fold_at(scene, record)
    except FoldLost as e:
        raise Stopped(f"the fold cannot be polished for its sensitivities: {e}") from None
    return sensitivities(scene, fold, record)


def _barrier(result: Result) -> float | None:
    """The energy barrier that the last step has passed, if it was to."""
    steps, begin = result.scene.problem.programme, result.walked.begin
    if not steps or steps[-1].until != "zero" or begin is None:
        return None
    from magshell_fenicsx.simulate.results import barrier

    assert result.walked.last
    return barrier(result.scene, steps[-1], begin.point.state, result.walked.last.point.state)


def _follow(
    result: Result,
    files: RunFiles | None,
    say: Say,
    progress: RunProgress,
    start: float,
    watch: Watch,
) -> None:
    """Compute the history of a scene and write it point by point."""
    scene, made = result.scene, RowMaker(result.scene)
    for record in follow(scene, remark=result.remarks.append):
        if files and not result.rows:
            if files.journal is None:
                files.begin()
            assert files.journal
            scene.journal = Stoppable(files.journal, watch)  # before the first solve of a step
        result.walked.add(record)
        row = made.row(record, time.perf_counter() - start)
        result.rows.append(row)
        if record.label == SOLUTION:
            result.found[len(result.rows) - 1] = record.point.state
        else:
            result.latest, result.last, result.end = (
                record,
                record.point.state,
                len(result.rows) - 1,
            )
        if wanted(scene.problem.frequencies, len(result.rows) - 1):
            result.kept[len(result.rows) - 1] = record.point.state
        if record.scene and record.scene is not scene:
            result.elsewhere[len(result.rows) - 1] = record.scene
        if record.label in LOCATED:
            result.singular[len(result.rows) - 1] = record.point.state
        if files:
            with result.output:
                files.write(row, record.point.state, record.scene or scene)
        replayed = files is not None and len(result.rows) <= files.kept
        progress.accepted(row, known=replayed)
        if not replayed:
            say(_line(row))


def _line(row: Row) -> str:
    """A point in 79 columns: what varied, the displacement, and of the other loads those that there
    are.
    """
    pressed = amplitude(str(row["amplitude"])).conjugate  # of several bodies each has its own force
    load = (
        "load_factor"
        if "load_factor" in row
        else pressed
        if pressed.startswith("force_")
        else "force"
    )
    formats = {"lambda_m": "+.4e", "p_over_pc": ".6f", load: "9.5f"}
    varied = amplitude(str(row["amplitude"])).column if row["amplitude"] else ""
    beside = f" + {row['excluded_pivots']} excluded" if row["excluded_pivots"] else ""
    unstable = (
        [f"unstable {row['negative_pivots']}{beside}"] if row["negative_pivots"] or beside else []
    )
    loads = [name for name in formats if name != varied and row[name]]
    first = [_value(varied, row, formats.get(varied, "9.5f"))] if varied else []
    at_pole = (
        [_value("w_pole_over_h", row, "8.4f", "pole")]
        if row["w_pole_over_h"] != row["w_over_h"]
        else []
    )
    parts = [
        *first,
        _value("w_over_h", row, "8.4f"),
        *unstable,
        *(_value(n, row, formats[n]) for n in loads),
        *at_pole,
    ]
    return fit_to_columns(
        [f"{row['point']:4d} {row['label']:>11}", *parts, f"it {row['iterations']}"], LINE_COLUMNS
    )


def _value(name: str, row: Row, form: str, words: str = "") -> str:
    """A column, in the case's units with five digits if it has any, else in a format."""
    q = shown_quantity(name, row)
    rounding = q.kind == "displacement" and abs(float(row[name])) < ROUNDING
    measured = format_number(0.0 if rounding else float(row[q.name]), "9.5g" if q.name != name else form)
    return f"{words or q.ascii_symbol} {measured}{f' {q.si}' if q.name != name else ''}"

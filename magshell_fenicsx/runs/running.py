"""Run a case: follow its programme, write every accepted point, summarise.

A signal or a time limit stops a run between two solves or two steps in time; a signal also within a
solve, before it factors the next tangent.

A scene is the model of a problem with its solver. A record is a point of the path, with the scene
that it belongs to; a row has its columns of path.csv. The journal, or checkpoint, keeps the result
of each solve; a resumed run replays these instead of solving, until they are used up. A status is a
line of text that the next one replaces. `say` prints a line that stays, `tell` shows a status. The
result grows with the run. All ranks (processes) run the same code; only rank 0 prints and writes.
"""

import signal
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
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
from magshell_fenicsx.output.store.durable import errors_as_damage, read_result
from magshell_fenicsx.output.store.folder import DiskError, access_disk, locked_folder, user_folder
from magshell_fenicsx.output.store.manifest import MESH
from magshell_fenicsx.output.store.run_identity import empty_checkpoint
from magshell_fenicsx.output.store.stored_results import pole_of
from magshell_fenicsx.output.store.table import LOCATED, SOLUTION, Row, pole_name
from magshell_fenicsx.parts.supports.boundary import edges_of_inflated_rubber
from magshell_fenicsx.platform.environment import fast_blas
from magshell_fenicsx.platform.terminal import LINE_COLUMNS, fit_to_columns, is_plain_output
from magshell_fenicsx.problem.mesh_sizes import MAX_DEGREE
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.quantities.quantity import format_number
from magshell_fenicsx.quantities.registry import amplitude, field_columns, shown_quantity
from magshell_fenicsx.runs.files import RunFiles, open_folder
from magshell_fenicsx.runs.modes import frequencies_after, keeps_state, modes_after
from magshell_fenicsx.runs.rows import RowMaker, imbalances, motion_errors
from magshell_fenicsx.runs.status import RunProgress, status_line
from magshell_fenicsx.runs.summary import Result, summary
from magshell_fenicsx.simulate.adapt.ending import NoResult
from magshell_fenicsx.simulate.degree_comparison import NotEstimated
from magshell_fenicsx.simulate.discretisation_error import ErrorEstimates, FineScenes
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
REMARK_ON_FIRST_MODEL = (
    "mesh.tolerance and the estimated error are of the bifurcation in the first model, and not of "
    "what follows in the larger one"
)
REMARK_ON_BRANCH = (
    "at the end of the branch the estimated relative error is {:.2g}, on a mesh of the larger "
    "model's own"
)
LARGE_ERROR_WARNING = (
    "warning: the estimated error of {} is {:.2g} % of it, by the mesh: give a larger "
    "mesh.refinement, or mesh.tolerance"
)
NOT_REACHED = "the run ended before its errors were estimated"
ROUNDING = 1e-9  # over h: a smaller displacement is printed as zero


class Interrupted(RuntimeError):
    """Error that a signal or the time limit has asked the run to stop; the message names which."""


class Watch:
    """Recorder of requests to stop; inside `with`, signals are recorded instead of obeyed.

    Parameters
    ----------
    comm
        Communicator of all ranks of the run; a request on one rank stops all.
    start
        Start of the run, in seconds of `time.perf_counter`.
    limit
        Seconds after which the run stops; None sets no limit.
    signals
        Whether `SIGNALS` are recorded, which needs the main thread. A second SIGINT is obeyed.

    Attributes
    ----------
    follows_path
        Whether a path is followed: then a signal also stops a solve, for which nothing is written.
    _comm, _start, _limit
        The parameters of these names.
    _signals
        The signals that are recorded; empty if none are.
    _reason
        Name of the signal, or the time limit, that asks this rank to stop; None without.
    _handlers_before
        Signal -> its handler before `with`.
    """

    def __init__(self, comm: MPI.Comm, start: float, limit: float | None, signals: bool) -> None:
        self._comm, self._start, self._limit = comm, start, limit
        # Python allows signal handlers only in the main thread
        is_main_thread = threading.current_thread() is threading.main_thread()
        self._signals = SIGNALS if signals and is_main_thread else ()
        self._reason: str | None = None
        self.follows_path = False

    def __enter__(self) -> Self:
        """Let signals be recorded until the end of `with`, but for those that are ignored."""
        self._handlers_before: dict[
            signal.Signals, Callable[[int, FrameType | None], Any] | int | None
        ] = {
            number: signal.signal(
                number, signal.SIG_IGN if self._is_ignored(number) else self._note
            )
            for number in self._signals
        }
        return self

    def _is_ignored(self, number: signal.Signals) -> bool:
        """Return whether a signal is SIGHUP and ignored already, as by `nohup`.

        Such a SIGHUP stays ignored: the handler of PETSc would end the process.
        """
        return number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Restore the handlers of signals that were in place before."""
        for number, handler in self._handlers_before.items():
            signal.signal(number, handler)

    def check(self, *, limited: bool = True) -> None:
        """Raise `Interrupted` if a rank has a request to stop, or at the time limit; collective.

        Parameters
        ----------
        limited
            Whether the time limit counts as well as signals.

        Raises
        ------
        Interrupted
            On every rank, if any rank has been asked to stop or has reached the limit.
        """
        limit = self._limit if limited else None
        if limit is not None and time.perf_counter() - self._start >= limit:
            self._reason = self._reason or f"the time limit of {limit:g} s"
        self._raise_request()

    def check_within_solve(self) -> None:
        """Raise `Interrupted` within a solve of the path, if a signal asks for it; collective.

        A time limit lets each solve end, so that a run that is resumed again and again gets on.
        """
        if self.follows_path:
            self._raise_request()

    def _raise_request(self) -> None:
        """Raise `Interrupted` on all ranks if one has a reason to stop; collective."""
        # of the first rank that has one, so that all ranks raise together
        reason = next(filter(None, self._comm.allgather(self._reason)), None)
        if reason:
            raise Interrupted(f"interrupted by {reason}")

    def _note(self, number: int, frame: FrameType | None) -> None:
        """Record a signal as the reason to stop; restore the earlier handler of SIGINT.

        A second SIGINT therefore acts as it would without the watch.
        """
        self._reason = signal.Signals(number).name
        if number == signal.SIGINT:
            signal.signal(number, self._handlers_before[signal.SIGINT])


class StoppableJournal:
    """Journal of solver results that stops the run before a new solve if the watch requests it.

    It wraps another journal (`_journal`), to which it passes every call, and asks the `_watch`. All
    methods are collective.
    """

    def __init__(self, journal: SolverJournal, watch: Watch) -> None:
        self._journal, self._watch = journal, watch

    def replay(self) -> Point | str | None:
        """Return the next recorded result; None if a solve is needed and no stop is requested.

        Raises
        ------
        Interrupted
            If a solve is needed and a stop is requested.
        """
        result = self._journal.replay()
        if result is None:
            self._watch.check()
        return result

    def record(self, result: Point | str) -> None:
        self._journal.record(result)

    def recorded_values(self, find: Callable[[], RecordedValues]) -> RecordedValues:
        return self._journal.recorded_values(find)

    def begin(self, space: object) -> None:
        self._journal.begin(space)

    def check(self, is_known: bool) -> None:
        """Stop the run if that is requested, between two steps in time towards one result.

        `is_known` is whether the result is already recorded. The time limit does not count then: a
        resumed run computes known steps again, and would otherwise never get beyond them.
        """
        self._watch.check(limited=not is_known)


@dataclass(frozen=True)
class RunOutput:
    """Where a run reports its progress, and what may stop it.

    Attributes
    ----------
    comm
        Communicator of all ranks.
    say
        Function that prints a line that stays; silent on ranks other than 0.
    tell
        Function that shows a status line, which the next status replaces; silent on ranks other
        than 0.
    watch
        Recorder of requests to stop.
    start
        Beginning of the run, in seconds of `time.perf_counter`.
    pictures
        Whether pictures are drawn.
    """

    comm: MPI.Comm
    say: Say
    tell: Say
    watch: Watch
    start: float
    pictures: bool

    def report(self, what: str) -> None:
        """Show an activity, such as "mesh and kernels", as the status, with the time so far."""
        self.tell(status_line(what, time.perf_counter() - self.start))


def run(  # noqa: PLR0913 - what a user gives
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
    """Run a problem, and write its results into a folder if one is given; collective.

    A `Problem` holds everything that will be computed.

    Parameters
    ----------
    out
        Folder of the results; None writes nothing.
    say, tell
        Functions for lines that stay, and for statuses, which the next status replaces. Without
        `tell`, no status is shown.
    resume, overwrite
        Whether the run in the folder goes on, or whether another run may be replaced.
    time_limit, pictures
        Seconds after which the run stops, None without; and whether pictures are drawn.

    Raises
    ------
    CaseError
        If the time limit is negative, the problem cannot be written, or the folder cannot be used.
    """
    start = time.perf_counter()
    # what cannot be run is refused
    folder = None if out is None else user_folder(out)
    if time_limit is not None and not time_limit >= 0:
        raise CaseError(f"--time-limit {time_limit}: must be a number of seconds, 0 or more")
    if folder and not problem.document.data:
        raise CaseError(
            "out: a run is known again by what it writes of its case: give the problem a 'document'"
        )
    # where the run reports: rank 0 alone prints
    has_listener = tell is not None
    if comm.rank != 0:
        say, tell = _print_nothing, _print_nothing
    watch = Watch(comm, start, time_limit, signals=out is not None)
    output = RunOutput(comm, say, tell or _print_nothing, watch, start, pictures)
    progress = _kernel_progress(output, keeps_first=is_plain_output(comm.size))
    # the run; the compilation of kernels also reports its progress if somebody listens
    with reporting_progress_to(progress) if has_listener else nullcontext():
        draws_pictures = pictures and comm.rank == 0
        if folder and draws_pictures:
            from magshell_fenicsx.output.pictures.rendering import library

            library()  # before anything is solved: there may be no compiler
        if folder is None:
            return _run(problem, None, output, resume=False)
        with locked_folder(folder, comm, make=not resume):
            open_folder(folder, problem.document, comm, resume, overwrite)
            return _run(problem, folder, output, resume=resume)


def _kernel_progress(output: RunOutput, *, keeps_first: bool) -> Say:
    """Return a function that reports the progress of the compilation of kernels.

    Parameters
    ----------
    keeps_first
        Whether the first report is printed as a line that stays, since a pipe shows statuses late.
    """
    first_reports = iter([output.say] if keeps_first else [])  # used up by the first report

    def report(what: str) -> None:
        """Print or show a report with the time so far."""
        # `say` for the first report if it is kept, `tell` for all others
        show = next(first_reports, output.tell)
        show(status_line(what, time.perf_counter() - output.start))

    return report


def _print_nothing(line: str) -> None:
    """Print nothing."""


def _run(problem: Problem, folder: Path | None, output: RunOutput, *, resume: bool) -> Result:
    """Run a problem and return its result; collective.

    Parameters
    ----------
    folder
        Prepared and locked folder of the run; None if nothing is written.
    resume
        Whether the run in the folder goes on.

    Returns
    -------
    Result
        Its `stopped` is the reason, if the run was interrupted or could not go on.
    """
    comm, say = output.comm, output.say
    first_checkpoint = b""
    if folder:  # before the scene is built, which takes long: the files of the case may change
        write = partial(empty_checkpoint, problem.document)
        first_checkpoint = access_disk(comm, write, "cannot be read")
    # the scene, and the files of the run
    result = _unloaded_result(problem, folder if resume else None, output)
    scene, mesh = result.scene, result.adapted
    _say_what_is_solved(scene, comm, say)
    files = None
    if folder:
        mesh_content = mesh.to_json() if mesh else None
        files = RunFiles(folder, scene, first_checkpoint, resume=resume, mesh=mesh_content)
    if files and files.complete_points:
        # times go on from the interrupted run
        output = replace(output, start=output.start - files.elapsed)
        say(f"resuming after {files.complete_points} points")
    # the path, and what is written after it
    interruption: RuntimeError | None = None
    scene.progress = progress = RunProgress(scene, output.tell, output.start)
    with output.watch:
        # `_follow` sets the journal of the files when they are opened, at the first point
        scene.journal = StoppableJournal(NoJournal(), output.watch)
        scene.newton.factorisation.allow = output.watch.check_within_solve
        output.watch.follows_path = True
        try:
            _follow(result, files, output, progress)
            _conclude(result, say)
        except (Stopped, NoEigenpair) as e:  # the solver cannot go on
            result.stopped = str(e)
        except (Interrupted, DiskError) as e:
            interruption, result.stopped = e, str(e)
        output.watch.follows_path = False
        if files and folder:
            interruption = _write_results(result, files, folder, output, progress, interruption)
    # the reason of an interruption, and how to go on where a journal has been written
    if interruption:
        is_resumable = files is not None and files.journal is not None
        resume_hint = ""
        if is_resumable:
            resume_hint = (
                f"; the results so far are in {folder}/, and --resume continues from there"
            )
        result.stopped = f"{interruption}{resume_hint}"
    return result


def _unloaded_result(problem: Problem, folder: Path | None, output: RunOutput) -> Result:
    """Return the result before the first point, with the scene of the problem; collective.

    A scene is the model of a problem with its solver.

    Parameters
    ----------
    folder
        Folder of the run that is resumed, which may hold a chosen mesh; None for a new run.

    Raises
    ------
    CaseError, MeshError
        With the place in the case before the message.
    """
    try:
        # modes of the perfect shell become imperfections, where the case asks for this
        problem = with_modes(problem, output.comm)
        mesh = _mesh_for_tolerance(problem, folder, output.comm, output.say, output.report)
        output.report("mesh and kernels")
        scene = mesh.choice.scene(problem, output.comm) if mesh else Scene(problem, output.comm)
        if problem.gradients is not None:
            from magshell_fenicsx.runs.gradients import refuse_unknown

            refuse_unknown(scene)
    except (CaseError, MeshError) as e:
        raise type(e)(problem.document.with_place(str(e))) from None
    if mesh and mesh.branch:  # the larger model of a branch gets the mesh chosen for it
        scene.remesh = mesh.branch.choice.applied
    return Result(scene, scene.unloaded(), adapted=mesh)


def _write_results(
    result: Result,
    files: RunFiles,
    folder: Path,
    output: RunOutput,
    progress: RunProgress,
    interruption: RuntimeError | None,
) -> RuntimeError | None:
    """Write what follows the path: summary, modes, pictures and report; collective.

    It writes nothing if the path has not begun: the files have no journal then.

    Parameters
    ----------
    interruption
        Error that has interrupted the path; None if nothing has. Then only the summary and the
        report are written, and the checkpoint stays.

    Returns
    -------
    RuntimeError or None
        The given interruption, or else the error of the disk that occurred while writing.
    """
    if not files.journal:
        return interruption
    result.replayed = files.journal.replayed
    pictures = output.pictures and not interruption  # an interrupted run draws none
    try:
        # what follows may fail: the results are on disk before
        unestimated = ErrorEstimates(reasons={"all": NOT_REACHED})
        files.write_summary(summary(result, unestimated, time.perf_counter() - output.start))
        if not interruption:
            progress.doing("errors by one degree more")
            _estimate_errors(result, output)
            estimates = result.error_estimates  # pictures read them from the summary
            files.write_summary(summary(result, estimates, time.perf_counter() - output.start))
            progress.doing("modes and pictures")
            _write_after_run(result, folder, output.comm, output.say, pictures)
            files.write_summary(summary(result, estimates, time.perf_counter() - output.start))
        access_disk(output.comm, partial(write_report, folder, playable=pictures))
    except DiskError as e:
        interruption = interruption or e
    files.close(complete=not interruption and not result.stopped)
    return interruption


def _estimate_errors(result: Result, output: RunOutput) -> None:
    """Estimate the errors of the results, and print warnings about them; collective.

    A run that has been asked to stop, or is at its time limit, has no estimates, or no further
    ones.
    """

    def check() -> None:
        """Raise `NotEstimated` if the run has been asked to stop."""
        try:
            output.watch.check()
        except Interrupted as e:
            raise NotEstimated(str(e)) from None

    result.fine_scenes = FineScenes(check)
    try:
        check()
    except NotEstimated as e:
        result.error_estimates = ErrorEstimates(reasons={"all": str(e)})
        return
    for name, error in result.large_errors.items():
        output.say(LARGE_ERROR_WARNING.format(name, 100 * error))
    estimates = result.error_estimates
    for name in estimates.too_coarse:
        way_on = _way_to_estimate(result.scene.problem)
        output.say(f"warning: no estimated error of {name}: {estimates.reasons[name]}: {way_on}")


def _way_to_estimate(problem: Problem) -> str:
    """Return what gives an estimated error where the mesh of a run may be too coarse, in words."""
    mesh = problem.mesh
    way_on = "compare with a larger mesh.refinement"
    if mesh.tolerance is None:
        way_on = "mesh.tolerance, such as 1e-3, finds a mesh and gives one; or " + way_on
    # the cells at a clamped edge of inflated rubber have one size, whatever the refinement
    if edges_of_inflated_rubber(problem.context) and mesh.degree < MAX_DEGREE:
        way_on = f"give mesh.degree: {mesh.degree + 1}"
        if mesh.tolerance is not None:
            way_on += " in place of mesh.tolerance"
    return way_on


def _say_what_is_solved(scene: Scene, comm: MPI.Comm, say: Say) -> None:
    """Print what the model includes, its size, and warnings.

    Warnings are those of the scene, and about a slow BLAS or factorisation.
    """
    included = ", ".join(scene.problem.included)
    say(f"{included}: {scene.cells} cells, {scene.model.system.dofs} unknowns")
    for warning in (*scene.warnings, *scene.unresolved):
        say(f"warning: {warning}")
    if fast_blas() is None:
        say("warning: PETSc uses the reference BLAS; install OpenBLAS to factor seven times faster")
    if comm.size == 1 and not has_cholmod():
        say(
            "warning: PETSc has no CHOLMOD, which factors tangents that are positive definite in "
            "half of the time"
        )


def _conclude(result: Result, say: Say) -> None:
    """Compute what follows from a complete path, and print warnings about it; collective.

    Sets the error of the branch, remarks, sensitivities and the energy barrier of the result.
    Warnings name searches without a solution, imbalances of energy and errors of motions.
    """
    programme, length = result.scene.problem.programme, result.scene.model.system.length
    if result.adapted and result.scenes_of_rows:  # the path has gone on in a larger model
        result.branch_error = _branch_error(result)
        if result.branch_error is None:
            result.remarks.append(REMARK_ON_FIRST_MODEL)
        else:
            result.remarks.append(REMARK_ON_BRANCH.format(result.branch_error))
    for step in programme:
        steps_with_solutions = {int(result.rows[number]["step"]) for number in result.found}
        if step.load.search and step.number not in steps_with_solutions:
            say(
                f"warning: the search at the end of step {step.number} has found no further "
                "solution"
            )
    for warning in imbalances(programme, result.rows, length):
        say(f"warning: {warning}")
    for warning in motion_errors(programme, result.rows):
        say(f"warning: {warning}")
    result.sensitivities = _sensitivities(result)
    result.barrier = _barrier(result)


def _write_after_run(
    result: Result, folder: Path, comm: MPI.Comm, say: Say, pictures: bool
) -> None:
    """Write modes, frequencies and gradients, and draw pictures if wanted; collective.

    The time counts as that of the output, in `result.output`.
    """
    with result.output:
        modes_after(result, folder, say)
        frequencies_after(result, folder, say)
        result.fine_scenes.clear()  # nothing else is compared
        if result.scene.problem.gradients is not None:
            from magshell_fenicsx.runs.gradients import gradients_after

            gradients_after(result, folder, say)
        if pictures:
            access_disk(comm, partial(_draw, folder))


def _draw(folder: Path) -> None:
    """Draw the pictures of a run from the files in its folder; on one rank only."""
    from magshell_fenicsx.output.pictures.plot import draw

    draw(folder)


def _mesh_for_tolerance(
    problem: Problem, folder: Path | None, comm: MPI.Comm, say: Say, report: Say
) -> "Adapted | None":
    """Return the mesh that is adapted to the case's `mesh.tolerance`; collective.

    A resumed run takes the mesh that is saved in its folder, if there is one. Where the path may go
    on along a branch, the result also has a mesh for that branch.

    Parameters
    ----------
    folder
        Folder of a resumed run; None for a new one.
    say, report
        Functions that print a line, and that show an activity as the status.

    Returns
    -------
    Adapted or None
        None without a tolerance, or if the run has no scalar result to estimate an error of.

    Raises
    ------
    Damaged
        If the saved mesh cannot be used.
    """
    if problem.mesh.tolerance is None:
        return None
    from magshell_fenicsx.simulate.adapt.branch import branched
    from magshell_fenicsx.simulate.adapt.tolerance import adapted

    # an interrupted run has found its mesh already, which takes long
    saved_mesh = _saved_mesh(problem, folder / MESH, comm) if folder else None
    if saved_mesh is not None:
        return saved_mesh
    try:
        mesh = adapted(problem, comm, say, report)
    except NoResult as e:
        say(f"warning: mesh.tolerance ignored, this run has no scalar result: {e}")
        return None
    # on a branch, which may be in a larger model, the result has an error of its own
    if not any(
        step.load.end.follows_branch or step.load.end.branch_points for step in problem.programme
    ):
        return mesh
    try:
        return replace(mesh, branch=branched(mesh, comm, say, report))
    except NoResult as e:
        say(f"warning: mesh.tolerance is of the bifurcation alone: {e}")
        return mesh


def _saved_mesh(problem: Problem, file: Path, comm: MPI.Comm) -> "Adapted | None":
    """Return the mesh that an interrupted run has saved in a file; None without one. Collective.

    Raises
    ------
    Damaged
        If the content of the file cannot be used.
    """
    from magshell_fenicsx.simulate.adapt.choice import Adapted

    saved_content = access_disk(
        comm, lambda: read_result(file) if file.exists() else b"", "cannot be read"
    )
    if not saved_content:
        return None
    with errors_as_damage(file):
        return Adapted.from_json(problem, saved_content)


def _branch_error(result: Result) -> float | None:
    """Return the estimated relative error at the end of a branch in a larger model; collective.

    None if no mesh was chosen for the branch, or the path has not left its first model.
    """
    assert result.adapted
    mesh_of_branch, last_record = result.adapted.branch, result.last_record
    if mesh_of_branch is None or last_record is None:
        return None
    if last_record.scene is result.scene:
        return None
    from magshell_fenicsx.simulate.adapt.branch import branch_error

    try:
        return branch_error(mesh_of_branch, last_record)
    except NoResult:
        return None


def _sensitivities(result: Result) -> dict[str, float]:
    """Return the sensitivities at the final fold by name, if the case requests them; collective.

    Empty if the path does not end at a fold. `simulate.sensitivity` explains their names and units.

    Raises
    ------
    Stopped
        If the fold cannot be located accurately enough.
    """
    scene, last_row = result.scene, result.rows[result.end]
    if last_row["label"] != "fold":
        return {}
    step = scene.problem.programme[int(last_row["step"]) - 1]  # steps are numbered from 1
    if not step.load.end.sensitivities:
        return {}
    from magshell_fenicsx.simulate.sensitivity import sensitivities
    from magshell_fenicsx.simulate.steps import fold_at

    assert result.path_history.located
    record = result.path_history.located[-1]
    scene = record.scene or scene
    try:
        fold = fold_at(scene, record)
    except FoldLost as e:
        raise Stopped(f"the fold cannot be polished for its sensitivities: {e}") from None
    return sensitivities(scene, fold, record)


def _barrier(result: Result) -> float | None:
    """Return the energy barrier of a last step with `until: zero`, over E h R^2; collective.

    It is between the states at the step's begin and end; None for other last steps.
    """
    steps, begin = result.scene.problem.programme, result.path_history.begin
    if not steps or begin is None:
        return None
    # a step with `until: zero` passes the largest load and goes back to the load zero: the unstable
    # state there, of the highest energy, is the top of the barrier
    if steps[-1].until != "zero":
        return None
    from magshell_fenicsx.simulate.results import barrier

    assert result.path_history.last
    return barrier(result.scene, steps[-1], begin.point.state, result.path_history.last.point.state)


def _follow(
    result: Result,
    files: RunFiles | None,
    output: RunOutput,
    progress: RunProgress,
) -> None:
    """Compute the path of the result's scene, and add each point to the result; collective.

    Each point is also written to `files`, unless None, and printed. A point that an interrupted run
    has written is computed again from the journal, and not printed.

    Raises
    ------
    Stopped, NoEigenpair, Interrupted, DiskError
        If the path ends early. The result has the points before that.
    """
    scene, row_maker, pole = result.scene, RowMaker(result.scene), ""
    for record in follow(scene, remark=result.remarks.append):
        # at the first point, which comes before the first solve of a step, the files are opened,
        # and the scene takes their journal
        if files and not result.rows:
            if files.journal is None:
                files.begin()
            assert files.journal
            scene.journal = StoppableJournal(files.journal, output.watch)
        # the point with its row
        result.path_history.add(record)
        row = row_maker.row(record, time.perf_counter() - output.start)
        number = len(result.rows)
        result.rows.append(row)
        if record.label == SOLUTION:  # a solution of a search is no point of the path
            result.found[number] = record.point.state
        else:
            result.last_record, result.last, result.end = record, record.point.state, number
        # states and scenes that are needed after the path
        if keeps_state(scene.problem.frequencies, number):
            result.states_for_frequencies[number] = record.point.state
        if record.scene and record.scene is not scene:
            result.scenes_of_rows[number] = record.scene
        if record.label in LOCATED:
            result.singular[number] = record.point.state
        # what is written and printed
        if files:
            with result.output:
                files.write(row, record.point.state, record.scene or scene)
        replayed = files is not None and len(result.rows) <= files.complete_points
        progress.accepted(row, is_known=replayed)
        pole = pole or pole_name(row, pole_of(scene.problem.document.data)).removeprefix("the ")
        if not replayed:
            output.say(_line(row, pole))
            if record.said:  # at once, since the path may take long from here on
                output.say(f"warning: {record.said}")


def _line(row: Row, pole: str) -> str:
    """Return a point as one line of at most 79 columns: loads, displacements, iterations.

    `row` is the point's row of path.csv, `pole` the name of the point of `w_pole_over_h`.
    """
    # column of the amplitude that varied; empty without
    varied = ""
    if row["amplitude"]:
        varied = amplitude(str(row["amplitude"])).column
    # column of the force: of one body "force"; of several bodies each has its own, such as
    # "force_a", which is the conjugate of the amplitude that moves the body
    force_column = "force"
    conjugate = amplitude(str(row["amplitude"])).conjugate
    if "load_factor" in row:
        force_column = "load_factor"
    elif conjugate.startswith("force_"):
        force_column = conjugate
    # the loads with their formats, and the fields of the line
    formats = dict.fromkeys(field_columns(), "+.4e") | {"p_over_pc": ".6f", force_column: "9.5f"}
    fields = [f"{row['point']:4d} {row['label']:>11}"]
    if varied:
        fields.append(_value(varied, row, formats.get(varied, "9.5f")))
    fields.append(_value("w_over_h", row, "8.4f"))
    excluded = f" + {row['excluded_pivots']} excluded" if row["excluded_pivots"] else ""
    if row["negative_pivots"] or excluded:
        fields.append(f"unstable {row['negative_pivots']}{excluded}")
    # the other loads, where they are not zero, and the displacement of the pole, the tip or the
    # first named point, if it is another
    fields += [_value(name, row, formats[name]) for name in formats if name != varied and row[name]]
    if row["w_pole_over_h"] != row["w_over_h"]:
        fields.append(_value("w_pole_over_h", row, "8.4f", pole))
    return fit_to_columns([*fields, f"it {row['iterations']}"], LINE_COLUMNS)


def _value(name: str, row: Row, form: str, words: str = "") -> str:
    """Return "symbol value" of a column of a row, such as "w/h   0.1234".

    In a case with units, another column of the row may have the same quantity in a unit. That one
    is shown, with five digits and its unit. Else the column itself is shown in the format `form`.

    Parameters
    ----------
    name
        Name of the column in path.csv.
    words
        Text in place of the symbol; empty for the symbol.
    """
    shown = shown_quantity(name, row)  # the quantity of the column that is shown
    is_zero = shown.kind == "displacement" and abs(float(row[name])) < ROUNDING
    number = 0.0 if is_zero else float(row[shown.name])
    value, unit = format_number(number, form), ""
    if shown.name != name:
        value, unit = format_number(number, "9.5g"), f" {shown.si}"
    return f"{words or shown.ascii_symbol} {value}{unit}"

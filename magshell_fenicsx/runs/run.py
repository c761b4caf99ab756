"""Run a case: follow its history, write every accepted point, summarise."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.opened import opened
from magshell_fenicsx.continuation.factor import has_cholmod
from magshell_fenicsx.continuation.fold import FoldLost
from magshell_fenicsx.continuation.modes import NoEigenpair
from magshell_fenicsx.continuation.point import NoJournal
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.output.report.report import write_report
from magshell_fenicsx.output.store import checkpoint
from magshell_fenicsx.output.store.durable import Damaged, read_result
from magshell_fenicsx.output.store.folder import DiskError, by_first, given_folder, held_folder
from magshell_fenicsx.output.store.table import LOCATED, SOLUTION, Row
from magshell_fenicsx.output.store.written import MESH
from magshell_fenicsx.platform.environment import fast_blas
from magshell_fenicsx.quantities.quantity import spelled
from magshell_fenicsx.quantities.registry import amplitude, shown
from magshell_fenicsx.runs.files import RunFiles, open_folder
from magshell_fenicsx.runs.frequencies import frequencies_after, wanted
from magshell_fenicsx.runs.gradients import gradients_after, refuse_unknown
from magshell_fenicsx.runs.interrupt import Interrupted, Stoppable, Watch
from magshell_fenicsx.runs.modes import modes_after
from magshell_fenicsx.runs.rows import RowMaker, departures, imbalances
from magshell_fenicsx.runs.status import RunProgress, waiting
from magshell_fenicsx.runs.summary import Result, summary
from magshell_fenicsx.simulate.adapt.choice import Adapted
from magshell_fenicsx.simulate.adapt.ending import NoResult
from magshell_fenicsx.simulate.adapt.tolerance import adapted
from magshell_fenicsx.simulate.barrier import barrier
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.perfect import with_modes
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.sensitivity import fold_at, sensitivities

__all__ = ["Result", "run"]

Say = Callable[[str], None]
ROUNDING = 1e-9  # a displacement over h as small as this is printed as zero


def run(
    case: Case | str | Path,
    out: Path | str | None = None,
    comm: MPI.Comm = MPI.COMM_WORLD,
    say: Say = lambda line: None,
    *,
    tell: Say | None = None,
    resume: bool = False,
    overwrite: bool = False,
    time_limit: float | None = None,
    pictures: bool = True,
    terms: Sequence[OwnTerm] = (),
) -> Result:
    """Run a case.

    With `out`, SIGTERM, SIGINT and SIGUSR1 stop the run after the current point, and it can be resumed.

    Parameters
    ----------
    case
        A case, or the path of its file.
    out
        Folder for path.csv, summary.json, fields and pictures; None writes nothing.
    say
        Called on rank 0 with one line of text per accepted point.
    tell
        Called on rank 0 with a status line, which replaces the one before.
    resume
        Continue the interrupted run in `out`.
    overwrite
        Replace the run in `out` even if it is that of another case file, or was interrupted.
    time_limit
        Seconds after which the run stops in the same way.
    pictures
        Whether they are drawn; `magshell plot` draws them later.
    terms
        User-defined energies, with their amplitudes at `OwnTerm.value`; to resume the run give the same.

    Raises
    ------
    CaseError
        If building the case finds an error, `out` cannot be written, has files that no run has written, a run of
        another case file or an interrupted one, or no run of this case to resume; what is in `out` stays as it is.
    AlreadyComplete
        If the run to be resumed is complete.
    DiskError
        If the disk is full before the first point.
    """
    start = time.perf_counter()
    folder = None if out is None else given_folder(out)
    if time_limit is not None and not time_limit >= 0:
        raise CaseError(f"--time-limit {time_limit}: must be a number of seconds, 0 or more")
    case = opened(case, comm)
    case = case.with_terms(terms) if terms else case
    watch = Watch(comm, start, time_limit, signals=out is not None)
    say, tell = (say, tell or _ignored) if comm.rank == 0 else (_ignored, _ignored)
    if folder is None:
        return _run(case, None, comm, say, tell, watch, start, pictures, resume=False)
    with held_folder(folder, comm, make=not resume):
        open_folder(folder, case, comm, resume, overwrite)
        return _run(case, folder, comm, say, tell, watch, start, pictures, resume=resume)


def _ignored(line: str) -> None:
    """Print nothing."""


def _run(
    case: Case,
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
    """Run a case in a prepared folder; `start` is in seconds of `time.perf_counter`."""

    def doing(what: str) -> None:
        tell(waiting(what, time.perf_counter() - start))

    begun = by_first(comm, partial(checkpoint.begun, case), "cannot be read") if folder else b""
    try:
        with_modes(case, comm)
        found = _mesh_for_tolerance(case, folder if resume else None, comm, say, doing)
        doing("mesh and kernels")
        scene = found.choice.scene(case, comm) if found else Scene(case, comm)
        refuse_unknown(scene)
    except (CaseError, MeshError) as e:
        raise type(e)(case.placed(str(e))) from None
    result = Result(scene, scene.unloaded(), adapted=found)
    say(f"{', '.join(scene.plan.included)}: {scene.cells} cells, {scene.model.system.dofs} unknowns")
    for warning in (*scene.warnings, *scene.unshown):
        say(f"warning: {warning}")
    if fast_blas() is None:
        say("warning: PETSc uses the reference BLAS; install OpenBLAS to factor seven times faster")
    if comm.size == 1 and not has_cholmod():
        say("warning: PETSc has no CHOLMOD, which factors tangents that are positive definite in half of the time")
    mesh = found.to_json() if found else None
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
            for step in scene.plan.programme:
                if step.load.search and not any(int(result.rows[i]["step"]) == step.number for i in result.found):
                    say(f"warning: the search at the end of step {step.number} has found no further solution")
            steps = scene.plan.programme
            for said in (*imbalances(steps, result.rows, scene.model.system.length), *departures(steps, result.rows)):
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
                        gradients_after(result, folder, say)
                        if pictures:
                            by_first(comm, partial(_draw, folder))
                    files.summarise(summary(result, time.perf_counter() - start))  # with the time of the pictures
                by_first(comm, partial(write_report, folder, playable=pictures and not interrupted))
            except DiskError as e:
                interrupted = interrupted or e
            files.close(complete=not interrupted and not result.stopped)
    if interrupted:
        there = files is not None and files.journal is not None
        hint = f"; the results so far are in {folder}/, and --resume continues from there" if there else ""
        result.stopped = f"{interrupted}{hint}"
    return result


def _draw(folder: Path) -> None:
    """Draw the pictures of the folder."""
    from magshell_fenicsx.output.pictures.plot import draw

    draw(folder)


def _mesh_for_tolerance(case: Case, folder: Path | None, comm: MPI.Comm, say: Say, doing: Say) -> Adapted | None:
    """The mesh for the case's tolerance, that of an interrupted run if its folder has one; None for the default."""
    if case.mesh.tolerance is None:
        return None
    file = folder / MESH if folder else None
    if file and (known := by_first(comm, lambda: read_result(file) if file.exists() else b"", "cannot be read")):
        try:
            return Adapted.from_json(case, known)
        except (ValueError, KeyError, TypeError, IndexError) as e:
            raise Damaged(f"{file}: is damaged: {type(e).__name__}: {e}") from None
    try:
        return adapted(case, comm, say, doing)
    except NoResult as e:
        say(f"warning: mesh.tolerance ignored, this run has no scalar result: {e}")
        return None


def _sensitivities(result: Result) -> dict[str, float]:
    """The sensitivities at the final fold, if the case requests them."""
    scene, last = result.scene, result.rows[result.end]
    step = scene.plan.programme[int(last["step"]) - 1] if last["label"] == "fold" else None
    if step is None or not step.load.wants_sensitivities:
        return {}
    assert result.history.located
    record = result.history.located[-1]
    try:
        fold = fold_at(scene, record)
    except FoldLost as e:
        raise Stopped(f"the fold cannot be polished for its sensitivities: {e}") from None
    return sensitivities(scene, fold, record)


def _barrier(result: Result) -> float | None:
    """The energy barrier that the last step has passed, if it was to."""
    steps, begin = result.scene.plan.programme, result.history.begin
    if not steps or steps[-1].until != "zero" or begin is None:
        return None
    assert result.history.last
    return barrier(result.scene, steps[-1], begin.point.state, result.history.last.point.state)


def _follow(
    result: Result, files: RunFiles | None, say: Say, progress: RunProgress, start: float, watch: Watch
) -> None:
    """Compute the history of a scene and write it point by point."""
    scene, made = result.scene, RowMaker(result.scene)
    for record in follow(scene, remark=result.remarks.append):
        if files and not result.rows:
            if files.journal is None:
                files.begin()
            assert files.journal
            scene.journal = Stoppable(files.journal, watch)  # before the first solve of a step
        result.history.add(record)
        row = made.row(record, time.perf_counter() - start)
        result.rows.append(row)
        if record.label == SOLUTION:
            result.found[len(result.rows) - 1] = record.point.state
        else:
            result.last, result.end = record.point.state, len(result.rows) - 1
        if wanted(scene.case.frequencies, len(result.rows) - 1):
            result.kept[len(result.rows) - 1] = record.point.state
        if record.label in LOCATED:
            result.singular[len(result.rows) - 1] = record.point.state
        if files:
            with result.output:
                files.write(row, record.point.state)
        known = files is not None and len(result.rows) <= files.kept
        progress.accepted(row, known=known)
        if not known:
            say(_line(row))


def _line(row: Row) -> str:
    pressed = amplitude(str(row["amplitude"])).conjugate  # of several bodies each has its own force
    load = "load_factor" if "load_factor" in row else pressed if pressed.startswith("force_") else "force"
    formats = {"lambda_m": "+.4e", "p_over_pc": ".6f", load: "9.5f"}
    if row["amplitude"] and (varied := amplitude(str(row["amplitude"])).column) not in formats:
        formats[varied] = "9.5f"
    values = [_value(name, row, form) for name, form in (formats | {"w_over_h": "8.4f"}).items()]
    pole = _value("w_pole_over_h", row, "8.4f", "pole")
    beside = f" + {row['excluded_pivots']} excluded" if row["excluded_pivots"] else ""
    counts = f"unstable {row['negative_pivots']}{beside}  it {row['iterations']}"
    return "  ".join([f"{row['point']:4d} {row['label']:>11}", *values, pole, counts])


def _value(name: str, row: Row, form: str, words: str = "") -> str:
    """A column, in the case's units with five digits if it has any, else in a format."""
    q = shown(name, row)
    rounding = q.kind == "displacement" and abs(float(row[name])) < ROUNDING
    measured = spelled(0.0 if rounding else float(row[q.name]), "9.5g" if q.name != name else form)
    return f"{words or q.plain} {measured}{f' {q.si}' if q.name != name else ''}"

"""Functions that programs call: a run and a scene of a problem, or of what makes one.

That is a case, a mapping like a case file, or the path of a file. A problem has all that is
computed; a scene is a problem with its finite element model. The processes are those of MPI.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING
from warnings import warn

from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.case_variants import open_case, with_same_files
from magshell_fenicsx.case.open_problem import ProblemSource, problem_of, processes
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.model import Model
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.runs.modes import frequencies_after
from magshell_fenicsx.runs.running import run as run_problem
from magshell_fenicsx.runs.summary import Result
from magshell_fenicsx.simulate.follow import follow as follow_scene
from magshell_fenicsx.simulate.follow import warn_of
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene as SceneOfProblem

if TYPE_CHECKING:
    from magshell_fenicsx.studies.boundary.stability_boundary import StabilityBoundary
    from magshell_fenicsx.studies.ensemble.ensemble import Ensemble
    from magshell_fenicsx.studies.identify.identification import Identified
    from magshell_fenicsx.studies.sweep.sweep import Sweep

Say = Callable[[str], None]


class Scene(Model):
    """The former name of `Model`.

    Parameters
    ----------
    case
        A problem, or a case, a mapping like a case file, or the path of a file.
    comm
        The processes; by default those of the mesh that a program gave, or all.
    plan
        The name of a problem in earlier versions.
    terms
        User-defined energies besides those of the case.
    """

    def __init__(
        self,
        case: ProblemSource,
        comm: MPI.Comm | None = None,
        plan: Problem | None = None,
        *,
        terms: Sequence[OwnTerm] = (),
    ) -> None:
        if plan is not None:
            warn(
                "Scene(case, plan=problem) is now Scene(problem)", DeprecationWarning, stacklevel=2
            )
        super().__init__(plan or case, comm, terms=terms)
        self._given = case

    @property
    def case(self) -> Case:
        """The case that the scene was made of, as in earlier versions."""
        warn(
            "Scene.case is now Scene.problem, which has all that is computed",
            DeprecationWarning,
            stacklevel=2,
        )
        assert not isinstance(self._given, Problem), "a scene of a problem has no case"
        return open_case(self._given, self.comm)


def follow(
    given: SceneOfProblem | ProblemSource,
    *,
    search: bool = True,
    remark: Callable[[str], None] = warn_of,
) -> Iterator[Record]:
    """Compute the history of a scene, or of a problem or what makes one.

    It yields every accepted point. A problem on a mesh of a program is solved by the processes of
    that mesh.

    Parameters
    ----------
    search
        Whether steps search for further solutions where the case asks for that.
    remark
        Called with sentences without which the result must not be read; by default they are
        warnings.
    """
    scene = given if isinstance(given, SceneOfProblem) else Model(given)
    return follow_scene(scene, search=search, remark=remark)


def _ranks(executor: Executor | None) -> MPI.Intracomm:
    """Return the ranks that compute a study: this process alone where it has an executor.

    Raises
    ------
    CaseError
        If the executor is none.
    """
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise CaseError(
            f"executor: {executor!r}: is no executor: give one of concurrent.futures, such as "
            "ProcessPoolExecutor(4)"
        )
    return MPI.COMM_SELF if executor else MPI.COMM_WORLD


def sweep(
    file: Path | str,
    over: str | Sequence[str],
    settings: Sequence[str] = (),
    out: Path | str = "results/sweep",
    say: Say = lambda line: None,
    *,
    result: str | None = None,
    full_paths: bool = False,
    executor: Executor | None = None,
) -> "Sweep":
    """Run a case file at all points of a product of axes; see `studies.sweep.sweep.sweep`.

    Parameters
    ----------
    over
        One axis, or several: "KEY=START:STOP:COUNT" or "KEY=VALUE,VALUE"; keys tied with `+`.
    settings
        Texts "KEY=VALUE" that replace keys of the case.
    out
        Folder of sweep.csv and of the points, which are kept.
    result
        A further number of each point, as of `magshell sweep --result`.
    full_paths
        Compute the full path at every point.
    executor
        Processes that compute points, such as `concurrent.futures.ProcessPoolExecutor`; they see
        the same files. None: the ranks of MPI.
    """
    from magshell_fenicsx.studies.sweep.sweep import sweep as sweep_case

    return sweep_case(
        file,
        [over] if isinstance(over, str) else over,
        settings,
        out,
        _ranks(executor),
        say,
        make_case=Case.from_source,
        result=result,
        full_paths=full_paths,
        executor=executor,
    )


def ensemble(
    file: Path | str,
    settings: Sequence[str] = (),
    out: Path | str = "results/ensemble",
    say: Say = lambda line: None,
    *,
    samples: int,
    seed: int,
    result: str = "knockdown",
    executor: Executor | None = None,
) -> "Ensemble":
    """Compute random samples of a case file; see `studies.ensemble.ensemble.ensemble`.

    Parameters
    ----------
    settings
        Texts "KEY=VALUE" that replace keys of the case.
    out
        Folder of samples.csv and of the samples, which are kept.
    samples, seed
        Number of samples, and the seed of their random numbers.
    result
        Result of each sample, as of `magshell ensemble --result`.
    executor
        Processes that compute samples, as of `sweep`. None: the ranks of MPI.
    """
    from magshell_fenicsx.studies.ensemble.ensemble import ensemble as compute_ensemble

    return compute_ensemble(
        file,
        settings,
        samples=samples,
        seed=seed,
        make_case=Case.from_source,
        result=result,
        out=out,
        comm=_ranks(executor),
        say=say,
        executor=executor,
    )


def boundary(
    file: Path | str,
    over: str | Sequence[str],
    settings: Sequence[str] = (),
    out: Path | str = "results/boundary",
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    say: Say = lambda line: None,
    *,
    start: str | None = None,
) -> "StabilityBoundary":
    """Follow the instability at the end of a case file in a second key; see
    `studies.boundary.stability_boundary.boundary`.

    With two keys in `over` it is followed in the first key for each value of the second, see
    `studies.boundary.stability_map.boundary_map`.

    Parameters
    ----------
    over
        "KEY=A:B", the key that varies and its range; or two such texts, the second one
        "KEY=A:B:COUNT".
    settings
        Texts "KEY=VALUE" that replace keys of the case.
    start
        "DIR:POINT": the fold or bifurcation at a point of the run in a folder, which is followed
        instead. None: the instability at the end of the case.
    """
    from magshell_fenicsx.studies.boundary.stability_map import boundary_map

    overs = [over] if isinstance(over, str) else over
    return boundary_map(
        file, overs, settings, out, comm, say, make_case=Case.from_source, start=start
    )


def identify(
    file: Path | str,
    data: Path | str,
    settings: Sequence[str] = (),
    out: Path | str = "results/identify",
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    say: Say = lambda line: None,
) -> "Identified":
    """Find numbers of a case file from measured data; see `studies.identify.identification`.

    Parameters
    ----------
    file, data
        The case file, which says which numbers are searched for, and a CSV file with the data.
    settings
        Texts "KEY=VALUE" that replace keys of the case.
    out
        Folder of the results.
    say
        Function that prints a line of text.
    """
    from magshell_fenicsx.studies.identify.identification import identify as identify_parameters

    return identify_parameters(
        file,
        data,
        settings,
        out,
        comm,
        say,
        make_case=lambda source: with_same_files(Case.from_source(source), comm),
    )


def run(  # noqa: PLR0913 - what a user gives
    case: ProblemSource,
    out: Path | str | None = None,
    comm: MPI.Comm | None = None,
    say: Say = lambda line: None,
    *,
    tell: Say | None = None,
    resume: bool = False,
    overwrite: bool = False,
    time_limit: float | None = None,
    pictures: bool = True,
    terms: Sequence[OwnTerm] = (),
) -> Result:
    """Run a problem.

    With `out`, SIGTERM, SIGINT, SIGUSR1 and SIGHUP stop the run after the current point, and it can
    be resumed.

    Parameters
    ----------
    case
        A problem, or a case, a mapping like a case file, or the path of a file.
    out
        Folder for path.csv, summary.json, fields and pictures; None writes nothing.
    comm
        The processes; by default those of the mesh that a program gave, or all.
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
        User-defined energies, with their amplitudes at `OwnTerm.value`; to resume the run give the
        same.

    Raises
    ------
    CaseError, MeshError
        If no problem or no model can be built: a MeshError, where the surface has no such edge or
        patch, or its triangulation carries no shell. A CaseError too, if `out` cannot be written,
        has files that no run has written, a run of another case file or an interrupted one, or no
        run of this case to resume; what is in `out` stays as it is.
    AlreadyComplete
        If the run to be resumed is complete.
    DiskError
        If the disk is full before the first point.
    """
    comm = processes(case, comm)
    problem = problem_of(case, comm, terms)
    result = run_problem(
        problem,
        out,
        comm,
        say,
        tell=tell,
        resume=resume,
        overwrite=overwrite,
        time_limit=time_limit,
        pictures=pictures,
    )
    if out is None:  # with a folder they are there already
        on_first: Say = say if comm.rank == 0 else lambda line: None
        frequencies_after(result, None, on_first)
        result.fine_scenes.clear()
        if problem.gradients is not None:
            from magshell_fenicsx.runs.gradients import gradients_after

            gradients_after(result, None, on_first)
    return result

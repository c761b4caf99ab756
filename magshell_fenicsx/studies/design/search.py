"""A design: an optimiser of SciPy varies a case for a result.

Every evaluation is kept, and the best case is verified on a finer mesh. Evaluations are known by
their variables. A design that is started again takes the evaluations in its folder, follows the
same course, and goes on where it was interrupted.

The p variables are a vector x of scaled numbers (see `design_variables`). An evaluation has the
results of the case at x with their gradients, and no values if there are none. A wanted shape has a
target, a map from undeformed to wanted places; a curve is approached in stages of growing
curvature. The remanence is given by vectors at control points, in a file. A fold is a result that
is a critical load.
"""

import hashlib
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError, read_source
from magshell_fenicsx.output.store.durable import write_object, write_whole
from magshell_fenicsx.output.store.folder import access_disk, user_folder
from magshell_fenicsx.platform.environment import code_version
from magshell_fenicsx.platform.processes import on_first_rank
from magshell_fenicsx.platform.terminal import print_line
from magshell_fenicsx.runs.running import run
from magshell_fenicsx.runs.summary import Result
from magshell_fenicsx.simulate.gradients.fields import MASS, mass
from magshell_fenicsx.simulate.gradients.instabilities import FOLDS, SCALES, LostResult
from magshell_fenicsx.simulate.gradients.results import BARRIER, vibration_at_end
from magshell_fenicsx.simulate.results import Target, distances
from magshell_fenicsx.simulate.scene_cache import SceneCache
from magshell_fenicsx.studies.design.evaluation import DISTANCE, DesignEvaluation, evaluate
from magshell_fenicsx.studies.design.goal import DesignGoal, design_goal_of, search_optimum
from magshell_fenicsx.studies.design.picture import ReachedShape, draw_design, reached_shape
from magshell_fenicsx.studies.design.variables import Variables, variables
from magshell_fenicsx.studies.points import Case, MakeCase, identity
from magshell_fenicsx.studies.runner import Say, remaining_time_text, reporting_progress
from magshell_fenicsx.studies.store import Folder, OutcomeStore, write_table

Array = NDArray[np.float64]
FOLDER = Folder(
    "a design",
    ("summary.json", "design.csv", "best.yaml", "best.csv", "design.png"),
    ("objective", "best"),
)
STAGES_PART = 4  # stages before the last have this part of the iterations
INFLUENCE_TOLERANCE = 1e-10  # change of a result, relative, over the whole range of a variable
OTHER_RESULT_DIFFERENCE = 0.3  # relative difference of a result that is another result
ROUNDING = 1e-12  # a smaller one is none


class Missed(RuntimeError):
    """The design is not what was asked for; the message says by how much."""


@dataclass
class Design:
    """A search for a design, with its evaluations in a folder.

    Attributes
    ----------
    variables, goal
        What varies, and what is wanted.
    folder
        Folder of the design, with the evaluations in points/.
    comm
        Ranks that compute together.
    say
        Called with a line for each evaluation.
    rows
        Rows of design.csv, one per evaluation.
    tried
        The variables and the evaluations of the present stage, in order.
    stage
        Number of the present stage, from 1; 0 for the last one.
    seconds
        Wall time of each new evaluation.
    """

    variables: Variables
    goal: DesignGoal
    folder: Path
    comm: MPI.Comm
    say: Say
    rows: list[dict[str, Any]] = field(default_factory=list)
    tried: list[tuple[Array, DesignEvaluation]] = field(default_factory=list)
    stage: int = 0
    seconds: list[float] = field(default_factory=list)

    def __call__(self, x: Array) -> DesignEvaluation:
        """Return the evaluation of a vector of variables, stored or new; collective."""
        x = np.array(self.comm.bcast(x))
        # the optimiser may ask for a vector again
        for earlier_x, evaluated in reversed(self.tried):
            if np.array_equal(earlier_x, x):
                return evaluated
        # the targets of a stage before the last give other results for the same x
        stage = f"{self.stage}".encode() if self.stage else b""
        name = hashlib.sha256(x.tobytes() + stage).hexdigest()[:16]
        vectors = self._store.folder / f"{name}.csv"
        compute = partial(self._computed_evaluation, x, vectors)
        evaluation = self._store.obtain(name, compute, self.comm)
        self._add(x, evaluation, name)
        return evaluation

    def begin(self, stage: int, targets: Sequence[Mapping[str, Target]]) -> None:
        """Begin a stage: set its targets, and forget the evaluations of the stage before.

        Parameters
        ----------
        stage
            Number of the stage, from 0.
        targets
            For each stage: result -> map from undeformed to wanted places.
        """
        self.stage = (stage + 1) % len(targets)  # 0 for the last
        self.goal.targets = targets[stage]
        self.tried.clear()

    def _computed_evaluation(self, x: Array, vectors: Path) -> DesignEvaluation:
        """Compute the evaluation of a vector of variables; collective.

        Parameters
        ----------
        vectors
            File that gets the vectors of the remanence, if it varies.
        """
        start_time = time.perf_counter()
        access_disk(self.comm, lambda: self.variables.write(x, vectors))
        case, goal = self.variables.case_of(x, vectors), self.goal
        evaluation = evaluate(case, x, self.variables, goal.results, goal.targets, self._scenes)
        evaluation = DesignEvaluation(**self.comm.bcast(asdict(evaluation)))
        self.seconds.append(time.perf_counter() - start_time)
        return evaluation

    @cached_property
    def _scenes(self) -> SceneCache:
        """Scene of an evaluation, a model with its solver, for the next one."""
        return SceneCache(self.comm, overwrites=True)

    @cached_property
    def _store(self) -> OutcomeStore[DesignEvaluation]:
        """The stored evaluations of this design.

        Iterations and the finer mesh of the verification do not count for what it is.
        """
        section_text = self.goal.section.model_dump_json(exclude={"iterations", "verify"})
        designed = hashlib.sha256(
            (identity(self.variables.case) + section_text).encode()
        ).hexdigest()[:16]
        return OutcomeStore(self.folder / "points", DesignEvaluation, {"design": designed})

    def _add(self, x: Array, evaluation: DesignEvaluation, name: str) -> None:
        """Add an evaluation to the table design.csv, and say it; collective.

        Parameters
        ----------
        name
            Name of the evaluation's file in points/, without suffix.
        """
        self.tried.append((x, evaluation))
        best, solved = self.best, bool(evaluation.values)
        row = {
            "evaluation": len(self.rows) + 1,
            **{result: evaluation.values.get(result) for result in self.goal.results},
            **{f"{result}_error": evaluation.errors.get(result) for result in self.goal.results},
            **evaluation.seen,
            "objective": self.goal.objective(evaluation) if solved else None,
            "violation": self.goal.violation(evaluation) if solved else None,
            "best": bool(best and best[0] is x),  # the vector just added
            **self.variables.numbers(x),
            **({"stage": self.stage or "last"} if self.goal.stages else {}),
            "note": evaluation.note,
            "point": name,
        }
        self.rows.append(row)
        access_disk(self.comm, self._write)
        # the line of text: the stage, results, a note (in brackets behind results), the time left
        stage = f"stage {row['stage']}: " if "stage" in row else ""
        values = ", ".join(
            f"{key} = {value:.9g}{' R' if key == DISTANCE else ''}"
            for key, value in (evaluation.values | evaluation.seen).items()
        )
        note = f" ({evaluation.note})" if values and evaluation.note else evaluation.note
        self.say(
            f"{row['evaluation']:5d}  "
            f"{stage}{values}{note}{'  best' if row['best'] else ''}{self._time_left}"
        )

    @property
    def _time_left(self) -> str:
        """Text of the time for the remaining iterations, one evaluation each; "" if short."""
        # the first evaluation is no iteration
        remaining_iterations = self.goal.section.iterations + 1 - len(self.rows)
        if not self.seconds or remaining_iterations <= 0:
            return ""
        seconds_left = float(np.mean(self.seconds)) * remaining_iterations
        return remaining_time_text(seconds_left, "at most about ")

    def _write(self) -> None:
        """Write design.csv, unless no evaluation has results and there is an earlier table."""
        has_results = any(evaluation.values for _, evaluation in self.tried)
        if not has_results and (self.folder / "design.csv").exists():
            return  # a design that cannot start replaces nothing
        write_table(self.rows, self.folder / "design.csv")

    @property
    def best(self) -> tuple[Array, DesignEvaluation] | None:
        """Vector and evaluation of the best evaluation in this stage; None if none has results.

        The least violation of the constraints counts first, then the objective.
        """
        solved = [(x, evaluation) for x, evaluation in self.tried if evaluation.values]
        if not solved:
            return None

        def merit(x_and_evaluation: tuple[Array, DesignEvaluation]) -> tuple[float, float]:
            """Return violation and objective of an evaluation; the least pair is the best."""
            _, evaluation = x_and_evaluation
            return self.goal.merit(evaluation)

        return min(solved, key=merit)


def design(
    file: Path | str,
    settings: Sequence[str] = (),
    out: Path | str = "results/design",
    *,
    make_case: MakeCase,
    resume: bool = False,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    say: Say = print_line,
) -> dict[str, Any]:
    """Vary a case for a result; collective.

    Parameters
    ----------
    out
        Folder of design.csv (all evaluations), best.yaml with best.csv (the best case and its
        remanence), design.png, summary.json, verified/ (the run of the best case on a finer mesh)
        and points/.
    make_case
        Makes a case of its source, the same on all ranks.
    resume
        Require that the folder has evaluations to go on from.

    Returns
    -------
    The content of summary.json.

    Raises
    ------
    CaseError
        If the case has no design, or a variable or a result does not exist.
    Missed
        After everything is written: if a target is not reached, a constraint not kept, or no
        optimum found.
    """
    source = on_first_rank(comm, lambda: read_source(Path(file), settings))
    case, folder = make_case(source), user_folder(out)
    if case.design is None:
        raise CaseError(f"{file}: design: is missing: it says what varies and what is wanted")
    try:
        design_variables = variables(source, case, case.design, make_case)
        goal = design_goal_of(case, case.design)
        with FOLDER.locked(folder, comm, Path(file).name):
            # without `resume` stored evaluations are taken too
            if resume and not access_disk(comm, lambda: any((folder / "points").glob("*.json"))):
                raise CaseError(f"{folder}: has no evaluation to resume")
            with reporting_progress(comm, say) as progress:
                return _designed(
                    Design(design_variables, goal, folder, comm, progress), Path(file), comm
                )
    except CaseError as e:
        raise CaseError(case.with_place(str(e))) from None


def _designed(search: Design, file: Path, comm: MPI.Intracomm) -> dict[str, Any]:
    """Search the best design, write it with tables and pictures, and verify it; collective.

    Parameters
    ----------
    file
        The case file.

    Returns
    -------
    The content of summary.json.

    Raises
    ------
    Missed
        If a target is not reached, a constraint not kept, or a step has no result.
    """
    vary, design_goal, folder = search.variables, search.goal, search.folder
    section = design_goal.section
    first_evaluation, best, x, ended = _optimised(search)
    angle_steps = section.remanence.steps if section.remanence else None
    if angle_steps:  # angles that can be made
        x, best = _rounded(search, x, best, angle_steps)
    access_disk(comm, partial(_write_best, search, x, file))
    content: dict[str, Any] = {
        "case": file.name,
        "objective": section.objective.model_dump(exclude_none=True),
        "start": first_evaluation.values | first_evaluation.seen,
        "best": best.values | best.seen,
        "numbers": vary.numbers(x),
        "ended": ended,
        "without_influence": _without_influence(vary, first_evaluation),
        "evaluations": len(search.rows),
        "note": best.note,
        "violation": design_goal.violation(best),
        "sources": code_version(),
    }
    # result -> its wanted value, if there is one
    wanted = section.objective
    target_values = (
        {wanted.reach: wanted.value} if wanted.reach and wanted.value is not None else {}
    )
    draw_result = partial(
        draw_design, search.rows, design_goal.results, vary, x, folder / "design.png", target_values
    )
    access_disk(comm, draw_result)
    access_disk(comm, lambda: write_object(folder / "summary.json", content))
    # the summary is written before and after the long run of the verification
    content["verified"] = verified(search, best, comm)
    # the picture is drawn again, with the shape that the verified run has reached
    targets: Sequence[Callable[[Array], Array] | None] = [*design_goal.targets.values()] or [None]
    for target in targets:
        access_disk(comm, partial(_draw_reached, draw_result, folder / "verified", target))
    access_disk(comm, lambda: write_object(folder / "summary.json", content))
    if missed := design_goal.missed(best):
        raise Missed(f"{missed}; the best case is {folder / 'best.yaml'}")
    return content


def _rounded(
    search: Design, x: Array, best: DesignEvaluation, angle_steps: int
) -> tuple[Array, DesignEvaluation]:
    """Round the angles of the remanence of the best design, and evaluate it once more; collective.

    Parameters
    ----------
    x, best
        Variables (p,) of the best design, and its evaluation.
    angle_steps
        Number of steps of a full turn, to which angles are rounded.

    Returns
    -------
    x, best
        The rounded variables (p,), and their evaluation.

    Raises
    ------
    Missed
        If the rounded design has no result.
    """
    rounded_x = search.variables.rounded(x, angle_steps)
    rounded_best = search(rounded_x)
    if not rounded_best.values:
        raise Missed(
            f"with angles in {angle_steps} steps of a turn there is no result: {rounded_best.note}"
        )
    search.say(
        f"angles rounded to {angle_steps} steps of a turn: {search.goal.words(best)} -> "
        f"{search.goal.words(rounded_best)}"
    )
    return rounded_x, rounded_best


def _draw_reached(
    draw_result: Callable[[ReachedShape | None], None], folder: Path, target: Target | None
) -> None:
    """Draw the picture with the shape that the run in a folder has reached; called on rank 0.

    Parameters
    ----------
    draw_result
        Draws the picture; None: without a shape.
    target
        Map from undeformed to wanted places; None without.
    """
    draw_result(reached_shape(folder, target))


def _optimised(search: Design) -> tuple[DesignEvaluation, DesignEvaluation, Array, str]:
    """Search the best variables, one stage after another; collective.

    Returns
    -------
    first, best
        The first evaluation and the best one of the last stage.
    x
        Variables of the best evaluation.
    ended
        Message of the optimiser about its end.

    Raises
    ------
    Missed
        If the start has no result, or no variable has an influence.
    """
    vary, goal, iterations = search.variables, search.goal, search.goal.section.iterations
    targets = [*goal.stages, goal.targets]  # one item for each stage
    search.begin(0, targets)
    first, x = search(vary.start_values), vary.start_values
    if not first.values:
        raise Missed(f"the case itself has no result to start from: {first.note}")
    goal.begin(first)
    names_without_influence = _without_influence(vary, first)
    for name in names_without_influence:
        search.say(
            f"warning: {name} has no influence on {', '.join(goal.results)} where the design starts"
        )
    if len(names_without_influence) == len(vary.blocks):
        raise Missed(
            f"no variable has an influence on {', '.join(goal.results)} where the design starts"
        )
    iterations_before_last = -(-iterations // STAGES_PART)  # rounded up
    for stage in range(len(targets)):
        if stage:  # begin from the best of the stage before
            search.begin(stage, targets)
            goal.begin(search(x))
        is_last = stage == len(targets) - 1
        ended = search_optimum(
            search, goal, vary, x, iterations if is_last else iterations_before_last
        )
        assert search.best
        x, best = search.best
    return first, best, x, ended


def _without_influence(vary: Variables, first: DesignEvaluation) -> list[str]:
    """Return the names of the variables that change no result at the start.

    Parameters
    ----------
    first
        The first evaluation; its gradients are for the vector of variables.
    """
    slopes = np.array([first.gradients[result] for result in first.values])
    result_sizes = np.array([abs(value) or 1.0 for value in first.values.values()])
    # (p,) largest relative change of a result by each variable
    largest_changes = (np.abs(slopes) / result_sizes[:, None]).max(axis=0)
    return [
        name
        for name, block in vary.blocks.items()
        if largest_changes[block].max() < INFLUENCE_TOLERANCE
    ]


def _write_best(search: Design, x: Array, file: Path) -> None:
    """Write the best case as best.yaml, which `magshell run` takes, and its remanence as best.csv.

    Parameters
    ----------
    file
        The case file, from whose folder the case names further files.
    """
    folder, data = search.folder, search.variables.data(x, "best.csv")
    search.variables.write(x, folder / "best.csv")
    _from_here(data, file.parent.absolute(), folder.absolute())
    text = f"# The best case of a design: {file.name}\n" + yaml.safe_dump(data, sort_keys=False)
    write_whole(folder / "best.yaml", text.encode())


def _from_here(part: Any, old: Path, new: Path) -> None:
    """Rewrite names of files in plain data of a case, relative to a new folder instead of the old.

    The data are changed in place.
    """
    # the parts of a section or list; a value has none
    if isinstance(part, dict):
        keys_and_values: Iterable[tuple[Any, Any]] = part.items()
    else:
        keys_and_values = enumerate(part if isinstance(part, list) else [])
    for key, value in keys_and_values:
        is_file_name = key == "file" and isinstance(value, str)
        if is_file_name and value != "best.csv":  # which is in the new folder already
            part[key] = os.path.relpath(old / value, new)
        _from_here(value, old, new)


def verified(search: Design, best: DesignEvaluation, comm: MPI.Intracomm) -> dict[str, Any]:
    """Run best.yaml on a finer mesh into verified/, and compare the results; collective.

    Parameters
    ----------
    best
        The evaluation of the best design.

    Returns
    -------
    The results of the run, its settings and its excluded modes, as in summary.json.
    """
    goal, say, file, settings = search.goal, search.say, search.folder / "best.yaml", list[str]()

    def best_case() -> Case:
        """Read best.yaml with the present settings."""
        return search.variables.make_case(on_first_rank(comm, lambda: read_source(file, settings)))

    case = best_case()
    # the mesh of a file cannot be refined
    if case.several or case.shell.geometry != "mesh":
        settings = [f"mesh.refinement={case.mesh.refinement * goal.section.verify:.6g}"]
        case = best_case()
    how = ", ".join(settings) or "on the mesh of the file"
    # overwrite: the folder is the design's own
    result = run(case.problem(), search.folder / "verified", comm, overwrite=True)
    values = {name: _value(result, name) for name in goal.results if name not in goal.targets}
    # a shape: root mean square and largest distance from the wanted places
    extra_results = dict[str, float]()
    for target in goal.targets.values():
        extra_results["rms_distance"], extra_results[DISTANCE] = distances(
            result.scene, result.last, target
        )
    for name, value in (values | extra_results).items():
        designed = best.values.get(name, best.seen.get(name))
        if value is None:
            say(f"verified ({how}): no {name}{f': {result.stopped}' if result.stopped else ''}")
        elif designed is not None:
            _say_difference(say, how, name, value, designed)
    # instabilities of modes that the reduced model of the design does not have
    modes = [f"{p['kind']} {p['mode']}".strip() for p in result.limit_points if p["mode"]]
    if modes and not any(name in FOLDS for name in goal.results):
        say(f"warning: the run sees modes that the design did not: {', '.join(modes)}")
    # number of unstable ones among them at the end
    excluded = int(result.rows[-1]["excluded_pivots"]) if result.rows else 0
    return {
        "settings": settings,
        **values,
        **extra_results,
        "excluded_modes": modes,
        "excluded_pivots": excluded,
    }


def _say_difference(say: Say, how: str, name: str, value: float, designed: float) -> None:
    """Say a verified result beside that of the design, with a warning if it is another one.

    Parameters
    ----------
    how
        Settings of the verified run, in words.
    value, designed
        The result of that run, and of the design.
    """
    relative_difference = value / designed - 1
    say(
        f"verified ({how}): {name} = {value:.9g}, {_difference_words(relative_difference)} "
        f"the design's {designed:.9g}"
    )
    if abs(relative_difference) > OTHER_RESULT_DIFFERENCE:  # no matter of the mesh's error
        say(
            f"warning: {name} is another one there: the mesh is too coarse, or there are "
            "several equilibria"
        )


def _value(result: Result, name: str) -> float | None:
    """Return a result of a run; None if the run lacks it.

    For a critical load it is the first instability of this load on the path, excluded modes too,
    in the result's unit.
    """
    if name == MASS:
        return mass(result.scene).value
    if name in FOLDS:
        points = (
            p for p in result.limit_points if p["amplitude"] == FOLDS[name] and not p["branch"]
        )
        size = result.scene.sizes.by_unit[SCALES[name]] if name in SCALES else 1.0
        return next((size * float(p["value"]) for p in points), None)
    if name == BARRIER:
        return result.barrier
    if not result.rows:
        return None
    row = result.rows[-1]
    try:
        # a frequency; None if the name is none
        omega2 = vibration_at_end(result.scene, result.path_history, name)
    except LostResult:
        return None
    if omega2 is not None:
        return omega2
    # a column of the last point, without unit or in units
    return float((row | result.scene.sizes.values(row))[name])


def _difference_words(relative_difference: float) -> str:
    """Return a relative difference in words.

    Examples
    --------
    >>> _difference_words(-3.19e-8), _difference_words(1.62e-2), _difference_words(-8.9e-15)
    ('3.2e-06 % below', '1.6 % above', 'equal to')
    """
    if abs(relative_difference) < ROUNDING:
        return "equal to"
    return (
        f"{100 * abs(relative_difference):.2g} % {'above' if relative_difference > 0 else 'below'}"
    )

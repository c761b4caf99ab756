"""The results of a design's case and their gradients by its variables.

A path is a sequence of equilibria, its records, up to where a result is taken; it is lost where no
further point is found. Gradients are by the adjoint method: an `Adjoint` is a result with the
multipliers by which it is differentiated by any number or field of the case, by name. The design's
p variables stand for such numbers and fields. A critical load (`FOLDS`: result -> load) is the
lowest of several instabilities, which may cross; a frequency likewise. A target is a map from
undeformed to wanted places. A scene is the model of a case with its solver.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.field_gradient import FieldGradient
from magshell_fenicsx.continuation.fold import FoldLost
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.simulate.adapt.ending import History
from magshell_fenicsx.simulate.discretisation_error import FineScenes, estimate_errors
from magshell_fenicsx.simulate.follow import BEYOND_INSTABILITY, follow_alone
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint, Begins
from magshell_fenicsx.simulate.gradients.fields import MASS, mass
from magshell_fenicsx.simulate.gradients.gradient import derivative
from magshell_fenicsx.simulate.gradients.instabilities import (
    FOLDS,
    MAX_INSTABILITIES,
    MAX_LOAD_RATIO,
    LostResult,
    instabilities,
    load,
    located,
    refuse_moving,
)
from magshell_fenicsx.simulate.gradients.results import adjoint_at_end, refuse_no_result
from magshell_fenicsx.simulate.gradients.vibration import FIRST_FREQUENCIES, adjoints_of_vibrations
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.results import Target, distances
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.scene_cache import SceneCache
from magshell_fenicsx.studies.design.variables import Variables
from magshell_fenicsx.studies.points import Case

Array = NDArray[np.float64]

DISTANCE = "largest_distance"
WITH_MASS = ("thickness", "deviation")  # fields that the mass depends on
LOWEST = (*FOLDS, *FIRST_FREQUENCIES)  # results that others of their kind may cross


@dataclass(frozen=True)
class DesignEvaluation:
    """The results of one vector of design variables.

    Attributes
    ----------
    values, gradients
        Result -> its value and its gradient (p,); empty if the path was lost.
    beside
        Result -> values and gradients of the instabilities or frequencies next above the lowest
        one, which is the result.
    errors
        Result -> its estimated error by the mesh, where that is known.
    seen
        Further numbers: the largest distance to a wanted shape.
    note
        Why there are no values, or which instabilities there are.
    """

    values: dict[str, float] = field(default_factory=dict)
    gradients: dict[str, list[float]] = field(default_factory=dict)
    beside: dict[str, list[tuple[float, list[float]]]] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)
    seen: dict[str, float] = field(default_factory=dict)
    note: str = ""


def evaluate(
    case: Case,
    x: Array,
    variables: Variables,
    results: Sequence[str],
    targets: Mapping[str, Target],
    scenes: SceneCache,
) -> DesignEvaluation:
    """Follow the path of a case, and differentiate its results; collective.

    Parameters
    ----------
    x
        Design variables (p,) of the case.
    results
        Names of the results; a key of `targets` is the mean square distance from that shape.
    targets
        Name of a shape -> map from undeformed to wanted places.
    scenes
        Keeps the scene, a model with its solver, for the next case.

    Returns
    -------
    Values and gradients; a note without values if the case cannot be meshed or has no such result.
    """
    try:
        scene = scenes.scene_for(case.problem(variables.smooth))
        _refuse_missing_results(scene, variables, results, targets)
        path = _follow_until_enough(scene, results)
    except MeshError as e:
        return DesignEvaluation(note=f"no shell: {e}")
    evaluation = DesignEvaluation()
    notes = [f"the path is lost: {path.lost_reason}"] if path.lost_reason else []

    def slope(gradients: Mapping[str, float | FieldGradient]) -> list[float]:
        """Return the gradient (p,) by the variables from those by names of numbers and fields."""
        return [float(v) for v in variables.gradient(x, scene, gradients)]

    try:
        for result in results:
            if result == MASS:
                _add_mass(evaluation, scene, variables, slope)
                continue
            # only a critical load may lie before the place where the path is lost
            if path.lost_reason and result not in FOLDS:
                return DesignEvaluation(note=notes[0])
            # pairs of the mode and its adjoint, of several modes the lowest first
            adjoints, note = _adjoints(scene, path, result, targets)
            notes += [note] if note else []
            # value and gradient (p,) of each mode
            values = [
                _value_and_gradient(adjoint_of_mode, variables, slope)
                for _, adjoint_of_mode in adjoints
            ]
            # the lowest is first, and all others stand beside it
            evaluation.values[result], evaluation.gradients[result] = values[0]
            if result in LOWEST:
                evaluation.beside[result] = values[1:]
    except (LostResult, FoldLost) as e:
        return DesignEvaluation(note="; ".join([f"no {result}: {e}", *notes]))
    for target in targets.values():
        _, largest_distance = distances(scene, path.records[-1].point.state, target)
        evaluation.seen[DISTANCE] = largest_distance
    evaluation.errors.update(_estimated_errors(scene, path, evaluation.values))
    return replace(evaluation, note="; ".join(notes))


def _estimated_errors(
    scene: Scene, path: "_ComputedPath", results: Iterable[str]
) -> dict[str, float]:
    """Return the estimated errors of results by the mesh, of those that have one; collective."""
    has_stopped = bool(path.lost_reason)
    estimates = estimate_errors(scene, path.history, FineScenes(), has_stopped=has_stopped)
    # a critical load has an error of its name, a column of path.csv one at the end
    at_end = {result: estimates.errors.get(f"{result}@end") for result in results}
    errors = {result: estimates.errors.get(result, error) for result, error in at_end.items()}
    return {result: error for result, error in errors.items() if error is not None}


# converts gradients by names of numbers and fields to the gradient (p,) by the variables
Slope = Callable[[Mapping[str, float | FieldGradient]], list[float]]


def _value_and_gradient(
    adjoint: Adjoint, variables: Variables, slope: Slope
) -> tuple[float, list[float]]:
    """Return a result in its unit, and its gradient (p,) by the variables; collective."""
    value = adjoint.value_in_unit
    derivatives = {name: derivative(adjoint, name) for name in variables.names}
    return value, slope(derivatives)


@dataclass
class _ComputedPath:
    """The records of a path as far as results need them.

    Attributes
    ----------
    records
        Points of the path with their origin.
    history
        The same records, with those at which steps begin.
    lost_reason
        Why the path was lost; "" if it was not.
    """

    records: list[Record] = field(default_factory=list)
    history: History = field(default_factory=History)
    lost_reason: str = ""


def _refuse_missing_results(
    scene: Scene, variables: Variables, results: Sequence[str], targets: Mapping[str, Target]
) -> None:
    """Check that the case has all results with gradients.

    Raises
    ------
    CaseError
        With the key of a result that the case does not have.
    """
    named_sections = variables.case.design.named_results
    for result in results:
        if result != MASS and result not in targets:
            refuse_no_result(scene, [result], named_sections[result], extra_results=[MASS])


def _follow_until_enough(scene: Scene, results: Sequence[str]) -> _ComputedPath:
    """Follow the path of a scene as far as the results need it; collective.

    A path that is lost keeps its records, and the reason.
    """
    path, remarks = _ComputedPath(), list[str]()
    try:
        for record in follow_alone(scene, remark=remarks.append):
            path.records.append(record)
            path.history.add(record)
            if _enough(path.records, results):
                break
    except Stopped as e:
        path.lost_reason = str(e)
    # a path that ends beyond an instability has no result at its end either
    remarks_on_end = (text for text in remarks if text.startswith(BEYOND_INSTABILITY))
    path.lost_reason = path.lost_reason or next(remarks_on_end, "")
    return path


def _add_mass(
    evaluation: DesignEvaluation, scene: Scene, variables: Variables, slope: Slope
) -> None:
    """Add the mass of the shell, with its gradient, to an evaluation.

    Parameters
    ----------
    slope
        Converts derivatives by names of numbers and fields to the gradient (p,) by the variables.
    """
    functional = mass(scene)
    # fields and numbers of the shell alone change its mass; one of thickness h has no forms, and
    # no derivatives
    keys = [name for name in variables.names if name in WITH_MASS or "shell." in name]
    derivatives = {name: derivative(functional, name) for name in keys if functional.forms}
    evaluation.values[MASS], evaluation.gradients[MASS] = functional.value, slope(derivatives)


def _adjoints(
    scene: Scene, path: _ComputedPath, result: str, targets: Mapping[str, Target]
) -> tuple[list[tuple[str, Adjoint]], str]:
    """Return the adjoints of a result, by which it is differentiated.

    Returns
    -------
    adjoints
        Kind of the mode and its adjoint; of `LOWEST` results several, the lowest first.
    note
        Text about the modes; "" without.
    """
    if result in LOWEST:
        adjoints = _lowest(scene, path.records, result, path.history.begins)
        modes = (
            f"{mode or 'mode'} at {adjoint_of_mode.value_in_unit:.6g}"
            for mode, adjoint_of_mode in adjoints
        )
        return adjoints, f"lowest: {', '.join(modes)}"
    target = targets.get(result, result)  # the map of a wanted shape, else a name
    refuse_moving(scene, path.records[-1], target)
    kind, adjoint = adjoint_at_end(scene, path.history, target)
    return [(kind, adjoint)], f"{result}: {kind}" if kind else ""


def _lowest(
    scene: Scene, records: Sequence[Record], result: str, begins: Begins
) -> list[tuple[str, Adjoint]]:
    """Return the lowest instabilities or vibrations of a result: name of the mode, and its adjoint.

    Parameters
    ----------
    begins
        Number of a step -> the last record before it.
    """
    if result in FOLDS:
        return instabilities(scene, records, result, begins=begins)
    return adjoints_of_vibrations(
        scene,
        records[-1],
        result,
        max_ratio=MAX_LOAD_RATIO,
        max_count=MAX_INSTABILITIES,
        begins=begins,
    )


def _enough(records: Sequence[Record], results: Sequence[str]) -> bool:
    """Return whether the path is known as far as the results need it.

    Folds of one load need the path up to `MAX_LOAD_RATIO` times the lowest instability. All other
    results need the whole path.
    """
    # loads of the results; None for one that is no critical load, and needs the whole path
    amplitudes = {FOLDS.get(result) for result in results if result != MASS}
    if None in amplitudes or len(amplitudes) > 1:
        return False
    (name,) = amplitudes
    assert name
    # the load at the lowest instability so far
    lowest = min((load(r, name) for r in located(records, name)), default=np.inf)
    return records[-1].amplitude == name and load(records[-1], name) > MAX_LOAD_RATIO * lowest

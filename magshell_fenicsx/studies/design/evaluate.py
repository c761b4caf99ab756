"""The results of a design's case and their gradients by its variables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.fold import FoldLost
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.gradient import Adjoint, adjoint, adjoint_of_fold, derivative
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.results import Target, distances
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.sensitivity import fold_at
from magshell_fenicsx.studies.design.variables import Variables

Array = NDArray[np.float64]
FOLDS = {"knockdown": "pressure", "critical_field": "lambda_m"}  # result -> the amplitude of its fold
DISTANCE = "largest_distance"


@dataclass(frozen=True)
class Evaluation:
    """The results of one vector of variables.

    Attributes
    ----------
    values, gradients
        By result; empty if the path was lost.
    seen
        Further numbers: the largest distance to a wanted shape.
    note
        Why there are no values, or what else was seen.
    """

    values: dict[str, float] = field(default_factory=dict)
    gradients: dict[str, list[float]] = field(default_factory=dict)
    seen: dict[str, float] = field(default_factory=dict)
    note: str = ""


class Lost(RuntimeError):
    """The path of a case has no such result."""


def evaluate(
    case: Case, x: Array, variables: Variables, results: Sequence[str], targets: Mapping[str, Target], comm: MPI.Comm
) -> Evaluation:
    """Follow the path of a case, and differentiate its results; collective."""
    try:
        scene = Scene(case, comm)
        records = list(follow(scene, search=False))
    except (Stopped, MeshError) as e:
        return Evaluation(note=f"the path is lost: {e}")
    by = [*variables.keys, *(["remanence"] if variables.controls is not None else [])]
    values, gradients, seen = dict[str, float](), dict[str, list[float]](), dict[str, float]()
    try:
        for result in results:
            value, found = result_of(scene, records, result, targets)
            values[result] = value
            gradients[result] = variables.gradient(x, scene, {name: derivative(found, name) for name in by}).tolist()
    except (Lost, FoldLost) as e:
        return Evaluation(note=f"no {result}: {e}")
    for target in targets.values():
        seen[DISTANCE] = distances(scene, records[-1].point.state, target)[1]
    return Evaluation(values, gradients, seen, _before(records, results))


def result_of(
    scene: Scene, records: Sequence[Record], result: str, targets: Mapping[str, Target]
) -> tuple[float, Adjoint]:
    """A result of a path, and what its derivatives are contracted with.

    Raises
    ------
    Lost, FoldLost
        If the path has no such result.
    """
    if result not in FOLDS:
        found = adjoint(scene, records[-1], targets.get(result, result))
        assert found.explicit
        return found.explicit.value, found
    amplitude = FOLDS[result]
    located = [r for r in records if r.amplitude == amplitude and not r.mode and not r.branch and r.label == "fold"]
    if not located:
        others = {f"{r.label} {r.mode}".strip() for r in records if r.label in ("fold", "bifurcation")}
        raise Lost(f"the path has no fold of {amplitude}" + (f", but {', '.join(sorted(others))}" if others else ""))
    fold = fold_at(scene, located[0])
    return fold.value, adjoint_of_fold(scene, located[0], fold)


def _before(records: Sequence[Record], results: Sequence[str]) -> str:
    """Instabilities that come before the fold, which the gradient does not see."""
    seen = dict[str, float]()
    for r in records:
        if r.label in ("fold", "bifurcation") and r.mode and r.amplitude in [FOLDS.get(result) for result in results]:
            seen.setdefault(r.mode, r.point.state.mu[r.amplitude])
    return "; ".join(f"before it {mode} at {value:.6g}" for mode, value in seen.items())

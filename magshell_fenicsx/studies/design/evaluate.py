"""The results of a design's case and their gradients by its variables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.fold import FoldLost
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.gradients.adjoint import adjoint
from magshell_fenicsx.simulate.gradients.gradient import derivative
from magshell_fenicsx.simulate.gradients.instabilities import BESIDE, FOLDS, Lost, instabilities, load, located
from magshell_fenicsx.simulate.gradients.mass import MASS, mass
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.results import Target, distances
from magshell_fenicsx.simulate.standing import Standing
from magshell_fenicsx.studies.design.variables import Variables

Array = NDArray[np.float64]
DISTANCE = "largest_distance"


@dataclass(frozen=True)
class Evaluation:
    """The results of one vector of variables.

    Attributes
    ----------
    values, gradients
        By result; empty if the path was lost.
    beside
        Result -> values and gradients of the instabilities next to the lowest one, which is the result.
    seen
        Further numbers: the largest distance to a wanted shape.
    note
        Why there are no values, or which instabilities there are.
    """

    values: dict[str, float] = field(default_factory=dict)
    gradients: dict[str, list[float]] = field(default_factory=dict)
    beside: dict[str, list[tuple[float, list[float]]]] = field(default_factory=dict)
    seen: dict[str, float] = field(default_factory=dict)
    note: str = ""


def evaluate(
    case: Case,
    x: Array,
    variables: Variables,
    results: Sequence[str],
    targets: Mapping[str, Target],
    comm: MPI.Comm,
    known: Standing,
) -> Evaluation:
    """Follow the path of a case, and differentiate its results; collective. `known` is of the case before."""
    lost = ""
    records = list[Record]()
    try:
        scene = known.of(case, comm)
        for record in follow(scene, search=False):
            records.append(record)
            if _enough(records, results):
                break
    except MeshError as e:
        return Evaluation(note=f"no shell: {e}")
    except Stopped as e:
        lost = str(e)
    made, notes = Evaluation(), [f"the path is lost: {lost}"] if lost else []
    try:
        for result in results:
            if result == MASS:
                made.values[result], by_thickness = mass(scene)
                slope = variables.gradient(x, scene, {"thickness": by_thickness} if by_thickness else {})
                made.gradients[result] = [float(v) for v in slope]
                continue
            if result in FOLDS:
                found = instabilities(scene, records, FOLDS[result])
                notes.append("lowest: " + ", ".join(f"{name} at {each.value:.6g}" for name, each in found))
            elif lost:
                return Evaluation(note=notes[0])
            else:
                found = [("", adjoint(scene, records[-1], targets.get(result, result)))]
            slopes = [
                variables.gradient(x, scene, {name: derivative(each, name) for name in variables.names})
                for _, each in found
            ]
            (made.values[result], made.gradients[result]), *others = [
                (each.value, [float(v) for v in slope]) for (_, each), slope in zip(found, slopes, strict=True)
            ]
            if result in FOLDS:
                made.beside[result] = others
    except (Lost, FoldLost) as e:
        return Evaluation(note="; ".join([f"no {result}: {e}", *notes]))
    for target in targets.values():
        made.seen[DISTANCE] = distances(scene, records[-1].point.state, target)[1]
    return replace(made, note="; ".join(notes))


def _enough(records: Sequence[Record], results: Sequence[str]) -> bool:
    """Whether the path is known as far as the results need it."""
    amplitudes = {FOLDS.get(result) for result in results if result != MASS}
    if None in amplitudes or len(amplitudes) > 1:
        return False
    (name,) = amplitudes
    assert name
    lowest = min((load(r, name) for r in located(records, name)), default=np.inf)
    return records[-1].amplitude == name and load(records[-1], name) > BESIDE * lowest

"""The results of a design's case and their gradients by its variables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.field_gradient import FieldGradient
from magshell_fenicsx.continuation.fold import FoldLost
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.simulate.adapt.ending import History
from magshell_fenicsx.simulate.follow import BEYOND, follow_alone
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint, Begins
from magshell_fenicsx.simulate.gradients.fields import MASS, mass
from magshell_fenicsx.simulate.gradients.gradient import derivative
from magshell_fenicsx.simulate.gradients.instabilities import (
    BESIDE,
    FOLDS,
    MOST,
    Lost,
    instabilities,
    load,
    located,
    refuse_moving,
)
from magshell_fenicsx.simulate.gradients.results import adjoint_at_end, refuse_no_result
from magshell_fenicsx.simulate.gradients.vibration import FIRST, adjoints_of_vibrations
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.results import Target, distances
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.standing import Standing
from magshell_fenicsx.studies.design_variables import Variables
from magshell_fenicsx.studies.runner import Case

Array = NDArray[np.float64]

DISTANCE = "largest_distance"
WITH_MASS = ("thickness", "deviation")  # fields that the mass depends on
LOWEST = (*FOLDS, *FIRST)  # results that others of their kind may cross


@dataclass(frozen=True)
class Evaluation:
    """The results of one vector of variables.

    Attributes
    ----------
    values, gradients
        By result; empty if the path was lost.
    beside
        Result -> values and gradients of the instabilities next to the lowest one, which is the
        result.
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
    standing: Standing,
) -> Evaluation:
    """Follow the path of a case, and differentiate its results; collective.

    `known` is of the case before.
    """
    lost, named = "", variables.case.design.named
    records, history, remarks = list[Record](), History(), list[str]()
    try:
        scene = standing.of(case.problem(variables.smooth), comm)
        for result in results:
            if result != MASS and result not in targets:
                refuse_no_result(scene, [result], named[result], more=[MASS])
        for record in follow_alone(scene, remark=remarks.append):
            records.append(record)
            history.add(record)
            if _enough(records, results):
                break
    except MeshError as e:
        return Evaluation(note=f"no shell: {e}")
    except Stopped as e:
        lost = str(e)
    lost = lost or next((text for text in remarks if text.startswith(BEYOND)), "")
    made, notes = Evaluation(), [f"the path is lost: {lost}"] if lost else []

    def slope(by: Mapping[str, float | FieldGradient]) -> list[float]:
        return [float(v) for v in variables.gradient(x, scene, by)]

    try:
        for result in results:
            if result == MASS:
                of_mass = mass(scene)
                by = [name for name in variables.names if name in WITH_MASS or "shell." in name]
                made.values[result] = of_mass.value
                made.gradients[result] = slope(
                    {name: derivative(of_mass, name) for name in by if of_mass.forms}
                )
                continue
            if lost and result not in FOLDS:
                return Evaluation(note=notes[0])
            if result in LOWEST:
                adjoints = _lowest(scene, records, result, history.begins)
                notes.append(
                    "lowest: "
                    + ", ".join(f"{mode or 'mode'} at {each.shown:.6g}" for mode, each in adjoints)
                )
            else:
                refuse_moving(scene, records[-1], targets.get(result, result))
                adjoints = [adjoint_at_end(scene, history, targets.get(result, result))]
                notes += [f"{result}: {kind}" for kind, _ in adjoints if kind]
            (made.values[result], made.gradients[result]), *others = [
                (each.shown, slope({name: derivative(each, name) for name in variables.names}))
                for _, each in adjoints
            ]
            if result in LOWEST:
                made.beside[result] = others
    except (Lost, FoldLost) as e:
        return Evaluation(note="; ".join([f"no {result}: {e}", *notes]))
    for target in targets.values():
        made.seen[DISTANCE] = distances(scene, records[-1].point.state, target)[1]
    return replace(made, note="; ".join(notes))


def _lowest(
    scene: Scene, records: Sequence[Record], result: str, begins: Begins
) -> list[tuple[str, Adjoint]]:
    """The lowest instabilities or vibrations, and what their derivatives are contracted with."""
    if result in FOLDS:
        return instabilities(scene, records, result, begins=begins)
    return adjoints_of_vibrations(
        scene, records[-1], result, beside=BESIDE, most=MOST, begins=begins
    )


def _enough(records: Sequence[Record], results: Sequence[str]) -> bool:
    """Whether the path is known as far as the results need it."""
    amplitudes = {FOLDS.get(result) for result in results if result != MASS}
    if None in amplitudes or len(amplitudes) > 1:
        return False
    (name,) = amplitudes
    assert name
    lowest = min((load(r, name) for r in located(records, name)), default=np.inf)
    return records[-1].amplitude == name and load(records[-1], name) > BESIDE * lowest

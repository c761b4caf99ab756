"""The results of a design's case and their gradients by its variables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.continuation.fold import FoldLost
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.gradient import Adjoint, adjoint, adjoint_of_instability, derivative
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.results import Target, distances
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.studies.design.variables import Variables

Array = NDArray[np.float64]
FOLDS = {"knockdown": "pressure", "critical_field": "lambda_m"}  # result -> the amplitude of its fold
DISTANCE = "largest_distance"
BESIDE = 1.15  # instabilities up to this multiple of the lowest are looked at
MOST = 5  # and at most so many


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


class Lost(RuntimeError):
    """The path of a case has no such result."""


def evaluate(
    case: Case, x: Array, variables: Variables, results: Sequence[str], targets: Mapping[str, Target], comm: MPI.Comm
) -> Evaluation:
    """Follow the path of a case, and differentiate its results; collective."""
    lost = ""
    records = list[Record]()
    try:
        scene = Scene(case, comm)
        for record in follow(scene, search=False):
            records.append(record)
            if _enough(records, results):
                break
    except MeshError as e:
        return Evaluation(note=f"no shell: {e}")
    except Stopped as e:
        lost = str(e)
    by = [*variables.keys, *(["remanence"] if variables.controls is not None else [])]
    made, notes = Evaluation(), [f"the path is lost: {lost}"] if lost else []
    try:
        for result in results:
            if result in FOLDS:
                found = instabilities(scene, records, FOLDS[result])
                notes.append("lowest: " + ", ".join(f"{name} at {each.value:.6g}" for name, each in found))
            elif lost:
                return Evaluation(note=notes[0])
            else:
                found = [("", adjoint(scene, records[-1], targets.get(result, result)))]
            slopes = [variables.gradient(x, scene, {name: derivative(each, name) for name in by}) for _, each in found]
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
    amplitudes = {FOLDS.get(result) for result in results}
    if None in amplitudes or len(amplitudes) > 1:
        return False
    (name,) = amplitudes
    assert name
    lowest = min((_load(r, name) for r in _located(records, name)), default=np.inf)
    return records[-1].amplitude == name and _load(records[-1], name) > BESIDE * lowest


def _located(records: Sequence[Record], amplitude: str) -> list[Record]:
    there = [r for r in records if r.amplitude == amplitude and not r.branch]
    return [r for r in there if r.label == "fold" or (r.label == "bifurcation" and not r.point.negative_pivots)]


def _load(record: Record, amplitude: str) -> float:
    return abs(record.point.state.mu[amplitude])


def instabilities(scene: Scene, records: Sequence[Record], amplitude: str) -> list[tuple[str, Adjoint]]:
    """The instabilities of a path by name, the lowest first, and what their derivatives are contracted with.

    Raises
    ------
    Lost, FoldLost
        If there is none, or the lowest one has no gradient.
    """
    located = sorted(_located(records, amplitude), key=lambda r: _load(r, amplitude))
    found = list[tuple[str, Adjoint]]()
    for record in [r for r in located if _load(r, amplitude) <= BESIDE * _load(located[0], amplitude)][:MOST]:
        name = record.mode or record.label
        try:
            found.append((name, adjoint_of_instability(scene, record)))
        except CaseError as e:
            if not found:
                raise Lost(str(e)) from None
    if not found:
        raise Lost(f"the path has no instability in {amplitude}")
    return sorted(found, key=lambda each: abs(each[1].value))

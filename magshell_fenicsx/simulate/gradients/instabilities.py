"""The lowest instabilities of a path as results that have gradients.

In: the records of a path. Out: adjoints, from which derivatives by any parameter follow. The result
is the load at a fold, or at a bifurcation into waves around a meridian. An amplitude is a load
parameter by name, as "pressure". A path may go over to a branch at a bifurcation; the records of
this branch do not count.
"""

from collections.abc import Sequence
from dataclasses import replace

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.quantities import registry as quantities
from magshell_fenicsx.simulate.gradients.adjoint import (
    NO_BEGINS,
    Adjoint,
    Begins,
    adjoint_of_instability,
)
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import Target, in_units
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.steps import leaves_path

_LOADS = [a for a in quantities.AMPLITUDES.values() if a.critical_names]
# result -> the amplitude of its fold; and of those in units -> key of the unit
FOLDS = {name: load.name for load in _LOADS for name in load.critical_names}
SCALES = {load.critical_names[1]: quantities.quantity(load.column).scale for load in _LOADS}
MAX_LOAD_RATIO = 1.15  # instabilities up to this multiple of the lowest are looked at
MAX_INSTABILITIES = 5  # and at most so many


class LostResult(RuntimeError):
    """The path of a case has no such result; the message has the reason."""


def located(records: Sequence[Record], amplitude: str) -> list[Record]:
    """Return the records at which the path loses its stability as an amplitude grows.

    Such a record is a fold, or a bifurcation before which no direction is unstable; records of
    branches do not count.
    """
    records_in_amplitude = [
        record for record in records if record.amplitude == amplitude and not record.branch
    ]
    return [record for record in records_in_amplitude if _loses_stability(record)]


def _loses_stability(record: Record) -> bool:
    """Return whether a record is a fold, or a bifurcation of what was stable before."""
    if record.label == "bifurcation":
        return not record.point.negative_pivots
    return record.label == "fold"


def on_path(scene: Scene, records: Sequence[Record]) -> list[Record]:
    """Return the records up to the first bifurcation at which a step leaves the path."""
    before_branch, steps = list[Record](), scene.problem.programme
    for record in records:
        before_branch.append(record)
        is_bifurcation_in_step = record.label == "bifurcation" and record.step
        if is_bifurcation_in_step and leaves_path(steps[record.step - 1]):
            break
    return before_branch


def load(record: Record, amplitude: str) -> float:
    """Return the absolute value of an amplitude at a record."""
    return abs(record.point.state.mu[amplitude])


def refuse_unitless(scene: Scene, result: str) -> None:
    """Check that a case has the unit of a result of `FOLDS`.

    Raises
    ------
    CaseError
        If the result has a unit, and the case does not have this unit.
    """
    sizes = scene.sizes
    if result not in SCALES:
        return
    # a field in T is no result in mT
    has_other_unit = result.endswith("_mT") and sizes.field != "mT"
    if SCALES[result] not in sizes.by_unit or has_other_unit:
        name_without_unit = next(
            name for name, amplitude in FOLDS.items() if amplitude == FOLDS[result]
        )
        raise CaseError(f"{result}: the case has no such unit; {name_without_unit} has none")


def refuse_moving(scene: Scene, end: Record, result: str | Target) -> None:
    """Check that a result is not read at a point that moves along the path when parameters vary.

    Parameters
    ----------
    end
        Last record of the path.

    Raises
    ------
    LostResult
        If the path ends at an instability, and the result is not its amplitude.
    """
    column = ""  # a target shape has none
    if isinstance(result, str):
        column, _ = in_units(scene, end.point.state, result)  # the one without unit
    # the amplitude itself is a result that has a gradient there
    is_load = end.amplitude in FOLDS.values() and column in (
        end.amplitude,
        quantities.amplitude(end.amplitude).column,
    )
    if end.label in ("fold", "bifurcation") and not is_load:
        allowed = (
            ", ".join(name for name, amplitude in FOLDS.items() if amplitude == end.amplitude)
            or "none"
        )
        raise LostResult(
            f"the path ends at a {end.label}, which moves with what varies: only its load has a "
            f"gradient ({allowed})"
        )


def as_asked(adjoint: Adjoint, result: object) -> Adjoint:
    """Return an adjoint whose result has the unit of the requested name.

    Raises
    ------
    CaseError
        If the case does not have this unit.
    """
    if result not in SCALES:
        return adjoint
    refuse_unitless(adjoint.scene, str(result))
    return replace(adjoint, scale=SCALES[str(result)])


def instabilities(
    scene: Scene,
    records: Sequence[Record],
    result: str,
    max_count: int = MAX_INSTABILITIES,
    begins: Begins = NO_BEGINS,
) -> list[tuple[str, Adjoint]]:
    """Return the lowest instabilities of a path by name, with their adjoints; collective.

    The lowest comes first.

    Parameters
    ----------
    records
        Records of the path in order.
    result
        One of `FOLDS`.
    max_count
        Largest number of instabilities.
    begins
        Number of a step -> the last record before it, where steps hold conjugates.

    Returns
    -------
    list of (name, adjoint)
        Mode or label of the record, and the adjoint of its amplitude. Those above `MAX_LOAD_RATIO`
        times the lowest amplitude, and those without a gradient, are left out.

    Raises
    ------
    LostResult, FoldLost
        If there is no instability, or the lowest one has no gradient.
    """
    amplitude = FOLDS[result]
    ascending = sorted(
        located(on_path(scene, records), amplitude), key=lambda r: load(r, amplitude)
    )
    near_lowest = [
        r for r in ascending if load(r, amplitude) <= MAX_LOAD_RATIO * load(ascending[0], amplitude)
    ]
    by_name = list[tuple[str, Adjoint]]()
    for record in near_lowest[:max_count]:
        name = record.mode or record.label
        try:
            adjoint = adjoint_of_instability(scene, record, begins=begins)
            by_name.append((name, as_asked(adjoint, result)))
        except CaseError as e:  # a higher one without a gradient is left out
            if not by_name:
                raise LostResult(str(e)) from None
    if not by_name:
        raise LostResult(f"the path has no instability in {amplitude}")
    # sorted again: an adjoint has the exact amplitude, a record that of a point near by
    return sorted(by_name, key=lambda name_and_adjoint: abs(name_and_adjoint[1].value))

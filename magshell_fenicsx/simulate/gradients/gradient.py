"""Gradients of a result with respect to amplitudes, numbers of the case, and fields."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

from magshell_fenicsx.assembly.forms import FieldGradient
from magshell_fenicsx.continuation.fold import Fold
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.simulate.adapt.ending import History
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint, adjoint_of_instability
from magshell_fenicsx.simulate.gradients.fields import FIELDS, by_field
from magshell_fenicsx.simulate.gradients.instabilities import FOLDS, as_asked
from magshell_fenicsx.simulate.gradients.results import adjoint_at_end
from magshell_fenicsx.simulate.gradients.single import by_amplitude, by_number, size_by_number
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import Target
from magshell_fenicsx.simulate.scene import Scene

Gradient: TypeAlias = float | FieldGradient


def gradient(
    scene: Scene,
    record: Record,
    *,
    of: str | Target,
    by: str | Sequence[str],
    fold: Fold | None = None,
    hold: Mapping[str, str] | None = None,
    begin: Record | None = None,
) -> dict[str, Gradient]:
    """The derivatives of a result at a record; collective.

    Parameters
    ----------
    of
        "instability": the amplitude of a record that is a fold or, on a meridian, a neutral wave ("knockdown" and
        "critical_field" are names of it, also "buckling_pressure_Pa" and "critical_field_mT"); a column of path.csv
        (named points, w_over_h, reactions, volume_change, the load where it is not held, energy; those with units too);
        "omega2_1", "omega2_2", ...: the squared natural frequencies, ascending, and "hertz_1", ...; "barrier": the
        energy barrier of a last step with until: zero; or a function from undeformed places (n, 3) over R to wanted
        ones: the mean square distance to them.
    by
        One of these, or several: amplitudes ("lambda_m", ...), keys of the case with a number
        ("magnetic.remanent.polar"), and fields:
        "remanence" (vectors over |B^r|, of a meridian along e_rho, e_theta, e_z), "magnitude" (a factor of it),
        "thickness" (over h), "curvature" (the natural one over 1/R in the case's frame: 11, 22, 12) and "deviation"
        (w0 over R, along the outward normal of the perfect shell).
    fold
        Of `fold_at`, if it is known.
    hold
        Amplitude -> "load" or "conjugate": what stays while p changes. By default what the record's step holds, and
        the displacement where that is its control.
    begin
        Of a barrier, and of a step that holds conjugates: the last record before the step.

    Returns
    -------
    Numbers, and `FieldGradient` of fields.

    Raises
    ------
    CaseError
        If the scene has no such result or parameter.
    FoldLost
        If Newton's method for the fold fails.
    """
    if isinstance(of, str) and of in FOLDS and record.amplitude != FOLDS[of]:
        raise CaseError(f"{of}: the record is of {record.amplitude or 'the start'}, not of {FOLDS[of]}")
    begins = {record.step: begin} if begin else {}
    if of == "instability" or (isinstance(of, str) and of in FOLDS):
        found = as_asked(adjoint_of_instability(scene, record, fold, begins), of)
    else:
        found = adjoint_at_end(scene, History(record, record, begin, begins=begins), of, hold)[1]
    return {name: derivative(found, name) for name in ([by] if isinstance(by, str) else by)}


def derivative(adjoint: Adjoint, by: str) -> Gradient:
    """The derivative by one parameter, in the unit of the result; see `gradient`."""
    size = adjoint.size
    if by in FIELDS:
        found = by_field(adjoint, by)
        return replace(found, forces=size * found.forces)
    if by in adjoint.state.mu:
        return size * by_amplitude(adjoint, by)
    return size * by_number(adjoint, by) + adjoint.value * size_by_number(adjoint, by)

"""Gradients of a result with respect to amplitudes, numbers of the case, and fields."""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

from magshell_fenicsx.assembly.field_derivative import FieldGradient
from magshell_fenicsx.continuation.fold import Fold
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint, adjoint, adjoint_of_instability
from magshell_fenicsx.simulate.gradients.fields import FIELDS, by_field
from magshell_fenicsx.simulate.gradients.single import by_amplitude, by_number
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import Target
from magshell_fenicsx.simulate.scene import Scene

Gradient: TypeAlias = float | FieldGradient


def gradient(
    scene: Scene,
    record: Record,
    *,
    of: str | Target,
    by: Sequence[str],
    fold: Fold | None = None,
    hold: Mapping[str, str] | None = None,
) -> dict[str, Gradient]:
    """The derivatives of a result at a record; collective.

    Parameters
    ----------
    of
        "instability": the amplitude of a record that is a fold or, on a meridian, a neutral wave; a column of path.csv
        (named points, w_over_h, reactions, volume_change, the load where it is not held, energy); or a function from
        undeformed places (n, 3) over R to wanted ones: the mean square distance to them.
    by
        Amplitudes ("lambda_m", ...), keys of the case with a number ("magnetic.remanent.polar"), and fields:
        "remanence" (vectors over |B^r|, of a meridian along e_rho, e_theta, e_z), "magnitude" (a factor of it),
        "thickness" (over h), "curvature" (the natural one over 1/R in the case's frame: 11, 22, 12) and "deviation"
        (w0 over R, along the outward normal of the perfect shell).
    fold
        Of `fold_at`, if it is known.
    hold
        Amplitude -> "load" or "conjugate": what stays while p changes. By default what the record's step holds, and
        the displacement where that is its control.

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
    found = adjoint_of_instability(scene, record, fold) if of == "instability" else adjoint(scene, record, of, hold)
    return {name: derivative(found, name) for name in by}


def derivative(adjoint: Adjoint, by: str) -> Gradient:
    """The derivative by one parameter; see `gradient`."""
    if by in FIELDS:
        return by_field(adjoint, by)
    if by in adjoint.state.mu:
        return by_amplitude(adjoint, by)
    return by_number(adjoint, by)

"""Whether a mirror plane, or a turn about e3, leaves a dead load."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.by_formula import function
from magshell_fenicsx.mesh.mirror import ROUNDING, Mirror
from magshell_fenicsx.parts.forces.dead import DeadLoadSection
from magshell_fenicsx.problem.problem import Span
from magshell_fenicsx.shape.turning import scalar_turns, vector_turns

Array = NDArray[np.float64]


def alike(here: Array, there: Array) -> bool:
    """Equal to rounding, and finite."""
    if not (np.isfinite(here).all() and np.isfinite(there).all()):
        return False
    return bool((np.abs(here - there) <= ROUNDING * np.abs(here).max(initial=0.0)).all())


def load_turns(load: DeadLoadSection, span: Span, R: float) -> bool:
    """Whether a load by formula is the same all around e3."""
    if load.vector is None:
        return scalar_turns(str(load.pressure), span, R)
    return vector_turns([str(v) for v in load.vector], span, R)


def is_image(load: DeadLoadSection, other: DeadLoadSection, mirror: Mirror, x: Array, R: float) -> bool:
    """Whether the plane mirrors one load to the other; x are places (n, 3) for formulas."""
    if load.varies or other.varies:
        return _mirrored_formula(load, other, mirror, R * x, R * mirror.image(x))
    edge = load.edge and mirror.other(load.edge)
    if (edge, load.at, load.over, load.moment, load.pressure, load.potential is None) != (
        other.edge,
        other.at,
        other.over,
        other.moment,
        other.pressure,
        other.potential is None,
    ):
        return False
    for here, there in ((getattr(x, key) for x in (load, other)) for key in ("force", "per_length", "per_area")):
        if (here is None) != (there is None):
            return False
        if here and np.abs(mirror.reflection @ here - there).max() > 1e-10 * np.linalg.norm(here):
            return False
    return True


def _mirrored_formula(load: DeadLoadSection, other: DeadLoadSection, mirror: Mirror, x: Array, image: Array) -> bool:
    edge = load.edge and mirror.other(load.edge)
    if (edge, load.over, load.vector is None) != (other.edge, other.over, other.vector is None):
        return False
    values, images = (
        np.stack([function(v)(*places.T) for v in (each.vector or [each.pressure or 0.0])], axis=-1)
        for each, places in ((load, x), (other, image))
    )
    return alike(values if load.vector is None else values @ mirror.reflection, images)

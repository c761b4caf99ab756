"""Dead loads in the model's terms: over E h R and in the model's frame, on the part that is modelled."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.expressions import ByFormula, Inwards, function
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.models.shell.parameters import (
    AreaForce,
    DeadLoad,
    EdgeForce,
    EdgeMoment,
    Loads,
    PointForce,
    Potential,
)
from magshell_fenicsx.models.shell.patterns import Pattern
from magshell_fenicsx.parts.forces.dead import DeadLoadSection, potential
from magshell_fenicsx.parts.part import Account, Context, Modelled

Array = NDArray[np.float64]


def dead_load(load: DeadLoadSection, name: str, context: Context, modelled: Modelled) -> DeadLoad:
    """A load as the model takes it; `name` is for its energy, if it has one."""
    mirror = modelled.mirror
    shared = mirror is not None and (load.edge is None or mirror.other(load.edge) == load.edge)
    Q, scales = rotation(modelled.turn), context.scales
    E, t, R = scales.E, scales.h, scales.R
    if load.potential is not None:
        return Potential(potential(name, load.potential, Q, scales))
    if load.varies:
        unit = E * t if load.edge else E * t / R
        pattern = _pattern(load, Q, R, 1 / unit)
        return EdgeForce(load.edge, pattern, total=False) if load.edge else AreaForce(_over(load), pattern)
    force = np.asarray((0.5 if shared else 1.0) * (Q @ (load.force or np.zeros(3))) / (E * t * R))
    if load.at is not None:
        return PointForce(load.at, force)
    if load.edge is not None and load.moment is not None:
        return EdgeMoment(load.edge, load.moment / (E * t * R))
    if load.edge is not None and load.force is not None:
        return EdgeForce(load.edge, force, total=True)
    if load.edge is not None:
        assert load.per_length is not None
        return EdgeForce(load.edge, np.asarray(Q @ np.array(load.per_length, dtype=float) / (E * t)), total=False)
    if load.pressure is not None:
        assert isinstance(load.pressure, float | int)
        return AreaForce(_over(load), load.pressure * R / (E * t))
    assert load.per_area is not None
    return AreaForce(_over(load), np.asarray(Q @ np.array(load.per_area, dtype=float) * R / (E * t)))


def _over(load: DeadLoadSection) -> str | None:
    return None if load.over == "all" else load.over


def _pattern(load: DeadLoadSection, Q: Array, length: float, factor: float) -> Pattern:
    """The load of a formula in the model's frame; a pressure is against the normal."""
    if load.vector is not None:
        return ByFormula([function(v) for v in load.vector], Q, length, factor, vectors=True)
    assert load.pressure is not None
    return Inwards(ByFormula([function(load.pressure)], Q, length, factor))


def account(context: Context, loads: Loads) -> Account:
    """Forces and dead loads."""
    patches = [force.patch * context.shell.R_over_h for force in loads.forces.values()]
    words = [f"force on a patch of radius {patch:g} h" if patch else "force at a point" for patch in patches]
    if dead := loads.all_dead:
        words.append(f"{len(dead)} dead load{'s' * (len(dead) > 1)}")
    return Account(words, [] if loads.forces else ["force: none"])

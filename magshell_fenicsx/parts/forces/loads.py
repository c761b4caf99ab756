"""Dead loads in the model's terms: over E h R and in the model's frame, on the part that is modelled."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.expressions import ByFormula, Inwards, function
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.mesh.patch import PatchMesh
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
from magshell_fenicsx.models.shell.thickness import patch_of
from magshell_fenicsx.parts.forces.dead import DeadLoadSection, potential
from magshell_fenicsx.parts.part import Account, Context, Modelled
from magshell_fenicsx.parts.seen import Seen, Sight
from magshell_fenicsx.quantities.registry import amplitude

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


def also_displaced(loads: Loads) -> tuple[str, ...]:
    """Amplitudes with a displacement besides the one of the column w_over_h."""
    return tuple(name for name in (*loads.forces, *loads.dead) if name != loads.displaced)


class ForcesSeen(Seen):
    """Factors of forces and dead loads, and displacements along them."""

    before_points: ClassVar[bool] = True

    def amplitudes(self, loads: Loads) -> tuple[str, ...]:
        return (*loads.forces, *loads.dead)

    def columns(self, loads: Loads, supports: Sequence[str]) -> tuple[str, ...]:
        factors = (amplitude(name).column for name in self.amplitudes(loads) if name != "force")
        return (*factors, *(f"w_{name}_over_h" for name in also_displaced(loads)))

    def observe(self, sight: Sight, state: State) -> dict[str, float]:
        model, loads = sight.model, sight.loads
        factors = {amplitude(name).column: state.mu[name] for name in self.amplitudes(loads)}
        along = also_displaced(loads)
        return factors | {f"w_{name}_over_h": model.loaded_deflection(state.u, name) / sight.h for name in along}

    def refuse_unfit(self, loads: Loads, surface: PatchMesh) -> None:
        for load in loads.all_dead:
            if isinstance(load, AreaForce) and load.patch is not None:
                patch_of(surface.patches, load.patch)

    def conjugate_unit(self, sight: Sight, name: str) -> float | None:
        """w/h of a force, the shell's length of dead loads."""
        if name in sight.loads.forces:
            return sight.model.force_unit * sight.h
        return sight.model.load_size.get(name, 0.0) / sight.length if name in sight.loads.dead else None


def account(context: Context, loads: Loads) -> Account:
    """Forces and dead loads."""
    patches = [force.patch * context.shell.R_over_h for force in loads.forces.values()]
    words = [f"force on a patch of radius {patch:g} h" if patch else "force at a point" for patch in patches]
    if dead := loads.all_dead:
        words.append(f"{len(dead)} dead load{'s' * (len(dead) > 1)}")
    return Account(words, [] if loads.forces else ["force: none"])

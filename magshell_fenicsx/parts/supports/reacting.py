"""Reactions of supports, and those along motions, as columns of path.csv in the case's units."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.models.observed import Observed
from magshell_fenicsx.models.shell.parameters import Loads
from magshell_fenicsx.parts.supports.reactions import reactions

Array = NDArray[np.float64]


def columns(supports: Iterable[str]) -> tuple[str, ...]:
    """The columns of supports: forces and moments along the axes."""
    return tuple(f"{name}_{kind}{axis}" for name in supports for kind in "fm" for axis in "xyz")


def motion_columns(loads: Loads) -> dict[str, str]:
    """Amplitude of a motion -> the column of its reaction."""
    names = list(dict.fromkeys(move.motion.name for move in loads.moves))
    return {name: "reaction" if len(names) == 1 else f"reaction_{name}" for name in names}


def motion_size(loads: Loads, name: str) -> float:
    """The sum of the lengths of the translations of an amplitude, over R; without any of the angles (rad)."""
    motions = [move.motion for move in loads.moves if move.motion.name == name for _ in move.names]
    shifts = float(sum(np.linalg.norm(motion.shift) for motion in motions))
    return shifts or float(sum(np.linalg.norm(motion.turn) for motion in motions))


def source_columns(loads: Loads) -> dict[str, str]:
    """Amplitude of a source -> the column of the force, the torque or the work on it."""
    found: dict[str, str] = {}
    turns = [motion.name for motion in loads.magnetic.turns] if loads.magnetic else []
    for each in loads.magnetic.driven if loads.magnetic else ():
        own = [motion for motion in each.motions if motion.name not in turns]
        found |= {motion.name: "source_torque" if motion.turns else "source_force" for motion in own}
        found |= dict.fromkeys(each.factors, "source_work")
    kinds = list(found.values())
    return {name: kind if kinds.count(kind) == 1 else f"{kind}_{name}" for name, kind in found.items()}


def source_size(loads: Loads, name: str) -> float:
    """The length over R, the angle (rad) or the change of the factor for an amplitude of one."""
    assert loads.magnetic
    for each in loads.magnetic.driven:
        if name in each.factors:
            return each.factors[name]
        for motion in each.motions:
            if motion.name == name:
                return float(np.linalg.norm(motion.turn if motion.turns else motion.shift))
    raise KeyError(name)


def observed_reactions(
    model: Observed, state: State, mirror: Mirror | None, frame: Array, force: float, length: float
) -> dict[str, float]:
    """The values of `columns` of all supports, sorted by support; collective.

    Parameters
    ----------
    frame
        The model's frame, see `mesh.frame.rotation`.
    force, length
        E h R and R in the case's units.
    """
    found: dict[str, float] = {}
    for name, one in reactions(model, state, mirror).items():
        values = np.concatenate([force * one.force @ frame, force * length * one.moment @ frame])
        found |= dict(zip(columns([name]), (float(v) for v in values), strict=True))
    return found

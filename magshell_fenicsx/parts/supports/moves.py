"""Motions of supports in the model's terms, and the symmetry that they leave."""

from math import radians

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.motion import Motion
from magshell_fenicsx.case.case import Case
from magshell_fenicsx.mesh.frame import rotation
from magshell_fenicsx.mesh.mirror import ROUNDING, Mirror
from magshell_fenicsx.models.shell.parameters import Move
from magshell_fenicsx.parts.supports.motion import EdgeSection, MoveSection

Array = NDArray[np.float64]


def moves(case: Case, turn: float) -> tuple[Move, ...]:
    """The motions of all steps, each amplitude once, in a frame turned about e3 (rad)."""
    steps = {step.name: step.load for step in case.programme if isinstance(step.load, EdgeSection)}
    return tuple(
        Move(tuple(one.supports), motion(one, name, case.shell.reference, turn))
        for name, load in steps.items()
        for one in load.moves
    )


def motion(move: MoveSection, name: str, R: float, turn: float = 0.0) -> Motion:
    """A motion with the amplitude `name`, over the length R."""
    Q, about, zero = rotation(turn), move.rotation, np.zeros(3)
    shift = Q @ (np.array(move.translation) / R) if move.translation else zero
    if about is None:
        return Motion(name, shift, zero, zero)
    axis = np.array(about.axis) / np.linalg.norm(about.axis)
    return Motion(name, shift, radians(about.angle) * (Q @ axis), Q @ (np.array(about.point) / R))


def sideways(load: EdgeSection) -> str | None:
    """Why a motion is not axisymmetric; None if it is."""
    for one in load.moves:
        if one.rotation or (one.translation and any(one.translation[:2])):
            return f"the motion of {one.supports[0]} is not along e3"
    return None


def held_vectors(load: EdgeSection) -> list[Array]:
    """Unit vectors (3,) that a mirror plane through e3 must hold: translations, and normals of axes of rotation."""
    found = [np.array(one.translation) for one in load.moves if one.translation]
    found += [np.cross([0.0, 0.0, 1.0], one.rotation.axis) for one in load.moves if one.rotation]
    return [v / np.linalg.norm(v) for v in found if v.any()]


def mirrored(load: EdgeSection, R: float, mirror: Mirror) -> bool:
    """Whether a plane maps the motions onto themselves."""
    motions = {name: motion(one, "", R) for one in load.moves for name in one.supports}
    return all(
        mirror.other(name) in motions and _is_image(one, motions[mirror.other(name)], mirror)
        for name, one in motions.items()
    )


def _is_image(one: Motion, other: Motion, mirror: Mirror) -> bool:
    """A mirrored rotation runs the other way about the mirrored axis."""
    S, along = mirror.reflection, other.turn / (np.linalg.norm(other.turn) or 1.0)
    apart = mirror.image(one.centre) - other.centre
    size = max(np.abs([one.shift, one.turn]).max(), ROUNDING)
    return bool(
        np.abs(S @ one.shift - other.shift).max() < ROUNDING * size
        and np.abs(S @ one.turn + other.turn).max() < ROUNDING * size
        and (not other.turns or np.abs(apart - (apart @ along) * along).max() < ROUNDING)
    )

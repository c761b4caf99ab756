"""The direction of the applied field in a programme, and the curves of its components."""

from collections.abc import Mapping, Sequence
from math import atan2, copysign, cos, degrees, hypot, sin

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.device import Curve
from magshell_fenicsx.parts.magnetism.field_step import RotationSection
from magshell_fenicsx.parts.magnetism.magnetised import ACROSS, Magnetisation
from magshell_fenicsx.parts.magnetism.moving_source import combined_motion
from magshell_fenicsx.parts.step import ProgrammeStep

Array = NDArray[np.float64]
FIELD = ("lambda_m", *ACROSS)  # amplitudes of the field's components


def directions(
    programme: Sequence[ProgrammeStep], field: Magnetisation | None, turn: float
) -> Array:
    """Unit vectors (steps + 1, 3) of the field before each step and after the last, in a turned
    frame.
    """
    vectors = [field.axes[0] if field else np.eye(3)[2]]
    for step in programme:
        vectors.append(
            step.load.to.vector(turn) if isinstance(step.load, RotationSection) else vectors[-1]
        )
    return np.array(vectors)


def components(direction: Array, field: Magnetisation | None) -> Array:
    """A direction by the amplitudes of `FIELD`; a field in space has one amplitude in each
    direction.
    """
    return np.ones(1) if field is None or field.in_space else np.array(field.axes) @ direction


def field_at(mu: Mapping[str, float]) -> Array:
    """The components of the field, from all amplitudes."""
    return np.array([mu[name] for name in FIELD if name in mu])


def straight(direction: Array) -> dict[str, Curve]:
    """The components of a field t along a direction."""

    def curve(c: float) -> Curve:
        return lambda t: (c * t, c, 0.0)

    return {name: curve(float(c)) for name, c in zip(FIELD, direction, strict=False)}


def circle(size: float, before: Array, after: Array) -> dict[str, Curve]:
    """The components of a field that has turned by t (rad) from one direction towards another."""
    rest = after - (before @ after) * before
    away = rest / np.linalg.norm(rest)

    def curve(b: float, a: float) -> Curve:
        return lambda t: (
            b * cos(t) + a * sin(t),
            a * cos(t) - b * sin(t),
            -b * cos(t) - a * sin(t),
        )

    parts = zip(FIELD, size * before, size * away, strict=False)
    return {name: curve(float(b), float(a)) for name, b, a in parts}


def as_a_whole(name: str, total: float) -> dict[str, Curve]:
    """The amplitude of the rotation of a field in space, which is 1 at the angle `total` (rad)."""
    return {name: lambda t: (t / total, 1 / total, 0.0)}


def field_size(mu: Mapping[str, float], sense: float) -> float:
    """The magnitude of the field with the sign of the case's field, or with its own where it has
    not turned.
    """
    first, across, third = (mu.get(name, 0.0) for name in FIELD)
    return copysign(hypot(first, across, third), sense) if across or third else first


def field_angle(mu: Mapping[str, float], field: Magnetisation | None, sense: float = 1.0) -> float:
    """The angle between the field and its first direction (degrees); `sense` is the sign of the
    case's field.
    """
    if field and field.turns:
        first, axis = field.axes[0], field.turns[0].turn / np.linalg.norm(field.turns[0].turn)
        now = combined_motion(field.turns, mu)[0] @ first
        normal = np.cross(first, now)
        planar = all(np.abs(np.cross(axis, one.turn)).max() < 1e-9 for one in field.turns)
        across = float(normal @ axis) if planar else float(np.linalg.norm(normal))
        return degrees(atan2(across, float(first @ now)))
    along, across, third = (mu.get(name, 0.0) for name in FIELD)
    if not (across or third):
        return 0.0
    return degrees(atan2(hypot(across, third) if third else sense * across, sense * along))

"""The direction of the applied field in a programme, and the curves of its components.

- A programme is the list of a case's steps. Only steps of kind `rotation` turn the field.
- An amplitude is a load parameter, by name; mu holds them all. The components of a field along its
  `axes` are the amplitudes `COMPONENTS`: along its first direction, and across it.
- A curve is a function of one parameter t that returns an amplitude with its first and second
  derivatives; a step follows it.
- A field in space (of sources or formulas) has one strength and turns as a whole, by an amplitude
  for each rotation.
"""

from collections.abc import Mapping, Sequence
from math import atan2, copysign, cos, degrees, hypot, sin

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.device import Curve
from magshell_fenicsx.parts.magnetism.field_step import RotationSection
from magshell_fenicsx.parts.magnetism.fields import FIELD
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.parts.magnetism.moving_source import combined_motion
from magshell_fenicsx.parts.step import ProgrammeStep

Array = NDArray[np.float64]
COMPONENTS = (FIELD.name, *FIELD.components)  # amplitudes of the field's components


def directions(
    programme: Sequence[ProgrammeStep], field: Magnetisation | None, turn: float
) -> Array:
    """Return unit vectors (steps + 1, 3) of the field before each step and after the last one.

    Row i is the direction before the step with the index i. The vectors are in a frame turned by
    `turn` about e3 (rad). Without a field the first direction is e3. A step that turns the field
    gives a new direction, any other keeps that of before.
    """
    vectors = [field.axes[0] if field else np.eye(3)[2]]
    for step in programme:
        vectors.append(
            step.load.to.vector(turn) if isinstance(step.load, RotationSection) else vectors[-1]
        )
    return np.array(vectors)


def components(direction: Array, field: Magnetisation | None) -> Array:
    """Return the components of a direction (3,), for the amplitudes of `COMPONENTS` that exist.

    A field in space has one amplitude for all directions: the result is then [1].
    """
    return np.ones(1) if field is None or field.in_space else np.array(field.axes) @ direction


def field_at(mu: Mapping[str, float]) -> Array:
    """Return the components of the field that exist, from all amplitudes by name."""
    return np.array([mu[name] for name in COMPONENTS if name in mu])


def straight(direction: Array) -> dict[str, Curve]:
    """Return amplitude -> curve for a field of strength t along a direction.

    `direction` has a component for each amplitude of `COMPONENTS` that exists. A curve returns the
    amplitude c t with its derivatives c and 0.
    """

    def curve(c: float) -> Curve:
        """Return the curve c t."""
        return lambda t: (c * t, c, 0.0)

    return {name: curve(float(c)) for name, c in zip(COMPONENTS, direction, strict=False)}


def circle(size: float, start: Array, end: Array) -> dict[str, Curve]:
    """Return amplitude -> curve for a field that is turned by t (rad) from `start` towards `end`.

    `start` and `end` are unit vectors of the field's components, `size` is its signed magnitude.
    """
    # the part of `end` across `start`: along it lies the direction after a turn by 90 degrees
    normal_part = end - (start @ end) * start
    quarter_turn = normal_part / np.linalg.norm(normal_part)

    def curve(b: float, a: float) -> Curve:
        """Return the curve b cos t + a sin t."""
        return lambda t: (
            b * cos(t) + a * sin(t),
            a * cos(t) - b * sin(t),
            -b * cos(t) - a * sin(t),
        )

    names_and_sizes = zip(COMPONENTS, size * start, size * quarter_turn, strict=False)
    return {name: curve(float(b), float(a)) for name, b, a in names_and_sizes}


def as_a_whole(name: str, total: float) -> dict[str, Curve]:
    """Return the curve of the rotation of a field in space: amplitude 1 at angle `total` (rad)."""
    return {name: lambda t: (t / total, 1 / total, 0.0)}


def field_size(mu: Mapping[str, float], sense: float) -> float:
    """Return the magnitude of the field from amplitudes `mu`, with the sign `sense` of the case.

    A field that has not turned is returned with its own sign.
    """
    first, second, third = (mu.get(name, 0.0) for name in COMPONENTS)
    return copysign(hypot(first, second, third), sense) if second or third else first


def field_angle(mu: Mapping[str, float], field: Magnetisation | None, sense: float = 1.0) -> float:
    """Return the angle between the field and its first direction (degrees), from amplitudes `mu`.

    `sense` is the sign of the field of the case. The angle is signed, from -180 to 180, if the
    field turns in one plane; else it is from 0 to 180.
    """
    # a field in space: its direction follows from the rotations, each with an axis `turn`
    if field and field.turns:
        first, axis = field.axes[0], field.turns[0].turn / np.linalg.norm(field.turns[0].turn)
        rotation, *_ = combined_motion(field.turns, mu)
        direction = rotation @ first
        normal = np.cross(first, direction)
        is_planar = all(np.abs(np.cross(axis, motion.turn)).max() < 1e-9 for motion in field.turns)
        # sine of the angle, with a sign if all rotations have one axis
        sine = float(normal @ axis) if is_planar else float(np.linalg.norm(normal))
        return degrees(atan2(sine, float(first @ direction)))
    # else: components along the first direction, and across it
    component, second, third = (mu.get(name, 0.0) for name in COMPONENTS)
    if not (second or third):
        return 0.0
    return degrees(atan2(hypot(second, third) if third else sense * second, sense * component))

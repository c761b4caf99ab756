"""The direction of the applied field in a programme, and the curves of its components."""

from collections.abc import Mapping, Sequence
from math import atan2, copysign, cos, degrees, hypot, sin

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.loading import ProgrammeStep
from magshell_fenicsx.case.loads.field import RotationSection
from magshell_fenicsx.continuation.along import Curve
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.shell.parameters import ACROSS, Magnetisation
from magshell_fenicsx.plan.turned import along, at_angle

Array = NDArray[np.float64]
FIELD = ("lambda_m", *ACROSS)  # amplitudes of the field's components


def directions(programme: Sequence[ProgrammeStep], field: Magnetisation | None, turn: float) -> Array:
    """Unit vectors (steps + 1, components) of the field before each step and after the last, in a turned frame."""
    if field is None:
        return np.ones((len(programme) + 1, 1))
    basis = np.array(field.axes)
    found = [np.eye(len(basis))[0]]
    for step in programme:
        found.append(basis @ step.load.to.vector(turn) if isinstance(step.load, RotationSection) else found[-1])
    return np.array(found)


def field_at(state: State) -> Array:
    """The components of the field."""
    return np.array([state.mu[name] for name in FIELD if name in state.mu])


def turned(directions: Array, field: Magnetisation | None) -> list[Array]:
    """Harmonics (5, 3, 3) of the gradient of a field of size one, from each direction of `directions` to the next."""
    if field is None or field.gradient is None or not field.turned:
        return []
    return [parts for _, parts in along(field.gradient, list(directions @ np.array(field.axes)))]


def straight(direction: Array, field: Magnetisation, parts: Array | None) -> dict[str, Curve]:
    """The components of a field t along a direction, and of its gradient; `parts` are its harmonics there."""

    def curve(c: float) -> Curve:
        return lambda t: (c * t, c, 0.0)

    found = dict(zip(FIELD, direction, strict=False))
    if parts is not None and field.gradient is not None:
        rest = at_angle(parts, 0.0) - direction[0] * field.gradient
        found |= {name: np.sum(rest * B) for name, B in field.gradients.items() if name != FIELD[0]}
    return {name: curve(float(c)) for name, c in found.items()}


def _away(before: Array, after: Array) -> Array:
    """The unit vector in the plane of two directions that is normal to the first, on the side of the second."""
    rest = after - (before @ after) * before
    return np.asarray(rest / np.linalg.norm(rest))


def circle(size: float, before: Array, after: Array) -> dict[str, Curve]:
    """The components of a field that has turned by t (rad) from one direction towards another."""
    away = _away(before, after)

    def curve(b: float, a: float) -> Curve:
        return lambda t: (b * cos(t) + a * sin(t), a * cos(t) - b * sin(t), -b * cos(t) - a * sin(t))

    parts = zip(FIELD, size * before, size * away, strict=False)
    return {name: curve(float(b), float(a)) for name, b, a in parts}


def turning(size: float, before: Array, after: Array, field: Magnetisation, parts: Array) -> dict[str, Curve]:
    """The components of the gradient of the field of `circle`; lambda_m has `Magnetisation.gradient` in its own."""
    away = _away(before, after)
    assert field.gradient is not None
    rest = parts - np.multiply.outer([0.0, before[0], away[0], 0.0, 0.0], field.gradient)

    def curve(k: Array) -> Curve:
        def of(t: float) -> tuple[float, float, float]:
            c, s, c2, s2 = cos(t), sin(t), cos(2 * t), sin(2 * t)
            slope = k @ [0.0, -s, c, -2 * s2, 2 * c2]
            return float(k @ [1.0, c, s, c2, s2]), float(slope), float(k @ [0.0, -c, -s, -4 * c2, -4 * s2])

        return of

    return {
        name: curve(size * np.sum(rest * B, axis=(1, 2))) for name, B in field.gradients.items() if name != FIELD[0]
    }


def field_size(mu: Mapping[str, float], sense: float) -> float:
    """The magnitude of the field with the sign of the case's field, or with its own where it has not turned."""
    first, across, third = (mu.get(name, 0.0) for name in FIELD)
    return copysign(hypot(first, across, third), sense) if across or third else first


def field_angle(mu: Mapping[str, float], sense: float = 1.0) -> float:
    """The angle between the field and its first direction (degrees); `sense` is the sign of the case's field."""
    first, across, third = (mu.get(name, 0.0) for name in FIELD)
    if not (across or third):
        return 0.0
    return degrees(atan2(hypot(across, third) if third else sense * across, sense * first))

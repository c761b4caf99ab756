"""Lines that outline simple bodies, around their own axes."""

from itertools import product

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SEEN = 0.5  # of R: half of what is drawn of a body without end


def circle(radius: float, z: float = 0.0, *, axes: tuple[int, int, int] = (0, 1, 2)) -> Array:
    """Places (n, 3) along a circle around the last of some axes."""
    t = np.linspace(0.0, 2 * np.pi, 49)
    return np.column_stack([radius * np.cos(t), radius * np.sin(t), np.full_like(t, z)])[:, np.argsort(axes)]


def upright(radius: float, height: float) -> list[Array]:
    """The outline of a cylinder: both circles, and four lines between them."""
    ends = np.array([-height / 2, height / 2])
    sides = [np.array([[x, y, z] for z in ends]) for x, y in radius * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])]
    return [*(circle(radius, z) for z in ends), *sides]


def ball(radius: float) -> list[Array]:
    """The outline of a sphere: three circles."""
    return [circle(radius, axes=axes) for axes in ((0, 1, 2), (1, 2, 0), (2, 0, 1))]


def edges(low: Array, high: Array) -> list[Array]:
    """The twelve edges of a box between two corners (3,)."""
    corners = np.array([*product((0, 1), repeat=3)])
    pairs = [(a, b) for a in corners for b in corners if (b - a).sum() == 1 and (b >= a).all()]
    return [low + np.array(pair) * (high - low) for pair in pairs]


def frame(axis: Array) -> Array:
    """Two unit vectors across a unit vector (3,), and itself, as columns."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first = first / np.linalg.norm(first)
    return np.column_stack([first, np.cross(axis, first), axis])

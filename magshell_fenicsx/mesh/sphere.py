"""The sphere of radius 1, charted by (x, y) = phi (cos theta, sin theta), and the plane."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def sphere(chart: Array) -> Array:
    """Chart (n, 2) -> places (n, 3), which are the normals too."""
    phi = np.hypot(chart[:, 0], chart[:, 1])
    horizontal = np.sinc(phi / np.pi)[:, None] * chart
    return np.column_stack([horizontal, np.cos(phi)])


def flat(chart: Array) -> Array:
    """Chart (x, y) -> the plane z = 0."""
    return np.column_stack([chart, np.zeros(len(chart))])


def upwards(chart: Array) -> Array:
    """The normals (n, 3) of that plane."""
    return np.broadcast_to([0.0, 0.0, 1.0], (len(chart), 3))

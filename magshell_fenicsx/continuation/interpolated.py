"""Polynomials through some points."""

from collections.abc import Sequence

import numpy as np
import scipy


def slope(places: Sequence[float]) -> list[tuple[float, float]]:
    """Weights and places of the slope at the first place of the polynomial through all."""
    off = np.array(places) - places[0]
    scale = np.abs(off).max()
    weights = np.linalg.solve(np.vander(off / scale, increasing=True).T, np.eye(len(places))[1]) / scale
    return [(float(weight), float(q)) for weight, q in zip(weights, places, strict=True)]


def interpolated(x: Sequence[float], y: Sequence[float], at: float) -> float:
    """The value at `at` of the polynomial through the points (x, y)."""
    return float(scipy.interpolate.barycentric_interpolate(x, y, at))


def stationary(rise: float, d0: float, d1: float) -> float:
    """The place between 0 and 1, not too close to these, where a cubic is stationary, from its rise and end slopes."""
    roots = np.roots([3 * (d0 + d1 - 2 * rise), 2 * (3 * rise - 2 * d0 - d1), d0])
    inside = [float(r.real) for r in roots if abs(r.imag) < 1e-12 and 0 < r.real < 1]
    t = inside[0] if inside else d0 / (d0 - d1)
    return float(min(max(t, 1e-3), 1 - 1e-3))

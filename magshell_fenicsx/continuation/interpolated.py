"""Polynomials through some points."""

from collections.abc import Sequence
from math import prod

import numpy as np
import scipy

REAL = 1e-12  # imaginary part of a root that counts as real
LEAST = 0.05  # of a way to a corner, from both ends


def slope(places: Sequence[float]) -> list[tuple[float, float]]:
    """Weights and places of the slope at the first place of the polynomial through all."""
    off = np.array(places) - places[0]
    scale = np.abs(off).max()
    weights = (
        np.linalg.solve(np.vander(off / scale, increasing=True).T, np.eye(len(places))[1]) / scale
    )
    return [(float(weight), float(q)) for weight, q in zip(weights, places, strict=True)]


def interpolated(x: Sequence[float], y: Sequence[float], at: float) -> float:
    """The value at `at` of the polynomial through the points (x, y)."""
    return float(scipy.interpolate.barycentric_interpolate(x, y, at))


def _flat(rise: float, d0: float, d1: float) -> list[float]:
    """The places where a cubic is stationary, from its rise between 0 and 1 and the slopes there."""
    roots = np.roots([3 * (d0 + d1 - 2 * rise), 2 * (3 * rise - 2 * d0 - d1), d0])
    return [float(r.real) for r in roots if abs(r.imag) < REAL]


def stationary(rise: float, d0: float, d1: float) -> float:
    """The place between 0 and 1, not too close to these, where that cubic is stationary."""
    inside = [t for t in _flat(rise, d0, d1) if 0 < t < 1]
    t = inside[0] if inside else d0 / (d0 - d1)
    return float(min(max(t, 1e-3), 1 - 1e-3))


def flat_beyond(rise: float, d0: float, d1: float) -> float:
    """The first place beyond 1 where that cubic is stationary; infinite if there is none."""
    return min((t for t in _flat(rise, d0, d1) if t > 1), default=np.inf)


def hermite(s: float, nodes: Sequence[float]) -> list[tuple[float, float]]:
    """Weights of the values and slopes at nodes, in the value at `s` of the Hermite polynomial
    through all of them.
    """
    weights = []
    for i, a in enumerate(nodes):
        others = [*nodes[:i], *nodes[i + 1 :]]
        square = prod((s - b) / (a - b) for b in others) ** 2
        bend = 2 * sum(1 / (a - b) for b in others)
        weights.append((square * (1 - bend * (s - a)), square * (s - a)))
    return weights


def corner(rise: float, low: float, high: float) -> float:
    """The part of the way at which straight lines from both ends meet, not too near them; slopes as
    of `stationary`.
    """
    return min(max((rise - high) / (low - high), LEAST), 1 - LEAST)

"""Interpolating polynomials: derivatives, stationary points and Hermite interpolation.

All functions are scalar. Where a cubic is given by its rise and its end slopes, it stands over the
interval from 0 to 1.
"""

from collections.abc import Sequence
from math import prod

import numpy as np
import scipy

REAL_ROOT_TOLERANCE = 1e-12  # imaginary part of a root that counts as real
MIN_END_DISTANCE = 1e-3  # least distance of a stationary point from the ends of the interval
MIN_KINK_DISTANCE = 0.05  # the same of a kink


def slope_weights(places: Sequence[float]) -> list[tuple[float, float]]:
    """Return the weights of a difference formula for the slope at the first of some places.

    The formula differentiates the polynomial through the values at all places. The slope is the sum
    of the weights times the values.

    Returns
    -------
    Pairs of a weight and its place.
    """
    offsets = np.array(places) - places[0]
    scale = np.abs(offsets).max()
    vandermonde = np.vander(offsets / scale, increasing=True)
    # exact for all powers of the offset x: the slopes at zero are 0, 1, 0, ..., the right side
    weights = np.linalg.solve(vandermonde.T, np.eye(len(places))[1]) / scale
    return [(float(weight), float(place)) for weight, place in zip(weights, places, strict=True)]


def interpolated(x: Sequence[float], y: Sequence[float], place: float) -> float:
    """Return the value at a place of the polynomial through the points (x, y)."""
    return float(scipy.interpolate.barycentric_interpolate(x, y, place))


def _stationary_places(rise: float, d0: float, d1: float) -> list[float]:
    """Return all places where a cubic is stationary.

    The cubic rises by `rise` from 0 to 1, and has the slopes d0 at 0 and d1 at 1.
    """
    # coefficients of its derivative, a quadratic polynomial
    roots = np.roots([3 * (d0 + d1 - 2 * rise), 2 * (3 * rise - 2 * d0 - d1), d0])
    return [float(r.real) for r in roots if abs(r.imag) < REAL_ROOT_TOLERANCE]


def stationary(rise: float, d0: float, d1: float) -> float:
    """Return the place between 0 and 1 where a cubic is stationary, not too close to the ends.

    Parameters
    ----------
    rise
        Change of the cubic from 0 to 1.
    d0, d1
        Its slopes at 0 and 1, of opposite signs.
    """
    # if no stationary place lies between the ends: the zero of a linear slope from d0 to d1
    inner_places = [t for t in _stationary_places(rise, d0, d1) if 0 < t < 1]
    t = inner_places[0] if inner_places else d0 / (d0 - d1)
    return float(min(max(t, MIN_END_DISTANCE), 1 - MIN_END_DISTANCE))


def flat_beyond(rise: float, d0: float, d1: float) -> float:
    """Return the first place beyond 1 where a cubic is stationary; infinite if there is none.

    The cubic rises by `rise` from 0 to 1, and has the slopes d0 at 0 and d1 at 1.
    """
    return min((t for t in _stationary_places(rise, d0, d1) if t > 1), default=np.inf)


def hermite(s: float, nodes: Sequence[float]) -> list[tuple[float, float]]:
    """Return the weights of values and slopes at nodes in the Hermite polynomial's value at `s`.

    The polynomial takes given values and slopes at all nodes.

    Parameters
    ----------
    s
        The place where the polynomial is evaluated.
    nodes
        Distinct places with known values and slopes.

    Returns
    -------
    For each node the weight of its value and that of its slope.
    """
    weights = []
    for i, a in enumerate(nodes):
        others = [*nodes[:i], *nodes[i + 1 :]]
        # the square of the Lagrange polynomial of node a at s, and its slope at a, where it is 1
        square = prod((s - b) / (a - b) for b in others) ** 2
        derivative = 2 * sum(1 / (a - b) for b in others)
        weights.append((square * (1 - derivative * (s - a)), square * (s - a)))
    return weights


def kink(rise: float, d0: float, d1: float) -> float:
    """Return the place between 0 and 1 where straight lines from both ends meet.

    It is not too close to the ends, so that a bracket shrinks whatever the error.

    Parameters
    ----------
    rise
        Difference of the values at 0 and 1.
    d0, d1
        The slopes of the lines through 0 and 1.
    """
    return min(max((rise - d1) / (d0 - d1), MIN_KINK_DISTANCE), 1 - MIN_KINK_DISTANCE)

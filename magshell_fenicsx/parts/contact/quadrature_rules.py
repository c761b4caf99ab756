"""Quadrature rules for contact: in triangles, also with points on an edge and at its corners, and
on lines.
"""

from collections.abc import Sequence
from functools import cache

import basix
import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
EDGE_OFFSET = 1e-5  # distance of the points of an edge from it, over the height of their cell
COVER_DIVISIONS = 60  # of a side, at whose ends the distance from a rule's points is measured


def triangle_rule(degree: int) -> tuple[Array, Array]:
    """Return points (n, 2) in the reference triangle and weights, exact to a polynomial degree."""
    return basix.make_quadrature(basix.CellType.triangle, degree)  # type: ignore[no-any-return]


@cache
def edge_rule(degree: int, turning_ends: int = 0, corner: float = 0.0) -> tuple[Array, Array]:
    """Return `triangle_rule` with points next to the side opposite to the first corner.

    So an edge there has points. On lines from that corner they are Radau's, for the weight of their
    distance from it, with one `EDGE_OFFSET` before the side: an edge often lies exactly opposite
    another one, where the second derivative of the gap jumps. Along the side they are Gauss's, so
    that none is opposite a corner, where several cells meet.

    Parameters
    ----------
    turning_ends
        Where the edge turns: 1 at the begin of the side, 2 at the end, 3 at both, 0 nowhere. There
        a point on it is a part `corner` of the side before that.
    """
    t, weights_t = _rule_with_points((degree + 1) // 2, [1 - EDGE_OFFSET], 1)
    fixed_points = [corner] if turning_ends & 1 else []
    if turning_ends & 2:
        fixed_points.append(1 - corner)
    inner_line = _rule_with_points((degree + 2) // 2, [], 0)
    last_line = _rule_with_points((degree + 2 - len(fixed_points)) // 2, fixed_points, 0)
    places, weights = list[Array](), list[Array]()
    for position, weight in zip(t, weights_t, strict=True):
        s, weights_s = last_line if position == t[-1] else inner_line
        places.append(np.stack([position * (1 - s), position * s], axis=1))
        weights.append(weight * weights_s)
    return np.concatenate(places), np.concatenate(weights)


def line_rule(count: int, begins: bool, ends: bool) -> tuple[Array, Array]:
    """Return points and weights on [0, 1]: Gauss's, or Radau's and Lobatto's next to ends.

    Parameters
    ----------
    count
        Number of points.
    begins, ends
        Whether a point is next to the begin, and to the end.
    """
    from scipy.special import roots_jacobi  # takes long to import

    x, w = roots_jacobi(count - begins - ends, float(ends), float(begins))
    w = w / ((1 - x) ** int(ends) * (1 + x) ** int(begins))
    end_weight = 2 / (count * (count - 1)) if begins and ends else 2 / count**2
    x = np.concatenate([[-1 + 2 * EDGE_OFFSET] * begins, x, [1 - 2 * EDGE_OFFSET] * ends])
    w = np.concatenate([[end_weight] * begins, w, [end_weight] * ends])
    return (x + 1) / 2, w / 2


def _rule_with_points(count: int, fixed_points: Sequence[float], power: int) -> tuple[Array, Array]:
    """Return points from 0 to 1 and weights for the weight x^power, of the highest degree.

    The free points are the roots of a polynomial that is orthogonal to all lower ones, in
    Legendre's, by the weight times what is zero at the fixed ones. G. H. Golub, SIAM Review 15
    (1973) 318-334.

    Parameters
    ----------
    count
        Number of free points.
    fixed_points
        Further points.
    """
    x, w = scipy.special.roots_legendre(2 * count + 4)
    legendre, point_count = np.polynomial.legendre.legvander, count + len(fixed_points)
    weight = w / 2 * ((1 + x) / 2) ** power
    signed = weight * np.prod([(1 + x) / 2 - point for point in fixed_points], axis=0)
    P = legendre(x, count - 1)
    signed = np.sign(signed.sum()) * signed[:, None] * P
    free_points = scipy.linalg.eigh(P.T @ (x[:, None] * signed), P.T @ signed, eigvals_only=True)
    points = np.sort([*((1 + free_points) / 2), *fixed_points])
    moments = legendre(x, point_count - 1).T @ weight
    return points, np.linalg.solve(legendre(2 * points - 1, point_count - 1).T, moments)


def cover_distance(X: Array) -> float:
    """Return how far a place of a triangle is from the nearest of some points, at most.

    The triangle is equilateral, and the distance is over its side.

    Parameters
    ----------
    X
        (n, 2) points in the reference triangle.
    """
    n = COVER_DIVISIONS
    lattice = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
    equilateral = np.array([[1.0, 0.0], [0.5, np.sqrt(3) / 2]])
    distances = np.linalg.norm((lattice[:, None] - X) @ equilateral, axis=2)
    return float(distances.min(axis=1).max()) + 1 / n

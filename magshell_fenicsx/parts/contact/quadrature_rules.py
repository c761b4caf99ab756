"""Quadrature rules for contact: in triangles, also with points on an edge and at its corners, and
on lines.

The reference triangle has the corners (0, 0), (1, 0) and (0, 1); its third side is opposite to the
first corner. Gauss's rule has no points at the ends of [0, 1], Radau's has one, Lobatto's has both.
Here such a point is `EDGE_OFFSET` before the end.
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
    """Return points (n, 2) and weights (n,) in the reference triangle, exact to a degree."""
    return basix.make_quadrature(basix.CellType.triangle, degree)  # type: ignore[no-any-return]


@cache
def edge_rule(degree: int, turning_ends: int = 0, corner: float = 0.0) -> tuple[Array, Array]:
    """Return a rule for a triangle whose third side is an edge: points (n, 2) and weights (n,).

    It is exact to the degree and has points next to the side opposite to the first corner, so that
    an edge there has points. On lines from that corner the rule is Radau's, with the distance from
    the corner as weight. Its last point is `EDGE_OFFSET` before the side: an edge often lies
    exactly opposite another one, where the second derivative of the gap jumps. Along the side the
    points are Gauss's, so that none is opposite a corner, where several cells meet.

    Parameters
    ----------
    turning_ends
        Where the edge turns: 1 at the begin of the side, 2 at the end, 3 at both, 0 nowhere.
    corner
        Distance over the side's length of a further point on it from each turning end.
    """
    # t goes along lines from the first corner, from 0 there to 1 on the third side; the area
    # element has the weight t
    t, weights_t = _rule_with_points((degree + 1) // 2, fixed_points=[1 - EDGE_OFFSET], power=1)
    # points near the turning ends of the side, on [0, 1] along it
    turns_at_begin, turns_at_end = turning_ends & 1, turning_ends & 2
    fixed_points = [corner] if turns_at_begin else []
    if turns_at_end:
        fixed_points.append(1 - corner)
    # n free and m fixed points are exact to the degree 2 n + m - 1
    inner_line = _rule_with_points((degree + 2) // 2, fixed_points=[], power=0)
    last_line = _rule_with_points((degree + 2 - len(fixed_points)) // 2, fixed_points, power=0)
    places, weights = list[Array](), list[Array]()
    for position, weight in zip(t, weights_t, strict=True):
        # s goes across the lines, parallel to the side; at the last t the points are next to it
        s, weights_s = last_line if position == t[-1] else inner_line
        places.append(np.stack([position * (1 - s), position * s], axis=1))
        weights.append(weight * weights_s)
    return np.concatenate(places), np.concatenate(weights)


def line_rule(count: int, begins: bool, ends: bool) -> tuple[Array, Array]:
    """Return points (n,) and weights (n,) on [0, 1]: Gauss's rule, or Radau's or Lobatto's.

    Radau's rule has a point `EDGE_OFFSET` before one end, Lobatto's before both ends.

    Parameters
    ----------
    count
        Number of points.
    begins, ends
        Whether a point is next to the begin, and to the end.
    """
    from scipy.special import roots_jacobi  # takes long to import

    # inner points on [-1, 1]: roots of the polynomial for the weight (1 - x) and (1 + x) of the
    # ends that are points; these factors are then divided out
    x, w = roots_jacobi(count - begins - ends, float(ends), float(begins))
    w = w / ((1 - x) ** int(ends) * (1 + x) ** int(begins))
    # the weight of an end point on [-1, 1]: Lobatto's, else Radau's
    end_weight = 2 / (count * (count - 1)) if begins and ends else 2 / count**2
    x = np.concatenate([[-1 + 2 * EDGE_OFFSET] * begins, x, [1 - 2 * EDGE_OFFSET] * ends])
    w = np.concatenate([[end_weight] * begins, w, [end_weight] * ends])
    return (x + 1) / 2, w / 2


def _rule_with_points(count: int, fixed_points: Sequence[float], power: int) -> tuple[Array, Array]:
    """Return points and weights on [0, 1] of the highest degree, for the weight x^power.

    The free points are the roots of a polynomial. It is orthogonal to all lower ones, by the weight
    times the polynomial that is zero at the fixed points. G. H. Golub, SIAM Review 15 (1973)
    318-334.

    Parameters
    ----------
    count
        Number of free points.
    fixed_points
        Further points.
    power
        Exponent of the weight.
    """
    legendre = np.polynomial.legendre.legvander  # Legendre's polynomials at places, as columns
    point_count = count + len(fixed_points)
    # Gauss's rule on [-1, 1], with enough points for all integrals below; `weight` has that of the
    # rule on [0, 1] times x^power
    x, w = scipy.special.roots_legendre(2 * count + 4)
    weight = w / 2 * ((1 + x) / 2) ** power
    # the weight times the polynomial that is zero at the fixed points
    weight_of_roots = weight * np.prod([(1 + x) / 2 - point for point in fixed_points], axis=0)
    # its integral is made positive, as the eigenvalue problem needs
    polynomials = legendre(x, count - 1)
    weighted_polynomials = np.sign(weight_of_roots.sum()) * weight_of_roots[:, None] * polynomials
    # the roots are eigenvalues of the multiplication by x among polynomials of lower degree
    free_points = scipy.linalg.eigh(
        polynomials.T @ (x[:, None] * weighted_polynomials),
        polynomials.T @ weighted_polynomials,
        eigvals_only=True,
    )
    points = np.sort([*((1 + free_points) / 2), *fixed_points])
    # weights that integrate as many of Legendre's polynomials exactly as there are points
    moments = legendre(x, point_count - 1).T @ weight
    return points, np.linalg.solve(legendre(2 * points - 1, point_count - 1).T, moments)


def cover_distance(X: Array) -> float:
    """Return the largest distance of a place of a triangle from the nearest of some points.

    The triangle is equilateral, and the distance is over its side. It is an upper bound.

    Parameters
    ----------
    X
        (n, 2) points in the reference triangle.
    """
    n = COVER_DIVISIONS
    lattice = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
    equilateral = np.array([[1.0, 0.0], [0.5, np.sqrt(3) / 2]])
    distances = np.linalg.norm((lattice[:, None] - X) @ equilateral, axis=2)
    return float(distances.min(axis=1).max()) + 1 / n  # a place is nearer than 1/n to the lattice

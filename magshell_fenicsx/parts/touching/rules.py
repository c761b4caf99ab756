"""Rules of quadrature for contact: in triangles, also with points on an edge and at its corners,
and on lines.
"""

from collections.abc import Sequence
from functools import cache

import basix
import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
BEFORE = 1e-5  # of the height of a cell: how far the points of its edge are inside
FINE = 60  # parts of a side, at whose ends the distance from a rule's points is measured


def inner_rule(degree: int) -> tuple[Array, Array]:
    """Points in the reference triangle and weights, exact for polynomials of this degree."""
    return basix.make_quadrature(basix.CellType.triangle, degree)  # type: ignore[no-any-return]


@cache
def ending_rule(degree: int, turns: int = 0, corner: float = 0.0) -> tuple[Array, Array]:
    """The same with points beside the side opposite to the first corner, so that an edge there has
    points.

    On lines from that corner the points are Radau's, for the weight of their distance from it, with
    one `BEFORE` the side: an edge often lies exactly opposite another one, where the second
    derivative of the gap jumps. Along the side they are Gauss's, so that none is opposite a corner,
    where several cells meet. Where the edge turns, at the begin of the side if `turns` is 1, at the
    end if 2, at both if 3, one on it is a part `corner` of the side before that.
    """
    t, by_t = _with_points((degree + 1) // 2, [1 - BEFORE], 1)
    given = [at for at, there in ((corner, 1), (1 - corner, 2)) if turns & there]
    inside, on_side = (_with_points((degree + 2 - len(at)) // 2, at, 0) for at in ([], given))
    sides = [inside] * (len(t) - 1) + [on_side]
    X = [np.stack([at * (1 - s), at * s], axis=1) for at, (s, _) in zip(t, sides, strict=True)]
    return np.concatenate(X), np.concatenate(
        [by * by_s for by, (_, by_s) in zip(by_t, sides, strict=True)]
    )


def rule_on_line(count: int, begins: bool, ends: bool) -> tuple[Array, Array]:
    """Points and weights on [0, 1]: Gauss's, or Radau's and Lobatto's with points next to ends."""
    from scipy.special import roots_jacobi  # takes long to import

    x, w = roots_jacobi(count - begins - ends, float(ends), float(begins))
    w = w / ((1 - x) ** int(ends) * (1 + x) ** int(begins))
    end = 2 / (count * (count - 1)) if begins and ends else 2 / count**2
    x = np.concatenate([[-1 + 2 * BEFORE] * begins, x, [1 - 2 * BEFORE] * ends])
    w = np.concatenate([[end] * begins, w, [end] * ends])
    return (x + 1) / 2, w / 2


def _with_points(count: int, given: Sequence[float], power: int) -> tuple[Array, Array]:
    """Points from 0 to 1 and weights for the weight x^power, of highest degree with `count` points
    beside given ones.

    Those are the roots of a polynomial that is orthogonal to all lower ones, in Legendre's, by the
    weight times what is zero at the given ones. G. H. Golub, SIAM Review 15 (1973) 318-334.
    """
    x, w = scipy.special.roots_legendre(2 * count + 4)
    legendre, number = np.polynomial.legendre.legvander, count + len(given)
    weight = w / 2 * ((1 + x) / 2) ** power
    P, signed = legendre(x, count - 1), weight * np.prod([(1 + x) / 2 - at for at in given], axis=0)
    signed = np.sign(signed.sum()) * signed[:, None] * P
    free = scipy.linalg.eigh(P.T @ (x[:, None] * signed), P.T @ signed, eigvals_only=True)
    points = np.sort([*((1 + free) / 2), *given])
    return points, np.linalg.solve(
        legendre(2 * points - 1, number - 1).T, legendre(x, number - 1).T @ weight
    )


def covers(X: Array) -> float:
    """How far the farthest place of an equilateral triangle is from the nearest of some points,
    over its side.
    """
    lattice = np.array([(i, j) for i in range(FINE + 1) for j in range(FINE + 1 - i)]) / FINE
    equal = np.array([[1.0, 0.0], [0.5, np.sqrt(3) / 2]])
    return (
        float(np.linalg.norm((lattice[:, None] - X) @ equal, axis=2).min(axis=1).max()) + 1 / FINE
    )

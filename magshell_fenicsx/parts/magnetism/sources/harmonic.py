"""The derivatives of a field outside its sources, from its values.

There B has neither a divergence nor a curl, so around any place it is the gradient of a series of harmonic
polynomials. The values at the place itself, at six points on the axes and at eight on the diagonals of a cube, all at
the distance a, determine the first and second derivatives exactly if the series ends at degree 5. What is left out is
of order (a/d)^4, with the distance d from the nearest source; rounding is of order (d/a)^2. With a = 0.005 d both are
1e-9 of the derivatives of a cylinder magnet, measured against 27 points at 0.03 d.
"""

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.sources.known import Values

Array = NDArray[np.float64]
STEP, DEGREE = 0.005, 5


@dataclass(frozen=True)
class Harmonic:
    """A field with its derivatives, of its values alone.

    Attributes
    ----------
    values
        Places (n, 3) -> B (n, 3).
    distance
        Places (n, 3) -> distance (n,) from the nearest source, negative inside a magnet, where the field is nan.
    """

    values: Values
    distance: Values

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        d = self.distance(x)
        outside = np.isfinite(d) & (d > 0)
        B, G, H = (np.full((len(x), *shape), np.nan) for shape in ((3,), (3, 3), (3, 3, 3)))
        if not outside.any():
            return B, G, H
        points, first, second = stencil()
        step = STEP * d[outside]
        found = self.values((x[outside, None] + step[:, None, None] * points).reshape(-1, 3))
        flat = np.reshape(found, (len(step), 3 * len(points)))
        B[outside] = flat[:, :3]
        G[outside] = (flat @ first / step[:, None]).reshape(-1, 3, 3)
        H[outside] = (flat @ second / step[:, None] ** 2).reshape(-1, 3, 3, 3)
        return B, G, H


@cache
def stencil() -> tuple[Array, Array, Array]:
    """Points (m, 3) at the distance 0 or 1, and what makes derivatives of the values there: (3 m, 9) and (3 m, 27).

    The gradients of the powers (a . x)^l of null vectors a are those of all harmonic polynomials of degree l.
    """
    axes, diagonals = np.vstack([np.eye(3), -np.eye(3)]), np.array([*product((-1.0, 1.0), repeat=3)]) / np.sqrt(3)
    points = np.vstack([np.zeros((1, 3)), axes, diagonals])
    values, first, second = list[Array](), list[Array](), list[Array]()
    for degree in range(1, DEGREE + 1):
        for t in 2 * np.pi * np.arange(2 * degree + 1) / (2 * degree + 1):
            a = np.array([np.cos(t), np.sin(t), 1j])
            power = np.ones(len(points)) if degree == 1 else (points @ a) ** (degree - 1)
            rows = np.outer(power, a).ravel(), 2.0 * (degree == 2) * np.outer(a, a).ravel()
            third = 6.0 * (degree == 3) * np.einsum("i,j,k->ijk", a, a, a).ravel()
            for part in (np.real, np.imag):
                for known, row in zip((values, first, second), (degree * rows[0], rows[1], third), strict=True):
                    known.append(part(row))
    inverse = np.linalg.pinv(np.array(values), rcond=1e-10)
    first_weights, second_weights = (np.asarray(inverse @ np.array(rows), dtype=float) for rows in (first, second))
    return points, first_weights, second_weights

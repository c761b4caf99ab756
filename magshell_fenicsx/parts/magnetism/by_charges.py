"""Derivatives of the energy of charges, and of its forces along a displacement, by the charges themselves.

The energy W = sum of q_i q_j/|x_i - x_j| has dW/dq_i = sum of q_j/|x_i - x_j|, and of v . dW/du the rate of that along
v. Places are found with rates of nodes as imaginary parts, times a step so small that their own are exact to rounding
(W. Squire, G. Trapp, SIAM Review 40, 1998, 110).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.pairs import Points

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Ints = NDArray[np.int64]
STEP = 1e-30  # of the imaginary part
CHUNK = 400_000  # pairs of charges at once


@dataclass(frozen=True)
class Weights:
    """What is asked for: `energy` times W and `force` times v . dW/du."""

    energy: float
    force: float


def places(points: Points, rows: Ints, nodes: Complex) -> tuple[Complex, Complex, Complex]:
    """Of points of elements `rows` on cells with nodes (n, k, 3): r, n and x (n, P, .., layers, 3)."""
    T = np.moveaxis(points.tables, -2, 0)
    flat = np.ascontiguousarray(nodes.transpose(1, 0, 2)).view(np.float64).reshape(nodes.shape[1], -1)
    r, a1, a2 = (
        np.moveaxis(
            (each.reshape(-1, each.shape[-1]) @ flat).view(np.complex128).reshape(-1, *nodes.shape[::2]), 1, 0
        ).reshape(len(nodes), *each.shape[:-1], 3)
        for each in T
    )
    m = np.cross(a1, a2)
    n = m / np.sqrt(np.sum(m * m, axis=-1, keepdims=True))
    heights = points.t[rows][..., None] * points.heights
    return r, n, r[..., None, :] + heights[..., None] * n[..., None, :]


def add(
    nodes: Complex, cells: Ints, left: tuple[Points, Ints], right: tuple[Points, Ints], weights: Weights
) -> tuple[Array, Array]:
    """Derivatives by the charges of the left and of the right points, like `Points.q`, of sums over pairs (n, 2)."""
    one, other = (np.zeros_like(points.q) for points, _ in (left, right))
    same = right[0].tables.ndim == 3
    size = left[0].q[0].size * (right[0].q[0].size if same else right[0].q[0, 0].size)
    step = max(1, CHUNK // size)
    for first in range(0, len(cells), step):
        some = slice(first, first + step)
        x, y = (places(of, rows[some], nodes[cells[some, i]])[2] for i, (of, rows) in enumerate((left, right)))
        n, P = x.shape[:2]
        x, y = (np.moveaxis(each.reshape(n, 1 if same else P, -1, 3), -1, 0)[:, :, :, :, None] for each in (x, y))
        along = [
            a - b.swapaxes(2, 3) for a, b in zip(*(np.ascontiguousarray(each.real) for each in (x, y)), strict=True)
        ]
        rate = [a - b.swapaxes(2, 3) for a, b in zip(*(each.imag / STEP for each in (x, y)), strict=True)]
        inverse = 1 / np.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)  # (n, 1 or P, left, right)
        rising = along[0] * rate[0] + along[1] * rate[1] + along[2] * rate[2]
        seen = weights.energy * inverse - weights.force * inverse**2 * inverse * rising
        q, p = (of.q[rows[some]].reshape(n, inverse.shape[1], -1) for of, rows in (left, right))
        np.add.at(one, left[1][some], (seen @ p[..., None])[..., 0].reshape(n, *one.shape[1:]))
        np.add.at(other, right[1][some], (q[..., None, :] @ seen)[..., 0, :].reshape(n, *other.shape[1:]))
    return one, other

"""Derivatives of the energy of charges, and of its forces along a displacement, by the charges and
by their heights.

The energy W = sum of q_i q_j/|x_i - x_j| has dW/dq_i = sum of q_j/|x_i - x_j|, and of v . dW/du the
rate of that along v. Places are found with rates of nodes as imaginary parts, times a step so small
that their own are exact to rounding (W. Squire, G. Trapp, SIAM Review 40, 1998, 110).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.magnetised_cells import STEP
from magshell_fenicsx.parts.magnetism.pairs import Points

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Ints = NDArray[np.int64]
Elements = tuple[Points, Ints]  # points on elements of a kind, and the rows of these
Placed = tuple[
    list[Complex], list[Complex]
]  # components (n, 1 or P, charges) of places and of normals
CHUNK = 400_000  # pairs of charges at once


@dataclass(frozen=True)
class Weights:
    """What is asked for: `energy` times W and `force` times v . dW/du."""

    energy: float
    force: float


def places(points: Points, rows: Ints, nodes: Complex) -> tuple[Complex, Complex, Complex]:
    """Of points of elements `rows` on cells with nodes (n, k, 3): r, n and x (n, P, .., layers, 3)."""
    T = np.moveaxis(points.tables, -2, 0)
    flat = (
        np.ascontiguousarray(nodes.transpose(1, 0, 2)).view(np.float64).reshape(nodes.shape[1], -1)
    )
    r, a1, a2 = (
        np.moveaxis(
            (each.reshape(-1, each.shape[-1]) @ flat)
            .view(np.complex128)
            .reshape(-1, *nodes.shape[::2]),
            1,
            0,
        ).reshape(len(nodes), *each.shape[:-1], 3)
        for each in T
    )
    m = np.cross(a1, a2)
    n = m / np.sqrt(np.sum(m * m, axis=-1, keepdims=True))
    heights = points.t[rows][..., None] * points.heights
    return r, n, r[..., None, :] + heights[..., None] * n[..., None, :]


def add(
    nodes: Complex,
    cells: Ints,
    left: Elements,
    right: Elements,
    weights: Weights,
    *,
    heights: bool = False,
) -> tuple[Array, Array]:
    """Derivatives by the charges of the left and of the right points, like `Points.q`, of sums over
    pairs (n, 2).

    Or those by the `heights` of the charges over the mid-surface.
    """
    one, other = (np.zeros_like(points.q) for points, _ in (left, right))
    same = right[0].tables.ndim == 3
    size = left[0].q[0].size * (right[0].q[0].size if same else right[0].q[0, 0].size)
    step, found = (
        max(1, CHUNK // (4 * size if heights else size)),
        _by_heights if heights else _by_charges,
    )
    for first in range(0, len(cells), step):
        some = slice(first, first + step)
        x, y = (
            _along(of, rows[some], nodes[cells[some, i]], same)
            for i, (of, rows) in enumerate((left, right))
        )
        q, p = (
            of.q[rows[some]].reshape(*z[0][0].shape) for (of, rows), z in ((left, x), (right, y))
        )
        for total, (_, rows), on in zip(
            (one, other), (left, right), found(x, y, q, p, weights), strict=True
        ):
            np.add.at(total, rows[some], on.reshape(len(on), *total.shape[1:]))
    return one, other


def _by_charges(x: Placed, y: Placed, q: Array, p: Array, weights: Weights) -> tuple[Array, Array]:
    parts = [[(np.ascontiguousarray(c.real), c.imag / STEP) for c in each[0]] for each in (x, y)]
    along, rate = (
        [a[i][..., :, None] - b[i][..., None, :] for a, b in zip(*parts, strict=True)]
        for i in range(2)
    )  # (n, 1 or P, left, right)
    inverse = 1 / np.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
    rising = along[0] * rate[0] + along[1] * rate[1] + along[2] * rate[2]
    seen = weights.energy * inverse - weights.force * inverse**2 * inverse * rising
    return (seen @ p[..., None])[..., 0], (q[..., None, :] @ seen)[..., 0, :]


def _by_heights(x: Placed, y: Placed, q: Array, p: Array, weights: Weights) -> tuple[Array, Array]:
    d = [a[..., :, None] - b[..., None, :] for a, b in zip(x[0], y[0], strict=True)]
    square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    share = 1 / (square * np.sqrt(square))
    on_one, on_other = np.zeros(q.shape, complex), np.zeros(p.shape, complex)
    for each, n, m in zip(d, x[1], y[1], strict=True):
        force = share * each
        on_one -= n * (force @ p[..., None])[..., 0]
        on_other += m * (q[..., None, :] @ force)[..., 0, :]
    one, other = (
        weights.energy * on.real + weights.force * on.imag / STEP
        for on in (q * on_one, p * on_other)
    )
    return one, other


def _along(points: Points, rows: Ints, nodes: Complex, same: bool) -> Placed:
    _, n, x = places(points, rows, nodes)
    shape = len(x), 1 if same else x.shape[1], -1, 3
    each = x.reshape(shape), np.broadcast_to(n[..., None, :], x.shape).reshape(shape)
    return [each[0][..., i] for i in range(3)], [each[1][..., i] for i in range(3)]

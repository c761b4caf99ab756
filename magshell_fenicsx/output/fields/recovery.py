"""Strains, moments and stresses recovered at nodes, and the parts of a surface within which they
are smooth.
"""

from collections.abc import Mapping

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.strains import TangentFrame
from magshell_fenicsx.output.fields.point_fields import in_frame, in_space, principal_fields

Array = NDArray[np.float64]
ROUNDING = {"E": 1e-13, "M": 1e-8}  # smaller strains and moments are zero, up to rounding


def relative_jump(values: Array, continuous: Array, weight: Array, zero: float = 0.0) -> float:
    """The weighted rms of the difference between the cells' values and continuous ones, over the
    rms of the values.

    Parameters
    ----------
    values, continuous
        (cells, points, ...)
    weight
        (cells, points)
    zero
        Of values no larger than this there is none.

    Examples
    --------
    >>> round(relative_jump(np.array([[3.0, 5.0], [3.0, 5.0]]), np.full((2, 2), 4.0), np.ones((2, 2))), 3)
    0.243
    """

    def mean_square(f: Array) -> float:
        squared = (f**2).reshape(*weight.shape, -1).sum(axis=-1)
        return float((weight * squared).sum() / weight.sum())

    size = np.sqrt(mean_square(values))
    return float(np.sqrt(mean_square(values - continuous)) / size) if size > zero else 0.0


Numbers = NDArray[np.int64]
SECOND = (
    0.03  # weight of the second ring of cells around a vertex at an edge, where the first has few
)
ENOUGH = 1.2  # samples over coefficients of a polynomial, at least
RIDGE = 1e-10  # keeps fits regular whose samples lie on few lines


class Recovery:
    """Fits a polynomial around each vertex, and blends those of a cell's vertices with barycentric
    weights.

    So the result is continuous where cells share vertices, and polynomials are reproduced. Around a
    vertex at an edge the second ring of cells has a small weight.

    Parameters
    ----------
    cells
        (m, d + 1) numbers of vertices, all of 0, 1, ...; cells of two smooth parts share none.
    samples, weight
        (m, q, k) places in each cell, and (m, q) their weights.
    vertices
        (v, k) places.
    frames
        (v, d, k) axes of the polynomial's d coordinates around each vertex.
    degree
        Of the polynomials.
    """

    def __init__(
        self,
        cells: Numbers,
        samples: Array,
        weight: Array,
        vertices: Array,
        frames: Array,
        degree: int,
    ) -> None:
        self._cells, self._vertices, self._frames, self._degree = cells, vertices, frames, degree
        self._count = len(_powers(cells.shape[1] - 1, degree))
        self._size = np.ones(len(vertices))
        near, share = _patches(cells, len(vertices))
        many = np.diff(near.indptr)
        of_row = np.repeat(
            many * weight.shape[1], self._count
        )  # a row for each coefficient of each vertex
        starts = np.concatenate([[0], np.cumsum(of_row)])
        columns, values = np.zeros(starts[-1], np.int32), np.zeros(starts[-1])
        for number in np.unique(many):
            at = np.flatnonzero(many == number)
            each = near.indptr[at][:, None] + np.arange(number)
            fit = self._fit(
                at, samples[near.indices[each]], weight[near.indices[each]] * share[each][..., None]
            )
            sample = near.indices[each][..., None] * weight.shape[1] + np.arange(weight.shape[1])
            places = starts[at * self._count][:, None] + np.arange(self._count * sample[0].size)
            columns[places] = np.tile(sample.reshape(len(at), -1), self._count)
            values[places[:, : fit[0].size]] = fit.reshape(len(at), -1)
        shape = len(vertices) * self._count, weight.size
        self._coefficients = scipy.sparse.csr_matrix((values, columns, starts), shape)

    def coefficients(self, values: Array) -> Array:
        """Those of all polynomials, of values (m, q, ...) at the samples."""
        return np.asarray(self._coefficients @ values.reshape(self._coefficients.shape[1], -1))

    def at(self, cell: Numbers, places: Array, barycentric: Array) -> "scipy.sparse.csr_matrix":
        """From coefficients to values at places (n, k) in cells (n,) with barycentric coordinates
        (n, d + 1).
        """
        vertex = self._cells[cell]
        y = np.einsum(
            "nvdk,nvk->nvd", self._frames[vertex], places[:, None] - self._vertices[vertex]
        )
        values = (
            _monomials(y / self._size[vertex][..., None], self._degree) * barycentric[..., None]
        )
        columns = vertex[..., None] * self._count + np.arange(self._count)
        starts = np.arange(len(cell) + 1) * columns[0].size
        return scipy.sparse.csr_matrix(
            (values.ravel(), columns.ravel(), starts),
            (len(cell), len(self._vertices) * self._count),
        )

    def _fit(self, at: Numbers, samples: Array, weight: Array) -> Array:
        """From the samples (n, cells, q, k) around vertices to coefficients: (n, coefficients,
        samples).
        """
        n = len(at)
        relative = samples.reshape(n, -1, samples.shape[-1]) - self._vertices[at][:, None]
        y = relative @ np.swapaxes(self._frames[at], 1, 2)
        self._size[at] = np.abs(y).max(axis=(1, 2))
        degree = self._degree
        while degree and ENOUGH * len(_powers(y.shape[-1], degree)) > y.shape[1]:
            degree -= 1
        P = _monomials(y / self._size[at][:, None, None], degree)
        weight = weight.reshape(n, -1)
        root = np.sqrt(weight / weight.sum(axis=1, keepdims=True))[..., None]
        ridge = np.broadcast_to(RIDGE * np.eye(P.shape[-1]), (n, P.shape[-1], P.shape[-1]))
        Q, triangle = np.linalg.qr(
            np.concatenate([root * P, ridge], axis=1)
        )  # of a small condition
        return np.asarray(np.linalg.solve(triangle, np.swapaxes(Q[:, : P.shape[1]] * root, 1, 2)))


def _patches(cells: Numbers, count: int) -> tuple["scipy.sparse.csr_matrix", Array]:
    """The cells around each vertex as a sparse pattern, and the weight of each in its order."""
    m, corners = cells.shape
    sharing = scipy.sparse.csr_matrix(
        (np.ones(cells.size), (cells.ravel(), np.repeat(np.arange(m), corners))), (count, m)
    )
    sides = np.concatenate([np.delete(cells, i, axis=1) for i in range(corners)])
    sides, times = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    border = np.zeros(count)
    border[sides[times == 1]] = 1.0
    farther = scipy.sparse.diags(border) @ (sharing @ (sharing.T @ sharing))
    farther.data[:] = SECOND
    both = (sharing + farther).tocsr()
    return both, np.where(both.data > SECOND, 1.0, SECOND)


def _powers(dimensions: int, degree: int) -> list[tuple[int, ...]]:
    """Exponents of all monomials, those of low degree first."""
    if dimensions == 1:
        return [(n,) for n in range(degree + 1)]
    return [(i, n - i) for n in range(degree + 1) for i in range(n + 1)]


def _monomials(y: Array, degree: int) -> Array:
    """Values (..., coefficients) at y (..., d)."""
    along = [np.stack([x**n for n in range(degree + 1)], axis=-1) for x in np.moveaxis(y, -1, 0)]
    return np.stack(
        [
            np.prod([a[..., n] for a, n in zip(along, powers, strict=True)], axis=0)
            for powers in _powers(len(along), degree)
        ],
        axis=-1,
    )


UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])  # the components of a symmetric tensor
WHOLE = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
TWICE = np.sqrt([1.0, 2, 2, 1, 2, 1])  # so that the sum of squares is that of all nine


class RecoveredShell:
    """Takes tensors from samples to nodes.

    Parameters
    ----------
    numbers
        (m, s) nodes of all cells, corners first; smooth parts share none.
    reference
        (s, 2) their places in the reference cell.
    nodes, normals
        (m, s, 3) places and undeformed normals there.
    samples, weight
        (m, q, 3) places and (m, q) weights.
    table
        (q, s) values of the nodes' shape functions at the samples.
    degree
        Of the displacement, and of the polynomials that are fitted.
    """

    def __init__(
        self,
        numbers: NDArray[np.int64],
        reference: Array,
        nodes: Array,
        normals: Array,
        samples: Array,
        weight: Array,
        table: Array,
        degree: int,
    ) -> None:
        vertices, corners = np.unique(numbers[:, :3], return_inverse=True)
        corners = corners.reshape(-1, 3)
        place, normal = np.zeros((2, len(vertices), 3))
        place[corners] = nodes[:, :3]
        np.add.at(normal, corners, normals[:, :3])
        self._recovery = Recovery(corners, samples, weight, place, frames(normal), degree)
        _, first = np.unique(numbers, return_index=True)
        cell, node = np.divmod(first, numbers.shape[1])
        barycentric = np.column_stack([1 - reference.sum(axis=1), reference])[node]
        self._to_nodes = self._recovery.at(cell, nodes[cell, node], barycentric)
        self._numbers, self._weight, self._table = numbers, weight, table

    def fields(
        self, tensors: Mapping[str, Array], n0: Array
    ) -> tuple[dict[str, Array], dict[str, float]]:
        """E, M, ... at the nodes with normals n0 (n, 3), their principal values, by how much
        samples differ.

        Parameters
        ----------
        tensors
            Name -> (m, q, 6) at the samples, see `six`.
        """
        fit = self._recovery.coefficients(np.concatenate(list(tensors.values()), axis=-1))
        at_nodes = dict(
            zip(tensors, np.split(self._to_nodes @ fit, len(tensors), axis=-1), strict=True)
        )
        jumps = {
            name: relative_jump(
                tensors[name], self._table @ at_nodes[name][self._numbers], self._weight, zero
            )
            for name, zero in ROUNDING.items()
        }
        t = frames(n0)
        components = {
            name: in_frame((values / TWICE)[..., WHOLE], t) for name, values in at_nodes.items()
        }
        smooth = {name: in_space(S, t) for name, S in components.items()}
        return smooth | principal_fields(components), jumps


def six(frame: TangentFrame) -> Array:
    """(..., 6, 3) from S_11, S_12, S_22 in a frame to the components of a tensor in space, times
    `TWICE`.
    """
    return np.asarray(frame.in_space[..., *UPPER, :] * TWICE[:, None])


def frames(normals: Array) -> Array:
    """Two unit vectors (n, 2, 3) across each of some vectors (n, 3)."""
    n = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    t1 = np.cross(n, np.where(np.abs(n[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    t1 /= np.linalg.norm(t1, axis=-1, keepdims=True)
    return np.stack([t1, np.cross(n, t1)], axis=1)


JUMP = 1e-3  # of a given field over its largest value
KINK = 0.5  # jump of the normal, some 30 degrees: less is a facet


def smooth_parts(corners: Numbers, sides: Numbers, given: list[Array], normals: Array) -> Numbers:
    """The number of the part to which each cell belongs.

    Parameters
    ----------
    corners
        (m, s) numbers of the nodes of the cells.
    sides
        (e, j) which of these nodes are on each side.
    given
        (m, s, ...) fields at the nodes.
    normals
        (m, s, 3)
    """
    count = len(corners)
    on = corners[:, sides].reshape(-1, sides.shape[1])  # nodes of all sides, cell after cell
    order = np.argsort(on, axis=1)
    key = np.take_along_axis(on, order, axis=1)
    _, first, which, times = np.unique(
        key, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    which = which.ravel()
    twins = np.flatnonzero((times[which] == 2) & (first[which] != np.arange(len(on))))
    pair = np.column_stack([first[which[twins]], twins])

    def jumps(field: Array) -> Array:
        """The largest jump of a field at the nodes of each shared side."""
        values = field.reshape(count, corners.shape[1], -1)[:, sides].reshape(*on.shape, -1)
        one, other = np.take_along_axis(values, order[..., None], axis=1)[pair.T]
        return np.asarray(np.abs(one - other).max(axis=(1, 2)))

    kink = jumps(normals)
    apart = kink > KINK
    for field in given:
        largest = np.abs(field).max() or 1.0
        apart |= jumps(field) > largest * (
            JUMP + 2 * kink
        )  # a field along the normal turns with facets
    a, b = (pair[~apart] // len(sides)).T
    together = scipy.sparse.coo_matrix((np.ones(len(a)), (a, b)), (count, count))
    return np.asarray(
        scipy.sparse.csgraph.connected_components(together, directed=False)[1], np.int64
    )


def split(numbers: Numbers, parts: Numbers) -> Numbers:
    """The nodes (m, s) of cells, renumbered so that each part has its own.

    Examples
    --------
    >>> split(np.array([[0, 1], [1, 2]]), np.array([0, 1])).tolist()
    [[0, 1], [2, 3]]
    """
    if not parts.any():
        return numbers
    key = np.column_stack([np.repeat(parts, numbers.shape[1]), numbers.ravel()])
    return np.unique(key, axis=0, return_inverse=True)[1].reshape(numbers.shape).astype(np.int64)

"""Smooth fields from fields that jump between cells: superconvergent patch recovery."""

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
SECOND = 0.03  # weight of the second ring of cells around a vertex at an edge, where the first has few
ENOUGH = 1.2  # samples over coefficients of a polynomial, at least
RIDGE = 1e-10  # keeps fits regular whose samples lie on few lines


class Recovery:
    """Fits a polynomial around each vertex, and blends those of a cell's vertices with barycentric weights.

    So the result is continuous where cells share vertices, and polynomials are reproduced. Around a vertex at an edge
    the second ring of cells has a small weight.

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
        self, cells: Numbers, samples: Array, weight: Array, vertices: Array, frames: Array, degree: int
    ) -> None:
        self._cells, self._vertices, self._frames, self._degree = cells, vertices, frames, degree
        self._count = len(_powers(cells.shape[1] - 1, degree))
        self._size = np.ones(len(vertices))
        near, share = _patches(cells, len(vertices))
        many = np.diff(near.indptr)
        of_row = np.repeat(many * weight.shape[1], self._count)  # a row for each coefficient of each vertex
        starts = np.concatenate([[0], np.cumsum(of_row)])
        columns, values = np.zeros(starts[-1], np.int32), np.zeros(starts[-1])
        for number in np.unique(many):
            at = np.flatnonzero(many == number)
            each = near.indptr[at][:, None] + np.arange(number)
            fit = self._fit(at, samples[near.indices[each]], weight[near.indices[each]] * share[each][..., None])
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
        """From coefficients to values at places (n, k) in cells (n,) with barycentric coordinates (n, d + 1)."""
        vertex = self._cells[cell]
        y = np.einsum("nvdk,nvk->nvd", self._frames[vertex], places[:, None] - self._vertices[vertex])
        values = _monomials(y / self._size[vertex][..., None], self._degree) * barycentric[..., None]
        columns = vertex[..., None] * self._count + np.arange(self._count)
        starts = np.arange(len(cell) + 1) * columns[0].size
        return scipy.sparse.csr_matrix(
            (values.ravel(), columns.ravel(), starts), (len(cell), len(self._vertices) * self._count)
        )

    def _fit(self, at: Numbers, samples: Array, weight: Array) -> Array:
        """From the samples (n, cells, q, k) around vertices to coefficients: (n, coefficients, samples)."""
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
        Q, triangle = np.linalg.qr(np.concatenate([root * P, ridge], axis=1))  # of a small condition
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

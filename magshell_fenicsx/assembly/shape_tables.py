"""Shape functions and their derivatives at points of the reference triangle and of its edges.

Fields are evaluated at the same points of all cells, and back, by matrix products.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import basix
import numpy as np
from dolfinx import mesh
from numpy.typing import NDArray

from magshell_fenicsx.assembly.point_kernels import Pair
from magshell_fenicsx.platform import compat

Array = NDArray[np.float64]
PARTS = 6  # value, two first and three second derivatives
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
EDGES = ((1, 2), (0, 2), (0, 1))


@dataclass(frozen=True)
class Table:
    """Derivatives of the shape functions at some points.

    Attributes
    ----------
    values
        (points, 6, functions): the shape functions, their derivatives by X, Y, XX, XY, YY.
    """

    values: Array

    @classmethod
    def tabulate(cls, element: basix.finite_element.FiniteElement, X: Array) -> "Table":
        return cls(np.ascontiguousarray(element.tabulate(2, X)[..., 0].transpose(1, 0, 2)))

    @cached_property
    def triangle(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Pairs a <= b of functions."""
        return np.triu_indices(self.values.shape[2])

    def jets(self, nodal: Array) -> Array:
        """(entities, points, 6, 3) from nodal vectors (entities, functions, 3)."""
        points, parts, functions = self.values.shape
        jets = np.matmul(self.values.reshape(-1, functions), nodal)
        return np.asarray(jets.reshape(len(nodal), points, parts, 3))

    def symmetric(self, w: Array, pairs: tuple[Pair, ...]) -> Array:
        """w (D_i D_j + D_j D_i) of functions a <= b, (points * pairs, functions (functions + 1)/2);
        once if i = j.
        """
        a, b = self.triangle
        D = self.values
        products = [D[:, i, a] * D[:, j, b] + (i < j) * D[:, j, a] * D[:, i, b] for i, j in pairs]
        return _flat(w, products)

    def skew(self, w: Array, pairs: tuple[Pair, ...]) -> Array:
        """w (D_i D_j - D_j D_i) of functions a <= b, (points * pairs, functions (functions + 1)/2)."""
        a, b = self.triangle
        D = self.values
        return _flat(w, [D[:, i, a] * D[:, j, b] - D[:, j, a] * D[:, i, b] for i, j in pairs])

    def cross(self, w: Array, other: "Table", pairs: tuple[Pair, ...]) -> Array:
        """w D_i D'_j of all functions a here and b there, (points * pairs, functions^2)."""
        products = [self.values[:, i, :, None] * other.values[:, j, None, :] for i, j in pairs]
        return _flat(w, [p.reshape(len(p), -1) for p in products])


def _flat(w: Array, products: list[Array]) -> Array:
    stacked = w[:, None, None] * np.stack(products, axis=1)
    return np.ascontiguousarray(stacked.reshape(-1, stacked.shape[2]))


def cell_rule(degree: int) -> tuple[Array, Array]:
    """Points (q, 2) and weights (q,), which sum to the reference triangle's area."""
    points, weights = basix.make_quadrature(basix.CellType.triangle, degree)
    return np.asarray(points), np.asarray(weights)


def edge_rule(degree: int, edge: int, backwards: bool) -> tuple[Array, Array]:
    """Points (q, 2) on an edge, from its first corner or from its last, and weights that sum to
    one.
    """
    x, weights = basix.make_quadrature(basix.CellType.interval, degree)
    start, end = CORNERS[list(EDGES[edge][:: -1 if backwards else 1])]
    return start + np.asarray(x) * (end - start), np.asarray(weights)


def edge_covector(edge: int) -> Array:
    """(2,), zero along an edge, positive outward and as long as the edge."""
    start, end = CORNERS[list(EDGES[edge])]
    along = end - start
    m = np.array([along[1], -along[0]])
    return m if m @ (CORNERS.mean(axis=0) - start) < 0 else -m


def cell_frames(domain: mesh.Mesh) -> Array:
    """(local cells, 4): p, q, s and the Jacobian determinant of each triangle in space.

    With X, Y the reference coordinates and x along the first edge, d/dx = p d/dX and d/dy = q d/dX
    + s d/dY.
    """
    corners = domain.geometry.x[compat.corner_numbers(domain)]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = np.linalg.norm(first, axis=1)
    along = first / length[:, None]
    shift = np.einsum("ci,ci->c", second, along)
    height = np.linalg.norm(second - shift[:, None] * along, axis=1)
    return np.column_stack([1 / length, -shift / (length * height), 1 / height, length * height])


class Sheet:
    """Some of a field's derivatives at points of every cell, in the order (cell; point, part,
    component).

    The table of shape functions is expanded to vectors. This triples the arithmetic but avoids
    sorting.

    Parameters
    ----------
    parts
        The chosen derivatives of a `Table`.
    """

    def __init__(self, table: Table, weights: Array, parts: Sequence[int]) -> None:
        D, one = table.values[:, list(parts)], np.eye(3)
        size = 3 * D.shape[2]
        self._there = np.einsum("qpf,cd->fcqpd", D, one).reshape(size, -1)
        self._back = np.einsum("q,qpf,cd->qpdfc", weights, D, one).reshape(-1, size)

    def at_points(self, nodal: Array, out: Array) -> None:
        """Write the values at the points to `out`, in any shape, from nodal vectors (cells,
        functions * 3).
        """
        np.matmul(nodal, self._there, out=out.reshape(-1, self._there.shape[1]))

    def at_nodes(self, gradients: Array) -> Array:
        """The weighted sum (cells, functions * 3) over points of gradients, in any shape."""
        return np.asarray(gradients.reshape(-1, len(self._back)) @ self._back)

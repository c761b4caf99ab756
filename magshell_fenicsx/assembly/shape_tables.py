"""Shape functions and their derivatives at points of the reference triangle and of its edges.

Fields are evaluated at the same points of all cells, and integrated back to nodes, by matrix
products. Theory: docs/tangent.md.

A jet is a field's value with its first and second derivatives by the reference coordinates X, Y.
D_i[a] is derivative i (0 to 5, the value is 0) of shape function a. An entity is a cell or an edge;
an edge may have two sides, its cells.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import basix
import numpy as np
from dolfinx import mesh
from numpy.typing import NDArray

from magshell_fenicsx.assembly.point_kernels import IndexPair
from magshell_fenicsx.platform import compat

Array = NDArray[np.float64]
JET_SIZE = 6  # value, two first and three second derivatives
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # of the reference triangle
EDGES = ((1, 2), (0, 2), (0, 1))  # corners of each edge, in the order of dolfinx


@dataclass(frozen=True)
class ShapeTable:
    """Shape functions and their derivatives D_i at some points.

    Attributes
    ----------
    values
        (points, 6, functions): the shape functions, and their derivatives by X, Y, XX, XY, YY.
    """

    values: Array

    @classmethod
    def tabulate(cls, element: basix.finite_element.FiniteElement, X: Array) -> "ShapeTable":
        """Return the table of an element at points X (points, 2)."""
        return cls(np.ascontiguousarray(element.tabulate(2, X)[..., 0].transpose(1, 0, 2)))

    @cached_property
    def triangle(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The pairs a <= b of functions, as two arrays of indices."""
        return np.triu_indices(self.values.shape[2])

    def jets(self, nodal: Array) -> Array:
        """Return the values and derivatives of vector fields at the points: their jets.

        Parameters
        ----------
        nodal
            (entities, functions, 3): nodal vectors of cells or edges.

        Returns
        -------
        Array
            (entities, points, 6, 3).
        """
        points, derivatives, functions = self.values.shape
        jets = np.matmul(self.values.reshape(-1, functions), nodal)
        return np.asarray(jets.reshape(len(nodal), points, derivatives, 3))

    def symmetric(self, w: Array, pairs: tuple[IndexPair, ...]) -> Array:
        """Return w (D_i[a] D_j[b] + D_j[a] D_i[b]) of functions a <= b; half as much if i = j.

        Parameters
        ----------
        w
            (points,): weights.
        pairs
            The pairs i <= j of derivatives, by their numbers in the table, 0 to 5.

        Returns
        -------
        Array
            (points * pairs, functions (functions + 1)/2).
        """
        a, b = self.triangle
        D = self.values
        # (i < j) is 1 for two different derivatives and 0 for i = j: the second product is left out
        products = [D[:, i, a] * D[:, j, b] + (i < j) * D[:, j, a] * D[:, i, b] for i, j in pairs]
        return _flat(w, products)

    def skew(self, w: Array, pairs: tuple[IndexPair, ...]) -> Array:
        """Return w (D_i[a] D_j[b] - D_j[a] D_i[b]) of functions a <= b.

        Parameters
        ----------
        w
            (points,): weights.
        pairs
            The pairs i < j of derivatives, by their numbers in the table, 0 to 5.

        Returns
        -------
        Array
            (points * pairs, functions (functions + 1)/2).
        """
        a, b = self.triangle
        D = self.values
        return _flat(w, [D[:, i, a] * D[:, j, b] - D[:, j, a] * D[:, i, b] for i, j in pairs])

    def cross(self, w: Array, other: "ShapeTable", pairs: tuple[IndexPair, ...]) -> Array:
        """Return w D_i D'_j of all functions a of this side and b of the other one.

        Parameters
        ----------
        w
            (points,): weights.
        other
            The table of the other side of an edge, at the same points.
        pairs
            The pairs i, j of derivatives: on this side, and on the other one.

        Returns
        -------
        Array
            (points * pairs, functions^2).
        """
        products = [self.values[:, i, :, None] * other.values[:, j, None, :] for i, j in pairs]
        return _flat(w, [product.reshape(len(product), -1) for product in products])


def _flat(w: Array, products: list[Array]) -> Array:
    """Return weighted products as (points * pairs, ...).

    Parameters
    ----------
    w
        (points,): weights.
    products
        For each pair of derivatives an array (points, ...).
    """
    stacked = w[:, None, None] * np.stack(products, axis=1)
    return np.ascontiguousarray(stacked.reshape(-1, stacked.shape[2]))


def cell_rule(degree: int) -> tuple[Array, Array]:
    """Return points (q, 2) and weights (q,), which sum to the reference triangle's area."""
    points, weights = basix.make_quadrature(basix.CellType.triangle, degree)
    return np.asarray(points), np.asarray(weights)


def edge_rule(degree: int, edge: int, is_reversed: bool) -> tuple[Array, Array]:
    """Return a quadrature rule of a degree on an edge of the reference triangle.

    Parameters
    ----------
    edge
        Number of the edge, 0 to 2.
    is_reversed
        Whether points run from the last corner of the edge to its first.

    Returns
    -------
    Points (q, 2), and weights (q,) that sum to one.
    """
    x, weights = basix.make_quadrature(basix.CellType.interval, degree)
    # the corners between which the points run, in reverse order if reversed
    start, end = CORNERS[list(EDGES[edge][:: -1 if is_reversed else 1])]
    return start + np.asarray(x) * (end - start), np.asarray(weights)


def edge_covector(edge: int) -> Array:
    """Return a covector (2,): zero along an edge, positive outward and as long as the edge.

    Parameters
    ----------
    edge
        Number of an edge of the reference triangle, 0 to 2.
    """
    start, end = CORNERS[list(EDGES[edge])]
    tangent = end - start
    covector = np.array([tangent[1], -tangent[0]])
    # its value along the way from the edge to the centre must be negative
    return covector if covector @ (CORNERS.mean(axis=0) - start) < 0 else -covector


def cell_frames(domain: mesh.Mesh) -> Array:
    """Return the maps from reference to local Cartesian derivatives of triangles in space.

    With X, Y the reference coordinates and x along the first edge, d/dx = p d/dX and d/dy = q d/dX
    + s d/dY.

    Returns
    -------
    Array
        (local cells, 4): p, q, s and the Jacobian determinant.
    """
    corners = domain.geometry.x[compat.geometry_dofs(domain)]
    first_edge, second_edge = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = np.linalg.norm(first_edge, axis=1)
    # unit vector of x; y is normal to it in the plane of the triangle. The second edge has the
    # components (second_along_first, height)
    direction = first_edge / length[:, None]
    second_along_first = np.einsum("ci,ci->c", second_edge, direction)
    height = np.linalg.norm(second_edge - second_along_first[:, None] * direction, axis=1)
    return np.column_stack(
        [1 / length, -second_along_first / (length * height), 1 / height, length * height]
    )


class PointSampling:
    """Sampling of vector fields and their derivatives at points of every cell, and its transpose.

    Values are in the order (cell; point, derivative, component). The table of shape functions is
    expanded to vectors. This triples the arithmetic but avoids sorting. The private fields
    `_to_points` and `_to_nodes` are the matrices of both maps.

    Parameters
    ----------
    table
        Shape functions at the points.
    weights
        (points,) of the quadrature.
    derivatives
        Numbers of the derivatives in the table that are sampled.
    """

    def __init__(self, table: ShapeTable, weights: Array, derivatives: Sequence[int]) -> None:
        D, identity = table.values[:, list(derivatives)], np.eye(3)
        size = 3 * D.shape[2]
        # indices: q point, p derivative, f function, c component of the node, d of the value
        self._to_points = np.einsum("qpf,cd->fcqpd", D, identity).reshape(size, -1)
        self._to_nodes = np.einsum("q,qpf,cd->qpdfc", weights, D, identity).reshape(-1, size)

    def at_points(self, nodal: Array, out: Array) -> None:
        """Write the values of nodal vectors (cells, functions * 3) to `out`, of any shape."""
        np.matmul(nodal, self._to_points, out=out.reshape(-1, self._to_points.shape[1]))

    def at_nodes(self, gradients: Array) -> Array:
        """Return nodal vectors (cells, functions * 3): the weighted sum of gradients at points.

        It is the transpose of `at_points`, with the weights of the quadrature.

        Parameters
        ----------
        gradients
            Derivatives by the values at points, in their order and in any shape.
        """
        return np.asarray(gradients.reshape(-1, len(self._to_nodes)) @ self._to_nodes)

"""Tessellation: flat triangles of a surface, as fine as its cells are curved.

A reference cell (a triangle, or a square for the faces of a solid) is divided once; all cells are
divided alike. Shapes: m cells with k nodes each, q points in a reference cell, t triangles in all.
The shape functions interpolate between the nodes of a cell.
"""

from dataclasses import dataclass

import basix
import numpy as np
from dolfinx.cpp.io import perm_vtk
from dolfinx.mesh import CellType
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
EQUISPACED = basix.LagrangeVariant.equispaced
TINY = 1e-300  # least divisor


@dataclass(frozen=True)
class Tessellation:
    """Flat triangles in the cells of a surface.

    Each cell has the same q points in its reference cell, whatever the displacement. Points are
    numbered cell after cell.

    Attributes
    ----------
    nodes
        (m, k) nodes of each cell, or of each outer face of a solid.
    table
        (q, k) values of the cells' shape functions at the points.
    slopes
        (2, q, k) derivatives of the shape functions at the points, by the reference coordinates.
    triangles
        (t, 3) numbers of the points of all cells.
    flat
        Whether the cells are flat triangles; their normals are then averaged at nodes.
    degree
        Degree of the shape functions.
    """

    nodes: Numbers
    table: Array
    slopes: Array
    triangles: NDArray[np.int32]
    flat: bool
    degree: int = 1

    def at_points(self, values: Array) -> Array:
        """Return values at nodes (n, ...), interpolated at the points of all cells (m q, ...)."""
        values_of_cells = values[self.nodes].reshape(*self.nodes.shape, -1)
        return np.asarray(np.matmul(self.table, values_of_cells).reshape(-1, *values.shape[1:]))

    def normals(self, r: Array) -> Array:
        """Return unit normals (m q, 3) at the points, of the surface with nodes at r (n, 3).

        Within a cell they have one orientation.
        """
        first_tangent, second_tangent = np.matmul(self.slopes[:, None], r[self.nodes])
        vectors = np.cross(first_tangent, second_tangent).reshape(-1, 3)
        if self.flat:  # the points of a flat triangle are its nodes: sums of normals at each node
            node_numbers, node_count = self.nodes.ravel(), len(r)
            sums = [np.bincount(node_numbers, vectors[:, i], node_count) for i in range(3)]
            vectors = np.column_stack(sums)[node_numbers]
        lengths = np.maximum(np.linalg.norm(vectors, axis=1), TINY)
        return np.asarray(vectors / lengths[:, None])


def tessellate(surface: Surface, max_triangles: int = 40_000) -> Tessellation:
    """Return the flat triangles of a surface, about `max_triangles` at most.

    There are never fewer than one triangle for each cell, or two for each outer face of a solid.
    """
    if surface.is_body:
        faces = _outer_faces(surface.cells)
        division = _division(2 * len(faces), finest=4, max_triangles=max_triangles)
        element = basix.create_element(
            basix.ElementFamily.P, basix.CellType.quadrilateral, 2, EQUISPACED
        )
        in_order = np.arange(9)  # the faces have the element's own order
        return _divided(faces, element, in_order, triangulation=_squares(division))
    count = surface.cells.shape[1]
    # a triangle of degree d has (d + 1)(d + 2)/2 nodes
    degree = round((np.sqrt(8 * count + 1) - 3) / 2)
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType.triangle, degree, EQUISPACED
    )
    order = np.argsort(perm_vtk(CellType.triangle, count))
    # two parts for each interval between nodes show the curvature; flat cells need no division
    division = (
        1
        if degree == 1
        else _division(len(surface.cells), finest=2 * degree, max_triangles=max_triangles)
    )
    return _divided(surface.cells, element, order, triangulation=_triangle(division))


def _division(triangles: int, finest: int, max_triangles: int) -> int:
    """Return the number n of equal parts of each side of a triangle, from 1 to `finest`.

    A triangle becomes n² smaller ones, `max_triangles` in all at most. `triangles` is the number of
    triangles that are to be divided.
    """
    return int(np.clip(np.sqrt(max_triangles / max(triangles, 1)), 1, finest))


def _divided(
    nodes: Numbers,
    element: "basix.finite_element.FiniteElement",
    order: Numbers,
    triangulation: tuple[Array, Numbers],
) -> Tessellation:
    """Return the tessellation of cells that are all divided alike.

    Parameters
    ----------
    nodes
        (m, k) nodes of the cells.
    element
        Element with the cells' shape functions.
    order
        Number in `element` of each node of a cell.
    triangulation
        Points (q, 2) in the reference cell, and triangles (t, 3) between them.
    """
    points, triangles = triangulation
    # values and derivatives of the shape functions, in the order of a cell's nodes
    table, *slopes = element.tabulate(1, points)[:, :, :, 0][:, :, order]
    # the points of all cells are numbered cell after cell
    numbers = np.arange(len(nodes))[:, None, None] * len(points) + triangles
    corners = numbers.reshape(-1, 3).astype(np.int32)
    is_flat = nodes.shape[1] == 3  # a triangle of degree one
    return Tessellation(nodes, table, np.array(slopes), corners, is_flat, element.degree)


def _triangle(n: int) -> tuple[Array, Numbers]:
    """Return points (q, 2) in the reference triangle, and n² triangles (n², 3) between them."""
    places = [(i, j) for j in range(n + 1) for i in range(n + 1 - j)]  # in steps of 1/n
    number = {place: k for k, place in enumerate(places)}
    # triangles that point up, and those that point down between them
    up = [(number[i, j], number[i + 1, j], number[i, j + 1]) for i, j in places if i + j < n]
    down = [
        (number[i + 1, j], number[i + 1, j + 1], number[i, j + 1])
        for i, j in places
        if i + j < n - 1
    ]
    return np.array(places) / n, np.array(up + down)


def _squares(n: int) -> tuple[Array, Numbers]:
    """Return points (q, 2) in the reference square, and 2 n² triangles between them."""
    x, y = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
    # for each of the n² squares the numbers of its points: lower left, lower right, upper left
    low = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    right, upper = low + 1, low + n + 1
    triangles = np.concatenate(
        [np.column_stack([low, right, upper]), np.column_stack([right, upper + 1, upper])]
    )
    return np.column_stack([x.ravel(), y.ravel()]) / n, triangles


def _outer_faces(cells: Numbers) -> Numbers:
    """Return the nodes (m, 9) of the faces that belong to one hexahedron only.

    They are in Basix's order of a square. `cells` (m, 27) are in VTK's order.
    """
    body = basix.create_element(basix.ElementFamily.P, basix.CellType.hexahedron, 2, EQUISPACED)
    square = basix.create_element(
        basix.ElementFamily.P, basix.CellType.quadrilateral, 2, EQUISPACED
    )
    # argsort inverts a permutation: once gives Basix to VTK, twice VTK to Basix
    to_basix = np.argsort(np.argsort(perm_vtk(CellType.hexahedron, cells.shape[1])))
    cells_in_basix_order = cells[:, to_basix]

    def half_steps(point: Array) -> tuple[int, ...]:
        """Return the coordinates of a node of degree two as multiples of a half."""
        return tuple(np.round(2 * point).astype(int))

    # all six faces of all cells, with their nodes in the order of the square
    faces = []
    for axis in range(3):
        other_axes = [i for i in range(3) if i != axis]
        for side in (0.0, 1.0):
            on_face = np.flatnonzero(np.isclose(body.points[:, axis], side))
            node_at = {half_steps(body.points[i, other_axes]): i for i in on_face}
            nodes_of_face = [node_at[half_steps(point)] for point in square.points]
            faces.append(cells_in_basix_order[:, nodes_of_face])
    all_faces = np.concatenate(faces)
    # the same face of two cells has the same four corners
    corners = np.sort(all_faces[:, :4], axis=1)
    _, first_face, count = np.unique(corners, axis=0, return_index=True, return_counts=True)
    return np.asarray(all_faces[np.sort(first_face[count == 1])])

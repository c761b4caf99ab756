"""Tessellation: the flat triangles of a surface, as fine as its cells are curved."""

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
    """Flat triangles in the cells of a surface; its points are the same for every displacement.

    Attributes
    ----------
    nodes
        (m, k) nodes of each cell, or of each outer face of a solid.
    table
        (q, k) values of the cells' shape functions at their q points.
    slopes
        (2, q, k) their derivatives at the points.
    triangles
        (t, 3) numbers of points, of all cells.
    flat
        Whether the cells are flat triangles, whose normals are averaged at nodes.
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
        """Return the values of nodes (n, ...) at the points (m q, ...)."""
        values_of_cells = values[self.nodes].reshape(*self.nodes.shape, -1)
        return np.asarray(np.matmul(self.table, values_of_cells).reshape(-1, *values.shape[1:]))

    def normals(self, r: Array) -> Array:
        """Return unit normals (m q, 3) of the surface with nodes at r (n, 3), one sign for each
        cell.
        """
        tangents = np.matmul(self.slopes[:, None], r[self.nodes])
        vectors = np.cross(*tangents).reshape(-1, 3)
        if self.flat:
            node_numbers, node_count = self.nodes.ravel(), len(r)
            sums = [np.bincount(node_numbers, vectors[:, i], node_count) for i in range(3)]
            vectors = np.column_stack(sums)[node_numbers]
        lengths = np.maximum(np.linalg.norm(vectors, axis=1), TINY)
        return np.asarray(vectors / lengths[:, None])


def tessellate(surface: Surface, max_triangles: int = 40_000) -> Tessellation:
    """Return the flat triangles of a surface, about `max_triangles` of them at most.

    They are never fewer than the cells of the surface give.
    """
    if surface.is_body:
        faces = _outer_faces(surface.cells)
        division = _division(2 * len(faces), 4, max_triangles)
        element = basix.create_element(
            basix.ElementFamily.P, basix.CellType.quadrilateral, 2, EQUISPACED
        )
        return _divided(faces, element, np.arange(9), _squares(division))
    count = surface.cells.shape[1]
    degree = round((np.sqrt(8 * count + 1) - 3) / 2)
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType.triangle, degree, EQUISPACED
    )
    order = np.argsort(perm_vtk(CellType.triangle, count))
    division = 1 if degree == 1 else _division(len(surface.cells), 2 * degree, max_triangles)
    return _divided(surface.cells, element, order, _triangle(division))


def _division(triangles: int, finest: int, max_triangles: int) -> int:
    """Return into how many parts the sides of triangles are divided, from 1 to `finest`."""
    return int(np.clip(np.sqrt(max_triangles / max(triangles, 1)), 1, finest))


def _divided(
    nodes: Numbers,
    element: "basix.finite_element.FiniteElement",
    order: Numbers,
    triangulation: tuple[Array, Numbers],
) -> Tessellation:
    """Return cells divided alike; `triangulation` is that of the reference cell."""
    points, triangles = triangulation
    table, *slopes = element.tabulate(1, points)[:, :, :, 0][:, :, order]
    numbers = np.arange(len(nodes))[:, None, None] * len(points) + triangles
    corners = numbers.reshape(-1, 3).astype(np.int32)
    return Tessellation(
        nodes, table, np.array(slopes), corners, nodes.shape[1] == 3, element.degree
    )


def _triangle(n: int) -> tuple[Array, Numbers]:
    """Return points (q, 2) of the reference triangle in a grid, and its n² triangles."""
    places = [(i, j) for j in range(n + 1) for i in range(n + 1 - j)]
    number = {place: k for k, place in enumerate(places)}
    up = [(number[i, j], number[i + 1, j], number[i, j + 1]) for i, j in places if i + j < n]
    down = [
        (number[i + 1, j], number[i + 1, j + 1], number[i, j + 1])
        for i, j in places
        if i + j < n - 1
    ]
    return np.array(places) / n, np.array(up + down)


def _squares(n: int) -> tuple[Array, Numbers]:
    """Return points (q, 2) of the reference square in a grid, and its 2 n² triangles."""
    x, y = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
    low = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    right, upper = low + 1, low + n + 1
    triangles = np.concatenate(
        [np.column_stack([low, right, upper]), np.column_stack([right, upper + 1, upper])]
    )
    return np.column_stack([x.ravel(), y.ravel()]) / n, triangles


def _outer_faces(cells: Numbers) -> Numbers:
    """Return the nodes (m, 9) of faces of one hexahedron only, in Basix's order of a square."""
    body = basix.create_element(basix.ElementFamily.P, basix.CellType.hexahedron, 2, EQUISPACED)
    square = basix.create_element(
        basix.ElementFamily.P, basix.CellType.quadrilateral, 2, EQUISPACED
    )
    to_basix = np.argsort(np.argsort(perm_vtk(CellType.hexahedron, cells.shape[1])))
    cells_in_basix_order = cells[:, to_basix]

    def half_steps(point: Array) -> tuple[int, ...]:
        """Return coordinates of a node of degree two as multiples of a half."""
        return tuple(np.round(2 * point).astype(int))

    faces = []
    for axis in range(3):
        other_axes = [i for i in range(3) if i != axis]
        for side in (0.0, 1.0):
            on_face = np.flatnonzero(np.isclose(body.points[:, axis], side))
            node_at = {half_steps(body.points[i, other_axes]): i for i in on_face}
            nodes_of_face = [node_at[half_steps(point)] for point in square.points]
            faces.append(cells_in_basix_order[:, nodes_of_face])
    all_faces = np.concatenate(faces)
    corners = np.sort(all_faces[:, :4], axis=1)
    _, first_face, count = np.unique(corners, axis=0, return_index=True, return_counts=True)
    return np.asarray(all_faces[np.sort(first_face[count == 1])])

"""The flat triangles of a surface, as fine as its pieces are curved."""

from dataclasses import dataclass

import basix
import numpy as np
from dolfinx.cpp.io import perm_vtk
from dolfinx.mesh import CellType
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
EQUAL = basix.LagrangeVariant.equispaced


@dataclass(frozen=True)
class Tessellation:
    """Flat triangles in the pieces of a surface; its points are the same for every displacement.

    Attributes
    ----------
    nodes
        (m, k) nodes of each piece.
    table
        (q, k) values of its shape functions at its q points.
    slopes
        (2, q, k) their derivatives at its points.
    triangles
        (t, 3) numbers of points, of all pieces.
    flat
        Whether the pieces are flat triangles, whose normals are averaged at nodes.
    degree
        Of the shape functions.
    """

    nodes: Numbers
    table: Array
    slopes: Array
    triangles: NDArray[np.int32]
    flat: bool
    degree: int = 1

    def at(self, values: Array) -> Array:
        """Values (n, ...) of nodes at the points (m q, ...)."""
        flat = values[self.nodes].reshape(*self.nodes.shape, -1)
        return np.asarray(np.matmul(self.table, flat).reshape(-1, *values.shape[1:]))

    def normals(self, r: Array) -> Array:
        """Unit normals (m q, 3) of the surface with nodes at r (n, 3), one sign for each piece."""
        along = np.matmul(self.slopes[:, None], r[self.nodes])
        vectors = np.cross(*along).reshape(-1, 3)
        if self.flat:
            where, n = self.nodes.ravel(), len(r)
            vectors = np.column_stack([np.bincount(where, vectors[:, i], n) for i in range(3)])[
                where
            ]
        return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)[:, None])


def tessellated(surface: Surface, most: int = 40_000) -> Tessellation:
    """The flat triangles of a surface, at most about so many, but never fewer than its cells give."""
    if surface.is_body:
        faces = _outer_faces(surface.cells)
        division = _division(2 * len(faces), 4, most)
        element = basix.create_element(
            basix.ElementFamily.P, basix.CellType.quadrilateral, 2, EQUAL
        )
        return _divided(faces, element, np.arange(9), _squares(division))
    count = surface.cells.shape[1]
    degree = round((np.sqrt(8 * count + 1) - 3) / 2)
    element = basix.create_element(basix.ElementFamily.P, basix.CellType.triangle, degree, EQUAL)
    order = np.argsort(perm_vtk(CellType.triangle, count))
    division = 1 if degree == 1 else _division(len(surface.cells), 2 * degree, most)
    return _divided(surface.cells, element, order, _triangle(division))


def _division(pieces: int, wanted: int, most: int) -> int:
    return int(np.clip(np.sqrt(most / max(pieces, 1)), 1, wanted))


def _divided(
    nodes: Numbers,
    element: "basix.finite_element.FiniteElement",
    order: Numbers,
    fine: tuple[Array, Numbers],
) -> Tessellation:
    points, triangles = fine
    table, *slopes = element.tabulate(1, points)[:, :, :, 0][:, :, order]
    numbers = np.arange(len(nodes))[:, None, None] * len(points) + triangles
    corners = numbers.reshape(-1, 3).astype(np.int32)
    return Tessellation(
        nodes, table, np.array(slopes), corners, nodes.shape[1] == 3, element.degree
    )


def _triangle(n: int) -> tuple[Array, Numbers]:
    """Points of the reference triangle in a grid, and its n² triangles."""
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
    """The same of the reference square; 2 n² triangles."""
    x, y = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
    low = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    right, above = low + 1, low + n + 1
    triangles = np.concatenate(
        [np.column_stack([low, right, above]), np.column_stack([right, above + 1, above])]
    )
    return np.column_stack([x.ravel(), y.ravel()]) / n, triangles


def _outer_faces(cells: Numbers) -> Numbers:
    """The nine nodes of each face that belongs to one hexahedron only, in Basix's order of a
    square.
    """
    body = basix.create_element(basix.ElementFamily.P, basix.CellType.hexahedron, 2, EQUAL)
    square = basix.create_element(basix.ElementFamily.P, basix.CellType.quadrilateral, 2, EQUAL)
    ours = cells[
        :, np.argsort(np.argsort(perm_vtk(CellType.hexahedron, cells.shape[1])))
    ]  # in Basix's order
    faces = []
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        for side in (0.0, 1.0):
            on = np.flatnonzero(np.isclose(body.points[:, axis], side))
            at = {tuple(np.round(2 * body.points[i, others]).astype(int)): i for i in on}
            faces.append(ours[:, [at[tuple(np.round(2 * p).astype(int))] for p in square.points]])
    all_faces = np.concatenate(faces)
    corners = np.sort(all_faces[:, :4], axis=1)
    _, first, count = np.unique(corners, axis=0, return_index=True, return_counts=True)
    return np.asarray(all_faces[np.sort(first[count == 1])])

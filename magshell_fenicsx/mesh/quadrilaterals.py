"""A triangulated mid-surface in quadrilaterals of degree 2, with the direction in which each node is swept.

Each triangle is split into three quadrilaterals, which meet at its centre: they are graded as the triangles are,
and their edges follow the same circles.
"""

from dataclasses import dataclass
from typing import Any

import basix
import numpy as np
from dolfinx import mesh
from dolfinx.cpp.io import perm_gmsh
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import Embedding, PatchMesh, directed_sides

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
STEP = 1e-5  # of the differences that give the normal: their error is 1e-10
VERTICES = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
SIDES = ((0, 1), (1, 2), (2, 0))  # of a triangle


@dataclass(frozen=True)
class Quadrilaterals:
    """Three above each triangle.

    Attributes
    ----------
    nodes, places
        (n, d) nodes in the chart, and (n, 3) in space.
    offsets
        (n, 3) what the nodes move by when the surface moves outward by one: the unit normal or, at a kink, the
        vector on which every face moves by one.
    cells
        (m, 9) node numbers in the order of basix; cells 3 t, 3 t + 1 and 3 t + 2 are of triangle t.
    edges
        Name -> pairs of vertices.
    """

    nodes: Array
    places: Array
    offsets: Array
    cells: Numbers
    edges: dict[str, Numbers]


def split(patch: PatchMesh) -> Quadrilaterals:
    """Vertex, middle of a side, centre and middle of the other side make a quadrilateral."""
    reference, quads, on_sides = _reference_split()
    order = {3: 1, 6: 2, 10: 3}[patch.cells.shape[1]]
    geometry = basix.create_element(
        basix.ElementFamily.P, basix.CellType.triangle, order, basix.LagrangeVariant.equispaced
    )
    to_dolfinx = perm_gmsh(mesh.CellType.triangle, patch.cells.shape[1])
    values = geometry.tabulate(1, reference)[..., 0]
    vertices, corners = np.unique(patch.corners, return_inverse=True)
    corners = corners.reshape(-1, 3)
    pairs = directed_sides(corners)
    sides, side_of = np.unique(np.sort(pairs, axis=1), axis=0, return_inverse=True)
    side_of, backwards = side_of.reshape(3, -1), (pairs[:, 0] > pairs[:, 1]).reshape(3, -1)
    numbers = np.empty((len(corners), len(reference)), dtype=np.int64)
    numbers[:, :3] = corners
    for side, places in enumerate(on_sides):  # three nodes on a side, counted from its lower vertex
        along = np.where(backwards[side][:, None], [2, 1, 0], [0, 1, 2])
        numbers[:, places] = len(vertices) + 3 * side_of[side][:, None] + along
    inner = np.setdiff1d(np.arange(len(reference)), [0, 1, 2, *np.ravel(on_sides)])
    below = len(vertices) + 3 * len(sides)
    numbers[:, inner] = below + len(inner) * np.arange(len(corners))[:, None] + np.arange(len(inner))
    ordered = patch.cells[:, to_dolfinx]
    x = np.einsum("qk,ckx->cqx", values[0], patch.nodes[ordered])
    nodes = np.empty((numbers.max() + 1, patch.nodes.shape[1]))
    nodes[numbers] = x  # of glued sides either: they have one place in space
    if nodes.shape[1] == 2:
        offsets = surface_normal(patch.embedding, nodes)
    else:
        a1, a2 = np.einsum("dqk,ckx->dcqx", values[1:], patch.embedding(patch.nodes)[ordered])
        offsets = _mitred(a1, a2, numbers, quads)
    middle_of = {(int(sides[n, 0]), int(sides[n, 1])): len(vertices) + 3 * n + 1 for n in range(len(sides))}

    def halves(a: int, b: int) -> list[list[int]]:
        middle = middle_of[min(a, b), max(a, b)]
        return [[a, middle], [middle, b]]

    edges: dict[str, Numbers] = {
        name: np.array(
            [half for a, b in np.searchsorted(vertices, pairs) for half in halves(int(a), int(b))], dtype=np.int64
        ).reshape(-1, 2)
        for name, pairs in patch.edges.items()
    }
    return Quadrilaterals(nodes, patch.embedding(nodes), offsets, numbers[:, quads].reshape(-1, 9), edges)


def surface_normal(embedding: Embedding, x: Array) -> Array:
    """Unit normals (n, 3) at points (n, 2) of a chart, by central differences."""
    a1, a2 = (embedding(x + STEP * e) - embedding(x - STEP * e) for e in np.eye(2))
    return _unit(np.cross(a1, a2))


def _mitred(a1: Array, a2: Array, numbers: Numbers, quads: Numbers) -> Array:
    """Offsets (nodes, 3) from the tangents (cells, places, 3) of a surface that may have kinks.

    At corners of quadrilaterals the mean normal, each cell's weighted by its angle there, over its mean cosine with
    the cells' normals: exact between two faces and between three that are normal to each other. What a cell's own
    normal lacks of it is interpolated to the nodes between.
    """
    n = _unit(np.cross(a1, a2))
    weights = np.full(n.shape[:2], np.pi)
    for corner, (e, f) in enumerate(((a1, a2), (a2 - a1, -a1), (-a2, a1 - a2))):
        cosine = np.sum(_unit(e[:, corner]) * _unit(f[:, corner]), axis=1)
        weights[:, corner] = np.arccos(np.clip(cosine, -1, 1))
    total = np.zeros((numbers.max() + 1, 3))
    np.add.at(total, numbers, weights[..., None] * n)
    whole = np.bincount(numbers.ravel(), weights.ravel())[:, None]
    mitre = total * whole / np.maximum(np.sum(total**2, axis=1, keepdims=True), 1e-300)
    s, t = square().T
    bilinear = np.column_stack([(1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t])
    lacking = mitre[numbers[:, quads[:, :4]]] - n[:, quads[:, :4]]
    found = n[:, quads] + np.einsum("kc,mqcx->mqkx", bilinear, lacking)
    offsets = np.zeros_like(total)
    np.add.at(offsets, numbers[:, quads], found)
    return np.asarray(offsets / np.bincount(numbers[:, quads].ravel())[:, None])


def _unit(v: NDArray[Any]) -> Array:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300))


def _reference_split() -> tuple[Array, Numbers, list[list[int]]]:
    """Places (19, 2) in the reference triangle, vertices first; quadrilaterals (3, 9) of them; those on each side."""
    s, t = square().T[:, :, None]
    centre = VERTICES.mean(axis=0)
    found = [*VERTICES]
    quads = []
    for i in range(3):
        here, following, before = (VERTICES[(i + k) % 3] for k in range(3))
        side, other = (here + following) / 2, (here + before) / 2
        quad = (1 - s) * (1 - t) * here + s * (1 - t) * side + s * t * centre + (1 - s) * t * other
        numbers = []
        for x in quad:
            known = [n for n, y in enumerate(found) if np.allclose(x, y)]
            if not known:
                found.append(x)
            numbers.append(known[0] if known else len(found) - 1)
        quads.append(numbers)
    places = np.array(found)

    def along(a: int, b: int) -> list[int]:
        wanted = VERTICES[a] + np.array([0.25, 0.5, 0.75])[:, None] * (VERTICES[b] - VERTICES[a])
        return [int(np.argmin(np.linalg.norm(places - x, axis=1))) for x in wanted]

    return places, np.array(quads), [along(*side) for side in SIDES]


def square() -> Array:
    """Nodes (9, 2) of the reference quadrilateral, corners first."""
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType.quadrilateral, 2, basix.LagrangeVariant.equispaced
    )
    return np.asarray(element.points)

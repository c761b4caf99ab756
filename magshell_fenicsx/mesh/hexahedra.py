"""A body around a mid-surface: its triangles in quadrilaterals of degree 2, swept through the
thickness.

Each triangle is split into three quadrilaterals, which meet at its centre: they are graded as the
triangles are, and their edges follow the same circles.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import basix
import basix.ufl
import numpy as np
import ufl
from dolfinx import fem, mesh
from dolfinx.cpp.io import perm_gmsh
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.mesh.midsurface import create_mesh
from magshell_fenicsx.mesh.patch import (
    Deviated,
    Embedding,
    MeshError,
    PatchMesh,
    as_set,
    directed_sides,
    place_text,
)
from magshell_fenicsx.platform import compat

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
STEP = 1e-5  # of the differences that give the normal: their error is 1e-10
VERTICES = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
SIDES = ((0, 1), (1, 2), (2, 0))  # of a triangle
OUTER = ""  # face: a name that no edge has, while an annulus has an edge "outer"
MIDDLE = 0.5  # of the thickness
WHOLE = 5  # quadrature degree: three points in each direction


@dataclass(frozen=True)
class Quadrilaterals:
    """Three above each triangle.

    Attributes
    ----------
    nodes, places
        (n, d) nodes in the chart, and (n, 3) in space.
    offsets
        (n, 3) what the nodes move by when the surface moves outward by one: the unit normal or, at
        a kink, the vector on which every face moves by one.
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
    numbers[:, inner] = (
        below + len(inner) * np.arange(len(corners))[:, None] + np.arange(len(inner))
    )
    ordered = patch.cells[:, to_dolfinx]
    x = np.einsum("qk,ckx->cqx", values[0], patch.nodes[ordered])
    nodes = np.empty((numbers.max() + 1, patch.nodes.shape[1]))
    nodes[numbers] = x  # of glued sides either: they have one place in space
    if nodes.shape[1] == 2:
        offsets = surface_normal(patch.embedding, nodes)
    else:
        a1, a2 = np.einsum("dqk,ckx->dcqx", values[1:], patch.embedding(patch.nodes)[ordered])
        offsets = _mitred(a1, a2, numbers, quads)
    middle_of = {
        (int(sides[n, 0]), int(sides[n, 1])): len(vertices) + 3 * n + 1 for n in range(len(sides))
    }

    def halves(a: int, b: int) -> list[list[int]]:
        middle = middle_of[min(a, b), max(a, b)]
        return [[a, middle], [middle, b]]

    edges: dict[str, Numbers] = {
        name: np.array(
            [half for a, b in np.searchsorted(vertices, pairs) for half in halves(int(a), int(b))],
            dtype=np.int64,
        ).reshape(-1, 2)
        for name, pairs in patch.edges.items()
    }
    return Quadrilaterals(
        nodes, patch.embedding(nodes), offsets, numbers[:, quads].reshape(-1, 9), edges
    )


def surface_normal(embedding: Embedding, x: Array) -> Array:
    """Unit normals (n, 3) at points (n, 2) of a chart, by central differences."""
    a1, a2 = (embedding(x + STEP * e) - embedding(x - STEP * e) for e in np.eye(2))
    return _unit(np.cross(a1, a2))


def _mitred(a1: Array, a2: Array, numbers: Numbers, quads: Numbers) -> Array:
    """Offsets (nodes, 3) from the tangents (cells, places, 3) of a surface that may have kinks.

    At corners of quadrilaterals the mean normal, each cell's weighted by its angle there, over its
    mean cosine with the cells' normals: exact between two faces and between three that are normal
    to each other. What a cell's own normal lacks of it is interpolated to the nodes between.
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
    directions = n[:, quads] + np.einsum("kc,mqcx->mqkx", bilinear, lacking)
    offsets = np.zeros_like(total)
    np.add.at(offsets, numbers[:, quads], directions)
    return np.asarray(offsets / np.bincount(numbers[:, quads].ravel())[:, None])


def _unit(v: NDArray[Any]) -> Array:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300))


def _reference_split() -> tuple[Array, Numbers, list[list[int]]]:
    """Places (19, 2) in the reference triangle, vertices first; quadrilaterals (3, 9) of them;
    those on each side.
    """
    s, t = square().T[:, :, None]
    centre = VERTICES.mean(axis=0)
    corners = [*VERTICES]
    quads = []
    for i in range(3):
        corner, following, before = (VERTICES[(i + k) % 3] for k in range(3))
        side, other = (corner + following) / 2, (corner + before) / 2
        quad = (
            (1 - s) * (1 - t) * corner + s * (1 - t) * side + s * t * centre + (1 - s) * t * other
        )
        numbers = []
        for x in quad:
            same = [n for n, y in enumerate(corners) if np.allclose(x, y)]
            if not same:
                corners.append(x)
            numbers.append(same[0] if same else len(corners) - 1)
        quads.append(numbers)
    places = np.array(corners)

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


@dataclass(frozen=True)
class Body:
    """A body on all ranks.

    Attributes
    ----------
    mesh
        Hexahedra with geometry of degree 2; the third coordinate of their reference cell runs
        outwards.
    faces
        Name -> facets (local numbers): those of `OUTER`, and those above each named edge of the
        mid-surface.
    points, normals
        Name -> (3,) position of a node in the middle of the thickness, and the mid-surface's normal
        there.
    patches
        Name -> whether each local cell is above that part of the mid-surface.
    between
        (cells, 2) where each local cell begins and ends in the thickness: from 0 inside to 1
        outside.
    chart, heights, thickness
        Of each node of the geometry: the chart's coordinates (n, d) under it, where it is in the
        thickness, from 0 to 1, and h(x) over R; see `at_nodes`.
    w0
        Of each node of the geometry: the deviation over R of the mid-surface under it; None without
        imperfections.
    """

    mesh: mesh.Mesh
    faces: dict[str, NDArray[np.int32]]
    points: dict[str, Array]
    normals: dict[str, Array]
    patches: dict[str, NDArray[np.bool_]]
    between: Array
    chart: Array
    heights: Array
    thickness: Array
    w0: Array | None = None

    def at_nodes(self, V: fem.FunctionSpace, values: Array) -> Array:
        """What is known at the nodes of the geometry, at those of a quadratic space."""
        nodes = V.dofmap.index_map
        nodal = np.empty((nodes.size_local + nodes.num_ghosts, *values.shape[1:]))
        nodal[V.dofmap.list] = values[compat.corner_numbers(self.mesh)]
        return nodal


def sweep(
    patch: PatchMesh,
    h: float,
    layers: int | Sequence[float],
    comm: MPI.Comm,
    factor: Callable[[Array], Array] | None = None,
) -> Body:
    """Make the body of all ranks from the triangulation, which each of them has: it is small.

    Parameters
    ----------
    h
        The thickness over R.
    layers
        Number of cells through the thickness, or where they begin and end, from 0 to 1.
    factor
        What multiplies h at places (n, 3) of the mid-surface; None for 1.

    Raises
    ------
    MeshError
        On every rank, if the body overlaps itself.
    """
    quads = split(patch)
    ends = np.linspace(0, 1, layers + 1) if isinstance(layers, int) else np.array(layers)
    heights = np.concatenate([ends[:1], *([(a + b) / 2, b] for a, b in pairwise(ends))])
    thick = h * (np.ones(len(quads.places)) if factor is None else factor(quads.places))
    z = (heights - MIDDLE) * thick[:, None]
    X = (quads.places[:, None] + z[..., None] * quads.offsets[:, None]).reshape(-1, 3)
    cells = _swept(quads.cells, len(ends) - 1)
    _refuse_overlap(X, cells)
    domain = create_mesh(comm, basix.ufl.element("Lagrange", "hexahedron", 2, shape=(3,)), cells, X)
    original = domain.topology.original_cell_index
    triangle, layer = original // (3 * (len(ends) - 1)), original % (len(ends) - 1)
    places = {name: patch.embedding(x[None])[0] for name, x in patch.points.items()}
    nearest = {
        name: np.argmin(np.linalg.norm(quads.places - x, axis=1)) for name, x in places.items()
    }
    node, level = np.divmod(domain.geometry.input_global_indices, len(heights))
    return Body(
        domain,
        _named_faces(domain, quads, len(heights)),
        places,
        {name: quads.offsets[n] / np.linalg.norm(quads.offsets[n]) for name, n in nearest.items()},
        {name: inside[triangle] for name, inside in patch.patches.items()},
        np.column_stack([ends[layer], ends[layer + 1]]),
        quads.nodes[node],
        heights[level],
        thick[node],
        patch.embedding.w0(quads.nodes)[node] if isinstance(patch.embedding, Deviated) else None,
    )


def _refuse_overlap(X: Array, cells: Numbers) -> None:
    """Look at the volume of all cells at their nodes."""
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType.hexahedron, 2, basix.LagrangeVariant.equispaced
    )
    tables = element.tabulate(1, element.points)[1:, :, :, 0]
    for part in np.array_split(cells, len(cells) // 2000 + 1):
        volumes = np.linalg.det(np.einsum("dqk,ckx->cqdx", tables, X[part]))
        if (volumes <= 0).any():
            place = X[part[np.argwhere(volumes <= 0)[0][0]]].mean(axis=0)
            raise MeshError(
                f"model: solid: the body overlaps itself around {place_text(place)}/R: half its thickness is "
                "more than the radius of curvature, or than a fold leaves beside it"
            )


def _swept(quads: Numbers, layers: int) -> Numbers:
    """Hexahedra (quads * layers, 27) in the order of basix; node q at level k has the number q
    levels + k.
    """
    points = basix.create_element(
        basix.ElementFamily.P, basix.CellType.hexahedron, 2, basix.LagrangeVariant.equispaced
    ).points
    below = np.argmin(np.linalg.norm(points[:, None, :2] - square()[None], axis=2), axis=1)
    level = np.rint(2 * points[:, 2]).astype(np.int64)
    levels = 2 * layers + 1
    cells = [quads[:, below] * levels + level + 2 * layer for layer in range(layers)]
    return np.stack(cells, axis=1).reshape(-1, 27)


def _named_faces(
    domain: mesh.Mesh, quads: Quadrilaterals, levels: int
) -> dict[str, NDArray[np.int32]]:
    """Outer and side faces, found by the numbers of their nodes."""
    for pair in ((2, 3), (2, 0), (0, 3), (3, 2)):
        domain.topology.create_connectivity(*pair)
    facets = mesh.exterior_facet_indices(domain.topology)
    vertices = domain.topology.index_map(0)
    # of a vertex its number in the chart and its level
    ends = mesh.entities_to_geometry(
        domain, 0, np.arange(vertices.size_local + vertices.num_ghosts, dtype=np.int32)
    )
    numbers = domain.geometry.input_global_indices[ends[:, 0]]
    corners = domain.topology.connectivity(2, 0).array.reshape(-1, 4)[facets]
    chart, level = np.divmod(numbers[corners], levels)
    named = {OUTER: facets[(level == levels - 1).all(axis=1)]}
    for name, pairs in quads.edges.items():
        wanted = as_set(pairs)
        above = [len(set(c)) == 2 and (min(c), max(c)) in wanted for c in chart]
        named[name] = facets[np.array(above, dtype=bool)]
    return named


def quadratic(domain: mesh.Mesh) -> fem.FunctionSpace:
    """Displacements of the mesh's own degree: rigid motions are exact."""
    return fem.functionspace(domain, ("Lagrange", 2, (3,)))


def face_measure(domain: mesh.Mesh, parts: Sequence[NDArray[np.int32]]) -> ufl.Measure:
    """Undeformed area of some facets, those of each part under its number from 1."""
    facets = np.concatenate(parts)
    tags = np.repeat(np.arange(1, len(parts) + 1, dtype=np.int32), [len(part) for part in parts])
    order = np.argsort(facets)
    tagged = mesh.meshtags(domain, 2, facets[order], tags[order])
    return ufl.Measure(
        "ds", domain=domain, subdomain_data=tagged, metadata={"quadrature_degree": WHOLE}
    )

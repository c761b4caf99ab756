"""A body of constant thickness around a mid-surface: hexahedra of degree 2, swept through the thickness.

Each triangle of the mid-surface's mesh is split into three quadrilaterals, which meet at its centre. So the body has
the element sizes of the shell, and its edges follow the same circles.
"""

from dataclasses import dataclass

import basix
import basix.ufl
import numpy as np
from dolfinx import fem, mesh
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.mesh.midsurface import at_reference_points, create_mesh
from magshell_fenicsx.mesh.patch import Embedding, PatchMesh, as_set, directed_sides

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
STEP = 1e-5  # of the differences that give the normal: their error is 1e-10
OUTER = "outer"  # face
VERTICES = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
SIDES = ((0, 1), (1, 2), (2, 0))  # of a triangle


@dataclass(frozen=True)
class Body:
    """A body on all ranks.

    Attributes
    ----------
    mesh
        Hexahedra with geometry of degree 2; the third coordinate of their reference cell runs outwards.
    faces
        Name -> facets (local numbers): "outer", and those above each named edge of the mid-surface.
    points, normals
        Name -> (3,) position of a node in the middle of the thickness, and the mid-surface's normal there.
    """

    mesh: mesh.Mesh
    faces: dict[str, NDArray[np.int32]]
    points: dict[str, Array]
    normals: dict[str, Array]


@dataclass(frozen=True)
class _Quadrilaterals:
    """Nodes (n, 2) of the chart, cells (m, 9) in the order of basix, and the pairs of vertices on named edges."""

    nodes: Array
    cells: Numbers
    edges: dict[str, Numbers]


def sweep(patch: PatchMesh, h: float, layers: int, comm: MPI.Comm) -> Body:
    """Make the body on all ranks from the triangulation, which every rank has: it is small."""
    quads, levels = _split(patch), 2 * layers + 1
    z = np.linspace(-h / 2, h / 2, levels)
    r, n = patch.embedding(quads.nodes), surface_normal(patch.embedding, quads.nodes)
    X = (r[:, None] + z[:, None] * n[:, None]).reshape(-1, 3)
    element = basix.ufl.element("Lagrange", "hexahedron", 2, shape=(3,))
    domain = create_mesh(comm, element, _swept(quads.cells, layers), X)
    chart = {name: x[None] for name, x in patch.points.items()}
    return Body(
        domain,
        _named_faces(domain, quads, levels),
        {name: patch.embedding(x)[0] for name, x in chart.items()},
        {name: surface_normal(patch.embedding, x)[0] for name, x in chart.items()},
    )


def surface_normal(embedding: Embedding, x: Array) -> Array:
    """Unit normals (n, 3) at points (n, 2) of a chart, by central differences."""
    a1, a2 = (embedding(x + STEP * e) - embedding(x - STEP * e) for e in np.eye(2))
    m = np.cross(a1, a2)
    return np.asarray(m / np.linalg.norm(m, axis=1)[:, None])


def _split(patch: PatchMesh) -> _Quadrilaterals:
    """Three quadrilaterals for each triangle: vertex, middle of a side, centre, middle of the other side."""
    reference, quads, on_sides = _reference_split()
    vertices, corners = np.unique(patch.cells[:, :3], return_inverse=True)
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
    nodes = np.empty((numbers.max() + 1, patch.nodes.shape[1]))
    nodes[numbers] = at_reference_points(patch.nodes, patch.cells, reference)
    ends = zip(sides[:, 0], sides[:, 1], strict=True)
    middle_of = {(int(a), int(b)): len(vertices) + 3 * n + 1 for n, (a, b) in enumerate(ends)}

    def halves(a: int, b: int) -> list[list[int]]:
        middle = middle_of[min(a, b), max(a, b)]
        return [[a, middle], [middle, b]]

    edges: dict[str, Numbers] = {
        name: np.array(
            [half for a, b in np.searchsorted(vertices, pairs) for half in halves(int(a), int(b))], dtype=np.int64
        ).reshape(-1, 2)
        for name, pairs in patch.edges.items()
    }
    return _Quadrilaterals(nodes, numbers[:, quads].reshape(-1, 9), edges)


def _reference_split() -> tuple[Array, Numbers, list[list[int]]]:
    """Places (19, 2) in the reference triangle, vertices first; quadrilaterals (3, 9) of them; those on each side."""
    square = _quadratic_points(basix.CellType.quadrilateral)
    s, t = square.T[:, :, None]
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


def _quadratic_points(cell: basix.CellType) -> Array:
    """Places of the nodes of degree 2 in a reference cell."""
    return np.asarray(basix.create_element(basix.ElementFamily.P, cell, 2, basix.LagrangeVariant.equispaced).points)


def _swept(quads: Numbers, layers: int) -> Numbers:
    """Hexahedra (quads * layers, 27) in the order of basix; node q at level k has the number q levels + k."""
    points = _quadratic_points(basix.CellType.hexahedron)
    square = _quadratic_points(basix.CellType.quadrilateral)
    below = np.argmin(np.linalg.norm(points[:, None, :2] - square[None], axis=2), axis=1)
    level = np.rint(2 * points[:, 2]).astype(np.int64)
    levels = 2 * layers + 1
    cells = [quads[:, below] * levels + level + 2 * layer for layer in range(layers)]
    return np.stack(cells, axis=1).reshape(-1, 27)


def _named_faces(domain: mesh.Mesh, quads: _Quadrilaterals, levels: int) -> dict[str, NDArray[np.int32]]:
    """Outer and side faces, found by the numbers of their nodes."""
    for pair in ((2, 3), (2, 0), (0, 3)):
        domain.topology.create_connectivity(*pair)
    facets = mesh.exterior_facet_indices(domain.topology)
    vertices = domain.topology.index_map(0)
    # a vertex has the number (number in the chart) * levels + level
    ends = mesh.entities_to_geometry(domain, 0, np.arange(vertices.size_local + vertices.num_ghosts, dtype=np.int32))
    numbers = domain.geometry.input_global_indices[ends[:, 0]]
    corners = domain.topology.connectivity(2, 0).array.reshape(-1, 4)[facets]
    chart, level = np.divmod(numbers[corners], levels)
    found = {OUTER: facets[(level == levels - 1).all(axis=1)]}
    for name, pairs in quads.edges.items():
        wanted = as_set(pairs)
        above = [len(set(c)) == 2 and (min(c), max(c)) in wanted for c in chart]
        found[name] = facets[np.array(above, dtype=bool)]
    return found


def quadratic(domain: mesh.Mesh) -> fem.FunctionSpace:
    """Displacements of the mesh's own degree: rigid motions are exact."""
    return fem.functionspace(domain, ("Lagrange", 2, (3,)))

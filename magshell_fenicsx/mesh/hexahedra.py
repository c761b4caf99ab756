"""Hexahedra of a body around a mid-surface, swept through the thickness.

Each triangle of the mid-surface is divided into three quadrilaterals of degree 2, which meet at its
centre: they are graded as the triangles are, and their edges follow the same circles. `sweep` makes
the mesh of the body on all ranks.

The nodes of a mid-surface have coordinates in a chart (d = 2), or are places in space (d > 2); its
embedding maps both to places in space. The offset of a node is the vector by which it moves per
distance through the thickness. A layer of hexahedra has three levels of nodes: its begin, its
middle and its end, which is the begin of the next layer. h is the thickness and R the reference
length. Lengths are over R.
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

from magshell_fenicsx.mesh.midsurface import ORDERS, create_mesh
from magshell_fenicsx.mesh.patch import (
    DeviatedEmbedding,
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
DIFFERENCE_STEP = (
    1e-5  # in the chart, of the differences that give the normal: their error is 1e-10
)
VERTICES = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # of the reference triangle
TRIANGLE_SIDES = ((0, 1), (1, 2), (2, 0))
SIDE_NODES = np.array([0.25, 0.5, 0.75])  # on a side of a triangle, between its vertices
OUTER_FACE = ""  # a name that no edge has, while an annulus has an edge "outer"
MIDSURFACE_HEIGHT = 0.5  # of the thickness, from 0 inside to 1 outside
QUADRATURE_DEGREE = 5  # three points in each direction
CELLS_PER_CHECK = 2000  # whose volumes are computed at once
TINY = 1e-300  # keeps divisions by a length defined


@dataclass(frozen=True)
class Quadrilaterals:
    """The quadrilaterals of degree 2 of a mid-surface, three on each triangle.

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
    """Divide each triangle of a mid-surface into three quadrilaterals.

    The corners of a quadrilateral are a vertex, the middle of a side, the centre of the triangle,
    and the middle of the other side.
    """
    # the divided reference triangle, and its nodes' shape functions in the triangle that is divided
    reference, quads, nodes_on_sides = _reference_split()
    order = ORDERS[patch.cells.shape[1]]
    geometry = basix.create_element(
        basix.ElementFamily.P, basix.CellType.triangle, order, basix.LagrangeVariant.equispaced
    )
    to_dolfinx = perm_gmsh(mesh.CellType.triangle, patch.cells.shape[1])
    # [0] shape functions and [1:] their two derivatives, at the places of the quadrilaterals' nodes
    values = geometry.tabulate(1, reference)[..., 0]
    # numbers of the new nodes, and their coordinates in chart or space
    vertices, corners = np.unique(patch.corners, return_inverse=True)
    corners = corners.reshape(-1, 3)
    sides, numbers = _node_numbers(corners, len(vertices), len(reference), nodes_on_sides)
    dolfinx_cells = patch.cells[:, to_dolfinx]
    nodes_of_cells = np.einsum("qk,ckx->cqx", values[0], patch.nodes[dolfinx_cells])
    nodes = np.empty((numbers.max() + 1, patch.nodes.shape[1]))
    # a node of two glued sides gets the coordinates of either: they have one place in space
    nodes[numbers] = nodes_of_cells
    # a chart is mapped smoothly, so the normals are enough; a surface in space may have kinks
    if nodes.shape[1] == 2:
        offsets = surface_normal(patch.embedding, nodes)
    else:
        a1, a2 = np.einsum("dqk,ckx->dcqx", values[1:], patch.embedding(patch.nodes)[dolfinx_cells])
        offsets = _mitred_offsets(a1, a2, numbers, quads)
    edges = _halved_edges(patch, vertices, sides)
    places = patch.embedding(nodes)
    return Quadrilaterals(nodes, places, offsets, numbers[:, quads].reshape(-1, 9), edges)


def _halved_edges(patch: PatchMesh, vertices: Numbers, sides: Numbers) -> dict[str, Numbers]:
    """Return the named edges with each side divided into two: name -> pairs of new node numbers.

    Parameters
    ----------
    vertices
        Old number of each vertex.
    sides
        (s, 2) new numbers of the vertices of each side, the lower one first.
    """
    first_side_node = len(vertices)
    # three nodes between the vertices of each side have the numbers after those of all vertices,
    # side by side: the second of the three is the middle
    middle_of_side = {
        (int(sides[n, 0]), int(sides[n, 1])): first_side_node + 3 * n + 1 for n in range(len(sides))
    }
    edges = dict[str, Numbers]()
    for name, pairs in patch.edges.items():
        halves = list[list[int]]()
        # the new number of a vertex is its index in `vertices`
        for a, b in np.searchsorted(vertices, pairs):
            middle = middle_of_side[int(min(a, b)), int(max(a, b))]
            halves += [[int(a), middle], [middle, int(b)]]
        edges[name] = np.array(halves, dtype=np.int64).reshape(-1, 2)
    return edges


def _node_numbers(
    corners: Numbers, vertex_count: int, nodes_per_triangle: int, nodes_on_sides: list[list[int]]
) -> tuple[Numbers, Numbers]:
    """Number the nodes of divided triangles: vertices, three nodes on each side, then inner ones.

    Parameters
    ----------
    corners
        (m, 3) vertices of the triangles.
    nodes_on_sides
        For each side of the reference triangle its nodes, in the direction of the side.

    Returns
    -------
    sides
        (s, 2) vertices of each side, the lower one first.
    numbers
        (m, nodes) of the nodes of each triangle.
    """
    pairs = directed_sides(corners)
    sides, side_of_pair = np.unique(np.sort(pairs, axis=1), axis=0, return_inverse=True)
    side_numbers = side_of_pair.reshape(3, -1)
    is_backwards = (pairs[:, 0] > pairs[:, 1]).reshape(3, -1)
    numbers = np.empty((len(corners), nodes_per_triangle), dtype=np.int64)
    numbers[:, :3] = corners
    # two triangles share the nodes of a side, so these are counted from its lower vertex
    for side, nodes in enumerate(nodes_on_sides):
        position = np.where(is_backwards[side][:, None], [2, 1, 0], [0, 1, 2])
        numbers[:, nodes] = vertex_count + 3 * side_numbers[side][:, None] + position
    # all other nodes are inside and belong to one triangle
    inner = np.setdiff1d(np.arange(nodes_per_triangle), [0, 1, 2, *np.ravel(nodes_on_sides)])
    first_inner = vertex_count + 3 * len(sides)
    first_of_triangle = first_inner + len(inner) * np.arange(len(corners))[:, None]
    numbers[:, inner] = first_of_triangle + np.arange(len(inner))
    return sides, numbers


def surface_normal(embedding: Embedding, x: Array) -> Array:
    """Return unit normals (n, 3) at points (n, 2) of a chart, by central differences."""
    step = DIFFERENCE_STEP
    a1, a2 = (embedding(x + step * e) - embedding(x - step * e) for e in np.eye(2))
    return _unit(np.cross(a1, a2))


def _mitred_offsets(a1: Array, a2: Array, numbers: Numbers, quads: Numbers) -> Array:
    """Return offsets (nodes, 3) for a surface that may have kinks.

    An offset is the vector by which a node moves when all faces around it move outward by one. At
    a corner of quadrilaterals it is the mean m of the normals of the cells there, divided by the
    mean cosine between m and these normals. Each cell's normal is weighted by the cell's angle at
    the corner. This is exact between two faces, and between three that are normal to each other.

    At a corner this vector differs from the normal of a cell there. At the other nodes of the cell
    the offset is the cell's normal plus a difference that is interpolated bilinearly between the
    differences at its four corners.

    Parameters
    ----------
    a1, a2
        (cells, places, 3) tangents of the surface, at the places of each cell's nodes.
    numbers
        (cells, places) node of each place.
    quads
        (3, 9) places of the three quadrilaterals.
    """
    n = _unit(np.cross(a1, a2))
    # sum of the weighted normals of all cells at each node, and the sum of the weights
    weights = _angles_at_places(a1, a2)
    total = np.zeros((numbers.max() + 1, 3))
    np.add.at(total, numbers, weights[..., None] * n)
    total_weight = np.bincount(numbers.ravel(), weights.ravel())[:, None]
    # the mean normal total/total_weight, divided by |total|^2/total_weight^2
    mitre = total * total_weight / np.maximum(np.sum(total**2, axis=1, keepdims=True), TINY)
    # shape functions (9 nodes, 4 corners) of a quadrilateral, 1 at one corner and 0 at the others
    xi, eta = quadrilateral_nodes().T
    bilinear = np.column_stack([(1 - xi) * (1 - eta), xi * (1 - eta), (1 - xi) * eta, xi * eta])
    # difference from the cell's normal at corners, (cells, 3 quadrilaterals, 4 corners, 3)
    corners = quads[:, :4]  # the first four places of a quadrilateral
    difference = mitre[numbers[:, corners]] - n[:, corners]
    directions = n[:, quads] + np.einsum("kc,mqcx->mqkx", bilinear, difference)
    # mean over the quadrilaterals at each node
    nodes_of_quads = numbers[:, quads]
    offsets = np.zeros_like(total)
    np.add.at(offsets, nodes_of_quads, directions)
    return np.asarray(offsets / np.bincount(nodes_of_quads.ravel())[:, None])


def _angles_at_places(a1: Array, a2: Array) -> Array:
    """Return the angle (cells, places) of each triangle at places: pi but at its vertices.

    Parameters
    ----------
    a1, a2
        (cells, places, 3) tangents. The first three places are the vertices.
    """
    angles = np.full(a1.shape[:2], np.pi)
    # the two sides that leave each vertex
    sides_at_vertices = ((a1, a2), (a2 - a1, -a1), (-a2, a1 - a2))
    for vertex, (e, f) in enumerate(sides_at_vertices):
        cosine = np.sum(_unit(e[:, vertex]) * _unit(f[:, vertex]), axis=1)
        angles[:, vertex] = np.arccos(np.clip(cosine, -1, 1))
    return angles


def _unit(v: NDArray[Any]) -> Array:
    """Return vectors (..., 3) over their lengths."""
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), TINY))


def _reference_split() -> tuple[Array, Numbers, list[list[int]]]:
    """Divide the reference triangle into three quadrilaterals.

    Returns
    -------
    places
        (19, 2), vertices first.
    quads
        (3, 9) numbers of the places of each quadrilateral.
    nodes_on_sides
        For each side the numbers of the three places between its vertices.
    """
    # a column for each, to be multiplied by places (2,)
    xi, eta = quadrilateral_nodes().T[:, :, None]
    centre = VERTICES.mean(axis=0)
    places = [*VERTICES]
    quads = []
    # the quadrilateral at each vertex; its nodes are numbered at their first occurrence
    for i in range(3):
        vertex, next_vertex, previous_vertex = (VERTICES[(i + k) % 3] for k in range(3))
        middle, other_middle = (vertex + next_vertex) / 2, (vertex + previous_vertex) / 2
        quad = (
            (1 - xi) * (1 - eta) * vertex
            + xi * (1 - eta) * middle
            + xi * eta * centre
            + (1 - xi) * eta * other_middle
        )
        quad_numbers = []
        for x in quad:  # neighbouring quadrilaterals share places
            known_numbers = [n for n, y in enumerate(places) if np.allclose(x, y)]
            if not known_numbers:
                places.append(x)
            quad_numbers.append(known_numbers[0] if known_numbers else len(places) - 1)
        quads.append(quad_numbers)
    reference = np.array(places)

    def nodes_on_side(a: int, b: int) -> list[int]:
        """Return the numbers of the three places on the side between two vertices."""
        points = VERTICES[a] + SIDE_NODES[:, None] * (VERTICES[b] - VERTICES[a])
        return [int(np.argmin(np.linalg.norm(reference - x, axis=1))) for x in points]

    return reference, np.array(quads), [nodes_on_side(*side) for side in TRIANGLE_SIDES]


def quadrilateral_nodes() -> Array:
    """Return the nodes (9, 2) of the reference quadrilateral of degree 2, corners first."""
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType.quadrilateral, 2, basix.LagrangeVariant.equispaced
    )
    return np.asarray(element.points)


@dataclass(frozen=True)
class BodyMesh:
    """The mesh of a body on all ranks.

    Attributes
    ----------
    mesh
        Hexahedra with geometry of degree 2; the third coordinate of their reference cell runs
        outwards.
    faces
        Name -> facets (local numbers): of the outer face (`OUTER_FACE`, an empty name), and above
        each named edge of the mid-surface.
    points, normals
        Name -> (3,) position of a node in the middle of the thickness, and the mid-surface's normal
        there.
    patches
        Name -> whether each local cell is above that part of the mid-surface.
    layer_bounds
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
    layer_bounds: Array
    chart: Array
    heights: Array
    thickness: Array
    w0: Array | None = None

    def at_nodes(self, V: fem.FunctionSpace, values: Array) -> Array:
        """Return nodal values of a quadratic space for values (n, ...) at the geometry's nodes.

        Space and geometry have the same nodes in each cell, but number them differently.
        """
        nodes = V.dofmap.index_map
        nodal = np.empty((nodes.size_local + nodes.num_ghosts, *values.shape[1:]))
        nodal[V.dofmap.list] = values[compat.geometry_dofs(self.mesh)]
        return nodal


def sweep(
    patch: PatchMesh,
    h: float,
    layers: int | Sequence[float],
    comm: MPI.Comm,
    factor: Callable[[Array], Array] | None = None,
) -> BodyMesh:
    """Make the mesh of a body on all ranks; collective.

    Parameters
    ----------
    patch
        Triangulation of the mid-surface, which every rank has: it is small.
    h
        The thickness over R.
    layers
        Number of cells through the thickness, or where they begin and end, from 0 to 1.
    factor
        Places (n, 3) of the mid-surface -> factor (n,) of the thickness; None for 1.

    Raises
    ------
    MeshError
        On every rank, if the body overlaps itself.
    """
    quads = split(patch)
    bounds, heights = _bounds_and_levels(layers)
    factors = np.ones(len(quads.places)) if factor is None else factor(quads.places)
    thickness = h * factors
    # distance of each level from the mid-surface, (nodes of it, levels)
    z = (heights - MIDSURFACE_HEIGHT) * thickness[:, None]
    X = (quads.places[:, None] + z[..., None] * quads.offsets[:, None]).reshape(-1, 3)
    layer_count = len(bounds) - 1
    cells = _swept_cells(quads.cells, layer_count)
    _refuse_overlap(X, cells)
    domain = create_mesh(comm, basix.ufl.element("Lagrange", "hexahedron", 2, shape=(3,)), cells, X)
    # number of the hexahedron in `cells`: layers vary fastest, then the triangle's three parts
    original_cells = domain.topology.original_cell_index
    triangle, layer = original_cells // (3 * layer_count), original_cells % layer_count
    points = {name: patch.embedding(x[None])[0] for name, x in patch.points.items()}
    # the body's node above node q of the mid-surface, at level k, has the number q levels + k
    node, level = np.divmod(domain.geometry.input_global_indices, len(heights))
    w0 = None
    if isinstance(patch.embedding, DeviatedEmbedding):
        w0 = patch.embedding.w0(quads.nodes)[node]
    return BodyMesh(
        mesh=domain,
        faces=_named_faces(domain, quads, len(heights)),
        points=points,
        normals={name: _normal_at(x, quads) for name, x in points.items()},
        patches={name: mask[triangle] for name, mask in patch.patches.items()},
        layer_bounds=np.column_stack([bounds[layer], bounds[layer + 1]]),
        chart=quads.nodes[node],
        heights=heights[level],
        thickness=thickness[node],
        w0=w0,
    )


def _bounds_and_levels(layers: int | Sequence[float]) -> tuple[Array, Array]:
    """Return where layers begin and end, and the heights of all levels of nodes.

    Both are fractions of the thickness, from 0 inside to 1 outside. The levels are the begin of the
    first layer, then the middle and the end of each layer.

    Parameters
    ----------
    layers
        Number of layers of equal height, or where they begin and end.
    """
    bounds: Array = np.array(layers)
    if isinstance(layers, int):
        bounds = np.linspace(0, 1, layers + 1, dtype=np.float64)
    middles_and_ends = [((a + b) / 2, b) for a, b in pairwise(bounds)]
    return bounds, np.concatenate([bounds[:1], *middles_and_ends])


def _normal_at(x: Array, quads: Quadrilaterals) -> Array:
    """Return the unit normal (3,) of the mid-surface at the node that is nearest to a place."""
    nearest = np.argmin(np.linalg.norm(quads.places - x, axis=1))
    offset = quads.offsets[nearest]
    return np.asarray(offset / np.linalg.norm(offset))


def _refuse_overlap(X: Array, cells: Numbers) -> None:
    """Check that no cell is turned over: the Jacobian is positive at all nodes of all cells.

    Parameters
    ----------
    X
        (n, 3) nodes.
    cells
        (m, 27) node numbers.

    Raises
    ------
    MeshError
        With the place of a cell that is turned over.
    """
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType.hexahedron, 2, basix.LagrangeVariant.equispaced
    )
    # derivatives of the shape functions at the nodes
    tables = element.tabulate(1, element.points)[1:, :, :, 0]
    for some_cells in np.array_split(cells, len(cells) // CELLS_PER_CHECK + 1):
        # determinants of the Jacobian, (cells, nodes)
        volumes = np.linalg.det(np.einsum("dqk,ckx->cqdx", tables, X[some_cells]))
        if (volumes <= 0).any():
            first_bad = np.argwhere(volumes <= 0)[0][0]
            place = X[some_cells[first_bad]].mean(axis=0)
            raise MeshError(
                f"model: solid: the body overlaps itself around {place_text(place)}/R: "
                "half its thickness is more than the radius of curvature, or than a fold leaves "
                "beside it"
            )


def _swept_cells(quads: Numbers, layers: int) -> Numbers:
    """Return hexahedra (quads * layers, 27) in the order of basix.

    The node of the body above node q of the mid-surface, at level k, has the number q levels + k. A
    layer has three levels, of which neighbours share one.

    Parameters
    ----------
    quads
        (m, 9) nodes of the quadrilaterals.
    layers
        Number of layers.
    """
    points = basix.create_element(
        basix.ElementFamily.P, basix.CellType.hexahedron, 2, basix.LagrangeVariant.equispaced
    ).points
    # for each node of a hexahedron, the node of the quadrilateral below it, and its level (0 to 2)
    distances = np.linalg.norm(points[:, None, :2] - quadrilateral_nodes()[None], axis=2)
    node_of_quad = np.argmin(distances, axis=1)
    level = np.rint(2 * points[:, 2]).astype(np.int64)
    levels = 2 * layers + 1
    # a layer begins two levels above the one before
    cells = [quads[:, node_of_quad] * levels + level + 2 * layer for layer in range(layers)]
    return np.stack(cells, axis=1).reshape(-1, 27)


def _named_faces(
    domain: mesh.Mesh, quads: Quadrilaterals, levels: int
) -> dict[str, NDArray[np.int32]]:
    """Return the facets (local numbers) of the outer face, and those above each named edge.

    They are found by the numbers of their nodes.

    Parameters
    ----------
    levels
        Number of nodes through the thickness.
    """
    # dimensions: 0 vertices, 2 facets, 3 cells; what the calls below need
    for pair in ((2, 3), (2, 0), (0, 3), (3, 2)):
        domain.topology.create_connectivity(*pair)
    facets = mesh.exterior_facet_indices(domain.topology)
    vertices = domain.topology.index_map(0)
    vertex_numbers = np.arange(vertices.size_local + vertices.num_ghosts, dtype=np.int32)
    # number of each vertex as `sweep` gave it, from which its node of the mid-surface and its level
    # follow
    nodes = mesh.entities_to_geometry(domain, 0, vertex_numbers)
    numbers = domain.geometry.input_global_indices[nodes[:, 0]]
    corners = domain.topology.connectivity(2, 0).array.reshape(-1, 4)[facets]
    chart_nodes, level = np.divmod(numbers[corners], levels)
    faces = {OUTER_FACE: facets[(level == levels - 1).all(axis=1)]}
    for name, pairs in quads.edges.items():
        pairs_of_edge = as_set(pairs)
        # a facet above an edge has two nodes of the mid-surface, those of a pair
        is_above = [len(set(c)) == 2 and (min(c), max(c)) in pairs_of_edge for c in chart_nodes]
        faces[name] = facets[np.array(is_above, dtype=bool)]
    return faces


def quadratic_space(domain: mesh.Mesh) -> fem.FunctionSpace:
    """Return the space of displacements of the mesh's own degree: rigid motions are exact."""
    return fem.functionspace(domain, ("Lagrange", 2, (3,)))


def face_measure(domain: mesh.Mesh, parts: Sequence[NDArray[np.int32]]) -> ufl.Measure:
    """Return the measure of undeformed area over some facets.

    Parameters
    ----------
    parts
        For each part the local numbers of its facets. Part i has the tag i + 1.
    """
    facets = np.concatenate(parts)
    tags = np.repeat(np.arange(1, len(parts) + 1, dtype=np.int32), [len(part) for part in parts])
    order = np.argsort(facets)
    tagged = mesh.meshtags(domain, 2, facets[order], tags[order])
    return ufl.Measure(
        "ds",
        domain=domain,
        subdomain_data=tagged,
        metadata={"quadrature_degree": QUADRATURE_DEGREE},
    )

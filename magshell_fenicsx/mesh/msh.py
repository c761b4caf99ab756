"""Surface meshes of gmsh (.msh) with triangles of order 1, 2 or 3.

`read_msh` makes a `PatchMesh` of a file, of the triangles that a program gives in its place, or of
several shells. It orients the triangles, takes T-junctions apart, names edges and patches by
physical groups, and finds named points among the vertices. Messages tell places in the coordinates
of the file.

At a T-junction an edge of a sheet ends on another sheet; the sheet gets nodes of its own there. A
patch is a named part of the surface. Edges and curves are given by the pairs of vertices of their
sides. Cells have 3, 6 or 10 nodes in gmsh's order, vertices first. A held edge is clamped or
hinged. A sector is the part between two symmetry planes. R is the reference length.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.midsurface import nodal_normals
from magshell_fenicsx.mesh.mirror import Mirror, Sector, cut
from magshell_fenicsx.mesh.msh_format import MshContent, parsed
from magshell_fenicsx.mesh.multi_shell import MultiShellMesh
from magshell_fenicsx.mesh.non_manifold import edges_with_new_nodes, separate_sheets
from magshell_fenicsx.mesh.patch import (
    MeshError,
    PatchMesh,
    SurfaceTriangles,
    among,
    as_set,
    border_pairs,
    directed_sides,
    inner_pairs,
    place_text,
)
from magshell_fenicsx.mesh.vertex_spacing import distinguishable_texts
from magshell_fenicsx.platform.input_files import Files

if TYPE_CHECKING:
    from magshell_fenicsx.mesh.user_mesh import UserMesh

Array = NDArray[np.float64]
Cells = NDArray[np.int64]
REVERSED_NODES = {
    3: [0, 2, 1],
    6: [0, 2, 1, 5, 4, 3],
    10: [0, 2, 1, 8, 7, 6, 5, 4, 3, 9],
}  # nodes of a triangle -> gmsh's order of the nodes of the reversed one
FLAT_TRIANGLE_TOLERANCE = 1e-12  # area over the square of a side, below which there is no area
SAME_PLACE_TOLERANCE = 1e-9  # over the extent: nodes at one place
AREA_TIE_TOLERANCE = 1e-6  # over the area: a difference of areas that decides nothing
POINT_TOLERANCE = 1e-6  # over the extent: distance up to which a vertex counts as a named point
HEIGHT_DIGITS = 9  # decimals of coordinates over R by which the highest vertex is found
REST = "rest"  # name of the border sides that are in no physical curve
TRIANGLE_TYPES = ("Triangle 3", "Triangle 6", "Triangle 10")  # gmsh's names
LINE_TYPES = ("Line 2", "Line 3", "Line 4")


def oriented(nodes: Array, cells: Cells, first_copy: int | None = None) -> Cells:
    """Return triangles (m, 3 | 6 | 10) with one orientation in each connected component.

    It is the orientation that the larger part of the component's area has. If both parts are equal,
    it is the one whose normals point upwards in the mean.

    Parameters
    ----------
    nodes, cells
        (n, 3) places, and (m, 3 | 6 | 10) node numbers; an edge has two triangles at most.
    first_copy
        Nodes from this one on are copies of others at the same places, on purpose, for sheets that
        end there. None without copies.

    Raises
    ------
    MeshError
        If a triangle has no area, or the surface has one side or is torn.
    """
    areas = _areas(nodes, cells)
    edges = directed_sides(cells)
    side, opposite_side = _sides_of_inner_edges(edges)
    # neighbours that agree run through their edge in opposite directions
    agree = edges[side, 0] != edges[opposite_side, 0]
    m = len(cells)
    # side n is one of triangle n % m: first sides of all triangles come first, then second, third
    cell, neighbour = side % m, opposite_side % m
    # in the graph each triangle stands twice, as it is (i) and reversed (i + m); orientations of
    # neighbours that agree are joined. An orientable component then makes two separate parts
    rows = np.concatenate([cell, cell + m])
    columns = np.concatenate(
        [np.where(agree, neighbour, neighbour + m), np.where(agree, neighbour + m, neighbour)]
    )
    graph = scipy.sparse.coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * m, 2 * m))
    _, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    if (part[:m] == part[m:]).any():
        place = nodes[edges[side[~agree][0]]].mean(axis=0)
        raise MeshError(
            "the surface has only one side: its normals cannot agree across the edge around "
            f"{place_text(place)}"
        )
    _refuse_torn(nodes, cells, part[:m], first_copy)
    # in each component, either the triangles oriented as its first one stay, or all others do
    keeps_orientation = np.empty(m, dtype=bool)
    components = np.minimum(part[:m], part[m:])  # one number for both parts
    for component in np.unique(components):
        in_component = np.flatnonzero(components == component)
        as_first = part[in_component] == part[in_component[0]]
        is_reversed = _is_reversed(nodes, cells[in_component], areas[in_component], as_first)
        keeps_orientation[in_component] = ~as_first if is_reversed else as_first
    reversed_cells = cells[:, REVERSED_NODES[cells.shape[1]]]
    return np.where(keeps_orientation[:, None], cells, reversed_cells)


def _areas(nodes: Array, cells: Cells) -> Array:
    """Return the areas (m,) of triangles, by their vertices.

    Raises
    ------
    MeshError
        If a triangle has no area.
    """
    v0, v1, v2 = (nodes[cells[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(v1 - v0, v2 - v0), axis=1) / 2
    squared_side = np.linalg.norm(v1 - v0, axis=1) ** 2
    flat = np.flatnonzero(areas <= FLAT_TRIANGLE_TOLERANCE * squared_side)
    if len(flat):
        raise MeshError(f"the triangle at {place_text(v0[flat[0]])} has no area")
    return np.asarray(areas)


def _sides_of_inner_edges(sides: Cells) -> tuple[Cells, Cells]:
    """Return the numbers of the first and of the second side at each edge with two triangles.

    Parameters
    ----------
    sides
        (3 m, 2) of all triangles, as of `directed_sides`; an edge has two triangles at most.
    """
    _, edge_of_side, side_counts = np.unique(
        np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    # sort the sides by edge; the two sides of an inner edge then follow one another
    sides_by_edge = np.argsort(edge_of_side.ravel(), kind="stable")
    first_of_inner = np.cumsum(side_counts)[side_counts == 2] - 2
    return sides_by_edge[first_of_inner], sides_by_edge[first_of_inner + 1]


def _is_reversed(nodes: Array, cells: Cells, areas: Array, as_first: NDArray[np.bool_]) -> bool:
    """Return whether a component shall have the orientation opposite to its first triangle's.

    The orientation with the larger area is taken. If both areas are equal, it is the one in which
    the sum of all normals points upwards, along e3. If the component of the sum along e3 is zero,
    that along e2 decides, then that along e1, and at last whether the normals point out of the
    volume. The numbers of triangles never decide, as they would make the orientation depend on the
    mesh.

    Parameters
    ----------
    cells, areas
        Triangles of the component and their areas.
    as_first
        Whether each triangle has the orientation of the first one.
    """
    area_as_first, total_area = areas[as_first].sum(), areas.sum()
    if abs(2 * area_as_first - total_area) > AREA_TIE_TOLERANCE * total_area:
        return bool(2 * area_as_first < total_area)
    a, b, c = (nodes[cells[:, i]] - nodes[np.unique(cells)].mean(axis=0) for i in range(3))
    # area vectors, all in the orientation of the first triangle
    vectors = np.where(as_first[:, None], 1, -1) * np.cross(b - a, c - a) / 2
    # proportional to the enclosed volume: vertices a are relative to the mean of all nodes
    outward = (a * vectors).sum(axis=1) / np.ptp(nodes, axis=0).max()
    # the first criterion that is not zero by symmetry decides
    for components in (vectors[:, 2], vectors[:, 1], vectors[:, 0], outward):
        if abs(total := components.sum()) > AREA_TIE_TOLERANCE * total_area:
            return bool(total < 0)
    return False


def _refuse_torn(
    nodes: Array, cells: Cells, component: NDArray[np.int32], first_copy: int | None
) -> None:
    """Check that components which are not connected have no nodes at one place.

    Parameters
    ----------
    component
        (m,) number of the connected component of each triangle.
    first_copy
        Nodes from this one on are copies of others on purpose; None without.

    Raises
    ------
    MeshError
        With the place of two nodes.
    """
    if (component == component[0]).all():
        return  # connected; two nodes at one place then show as border edges without a name
    vertices = np.unique(cells[:, :3])
    if first_copy is not None:
        vertices = vertices[vertices < first_copy]
    near_pairs = scipy.spatial.cKDTree(nodes[vertices]).query_pairs(
        SAME_PLACE_TOLERANCE * np.ptp(nodes, axis=0).max(), output_type="ndarray"
    )
    if len(near_pairs):
        place = place_text(nodes[vertices[near_pairs[0, 0]]])
        raise MeshError(
            f"the surface is torn: there are two nodes at {place}, and its parts are not connected"
        )


def border_edges(nodes: Array, cells: Cells, curves: Mapping[str, Cells]) -> dict[str, Cells]:
    """Return the part of each named curve that is a border of the surface.

    Border sides in no curve are the edge `REST`.

    Parameters
    ----------
    curves
        Name -> (e, 2) vertex pairs.

    Raises
    ------
    MeshError
        If triangles beside a border side without a name are not connected (a node stands twice in
        the file), or if the surface touches itself in a vertex.
    """
    border = border_pairs(directed_sides(cells))
    edges = among(curves, as_set(border))
    named_pairs = {pair for lines in edges.values() for pair in as_set(lines)}
    unnamed = sorted(as_set(border) - named_pairs)
    if unnamed:
        _refuse_doubled_nodes(nodes, cells, np.unique(unnamed))
        if REST in curves:
            middle = nodes[list(unnamed[0])].mean(axis=0)
            raise MeshError(
                f"the surface ends at the edge around {place_text(middle)}, which belongs to no "
                f"physical curve, and there is one called {REST}: give it another name"
            )
        edges[REST] = np.array(unnamed, dtype=np.int64)
    ends, counts = np.unique(border, return_counts=True)
    if (counts > 2).any():  # a vertex has two border edges
        raise MeshError(
            f"the surface touches itself in the vertex {place_text(nodes[ends[counts > 2][0]])}"
        )
    return edges


def _refuse_doubled_nodes(nodes: Array, cells: Cells, ends: NDArray[np.int64]) -> None:
    """Refuse a second node at the place of an end of an unnamed side: triangles are not connected.

    `ends` are the nodes at these ends.
    """
    vertices = np.unique(cells[:, :3])
    extent = float(np.ptp(nodes[vertices], axis=0).max())
    tree = scipy.spatial.cKDTree(nodes[vertices])
    counts = tree.query_ball_point(nodes[ends], SAME_PLACE_TOLERANCE * extent, return_length=True)
    if (counts > 1).any():
        place = place_text(nodes[ends[int(np.argmax(counts > 1))]])
        raise MeshError(
            f"there are two nodes at {place}: the triangles beside it are not connected"
        )


@dataclass(frozen=True)
class MeshFile:
    """A .msh file, or what a program gives under that name: triangles or several shells.

    Attributes
    ----------
    path
        Path of the file.
    scale
        Factor from its coordinates to lengths over R.
    normals
        Whether nodes are places followed by normals, (n, 6): the mean normals of the triangles
        around each node.
    files
        Reads the file.
    in_memory
        The triangles or the shells; None for a file.
    """

    path: Path
    scale: float
    normals: bool = False
    files: Files = field(default_factory=Files, compare=False)
    in_memory: SurfaceTriangles | MultiShellMesh | None = None

    @property
    def user_mesh(self) -> "UserMesh | None":
        """The mesh of a program; None for a file."""
        return self.in_memory.user_mesh if self.in_memory else None

    def content(self) -> SurfaceTriangles:
        """Return the triangles of the file or of the program.

        Raises
        ------
        MeshError
            If the file cannot be read.
        """
        assert not isinstance(self.in_memory, MultiShellMesh)
        return self.in_memory or _triangles_of_file(self)


def space_embedding(x: Array) -> Array:
    """Return the places (..., 3) of nodes in space: the embedding of a mesh without a chart."""
    return x[..., :3]


def node_normals(x: Array) -> Array:
    """Return unit normals (n, 3) of nodes (n, 6), which are places and normals."""
    return np.asarray(x[:, 3:] / np.linalg.norm(x[:, 3:], axis=1)[:, None])


def read_msh(
    file: MeshFile,
    points: Mapping[str, Array],
    mirror: Mirror | None = None,
    held_edges: Collection[str] = (),
    anywhere: Collection[str] = (),
) -> PatchMesh:
    """Read a surface; call it on one rank only.

    Physical groups of surfaces become named patches, those of curves named edges, or lines within
    the surface where they have triangles on both sides. Triangles whose
    orientation differs from that of the larger area are reversed.

    Parameters
    ----------
    file
        The mesh file, or what a program gives in its place.
    points
        Named places (3,) over R that must be vertices. If no "pole" is named, the highest vertex is
        the pole. Of several highest vertices it is one on no held edge, and best the pole of one of
        several shells.
    mirror
        Symmetry plane or sector, whose half or sector of the surface is returned; None for all.
    held_edges
        Names of edges that are clamped or hinged.
    anywhere
        Names of points that need not be vertices; those that are none are left out.

    Returns
    -------
    The triangulation with places over R, and the named points.

    Raises
    ------
    MeshError
        If the file cannot be read, or its surface cannot carry a shell. Places in messages are
        those of the file.
    """
    # several shells have been triangulated and cut already
    if isinstance(file.in_memory, MultiShellMesh):
        return _with_points_of_shells(file, file.in_memory.patch, points, held_edges)
    try:
        patch = _patch_of_triangles(file)
    except MeshError as e:
        raise MeshError(f"shell: {e}" if file.in_memory else f"shell.file: {e}") from None
    if isinstance(mirror, Sector) and patch.t_junctions:
        raise MeshError(
            f"symmetry: {mirror.waves}: not with a T-junction in the mesh file: take symmetry: half"
        )
    patch = cut(patch, mirror) if mirror else patch
    vertices = _named_vertices(patch, points, file.scale, held_edges, anywhere=anywhere)
    return replace(patch, points=vertices)


def _with_points_of_shells(
    file: MeshFile, patch: PatchMesh, points: Mapping[str, Array], held_edges: Collection[str]
) -> PatchMesh:
    """Return the triangulation of several shells with a vertex for each named point.

    A point that a shell itself has keeps the vertex of this shell, as another shell may have a
    vertex at the same place. Other names of the same place get this vertex too. All other points
    take the vertex that is at their place.

    Parameters
    ----------
    points
        Name -> place (3,) over R.
    held_edges
        Names of edges that are clamped or hinged.
    """
    points_of_shells = dict[str, Array]()
    for name_in_shell, x in patch.points.items():
        for name in _names_of_same_place(points, name_in_shell):
            points_of_shells[name] = x
    other_points = {name: x for name, x in points.items() if name not in points_of_shells}
    pole_names = [f"{shell}_pole" for shell in patch.shells]
    poles = [patch.points[name] for name in pole_names if name in patch.points]
    vertices = _named_vertices(patch, other_points, file.scale, held_edges, poles)
    return replace(patch, points={**vertices, **points_of_shells})


def _names_of_same_place(points: Mapping[str, Array], name: str) -> list[str]:
    """Return the names of all points at the place of a named point; empty without it."""
    if name not in points:
        return []
    return [other_name for other_name, x in points.items() if np.array_equal(x, points[name])]


def _patch_of_triangles(file: MeshFile) -> PatchMesh:
    """Return the whole surface of a file or of a program, oriented and over R, without points.

    Nodes without a triangle are dropped. Sheets that end on another sheet are separated at
    T-junctions.

    Raises
    ------
    MeshError
        If the surface cannot carry a shell.
    """
    triangles = file.content()
    nodes, cells, edges = _without_unused_nodes(file, triangles)
    # take T-junctions apart. `origin` is the old node of each node: copies at T-junctions follow
    # the old nodes. Each T-junction has a name, the pairs of its edge, and its supporting triangles
    first_copy = len(nodes)
    origin, cells, t_junctions = separate_sheets(nodes, cells)
    nodes = nodes[origin]
    if t_junctions:
        edges = edges_with_new_nodes(edges, cells, origin)
    for name, t_junction in t_junctions.items():
        if name in edges:
            raise MeshError(
                f"{file.path}: the physical curve {name}: is how a T-junction is called: "
                "take another"
            )
        edges[name] = t_junction.pairs
    # give all triangles one orientation
    cells_of_file = cells
    cells = oriented(nodes, cells, first_copy if t_junctions else None)
    # reversing exchanges the second and the third vertex
    is_reversed = (cells[:, 1] != cells_of_file[:, 1]).astype(np.int64)
    curves, edges = edges, border_edges(nodes, cells, edges)
    inner_lines = among(curves, inner_pairs(directed_sides(cells)))
    for name in inner_lines.keys() & edges.keys() - t_junctions.keys():
        raise MeshError(
            f"{file.path}: the physical curve {name}: is at the edge of the surface in part, and "
            "within it in part: make two curves of it"
        )
    nodes = nodes * file.scale
    if file.normals:
        nodes = np.column_stack([nodes, nodal_normals(nodes, cells)])
    return PatchMesh(
        nodes,
        cells,
        space_embedding,
        edges,
        patches=triangles.patches,
        source_triangles=np.column_stack([np.arange(len(cells)), is_reversed]),
        t_junctions={name: t_junction.supports for name, t_junction in t_junctions.items()},
        inner_lines=inner_lines,
    )


def _without_unused_nodes(
    file: MeshFile, triangles: SurfaceTriangles
) -> tuple[Array, Cells, dict[str, Cells]]:
    """Return nodes, cells and edges of triangles, with the nodes of triangles alone.

    Raises
    ------
    MeshError
        If an edge has a node without a triangle.
    """
    nodes, cells, edges = triangles.nodes, triangles.cells, dict(triangles.edges)
    used, numbers = np.unique(cells, return_inverse=True)
    # old number of a node -> its new one; -1 without a triangle
    new_number = np.full(len(nodes), -1, dtype=np.int64)
    new_number[used] = np.arange(len(used))
    for name, pairs in edges.items():
        edges[name] = new_number[pairs]
        if (edges[name] < 0).any():
            raise MeshError(
                f"{file.path}: the physical curve {name}: beside it there are no triangles: put "
                "the surface there in a physical group too (gmsh saves nothing else where there "
                "are groups), or save all elements"
            )
    return nodes[used], numbers.reshape(cells.shape), edges


def cell_count(file: MeshFile) -> int:
    """Return the number of triangles of a file or program.

    It is 0 for a file that cannot be read, which `read_msh` reports.
    """
    if file.in_memory:
        return len(file.in_memory.cells)
    try:
        content = parsed(file.files.content(file.path))
    except (OSError, MeshError):
        return 0
    return sum(len(nodes) for _, dim, _, nodes in content.blocks if dim == 2)


def _named_vertices(
    patch: PatchMesh,
    points: Mapping[str, Array],
    scale: float,
    held_edges: Collection[str],
    shell_poles: Sequence[Array] = (),
    anywhere: Collection[str] = (),
) -> dict[str, Array]:
    """Return the vertex (d,) of each named point, and the highest vertex as "pole".

    Of several highest vertices the pole is one on no held edge, and best a shell's own pole. A
    point that is called "pole" replaces it.

    Parameters
    ----------
    points
        Name -> place (3,) over R.
    held_edges
        Names of edges that are clamped or hinged.
    shell_poles
        Poles (d,) of several shells.
    scale
        Factor from the file's coordinates to lengths over R, for messages.
    anywhere
        Names of points that need not be vertices.

    Raises
    ------
    MeshError
        If a named point is no vertex.
    """
    numbers = np.unique(patch.cells[:, :3])
    corners = patch.nodes[numbers]  # all vertices
    held_vertices = [pairs.ravel() for name, pairs in patch.edges.items() if name in held_edges]
    is_free = ~np.isin(numbers, np.concatenate([*held_vertices, np.zeros(0, dtype=np.int64)]))
    vertices = {"pole": _pole(corners, is_free, shell_poles)}
    for name, x in points.items():
        distance = np.linalg.norm(corners[:, :3] - x[:3], axis=1)
        nearest = corners[np.argmin(distance)]
        if distance.min() > POINT_TOLERANCE * np.ptp(corners[:, :3], axis=0).max():
            if name in anywhere:
                continue
            place, nearest_place = np.asarray(x[:3] / scale), np.asarray(nearest[:3] / scale)
            text, nearest_text = distinguishable_texts(place, nearest_place)
            raise MeshError(
                f"points.{name}: ({text}) in the file's coordinates is no vertex of the mesh; "
                f"the nearest is ({nearest_text}). Points of stress that are neither loaded nor "
                "held may be anywhere"
            )
        vertices[name] = nearest
    return vertices


def _pole(corners: Array, is_free: NDArray[np.bool_], shell_poles: Sequence[Array]) -> Array:
    """Return the highest of all vertices and shells' poles, (d,).

    Parameters
    ----------
    corners, is_free
        (n, d) vertices, and whether each is on no held edge.
    shell_poles
        Poles (d,) of several shells.
    """
    candidates = np.array([*corners, *shell_poles])
    x, y, z = np.round(candidates[:, :3], HEIGHT_DIGITS).T
    is_shell_pole = np.arange(len(x)) >= len(corners)
    # a shell's pole is free if the vertex at its place is so
    nearest_corner = scipy.spatial.cKDTree(corners[:, :3]).query(candidates[:, :3])[1]
    # the last key counts first: height, free or held, a shell's pole or not, then y and x
    order = np.lexsort((x, y, is_shell_pole, is_free[nearest_corner], z))
    return np.asarray(candidates[order[-1]])


def _triangles_of_file(file: MeshFile) -> SurfaceTriangles:
    """Return the triangles of a file, with curves and patches by its physical groups.

    Coordinates are those of the file.

    Raises
    ------
    MeshError
        If the file cannot be read, or has no triangles or several orders of triangles.
    """
    try:
        content = parsed(file.files.content(file.path))
    except FileNotFoundError:
        raise MeshError(f"{file.path}: there is no such mesh file") from None
    except OSError as e:
        raise MeshError(f"{file.path}: cannot be read: {e.strerror}") from None
    except MeshError as e:
        raise MeshError(f"{file.path}: {e}") from None
    if not len(content.tags):
        raise MeshError(f"{file.path}: there is no mesh in it")
    blocks = _blocks_of_dimension(file, content, 2, TRIANGLE_TYPES)
    if not blocks:
        raise MeshError(
            f"{file.path}: it has no triangles: put the surface in a physical group (gmsh saves "
            "nothing else where there are groups), and mesh it (gmsh -2)"
        )
    if len({nodes.shape[1] for _, nodes in blocks}) != 1:
        raise MeshError(f"{file.path}: it has triangles of several orders")
    cells = _node_indices(file, content, np.concatenate([nodes for _, nodes in blocks]))
    # a patch is a physical group of surfaces: a triangle is in it if its surface is
    entity = np.concatenate([np.full(len(nodes), entity) for entity, nodes in blocks])
    patches = {name: np.isin(entity, entities) for name, entities in content.groups[2].items()}
    # an edge is a physical group of curves; a line begins with its two vertices
    edges = {}
    for name, entities in content.groups[1].items():
        lines = [
            nodes[:, :2]
            for entity, nodes in _blocks_of_dimension(file, content, 1, LINE_TYPES)
            if entity in entities
        ]
        if lines:  # a curve of the geometry may have no elements
            edges[name] = _node_indices(file, content, np.concatenate(lines))
    return SurfaceTriangles(content.places, cells, edges, patches)


def _blocks_of_dimension(
    file: MeshFile, content: MshContent, dimension: int, allowed_types: Collection[str]
) -> list[tuple[int, NDArray[np.int64]]]:
    """Return entity and node numbers (m, k) of each block of elements of one dimension.

    gmsh's entities are the surfaces and curves of the geometry; a block has the elements of one
    type on one entity.

    Raises
    ------
    MeshError
        If a block has elements of another type than the allowed ones.
    """
    blocks = []
    for name, dim, entity, nodes in content.blocks:
        if dim == dimension:
            if name not in allowed_types:
                raise MeshError(
                    f"{file.path}: it has elements {name}; "
                    "allowed are triangles of order 1, 2 and 3"
                )
            blocks.append((entity, nodes))
    return blocks


def _node_indices(
    file: MeshFile, content: MshContent, numbers: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the indices in the content of nodes with numbers (tags) of the file, in any shape.

    Raises
    ------
    MeshError
        If a node is not there.
    """
    order = np.argsort(content.tags)
    # where each number stands in the sorted tags; beyond the last tag it gets the last place
    positions = np.searchsorted(content.tags, numbers, sorter=order).clip(max=len(order) - 1)
    indices: NDArray[np.int64] = order[positions]
    # a missing number has found another tag
    if (missing := content.tags[indices] != numbers).any():
        raise MeshError(
            f"{file.path}: it has elements with the node {numbers[missing][0]}, which is not there"
        )
    return indices

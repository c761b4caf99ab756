"""Reading a surface mesh from a file of gmsh (.msh), with triangles of order 1, 2 or 3."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.assembly import Assembly
from magshell_fenicsx.mesh.branches import renamed, separated
from magshell_fenicsx.mesh.distinct import told_apart
from magshell_fenicsx.mesh.midsurface import nodal_normals
from magshell_fenicsx.mesh.mirror import Mirror, Sector, cut
from magshell_fenicsx.mesh.msh_format import Content, parsed
from magshell_fenicsx.mesh.patch import (
    MeshError,
    PatchMesh,
    Triangles,
    as_set,
    border_pairs,
    directed_sides,
    on_border,
    place_text,
)
from magshell_fenicsx.platform.reading import Files

if TYPE_CHECKING:
    from magshell_fenicsx.mesh.given import Home

Array = NDArray[np.float64]
Cells = NDArray[np.int64]
TURNED = {
    3: [0, 2, 1],
    6: [0, 2, 1, 5, 4, 3],
    10: [0, 2, 1, 8, 7, 6, 5, 4, 3, 9],
}  # nodes of a reversed triangle, gmsh's order
SAME_PLACE = 1e-9  # of the extent
TIE = 1e-6  # of the area: a difference that decides nothing


def oriented(nodes: Array, cells: Cells, first_copy: int | None = None) -> Cells:
    """The triangles (m, 3 | 6 | 10); those of a piece have one orientation, that of its larger
    area, or of a rule.

    An edge has two at most. Nodes from `first_copy` on stand at places of others: see
    `branches.separated`.

    Raises
    ------
    MeshError
        If a triangle has no area, or the surface has one side or is torn.
    """
    a, b, c = (nodes[cells[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    flat = np.flatnonzero(areas <= 1e-12 * np.linalg.norm(b - a, axis=1) ** 2)
    if len(flat):
        raise MeshError(f"the triangle at {place_text(a[flat[0]])} has no area")
    edges = directed_sides(cells)
    _, which, times = np.unique(
        np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    order = np.argsort(which.ravel(), kind="stable")
    first = np.cumsum(times)[times == 2] - 2
    one, other = order[first], order[first + 1]
    agree = (
        edges[one, 0] != edges[other, 0]
    )  # neighbours run through their edge in opposite directions
    m = len(cells)
    left, right = one % m, other % m
    # each triangle counts twice, once in each orientation: an orientable surface then has two
    # separate copies
    rows = np.concatenate([left, left + m])
    columns = np.concatenate([np.where(agree, right, right + m), np.where(agree, right + m, right)])
    graph = scipy.sparse.coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * m, 2 * m))
    _, copy = scipy.sparse.csgraph.connected_components(graph, directed=False)
    if (copy[:m] == copy[m:]).any():
        place = nodes[edges[one[~agree][0]]].mean(axis=0)
        raise MeshError(
            f"the surface has only one side: its normals cannot agree across the edge around {place_text(place)}"
        )
    _refuse_torn(nodes, cells, copy[:m], first_copy)
    as_first = np.empty(m, dtype=bool)
    pieces = np.minimum(copy[:m], copy[m:])
    for piece in np.unique(pieces):
        of = np.flatnonzero(pieces == piece)
        same = copy[of] == copy[of[0]]
        as_first[of] = ~same if _other_side(nodes, cells[of], areas[of], same) else same
    return np.where(as_first[:, None], cells, cells[:, TURNED[cells.shape[1]]])


def _other_side(nodes: Array, cells: Cells, areas: Array, as_first: NDArray[np.bool_]) -> bool:
    """Whether the normals are those of the triangles that are not `as_first`: of the larger area.

    Halves of the same size, as refined meshes have them, do not depend on the numbers of triangles:
    their normals point upwards on the whole, else along e2 or e1, else out of the volume.
    """
    same, whole = areas[as_first].sum(), areas.sum()
    if abs(2 * same - whole) > TIE * whole:
        return bool(2 * same < whole)
    a, b, c = (nodes[cells[:, i]] - nodes[np.unique(cells)].mean(axis=0) for i in range(3))
    vectors = np.where(as_first[:, None], 1, -1) * np.cross(b - a, c - a) / 2
    outward = (a * vectors).sum(axis=1) / np.ptp(nodes, axis=0).max()
    for along in (vectors[:, 2], vectors[:, 1], vectors[:, 0], outward):
        if abs(total := along.sum()) > TIE * whole:
            return bool(total < 0)
    return False


def _refuse_torn(
    nodes: Array, cells: Cells, copy: NDArray[np.int32], first_copy: int | None
) -> None:
    """See that pieces which are not connected lie apart."""
    if (copy == copy[0]).all():
        return
    vertices = np.unique(cells[:, :3])
    vertices = vertices if first_copy is None else vertices[vertices < first_copy]
    near = scipy.spatial.cKDTree(nodes[vertices]).query_pairs(
        SAME_PLACE * np.ptp(nodes, axis=0).max(), output_type="ndarray"
    )
    if len(near):
        place = place_text(nodes[vertices[near[0, 0]]])
        raise MeshError(
            f"the surface is torn: there are two nodes at {place}, and its parts are not connected"
        )


def border_edges(nodes: Array, cells: Cells, named: Mapping[str, Cells]) -> dict[str, Cells]:
    """The part of each named curve (e, 2) that is a border of the surface; every border edge needs
    a name.

    Raises
    ------
    MeshError
        If a border edge has no name (a hole, or a node that stands twice in the file), or if the
        surface touches itself in a vertex.
    """
    border = border_pairs(directed_sides(cells))
    listed = {pair for lines in named.values() for pair in as_set(lines)}
    unnamed = [(int(a), int(b)) for a, b in border if (int(a), int(b)) not in listed]
    if unnamed:
        place = nodes[list(unnamed[0])].mean(axis=0)
        vertices = np.unique(cells[:, :3])
        extent = np.ptp(nodes[vertices], axis=0).max()
        corner = nodes[unnamed[0][0]]
        twice = np.sum(np.linalg.norm(nodes[vertices] - corner, axis=1) < SAME_PLACE * extent) > 1
        if twice:
            raise MeshError(
                f"there are two nodes at {place_text(corner)}: the triangles beside it are not connected"
            )
        raise MeshError(
            f"the surface ends at the edge around {place_text(place)}, which belongs to no physical curve: "
            "close the hole, or name the edge (an edge without a condition is free)"
        )
    ends, times = np.unique(border, return_counts=True)
    if (times > 2).any():
        raise MeshError(
            f"the surface touches itself in the vertex {place_text(nodes[ends[times > 2][0]])}"
        )
    return on_border(named, border)


TRIANGLES, LINES = ("Triangle 3", "Triangle 6", "Triangle 10"), ("Line 2", "Line 3", "Line 4")
NEAR = 1e-6  # distance, over the extent, up to which a vertex counts as a named point


@dataclass(frozen=True)
class MeshFile:
    """A .msh file, triangles that a program gives under that name, or several shells.

    Attributes
    ----------
    scale
        Factor from its coordinates to lengths over R.
    normals
        Whether nodes are places followed by normals, (n, 6), which the triangles around a node have
        on average.
    files
        What has its content.
    given
        The triangles or the shells; None of a file.
    """

    path: Path
    scale: float
    normals: bool = False
    files: Files = field(default_factory=Files, compare=False)
    given: Triangles | Assembly | None = None

    @property
    def home(self) -> "Home | None":
        """The mesh of a program; None of a file."""
        return self.given.home if self.given else None

    def content(self) -> Triangles:
        """What is in it, or was given.

        Raises
        ------
        MeshError
            If it cannot be read.
        """
        assert not isinstance(self.given, Assembly)
        return self.given or _content(self)


def in_space(x: Array) -> Array:
    """The embedding of a mesh whose nodes are given in space."""
    return x[..., :3]


def normals(x: Array) -> Array:
    """Unit normals (n, 3) of nodes (n, 6)."""
    return np.asarray(x[:, 3:] / np.linalg.norm(x[:, 3:], axis=1)[:, None])


def read_msh(
    file: MeshFile,
    points: Mapping[str, Array],
    mirror: Mirror | None = None,
    held: Collection[str] = (),
) -> PatchMesh:
    """Read a surface; call it on one rank only.

    Physical groups of surfaces become named patches, those of curves named edges. Triangles whose
    orientation differs from that of the larger area are turned over.

    Parameters
    ----------
    points
        Named places (3,) over R that must be vertices. If no "pole" is named, the highest vertex is
        the pole; of several that are, one on no `held` edge, and best the pole of one of several
        shells.
    mirror
        The plane whose half is read; None for the whole surface.
    held
        Names of edges.

    Raises
    ------
    MeshError
        If the file cannot be read, or its surface cannot carry a shell. Places in messages are
        those of the file.
    """
    if isinstance(file.given, Assembly):
        patch = file.given.patch
        on_alike = {
            name: patch.points[like] for like in patch.points for name in _alike(points, like)
        }
        others = {name: x for name, x in points.items() if name not in on_alike}
        own = [
            patch.points[name]
            for name in map("{}_pole".format, patch.shells)
            if name in patch.points
        ]
        return replace(
            patch, points={**_vertices(patch, others, file.scale, held, own), **on_alike}
        )
    try:
        patch = _whole(file)
    except MeshError as e:
        raise MeshError(f"shell: {e}" if file.given else f"shell.file: {e}") from None
    if isinstance(mirror, Sector) and patch.feet:
        raise MeshError(
            f"symmetry: {mirror.waves}: not with a T-junction in the mesh file: take symmetry: half"
        )
    patch = cut(patch, mirror) if mirror else patch
    return replace(patch, points=_vertices(patch, points, file.scale, held))


def _alike(points: Mapping[str, Array], name: str) -> list[str]:
    """The names of points at the place of one."""
    return [
        other for other, x in points.items() if name in points and np.array_equal(x, points[name])
    ]


def _whole(file: MeshFile) -> PatchMesh:
    triangles = file.content()
    nodes, cells, edges = triangles.nodes, triangles.cells, dict(triangles.edges)
    used, again = np.unique(cells, return_inverse=True)  # drops nodes without a triangle
    cells = again.reshape(cells.shape)
    number = np.full(len(nodes), -1, dtype=np.int64)
    number[used] = np.arange(len(used))
    nodes = nodes[used]
    for name, pairs in edges.items():
        edges[name] = number[pairs]
        if (edges[name] < 0).any():
            raise MeshError(f"{file.path}: the physical curve {name} is not part of the surface")
    first_copy = len(nodes)
    origin, cells, feet = separated(nodes, cells)
    nodes, edges = nodes[origin], renamed(edges, cells, origin) if feet else edges
    for name, foot in feet.items():
        if name in edges:
            raise MeshError(
                f"{file.path}: the physical curve {name}: is how a T-junction is called: take another"
            )
        edges[name] = foot.pairs
    before, cells = cells, oriented(nodes, cells, first_copy if feet else None)
    turned = (cells[:, 1] != before[:, 1]).astype(np.int64)
    edges = border_edges(nodes, cells, edges)
    nodes = nodes * file.scale
    if file.normals:
        nodes = np.column_stack([nodes, nodal_normals(nodes, cells)])
    given = np.column_stack([np.arange(len(cells)), turned])
    on = {name: foot.on for name, foot in feet.items()}
    return PatchMesh(nodes, cells, in_space, edges, patches=triangles.patches, given=given, feet=on)


def cell_count(file: MeshFile) -> int:
    """How many triangles are in it; none in a file that cannot be read, which `read_msh` reports."""
    if file.given:
        return len(file.given.cells)
    try:
        held = parsed(file.files.content(file.path))
    except (OSError, MeshError):
        return 0
    return sum(len(nodes) for _, dim, _, nodes in held.blocks if dim == 2)


def _vertices(
    patch: PatchMesh,
    points: Mapping[str, Array],
    scale: float,
    held: Collection[str],
    own: Sequence[Array] = (),
) -> dict[str, Array]:
    """Named ones, and the highest as "pole": of several that are, a free one, best of the poles that shells have of
    their `own`."""
    numbers = np.unique(patch.cells[:, :3])
    corners = patch.nodes[numbers]
    on_held = [pairs.ravel() for name, pairs in patch.edges.items() if name in held]
    free = ~np.isin(numbers, np.concatenate([*on_held, np.zeros(0, dtype=np.int64)]))
    all_of_them = np.array([*corners, *own])
    x, y, z = np.round(all_of_them[:, :3], 9).T
    is_own = np.arange(len(x)) >= len(corners)
    is_free = free[scipy.spatial.cKDTree(corners[:, :3]).query(all_of_them[:, :3])[1]]
    vertices = {"pole": all_of_them[np.lexsort((x, y, is_own, is_free, z))[-1]]}
    for name, x in points.items():
        distance = np.linalg.norm(corners[:, :3] - x[:3], axis=1)
        nearest = corners[np.argmin(distance)]
        if distance.min() > NEAR * np.ptp(corners[:, :3], axis=0).max():
            wanted, near = told_apart(x[:3] / scale, nearest[:3] / scale)
            raise MeshError(
                f"points.{name}: ({wanted}) in the file's coordinates is no vertex of the mesh; the nearest is ({near})"
            )
        vertices[name] = nearest
    return vertices


def _content(file: MeshFile) -> Triangles:
    """Those of a file, and the names of its physical groups."""
    try:
        held = parsed(file.files.content(file.path))
    except FileNotFoundError:
        raise MeshError(f"{file.path}: there is no such mesh file") from None
    except OSError as e:
        raise MeshError(f"{file.path}: cannot be read: {e.strerror}") from None
    except MeshError as e:
        raise MeshError(f"{file.path}: {e}") from None
    if not len(held.tags):
        raise MeshError(f"{file.path}: there is no mesh in it")
    faces = _elements(file, held, 2, TRIANGLES)
    if len({nodes.shape[1] for _, nodes in faces}) != 1:
        raise MeshError(f"{file.path}: it has no triangles, or triangles of several orders")
    cells = _places(file, held, np.concatenate([nodes for _, nodes in faces]))
    entity = np.concatenate([np.full(len(nodes), entity) for entity, nodes in faces])
    patches = {name: np.isin(entity, entities) for name, entities in held.groups[2].items()}
    edges = {}
    for name, entities in held.groups[1].items():
        lines = [
            nodes[:, :2] for entity, nodes in _elements(file, held, 1, LINES) if entity in entities
        ]
        if lines:  # a curve of the geometry may have no elements
            edges[name] = _places(file, held, np.concatenate(lines))
    return Triangles(held.places, cells, edges, patches)


def _elements(
    file: MeshFile, held: Content, dimension: int, passed_over: Collection[str]
) -> list[tuple[int, NDArray[np.int64]]]:
    """Entity and nodes of the blocks of one dimension."""
    blocks = []
    for name, dim, entity, nodes in held.blocks:
        if dim == dimension:
            if name not in passed_over:
                raise MeshError(
                    f"{file.path}: it has elements {name}; allowed are triangles of order 1, 2 and 3"
                )
            blocks.append((entity, nodes))
    return blocks


def _places(file: MeshFile, held: Content, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices of the nodes with these numbers."""
    order = np.argsort(held.tags)
    positions: NDArray[np.int64] = order[
        np.searchsorted(held.tags, numbers, sorter=order).clip(max=len(order) - 1)
    ]
    if (missing := held.tags[positions] != numbers).any():
        raise MeshError(
            f"{file.path}: it has elements with the node {numbers[missing][0]}, which is not there"
        )
    return positions

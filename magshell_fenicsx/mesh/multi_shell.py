"""Several shells as one triangulation: each is meshed alone, then turned and moved to its place.

A node of the triangulation has ten numbers: its place in space (3,), its coordinates in the
triangulation of its shell alone (up to 6), and the number of the shell. So readers of mesh files
find places, and the embedding finds the shell's own coordinates: placement and curvature are as
exact as those of the shell alone. Edges of two shells are glued at joints; at a T-junction an edge
ends on another shell, and nothing is glued.

An embedding maps nodes to places in space. A patch is a named part of the surface, here also each
shell; an edge is given by the pairs of vertices of its sides. Glued nodes stay apart and have one
representative, whose number edges and triangles' corners have. Elements of order 1, 2 or 3 have 3,
6 or 10 nodes, in gmsh's order; `perm_gmsh` gives dolfinx's order. Lengths are over R.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import SECOND_SYMMETRY_EDGE, SYMMETRY_EDGE, Mirror
from magshell_fenicsx.mesh.patch import (
    DeviatedEmbedding,
    Embedding,
    MeshError,
    PatchMesh,
    as_set,
    check_orientation,
    directed_sides,
    place_text,
)
from magshell_fenicsx.mesh.vertex_spacing import distinguishable_texts

Array = NDArray[np.float64]
# distance, over the extent, up to which two edges meet; curved edges are that far from a coarse
# mesh
MEETING_TOLERANCE = 1e-5
SAME_PLACE_TOLERANCE = 1e-12  # over R: places that differ by rounding
SIDE_END_TOLERANCE = 1e-5  # over a side: a vertex so near to its end is there
PROJECTION_ITERATIONS = 40  # of the closest-point projection onto a side
REFERENCE_VERTICES = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
TRIANGLE_SIDES = np.array([[0, 1], [1, 2], [2, 0]])
CHART_DIMENSION = 2
MAX_SHELL_COORDINATES = 6  # numbers of a node in its shell: place and normal, in a mesh file


@dataclass(frozen=True)
class ShellPose:
    """Position, orientation and scale of a shell: x in its frame -> scale Q x + position.

    The frame is the one in which the shell is meshed alone. There x is over the shell's own length
    (the radius of a sphere, say); the result is over R, the reference length of all shells.

    Attributes
    ----------
    Q
        (3, 3): columns are the axes of the shell.
    position
        (3,) of its origin, over R.
    scale
        The shell's own length over R.
    """

    Q: Array
    position: Array
    scale: float

    def __call__(self, x: Array) -> Array:
        """Return the places (..., 3) over R of places x in the frame of the shell."""
        return np.asarray(self.scale * x @ self.Q.T + self.position)

    def to_shell_frame(self, x: Array) -> Array:
        """Return places (..., 3) in space in the frame of the shell, over its own length."""
        return np.asarray((x - self.position) @ self.Q / self.scale)


@dataclass(frozen=True)
class MemberShell:
    """A shell of several, meshed alone.

    Attributes
    ----------
    name
        Name of the shell.
    patch
        The triangulation of the shell alone.
    place
        Position, orientation and scale of the shell in space.
    points
        Names of those of `patch.points` that the case names.
    normal
        Nodes of `patch` -> normals of the perfect shell; None if they are not known.
    """

    name: str
    patch: PatchMesh
    place: ShellPose
    points: Sequence[str] = ()
    normal: Embedding | None = None


@dataclass(frozen=True)
class MultiShellEmbedding:
    """Map of nodes (n, 10) of several shells to places (n, 3), each by the embedding of its shell.

    Attributes
    ----------
    embeddings
        For each shell: the embedding of its triangulation alone, the number of coordinates that
        this takes, and where the shell is.
    normals
        For each shell: its coordinates -> normals of the perfect shell; None if not known.
    """

    embeddings: tuple[tuple[Embedding, int, ShellPose], ...]
    normals: tuple[Embedding | None, ...] = ()

    @property
    def has_charts(self) -> bool:
        """Whether all shells have charts, and none is from a mesh file."""
        return all(dimension == CHART_DIMENSION for _, dimension, _ in self.embeddings)

    def __call__(self, nodes: Array) -> Array:
        """Return the places (n, 3) over R of nodes (n, 10)."""
        # the last number of a node is that of its shell; the shell's own coordinates begin at 3
        shell_numbers, places = np.rint(nodes[:, -1]), np.array(nodes[:, :3])
        for i, (embedding, dimension, place) in enumerate(self.embeddings):
            is_in_shell = shell_numbers == i
            if is_in_shell.any():
                places[is_in_shell] = place(embedding(nodes[is_in_shell, 3 : 3 + dimension]))
        return places

    def normal(self, nodes: Array) -> Array:
        """Return outward unit normals (n, 3) of the perfect shells; nan where not known."""
        shell_numbers, normals = np.rint(nodes[:, -1]), np.full((len(nodes), 3), np.nan)
        for i, (normal, (_, dimension, place)) in enumerate(
            zip(self.normals, self.embeddings, strict=True)
        ):
            is_in_shell = shell_numbers == i
            if normal and is_in_shell.any():
                normals[is_in_shell] = normal(nodes[is_in_shell, 3 : 3 + dimension]) @ place.Q.T
        return normals

    def w0(self, nodes: Array) -> Array:
        """Return the deviations (n,) of the imperfect shells, over R."""
        shell_numbers, w0 = np.rint(nodes[:, -1]), np.zeros(len(nodes))
        for i, (embedding, dimension, place) in enumerate(self.embeddings):
            is_in_shell = shell_numbers == i
            if isinstance(embedding, DeviatedEmbedding) and is_in_shell.any():
                w0[is_in_shell] = place.scale * embedding.w0(nodes[is_in_shell, 3 : 3 + dimension])
        return w0


@dataclass(eq=False)
class MultiShellMesh:
    """Several shells in place of a mesh file; the triangulation is made at first use.

    Attributes
    ----------
    digest
        Hash of all that determines the shells.
    members
        Makes the shells, each rank the same; a `MeshError` or `CaseError` begins with the key of
        one that cannot be made.
    joints
        Pairs of names of edges; the first is joined to the second.
    moduli
        Name of a shell -> its Young's modulus over that of the first.
    laws
        Name of a shell -> the name of its law.
    mirrors
        Returns the symmetry planes that all shells share. It takes vectors that a plane should
        contain, and whether loose symmetry suffices, see `Outline.mirrors`.
    make_meridian
        Makes the meridians of shells with one axis, see `shape.meridian_chart.MeridianChart`; or
        says why there are none.
    normal
        Place (3,) -> the outward unit normal (3,) of the nearest perfect shell there.
    symmetric_part
        Symmetry plane -> the half on its positive side; sector -> the sector.
    is_symmetric_part
        Whether it is a half or a sector itself. The edges of all shells in a plane are then one,
        `SYMMETRY_EDGE` or `SECOND_SYMMETRY_EDGE`.
    user_mesh
        None: no program gave a mesh.
    """

    digest: str
    members: Callable[[], Sequence[MemberShell]] = field(repr=False)
    joints: Sequence[tuple[str, str]] = ()
    moduli: Mapping[str, float] = field(default_factory=dict)
    laws: Mapping[str, str] = field(default_factory=dict)
    mirrors: Callable[[Sequence[Array], bool], Sequence[Mirror]] = field(
        default=lambda *_: [], repr=False
    )
    make_meridian: Callable[[], Any] = field(default=lambda: "there are several shells", repr=False)
    normal: Callable[[Array], Array] | None = field(default=None, repr=False)
    symmetric_part: Callable[[Mirror], "MultiShellMesh"] | None = field(default=None, repr=False)
    is_symmetric_part: bool = False
    user_mesh: None = None

    def __deepcopy__(self, memo: dict[int, object]) -> "MultiShellMesh":
        return self

    @cached_property
    def meridian(self) -> Any:
        """The meridians, or why there are none."""
        return self.make_meridian()

    @cached_property
    def patch(self) -> PatchMesh:
        """The triangulation of all shells, with their joints."""
        shells = union_of_shells(self.members(), one_symmetry_edge=self.is_symmetric_part)
        return with_joints(shells, self.joints)

    @property
    def cells(self) -> NDArray[np.int64]:
        """Node numbers (m, 3 | 6 | 10) of the triangles of all shells."""
        return self.patch.cells


def union_of_shells(
    members: Sequence[MemberShell], *, one_symmetry_edge: bool = False
) -> PatchMesh:
    """Return one triangulation of shells that do not share a node.

    Each shell is a patch with its name. Names of edges, points and patches begin with that of the
    shell.

    Parameters
    ----------
    members
        Each shell with its own triangulation.
    one_symmetry_edge
        Whether the edges of all shells in a symmetry plane are one edge.
    """
    nodes_per_cell = max(member.patch.cells.shape[1] for member in members)
    embeddings = tuple((m.patch.embedding, m.patch.nodes.shape[1], m.place) for m in members)
    embedding = MultiShellEmbedding(embeddings, tuple(m.normal for m in members))
    nodes = list[Array]()
    cells, representatives = list[NDArray[np.int64]](), list[NDArray[np.int64]]()
    edges = dict[str, NDArray[np.int64]]()
    inner_lines = dict[str, NDArray[np.int64]]()
    points = dict[str, Array]()
    patches = dict[str, NDArray[np.bool_]]()
    cell_count = sum(len(member.patch.cells) for member in members)
    first_node = first_cell = 0
    for number, member in enumerate(members):
        patch = _with_nodes_per_cell(member.patch, nodes_per_cell)
        node_count = len(patch.nodes)
        nodes.append(_with_shell_number(patch.nodes, number, embedding))
        cells.append(patch.cells + first_node)
        glued = np.arange(node_count) if patch.representative is None else patch.representative
        representatives.append(glued + first_node)
        _add_edges(edges, member.name, patch, first_node, one_symmetry_edge=one_symmetry_edge)
        for name, pairs in patch.inner_lines.items():
            inner_lines[f"{member.name}_{name}"] = pairs + first_node
        for name in patch.points:
            # a shell's pole is a point of all shells even if the case does not name it
            if name in ("pole", *member.points):
                node = _with_shell_number(patch.points[name][None], number, embedding)[0]
                points[f"{member.name}_{name}"] = node
        end_cell = first_cell + len(patch.cells)
        all_cells = np.ones(len(patch.cells), dtype=bool)  # "": the shell as a patch of its own
        for name, mask in {"": all_cells, **patch.patches}.items():
            in_patch = np.zeros(cell_count, dtype=bool)
            in_patch[first_cell:end_cell] = mask
            patches[f"{member.name}_{name}" if name else member.name] = in_patch
        first_node, first_cell = first_node + node_count, end_cell
    # (m, 2): each triangle is its own source, and not reversed
    source_triangles = np.column_stack(
        [np.arange(cell_count), np.zeros(cell_count, dtype=np.int64)]
    )
    return PatchMesh(
        np.concatenate(nodes),
        np.concatenate(cells),
        embedding,
        edges,
        points,
        np.concatenate(representatives),
        patches,
        source_triangles,
        shells=tuple(member.name for member in members),
        inner_lines=inner_lines,
    )


def _add_edges(
    edges: dict[str, NDArray[np.int64]],
    shell: str,
    patch: PatchMesh,
    first_node: int,
    *,
    one_symmetry_edge: bool,
) -> None:
    """Add the edges of a shell to those of all shells, under names that begin with the shell's.

    Parameters
    ----------
    edges
        Name -> pairs of vertices, of all shells before this one.
    shell, patch
        Name and triangulation of the shell.
    first_node
        Number of its first node among those of all shells.
    one_symmetry_edge
        Whether its edges in a symmetry plane are appended to the one edge of all shells there.
    """
    for name, pairs in patch.edges.items():
        is_common = one_symmetry_edge and name in (SYMMETRY_EDGE, SECOND_SYMMETRY_EDGE)
        name_of_all = name if is_common else f"{shell}_{name}"
        earlier_pairs = [edges[name]] if is_common and name in edges else []
        edges[name_of_all] = np.concatenate([*earlier_pairs, pairs + first_node])


def _with_shell_number(coordinates: Array, number: int, embedding: MultiShellEmbedding) -> Array:
    """Return nodes (n, 10) of several shells for coordinates (n, d) in one of them.

    Parameters
    ----------
    number
        Number of the shell.
    """
    nodes = np.zeros((len(coordinates), 3 + MAX_SHELL_COORDINATES + 1))
    nodes[:, 3 : 3 + coordinates.shape[1]] = coordinates
    nodes[:, -1] = number
    nodes[:, :3] = embedding(nodes)  # which reads the numbers just set
    return nodes


def with_joints(patch: PatchMesh, joints: Sequence[tuple[str, str]]) -> PatchMesh:
    """Return the triangulation with edges glued at joints.

    Glued edges are lines within the surface; the edge of a T-junction stays one.

    Parameters
    ----------
    joints
        Pairs of names: an edge, and another edge or the shell or patch on which it ends.

    Raises
    ------
    MeshError
        If there is no such edge, or two edges cannot be glued.
    """
    keys = [f"joints.{number}.edges" for number in range(len(joints))]
    are_t_junctions = [
        is_t_junction(patch, edges, key) for edges, key in zip(joints, keys, strict=True)
    ]
    for edges, key, ends_on_shell in zip(joints, keys, are_t_junctions, strict=True):
        if not ends_on_shell:
            patch = glue_edges(patch, edges, key)
    # masks of the joints, only now: a mask has a value for each triangle, and gluing may have
    # divided triangles. A T-junction has none
    masks, glued_names = list[tuple[NDArray[np.bool_], NDArray[np.bool_]] | None](), set[str]()
    for edges, ends_on_shell in zip(joints, are_t_junctions, strict=True):
        if ends_on_shell:
            masks.append(None)
        else:
            masks.append((_cells_on_edge(patch, edges[0]), _cells_on_edge(patch, edges[1])))
            glued_names |= set(edges)
    border = {name: pairs for name, pairs in patch.edges.items() if name not in glued_names}
    joined = {name: patch.edges[name] for name in patch.edges if name in glued_names}
    return replace(
        patch, edges=border, joints=tuple(masks), inner_lines={**patch.inner_lines, **joined}
    )


def is_t_junction(patch: PatchMesh, edges: tuple[str, str], key: str) -> bool:
    """Return whether a joint is a T-junction: its first edge ends on a shell, or a patch of one.

    Parameters
    ----------
    edges
        Name of an edge, and of an edge, a shell or a patch.
    key
        Key of the joint, for the message.

    Raises
    ------
    MeshError
        If the first name is no edge; the message begins with the key.
    """
    if edges[1] in patch.edges or edges[1] not in patch.patches:
        return False
    if edges[0] not in patch.edges:
        raise MeshError(
            f"{key}: {edges[0]}: is no edge; an edge stands first, "
            "and then the shell on which it is"
        )
    return True


def glue_edges(patch: PatchMesh, edges: tuple[str, str], key: str) -> PatchMesh:
    """Return the triangulation with the second edge glued to the first, vertex by vertex.

    Where one edge has a vertex and the other has none, the triangle there is divided. Both edges
    then have the same vertices.

    Parameters
    ----------
    edges
        Names of the first and the second edge.
    key
        Key of the joint, with which messages begin.

    Raises
    ------
    MeshError
        If there is no such edge, the edges do not meet, or have different normals.
    """
    for name in edges:
        if name not in patch.edges:
            raise MeshError(f"{key}: {name}: there is no such edge, only {', '.join(patch.edges)}")
    # each edge gets vertices where the other one has some; a gap is the largest distance of these
    # from the edge, with its place
    places_of_first, places_of_second = (
        patch.nodes[np.unique(patch.edges[name]), :3] for name in edges
    )
    patch, gap_to_first = _with_vertices_on_edge(patch, edges[0], targets=places_of_second)
    patch, gap_to_second = _with_vertices_on_edge(patch, edges[1], targets=places_of_first)
    gap, gap_place = max(gap_to_first, gap_to_second, key=lambda gap_and_place: gap_and_place[0])
    if gap > MEETING_TOLERANCE * float(np.ptp(patch.nodes[:, :3], axis=0).max()):
        raise MeshError(
            f"{key}: {' and '.join(edges)} do not meet, by {gap:.4g} R at {place_text(gap_place)}, "
            "over R: move one of the shells, or make both edges as long"
        )
    assert patch.representative is not None
    glued_to = _vertices_after_gluing(patch, edges, key)
    glued_patch = replace(
        patch,
        edges={name: glued_to[pairs] for name, pairs in patch.edges.items()},
        representative=glued_to[patch.representative],
    )
    try:
        check_orientation(glued_patch)
    except MeshError:
        raise MeshError(
            f"{key}: the normals of {edges[0]} and {edges[1]} point to opposite sides: "
            "turn one of the shells over"
        ) from None
    return glued_patch


def _vertices_after_gluing(patch: PatchMesh, edges: tuple[str, str], key: str) -> NDArray[np.int64]:
    """Return the number that each vertex has after the second edge is glued to the first.

    A vertex of the second edge gets that of the nearest vertex of the first.

    Raises
    ------
    MeshError
        If there is not exactly one vertex of the second edge for each of the first; the message
        begins with the key.
    """
    assert patch.representative is not None
    first, second = (np.unique(patch.edges[name]) for name in edges)
    places = patch.nodes[:, :3]
    distances = np.linalg.norm(places[second][:, None] - places[first][None], axis=2)
    nearest = distances.argmin(axis=1)
    if len(np.unique(nearest)) != len(first):
        near_pair = _nearest_pair_text(places[first], places[second])
        raise MeshError(
            f"{key}: vertices of {' and '.join(edges)} nearly meet, {near_pair}, over R: "
            "give both shells the same mesh.size"
        )
    glued_to = np.arange(len(patch.representative))
    glued_to[second] = first[nearest]
    return glued_to


def _nearest_pair_text(first: Array, second: Array) -> str:
    """Return the two nearest different places of two edges, (n, 3) and (m, 3), as text."""
    places = np.vstack([first, second])
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)
    distances[distances <= SAME_PLACE_TOLERANCE] = np.inf
    i, j = np.unravel_index(int(distances.argmin()), distances.shape)
    text, other_text = distinguishable_texts(places[i], places[j])
    return f"at ({text}) and ({other_text})"


def _with_vertices_on_edge(
    patch: PatchMesh, edge: str, targets: Array
) -> tuple[PatchMesh, tuple[float, Array]]:
    """Return the triangulation with a vertex on an edge wherever the other edge has one.

    Parameters
    ----------
    targets
        (n, 3) vertices of the other edge.

    Returns
    -------
    patch
        The triangulation, with triangles divided at the targets that lie within their sides.
    gap
        Largest distance of a target from the edge over R, and this target (3,).
    """
    cell, side = _sides_on_edge(patch, edge)
    S, T = len(cell), len(targets)
    # ends of the S sides, in the reference triangle, and as places with the chord between them
    vertices_of_sides = TRIANGLE_SIDES[side]  # (S, 2), from 0 to 2
    start, end = REFERENCE_VERTICES[vertices_of_sides].transpose(1, 0, 2)
    end_nodes = patch.cells[cell[:, None], vertices_of_sides]
    end_places = patch.nodes[end_nodes, :3]
    chord = end_places[:, 1] - end_places[:, 0]

    def place_on_sides(t: Array) -> Array:
        """Return the places (S, T, 3) of parameters t (S, T) along the sides."""
        X = start[:, None] + t[..., None] * (end - start)[:, None]
        places = patch.embedding(_nodes_in_cells(patch, np.repeat(cell, T), X.reshape(-1, 2)))
        return np.asarray(places.reshape(S, T, 3))

    # move t to the point of each curved side closest to each target, by projection on its chord
    t = np.full((S, T), 0.5)  # parameter along each side, from 0 to 1; the search begins midway
    squared_lengths = np.einsum("si,si->s", chord, chord)[:, None]
    for _ in range(PROJECTION_ITERATIONS):
        offset = targets[None] - place_on_sides(t)
        t = np.clip(t + np.einsum("sti,si->st", offset, chord) / squared_lengths, 0, 1)
    distance = np.linalg.norm(targets[None] - place_on_sides(t), axis=2)
    # the nearest side of each target, and the target that is farthest from its nearest side
    nearest_side = distance.argmin(axis=0)
    farthest = int(distance.min(axis=0).argmax())
    gap = float(distance[nearest_side[farthest], farthest]), targets[farthest]
    t_on_nearest = t[nearest_side, np.arange(T)]
    # targets within a side, and not at its ends
    is_new = (t_on_nearest > SIDE_END_TOLERANCE) & (t_on_nearest < 1 - SIDE_END_TOLERANCE)
    for number in np.unique(nearest_side[is_new]):
        cuts = np.sort(t_on_nearest[is_new & (nearest_side == number)])
        patch = _with_divided_triangle(patch, edge, int(cell[number]), int(side[number]), cuts)
    return patch, gap


def _sides_on_edge(patch: PatchMesh, edge: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the triangle of each side on an edge, and the number of the side there (0 to 2)."""
    triangle_sides = patch.corners[:, TRIANGLE_SIDES]  # (m, 3 sides, 2 vertices)
    # the two vertices of a side -> its triangle, and its number there
    cell_and_side = {
        tuple(sorted(triangle_sides[c, s])): (c, s)
        for c, s in np.ndindex(*triangle_sides.shape[:2])
    }
    cell, side = np.array([cell_and_side[tuple(sorted(pair))] for pair in patch.edges[edge]]).T
    return cell, side


def _with_divided_triangle(
    patch: PatchMesh, edge: str, cell: int, side: int, cuts: Array
) -> PatchMesh:
    """Return the triangulation with one triangle divided from the vertex opposite to a side.

    The first new triangle takes the number of the old one; the others are appended.

    Parameters
    ----------
    cell, side
        Number of the triangle, and of its side (0 to 2), which is on the edge.
    cuts
        Places along the side at which it is divided, from 0 to 1, growing.
    """
    assert patch.representative is not None
    assert patch.source_triangles is not None
    # node numbers of each new triangle, coordinates of the new nodes, numbers along the side
    new_cells, new_nodes, side_nodes = _parts_of_triangle(patch, cell, side, cuts)
    first_new_node = len(patch.nodes)
    nodes = np.concatenate([patch.nodes, new_nodes])
    # coordinates in the shell are interpolated; places in space follow from them exactly
    nodes[first_new_node:, :3] = patch.embedding(nodes[first_new_node:])
    cells = np.concatenate([patch.cells, np.array(new_cells[1:])])
    cells[cell] = new_cells[0]
    parent_cells = np.full(len(new_cells) - 1, cell)
    # no new node is glued to another
    representative = np.concatenate([patch.representative, np.arange(first_new_node, len(nodes))])
    # in the edge, the pair of the old side is replaced by the pairs of the new sides
    ends = {int(representative[side_nodes[0]]), int(representative[side_nodes[-1]])}
    other_pairs = [pair for pair in patch.edges[edge] if {int(pair[0]), int(pair[1])} != ends]
    new_pairs = representative[np.array([side_nodes[:-1], side_nodes[1:]]).T]
    pairs = np.concatenate([np.array(other_pairs, dtype=np.int64).reshape(-1, 2), new_pairs])

    def with_new_cells(values: NDArray[Any]) -> NDArray[Any]:
        """Append the values of the old triangle for the new ones."""
        return np.concatenate([values, values[parent_cells]])

    return replace(
        patch,
        nodes=nodes,
        cells=cells,
        representative=representative,
        edges={**patch.edges, edge: pairs},
        patches={name: with_new_cells(mask) for name, mask in patch.patches.items()},
        source_triangles=with_new_cells(patch.source_triangles),
    )


def _parts_of_triangle(
    patch: PatchMesh, cell: int, side: int, cuts: Array
) -> tuple[list[NDArray[np.int64]], Array, list[int]]:
    """Divide a triangle from the vertex opposite to a side.

    Parameters
    ----------
    cell, side
        Number of the triangle, and of its side (0 to 2).
    cuts
        Places along the side at which it is divided, from 0 to 1, growing.

    Returns
    -------
    new_cells
        Nodes of each new triangle.
    new_nodes
        (k, 10) nodes that are new: first those at the cuts, then those of each new triangle. Their
        numbers follow that of the last old node.
    side_nodes
        Nodes along the side: its ends, and those at the cuts between.
    """
    from dolfinx import mesh  # slow to import, and not needed to read a case
    from dolfinx.cpp.io import perm_gmsh

    # a cell's number of nodes, and the vertices (0 to 2) at the ends of the side
    count, (i, j) = patch.cells.shape[1], TRIANGLE_SIDES[side]
    points = _equispaced_element(count).points
    cut_parameters = np.array([0.0, *cuts, 1.0])
    X = REFERENCE_VERTICES[i] + cut_parameters[:, None] * (
        REFERENCE_VERTICES[j] - REFERENCE_VERTICES[i]
    )
    apex = 3 - i - j  # the third vertex: 0 + 1 + 2 = 3
    first_new_node = len(patch.nodes)
    # nodes along the side: its ends and the new ones between
    side_nodes = [
        patch.cells[cell, i],
        *range(first_new_node, first_new_node + len(cuts)),
        patch.cells[cell, j],
    ]
    new_nodes = [_nodes_in_cells(patch, np.full(len(cuts), cell), X[1:-1])]
    new_cells = list[NDArray[np.int64]]()
    node_count = first_new_node + len(cuts)
    for k in range(len(cut_parameters) - 1):
        a, b, c = X[k], X[k + 1], REFERENCE_VERTICES[apex]
        # nodes of the new triangle but its vertices, in reference coordinates of the old triangle
        further_points = a + points[3:] @ np.array([b - a, c - a])
        further_count = len(further_points)
        new_nodes.append(_nodes_in_cells(patch, np.full(further_count, cell), further_points))
        vertices = [side_nodes[k], side_nodes[k + 1], patch.cells[cell, apex]]
        new_cell = np.empty(count, dtype=np.int64)
        new_cell[perm_gmsh(mesh.CellType.triangle, count)] = [
            *vertices,
            *range(node_count, node_count + further_count),
        ]
        new_cells.append(new_cell)
        node_count += further_count
    return new_cells, np.concatenate(new_nodes), side_nodes


def _nodes_in_cells(patch: PatchMesh, cell: NDArray[np.int64], X: Array) -> Array:
    """Return nodes (n, d) at reference points X (n, 2) of cells (n,).

    They are interpolated between the nodes of the cell, by its polynomials.
    """
    from dolfinx import mesh  # slow to import, and not needed to read a case
    from dolfinx.cpp.io import perm_gmsh

    count = patch.cells.shape[1]
    # shape functions (n, nodes), in dolfinx's order of the nodes
    table = _equispaced_element(count).tabulate(0, X)[0, :, :, 0]
    dolfinx_cells = patch.cells[cell][:, perm_gmsh(mesh.CellType.triangle, count)]
    return np.asarray(np.einsum("nk,nkd->nd", table, patch.nodes[dolfinx_cells]))


def _equispaced_element(count: int) -> Any:
    """Return basix's Lagrange element with `count` equispaced nodes (3, 6 or 10) on a triangle."""
    import basix  # slow to import, and not needed to read a case

    from magshell_fenicsx.mesh.midsurface import ORDERS

    family, variant = basix.ElementFamily.P, basix.LagrangeVariant.equispaced
    return basix.create_element(family, basix.CellType.triangle, ORDERS[count], variant)


def _cells_on_edge(patch: PatchMesh, edge: str) -> NDArray[np.bool_]:
    """Return whether each triangle (m,) has a side on an edge, and is on the edge's own shell.

    A glued edge is a side of triangles of both shells.
    """
    pairs, sides = as_set(patch.edges[edge]), np.sort(directed_sides(patch.corners), axis=1)
    is_side_on_edge = np.array([(int(a), int(b)) in pairs for a, b in sides])
    # `directed_sides` gives all first sides, then all second, then all third ones
    has_side_on_edge = is_side_on_edge.reshape(3, -1).any(axis=0)
    # an edge is called SHELL_EDGE; the longest name counts, as shells may be called a and a_b
    shell = max((name for name in patch.patches if edge.startswith(f"{name}_")), key=len)
    return np.asarray(has_side_on_edge & patch.patches[shell])


def _with_nodes_per_cell(patch: PatchMesh, count: int) -> PatchMesh:
    """Return the same triangles with `count` nodes each (3, 6 or 10); vertices keep their numbers.

    One triangulation has triangles of one order: those of shells with fewer nodes get more. The new
    nodes are at the places that the old triangles have there. Neighbours do not share them.
    """
    if patch.cells.shape[1] == count:
        return patch
    from dolfinx import mesh  # slow to import, and not needed to read a case
    from dolfinx.cpp.io import perm_gmsh

    from magshell_fenicsx.mesh.midsurface import at_reference_points

    # coordinates (m, new nodes of a cell, d) at the nodes that follow the three vertices
    new_points = _equispaced_element(count).points[3:]
    places = at_reference_points(patch.nodes, patch.cells, new_points)
    first_new = len(patch.nodes)
    new_numbers = first_new + np.arange(places.shape[0] * places.shape[1]).reshape(places.shape[:2])
    cells = np.empty((len(patch.cells), count), dtype=np.int64)
    cells[:, perm_gmsh(mesh.CellType.triangle, count)] = np.concatenate(
        [patch.cells[:, :3], new_numbers], axis=1
    )
    nodes = np.concatenate([patch.nodes, places.reshape(-1, patch.nodes.shape[1])])
    representative = patch.representative
    if representative is not None:
        representative = np.concatenate([representative, new_numbers.ravel()])
    return PatchMesh(
        nodes,
        cells,
        patch.embedding,
        patch.edges,
        patch.points,
        representative,
        patch.patches,
        patch.source_triangles,
        inner_lines=patch.inner_lines,
    )

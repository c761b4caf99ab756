"""Several shells as one triangulation: each is meshed as it is alone, then turned and moved to its
place.

A node is its place in space (3,), its node in the shell's own triangulation, and last the number of
its shell. So readers of mesh files find places, and the embedding finds the shell's own: placement
and curvature are as exact as those of the shell alone.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.distinct import told_apart
from magshell_fenicsx.mesh.mirror import CUT, SECOND_CUT, Mirror
from magshell_fenicsx.mesh.patch import (
    Deviated,
    Embedding,
    MeshError,
    PatchMesh,
    as_set,
    check_orientation,
    directed_sides,
    place_text,
)

Array = NDArray[np.float64]
# of the extent: how far vertices that meet may be apart; curved edges are that far from a coarse
# mesh
MEET = 1e-5
SAME = 1e-12  # over R: places that differ by rounding
NEARLY = 1e-5  # of a side: a place so near to its end is there
ROUNDS = 40  # of the search for the nearest place of a side
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
SIDES = np.array([[0, 1], [1, 2], [2, 0]])
CHART = 2  # numbers of a node of a chart
OWN = 6  # most numbers of a node of its own: place and normal, in a mesh file


@dataclass(frozen=True)
class Place:
    """Where a shell is: places x (n, 3) of its own, over its own length, are at scale Q x +
    position.

    Attributes
    ----------
    Q
        (3, 3): columns are its axes.
    position
        (3,) of its origin, over R.
    scale
        Its own length over R.
    """

    Q: Array
    position: Array
    scale: float

    def __call__(self, x: Array) -> Array:
        return np.asarray(self.scale * x @ self.Q.T + self.position)

    def own(self, x: Array) -> Array:
        """The shell's own places (..., 3) of those in space, over its own length."""
        return np.asarray((x - self.position) @ self.Q / self.scale)


@dataclass(frozen=True)
class Member:
    """A shell of an assembly: its name, its own triangulation, its place, and which points of it
    are named.

    `normal` maps its nodes to the normals of the perfect shell, if these are known.
    """

    name: str
    patch: PatchMesh
    place: Place
    points: Sequence[str] = ()
    normal: Embedding | None = None


@dataclass(frozen=True)
class Embedded:
    """Nodes (n, 10) of an assembly -> places (n, 3), by the shell of each."""

    embeddings: tuple[tuple[Embedding, int, Place], ...]
    normals: tuple[Embedding | None, ...] = ()

    @property
    def charts(self) -> bool:
        """Whether all shells have charts, and none is from a mesh file."""
        return all(size == CHART for _, size, _ in self.embeddings)

    def __call__(self, nodes: Array) -> Array:
        number, places = np.rint(nodes[:, -1]), np.array(nodes[:, :3])
        for i, (embedding, size, place) in enumerate(self.embeddings):
            of = number == i
            if of.any():
                places[of] = place(embedding(nodes[of, 3 : 3 + size]))
        return places

    def normal(self, nodes: Array) -> Array:
        """Outward unit normals (n, 3) of the perfect shells; nan where they are not known."""
        number, normals = np.rint(nodes[:, -1]), np.full((len(nodes), 3), np.nan)
        for i, (normal, (_, size, place)) in enumerate(
            zip(self.normals, self.embeddings, strict=True)
        ):
            if normal and (of := number == i).any():
                normals[of] = normal(nodes[of, 3 : 3 + size]) @ place.Q.T
        return normals

    def w0(self, nodes: Array) -> Array:
        """The deviations (n,) of the drawn shells, over R."""
        number, w0 = np.rint(nodes[:, -1]), np.zeros(len(nodes))
        for i, (embedding, size, place) in enumerate(self.embeddings):
            if isinstance(embedding, Deviated) and (of := number == i).any():
                w0[of] = place.scale * embedding.w0(nodes[of, 3 : 3 + size])
        return w0


@dataclass(eq=False)
class Assembly:
    """What stands in place of a mesh file where there are several shells; its mesh is made when it
    is asked for.

    Attributes
    ----------
    digest
        A hash of all from which it is made.
    members
        Makes its shells, each rank the same; a `MeshError` or `CaseError` begins with the key of
        one that cannot be.
    joints
        Pairs of names of edges; the first is joined to the second.
    moduli
        Name of a shell -> its Young's modulus over that of the first.
    laws
        Name of a shell -> the word for its law.
    mirrors
        Planes in which each shell is its own image, see `Outline.mirrors`.
    span
        The meridians of shells with one axis, see `shape.turning.Span`; or why there are none, in
        words.
    normal
        Place (3,) -> the outward unit normal (3,) of the nearest perfect shell there.
    half
        Its half at such a plane, on whose positive side it is, or its sector.
    halved
        Whether it is a half or a sector itself: edges on a plane are one, `CUT` or `SECOND_CUT`.
    home
        None: no program gave a mesh.
    """

    digest: str
    members: Callable[[], Sequence[Member]] = field(repr=False)
    joints: Sequence[tuple[str, str]] = ()
    moduli: Mapping[str, float] = field(default_factory=dict)
    laws: Mapping[str, str] = field(default_factory=dict)
    mirrors: Callable[[Sequence[Array], bool], Sequence[Mirror]] = field(
        default=lambda *_: [], repr=False
    )
    span: Callable[[], Any] = field(default=lambda: "there are several shells", repr=False)
    normal: Callable[[Array], Array] | None = field(default=None, repr=False)
    half: Callable[[Mirror], "Assembly"] | None = field(default=None, repr=False)
    halved: bool = False
    home: None = None

    def __deepcopy__(self, memo: dict[int, object]) -> "Assembly":
        return self

    @cached_property
    def turned(self) -> Any:
        """The meridians, or why there are none."""
        return self.span()

    @cached_property
    def patch(self) -> PatchMesh:
        """All of them as one triangulation."""
        return joined(together(self.members(), halved=self.halved), self.joints)

    @property
    def cells(self) -> NDArray[np.int64]:
        """Those of all shells."""
        return self.patch.cells


def together(members: Sequence[Member], *, halved: bool = False) -> PatchMesh:
    """One triangulation of shells that do not share a node; names of edges and points begin with
    that of the shell.

    Each shell is a patch with its name. The edges of `halved` ones on their plane are one edge.
    """
    most = max(member.patch.cells.shape[1] for member in members)
    embeddings = tuple((m.patch.embedding, m.patch.nodes.shape[1], m.place) for m in members)
    embedding = Embedded(embeddings, tuple(m.normal for m in members))
    nodes, cells, one = list[Array](), list[NDArray[np.int64]](), list[NDArray[np.int64]]()
    edges, points, patches = (
        dict[str, NDArray[np.int64]](),
        dict[str, Array](),
        dict[str, NDArray[np.bool_]](),
    )
    first, total = 0, sum(len(member.patch.cells) for member in members)

    def in_assembly(own: Array, number: int) -> Array:
        rows = np.zeros((len(own), 3 + OWN + 1))
        rows[:, 3 : 3 + own.shape[1]], rows[:, -1] = own, number
        rows[:, :3] = embedding(rows)
        return rows

    begin = 0
    for number, member in enumerate(members):
        patch = _raised(member.patch, most)
        count = len(patch.nodes)
        nodes.append(in_assembly(patch.nodes, number))
        cells.append(patch.cells + first)
        one.append((np.arange(count) if patch.one is None else patch.one) + first)
        for name, pairs in patch.edges.items():
            on_plane = halved and name in (CUT, SECOND_CUT)
            before = [edges[name]] if on_plane and name in edges else []
            edges[name if on_plane else f"{member.name}_{name}"] = np.concatenate(
                [*before, pairs + first]
            )
        named = [name for name in patch.points if name in ("pole", *member.points)]
        points |= {
            f"{member.name}_{name}": in_assembly(patch.points[name][None], number)[0]
            for name in named
        }
        every = np.ones(len(patch.cells), dtype=bool)
        for name, of in {"": every, **patch.patches}.items():
            inside = np.zeros(total, dtype=bool)
            inside[begin : begin + len(patch.cells)] = of
            patches[f"{member.name}_{name}" if name else member.name] = inside
        first, begin = first + count, begin + len(patch.cells)
    given = np.column_stack([np.arange(total), np.zeros(total, dtype=np.int64)])
    return PatchMesh(
        np.concatenate(nodes),
        np.concatenate(cells),
        embedding,
        edges,
        points,
        np.concatenate(one),
        patches,
        given,
        shells=tuple(member.name for member in members),
    )


def joined(patch: PatchMesh, joints: Sequence[tuple[str, str]]) -> PatchMesh:
    """With joints, whose edges are no border any more; the edge of a T-junction stays one.

    Raises
    ------
    MeshError
        See `glued`.
    """
    tees = [on_shell(patch, edges, f"joints.{number}.edges") for number, edges in enumerate(joints)]
    for number, edges in enumerate(joints):
        patch = patch if tees[number] else glued(patch, edges, f"joints.{number}.edges")
    sides = [
        None if tee else (_beside(patch, edges[0]), _beside(patch, edges[1]))
        for tee, edges in zip(tees, joints, strict=True)
    ]
    glued_names = {
        name for edges, tee in zip(joints, tees, strict=True) for name in edges if not tee
    }
    border = {name: pairs for name, pairs in patch.edges.items() if name not in glued_names}
    return replace(patch, edges=border, joints=tuple(sides))


def on_shell(patch: PatchMesh, edges: tuple[str, str], key: str) -> bool:
    """Whether a joint sets an edge, which stands first, on another shell or on a patch of one.

    Raises
    ------
    MeshError
        If the first name is no edge; the message begins with the key.
    """
    if edges[1] in patch.edges or edges[1] not in patch.patches:
        return False
    if edges[0] not in patch.edges:
        raise MeshError(
            f"{key}: {edges[0]}: is no edge; an edge stands first, and then the shell on which it is"
        )
    return True


def glued(patch: PatchMesh, edges: tuple[str, str], key: str) -> PatchMesh:
    """With the vertices of the second edge glued to those of the first, which are at the same
    places.

    Where one edge has a vertex and the other has none, the triangle there is divided.

    Raises
    ------
    MeshError
        If there is no such edge, the edges do not meet, or have different normals; the message
        begins with the key.
    """
    for name in edges:
        if name not in patch.edges:
            raise MeshError(f"{key}: {name}: there is no such edge, only {', '.join(patch.edges)}")
    places_on = [patch.nodes[np.unique(patch.edges[name]), :3] for name in edges]
    patch, unmet = _divided(patch, edges[0], places_on[1])
    patch, other = _divided(patch, edges[1], places_on[0])
    far, at = max(unmet, other, key=lambda each: each[0])
    if far > MEET * float(np.ptp(patch.nodes[:, :3], axis=0).max()):
        raise MeshError(
            f"{key}: {' and '.join(edges)} do not meet, by {far:.4g} R at {place_text(at)}, over R: move one of the "
            "shells, or make both edges as long"
        )
    assert patch.one is not None
    kept, away = (np.unique(patch.edges[name]) for name in edges)
    places = patch.nodes[:, :3]
    nearest = np.linalg.norm(places[away][:, None] - places[kept][None], axis=2).argmin(axis=1)
    if len(np.unique(nearest)) != len(kept):
        near = _nearest_two(places[kept], places[away])
        raise MeshError(
            f"{key}: vertices of {' and '.join(edges)} nearly meet, {near}, over R: give both shells the same mesh.size"
        )
    to = np.arange(len(patch.one))
    to[away] = kept[nearest]
    joined = replace(
        patch, edges={name: to[pairs] for name, pairs in patch.edges.items()}, one=to[patch.one]
    )
    try:
        check_orientation(joined)
    except MeshError:
        raise MeshError(
            f"{key}: the normals of {edges[0]} and {edges[1]} point to opposite sides: turn one of the shells over"
        ) from None
    return joined


def _nearest_two(kept: Array, away: Array) -> str:
    """The two nearest places (n, 3) along an edge that are not one, with all digits that tell them
    apart."""
    all_of_them = np.vstack([kept, away])
    apart = np.linalg.norm(all_of_them[:, None] - all_of_them[None], axis=2)
    apart[apart <= SAME] = np.inf
    i, j = np.unravel_index(int(apart.argmin()), apart.shape)
    one, other = told_apart(all_of_them[i], all_of_them[j])
    return f"at ({one}) and ({other})"


def _divided(patch: PatchMesh, edge: str, targets: Array) -> tuple[PatchMesh, tuple[float, Array]]:
    """With vertices on an edge at places (n, 3), and how far the farthest of these is from it, and
    where.
    """
    pairs, sides = patch.edges[edge], patch.corners[:, SIDES]
    of = {tuple(sorted(sides[c, s])): (c, s) for c, s in np.ndindex(*sides.shape[:2])}
    cell, side = np.array([of[tuple(sorted(pair))] for pair in pairs]).T
    S, T = len(pairs), len(targets)
    start, end = CORNERS[SIDES[side]].transpose(1, 0, 2)
    t = np.full((S, T), 0.5)
    ends = patch.nodes[patch.cells[cell[:, None], SIDES[side]], :3]
    chord = ends[:, 1] - ends[:, 0]

    def at(t: Array) -> Array:
        X = start[:, None] + t[..., None] * (end - start)[:, None]
        places = patch.embedding(_in_cells(patch, np.repeat(cell, T), X.reshape(-1, 2)))
        return np.asarray(places.reshape(S, T, 3))

    for _ in range(ROUNDS):
        off = targets[None] - at(t)
        t = np.clip(
            t + np.einsum("sti,si->st", off, chord) / np.einsum("si,si->s", chord, chord)[:, None],
            0,
            1,
        )
    distance = np.linalg.norm(targets[None] - at(t), axis=2)
    nearest, each = distance.argmin(axis=0), np.arange(T)
    worst = int(distance.min(axis=0).argmax())
    unmet = float(distance[nearest[worst], worst]), targets[worst]
    along = t[nearest, each]
    new = (along > NEARLY) & (along < 1 - NEARLY)
    for which in np.unique(nearest[new]):
        cuts = np.sort(along[new & (nearest == which)])
        patch = _fan(patch, edge, int(cell[which]), int(side[which]), cuts)
    return patch, unmet


def _fan(patch: PatchMesh, edge: str, cell: int, side: int, cuts: Array) -> PatchMesh:
    """With a triangle divided from the corner opposite to a side, at numbers from 0 to 1 along
    that.
    """
    import basix  # slow to import, and not needed to read a case
    from dolfinx import mesh
    from dolfinx.cpp.io import perm_gmsh

    from magshell_fenicsx.mesh.midsurface import ORDERS

    assert patch.one is not None
    assert patch.given is not None
    count, (i, j) = patch.cells.shape[1], SIDES[side]
    family, variant = basix.ElementFamily.P, basix.LagrangeVariant.equispaced
    points = basix.create_element(family, basix.CellType.triangle, ORDERS[count], variant).points
    on = np.array([0.0, *cuts, 1.0])
    X = CORNERS[i] + on[:, None] * (CORNERS[j] - CORNERS[i])
    apex = 3 - i - j
    first = len(patch.nodes)
    numbers = [patch.cells[cell, i], *range(first, first + len(cuts)), patch.cells[cell, j]]
    added, rows = [_in_cells(patch, np.full(len(cuts), cell), X[1:-1])], list[NDArray[np.int64]]()
    total = first + len(cuts)
    for k in range(len(on) - 1):
        a, b, c = X[k], X[k + 1], CORNERS[apex]
        inner = a + points[3:] @ np.array([b - a, c - a])
        added.append(_in_cells(patch, np.full(len(inner), cell), inner))
        row = np.empty(count, dtype=np.int64)
        own = [
            numbers[k],
            numbers[k + 1],
            patch.cells[cell, apex],
            *range(total, total + len(inner)),
        ]
        row[perm_gmsh(mesh.CellType.triangle, count)] = own
        rows.append(row)
        total += len(inner)
    nodes = np.concatenate([patch.nodes, *added])
    nodes[first:, :3] = patch.embedding(nodes[first:])
    cells = np.concatenate([patch.cells, np.array(rows[1:])])
    cells[cell] = rows[0]
    more = np.full(len(rows) - 1, cell)
    one = np.concatenate([patch.one, np.arange(first, total)])
    ends = {int(one[numbers[0]]), int(one[numbers[-1]])}
    kept = [pair for pair in patch.edges[edge] if {int(pair[0]), int(pair[1])} != ends]
    chain = one[np.array([numbers[:-1], numbers[1:]]).T]

    def parents(values: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([values, values[more]])

    return replace(
        patch,
        nodes=nodes,
        cells=cells,
        one=one,
        edges={
            **patch.edges,
            edge: np.concatenate([np.array(kept, dtype=np.int64).reshape(-1, 2), chain]),
        },
        patches={name: parents(inside) for name, inside in patch.patches.items()},
        given=parents(patch.given),
    )


def _in_cells(patch: PatchMesh, cell: NDArray[np.int64], X: Array) -> Array:
    """Nodes (n, d) at reference points (n, 2) of cells (n,)."""
    import basix
    from dolfinx import mesh
    from dolfinx.cpp.io import perm_gmsh

    from magshell_fenicsx.mesh.midsurface import ORDERS

    count = patch.cells.shape[1]
    family, variant = basix.ElementFamily.P, basix.LagrangeVariant.equispaced
    element = basix.create_element(family, basix.CellType.triangle, ORDERS[count], variant)
    table = element.tabulate(0, X)[0, :, :, 0]
    return np.asarray(
        np.einsum(
            "nk,nkd->nd",
            table,
            patch.nodes[patch.cells[cell][:, perm_gmsh(mesh.CellType.triangle, count)]],
        )
    )


def _beside(patch: PatchMesh, edge: str) -> NDArray[np.bool_]:
    """Whether each triangle of the edge's own shell has a side of it."""
    ends, sides = as_set(patch.edges[edge]), np.sort(directed_sides(patch.corners), axis=1)
    on = np.array([(int(a), int(b)) in ends for a, b in sides]).reshape(3, -1).any(axis=0)
    own = max((name for name in patch.patches if edge.startswith(f"{name}_")), key=len)
    return np.asarray(on & patch.patches[own])


def _raised(patch: PatchMesh, count: int) -> PatchMesh:
    """The same triangles with so many nodes, which are on them; vertices keep their numbers."""
    if patch.cells.shape[1] == count:
        return patch
    import basix  # slow to import, and not needed to read a case
    from dolfinx import mesh
    from dolfinx.cpp.io import perm_gmsh

    from magshell_fenicsx.mesh.midsurface import ORDERS, at_reference_points

    family, variant = basix.ElementFamily.P, basix.LagrangeVariant.equispaced
    element = basix.create_element(family, basix.CellType.triangle, ORDERS[count], variant)
    places = at_reference_points(patch.nodes, patch.cells, element.points[3:])
    new = len(patch.nodes) + np.arange(places.shape[0] * places.shape[1]).reshape(places.shape[:2])
    cells = np.empty((len(patch.cells), count), dtype=np.int64)
    cells[:, perm_gmsh(mesh.CellType.triangle, count)] = np.concatenate(
        [patch.cells[:, :3], new], axis=1
    )
    nodes = np.concatenate([patch.nodes, places.reshape(-1, patch.nodes.shape[1])])
    one = None if patch.one is None else np.concatenate([patch.one, new.ravel()])
    return PatchMesh(
        nodes, cells, patch.embedding, patch.edges, patch.points, one, patch.patches, patch.given
    )

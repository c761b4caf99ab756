"""Several shells as one triangulation: each is meshed as it is alone, then turned and moved to its place.

A node is its place in space (3,), its node in the shell's own triangulation, and last the number of its shell. So readers
of mesh files find places, and the embedding finds the shell's own: placement and curvature are as exact as those of the
shell alone.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import Embedding, PatchMesh

Array = NDArray[np.float64]
OWN = 6  # most numbers of a node of its own: place and normal, in a mesh file


@dataclass(frozen=True)
class Place:
    """Where a shell is: places x (n, 3) of its own, over its own length, are at scale Q x + position.

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
    """A shell of an assembly: its name, its own triangulation, its place, and which points of it are named."""

    name: str
    patch: PatchMesh
    place: Place
    points: Sequence[str] = ()


@dataclass(frozen=True)
class Embedded:
    """Nodes (n, 10) of an assembly -> places (n, 3), by the shell of each."""

    embeddings: tuple[tuple[Embedding, int, Place], ...]

    def __call__(self, nodes: Array) -> Array:
        number, found = np.rint(nodes[:, -1]), np.array(nodes[:, :3])
        for i, (embedding, size, place) in enumerate(self.embeddings):
            of = number == i
            if of.any():
                found[of] = place(embedding(nodes[of, 3 : 3 + size]))
        return found


@dataclass(eq=False)
class Assembly:
    """What stands in place of a mesh file where there are several shells; its mesh is made when it is asked for.

    Attributes
    ----------
    digest
        A hash of all from which it is made.
    members
        Makes its shells, each rank the same; a `MeshError` or `CaseError` begins with the key of one that cannot be.
    home
        None: no program gave a mesh.
    """

    digest: str
    members: Callable[[], Sequence[Member]] = field(repr=False)
    home: None = None

    def __deepcopy__(self, memo: dict[int, object]) -> "Assembly":
        return self

    @cached_property
    def patch(self) -> PatchMesh:
        """All of them as one triangulation."""
        return joined(self.members())

    @property
    def cells(self) -> NDArray[np.int64]:
        """Those of all shells."""
        return self.patch.cells


def joined(members: Sequence[Member]) -> PatchMesh:
    """One triangulation of shells that do not share a node; names of edges and points begin with that of the shell.

    Each shell is a patch with its name.
    """
    most = max(member.patch.cells.shape[1] for member in members)
    embeddings = tuple((m.patch.embedding, m.patch.nodes.shape[1], m.place) for m in members)
    embedding = Embedded(embeddings)
    nodes, cells, one = list[Array](), list[NDArray[np.int64]](), list[NDArray[np.int64]]()
    edges, points, patches = dict[str, NDArray[np.int64]](), dict[str, Array](), dict[str, NDArray[np.bool_]]()
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
        edges |= {f"{member.name}_{name}": pairs + first for name, pairs in patch.edges.items()}
        points |= {f"{member.name}_{name}": in_assembly(patch.points[name][None], number)[0] for name in member.points}
        inside = {member.name: np.ones(len(patch.cells), dtype=bool)}
        inside |= {f"{member.name}_{name}": of for name, of in patch.patches.items()}
        for name, of in inside.items():
            patches[name] = np.zeros(total, dtype=bool)
            patches[name][begin : begin + len(patch.cells)] = of
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
    )


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
    cells[:, perm_gmsh(mesh.CellType.triangle, count)] = np.concatenate([patch.cells[:, :3], new], axis=1)
    nodes = np.concatenate([patch.nodes, places.reshape(-1, patch.nodes.shape[1])])
    one = None if patch.one is None else np.concatenate([patch.one, new.ravel()])
    return PatchMesh(nodes, cells, patch.embedding, patch.edges, patch.points, one, patch.patches, patch.given)

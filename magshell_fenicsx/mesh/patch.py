"""A triangulated surface before it is given to dolfinx, and the sides of its triangles."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mpi4py import MPI

    from magshell_fenicsx.mesh.given import Home

Embedding = Callable[[NDArray[np.float64]], NDArray[np.float64]]
Array = NDArray[np.float64]
Pairs = NDArray[np.int64]  # (n, 2) vertices of edges


@dataclass(frozen=True, eq=False)
class Triangles:
    """A surface in space as a file or a program gives it; nobody changes it.

    Attributes
    ----------
    nodes
        (n, 3) coordinates.
    cells
        (m, 3 | 6 | 10) node numbers in gmsh's order, vertices first.
    edges
        Name -> (e, 2) vertex pairs.
    patches
        Name -> (m,) whether each triangle belongs to it.
    home
        The mesh of a program that they are from; None of a file.
    """

    nodes: Array
    cells: NDArray[np.int64]
    edges: dict[str, Pairs] = field(default_factory=dict)
    patches: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    home: "Home | None" = field(default=None, repr=False)

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self

    @cached_property
    def digest(self) -> str:
        """A hash of all that it has."""
        named = [
            each
            for name, part in {**self.edges, **self.patches}.items()
            for each in (np.array(name), part)
        ]
        return _digest(self.nodes, self.cells, *named)


@dataclass(frozen=True, eq=False, repr=False)
class GivenField:
    """Numbers that vary over `Triangles` as a program gives them, polynomials in each; nobody
    changes it.

    Attributes
    ----------
    name
        For people.
    degree
        Of the polynomials.
    nodal
        (m, nodes, size) values at the nodes of Basix's Lagrange element of the degree, in the order
        of each triangle.
    swapped
        (nodes,) for each node that with the second and third vertex exchanged.
    home
        The mesh that it is on.
    """

    name: str
    degree: int
    nodal: Array
    swapped: NDArray[np.int64]
    home: "Home | None" = None

    def __repr__(self) -> str:
        return "a function on the mesh"

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self

    @cached_property
    def digest(self) -> str:
        """A hash of its values."""
        return _digest(self.nodal)

    @property
    def size(self) -> int:
        """How many numbers it is at each place."""
        return int(self.nodal.shape[2])

    @property
    def largest(self) -> Array:
        """The numbers (size,) where they are largest."""
        each = self.nodal.reshape(-1, self.size)
        return np.asarray(each[np.argmax(np.linalg.norm(each, axis=1))])

    def mapped(self, of: Callable[[Array], Array]) -> "GivenField":
        """With other numbers (..., others) linear in these (..., size)."""
        return replace(self, nodal=of(self.nodal))

    def in_cells(self, given: NDArray[np.int64]) -> Array:
        """Values (cells, nodes, size) in triangles as `PatchMesh.given` tells them."""
        number, turned = given.T
        values = self.nodal[number]
        return np.where(turned[:, None, None] == 1, values[:, self.swapped], values)


def _digest(*arrays: NDArray[Any]) -> str:
    digest = hashlib.sha256()
    for each in arrays:
        digest.update(str((each.dtype, each.shape)).encode() + np.ascontiguousarray(each).tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class PatchMesh:
    """Triangles of order 1, 2 or 3 with named edges and points.

    Attributes
    ----------
    nodes
        (n, d) coordinates: of a chart (d = 2) or of space (d = 3).
    cells
        (m, 3 | 6 | 10) node numbers in gmsh's order, vertices first.
    embedding
        Maps (n, d) coordinates to (n, 3) points of the mid-surface.
    edges
        Name -> (e, 2) vertex pairs of that boundary edge.
    points
        Name -> (d,) coordinates of a vertex of the mesh.
    one
        (n,) for each node the node that it is glued to, or itself: glued nodes have the same place
        in space and are one vertex. `edges` has these numbers. None where nothing is glued.
    patches
        Name -> (m,) whether each triangle belongs to that part of the surface.
    given
        (m, 2) of a surface that was given as `Triangles`: the number of each triangle there, and 1
        where it has been turned over; None without.
    joints
        Of each two edges that are glued: whether each triangle has one, and whether it has the
        other. None for an edge on another shell, of which nothing is glued.
    feet
        Of a mesh file in which an edge has three triangles: name of an edge that stands on another
        sheet -> whether each triangle is one on which it does.
    shells
        Names of the patches that are shells, of which there are several.
    """

    nodes: NDArray[np.float64]
    cells: NDArray[np.int64]
    embedding: Embedding
    edges: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    points: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    one: NDArray[np.int64] | None = None
    patches: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    given: NDArray[np.int64] | None = None
    joints: tuple[tuple[NDArray[np.bool_], NDArray[np.bool_]] | None, ...] = ()
    feet: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    shells: tuple[str, ...] = ()

    @property
    def corners(self) -> NDArray[np.int64]:
        """(m, 3) vertices of the triangles, glued ones under one number."""
        corners = self.cells[:, :3]
        return corners if self.one is None else self.one[corners]


class MeshError(ValueError):
    """The triangulation cannot carry a shell; the message says where and why."""


def refuse_places(bad: Array, what: str, comm: "MPI.Comm") -> None:
    """See that no rank has found a bad place (n, 3) over R; collective.

    Raises
    ------
    MeshError
        On every rank, with the first of them.
    """
    if places := [place for of_rank in comm.allgather(bad[:1].tolist()) for place in of_rank]:
        x, y, z = places[0]
        raise MeshError(f"{what} at (x, y, z)/R = ({x:.3g}, {y:.3g}, {z:.3g})")


def place_text(x: NDArray[np.float64]) -> str:
    """The coordinates (3,) of a place, for messages."""
    return f"({x[0]:.4g}, {x[1]:.4g}, {x[2]:.4g})"


def directed_sides(cells: NDArray[np.int64]) -> Pairs:
    """Sides (3 m, 2) in the direction of their triangles (m, 3 or more): all first sides, all
    second, all third.
    """
    return np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]])


def border_pairs(sides: Pairs) -> Pairs:
    """The sides that belong to one triangle only, lower vertex first."""
    pairs, times = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    return np.asarray(pairs[times == 1])


def as_set(pairs: Pairs) -> set[tuple[int, int]]:
    """Pairs of vertices without a direction: lower vertex first."""
    return {(int(a), int(b)) for a, b in np.sort(pairs, axis=1)}


def on_border(named: Mapping[str, Pairs], border: Pairs) -> dict[str, Pairs]:
    """The part of each named edge that lies on the border; names without such a part are left out."""
    ends = as_set(border)
    kept = {
        name: pairs[[(a, b) in ends for a, b in np.sort(pairs, axis=1)]]
        for name, pairs in named.items()
    }
    return {name: pairs for name, pairs in kept.items() if len(pairs)}


def check_orientation(patch: PatchMesh) -> None:
    """Refuse a triangulation whose normals do not all point to one side.

    Raises
    ------
    MeshError
        If two neighbours run through their common edge in the same direction, or
        if more than two triangles share an edge.
    """
    same_way, times = np.unique(directed_sides(patch.corners), axis=0, return_counts=True)
    if (times > 1).any():
        a, b = same_way[times > 1][0]
        where = patch.embedding(patch.nodes[[a, b]]).mean(axis=0)
        raise MeshError(
            f"the normals of two neighbouring triangles point to opposite sides (or three triangles meet) "
            f"at the edge around {place_text(where)}"
        )


Deviation = Callable[[Array], Array]  # places (n, 3) of the perfect surface -> w0 (n,), both over R


@dataclass(frozen=True)
class Deviated:
    """Chart -> r0 = x + w0(x) n(x), with the sum w0 of all deviations.

    Attributes
    ----------
    perfect, normal
        Chart -> places x (n, 3) and outward unit normals (n, 3) of the perfect surface.
    """

    perfect: Embedding
    normal: Embedding
    deviations: tuple[Deviation, ...]

    def __call__(self, chart: Array) -> Array:
        return np.asarray(self.perfect(chart) + self.w0(chart)[:, None] * self.normal(chart))

    def along_normal(self, chart: Array, deviations: Sequence[Deviation]) -> Array:
        """The displacement (n, 3) that other deviations add."""
        return replace(self, deviations=tuple(deviations)).w0(chart)[:, None] * self.normal(chart)

    def w0(self, chart: Array) -> Array:
        """w0 over R at places of the chart, (n,)."""
        places = self.perfect(chart)
        return np.asarray(
            sum((deviation(places) for deviation in self.deviations), np.zeros(len(places)))
        )

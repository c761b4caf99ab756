"""A triangulated mid-surface before it is given to dolfinx, and the sides of its triangles.

`SurfaceTriangles` and `UserField` hold what a file or a program gives. `PatchMesh` is the
triangulation that the shell is computed on: nodes in a chart or in space, the embedding into space,
named edges, points and patches. A chart is the plane of two coordinates of the surface; a patch is
a named part of the surface; a user field is a function on the mesh of a program. The deviation w0
is the distance of the imperfect from the perfect surface along its normal. Lengths are over R, the
reference length, if nothing else is said. Arrays are NumPy's, and no function here is collective
but `refuse_places`.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mpi4py import MPI

    from magshell_fenicsx.mesh.user_mesh import UserMesh

Embedding = Callable[[NDArray[np.float64]], NDArray[np.float64]]
Array = NDArray[np.float64]
Pairs = NDArray[np.int64]  # (n, 2) vertices of edges


@dataclass(frozen=True, eq=False)
class SurfaceTriangles:
    """A surface in space as a file or a program gives it; it is never changed.

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
    user_mesh
        The mesh of a program that they are from; None for a file.
    """

    nodes: Array
    cells: NDArray[np.int64]
    edges: dict[str, Pairs] = field(default_factory=dict)
    patches: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    user_mesh: "UserMesh | None" = field(default=None, repr=False)

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self

    @cached_property
    def digest(self) -> str:
        """Hash of nodes, cells, edges and patches."""
        names_and_values = list[NDArray[Any]]()
        for name, values in {**self.edges, **self.patches}.items():
            names_and_values += [np.array(name), values]
        return _digest(self.nodes, self.cells, *names_and_values)


@dataclass(frozen=True, eq=False, repr=False)
class UserField:
    """A field on `SurfaceTriangles`, a polynomial in each, with the values of a program's function.

    Attributes
    ----------
    name
        Name for messages.
    degree
        Degree of the polynomials.
    nodal
        (m, nodes, size) values at the nodes of Basix's Lagrange element of the degree, in the order
        of each triangle; those of the function when it was read last.
    swapped
        (nodes,) number that each node has when the second and third vertex are exchanged.
    user_mesh
        The mesh that the field is on.
    read
        Returns the function's present values, as `nodal`; collective. None: they never change.
    """

    name: str
    degree: int
    nodal: Array
    swapped: NDArray[np.int64]
    user_mesh: "UserMesh | None" = None
    read: Callable[[], Array] | None = None

    def __repr__(self) -> str:
        return "a function on the mesh"

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self

    @property
    def digest(self) -> str:
        """Hash of the values."""
        return _digest(self.nodal)

    @property
    def size(self) -> int:
        """Number of components at each place."""
        return int(self.nodal.shape[2])

    @property
    def largest(self) -> Array:
        """The value (size,) of the largest norm."""
        values = self.nodal.reshape(-1, self.size)
        return np.asarray(values[np.argmax(np.linalg.norm(values, axis=1))])

    def mapped(self, linear_map: Callable[[Array], Array]) -> "UserField":
        """Return the field after a linear map of its values (..., size) to (..., other size)."""
        read = self.read
        mapped_read = (lambda: linear_map(read())) if read else None
        return replace(self, nodal=linear_map(self.nodal), read=mapped_read)

    def update(self) -> None:
        """Read the function again. Collective.

        Raises
        ------
        MeshError
            On every rank, if values are not numbers.
        """
        if self.read:
            self.nodal[...] = self.read()

    def in_cells(self, source_triangles: NDArray[np.int64]) -> Array:
        """Return the values (cells, nodes, size) in triangles of a triangulation, at their nodes.

        In a reversed triangle the second and third vertex are exchanged, and so are values there.

        Parameters
        ----------
        source_triangles
            (cells, 2) number of each triangle in `SurfaceTriangles`, and 1 where its orientation is
            reversed.
        """
        number, is_reversed = source_triangles.T
        values = self.nodal[number]
        return np.where(is_reversed[:, None, None] == 1, values[:, self.swapped], values)


def _digest(*arrays: NDArray[Any]) -> str:
    """Return a hash of types, shapes and contents of arrays."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(str((array.dtype, array.shape)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class PatchMesh:
    """Triangles of order 1, 2 or 3 with named edges, points and patches.

    Attributes
    ----------
    nodes
        (n, d) coordinates: of a chart (d = 2) or of space (d = 3; 6 with normals).
    cells
        (m, 3 | 6 | 10) node numbers in gmsh's order, vertices first; of order 1, 2 or 3.
    embedding
        Maps (n, d) coordinates to (n, 3) places of the mid-surface.
    edges
        Name -> (e, 2) vertex pairs of that boundary edge.
    points
        Name -> (d,) coordinates of a vertex of the mesh.
    representative
        (n,) for each node the node that it is glued to, or itself: glued nodes have the same place
        in space and are one vertex. `edges` has these numbers. None where nothing is glued.
    patches
        Name -> (m,) whether each triangle belongs to that part of the surface.
    source_triangles
        (m, 2) of a surface that was given as `SurfaceTriangles`: the number of each triangle there,
        and 1 where its orientation is reversed; None for other surfaces.
    joints
        For each joint, two masks (m,): whether each triangle has a side on the first edge, and on
        the second one. None for a T-junction, of which nothing is glued.
    t_junctions
        Of a mesh file in which an edge has three triangles: name of an edge that ends on another
        sheet -> (m,) whether each triangle is one that it ends on.
    shells
        Names of the patches that are shells, where there are several.
    inner_lines
        Name -> (e, 2) vertex pairs of a line within the surface: a joined edge, or a curve of a
        mesh file between triangles.
    """

    nodes: NDArray[np.float64]
    cells: NDArray[np.int64]
    embedding: Embedding
    edges: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    points: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    representative: NDArray[np.int64] | None = None
    patches: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    source_triangles: NDArray[np.int64] | None = None
    joints: tuple[tuple[NDArray[np.bool_], NDArray[np.bool_]] | None, ...] = ()
    t_junctions: dict[str, NDArray[np.bool_]] = field(default_factory=dict)
    shells: tuple[str, ...] = ()
    inner_lines: dict[str, NDArray[np.int64]] = field(default_factory=dict)

    @property
    def corners(self) -> NDArray[np.int64]:
        """Vertices (m, 3) of the triangles; glued vertices have one number."""
        corners = self.cells[:, :3]
        return corners if self.representative is None else self.representative[corners]


class MeshError(ValueError):
    """The triangulation cannot carry a shell; the message says where and why."""


def refuse_places(bad_places: Array, what: str, comm: "MPI.Comm") -> None:
    """Raise an error if a rank has found a place at which the mesh or a field is unfit; collective.

    Parameters
    ----------
    bad_places
        (n, 3) unfit places over R that this rank has found; perhaps none.
    what
        Begin of the message, which says what is wrong.

    Raises
    ------
    MeshError
        On every rank, with the first of the places.
    """
    first_of_each_rank = comm.allgather(bad_places[:1].tolist())
    if places := [place for places_of_rank in first_of_each_rank for place in places_of_rank]:
        x, y, z = places[0]
        raise MeshError(f"{what} at (x, y, z)/R = ({x:.3g}, {y:.3g}, {z:.3g})")


def place_text(x: NDArray[np.float64]) -> str:
    """Return the coordinates (3,) of a place as text for messages."""
    return f"({x[0]:.4g}, {x[1]:.4g}, {x[2]:.4g})"


def directed_sides(cells: NDArray[np.int64]) -> Pairs:
    """Return the sides (3 m, 2) of triangles (m, 3 or more), each in its triangle's direction.

    All first sides come first, then all second ones, then all third ones.
    """
    return np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]])


def inner_pairs(sides: Pairs) -> set[tuple[int, int]]:
    """Return the sides that belong to several triangles, lower vertex first."""
    return as_set(sides) - as_set(border_pairs(sides))


def border_pairs(sides: Pairs) -> Pairs:
    """Return the sides that belong to one triangle only, lower vertex first."""
    pairs, times = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    return np.asarray(pairs[times == 1])


def as_set(pairs: Pairs) -> set[tuple[int, int]]:
    """Return pairs of vertices as a set without direction: lower vertex first."""
    return {(int(a), int(b)) for a, b in np.sort(pairs, axis=1)}


def among(lines: Mapping[str, Pairs], sides: set[tuple[int, int]]) -> dict[str, Pairs]:
    """Return the part of each named line among some sides; names without one are left out.

    `sides` are pairs of vertices, lower one first.
    """
    parts = dict[str, Pairs]()
    for name, pairs in lines.items():
        is_there = [(int(a), int(b)) in sides for a, b in np.sort(pairs, axis=1)]
        if any(is_there):
            parts[name] = pairs[is_there]
    return parts


def check_orientation(patch: PatchMesh) -> None:
    """Check that all normals of a triangulation point to one side.

    Raises
    ------
    MeshError
        If two neighbours run through their common edge in the same direction, or
        if more than two triangles share an edge.
    """
    # neighbours that agree run through their edge in opposite directions: no side stands twice
    sides, times = np.unique(directed_sides(patch.corners), axis=0, return_counts=True)
    if (times > 1).any():
        a, b = sides[times > 1][0]
        middle = patch.embedding(patch.nodes[[a, b]]).mean(axis=0)
        raise MeshError(
            "the normals of two neighbouring triangles point to opposite sides "
            f"(or three triangles meet) at the edge around {place_text(middle)}"
        )


Deviation = Callable[[Array], Array]  # places (n, 3) of the perfect surface -> w0 (n,), both over R


@dataclass(frozen=True)
class DeviatedEmbedding:
    """Embedding of an imperfect surface: chart -> r0 = x + w0(x) n(x), w0 the sum of deviations.

    Attributes
    ----------
    perfect, normal
        Chart -> places x (n, 3) and outward unit normals (n, 3) of the perfect surface.
    deviations
        Places x -> w0 along the normal.
    """

    perfect: Embedding
    normal: Embedding
    deviations: tuple[Deviation, ...]

    def __call__(self, chart: Array) -> Array:
        return np.asarray(self.perfect(chart) + self.w0(chart)[:, None] * self.normal(chart))

    def along_normal(self, chart: Array, deviations: Sequence[Deviation]) -> Array:
        """Return the displacement (n, 3) over R that deviations give to places of the chart."""
        w0 = replace(self, deviations=tuple(deviations)).w0(chart)
        return w0[:, None] * self.normal(chart)

    def w0(self, chart: Array) -> Array:
        """Return the deviation w0 over R at places of the chart, (n,)."""
        places = self.perfect(chart)
        return np.asarray(
            sum((deviation(places) for deviation in self.deviations), np.zeros(len(places)))
        )

"""Closest-point projection onto a mid-surface of triangles.

The cells near a point come from a tree, its projection from Newton's method. A point of a surface
is near the material around itself, which it does not touch: a cell counts only if the way to it
within the undeformed surface is long. In go the places of all nodes and the points, out come the
places nearest to the points (`Projections`). docs/theory.md, Contact.

Where the thickness varies, or changes with the state, vectors have a fourth component: half of it
less h/2, with the other sign for points. The distance is then that of the faces and h: |x - y| of
the three, and the fourth of x - y.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import scipy.sparse
from mpi4py import MPI
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from magshell_fenicsx.platform.native import load_native

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
# thicknesses within the surface, along sides, up to which a point does not touch its own surface;
# the way along sides is at most 1.2 times as long as the shortest
SELF_CONTACT_DISTANCE = 4.8
CELL_RADIUS_FACTOR = 1.2  # radius of a cell over that of its nodes about their centre, at most
# largest distance of a cell's places from the nearest of a lattice, times the divisions of a side,
# over the radius of the cell
LATTICE_RADIUS_FACTOR = 1.6
LATTICE_DIVISIONS = (4, 12)  # of a cell's sides: starts of Newton's method, coarse, then fine
LEBESGUE_FACTOR = 1.05  # largest sum of shape functions everywhere over that at a lattice
VERTICES_PER_STRIP = 500  # from which ways within the surface are searched together
FOLLOW_ITERATIONS = 2  # of Newton's method after a small change
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # of the reference triangle
MAX_DIRECTIONS = 3  # in which a point can face places: on both sides, and before an edge
COMPONENT_SIGNS = np.array([1.0, 1.0, 1.0, -1.0])  # of the squares of components in the Hessian
PLACE_SHAPES = (2,), (2, 2), (), (3,)  # of X, free_directions, distance and direction
C_DECLARATIONS = """
    typedef struct {
        int64_t degree, coarse_count, count;
        const double *of, *undeformed, *coarse, *fine, *X, *bounds;
    } Cells;
    int64_t nearest(const Cells *, int64_t, const int64_t *, const int64_t *, const int64_t *,
        const uint8_t *, const uint8_t *, const double *, const int64_t *, const double *,
        const double *, double, double, double,
        int64_t *, int64_t *, double *, double *, double *, double *, uint8_t *);
    void places(int64_t, int64_t, const int64_t *, const int64_t *, const double *, const double *,
        double *);
"""


@dataclass(frozen=True)
class Cells:
    """All cells of a mid-surface, on every rank.

    Attributes
    ----------
    element
        Of basix, with its nodes.
    nodes
        (cells, functions): global numbers.
    corners
        (cells, 3): global numbers of vertices.
    """

    element: Any
    nodes: Longs
    corners: Longs

    @cached_property
    def neighbours(self) -> Longs:
        """(cells, 3): the cell across the side opposite to each corner; -1 at the boundary."""
        sides = [self.corners[:, [1, 2]], self.corners[:, [0, 2]], self.corners[:, [0, 1]]]
        pairs = np.sort(np.stack(sides, axis=1), axis=2)
        keys = pairs[..., 0] * (self.corners.max() + 1) + pairs[..., 1]
        order = np.argsort(keys.ravel(), kind="stable")
        is_shared_with_next = np.flatnonzero(np.diff(keys.ravel()[order]) == 0)
        neighbours = np.full(keys.size, -1)
        a, b = order[is_shared_with_next], order[is_shared_with_next + 1]
        neighbours[a], neighbours[b] = b // 3, a // 3
        return np.asarray(neighbours.reshape(-1, 3))

    @cached_property
    def is_on_edge(self) -> NDArray[np.bool_]:
        """(cells, 3): whether each corner is on an edge of the surface."""
        cell, side = np.nonzero(self.neighbours < 0)
        is_on_edge = np.zeros(self.corners.max() + 1, dtype=bool)
        for corner in ((side + 1) % 3, (side + 2) % 3):
            is_on_edge[self.corners[cell, corner]] = True
        return np.asarray(is_on_edge[self.corners])

    def edge_turns(self, r0: Array, cosine: float) -> NDArray[np.bool_]:
        """Return whether an undeformed edge turns at each corner (cells, 3), by more than an angle.

        Parameters
        ----------
        cosine
            Of the angle.
        """
        cell, side = np.nonzero(self.neighbours < 0)
        slopes = self.element.tabulate(1, CORNERS)[1:, :, :, 0]
        # where an edge is even the two tangents away from a vertex cancel
        turn = np.zeros((int(self.corners.max()) + 1, 3))
        sides = CORNERS[(side + 2) % 3] - CORNERS[(side + 1) % 3]
        for corner, sign in (((side + 1) % 3, 1.0), ((side + 2) % 3, -1.0)):
            tangent = np.einsum("kd,dkn,kni->ki", sides, slopes[:, corner], r0[self.nodes[cell]])
            tangent /= np.linalg.norm(tangent, axis=1)[:, None]
            np.add.at(turn, self.corners[cell, corner], sign * tangent)
        is_turn = np.linalg.norm(turn, axis=1) > np.sqrt(2 * (1 - cosine))
        return np.asarray(is_turn[self.corners])

    @cached_property
    def lattices(self) -> list[tuple[Array, Array]]:
        """Places (m, 2) spread over the reference cell with the shape functions there: coarse,
        fine.
        """
        spread = [
            np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
            for n in LATTICE_DIVISIONS
        ]
        return [(X, self.element.tabulate(0, X)[0, :, :, 0]) for X in spread]

    @cached_property
    def lebesgue_constant(self) -> float:
        """A bound of the element's Lebesgue constant, see `polynomial_bound`."""
        return LEBESGUE_FACTOR * float(np.abs(self.lattices[-1][1]).sum(axis=1).max())

    @cached_property
    def at_corners(self) -> Array:
        """Shape functions (3, functions) at the corners."""
        return np.asarray(self.element.tabulate(0, CORNERS)[0, :, :, 0])

    @cached_property
    def monomials(self) -> Array:
        """(monomials, functions): coefficients of polynomials from their values at nodes.

        The monomials are x^(n-j) y^j, n up to the degree, j from 0 to n.
        """
        x, y = self.element.points.T
        return np.linalg.inv(
            [x ** (n - j) * y**j for n in range(self.element.degree + 1) for j in range(n + 1)]
        ).T

    def near_within_surface(self, r0: Array, distance: Array) -> Longs:
        """Return `near_along_surface` of a placement (nodes, 3) and a reach (nodes,)."""
        x, reach = np.zeros((int(self.corners.max()) + 1, 3)), np.zeros(int(self.corners.max()) + 1)
        x[self.corners], reach[self.corners] = (
            self.at_corners @ r0[self.nodes],
            distance[self.nodes] @ self.at_corners.T,
        )
        return near_along_surface(self.corners, x, reach)


def near_along_surface(corners: Longs, x: Array, reach: Array) -> Longs:
    """Return which cells are near each other within a surface, along the sides of cells.

    The way between any of their corners is shorter than the mean of the reach at its ends.

    Parameters
    ----------
    corners
        (cells, 3), or (cells, 2) of a curve.
    x, reach
        (vertices, dim) undeformed, and (vertices,).

    Returns
    -------
    keys
        i * cells + j of pairs of cells, ascending.
    """
    count, (n, per_cell) = len(x), corners.shape
    farthest = float(reach.max())
    starts, ends = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    numbers = np.minimum(starts, ends), np.maximum(starts, ends)
    edges = scipy.sparse.coo_array((np.ones(len(starts)), numbers), (count, count))
    edges = edges.tocsr().tocoo()  # each once
    lengths = np.linalg.norm(x[edges.row] - x[edges.col], axis=1)
    graph = scipy.sparse.coo_array((lengths, (edges.row, edges.col)), (count, count)).tocsr()
    axis = int(np.ptp(x, axis=0).argmax())
    order = np.argsort(x[:, axis], kind="stable")
    near_pairs = list[tuple[Longs, Longs]]()
    sorted_x = x[order, axis]
    for strip_vertices in np.array_split(order, max(1, count // VERTICES_PER_STRIP)):
        # ways that short leave a strip by no more than their length
        low, high = x[strip_vertices[0], axis] - farthest, x[strip_vertices[-1], axis] + farthest
        begin, end = np.searchsorted(sorted_x, low), np.searchsorted(sorted_x, high, "right")
        candidates = order[begin:end]
        rows = np.flatnonzero(np.isin(candidates, strip_vertices))
        strip_graph = graph[candidates][:, candidates]
        lengths = dijkstra(strip_graph, directed=False, indices=rows, limit=farthest)
        mean_reach = (reach[candidates[rows], None] + reach[candidates]) / 2
        row, column = np.nonzero(lengths <= mean_reach)
        near_pairs.append((candidates[rows[row]], candidates[column]))
    i, j = (np.concatenate(numbers) for numbers in zip(*near_pairs, strict=True))
    vertex_pairs = scipy.sparse.coo_array((np.ones(len(i)), (i, j)), (count, count)).tocsr()
    of_cell = np.repeat(np.arange(n), per_cell)
    flags = np.ones(len(of_cell)), (of_cell, corners.ravel())
    vertices_of_cells = scipy.sparse.coo_array(flags, (n, count)).tocsr()
    i, j = (vertices_of_cells @ vertex_pairs @ vertices_of_cells.T).nonzero()
    return np.asarray(np.unique(i.astype(np.int64) * n + j))


@dataclass(frozen=True)
class Projections:
    """Points and the places of a surface nearest to them.

    Attributes
    ----------
    point, cell
        (n,) numbers of the points, and of the cells of the places.
    X
        (n, 2) in the reference cell.
    free_directions
        (n, 2, 2): columns are directions in which a place can move: both inside a cell, along a
        side, none in a corner.
    distance
        (n,) over R.
    side
        (n,): places in one direction from their point have one number, less than
        `MAX_DIRECTIONS`; 0 that of the nearest.
    direction
        (n, 3) unit vectors to the points.
    is_above
        (n,) whether the point is above the place, and not beside it as in one surface that is flat.
    """

    point: Longs
    cell: Longs
    X: Array
    free_directions: Array
    distance: Array
    side: Longs
    direction: Array
    is_above: NDArray[np.bool_]

    @property
    def firsts(self) -> Longs:
        """Numbers of the first place of each point and direction, of places in their order.

        The order is by points, directions and distances.
        """
        return np.flatnonzero(np.diff(MAX_DIRECTIONS * self.point + self.side, prepend=-1))

    def select(self, selection: Any) -> "Projections":
        """Return the selected places: numbers, flags or a slice."""
        return Projections(
            *(getattr(self, attribute.name)[selection] for attribute in fields(self))
        )


@dataclass(frozen=True)
class UndeformedPairs:
    """The pairs of points and places that are near each other within the undeformed surface.

    Attributes
    ----------
    is_near
        (pairs,) whether the cells are near in the surface; only there r and x matter.
    r, x
        (nodes, 4) and (n, 4) places of nodes and points, with half the thickness, of points with
        the other sign.
    least_distance_ratio
        Least distance of a place that counts, over the mean of both thicknesses.
    """

    is_near: NDArray[np.bool_]
    r: Array
    x: Array
    least_distance_ratio: float


@dataclass(frozen=True)
class ProjectionLimits:
    """How far the nearest place of a point is at most, where no other one is asked for.

    Attributes
    ----------
    is_bounded
        (pairs,) whether places of these cells that are farther may be left out.
    reach
        (n,) of each point.
    """

    is_bounded: NDArray[np.bool_]
    reach: Array


def polynomial_bound(values: Array, lebesgue_constant: float) -> float:
    """Return an upper bound of polynomials with values (cells, functions) at nodes.

    Parameters
    ----------
    lebesgue
        Lebesgue's constant of the element.
    """
    largest, smallest = values.max(axis=1, initial=-np.inf), values.min(axis=1, initial=np.inf)
    return float(
        ((largest + smallest + lebesgue_constant * (largest - smallest)) / 2).max(initial=-np.inf)
    )


def jets(element: Any, X: Array, nodal: Array, order: int = 2) -> Iterator[tuple[Array, Array]]:
    """Yield shape functions (n, functions) at places (n, 2), and the field (n, 3 or 4) there.

    First themselves, then their derivatives by the first coordinate, the second, and both twice, up
    to the order.

    Parameters
    ----------
    nodal
        (n, functions, 3 or 4) the field's values at the nodes of each place's cell.
    """
    for table in element.tabulate(order, X)[..., 0]:
        yield table, np.einsum("nk,nki->ni", table, nodal)


def nearest_places(
    cells: Cells,
    r: Array,
    x: Array,
    pairs: tuple[Longs, Longs, Longs, Longs],
    reach: float,
    max_distance: float = np.inf,
    undeformed: UndeformedPairs | None = None,
    limits: ProjectionLimits | None = None,
) -> tuple[Longs, Projections]:
    """Return the places of cells nearest to points, with the numbers of their pairs.

    Newton's method begins at the nearest place of a lattice. Compiled, see projection.c.

    Parameters
    ----------
    r
        (nodes, 3) places of all nodes, or (nodes, 4).
    x
        (n, 3) points, or (n, 4).
    pairs
        Of a cell with points: the cells, the first of the points in the last array, how many there
        are; and the numbers of points.
    reach
        Between points and mid-surfaces.
    max_distance
        Places that are farther are left out.
    """
    cell, first, number, order = pairs
    used_cells, row_of_cell = np.unique(cell, return_inverse=True)
    nodal = r[cells.nodes[used_cells]]
    no_flags = np.zeros(len(cell), dtype=bool)
    positions, reference = nodal[..., :3], undeformed or UndeformedPairs(no_flags, r, x, 0.0)
    search_limits = limits or ProjectionLimits(no_flags, np.zeros(len(x)))
    centres = positions.mean(axis=1)
    radii = CELL_RADIUS_FACTOR * np.linalg.norm(positions - centres[:, None], axis=2).max(axis=1)
    bounds = np.column_stack(
        [centres, radii, *(LATTICE_RADIUS_FACTOR / parts * radii for parts in LATTICE_DIVISIONS)]
    )
    lattice_places = [np.matmul(positions.swapaxes(1, 2), shape.T) for _, shape in cells.lattices]
    monomials = [
        cells.monomials @ _as_four_components(array)
        for array in (nodal, reference.r[cells.nodes[used_cells]])
    ]
    numbers = cells.element.degree, *(len(X) for X, _ in cells.lattices)
    (ffi, lib), p = library(), _pointers
    c_cells = ffi.new(
        "Cells *", [*numbers, *p(*monomials, *lattice_places, cells.lattices[-1][0], bounds)]
    )
    capacity = int(number.sum())
    point, pair = np.empty((2, capacity), dtype=np.int64)
    floats = [np.empty((capacity, *shape)) for shape in PLACE_SHAPES]
    results = point, pair, *floats, np.empty(capacity, dtype=bool)
    pair_arguments = row_of_cell.ravel(), first, number, reference.is_near, search_limits.is_bounded
    point_arguments = order, _as_four_components(x), _as_four_components(reference.x)
    arguments = p(*pair_arguments, search_limits.reach, *point_arguments)
    count = lib.nearest(
        c_cells,
        len(cell),
        *arguments,
        reach,
        max_distance,
        reference.least_distance_ratio,
        *p(*results),
    )
    X, free_directions, distance, direction = (array[:count] for array in results[2:6])
    point, pair, is_above = point[:count], pair[:count], results[6][:count]
    side = np.zeros(count, dtype=np.int64)
    return pair, Projections(
        point, cell[pair], X, free_directions, distance, side, direction, is_above
    )


def points_in_cells(cells: Cells, r: Array, cell: Longs, shape: Array) -> Array:
    """Return places (n, 3) or (n, 4) of points, with the sign of points.

    Parameters
    ----------
    r
        (nodes, 3) or (nodes, 4) all nodes.
    cell, shape
        (n,) cells of the points, and (n, functions) shape functions there.
    """
    x = np.empty((len(cell), 4))
    nodes = _as_four_components(r * COMPONENT_SIGNS[: r.shape[1]])
    arrays = _pointers(cell, cells.nodes, shape, nodes, x)
    library()[1].places(*shape.shape, *arrays)
    return x[:, : r.shape[1]]


def _pointers(*arrays: NDArray[Any]) -> list[Any]:
    kinds = {"int64": "int64_t[]", "float64": "double[]", "bool": "uint8_t[]"}
    return [
        library()[0].from_buffer(kinds[array.dtype.name], np.ascontiguousarray(array))
        for array in arrays
    ]


def _as_four_components(vectors: Array) -> Array:
    """Return vectors of three or four components with four."""
    return np.concatenate(
        [vectors, np.zeros((*vectors.shape[:-1], 4 - vectors.shape[-1]))], axis=-1
    )


@cache
def library() -> tuple[Any, Any]:
    """Return the cffi objects of projection.c, compiled on first use."""
    return load_native(Path(__file__).with_name("projection.c"), C_DECLARATIONS, MPI.COMM_SELF)


def follow_places(cells: Cells, x: Array, nodal: Array, X: Array, free_directions: Array) -> Array:
    """Return the places X (n, 2) after a small change, in the same free directions.

    They may be beyond a side.
    """
    for _ in range(FOLLOW_ITERATIONS):
        (_, y), *derivatives = jets(cells.element, X, nodal)
        g, A = slopes(with_length(x - y), *(each for _, each in derivatives))
        X = X - _solve_in_free_directions(free_directions, A, g)
    return X


def distances(off: Array) -> Array:
    """Return distances (n,) of the differences (n, 3) or (n, 4) between points and places."""
    return np.asarray(np.linalg.norm(off[:, :3], axis=1) + off[:, 3:].sum(axis=1))


def with_length(off: Array) -> Array:
    """Return differences (n, 3 or 4) with their length as the fourth component, if there is one."""
    return np.column_stack([off[:, :3], np.linalg.norm(off[:, :3], axis=1)])[:, : off.shape[1]]


def slopes(
    off: Array, y1: Array, y2: Array, y11: Array, y12: Array, y22: Array
) -> tuple[Array, Array]:
    """Return the gradient (n, 2) of half the squared distance by the place, and its Hessian.

    The Hessian is (n, 2, 2). With a fourth component both are |x - y| times those of the distance,
    the Hessian where the gradient is zero.

    Parameters
    ----------
    off
        (n, 3 or 4) from the places to the points.
    y1, y2, y11, y12, y22
        Derivatives of the surface at the places.
    """

    def dot(a: Array, b: Array) -> Array:
        return np.asarray(np.sum(a * b, axis=1))

    z1, z2 = y1 * COMPONENT_SIGNS[: y1.shape[1]], y2 * COMPONENT_SIGNS[: y2.shape[1]]
    mixed = dot(y1, z2) - dot(off, y12)
    A = np.stack(
        [dot(y1, z1) - dot(off, y11), mixed, mixed, dot(y2, z2) - dot(off, y22)], axis=1
    ).reshape(-1, 2, 2)
    return -np.stack([dot(off, y1), dot(off, y2)], axis=1), A


def _solve_in_free_directions(free_directions: Array, A: Array, g: Array) -> Array:
    """Return A^-1 g in the free directions."""
    return np.asarray(
        np.einsum(
            "nij,nj->ni",
            free_directions,
            np.einsum(
                "nij,nj->ni",
                inverse_in_free_directions(free_directions, A),
                _in_free_directions(free_directions, g),
            ),
        )
    )


def _in_free_directions(free_directions: Array, g: Array) -> Array:
    return np.asarray(np.einsum("nji,nj->ni", free_directions, g))


def inverse_in_free_directions(free_directions: Array, A: Array) -> Array:
    """Return the inverse (n, 2, 2) of A in the free directions, one where there is none."""
    is_fixed = np.asarray(~free_directions.any(axis=1))
    reduced = np.einsum("nji,njk,nkl->nil", free_directions, A, free_directions)
    reduced[:, 0, 0] += is_fixed[:, 0]
    reduced[:, 1, 1] += is_fixed[:, 1]
    adjugates = np.stack(
        [reduced[:, 1, 1], -reduced[:, 0, 1], -reduced[:, 1, 0], reduced[:, 0, 0]], axis=1
    )
    return np.asarray(adjugates.reshape(-1, 2, 2) / determinant(reduced)[:, None, None])


def determinant(A: Array) -> Array:
    """Return the determinants (n,) of matrices (n, 2, 2)."""
    return np.asarray(A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0])


def near_spheres(
    centres: Array, radii: Array, reach: float, own_spheres: Longs
) -> tuple[Longs, Longs]:
    """Return pairs i != j of spheres that are nearer to each other than a reach.

    They are searched in classes of similar radii.

    Parameters
    ----------
    own_spheres
        Numbers of the spheres that i is among.
    """
    size_class = np.floor(np.log2(np.maximum(radii, 1e-300) / radii.max())).astype(int)
    classes = [np.flatnonzero(size_class == k) for k in np.unique(size_class)]
    own_classes = [own_spheres[size_class[own_spheres] == k] for k in np.unique(size_class)]
    classes_with_trees = [(spheres, scipy.spatial.cKDTree(centres[spheres])) for spheres in classes]
    pairs = list[tuple[Longs, Longs]]()
    for first in filter(len, own_classes):
        first_tree = scipy.spatial.cKDTree(centres[first])
        for second, second_tree in classes_with_trees:
            distance = radii[first].max() + radii[second].max() + reach
            near_in_trees = first_tree.sparse_distance_matrix(
                second_tree, distance, output_type="ndarray"
            )
            i, j = first[near_in_trees["i"]], second[near_in_trees["j"]]
            is_near = (near_in_trees["v"] < radii[i] + radii[j] + reach) & (i != j)
            pairs.append((i[is_near], j[is_near]))
    no_numbers = np.zeros(0, dtype=np.int64)
    i, j = (
        np.concatenate([no_numbers, *spheres]).astype(np.int64)
        for spheres in zip((no_numbers, no_numbers), *pairs, strict=True)
    )
    return i, j


@dataclass(frozen=True)
class JoinedPlaces:
    """Places of a point in one direction, in neighbouring cells, as one: no jump at a fold.

    Attributes
    ----------
    first
        (m,) the nearest place of each.
    group
        (n,) the joined place that a place belongs to.
    distance
        (m,) -e log sum exp(-d/e) of the distances d of its places, with a small e.
    weight
        (n,) its derivatives by these.
    several
        (m,) whether it has several places.
    """

    first: Longs
    group: Longs
    distance: Array
    weight: Array
    several: NDArray[np.bool_]

    @classmethod
    def join(cls, places: Projections, blur: float) -> "JoinedPlaces":
        """Join places in the order of points, sides and distances; `blur` is e."""
        first = places.firsts
        counts = np.diff([*first, len(places.point)])
        group = np.repeat(np.arange(len(first)), counts)
        nearest = places.distance[first]
        size = np.exp((nearest[group] - places.distance) / blur)
        total = np.bincount(group, size, len(first))
        distance = nearest - blur * np.log(total)
        return cls(first, group, distance, size / total[group], counts > 1)

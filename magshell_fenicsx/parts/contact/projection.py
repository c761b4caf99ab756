"""Closest-point projection onto a mid-surface of triangles.

The cells near a point come from a tree, its projection from Newton's method. A point of a surface
is near the material around itself, which it does not touch: a cell counts only if the way to it
within the undeformed surface is long. In go the places of all nodes and the points, out come the
places nearest to the points (`Projections`). docs/theory.md, Contact.

Where the thickness varies, or changes with the state, vectors have a fourth component: half of it
less h/2, with the other sign for points. The distance is then |x - y| of the three components, plus
the fourth of x - y: it is the distance of the faces, plus h.

A place is a point of the surface: a cell with coordinates X in its reference triangle. Its free
directions are those in which it can move: two inside a cell, one along a side, none in a corner.
Side k of a cell is opposite to its corner k. A strip is a part of the vertices; a key i * cells + j
stands for the pair of cells i and j. Lengths are over R.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
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
        The basix element of places, whose nodes are points.
    nodes
        (cells, functions) global numbers of nodes.
    corners
        (cells, 3) global numbers of vertices.
    """

    element: Any
    nodes: Longs
    corners: Longs

    @cached_property
    def neighbours(self) -> Longs:
        """(cells, 3): the cell across the side opposite to each corner; -1 at the boundary."""
        # a key for each side, the same in both cells that share it: its vertices, the lower first
        sides = [self.corners[:, [1, 2]], self.corners[:, [0, 2]], self.corners[:, [0, 1]]]
        pairs = np.sort(np.stack(sides, axis=1), axis=2)
        keys = pairs[..., 0] * (self.corners.max() + 1) + pairs[..., 1]
        # two cells share a side if its key comes twice, that is next to itself in ascending order
        order = np.argsort(keys.ravel(), kind="stable")
        shared = np.flatnonzero(np.diff(keys.ravel()[order]) == 0)
        # number 3 cell + k stands for side k of a cell
        first_sides, second_sides = order[shared], order[shared + 1]
        neighbours = np.full(keys.size, -1)
        neighbours[first_sides] = second_sides // 3
        neighbours[second_sides] = first_sides // 3
        return np.asarray(neighbours.reshape(-1, 3))

    @cached_property
    def is_on_edge(self) -> NDArray[np.bool_]:
        """(cells, 3): whether each corner is on an edge of the surface."""
        cell, side = np.nonzero(self.neighbours < 0)  # the sides on an edge
        is_on_edge = np.zeros(self.corners.max() + 1, dtype=bool)  # of vertices
        # side k has the two corners that it is not opposite to
        for corner in ((side + 1) % 3, (side + 2) % 3):
            is_on_edge[self.corners[cell, corner]] = True
        return np.asarray(is_on_edge[self.corners])

    def edge_turns(self, r0: Array, cosine: float) -> NDArray[np.bool_]:
        """Return flags (cells, 3): whether the undeformed edge turns sharply at each corner.

        Parameters
        ----------
        r0
            (nodes, 3) undeformed places.
        cosine
            Cosine of the angle above which a turn counts.
        """
        cell, side = np.nonzero(self.neighbours < 0)  # the sides on an edge
        # (2, 3, functions): derivatives of shape functions by both coordinates at the corners
        slopes = self.element.tabulate(1, CORNERS)[1:, :, :, 0]
        # at each vertex the sum of the unit tangents of both sides on the edge, each away from the
        # vertex: where the edge is straight they cancel
        turn = np.zeros((int(self.corners.max()) + 1, 3))
        begin, end = (side + 1) % 3, (side + 2) % 3  # corners of each side on an edge
        sides = CORNERS[end] - CORNERS[begin]
        for corner, sign in ((begin, 1.0), (end, -1.0)):
            tangent = np.einsum("kd,dkn,kni->ki", sides, slopes[:, corner], r0[self.nodes[cell]])
            tangent /= np.linalg.norm(tangent, axis=1)[:, None]
            np.add.at(turn, self.corners[cell, corner], sign * tangent)
        # two unit vectors whose angle has this cosine have a difference of this length
        is_turn = np.linalg.norm(turn, axis=1) > np.sqrt(2 * (1 - cosine))
        return np.asarray(is_turn[self.corners])

    @cached_property
    def lattices(self) -> list[tuple[Array, Array]]:
        """The coarse and the fine lattice of places in the reference cell, with shape functions.

        Newton's method starts from the nearest of them. Places are (m, 2), shape functions (m,
        functions).
        """
        lattices = list[tuple[Array, Array]]()
        for n in LATTICE_DIVISIONS:
            X = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
            lattices.append((X, self.element.tabulate(0, X)[0, :, :, 0]))
        return lattices

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

        The monomials are x^(n-j) y^j, n up to the degree, j from 0 to n. The compiled Newton's
        method evaluates polynomials by them.
        """
        x, y = self.element.points.T
        return np.linalg.inv(
            [x ** (n - j) * y**j for n in range(self.element.degree + 1) for j in range(n + 1)]
        ).T

    def near_within_surface(self, r0: Array, distance: Array) -> Longs:
        """Return keys of the pairs of cells that are near within the surface, ascending.

        Cells are near if the way along sides between two of their corners is short.

        Parameters
        ----------
        r0, distance
            (nodes, 3) undeformed places, and (nodes,) length up to which a way is short.
        """
        # places and lengths at vertices, by shape functions from their values at nodes
        x, reach = np.zeros((int(self.corners.max()) + 1, 3)), np.zeros(int(self.corners.max()) + 1)
        x[self.corners], reach[self.corners] = (
            self.at_corners @ r0[self.nodes],
            distance[self.nodes] @ self.at_corners.T,
        )
        return near_along_surface(self.corners, x, reach)


def near_along_surface(corners: Longs, x: Array, reach: Array) -> Longs:
    """Return which cells are near each other within a surface, along the sides of cells.

    Two cells are near if the way between some corner of each is at most the mean of the reach at
    its two ends. Ways are the shortest ones in the graph of vertices and sides (Dijkstra).

    Parameters
    ----------
    corners
        (cells, 3) vertices, or (cells, 2) of a curve.
    x, reach
        (vertices, dim) undeformed places, and (vertices,) the largest length of a way.

    Returns
    -------
    keys
        Numbers i * cells + j of pairs of cells, ascending.
    """
    vertex_count, (cell_count, per_cell) = len(x), corners.shape
    # pairs of vertices that are near each other
    i, j = _near_vertices(_graph_of_sides(corners, x), x, reach)
    # sparse flags: which vertices are near each other, and which vertices a cell has
    is_near = scipy.sparse.coo_array((np.ones(len(i)), (i, j)), (vertex_count, vertex_count))
    cell_of_corner = np.repeat(np.arange(cell_count), per_cell)
    flags = np.ones(len(cell_of_corner)), (cell_of_corner, corners.ravel())
    has_vertex = scipy.sparse.coo_array(flags, (cell_count, vertex_count)).tocsr()
    # cells are near if any of their vertices are: there the product is not zero
    i, j = (has_vertex @ is_near.tocsr() @ has_vertex.T).nonzero()
    return np.asarray(np.unique(i.astype(np.int64) * cell_count + j))


def _graph_of_sides(corners: Longs, x: Array) -> scipy.sparse.csr_array:
    """Return the graph (vertices, vertices) of the sides of cells, with their lengths.

    Parameters
    ----------
    corners
        (cells, 3) vertices, or (cells, 2) of a curve.
    x
        (vertices, dim) undeformed places.
    """
    shape = len(x), len(x)
    begins, ends = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    lower_and_higher = np.minimum(begins, ends), np.maximum(begins, ends)
    sides = scipy.sparse.coo_array((np.ones(len(begins)), lower_and_higher), shape)
    sides = sides.tocsr().tocoo()  # which sums entries: each side once
    lengths = np.linalg.norm(x[sides.row] - x[sides.col], axis=1)
    return scipy.sparse.coo_array((lengths, (sides.row, sides.col)), shape).tocsr()


def _near_vertices(graph: scipy.sparse.csr_array, x: Array, reach: Array) -> tuple[Longs, Longs]:
    """Return the pairs (i, j) of vertices between which the way along sides is short enough.

    Parameters
    ----------
    graph
        (vertices, vertices) sparse: the lengths of sides.
    x, reach
        (vertices, dim) undeformed places, and (vertices,) the reach. A way is short enough if it is
        at most the mean of the reach at its two ends.
    """
    farthest = float(reach.max())
    # strips of vertices along the longest axis keep the matrices of ways small
    axis = int(np.ptp(x, axis=0).argmax())
    order = np.argsort(x[:, axis], kind="stable")
    sorted_x = x[order, axis]
    near_pairs = list[tuple[Longs, Longs]]()
    for strip in np.array_split(order, max(1, len(x) // VERTICES_PER_STRIP)):
        # a way from the strip that is short enough ends within this length of the strip
        low, high = x[strip[0], axis] - farthest, x[strip[-1], axis] + farthest
        begin, end = np.searchsorted(sorted_x, low), np.searchsorted(sorted_x, high, "right")
        candidates = order[begin:end]
        # from the strip's vertices (rows) to all candidates (columns)
        rows = np.flatnonzero(np.isin(candidates, strip))
        graph_of_candidates = graph[candidates][:, candidates]
        ways = dijkstra(graph_of_candidates, directed=False, indices=rows, limit=farthest)
        mean_reach = (reach[candidates[rows], None] + reach[candidates]) / 2
        row, column = np.nonzero(ways <= mean_reach)
        near_pairs.append((candidates[rows[row]], candidates[column]))
    i, j = (np.concatenate(vertices) for vertices in zip(*near_pairs, strict=True))
    return i, j


@dataclass(frozen=True)
class Projections:
    """Places of a surface that are nearest to points: one row for each pair of point and place.

    Attributes
    ----------
    point, cell
        (n,) numbers of the points, and of the cells of the places.
    X
        (n, 2) place in the reference cell.
    free_directions
        (n, 2, 2) matrices whose columns are directions in which the place can move: two inside a
        cell, one along a side, none in a corner. Other columns are zero.
    distance
        (n,) over R.
    side
        (n,) number of the direction from the point to the place, less than `MAX_DIRECTIONS`; 0 is
        that of the nearest place.
    direction
        (n, 3) unit vectors from the places to the points.
    is_above
        (n,) whether the point is above or below the place, and not beside it as in one flat
        surface.
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
        """Rows of the first place of each point and direction, which is the nearest one.

        Places must be in the order of points, directions and distances.
        """
        return np.flatnonzero(np.diff(MAX_DIRECTIONS * self.point + self.side, prepend=-1))

    def select(self, selection: Any) -> "Projections":
        """Return the selected places; a selection is row numbers, flags or a slice."""
        return Projections(
            *(getattr(self, attribute.name)[selection] for attribute in fields(self))
        )


def have_farther_places(
    keys: Longs, other_keys: Longs, distance: Array, tolerance: float
) -> NDArray[np.bool_]:
    """Return flags (n,): whether a point's place in another cell is listed, and is not nearer.

    Parameters
    ----------
    keys
        (n,) number of the point and the cell of each place, ascending.
    other_keys
        (n,) the same of each place's point and the other cell.
    distance
        (n,) distances of the places from their points.
    tolerance
        A place that is nearer by less is not nearer.
    """
    # the row of the point's place in the other cell, if that is listed; else any row
    row = np.minimum(np.searchsorted(keys, other_keys), max(len(keys) - 1, 0))
    is_nearer = distance[row] < distance - tolerance
    return np.asarray((keys[row] == other_keys) & ~is_nearer)


@dataclass(frozen=True)
class UndeformedPairs:
    """Undeformed places, to find out which pairs of points and places are the same material.

    Attributes
    ----------
    is_near
        (pairs,) whether the cells are near in the surface; only there r and x matter.
    r, x
        (nodes, 4) and (n, 4) undeformed places of nodes and points. The fourth component is half
        the thickness, with a minus sign for points.
    least_distance_ratio
        Least undeformed distance of a place that counts, over the mean of both thicknesses.
    """

    is_near: NDArray[np.bool_]
    r: Array
    x: Array
    least_distance_ratio: float


@dataclass(frozen=True)
class ProjectionLimits:
    """Bounds of the distance from points to their nearest places, where only these are needed.

    Attributes
    ----------
    is_bounded
        (pairs,) whether places in these cells may be left out if they are farther.
    reach
        (n,) bound for each point, over R.
    """

    is_bounded: NDArray[np.bool_]
    reach: Array


def polynomial_bound(values: Array, lebesgue_constant: float) -> float:
    """Return an upper bound of polynomials with values (cells, functions) at nodes.

    In each cell it is the middle of the nodal values, (max + min)/2, plus half their range times
    Lebesgue's constant. The result is the largest of all cells; of no cells it is minus infinity.

    Parameters
    ----------
    lebesgue_constant
        Lebesgue's constant of the element: it bounds how far a polynomial exceeds its nodal values.
    """
    nodal_max, nodal_min = values.max(axis=1, initial=-np.inf), values.min(axis=1, initial=np.inf)
    bounds = (nodal_max + nodal_min + lebesgue_constant * (nodal_max - nodal_min)) / 2
    return float(bounds.max(initial=-np.inf))


def jets(element: Any, X: Array, nodal: Array, order: int = 2) -> Iterator[tuple[Array, Array]]:
    """Yield shape functions (n, functions) at places (n, 2), with the field (n, 3 or 4) there.

    The first pair has values. Further pairs have derivatives by the first coordinate, by the
    second, and then the three second derivatives, up to the order.

    Parameters
    ----------
    element
        A basix element.
    X
        (n, 2) places in the reference cell.
    nodal
        (n, functions, 3 or 4) values of the field at the nodes of each place's cell.
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

    Newton's method begins at the nearest place of a lattice. It is compiled, see projection.c.

    Parameters
    ----------
    r
        (nodes, 3 or 4) places of all nodes over R.
    x
        (n, 3 or 4) points over R.
    pairs
        Four arrays. For each pair of a cell with several points: the cell, the position of its
        first point in the last array, and the number of its points. The last array lists points.
    reach
        Largest distance over R between points and mid-surfaces.
    max_distance
        Places with a larger distance are left out.
    undeformed
        Undeformed places, which exclude the material around a point; None: nothing is excluded.
    limits
        Bounds of the distance, if only the nearest place of each point is needed; None: all places
        are returned.

    Returns
    -------
    pair, places
        (m,) number of each place's pair, and the m places; their `side` is 0.
    """
    cell, first, number, order = pairs  # order: the list of points
    used_cells, row_of_cell = np.unique(cell, return_inverse=True)
    # stand-ins for missing arguments: without flags the C function does not read them
    no_flags = np.zeros(len(cell), dtype=bool)
    reference = undeformed or UndeformedPairs(no_flags, r, x, 0.0)
    search_limits = limits or ProjectionLimits(no_flags, np.zeros(len(x)))
    # the arrays of the struct must stay in memory during the call
    c_cells, _arrays_of_struct = _struct_of_cells(cells, r, reference.r, used_cells)
    pairs_in_c = row_of_cell.ravel(), first, number, order
    point, pair, X, free_directions, distance, direction, is_above = _nearest_in_c(
        c_cells, pairs_in_c, x, reference, search_limits, (reach, max_distance)
    )
    side = np.zeros(len(pair), dtype=np.int64)
    return pair, Projections(
        point, cell[pair], X, free_directions, distance, side, direction, is_above
    )


def _nearest_in_c(
    c_cells: Any,
    pairs: tuple[Longs, Longs, Longs, Longs],
    x: Array,
    reference: UndeformedPairs,
    limits: ProjectionLimits,
    distances: tuple[float, float],
) -> list[NDArray[Any]]:
    """Return the results of `nearest` in C, one row for each place that was found.

    They are the arrays `point`, `pair`, `X`, `free_directions`, `distance`, `direction` and
    `is_above`: see `nearest_places` for pairs, and `Projections` for the others.

    Parameters
    ----------
    c_cells
        The struct of the cells in C.
    pairs
        As in `nearest_places`, with the row of each cell in the struct in place of its number.
    x
        (n, 3 or 4) points over R.
    distances
        `reach` and `max_distance` of `nearest_places`.
    """
    (_, lib), pointers, (row_of_cell, first, number, order) = library(), _pointers, pairs
    # arrays for the results
    capacity = int(number.sum())  # each pair of point and cell has at most one place
    point, pair = np.empty((2, capacity), dtype=np.int64)
    floats = [np.empty((capacity, *shape)) for shape in PLACE_SHAPES]
    is_above = np.empty(capacity, dtype=bool)
    results = point, pair, *floats, is_above
    # the call; arguments have the order of `nearest` in C
    pair_arguments = row_of_cell, first, number, reference.is_near, limits.is_bounded
    point_arguments = order, _as_four_components(x), _as_four_components(reference.x)
    arguments = pointers(*pair_arguments, limits.reach, *point_arguments)
    count = lib.nearest(
        c_cells,
        len(row_of_cell),
        *arguments,
        *distances,
        reference.least_distance_ratio,
        *pointers(*results),
    )
    # the first `count` rows have results
    return [array[:count] for array in results]


def _struct_of_cells(
    cells: Cells, r: Array, r0: Array, used_cells: Longs
) -> tuple[Any, list[Array]]:
    """Return the struct `Cells` in C for some cells, and the arrays to which it points.

    Parameters
    ----------
    r, r0
        (nodes, 3 or 4) deformed and undeformed places of all nodes.
    used_cells
        Numbers of the cells.
    """
    nodal = r[cells.nodes[used_cells]]
    positions = nodal[..., :3]
    # (used cells, 6) spheres around cells, and their largest distances from both lattices; then the
    # places of both lattices in each cell
    bounds = _bounds_of_cells(positions)
    lattice_places = [np.matmul(positions.swapaxes(1, 2), shape.T) for _, shape in cells.lattices]
    # coefficients of each cell's polynomials, deformed and undeformed
    monomials = [
        cells.monomials @ _as_four_components(array)
        for array in (nodal, r0[cells.nodes[used_cells]])
    ]
    # the members of the struct in their order: sizes, then arrays
    sizes = cells.element.degree, *(len(X) for X, _ in cells.lattices)
    arrays = [*monomials, *lattice_places, cells.lattices[-1][0], bounds]
    ffi, _ = library()
    return ffi.new("Cells *", [*sizes, *_pointers(*arrays)]), arrays


def _bounds_of_cells(positions: Array) -> Array:
    """Return the sphere around each cell, and how far its places are from each lattice at most.

    The result (cells, 6) has the sphere's centre and radius, and then the distances from the coarse
    and from the fine lattice.

    Parameters
    ----------
    positions
        (cells, functions, 3) places of nodes.
    """
    centres = positions.mean(axis=1)
    radii = CELL_RADIUS_FACTOR * np.linalg.norm(positions - centres[:, None], axis=2).max(axis=1)
    lattice_distances = (LATTICE_RADIUS_FACTOR / parts * radii for parts in LATTICE_DIVISIONS)
    return np.column_stack([centres, radii, *lattice_distances])


def points_in_cells(cells: Cells, r: Array, cell: Longs, shape: Array) -> Array:
    """Return the places (n, 3 or 4) of points in cells.

    A fourth component has the sign of points: minus half the thickness, plus h/2.

    Parameters
    ----------
    r
        (nodes, 3 or 4) places of all nodes.
    cell, shape
        (n,) cells of the points, and (n, functions) shape functions there.
    """
    x = np.empty((len(cell), 4))
    nodes = _as_four_components(r * COMPONENT_SIGNS[: r.shape[1]])
    arrays = _pointers(cell, cells.nodes, shape, nodes, x)
    _, lib = library()
    lib.places(*shape.shape, *arrays)
    return x[:, : r.shape[1]]


def _pointers(*arrays: NDArray[Any]) -> list[Any]:
    """Return C pointers to arrays of int64, float64 or bool.

    An array that is not contiguous is copied, so arrays for results must be contiguous.
    """
    ffi, _ = library()
    kinds = {"int64": "int64_t[]", "float64": "double[]", "bool": "uint8_t[]"}
    return [
        ffi.from_buffer(kinds[array.dtype.name], np.ascontiguousarray(array)) for array in arrays
    ]


def _as_four_components(vectors: Array) -> Array:
    """Return vectors (..., 3 or 4) with four components; a missing one is zero."""
    return np.concatenate(
        [vectors, np.zeros((*vectors.shape[:-1], 4 - vectors.shape[-1]))], axis=-1
    )


@cache
def library() -> tuple[Any, Any]:
    """Return the cffi objects (ffi, lib) of projection.c, compiled on first use."""
    return load_native(Path(__file__).with_name("projection.c"), C_DECLARATIONS, MPI.COMM_SELF)


def follow_places(cells: Cells, x: Array, nodal: Array, X: Array, free_directions: Array) -> Array:
    """Return the places X (n, 2) nearest to points after a small motion, by Newton's method.

    A place moves in its free directions alone. It keeps its cell, but may get beyond a side: the
    result is smooth in the motion.

    Parameters
    ----------
    x
        (n, 3 or 4) the points after the motion.
    nodal
        (n, functions, 3 or 4) places of the nodes of each place's cell after the motion.
    X, free_directions
        (n, 2) places before the motion, and (n, 2, 2) matrices whose columns are the directions in
        which they can move; other columns are zero.
    """
    for _ in range(FOLLOW_ITERATIONS):
        # the places, and their derivatives y1, y2, y11, y12, y22; shape functions are not needed
        (_, y), *derivatives = jets(cells.element, X, nodal)
        g, A = slopes(with_length(x - y), *(derivative for _, derivative in derivatives))
        X = X - _solve_in_free_directions(free_directions, A, g)
    return X


def distances(off: Array) -> Array:
    """Return the distances (n,) for differences (n, 3 or 4) between points and places.

    A fourth component is added to the length of the first three.
    """
    return np.asarray(np.linalg.norm(off[:, :3], axis=1) + off[:, 3:].sum(axis=1))


def with_length(off: Array) -> Array:
    """Return differences (n, 3 or 4) with the length of the first three as fourth component.

    Differences of three components stay as they are. The scalar product of the result with a
    derivative of the surface by X is minus |x - y| times the derivative of the distance by X.
    """
    return np.column_stack([off[:, :3], np.linalg.norm(off[:, :3], axis=1)])[:, : off.shape[1]]


def slopes(
    off: Array, y1: Array, y2: Array, y11: Array, y12: Array, y22: Array
) -> tuple[Array, Array]:
    """Return gradient (n, 2) and Hessian (n, 2, 2) of half the squared distance by the place.

    With a fourth component they are |x - y| times the gradient and Hessian of the distance d. The
    Hessian is then exact where the gradient is zero, as at the nearest place.

    Parameters
    ----------
    off
        (n, 3 or 4) vectors from the places to the points; a fourth component is their length.
    y1, y2, y11, y12, y22
        (n, 3 or 4) derivatives of the surface at the places.
    """

    def dot(a: Array, b: Array) -> Array:
        return np.asarray(np.sum(a * b, axis=1))

    # the fourth component, half the thickness, has the other sign in products of slopes
    z1, z2 = y1 * COMPONENT_SIGNS[: y1.shape[1]], y2 * COMPONENT_SIGNS[: y2.shape[1]]
    mixed = dot(y1, z2) - dot(off, y12)
    A = np.stack(
        [dot(y1, z1) - dot(off, y11), mixed, mixed, dot(y2, z2) - dot(off, y22)], axis=1
    ).reshape(-1, 2, 2)
    return -np.stack([dot(off, y1), dot(off, y2)], axis=1), A


def _solve_in_free_directions(free_directions: Array, A: Array, g: Array) -> Array:
    """Return A^-1 g (n, 2) in the free directions, for A (n, 2, 2) and g (n, 2)."""
    inverse = inverse_in_free_directions(free_directions, A)
    # components of g, then of the result along the free directions; then the result itself
    components_of_g = np.einsum("nji,nj->ni", free_directions, g)
    components = np.einsum("nij,nj->ni", inverse, components_of_g)
    return np.asarray(np.einsum("nij,nj->ni", free_directions, components))


def inverse_in_free_directions(free_directions: Array, A: Array) -> Array:
    """Return the inverse (n, 2, 2) of A (n, 2, 2), in components along the free directions.

    Where a direction is not free, 1 stands on the diagonal, so that the matrix can be inverted.
    """
    is_fixed = np.asarray(~free_directions.any(axis=1))  # (n, 2): a column that is zero
    # A in components along the free directions, and its inverse: the adjugate by the determinant
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
    """Return pairs (i, j), i != j, of spheres whose surfaces are nearer to each other than a reach.

    Spheres are searched in classes of similar radii, so that large ones do not slow down small
    ones.

    Parameters
    ----------
    centres, radii
        (n, 3) and (n,).
    own_spheres
        Numbers of the spheres from which i is taken; j is any sphere.
    """
    # numbers of spheres by powers of two of the radius: of all spheres in `classes`, which have
    # search trees; of those from which i is taken in `own_classes`
    radius_class = np.floor(np.log2(np.maximum(radii, 1e-300) / radii.max())).astype(int)
    classes = [np.flatnonzero(radius_class == k) for k in np.unique(radius_class)]
    own_classes = [own_spheres[radius_class[own_spheres] == k] for k in np.unique(radius_class)]
    classes_with_trees = [(spheres, scipy.spatial.cKDTree(centres[spheres])) for spheres in classes]
    pairs = list[tuple[Longs, Longs]]()
    for own_class in filter(len, own_classes):
        own_tree = scipy.spatial.cKDTree(centres[own_class])
        for other_class, other_tree in classes_with_trees:
            # pairs of centres that are near for the largest radii of both classes: i and j are rows
            # of the classes, v distances
            farthest = radii[own_class].max() + radii[other_class].max() + reach
            near_centres = own_tree.sparse_distance_matrix(
                other_tree, farthest, output_type="ndarray"
            )
            i, j = own_class[near_centres["i"]], other_class[near_centres["j"]]
            # of these the pairs that are near for their own radii
            is_near = (near_centres["v"] < radii[i] + radii[j] + reach) & (i != j)
            pairs.append((i[is_near], j[is_near]))
    no_numbers = np.zeros(0, dtype=np.int64)  # for the case that there are no pairs
    i, j = (
        np.concatenate([no_numbers, *spheres]).astype(np.int64)
        for spheres in zip((no_numbers, no_numbers), *pairs, strict=True)
    )
    return i, j


@dataclass(frozen=True)
class JoinedPlaces:
    """Places of a point in one direction, in neighbouring cells, joined as one place.

    So the distance has no jump where the nearest place changes cells at a fold.

    Attributes
    ----------
    first
        (m,) row of the nearest of each joined place's places.
    group
        (n,) number of the joined place to which each place belongs.
    distance
        (m,) -e log sum exp(-d/e) over R, of the distances d of its places with a small e.
    weight
        (n,) derivatives of these distances by those of the places.
    several
        (m,) whether a joined place has several places.
    """

    first: Longs
    group: Longs
    distance: Array
    weight: Array
    several: NDArray[np.bool_]

    @classmethod
    def join(cls, places: Projections, blur: float) -> "JoinedPlaces":
        """Join the places of each point and direction as one.

        Parameters
        ----------
        places
            In the order of points, directions and distances.
        blur
            Length e over R of the smoothed minimum; small against all distances.
        """
        # each point and direction has one group of places, the nearest first
        first = places.firsts
        counts = np.diff([*first, len(places.point)])
        group = np.repeat(np.arange(len(first)), counts)
        least_distance = places.distance[first]
        # relative to the nearest place, so that nothing overflows
        exponential = np.exp((least_distance[group] - places.distance) / blur)
        sum_of_exponentials = np.bincount(group, exponential, len(first))
        distance = least_distance - blur * np.log(sum_of_exponentials)
        weight = exponential / sum_of_exponentials[group]
        return cls(first, group, distance, weight, several=counts > 1)

    @classmethod
    def separate(cls, distance: Array) -> "JoinedPlaces":
        """Return joined places of one place each, at distances (n,) from their points."""
        rows, ones = np.arange(len(distance)), np.ones(len(distance))
        return cls(rows, rows, distance, ones, several=ones == 0)

    def moved_by(self, change: Array, blur: float) -> "JoinedPlaces":
        """Return the same joined places after small changes (n,) of the distances of their places.

        The joined distances change by the weighted means, the weights by their first derivatives.

        Parameters
        ----------
        blur
            Length e over R of the smoothed minimum.
        """
        mean_change = np.bincount(self.group, self.weight * change, len(self.first))
        # weights are exp(-d/e) over their sum, here to first order in the changes of distances d
        weight = self.weight * (1 - (change - mean_change[self.group]) / blur)
        return replace(self, distance=self.distance + mean_change, weight=weight)

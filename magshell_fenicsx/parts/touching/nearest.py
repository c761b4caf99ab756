"""The places of a mid-surface that are nearest to some of its points: the cells near by from a
tree, then Newton.

A point of a surface is near the material around itself, which it does not touch. So a cell counts
only if the way to it within the undeformed surface is long.

Where the thickness varies, or changes with the state, vectors have a fourth component: half of it
less h/2, of x with the other sign. The distance is then that of the faces and h: |x - y| of the
three, and the fourth of x - y.
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
# thicknesses of the way along sides to what a point cannot touch; it is at most 1.2 times as long
BESIDE = 4.8
BULGE = 1.2  # of the radius of a cell's nodes about their centre, that of all of it
# of a cell's radius over the parts of its side: no place of it is farther from all those of a
# lattice
BETWEEN = 1.6
LATTICES = (
    4,
    12,
)  # parts of a cell's sides, between which the search for the nearest place begins: coarse, then fine
BETWEEN_PLACES = 1.05  # of a sum of shape functions at places of a lattice, that everywhere
STRIP = 500  # vertices from which ways are searched together
FOLLOWING = 2  # Newton's steps after a small change
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
WAYS = 3  # directions in which a point can face places: on both sides, and before an edge
SIGNS = np.array([1.0, 1.0, 1.0, -1.0])  # of the squares of components in the Hessian
SHAPES = (2,), (2, 2), (), (3,)  # of what places have: X, free, distance, way
FUNCTIONS = """
    typedef struct {
        int64_t degree, coarse_count, count;
        const double *of, *undeformed, *coarse, *fine, *X, *bounds;
    } Cells;
    int64_t nearest(const Cells *, int64_t, const int64_t *, const int64_t *, const int64_t *, const uint8_t *,
        const uint8_t *, const double *, const int64_t *, const double *, const double *, double, double, double,
        int64_t *, int64_t *, double *, double *, double *, double *, uint8_t *);
    void places(int64_t, int64_t, const int64_t *, const int64_t *, const double *, const double *, double *);
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
    def across(self) -> Longs:
        """(cells, 3): the cell across the side opposite to each corner; -1 at the boundary."""
        pairs = np.sort(
            np.stack(
                [self.corners[:, [1, 2]], self.corners[:, [0, 2]], self.corners[:, [0, 1]]], 1
            ),
            axis=2,
        )
        keys = pairs[..., 0] * (self.corners.max() + 1) + pairs[..., 1]
        order = np.argsort(keys.ravel(), kind="stable")
        twice = np.flatnonzero(np.diff(keys.ravel()[order]) == 0)
        beyond = np.full(keys.size, -1)
        a, b = order[twice], order[twice + 1]
        beyond[a], beyond[b] = b // 3, a // 3
        return np.asarray(beyond.reshape(-1, 3))

    @cached_property
    def on_edge(self) -> NDArray[np.bool_]:
        """(cells, 3): whether each corner is on an edge of the surface."""
        cell, side = np.nonzero(self.across < 0)
        there = np.zeros(self.corners.max() + 1, dtype=bool)
        there[self.corners[cell, (side + 1) % 3]] = there[self.corners[cell, (side + 2) % 3]] = True
        return np.asarray(there[self.corners])

    def turns(self, r0: Array, cosine: float) -> NDArray[np.bool_]:
        """(cells, 3): whether an edge of the undeformed surface turns at each corner, by more than
        an angle.
        """
        cell, side = np.nonzero(self.across < 0)
        D = self.element.tabulate(1, CORNERS)[1:, :, :, 0]
        onward = np.zeros(
            (int(self.corners.max()) + 1, 3)
        )  # of an even edge the two ways from a vertex cancel
        along = CORNERS[(side + 2) % 3] - CORNERS[(side + 1) % 3]
        for corner, sign in (((side + 1) % 3, 1.0), ((side + 2) % 3, -1.0)):
            way = np.einsum("kd,dkn,kni->ki", along, D[:, corner], r0[self.nodes[cell]])
            way /= np.linalg.norm(way, axis=1)[:, None]
            np.add.at(onward, self.corners[cell, corner], sign * way)
        turned = np.linalg.norm(onward, axis=1) > np.sqrt(2 * (1 - cosine))
        return np.asarray(turned[self.corners])

    @cached_property
    def lattices(self) -> list[tuple[Array, Array]]:
        """Places (m, 2) spread over the reference cell, and the shape functions there; coarse ones
        and fine ones.
        """
        spread = [
            np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)]) / n for n in LATTICES
        ]
        return [(X, self.element.tabulate(0, X)[0, :, :, 0]) for X in spread]

    @cached_property
    def lebesgue(self) -> float:
        """See `highest`."""
        return BETWEEN_PLACES * float(np.abs(self.lattices[-1][1]).sum(axis=1).max())

    @cached_property
    def at_corners(self) -> Array:
        """Shape functions (3, functions) at the corners."""
        return np.asarray(self.element.tabulate(0, CORNERS)[0, :, :, 0])

    @cached_property
    def monomials(self) -> Array:
        """(monomials, functions): polynomials x^(n-j) y^j, n up to the degree, j from 0 to n, from
        values at nodes.
        """
        x, y = self.element.points.T
        return np.linalg.inv(
            [x ** (n - j) * y**j for n in range(self.element.degree + 1) for j in range(n + 1)]
        ).T

    def near_in_surface(self, r0: Array, far: Array) -> Longs:
        """See `near_along_sides`; both are of all nodes."""
        x, reach = np.zeros((int(self.corners.max()) + 1, 3)), np.zeros(int(self.corners.max()) + 1)
        x[self.corners], reach[self.corners] = (
            self.at_corners @ r0[self.nodes],
            far[self.nodes] @ self.at_corners.T,
        )
        return near_along_sides(self.corners, x, reach)


def near_along_sides(corners: Longs, x: Array, reach: Array) -> Longs:
    """Keys i * cells + j, ascending, of the cells between which the way along sides is shorter than
    the mean of the reach at its ends.

    Parameters
    ----------
    corners
        (cells, 3), or (cells, 2) of a curve.
    x, reach
        (vertices, dim) undeformed, and (vertices,).
    """
    count, (n, per_cell) = len(x), corners.shape
    farthest = float(reach.max())
    a, b = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    ways = scipy.sparse.coo_array(
        (np.ones(len(a)), (np.minimum(a, b), np.maximum(a, b))), (count, count)
    ).tocsr()
    ways = ways.tocoo()
    lengths = np.linalg.norm(x[ways.row] - x[ways.col], axis=1)
    graph = scipy.sparse.coo_array((lengths, (ways.row, ways.col)), (count, count)).tocsr()
    axis = int(np.ptp(x, axis=0).argmax())
    order = np.argsort(x[:, axis], kind="stable")
    near = list[tuple[Longs, Longs]]()
    for some in np.array_split(
        order, max(1, count // STRIP)
    ):  # a way that short leaves a strip by no more
        low, high = x[some[0], axis] - farthest, x[some[-1], axis] + farthest
        around = order[
            np.searchsorted(x[order, axis], low) : np.searchsorted(x[order, axis], high, "right")
        ]
        inside = np.flatnonzero(np.isin(around, some))
        reached = dijkstra(graph[around][:, around], directed=False, indices=inside, limit=farthest)
        row, column = np.nonzero(reached <= (reach[around[inside], None] + reach[around]) / 2)
        near.append((around[inside[row]], around[column]))
    i, j = (np.concatenate(each) for each in zip(*near, strict=True))
    between = scipy.sparse.coo_array((np.ones(len(i)), (i, j)), (count, count)).tocsr()
    of_cell = np.repeat(np.arange(n), per_cell)
    has = scipy.sparse.coo_array((np.ones(len(of_cell)), (of_cell, corners.ravel())), (n, count))
    i, j = (has.tocsr() @ between @ has.tocsr().T).nonzero()
    return np.asarray(np.unique(i.astype(np.int64) * n + j))


@dataclass(frozen=True)
class Places:
    """Points and the places of a surface nearest to them.

    Attributes
    ----------
    point, cell
        (n,) numbers of the points, and of the cells of the places.
    X
        (n, 2) in the reference cell.
    free
        (n, 2, 2): columns are directions in which a place can move: both inside a cell, along a
        side, none in a corner.
    distance
        (n,).
    side
        (n,): places in one direction from their point have one number, less than `WAYS`; 0 that of
        the nearest.
    way
        (n, 3) direction to the point.
    above
        (n,) whether the point is above the place, and not beside it as in one surface that is flat.
    """

    point: Longs
    cell: Longs
    X: Array
    free: Array
    distance: Array
    side: Longs
    way: Array
    above: NDArray[np.bool_]

    @property
    def firsts(self) -> Longs:
        """Where each point and direction begins, of places in the order of points, directions and
        distances.
        """
        return np.flatnonzero(np.diff(WAYS * self.point + self.side, prepend=-1))

    def of(self, which: Any) -> "Places":
        """Some of them."""
        return Places(*(getattr(self, each.name)[which] for each in fields(self)))


@dataclass(frozen=True)
class Undeformed:
    """Which pairs of points and places are near each other within the undeformed surface.

    Attributes
    ----------
    near
        (pairs,) whether the cells are near in the surface; only there places are asked.
    r, x
        (nodes, 4) and (n, 4) places of nodes and points, with half the thickness, of points with
        the other sign.
    apart
        How far a place is at least, over the mean of both thicknesses.
    """

    near: NDArray[np.bool_]
    r: Array
    x: Array
    apart: float


@dataclass(frozen=True)
class Limits:
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


def highest(values: Array, lebesgue: float) -> float:
    """A bound of polynomials with values (cells, functions) at nodes; Lebesgue's constant is that
    of the element.
    """
    most, least = values.max(axis=1, initial=-np.inf), values.min(axis=1, initial=np.inf)
    return float(((most + least + lebesgue * (most - least)) / 2).max(initial=-np.inf))


def jets(element: Any, X: Array, nodal: Array, order: int = 2) -> Iterator[tuple[Array, Array]]:
    """Shape functions (n, functions) at places (n, 2), and the field of nodal vectors (n, functions, 3 or 4) there:
    itself and its derivatives by the first coordinate, the second, and both twice."""
    for table in element.tabulate(order, X)[..., 0]:
        yield table, np.einsum("nk,nki->ni", table, nodal)


def places_near(
    cells: Cells,
    r: Array,
    x: Array,
    pairs: tuple[Longs, Longs, Longs, Longs],
    reach: float,
    within: float = np.inf,
    undeformed: Undeformed | None = None,
    limits: Limits | None = None,
) -> tuple[Longs, Places]:
    """The places of cells nearest to points that are nearer than `within`, with the numbers of
    their pairs.

    Where the search begins is the nearest place of a lattice. Compiled, see nearest.c.

    Parameters
    ----------
    r
        (nodes, 3) places of all nodes, or (nodes, 4).
    x
        (n, 3) points, or (n, 4).
    pairs
        Of a cell with points: the cells, the first of the points in the last array, and how many
        there are.
    reach
        Between points and mid-surfaces.
    """
    cell, first, number, order = pairs
    used, which = np.unique(cell, return_inverse=True)
    nodal = r[cells.nodes[used]]
    nothing = np.zeros(len(cell), dtype=bool)
    flat, where = nodal[..., :3], undeformed or Undeformed(nothing, r, x, 0.0)
    limit = limits or Limits(nothing, np.zeros(len(x)))
    centres = flat.mean(axis=1)
    radii = BULGE * np.linalg.norm(flat - centres[:, None], axis=2).max(axis=1)
    bounds = np.column_stack([centres, radii, *(BETWEEN / parts * radii for parts in LATTICES)])
    placed = [np.matmul(flat.swapaxes(1, 2), shape.T) for _, shape in cells.lattices]
    of = [cells.monomials @ _padded(each) for each in (nodal, where.r[cells.nodes[used]])]
    numbers = cells.element.degree, *(len(X) for X, _ in cells.lattices)
    (ffi, lib), p = library(), _pointers
    every = ffi.new("Cells *", [*numbers, *p(*of, *placed, cells.lattices[-1][0], bounds)])
    most = int(number.sum())
    point, pair = np.empty((2, most), dtype=np.int64)
    made = point, pair, *(np.empty((most, *shape)) for shape in SHAPES), np.empty(most, dtype=bool)
    of_pairs = which.ravel(), first, number, where.near, limit.is_bounded
    given = p(*of_pairs, limit.reach, order, _padded(x), _padded(where.x))
    count = lib.nearest(every, len(cell), *given, reach, within, where.apart, *p(*made))
    X, free, distance, way = (each[:count] for each in made[2:6])
    point, pair, above, none = (
        point[:count],
        pair[:count],
        made[6][:count],
        np.zeros(count, dtype=np.int64),
    )
    return pair, Places(point, cell[pair], X, free, distance, none, way, above)


def places_of(cells: Cells, r: Array, cell: Longs, shape: Array) -> Array:
    """Those (n, 3) of points with shape functions (n, functions) in cells (n,), with nodes at r; or
    (n, 4) of both.
    """
    x = np.empty((len(cell), 4))
    arrays = _pointers(cell, cells.nodes, shape, _padded(r * SIGNS[: r.shape[1]]), x)
    library()[1].places(*shape.shape, *arrays)
    return x[:, : r.shape[1]]


def _pointers(*arrays: NDArray[Any]) -> list[Any]:
    kinds = {"int64": "int64_t[]", "float64": "double[]", "bool": "uint8_t[]"}
    return [
        library()[0].from_buffer(kinds[each.dtype.name], np.ascontiguousarray(each))
        for each in arrays
    ]


def _padded(vectors: Array) -> Array:
    """Those of three components with a fourth one."""
    return np.concatenate(
        [vectors, np.zeros((*vectors.shape[:-1], 4 - vectors.shape[-1]))], axis=-1
    )


@cache
def library() -> tuple[Any, Any]:
    """The cffi objects of nearest.c, compiled on first use."""
    return load_native(Path(__file__).with_name("nearest.c"), FUNCTIONS, MPI.COMM_SELF)


def followed(cells: Cells, x: Array, nodal: Array, X: Array, free: Array) -> Array:
    """The same places of triangles that have changed a little, in the same free directions, also
    beyond a side.
    """
    for _ in range(FOLLOWING):
        (_, y), *more = jets(cells.element, X, nodal)
        g, A = slopes(straight(x - y), *(each for _, each in more))
        X = X - _reduced(free, A, g)
    return X


def distances(off: Array) -> Array:
    """Those (n,) of the differences (n, 3) between points and places, or (n, 4) with the thickness."""
    return np.asarray(np.linalg.norm(off[:, :3], axis=1) + off[:, 3:].sum(axis=1))


def straight(off: Array) -> Array:
    """The same differences, with their length as the fourth component if there is one."""
    return np.column_stack([off[:, :3], np.linalg.norm(off[:, :3], axis=1)])[:, : off.shape[1]]


def slopes(
    off: Array, y1: Array, y2: Array, y11: Array, y12: Array, y22: Array
) -> tuple[Array, Array]:
    """The gradient (n, 2) of half the square of the distance by the place, and its Hessian (n, 2,
    2).

    With a fourth component both are |x - y| times those of the distance, the Hessian where the
    gradient is zero.
    """

    def dot(a: Array, b: Array) -> Array:
        return np.asarray(np.sum(a * b, axis=1))

    z1, z2 = y1 * SIGNS[: y1.shape[1]], y2 * SIGNS[: y2.shape[1]]
    mixed = dot(y1, z2) - dot(off, y12)
    A = np.stack(
        [dot(y1, z1) - dot(off, y11), mixed, mixed, dot(y2, z2) - dot(off, y22)], axis=1
    ).reshape(-1, 2, 2)
    return -np.stack([dot(off, y1), dot(off, y2)], axis=1), A


def _reduced(free: Array, A: Array, g: Array) -> Array:
    """A^-1 g in the free directions."""
    return np.asarray(
        np.einsum("nij,nj->ni", free, np.einsum("nij,nj->ni", inverse(free, A), _along(free, g)))
    )


def _along(free: Array, g: Array) -> Array:
    return np.asarray(np.einsum("nji,nj->ni", free, g))


def inverse(free: Array, A: Array) -> Array:
    """The inverse (n, 2, 2) of A in the free directions, one where there is none."""
    none = np.asarray(~free.any(axis=1))
    reduced = np.einsum("nji,njk,nkl->nil", free, A, free)
    reduced[:, 0, 0] += none[:, 0]
    reduced[:, 1, 1] += none[:, 1]
    turned = np.stack(
        [reduced[:, 1, 1], -reduced[:, 0, 1], -reduced[:, 1, 0], reduced[:, 0, 0]], axis=1
    )
    return np.asarray(turned.reshape(-1, 2, 2) / determinant(reduced)[:, None, None])


def determinant(A: Array) -> Array:
    """Of (n, 2, 2)."""
    return np.asarray(A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0])


def near_pairs(centres: Array, radii: Array, reach: float, own: Longs) -> tuple[Longs, Longs]:
    """Pairs i != j of spheres that are nearer to each other than a reach, i among some, in classes
    of similar radii."""
    size = np.floor(np.log2(np.maximum(radii, 1e-300) / radii.max())).astype(int)
    classes = [np.flatnonzero(size == k) for k in np.unique(size)]
    owned = [own[size[own] == k] for k in np.unique(size)]
    of_classes = [(each, scipy.spatial.cKDTree(centres[each])) for each in classes]
    pairs = list[tuple[Longs, Longs]]()
    for first in filter(len, owned):
        of_first = scipy.spatial.cKDTree(centres[first])
        for second, of_second in of_classes:
            most = radii[first].max() + radii[second].max() + reach
            near = of_first.sparse_distance_matrix(of_second, most, output_type="ndarray")
            i, j = first[near["i"]], second[near["j"]]
            fits = (near["v"] < radii[i] + radii[j] + reach) & (i != j)
            pairs.append((i[fits], j[fits]))
    nothing = np.zeros(0, dtype=np.int64)
    i, j = (
        np.concatenate([nothing, *each]).astype(np.int64)
        for each in zip((nothing, nothing), *pairs, strict=True)
    )
    return i, j


@dataclass(frozen=True)
class Joined:
    """Places of a point in one direction, in neighbouring cells, as one: a fold between cells has
    no jump then.

    Attributes
    ----------
    first
        (m,) the nearest place of each.
    group
        (n,) the joined one that a place belongs to.
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
    def of(cls, at: Places, blur: float) -> "Joined":
        """Of places in the order of points, sides and distances."""
        first = at.firsts
        counts = np.diff([*first, len(at.point)])
        group = np.repeat(np.arange(len(first)), counts)
        size = np.exp((at.distance[first][group] - at.distance) / blur)
        total = np.bincount(group, size, len(first))
        return cls(
            first, group, at.distance[first] - blur * np.log(total), size / total[group], counts > 1
        )

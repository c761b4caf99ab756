"""Which places of other cells the points of a surface face, at a displacement.

A tree gives the cells that are near, which are kept while nodes move little; Newton's method the
nearest place of each.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.parts.touching.faces import Faces
from magshell_fenicsx.parts.touching.nearest import (
    BESIDE,
    BETWEEN,
    BULGE,
    SHAPES,
    WAYS,
    Cells,
    Limits,
    Longs,
    Places,
    Undeformed,
    highest,
    jets,
    near_pairs,
    places_near,
    places_of,
)
from magshell_fenicsx.parts.touching.segments import Points

Array = NDArray[np.float64]
Inside = NDArray[np.bool_]
MARGIN = (
    0.5  # of the cells' mean radius: nodes that move less keep the pairs of cells that are near
)
MANY = 2_000_000  # distances of a point from a place at a time
# of the thickness: distances that differ by less belong to one place, see `nearest.Joined`
BLUR = 1e-6
ALIKE = 0.5  # the cosine between the ways to places that are one: folds between cells are smaller
# of the way between corners of cells beside each other, less than which they are apart where these
# fold
SHRUNK = 0.9
STEEP = 0.87  # the cosine of an angle between cells at which an edge is no part of a face any more
NEARER_FIRST = 0.3, 0.5  # of a reach: whether a place is so near is asked first, which costs less
SAME = (
    40 * BLUR
)  # of the thickness: a place that is farther than another by more than this does not count


class Facing:
    """The search for these places.

    Parameters
    ----------
    rule
        Points on all cells of this rank.
    allowed
        Whether points of cells (n,) may touch cells (n,).
    h
        Thickness over R.
    r0
        (nodes, 3) undeformed.
    faces
        How far they are from the mid-surface where the thickness varies, or changes with the state;
        None where it is h.
    """

    def __init__(
        self,
        cells: Cells,
        rule: Points,
        allowed: Callable[[Longs, Longs], Inside],
        h: float,
        r0: Array,
        faces: Faces | None,
        comm: MPI.Comm,
    ) -> None:
        self._cells, self._rule, self._allowed, self._h = cells, rule, allowed, h
        self._r0, self._faces, self._comm = r0, faces, comm
        self.half: Array = (
            faces.undeformed if faces else np.full(len(r0), h / 2)
        )  # undeformed, at all nodes
        self._thickest = 2 * highest(self.half[cells.nodes], cells.lebesgue)
        self._beside = cells.near_in_surface(r0, 2 * BESIDE * self.half)
        self._undeformed = np.column_stack([r0, self.half])
        self._known: tuple[Points, Array] = rule, self.x_of(rule, self._undeformed)
        self._own_cells = np.unique(rule.cell)  # the cells of this rank that are modelled
        self._tracked = dict[float, tuple[Array, float, tuple[Longs, Longs]]]()

    def placed(self, u: Array, *, faces: bool = True) -> Array:
        """All nodes, with what half the thickness is more than h/2 as a fourth component if it is another one; see
        `nearest`."""
        r = self._r0 + u
        return (
            np.column_stack([r, self._faces.half(u) - self._h / 2]) if faces and self._faces else r
        )

    def x_of(self, points: Points, r: Array, which: Any = slice(None)) -> Array:
        """The places of some points."""
        return places_of(self._cells, r, points.cell[which], points.shape[which])

    def near_on_way(self, u: Array, v: Array) -> bool:
        """Whether any cells that may touch come near each other between two displacements;
        collective.
        """
        both = [self._spheres(self._r0 + each) for each in (u, v)]
        centres = (both[0][0] + both[1][0]) / 2
        apart = np.linalg.norm(both[1][0] - both[0][0], axis=1) / 2
        radii = np.maximum(both[0][1], both[1][1]) + apart
        far = self._thickest
        near = self._fit(
            *near_pairs(centres, radii, far, self._own_cells), far, self._r0 + u, self._r0 + v
        )
        return bool(self._comm.allreduce(len(near[0])))

    def _spheres(self, r: Array, cell: Any = slice(None)) -> tuple[Array, Array]:
        """Centres and radii of spheres around cells."""
        nodal = r[self._cells.nodes[cell]]
        centres = nodal.mean(axis=1)
        return centres, BULGE * np.linalg.norm(nodal - centres[:, None], axis=2).max(axis=1)

    def _fit(self, i: Longs, j: Longs, far: float = 0.0, *displaced: Array) -> tuple[Longs, Longs]:
        """The pairs of cells that may touch; of those beside each other where one of some surfaces
        is folded.
        """
        allowed = self._allowed(i, j)
        i, j = i[allowed], j[allowed]
        fits = ~self._is_beside(i * len(self._cells.nodes) + j)
        beside = np.flatnonzero(~fits)
        for r in displaced:
            fits[beside] |= self._folded(i[beside], j[beside], r, far)
        return i[fits], j[fits]

    def _is_beside(self, keys: Longs) -> Inside:
        """Whether pairs i * cells + j are of cells that are near in the surface."""
        at = np.minimum(np.searchsorted(self._beside, keys), len(self._beside) - 1)
        return np.asarray(self._beside[at] == keys)

    def _folded(self, i: Longs, j: Longs, r: Array, far: float) -> Inside:
        """Whether places of cells (n,) may be nearer than `far` to those of others that are not
        near in the surface.
        """
        found, nodes = np.zeros(len(i), dtype=bool), self._cells.nodes
        (_, radii), (_, wide) = self._spheres(r), self._spheres(self._r0)
        for some in np.array_split(np.arange(len(i)), 1 + len(i) * nodes.shape[1] ** 2 // MANY):
            a, b = nodes[i[some]], nodes[j[some]]
            for count in (3, nodes.shape[1]):  # corners come first
                one, other = a[:, :count, None], b[:, None, :count]
                way, now = (np.linalg.norm(x[one] - x[other], axis=3) for x in (self._r0, r))
                if count == 3:
                    some = some[shrunk := (now < SHRUNK * way).any(axis=(1, 2))]
                    a, b = a[shrunk], b[shrunk]
                    continue
                between = BETWEEN / self._cells.element.degree
                apart = between * (radii[i[some]] + radii[j[some]])
                before = between * (wide[i[some]] + wide[j[some]])
                least = BESIDE * (self.half[one] + self.half[other])
                near = (now < far + apart[:, None, None]) & (way > least - before[:, None, None])
                found[some] = near.any(axis=(1, 2))
        return found

    def _near_cells(self, u: Array, reach: float) -> tuple[Longs, Longs]:
        """Pairs of a cell with points of this rank and any cell near by; they are kept while nodes
        move little.
        """
        if reach in self._tracked:
            then, margin, pairs = self._tracked[reach]
            moved = 2 * float(np.linalg.norm(u - then, axis=1).max(initial=0.0))
            if moved + reach <= margin:
                return pairs
        centres, radii = self._spheres(self._r0 + u)
        margin = reach + MARGIN * float(radii.mean())
        pairs = self._fit(
            *near_pairs(centres, radii, margin, self._own_cells), margin, self._r0 + u
        )
        self._tracked[reach] = np.array(u), margin, pairs
        return pairs

    def held_gap(self, held: Longs, u: Array) -> float:
        """The least one, over R, between faces at nodes that supports hold, at a displacement of
        all nodes.

        Of those that may touch and are no neighbours undeformed; infinite without, or if the shell
        thins.
        """
        if self._faces and not self._faces.constant:
            return np.inf
        count = len(self._cells.nodes)

        def may(i: Longs, j: Longs) -> Inside:
            return np.asarray(self._allowed(i, j) & ~self._is_beside(i * count + j))

        return between_held(held, self._cells.nodes, self._r0, u, self.half, may)

    def found(
        self,
        u: Array,
        reach: float,
        points: Points | None = None,
        *,
        faces: bool = True,
        least: bool = False,
    ) -> Places:
        """The places that points, those of the rule if none are given, face at a displacement,
        within a distance of faces or mid-surfaces; with `least` those of each point's least
        distance, and some others."""
        points = points or self._rule
        return self._facing(
            points, self.places_in(points, u, self.placed(u, faces=faces), reach, least=least)
        )

    def least_distance(self, u: Array, far: float, points: Points | None = None) -> float:
        """The least distance of any point at a displacement; `far` if none is nearer.
        Collective."""
        for reach in (*(part * far for part in NEARER_FIRST), far):
            mine = float(self.found(u, reach, points, least=True).distance.min(initial=far))
            nearest = float(self._comm.allreduce(mine, MPI.MIN))
            if nearest < reach:
                return nearest
        return far

    @cached_property
    def _separate_surfaces(self) -> tuple[Longs, Inside]:
        """The connected surface (n,) of each cell, and whether places of one face all of another
        one, (m, m).

        Of another surface each point's nearest place counts: it goes on from there to none that is
        nearer, and no place of it is near the point in the point's own surface.
        """
        cell, side = np.nonzero(self._cells.across >= 0)
        n, beyond = len(self._cells.nodes), self._cells.across[cell, side]
        joined = scipy.sparse.coo_array((np.ones(len(cell)), (cell, beyond)), (n, n))
        count, number = scipy.sparse.csgraph.connected_components(joined, directed=False)
        sizes, (_, first) = np.bincount(number), np.unique(number, return_index=True)
        faced = np.array(
            [
                np.bincount(number[self._allowed(np.full(n, i), np.arange(n))], minlength=count)
                for i in first
            ]
        )
        near = np.zeros((count, count), dtype=bool)
        near[number[self._beside // n], number[self._beside % n]] = True
        alike = faced == sizes
        return number, alike & alike.T & ~near & ~np.eye(count, dtype=bool)

    def _limits(
        self, asked: Longs, x: Array, r: Array, pairs: tuple[Longs, Longs], cell: Longs, most: float
    ) -> Limits:
        """How far the nearest place of a surface that is apart is at most: its nearest node within
        `most` is one.

        Parameters
        ----------
        asked, cell
            (m,) of the points x, and their cells.
        """
        number, apart = self._separate_surfaces
        more = r[:, 3][self._cells.nodes] if r.shape[1] > 3 else np.zeros((1, 1))
        varies = highest(more, self._cells.lebesgue) + highest(-more, self._cells.lebesgue)
        reach, surface = np.full(len(x), np.inf), number[cell]
        near = np.zeros(len(self._cells.nodes), dtype=bool)
        near[pairs[1]] = True
        for each in np.unique(surface):
            nodes, mine = (
                np.unique(self._cells.nodes[near & apart[each][number]]),
                asked[surface == each],
            )
            if len(nodes):
                away, _ = scipy.spatial.cKDTree(r[nodes, :3]).query(
                    x[mine, :3], distance_upper_bound=most
                )
                reach[mine] = away + varies + 2 * SAME * self._h
        return Limits(apart[number[pairs[0]], number[pairs[1]]], reach)

    def places_in(
        self, points: Points, u: Array, r: Array, reach: float, *, least: bool = False
    ) -> Places:
        """The places of all cells nearest to points, within a distance at a displacement; r as of
        `placed`."""
        thicker = (
            highest(r[:, 3][self._cells.nodes], self._cells.lebesgue) if r.shape[1] > 3 else 0.0
        )
        of_faces, reach = reach, reach + 2 * thicker
        i, j = self._near_cells(u, reach)
        order, cell_of = points.by_cell
        first = np.searchsorted(cell_of, i)
        number = np.searchsorted(cell_of, i, "right") - first
        asked = order[np.isin(cell_of, i)]
        x = np.zeros((len(order), r.shape[1]))
        x[asked] = self.x_of(points, r, asked)
        if self._known[0] is not points:
            self._known = points, self.x_of(points, self._undeformed)
        near = self._is_beside(i * len(self._cells.nodes) + j)
        undeformed = Undeformed(near, self._undeformed, self._known[1], BESIDE)
        limits = self._limits(asked, x, r, (i, j), points.cell[asked], reach) if least else None
        return places_near(
            self._cells, r, x, (j, first, number, order), reach, of_faces, undeformed, limits
        )[1]

    def of_far_cells(self, points: Points, at: Places) -> Places:
        """Those in cells that are not near in the surface: others are not cut along each other."""
        return at.of(~self._is_beside(points.cell[at.point] * len(self._cells.nodes) + at.cell))

    def thickness(self, points: Points, at: Places) -> Array:
        """The mean undeformed thickness (n,) at points and their places, over R."""
        (_, there), *_ = jets(
            self._cells.element, at.X, self.half[self._cells.nodes[at.cell]][..., None], 0
        )
        here = np.sum(
            points.shape[at.point] * self.half[self._cells.nodes[points.cell[at.point]]], axis=1
        )
        return np.asarray(here + there[:, 0])

    def _facing(self, points: Points, at: Places) -> Places:
        """Of all places those that are nearest: the surface goes on from none of them to a nearer one, and each point
        has one in each direction at most: on both sides of its own surface, and before its edge."""
        cells, number = self._cells, len(self._cells.nodes)
        keys = at.point * number + at.cell
        order = np.argsort(keys, kind="stable")
        at, keys = at.of(order), keys[order]
        on = np.column_stack([1 - at.X.sum(axis=1), at.X]) == 0.0
        beside = points.cell[at.point] * number
        stays = np.ones(len(keys), dtype=bool)
        for side in range(3):
            beyond = cells.across[at.cell, side]
            asked = on[:, side] & (beyond >= 0)
            there = np.minimum(
                np.searchsorted(keys, at.point * number + beyond), max(len(keys) - 1, 0)
            )
            listed = keys[there] == at.point * number + beyond
            nearer = at.distance[there] < at.distance - SAME * self._h
            folded = at.above & self._is_beside(
                beside + beyond
            )  # what goes on there is not looked at
            stays &= ~asked | (listed & ~nearer) | folded
        at = at.of(stays)
        if not len(at.point):
            return at
        at = at.of(np.lexsort((at.distance, at.point)))
        way, numbers, rest = at.way, np.full(len(at.point), WAYS - 1), np.arange(len(at.point))
        for number_of_way in range(WAYS - 1):
            first = np.flatnonzero(np.diff(at.point[rest], prepend=-1))
            nearest = np.repeat(rest[first], np.diff([*first, len(rest)]))
            alike = np.sum(way[rest] * way[nearest], axis=1) > ALIKE
            numbers[rest[alike]] = number_of_way
            rest = rest[~alike]
        at = replace(at, side=numbers)
        order = np.lexsort((at.distance, numbers, at.point))
        at = at.of(order)
        first = at.firsts
        least = np.repeat(at.distance[first], np.diff([*first, len(order)]))
        return at.of(at.distance < least + SAME * self._h)

    def left_to_edges(self, points: Points, at: Places, normals: Array) -> Inside:
        """Which places (n,) do not count: those of points inside a surface that face an edge of
        another one, steeply.

        The edge's own points are there too. Those of the face see a line, which is narrower than
        they are apart: it would be held back where it slides over one of them. Places of one point
        and direction are as the nearest.

        Parameters
        ----------
        normals
            (cells, 3) where the cuts were made.
        """
        first = at.firsts
        on_edge, steep = self._at_edges(points, nearest := at.of(first), normals)
        left = on_edge & steep & ~points.on_edge[nearest.point]
        return np.asarray(np.repeat(left, np.diff([*first, len(at.point)])))

    def press_alone(self, points: Points, nearest: Places, normals: Array) -> Inside:
        """Which points, given with their nearest places, press on a face whose own points are left
        to this edge.
        """
        on_edge, steep = self._at_edges(points, nearest, normals)
        return np.asarray(steep & ~on_edge)

    def _at_edges(self, points: Points, nearest: Places, normals: Array) -> tuple[Inside, Inside]:
        """Which nearest places are on an edge, and which are in a cell that is steep to their
        point's.
        """
        on_side = np.column_stack([1 - nearest.X.sum(axis=1), nearest.X]) == 0.0
        along = nearest.free.any(axis=(1, 2)) & (nearest.free[:, :, 1] == 0).all(axis=1)
        on_edge = along & (on_side & (self._cells.across[nearest.cell] < 0)).any(axis=1)
        in_corner = (
            on_side.sum(axis=1) == 2
        )  # where an edge goes on from one cell to another, or turns
        on_edge |= in_corner & (~on_side & self._cells.on_edge[nearest.cell]).any(axis=1)
        level = np.abs(np.sum(normals[points.cell[nearest.point]] * normals[nearest.cell], axis=1))
        return np.asarray(on_edge), np.asarray(level < STEEP)


def between_held(
    held: Longs,
    nodes: Longs,
    r0: Array,
    u: Array,
    half: Array,
    may: Callable[[Longs, Longs], Inside],
) -> float:
    """The least gap between faces at some nodes at a displacement, see `Facing.held_gap`.

    Parameters
    ----------
    nodes
        (cells, functions) of all cells.
    may
        Whether cells (n,) may touch others and are not near them in the surface.
    """
    cell_of = np.zeros(len(r0), dtype=np.int64)
    cell_of[nodes.ravel()] = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    cells, before, after, thickness = (
        cell_of[held],
        r0[held],
        (r0 + u)[held],
        half[held][:, None] + half[held],
    )
    i, j = np.nonzero(scipy.spatial.distance.cdist(before, before) > (1 - SAME) * thickness)
    near = np.linalg.norm(after[i] - after[j], axis=1) - thickness[i, j]
    counts = near < 0
    i, j, near = i[counts], j[counts], near[counts]
    return float(near[may(cells[i], cells[j])].min(initial=np.inf))


def nowhere() -> Places:
    """No places."""
    nothing, (X, free, distance, way) = (
        np.zeros(0, dtype=np.int64),
        (np.zeros((0, *each)) for each in SHAPES),
    )
    return Places(nothing, nothing, X, free, distance, nothing, way, nothing > 0)

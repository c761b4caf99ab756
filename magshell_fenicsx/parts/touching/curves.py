"""Points on meridians, and the places of other meridians that are nearest to them.

Places have rho, z, and half the thickness less h/2, of points with the other sign: see `nearest`
and `on_meridian`.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.touching.facing import ALIKE, SHRUNK
from magshell_fenicsx.parts.touching.nearest import BESIDE, BETWEEN_PLACES, BULGE, near_along_sides
from magshell_fenicsx.parts.touching.rules import BEFORE, rule_on_line

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
Inside = NDArray[np.bool_]
ROUNDS, EXACT = (
    30,
    1e-10,
)  # Newton's steps at most; after a smaller one, in the cell, the place is exact
FLAT = 1e-3  # of the square of the speed: below it the step takes that
START = (
    4  # parts of a cell, from whose ends the search for the nearest place begins, for each degree
)
SAME = 1e-9  # of h: places of two cells at the same distance are one
SIGNS = np.array([1.0, 1.0, -1.0])  # of the squares of components in A
BELOW = (
    0.5  # the sine of an angle between a curve and the way from a place to a point that is above it
)


@dataclass(frozen=True)
class Rule:
    """Points on the cells of two shells.

    Attributes
    ----------
    cell, shape, weight
        (n,) number, (n, functions) of that cell, and undeformed area over R^2, all around.
    first
        (n,) whether it is on the first shell.
    normal
        (n, 2) undeformed.
    on_edge
        (n,) whether it is next to a free end.
    """

    cell: Longs
    shape: Array
    weight: Array
    first: Inside
    normal: Array
    on_edge: Inside


@dataclass(frozen=True)
class Faced:
    """Points and the places that are nearest to them.

    Attributes
    ----------
    point, cell, X
        (n,) number of the point, cell of the place, and where it is in that.
    free
        (n,) whether it may move along the curve.
    distance
        (n,) over R.
    """

    point: Longs
    cell: Longs
    X: Array
    free: Inside
    distance: Array

    def of(self, which: Inside | Longs) -> "Faced":
        """Some of them."""
        return Faced(*(getattr(self, each.name)[which] for each in fields(self)))


def beside(nodes: Longs) -> Longs:
    """(cells, 2): the cell beyond each end; -1 where there is none."""
    beyond = np.full((len(nodes), 2), -1, dtype=np.int64)
    of = dict[int, tuple[int, int]]()
    for cell, end in np.ndindex(len(nodes), 2):
        if other := of.get(vertex := int(nodes[cell, end])):
            beyond[cell, end], beyond[other] = other[0], cell
        of[vertex] = cell, end
    return beyond


class Around:
    """The material around a point, which it does not touch, see `nearest`.

    Parameters
    ----------
    points, cells
        Undeformed places of the points (n, 3) and of the nodes of all cells (cells, functions, 3),
        the last component half the thickness, of points with the other sign.
    nodes
        (cells, functions) of all cells, the ends first.
    of
        (n,) cells of the points.
    """

    def __init__(self, points: Array, cells: Array, nodes: Longs, of: Longs) -> None:
        self._points, self._cells, self.of, count = points, cells, of, len(nodes)
        r0 = np.zeros((int(nodes.max()) + 1, 3))
        r0[nodes] = cells
        near: Inside = np.zeros(count * count, dtype=bool)
        near[near_along_sides(nodes[:, :2], r0[:, :2], 2 * BESIDE * r0[:, 2])] = True
        self._near = near.reshape(count, count)

    def near(self, cell: Longs, other: Longs) -> Inside:
        """Whether the way from cells (n,) to others, -1 for none, is short along the curve."""
        return np.asarray(self._near[cell, other] & (other >= 0))

    def fits(self, cell: Longs, other: Longs, nodal: Array) -> Inside:
        """Whether cells (n,) may touch others: of those near along the curve where one is folded."""
        fits = ~self._near[cell, other]
        near = np.flatnonzero(~fits & (cell != other))
        i, j = cell[near], other[near]
        now, way = (
            np.linalg.norm(r[i][:, :, None] - r[j][:, None], axis=3)
            for r in (nodal, self._cells[..., :2])
        )
        fits[near] = (now < SHRUNK * way).any(axis=(1, 2))
        return fits

    def apart(self, at: "Faced", shape: Array, above: Inside) -> Inside:
        """Which places count: those far along the curve, or else far undeformed and above or below
        their points.
        """
        near = self.near(self.of[at.point], at.cell)
        off = self._points[at.point] - np.einsum("nk,nki->ni", shape, self._cells[at.cell])
        away = np.linalg.norm(off[:, :2], axis=1) > BESIDE * np.abs(off[:, 2])
        return np.asarray(~near | (above & away))


class Close:
    """Which cells of the other shell points may be near to: from circles about cells, then from
    chords.

    Parameters
    ----------
    nodes
        (cells, functions) of all cells, the ends first.
    sides
        Whether each cell belongs to the first shell, and to the second.
    element
        Of basix.
    around
        Of a shell that may touch itself; both sides are then the same.
    """

    def __init__(
        self,
        rule: Rule,
        nodes: Longs,
        sides: tuple[Inside, Inside],
        element: Any,
        around: Around | None,
    ) -> None:
        self._one, self._other = (np.flatnonzero(side) for side in sides)
        self._around = around
        self._counts = np.bincount(rule.cell, minlength=len(nodes))
        self._starts = np.zeros_like(self._counts)  # points of a cell follow each other
        self._starts[rule.cell[::-1]] = np.arange(len(rule.cell))[::-1]
        at = np.linspace(0.0, 1.0, 20 * element.degree + 1, dtype=np.float64)[:, None]
        inner = np.abs(element.tabulate(0, at)[0, :, 2:, 0])
        self._bulge = BULGE * float(
            inner.sum(axis=1).max(initial=0.0)
        )  # of a curve, over that of its nodes
        self._part = element.points[2:, :1]

    def __call__(self, x: Array, nodal: Array, reach: float) -> tuple[Longs, Longs]:
        """Points and cells, among them all of less than this distance.

        Parameters
        ----------
        x, nodal
            Places of all points (n, 2), and of the nodes of all cells (cells, functions, 2).
        """
        point, cell = self._in_circles(nodal, reach)
        a, chord = nodal[:, 0], nodal[:, 1] - nodal[:, 0]
        off = nodal[:, 2:] - a[:, None] - self._part * chord[:, None]
        most = self._bulge * np.linalg.norm(off, axis=2).max(axis=1, initial=0.0)
        way, along = x[point] - a[cell], chord[cell]
        part = np.clip(np.sum(way * along, axis=1) / np.sum(chord * chord, axis=1)[cell], 0.0, 1.0)
        near = np.linalg.norm(way - part[:, None] * along, axis=1) - most[cell] < reach
        return point[near], cell[near]

    def _in_circles(self, nodal: Array, reach: float) -> tuple[Longs, Longs]:
        """Points of cells that are near to cells, and these."""
        one, other, centres = self._one, self._other, nodal.mean(axis=1)
        radii = BULGE * np.sqrt(np.sum((nodal - centres[:, None]) ** 2, axis=2).max(axis=1))
        way = centres[one][:, None] - centres[other]
        i, j = np.nonzero(
            np.sum(way * way, axis=2) < (radii[one][:, None] + radii[other] + reach) ** 2
        )
        of, cell = one[i], other[j]
        if self._around:
            fits = self._around.fits(of, cell, nodal)
            of, cell = of[fits], cell[fits]
        else:
            of, cell = np.concatenate([of, cell]), np.concatenate([cell, of])
        count = self._counts[of]
        first = np.repeat(self._starts[of] - np.cumsum(count) + count, count)
        return first + np.arange(len(first)), np.repeat(cell, count)


def nowhere() -> Faced:
    """No places."""
    nothing = np.zeros(0, dtype=np.int64)
    return Faced(nothing, nothing, np.zeros(0), np.zeros(0, dtype=bool), np.zeros(0))


def slopes(x: Array, jets: Array) -> tuple[Array, Array, Array]:
    """How far places are drawn to points x (n, 3) along their curves with these jets, the derivative A of that with the
    other sign, and that of a straight line; all (n,) times the distance."""
    y, first, second = jets
    off = np.column_stack([(x - y)[:, :2], np.linalg.norm((x - y)[:, :2], axis=1)])
    speed = np.sum(first * first * SIGNS, axis=1)
    return np.sum(off * first, axis=1), speed - np.sum(off * second, axis=1), speed


def distances(off: Array) -> Array:
    """Those (...,) of the differences (..., 3) between points and places."""
    return np.asarray(np.linalg.norm(off[..., :2], axis=-1) + off[..., 2])


class Curves:
    """The meridians of all shells.

    Parameters
    ----------
    element
        Of basix, with its nodes.
    nodes
        (cells, functions).
    r0
        (nodes, 2) undeformed.
    h
        Thickness over R.

    Attributes
    ----------
    element, nodes
        The same.
    beside
        (cells, 2): the cell beyond each end; -1 where there is none.
    lebesgue
        See `nearest.highest`.
    at_nodes
        (places, functions): derivatives of shape functions at the nodes.
    """

    def __init__(self, element: Any, nodes: Longs, r0: Array, h: float) -> None:
        self.element, self.nodes, self._r0, self._h = element, nodes, r0, h
        self.beside = beside(nodes)
        self._start = np.linspace(0.0, 1.0, START * element.degree + 1, dtype=np.float64)
        self.at_nodes = self.table(1, element.points.ravel())[1]
        self.lebesgue = BETWEEN_PLACES * float(
            np.abs(self.table(0, self._start)[0]).sum(axis=1).max()
        )

    def table(self, order: int, X: Array) -> Array:
        """Shape functions and derivatives (order + 1, n, functions); basix takes no empty X."""
        if not len(X):
            return np.zeros((order + 1, 0, self.nodes.shape[1]))
        return np.asarray(self.element.tabulate(order, X[:, None])[..., 0])

    def jets(self, X: Array, nodal: Array) -> Array:
        """(3, n, 3): places and two derivatives, of the curves through nodes (n, functions, 3)."""
        return np.asarray(np.einsum("dnk,nki->dni", self.table(2, X), nodal))

    def rule(self, count: int, sides: tuple[Inside, Inside]) -> Rule:
        """So many Gauss's points in each cell, in those with a free end the end among them.

        `sides` tell whether each cell belongs to the first shell, and to the second.
        """
        ends = (self.beside < 0) & (np.abs(self._r0[self.nodes[:, :2], 0]) > SAME)
        parts = list[tuple[Longs, Array, Array, Inside, Array, Inside]]()
        for begins, last in ((False, False), (True, False), (False, True), (True, True)):
            cells = np.flatnonzero(np.any(sides, axis=0) & (ends == [begins, last]).all(axis=1))
            X, w = rule_on_line(count, begins, last)
            table = self.table(1, X)
            x, along = np.einsum("dqk,cki->dcqi", table, self._r0[self.nodes[cells]])
            speed = np.linalg.norm(along, axis=2)
            area = 2 * np.pi * x[..., 0] * speed * w
            normal = np.stack([-along[..., 1], along[..., 0]], axis=-1) / speed[..., None]
            on_edge = np.tile((X < 2 * BEFORE) & begins | (X > 1 - 2 * BEFORE) & last, len(cells))
            cell, shape = np.repeat(cells, len(X)), np.tile(table[0], (len(cells), 1))
            parts.append(
                (cell, shape, area.ravel(), sides[0][cell], normal.reshape(-1, 2), on_edge)
            )
        return Rule(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def projected(self, x: Array, nodal: Array, point: Longs, cell: Longs) -> Faced:
        """The nearest place of each cell, by Newton's method from the nearest of some."""
        shape = self.table(0, self._start)[0]
        off = x[point][:, None] - np.einsum("mk,nki->nmi", shape, nodal[cell])
        X = self._start[distances(off).argmin(axis=1)]
        moving = np.arange(len(X))
        for _ in range(ROUNDS):
            pull, bent, speed = slopes(x[point[moving]], self.jets(X[moving], nodal[cell[moving]]))
            step = pull / np.where(bent > FLAT * speed, bent, speed)
            before = X[moving]
            X[moving] = np.clip(before + np.clip(step, -0.25, 0.25), 0.0, 1.0)
            moving = moving[np.abs(X[moving] - before) >= EXACT]
            if not len(moving):
                break
        jets = self.jets(X, nodal[cell])
        pull, *_ = slopes(x[point], jets)
        free = ~((X == 0.0) & (pull <= 0) | (X == 1.0) & (pull >= 0))
        return Faced(point, cell, X, free, distances(x[point] - jets[0]))

    def nearest(self, at: Faced, x: Array, nodal: Array, around: Around | None) -> Faced:
        """Of all places those from which the curve goes on to no nearer one, one on each side of a
        point.
        """
        number = len(self.nodes)
        at = at.of(np.argsort(at.point * number + at.cell))
        above: Inside = np.ones(len(at.point), dtype=bool)
        if around:
            above = self._above(at, x, nodal)
            counts = around.apart(at, self.table(0, at.X)[0], above)
            at, above = at.of(counts), above[counts]
        keys = at.point * number + at.cell
        stays: Inside = np.ones(len(keys), dtype=bool)
        for end, X in enumerate((0.0, 1.0)):
            beyond = self.beside[at.cell, end]
            there = np.minimum(
                np.searchsorted(keys, at.point * number + beyond), max(len(keys) - 1, 0)
            )
            listed = keys[there] == at.point * number + beyond
            nearer = listed & (at.distance[there] < at.distance - SAME * self._h)
            folded = above & around.near(around.of[at.point], beyond) if around else False
            stays &= ~((at.X == X) & (beyond >= 0)) | (listed & ~nearer) | folded
        at = at.of(stays)
        at = at.of(np.lexsort((at.distance, at.point)))
        if not len(at.point):
            return at
        way = (x[at.point] - self.jets(at.X, nodal[at.cell])[0])[:, :2]
        way = way / np.maximum(np.linalg.norm(way, axis=1), 1e-300)[:, None]
        begins = np.flatnonzero(np.diff(at.point, prepend=-1))
        first = np.repeat(begins, np.diff([*begins, len(way)]))
        behind = np.sum(way * way[first], axis=1) < ALIKE
        chosen = np.zeros(len(way), dtype=bool)
        chosen[begins] = True
        others = np.flatnonzero(behind)
        chosen[others[np.flatnonzero(np.diff(at.point[others], prepend=-1))]] = True
        return at.of(chosen)

    def _above(self, at: Faced, x: Array, nodal: Array) -> Inside:
        """Whether points are above or below their places, and not beside them as in one curve that
        is straight.
        """
        y, along, _ = self.jets(at.X, nodal[at.cell])[..., :2]
        way = x[at.point, :2] - y
        high = np.abs(way[:, 0] * along[:, 1] - way[:, 1] * along[:, 0])
        return np.asarray(
            high > BELOW * np.linalg.norm(way, axis=1) * np.linalg.norm(along, axis=1)
        )

    def cell_normals(self) -> Array:
        """(cells, 2) undeformed, of the straight lines between the ends."""
        a, b = self._r0[self.nodes[:, 0]], self._r0[self.nodes[:, 1]]
        n = np.column_stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]])
        return np.asarray(n / np.linalg.norm(n, axis=1)[:, None])

"""A grid of quadrilaterals on a rectangular chart, each cut into four triangles; opposite sides may
be glued.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.distinct import NEAR, grouped_by_distance
from magshell_fenicsx.mesh.patch import Embedding, MeshError, PatchMesh
from magshell_fenicsx.mesh.shapes import Faces, Glued, within

Array = NDArray[np.float64]
Side = tuple[str, int, int]  # name, axis across it, and which end of that axis
CLOSE = 1e-9  # over the chart's extent
SAMPLES = 2001  # of a size that varies


@dataclass(frozen=True)
class Grid:
    """low <= (x, y) <= high.

    Attributes
    ----------
    size
        Largest side of a quadrilateral: a number, or a function (axis, coordinate across it) ->
        side.
    sides
        Names of x = low, x = high, y = low and y = high.
    glued
        Whether the two ends of each axis are one line of the surface.
    through
        Coordinates across each axis at which there is a straight grid line.
    movable
        Coordinates at which there is one too, that near places may draw to themselves.
    """

    low: tuple[float, float]
    high: tuple[float, float]
    size: float | Callable[[int, float], float]
    sides: tuple[str, str, str, str] = ("left", "right", "bottom", "top")
    glued: tuple[bool, bool] = (False, False)
    through: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())
    movable: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())

    @property
    def edges(self) -> tuple[str, ...]:
        """Names of the surface's edges: the sides that are not glued."""
        return tuple(
            dict.fromkeys(name for i, name in enumerate(self.sides) if not self.glued[i // 2])
        )

    @property
    def corners(self) -> Array:
        """Chart coordinates (4, 2) of the corners."""
        return np.array(
            [[x, y] for x in (self.low[0], self.high[0]) for y in (self.low[1], self.high[1])]
        )

    @property
    def cells(self) -> float:
        """Approximate number of triangles."""
        quadrilaterals = [max(self._counts[axis][1][-1], 1.0) for axis in range(2)]
        return float(4 * quadrilaterals[0] * quadrilaterals[1])

    @cached_property
    def _counts(self) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Of both axes: see `_counted`."""
        return self._counted(0), self._counted(1)

    def _counted(self, axis: int) -> tuple[Array, Array]:
        """Coordinates across an axis, and the number of sides of quadrilaterals up to each of them."""
        low, high, size = self.low[axis], self.high[axis], self.size
        if not callable(size):
            return np.array([low, high]), np.array([0.0, (high - low) / size])
        x = np.linspace(low, high, SAMPLES, dtype=np.float64)
        per_length = 1 / np.array([size(axis, float(c)) for c in x])
        return x, np.concatenate(
            [[0.0], np.cumsum((per_length[1:] + per_length[:-1]) / 2 * np.diff(x))]
        )

    def size_at(self, axis: int, x: float) -> float:
        """Largest distance of grid lines across an axis, at a coordinate."""
        return self.size(axis, x) if callable(self.size) else self.size

    def lines(self, axis: int, points: Sequence[Array]) -> Array:
        """Coordinates of the grid lines across an axis, with distances up to the size.

        One is at every point, or near it where points nearly have the same coordinate.
        """
        low, high = self.low[axis], self.high[axis]
        straight = self._straight(axis)
        movable = [middle for _, middle in self._groups(axis, points)]
        given = np.unique([*straight, *movable])
        given = given[np.concatenate([[True], np.diff(given) > CLOSE * (high - low)])]
        given[-1] = high
        x, sides = self._counts[axis]
        counts = np.interp(given, x, sides)
        parts = [max(int(np.ceil(b - a - 1e-6)), 1) for a, b in pairwise(counts)]
        if self.glued[axis] and sum(parts) < 3:
            parts = [
                max(n, -(-3 // len(parts))) for n in parts
            ]  # with fewer, the glued mesh would be degenerate
        inner = []
        for a, b, n, first, last in zip(
            given[:-1], given[1:], parts, counts[:-1], counts[1:], strict=True
        ):
            between = np.linspace(a, b, n + 1)[1:]
            if callable(self.size):
                between[:-1] = np.interp(np.linspace(first, last, n + 1)[1:-1], sides, x)
            inner.append(between)
        return np.concatenate([given[:1], *inner])

    def _straight(self, axis: int) -> Array:
        """Coordinates of lines that stay where they are, both ends among them."""
        low, high = self.low[axis], self.high[axis]
        lines = np.unique([low, high, *self.through[axis]])
        return np.asarray(lines[np.concatenate([[True], np.diff(lines) > CLOSE * (high - low)])])

    def straight_line_at(self, axis: int, x: float) -> float | None:
        """The straight line that a coordinate is too near to for a line of its own, or on; None if
        there is none."""
        straight = self._straight(axis)
        nearest = float(straight[np.abs(straight - x).argmin()])
        rounding = CLOSE * (self.high[axis] - self.low[axis])
        return nearest if abs(nearest - x) <= max(rounding, NEAR * self.size_at(axis, x)) else None

    def _groups(self, axis: int, points: Sequence[Array]) -> list[tuple[Array, float]]:
        """Groups of coordinates that are near each other, beside no straight line, and the line of
        each."""
        rounding = CLOSE * (self.high[axis] - self.low[axis])
        given = np.unique([*(float(x[axis]) for x in points), *self.movable[axis]])
        free = np.array([x for x in given if self.straight_line_at(axis, float(x)) is None])
        groups = grouped_by_distance(free, lambda x: self.size_at(axis, x), rounding)
        return [(g, float(g[0] if np.ptp(g) <= rounding else (g[0] + g[-1]) / 2)) for g in groups]

    def vertices_of(self, points: Sequence[Array]) -> NDArray[np.int64]:
        """Numbers (n, 2) of the grid lines whose crossing each point takes; of glued ends the
        first."""
        numbers = np.zeros((len(points), 2), dtype=np.int64)
        for axis in range(2):
            lines, groups = self.lines(axis, points), self._groups(axis, points)
            for i, point in enumerate(points):
                x = float(point[axis])
                line = self.straight_line_at(axis, x)
                if line is None:
                    line = next(middle for group, middle in groups if group[0] <= x <= group[-1])
                number = int(np.abs(lines - line).argmin())
                numbers[i, axis] = 0 if self.glued[axis] and number == len(lines) - 1 else number
        return numbers


def grid_mesh(grid: Grid, points: Mapping[str, Array], embedding: Embedding) -> PatchMesh:
    """Triangulate a grid, with the named points (2,) among its vertices.

    Raises
    ------
    MeshError
        If a point lies outside.
    """
    for name, x in points.items():
        extent = np.subtract(grid.high, grid.low)
        if (x < grid.low - CLOSE * extent).any() or (x > grid.high + CLOSE * extent).any():
            raise MeshError(f"the point {name} is not on the surface")
    x, y = (grid.lines(axis, list(points.values())) for axis in range(2))
    n, m = len(x) - 1, len(y) - 1
    vertices = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    _draw_to_points(vertices, grid, points)
    centres = (vertices[:-1, :-1] + vertices[1:, 1:]) / 2
    nodes = np.concatenate([vertices.reshape(-1, 2), centres.reshape(-1, 2)])
    number = np.arange((n + 1) * (m + 1)).reshape(n + 1, m + 1)
    centre = number.size + np.arange(n * m).reshape(n, m)
    around = [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]]
    cells = np.concatenate(
        [
            np.stack([around[i], around[(i + 1) % 4], centre], axis=-1).reshape(-1, 3)
            for i in range(4)
        ]
    )
    one = np.arange(len(nodes))
    if grid.glued[0]:
        one[number[-1]] = one[number[0]]
    if grid.glued[1]:
        one[number[:, -1]] = one[number[:, 0]]
    edges: dict[str, NDArray[np.int64]] = {}
    for name, row in zip(
        grid.sides, (number[0], number[-1], number[:, 0], number[:, -1]), strict=True
    ):
        if name in grid.edges:  # two sides may have one name
            line = one[np.stack([row[:-1], row[1:]], axis=-1)]
            edges[name] = np.concatenate([edges[name], line]) if name in edges else line
    return PatchMesh(nodes, cells, embedding, edges, dict(points), one=one)


def _draw_to_points(vertices: Array, grid: Grid, points: Mapping[str, Array]) -> None:
    """Move vertices (n, m, 2) to the points that take them, where lines are not exactly there.

    Raises
    ------
    MeshError
        If two points take one vertex, or one would draw a straight line.
    """
    extent, places = np.subtract(grid.high, grid.low), list(points.values())
    taken = dict[tuple[int, int], tuple[str, Array]]()
    numbers = grid.vertices_of(places)
    for which, (name, place) in enumerate(points.items()):
        i, j = int(numbers[which, 0]), int(numbers[which, 1])
        before, at = taken.setdefault((i, j), (name, place))
        off = np.asarray(place - vertices[i, j])
        off -= np.where(grid.glued, np.round(off / extent) * extent, 0.0)
        apart = place - at - np.where(grid.glued, np.round((place - at) / extent) * extent, 0.0)
        if (np.abs(apart) > CLOSE * extent).any():
            raise MeshError(
                f"the points {before} and {name} are too near to each other for the elements there"
            )
        for axis in range(2):
            line = grid.straight_line_at(axis, float(place[axis]))
            end = grid.glued[axis] and line in (grid.low[axis], grid.high[axis])
            if abs(off[axis]) <= CLOSE * extent[axis]:
                off[axis] = 0.0
            elif line is not None and not end:
                raise MeshError(f"the point {name} is too near to an edge or a plane of symmetry")
        rows = (0, -1) if grid.glued[0] and i == 0 else (i,)
        columns = (0, -1) if grid.glued[1] and j == 0 else (j,)
        for copy in product(rows, columns) if before == name else ():
            vertices[copy] += off


@dataclass(frozen=True)
class RimmedGrid:
    """A grid's rectangle with closed curves, points (n, 2) each, that element edges follow."""

    grid: Grid
    rims: tuple[Array, ...]
    half: bool = False

    @property
    def extent(self) -> Array:
        return np.subtract(self.grid.high, self.grid.low)

    @property
    def area(self) -> float:
        return float(np.prod(self.extent))

    @property
    def reach(self) -> float:
        return float(self.extent.max())

    @property
    def box(self) -> tuple[Array, Array]:
        return np.array(self.grid.low), np.array(self.grid.high)

    @property
    def glued(self) -> tuple[Glued, ...]:
        return tuple(
            (i, self.grid.low[i], self.grid.high[i]) for i in range(2) if self.grid.glued[i]
        )

    def faces(self, occ: Any) -> Faces:
        """The rectangle, the rims with their images across glued sides, and the lines of the grid's
        `through`.
        """
        (x0, y0), (x1, y1) = self.grid.low, self.grid.high

        def rectangle() -> tuple[int, int]:
            return 2, occ.addRectangle(x0, y0, 0, x1 - x0, y1 - y0)

        steps = [(-1, 0, 1) if glued else (0,) for glued in self.grid.glued]
        images = [
            points + np.multiply(step, self.extent)
            for points in self.rims
            for step in product(*steps)
        ]
        near = [
            p
            for p in images
            if (p.max(axis=0) > self.grid.low).all() and (p.min(axis=0) < self.grid.high).all()
        ]
        surfaces = [rectangle(), *within(occ, near, rectangle)]
        for axis, other in ((0, 1), (1, 0)):
            for across in (*self.grid.through[axis], *self.grid.movable[axis]):
                if not self.grid.low[axis] < across < self.grid.high[axis]:
                    continue
                ends = np.array([self.grid.low, self.grid.high])
                ends[:, axis], ends[:, other] = (
                    across,
                    (self.grid.low[other], self.grid.high[other]),
                )
                surfaces.append((1, occ.addLine(*(occ.addPoint(*end, 0) for end in ends))))
        return surfaces

    def on_edges(self, x: Array) -> dict[str, NDArray[np.bool_]]:
        edges = dict[str, NDArray[np.bool_]]()
        for i, name in enumerate(self.grid.sides):
            axis, end = i // 2, (self.grid.low, self.grid.high)[i % 2]
            if name in self.grid.edges and not self.grid.glued[axis]:
                on = np.abs(x[:, axis] - end[axis]) < CLOSE * self.reach
                edges[name] = edges[name] | on if name in edges else on
        return edges

"""Triangulated grids: quadrilaterals on a rectangular chart, each divided into four triangles.

Opposite sides may be one line of the surface: their nodes are then glued. Grid lines pass through
the named points; lines that nearly coincide are one line, which is bent to the points.

The chart has two coordinates, axis 0 and 1; a line across an axis is the line of one value of this
coordinate. Fixed lines are straight and stay; movable lines may be moved to points nearby. Glued
nodes have one representative. An embedding maps chart coordinates to places in space. A rim is a
closed curve that element edges follow, such as the edge of a dimple.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import Embedding, MeshError, PatchMesh
from magshell_fenicsx.mesh.shapes import Faces, GluedSides, faces_within
from magshell_fenicsx.mesh.vertex_spacing import MIN_VERTEX_DISTANCE, grouped_by_distance

Array = NDArray[np.float64]
CHART_TOLERANCE = 1e-9  # over the chart's extent: coordinates that differ by rounding
COUNT_TOLERANCE = 1e-6  # of a number of quadrilaterals, which is rounded up
SIZE_SAMPLES = 2001  # of a size that varies, along an axis
MIN_GLUED_COUNT = 3  # quadrilaterals around: with fewer, the glued mesh would be degenerate


@dataclass(frozen=True)
class Grid:
    """The rectangle low <= (x, y) <= high of a chart, and the size of its quadrilaterals.

    Attributes
    ----------
    size
        Largest side of a quadrilateral: a number, or a function (axis, coordinate across it) ->
        side.
    sides
        Names of x = low, x = high, y = low and y = high.
    glued
        Whether the two ends of each axis are one line of the surface.
    fixed_lines
        Coordinates across each axis at which there is a straight grid line.
    movable_lines
        Coordinates at which there is one too, which is moved to places nearby.
    """

    low: tuple[float, float]
    high: tuple[float, float]
    size: float | Callable[[int, float], float]
    sides: tuple[str, str, str, str] = ("left", "right", "bottom", "top")
    glued: tuple[bool, bool] = (False, False)
    fixed_lines: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())
    movable_lines: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())

    @property
    def edges(self) -> tuple[str, ...]:
        """Names of the surface's edges: the sides that are not glued."""
        names = (name for i, name in enumerate(self.sides) if not self.glued[i // 2])
        return tuple(dict.fromkeys(names))

    @property
    def corners(self) -> Array:
        """Chart coordinates (4, 2) of the corners."""
        (x0, y0), (x1, y1) = self.low, self.high
        return np.array([[x, y] for x in (x0, x1) for y in (y0, y1)])

    @property
    def cells(self) -> float:
        """Approximate number of triangles."""
        counts = [max(cumulative_count[-1], 1.0) for _, cumulative_count in self._counts]
        return float(4 * counts[0] * counts[1])

    @cached_property
    def _counts(self) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """For each axis: coordinates, and the number of quadrilaterals up to each of them."""
        return self._cumulative_count(0), self._cumulative_count(1)

    def _cumulative_count(self, axis: int) -> tuple[Array, Array]:
        """Return coordinates (k,) across an axis, and the number of quadrilaterals up to each.

        The number is the integral of one over the size, not rounded.
        """
        low, high, size = self.low[axis], self.high[axis], self.size
        if not callable(size):
            return np.array([low, high]), np.array([0.0, (high - low) / size])
        x = np.linspace(low, high, SIZE_SAMPLES, dtype=np.float64)
        # integrated by the trapezoidal rule
        per_length = 1 / np.array([size(axis, float(c)) for c in x])
        steps = (per_length[1:] + per_length[:-1]) / 2 * np.diff(x)
        return x, np.concatenate([[0.0], np.cumsum(steps)])

    def size_at(self, axis: int, x: float) -> float:
        """Return the largest distance of grid lines across an axis, at a coordinate."""
        return self.size(axis, x) if callable(self.size) else self.size

    def lines(self, axis: int, points: Sequence[Array]) -> Array:
        """Return the coordinates of the grid lines across an axis, with distances up to the size.

        Every point has a line at its coordinate, or near it where points nearly have the same
        coordinate.
        """
        low, high = self.low[axis], self.high[axis]
        # lines that must be there, each once
        movable = [line for _, line in self._movable_groups(axis, points)]
        required = np.unique([*self._straight_lines(axis), *movable])
        is_new = np.diff(required) > CHART_TOLERANCE * (high - low)
        required = required[np.concatenate([[True], is_new])]
        required[-1] = high  # which may have been dropped as equal to a line before it
        x, cumulative_count = self._counts[axis]
        # quadrilaterals up to each required line, not yet whole numbers
        counts = np.interp(required, x, cumulative_count)
        intervals = [max(int(np.ceil(b - a - COUNT_TOLERANCE)), 1) for a, b in pairwise(counts)]
        if self.glued[axis] and sum(intervals) < MIN_GLUED_COUNT:
            min_count = -(-MIN_GLUED_COUNT // len(intervals))  # rounded up
            intervals = [max(n, min_count) for n in intervals]
        # divide the interval between each two required lines into its number of quadrilaterals
        lines = [required[:1]]
        for i, n in enumerate(intervals):
            new_lines = np.linspace(required[i], required[i + 1], n + 1)[1:]
            if callable(self.size):
                # equal parts of the count: lines are dense where the size is small
                inner_counts = np.linspace(counts[i], counts[i + 1], n + 1)[1:-1]
                new_lines[:-1] = np.interp(inner_counts, cumulative_count, x)
            lines.append(new_lines)
        return np.concatenate(lines)

    def _straight_lines(self, axis: int) -> Array:
        """Return the coordinates of lines that stay where they are, with both ends."""
        low, high = self.low[axis], self.high[axis]
        lines = np.unique([low, high, *self.fixed_lines[axis]])
        is_new = np.diff(lines) > CHART_TOLERANCE * (high - low)
        return np.asarray(lines[np.concatenate([[True], is_new])])

    def straight_line_at(self, axis: int, x: float) -> float | None:
        """Return the straight line near a coordinate, which then gets no line of its own.

        None if there is no straight line so near.
        """
        lines = self._straight_lines(axis)  # fixed lines and both ends
        nearest = float(lines[np.abs(lines - x).argmin()])
        rounding = CHART_TOLERANCE * (self.high[axis] - self.low[axis])
        min_distance = max(rounding, MIN_VERTEX_DISTANCE * self.size_at(axis, x))
        return nearest if abs(nearest - x) <= min_distance else None

    def _movable_groups(self, axis: int, points: Sequence[Array]) -> list[tuple[Array, float]]:
        """Return groups of coordinates near each other, with the coordinate of the group's line.

        They are the coordinates of points and movable lines that are near no straight line.
        """
        rounding = CHART_TOLERANCE * (self.high[axis] - self.low[axis])
        coordinates = np.unique([*(float(x[axis]) for x in points), *self.movable_lines[axis]])
        movable = np.array(
            [x for x in coordinates if self.straight_line_at(axis, float(x)) is None]
        )
        groups = list[tuple[Array, float]]()
        for group in grouped_by_distance(movable, lambda x: self.size_at(axis, x), rounding):
            is_one_place = np.ptp(group) <= rounding
            line = group[0] if is_one_place else (group[0] + group[-1]) / 2
            groups.append((group, float(line)))
        return groups

    def vertices_of(self, points: Sequence[Array]) -> NDArray[np.int64]:
        """Return the numbers (n, 2) of the two grid lines that cross at the vertex of each point.

        The first and the last line of a glued axis are one; it has the number 0.
        """
        numbers = np.zeros((len(points), 2), dtype=np.int64)
        for axis in range(2):
            lines, groups = self.lines(axis, points), self._movable_groups(axis, points)
            for i, point in enumerate(points):
                x = float(point[axis])
                line = self.straight_line_at(axis, x)
                if line is None:  # the line of the point's group
                    line = next(line for group, line in groups if group[0] <= x <= group[-1])
                number = int(np.abs(lines - line).argmin())
                is_second_end = self.glued[axis] and number == len(lines) - 1
                numbers[i, axis] = 0 if is_second_end else number
        return numbers


def grid_mesh(grid: Grid, points: Mapping[str, Array], embedding: Embedding) -> PatchMesh:
    """Triangulate a grid, with the named points (2,) among its vertices.

    Each quadrilateral is divided into four triangles, which meet at its centre.

    Raises
    ------
    MeshError
        If a point lies outside, or two take one vertex.
    """
    extent = np.subtract(grid.high, grid.low)
    tolerance = CHART_TOLERANCE * extent
    for name, point in points.items():
        if (point < grid.low - tolerance).any() or (point > grid.high + tolerance).any():
            raise MeshError(f"the point {name} is not on the surface")
    # vertices (n + 1, m + 1, 2) of the quadrilaterals, and their centres (n, m, 2)
    x, y = (grid.lines(axis, list(points.values())) for axis in range(2))
    n, m = len(x) - 1, len(y) - 1  # quadrilaterals along both axes
    vertices = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    _move_to_points(vertices, grid, points)
    centres = (vertices[:-1, :-1] + vertices[1:, 1:]) / 2
    nodes = np.concatenate([vertices.reshape(-1, 2), centres.reshape(-1, 2)])
    # their numbers: all vertices first, then all centres
    vertex_count = (n + 1) * (m + 1)
    number = np.arange(vertex_count).reshape(n + 1, m + 1)
    centre = vertex_count + np.arange(n * m).reshape(n, m)
    # corners of each quadrilateral, counter-clockwise; a triangle has two of them and the centre
    corners = [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]]
    cells = np.concatenate(
        [
            np.stack([corners[i], corners[(i + 1) % 4], centre], axis=-1).reshape(-1, 3)
            for i in range(4)
        ]
    )
    # the last line of a glued axis is the first one
    representative = np.arange(len(nodes))
    if grid.glued[0]:
        representative[number[-1]] = representative[number[0]]
    if grid.glued[1]:
        representative[number[:, -1]] = representative[number[:, 0]]
    # edges, in the order of `Grid.sides`
    edges: dict[str, NDArray[np.int64]] = {}
    numbers_of_sides = (number[0], number[-1], number[:, 0], number[:, -1])
    for name, numbers in zip(grid.sides, numbers_of_sides, strict=True):
        if name in grid.edges:  # two sides may have one name
            pairs = representative[np.stack([numbers[:-1], numbers[1:]], axis=-1)]
            edges[name] = np.concatenate([edges[name], pairs]) if name in edges else pairs
    return PatchMesh(nodes, cells, embedding, edges, dict(points), representative=representative)


def _move_to_points(vertices: Array, grid: Grid, points: Mapping[str, Array]) -> None:
    """Move vertices (n, m, 2) to the named points whose grid lines are not exactly there.

    Raises
    ------
    MeshError
        If two points take one vertex, or one would move a straight line.
    """
    extent, places = np.subtract(grid.high, grid.low), list(points.values())
    # (i, j) of a vertex -> name and place of the first point that takes it
    point_of_vertex = dict[tuple[int, int], tuple[str, Array]]()
    vertex_of_point = grid.vertices_of(places)  # (points, 2) numbers i and j

    def shortest(difference: Array) -> Array:
        """Return a difference (2,) of places; across glued ends the shorter way counts."""
        whole_turns = np.where(grid.glued, np.round(difference / extent) * extent, 0.0)
        return np.asarray(difference - whole_turns)

    for number, (name, place) in enumerate(points.items()):
        i, j = int(vertex_of_point[number, 0]), int(vertex_of_point[number, 1])
        first_name, first_place = point_of_vertex.setdefault((i, j), (name, place))
        offset = shortest(place - vertices[i, j])  # by which the vertex is moved
        distance = shortest(place - first_place)
        if (np.abs(distance) > CHART_TOLERANCE * extent).any():
            raise MeshError(
                f"the points {first_name} and {name} are too near to each other "
                "for the elements there"
            )
        # a straight line stays, but the ends of a glued axis may be bent
        for axis in range(2):
            line = grid.straight_line_at(axis, float(place[axis]))
            is_glued_end = grid.glued[axis] and line in (grid.low[axis], grid.high[axis])
            if abs(offset[axis]) <= CHART_TOLERANCE * extent[axis]:
                offset[axis] = 0.0
            elif line is not None and not is_glued_end:
                raise MeshError(f"the point {name} is too near to an edge or a plane of symmetry")
        # a vertex on a glued end stands at both ends
        rows = (0, -1) if grid.glued[0] and i == 0 else (i,)
        columns = (0, -1) if grid.glued[1] and j == 0 else (j,)
        if first_name == name:  # equal points move their vertex once
            for vertex in product(rows, columns):
                vertices[vertex] += offset


@dataclass(frozen=True)
class RimmedGrid:
    """A grid's rectangle with closed curves that element edges follow, for gmsh to triangulate.

    It has the methods of a `PlaneShape`.

    Attributes
    ----------
    rims
        Points (n, 2) of each curve.
    half
        False: the rectangle is that of the modelled part itself.
    """

    grid: Grid
    rims: tuple[Array, ...]
    half: bool = False

    @property
    def extent(self) -> Array:
        """Lengths (2,) of the sides of the rectangle."""
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
    def glued(self) -> tuple[GluedSides, ...]:
        """For each axis with glued ends: the axis, and the coordinates of both ends."""
        return tuple(
            (i, self.grid.low[i], self.grid.high[i]) for i in range(2) if self.grid.glued[i]
        )

    def faces(self, occ: Any) -> Faces:
        """Make the rectangle, the rims with images across glued sides, and the grid lines.

        The lines are the fixed and the movable ones.

        Parameters
        ----------
        occ
            gmsh's geometry kernel, `gmsh.model.occ`.
        """
        grid = self.grid
        (x0, y0), (x1, y1) = grid.low, grid.high

        def rectangle() -> tuple[int, int]:
            """Make the rectangle and return its dimension and tag."""
            return 2, occ.addRectangle(x0, y0, 0, x1 - x0, y1 - y0)

        # a rim across a glued side continues at the opposite side: images are shifted by the extent
        steps = [(-1, 0, 1) if glued else (0,) for glued in grid.glued]
        rims_and_images = [
            points + np.multiply(step, self.extent)
            for points in self.rims
            for step in product(*steps)
        ]
        # rims of which a part is inside the rectangle, by their bounding boxes
        rims_inside = list[Array]()
        for points in rims_and_images:
            begins_inside = (points.min(axis=0) < grid.high).all()
            if (points.max(axis=0) > grid.low).all() and begins_inside:
                rims_inside.append(points)
        surfaces = [rectangle(), *faces_within(occ, rims_inside, rectangle)]
        # grid lines inside the rectangle, each from one side to the other
        for axis, other_axis in ((0, 1), (1, 0)):
            for coordinate in (*grid.fixed_lines[axis], *grid.movable_lines[axis]):
                if not grid.low[axis] < coordinate < grid.high[axis]:
                    continue
                ends = np.array([grid.low, grid.high])
                ends[:, axis] = coordinate
                ends[:, other_axis] = (grid.low[other_axis], grid.high[other_axis])
                surfaces.append((1, occ.addLine(*(occ.addPoint(*end, 0) for end in ends))))
        return surfaces

    def on_edges(self, x: Array) -> dict[str, NDArray[np.bool_]]:
        """Return name of an edge -> whether points x (n, 2) lie on it; glued sides are left out."""
        edges = dict[str, NDArray[np.bool_]]()
        for i, name in enumerate(self.grid.sides):
            # sides are in the order x = low, x = high, y = low, y = high
            axis, end = i // 2, (self.grid.low, self.grid.high)[i % 2]
            if name in self.grid.edges and not self.grid.glued[axis]:
                on_side = np.abs(x[:, axis] - end[axis]) < CHART_TOLERANCE * self.reach
                edges[name] = edges[name] | on_side if name in edges else on_side
        return edges

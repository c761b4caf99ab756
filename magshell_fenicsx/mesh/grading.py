"""Element size over a surface: small where the solution varies over the length sqrt(Rh).

A `Grading` is the least size that its features ask for: discs, rings, lines and squares of a chart
with small elements, which grow away from there. It gives the size at a point, the distance of grid
lines, and an estimate of the number of triangles.

The size of an element is the length of its sides. The growth of a feature is the increase of the
size per distance from it. Points and coordinates are those of a chart of the surface; a grid line
across axis 0 (or 1) is the line of one first (or second) coordinate. h and R are thickness and
reference length. Lengths are over R.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, log1p, pi, sqrt
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.shapes import DiscShape, PlaneShape

Array = NDArray[np.float64]
Size = Callable[[Array], float]
PER_AREA = 4 / sqrt(3)  # triangles of size one per unit area
# distance over the size, at which triangles are seen to take their size: sizes grow, and triangles
# do not overshoot them
SIZE_SAMPLING_DISTANCE = 0.4
# cells of an estimate are not divided whose triangles differ less over their own number, or over
# that of all
CELL_TOLERANCE, TOTAL_TOLERANCE = 0.5, 1e-5
MIN_CELL_BUDGET = 1000  # cells that any estimate may have
MAX_SIZE_EVALUATIONS = 5_000_000  # of single features in an estimate
STANDARD_GROWTH = 0.4  # of the size per distance
RADIAL_CELLS, ANGULAR_CELLS = 8, 24  # first cells of the estimate of a disc
CELLS_OF_REACH = 8  # first cells of the estimate of other shapes, along their extent


class Feature(Protocol):
    """A place in a chart with small elements around it."""

    @property
    def size(self) -> float:
        """The least element size."""

    def line_spacing(self, axis: int, x: float) -> float:
        """Return the largest distance of grid lines across an axis, at a coordinate."""

    def __call__(self, x: Array) -> float:
        """Return the largest element size at a point (2,) of the chart."""

    def size_bound(self, x: Array, distance: Array) -> Array:
        """Return bounds (n,) of the sizes near points.

        Parameters
        ----------
        x
            (n, 2) points of the chart.
        distance
            (n,); positive: bound is the largest size within this distance of the point; negative:
            the least size within its absolute value; zero: the size itself.
        """


@dataclass(frozen=True)
class DiscFeature:
    """Elements of `size` within `radius` of `centre` (chart coordinates), growing outside.

    Attributes
    ----------
    growth
        Growth of the size per distance.
    """

    centre: tuple[float, float]
    radius: float
    size: float
    growth: float

    def __call__(self, x: Array) -> float:
        distance = np.hypot(x[0] - self.centre[0], x[1] - self.centre[1])
        return float(self.size + self.growth * max(0.0, distance - self.radius))

    def line_spacing(self, axis: int, x: float) -> float:
        return self.size + self.growth * max(0.0, abs(x - self.centre[axis]) - self.radius)

    def size_bound(self, x: Array, distance: Array) -> Array:
        """Return bounds (n,) of the sizes near points: upper ones for a positive distance."""
        from_centre = np.hypot(x[:, 0] - self.centre[0], x[:, 1] - self.centre[1])
        from_disc = from_centre - self.radius + distance
        return np.asarray(self.size + self.growth * np.maximum(from_disc, 0.0))

    def cells(self, reach: float) -> float:
        """Return the number of triangles up to a distance from the centre.

        It is the integral of 2 pi t/(s + g max(0, t - a))^2 over t up to `reach`, with the size s,
        the growth g and the radius a or, if that is less, the reach.
        """
        s, g, a = self.size, self.growth, min(self.radius, reach)
        outer = g * (reach - a) / s  # relative growth of the size from the disc to the reach
        ratio = outer / (1 + outer)
        # the integral from a to the reach, in closed form; up to a the size is s
        outside_disc = 2 * pi * (a / (s * g) * outer / (1 + outer) + (log1p(outer) - ratio) / g**2)
        return PER_AREA * (pi * a**2 / s**2 + outside_disc)


@dataclass(frozen=True)
class SquaresFeature:
    """Elements of given sizes within squares, growing outside.

    Attributes
    ----------
    centres
        (n, 2) of the squares, in the chart.
    halves
        (n,) half their sides.
    sizes
        (n,) element sizes.
    growth
        Growth of the size per distance.
    """

    centres: Array
    halves: Array
    sizes: Array
    growth: float = STANDARD_GROWTH

    @property
    def size(self) -> float:
        return float(self.sizes.min())

    def finer(self, refinement: float) -> "SquaresFeature":
        """Return the squares with elements that are smaller by a factor."""
        return replace(self, sizes=np.asarray(self.sizes / refinement, dtype=np.float64))

    def __call__(self, x: Array) -> float:
        offsets = np.maximum(np.abs(x - self.centres) - self.halves[:, None], 0.0)
        return float((self.sizes + self.growth * np.hypot(*offsets.T)).min())

    def line_spacing(self, axis: int, x: float) -> float:
        distances = np.maximum(np.abs(x - self.centres[:, axis]) - self.halves, 0.0)
        return float((self.sizes + self.growth * distances).min())

    def size_bound(self, x: Array, distance: Array) -> Array:
        """Return bounds (n,) of the sizes near points: upper ones for a positive distance.

        Every square is considered for every point.
        """
        offsets = np.abs(x[:, None] - self.centres) - self.halves[:, None]
        # negative inside a square: less the distance to its nearest side
        depth = np.minimum(offsets.max(axis=-1), 0.0)
        distance_outside = np.hypot(*np.moveaxis(np.maximum(offsets, 0.0), -1, 0))
        from_squares = distance_outside + depth + distance[:, None]
        return np.asarray((self.sizes + self.growth * np.maximum(from_squares, 0.0)).min(axis=1))

    def cells(self, reach: float) -> float:
        """Return the estimated number of triangles up to a distance from the squares.

        It is the number in the squares, and around a disc of their area with the least size.
        """
        area, least_size, growth = 4 * self.halves**2, self.size, self.growth
        disc = DiscFeature((0.0, 0.0), sqrt(float(area.sum()) / pi), least_size, growth)
        # without those in the disc itself, which the squares have
        cells_within = disc.cells(min(disc.radius, reach))
        cells_outside = max(disc.cells(reach) - cells_within, 0.0)
        return float(PER_AREA * (area / self.sizes**2).sum() + cells_outside)


@dataclass(frozen=True)
class RingFeature:
    """Elements of `size` at the distance `radius` from the origin of the chart, growing away.

    Attributes
    ----------
    growth
        Growth of the size per distance.
    """

    radius: float
    size: float
    growth: float

    def __call__(self, x: Array) -> float:
        return float(self.size + self.growth * abs(np.hypot(x[0], x[1]) - self.radius))

    def line_spacing(self, axis: int, x: float) -> float:
        return inf  # a ring belongs to discs, which are no grids

    def size_bound(self, x: Array, distance: Array) -> Array:
        """Return bounds (n,) of the sizes near points: upper ones for a positive distance."""
        from_ring = np.abs(np.hypot(x[:, 0], x[:, 1]) - self.radius) + distance
        return np.asarray(self.size + self.growth * np.maximum(from_ring, 0.0))


@dataclass(frozen=True)
class LineFeature:
    """Elements of `size` at the line x[axis] = place of a grid, growing away.

    Attributes
    ----------
    growth
        Growth of the size per distance.
    """

    axis: int
    place: float
    size: float
    growth: float

    def __call__(self, x: Array) -> float:
        return self.line_spacing(self.axis, float(x[self.axis]))

    def line_spacing(self, axis: int, x: float) -> float:
        return self.size + self.growth * abs(x - self.place) if axis == self.axis else inf

    def size_bound(self, x: Array, distance: Array) -> Array:
        """Return bounds (n,) of the sizes near points: upper ones for a positive distance."""
        from_line = np.abs(x[:, self.axis] - self.place) + distance
        return np.asarray(self.size + self.growth * np.maximum(from_line, 0.0))


@dataclass(frozen=True)
class Grading:
    """The element size of a surface: the least size of all features, at most `largest`.

    Calling it with a point (2,) of the chart returns the size there.
    """

    features: Sequence[Feature]
    largest: float

    def __call__(self, x: Array) -> float:
        """Return the element size at a point (2,) of the chart."""
        centres, radii, sizes, growths = self._discs
        distances = np.maximum(0.0, np.hypot(*(x - centres).T) - radii)
        sizes_of_discs = sizes + growths * distances
        sizes_of_others = (
            feature(x) for feature in self.features if not isinstance(feature, DiscFeature)
        )
        return float(min([self.largest, sizes_of_discs.min(initial=inf), *sizes_of_others]))

    @cached_property
    def _discs(self) -> tuple[Array, ...]:
        """Centres (n, 2), radii, sizes and growths (n,) of the discs: there may be hundreds."""
        discs = [f for f in self.features if isinstance(f, DiscFeature)]
        rows = np.array([[*f.centre, f.radius, f.size, f.growth] for f in discs]).reshape(-1, 5)
        columns = rows.T
        return columns[:2].T, *columns[2:]

    def line_spacing(self, axis: int, x: float) -> float:
        """Return the largest distance of grid lines across an axis, at a coordinate."""
        return min([self.largest, *(feature.line_spacing(axis, x) for feature in self.features)])

    def cells(self, shape: PlaneShape) -> float:
        """Return the approximate number of triangles in a shape.

        It is the integral of one over the square of the size, over cells of the shape that are
        divided until the size varies little in each.
        """
        # how many cells may be looked at: each takes an evaluation of every feature
        feature_count = sum(
            len(f.halves) if isinstance(f, SquaresFeature) else 1 for f in self.features
        )
        budget = max(MIN_CELL_BUDGET, MAX_SIZE_EVALUATIONS // max(1, feature_count))
        # each round adds the triangles of cells in which the size varies little, and goes on with
        # the quarters of all other cells
        undivided_cells, total = _EstimateCells.of_shape(shape), 0.0
        while len(undivided_cells.low):
            centres, area, radius = undivided_cells.centres_areas_radii()
            # sizes at the centres, and their upper and lower bounds in the cells
            sizes, max_sizes, min_sizes = (
                self._size_bound(centres, factor * radius) for factor in (0.0, 1.0, -1.0)
            )
            # number of triangles, over `PER_AREA`: each takes the least size nearby, since sizes
            # grow and triangles do not overshoot them
            triangles = area / self._size_bound(centres, -SIZE_SAMPLING_DISTANCE * sizes) ** 2
            # the number of triangles in a cell lies between bounds, by the bounds of its size
            uncertainty = area / min_sizes**2 - area / max_sizes**2
            divided = (uncertainty > CELL_TOLERANCE * triangles) & (
                uncertainty > TOTAL_TOLERANCE * (total + triangles.sum())
            )
            if divided.sum() * 4 > budget:  # too many cells to look at: all are taken as they are
                divided[:] = False
            total += float(triangles[~divided].sum())
            undivided_cells, budget = undivided_cells.quarters(divided), budget - len(divided)
        # where a strip is narrower than a triangle, its length decides instead of its area
        along_thin_strip = 2 * shape.reach / self.largest
        return PER_AREA * total + along_thin_strip

    def _size_bound(self, x: Array, distance: Array) -> Array:
        """Return bounds (n,) of the element sizes within distances (n,) of points x (n, 2).

        Positive distances give upper bounds, negative ones lower bounds, zero the sizes themselves.
        """
        sizes = np.full(len(x), self.largest)
        for feature in self.features:
            np.minimum(sizes, feature.size_bound(x, distance), out=sizes)
        return sizes


@dataclass(frozen=True)
class _EstimateCells:
    """Rectangular cells of a shape, over which the number of triangles is estimated.

    Attributes
    ----------
    low, high
        (n, 2) lower and upper coordinates of the cells.
    polar
        Whether the coordinates are radius and angle, as for a disc; else those of the chart.
    """

    low: Array
    high: Array
    polar: bool

    @classmethod
    def of_shape(cls, shape: PlaneShape) -> "_EstimateCells":
        """Return the first cells of a shape, which are divided later."""
        polar = isinstance(shape, DiscShape)
        low, high = shape.box
        if polar:
            counts = np.array([RADIAL_CELLS, ANGULAR_CELLS // 2 if shape.half else ANGULAR_CELLS])
        else:
            counts = np.maximum(1, np.ceil(CELLS_OF_REACH * (high - low) / shape.reach))
        # lower and upper coordinates of the cells along each axis, then of all cells
        bounds_by_axis = [
            np.linspace(a, b, int(n) + 1) for a, b, n in zip(low, high, counts, strict=True)
        ]
        lower_by_axis = [bounds[:-1] for bounds in bounds_by_axis]
        upper_by_axis = [bounds[1:] for bounds in bounds_by_axis]
        low, high = (
            np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
            for axes in (lower_by_axis, upper_by_axis)
        )
        return cls(low, high, polar)

    def centres_areas_radii(self) -> tuple[Array, Array, Array]:
        """Return centres (n, 2) in the chart, areas (n,), and half diagonals (n,)."""
        middle, (width, height) = (self.low + self.high) / 2, (self.high - self.low).T
        if not self.polar:
            return middle, width * height, np.hypot(width, height) / 2
        r, angle = middle.T
        # area r dr dangle; the half diagonal with the arc at the outer radius
        x = r[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        return x, r * width * height, np.hypot(width, self.high[:, 0] * height) / 2

    def quarters(self, divided: NDArray[np.bool_]) -> "_EstimateCells":
        """Return the four quarters of each cell that is to be divided."""
        low, half_sides = self.low[divided], (self.high - self.low)[divided] / 2
        low = np.concatenate(
            [low + half_sides * corner for corner in ([0, 0], [0, 1], [1, 0], [1, 1])]
        )
        return _EstimateCells(low, low + np.tile(half_sides, (4, 1)), self.polar)

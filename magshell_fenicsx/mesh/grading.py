"""Element size over a surface: small where the solution varies over the length sqrt(Rh)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, log1p, pi, sqrt
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.shapes import Shape

Size = Callable[[NDArray[np.float64]], float]
PER_AREA = 4 / sqrt(3)  # triangles of size one per unit area


class Feature(Protocol):
    """A place with small elements around it."""

    @property
    def size(self) -> float:
        """The smallest."""

    def across(self, axis: int, x: float) -> float:
        """Wanted distance of grid lines across an axis, at a coordinate."""

    def __call__(self, x: NDArray[np.float64]) -> float:
        """Wanted element size at a point of the chart."""

    def cells(self, reach: float) -> float:
        """Approximate number of elements up to the distance `reach` from the place."""


@dataclass(frozen=True)
class Disc:
    """Elements of `size` within `radius` of `centre` (chart coordinates), growing outside."""

    centre: tuple[float, float]
    radius: float
    size: float
    growth: float

    def __call__(self, x: NDArray[np.float64]) -> float:
        distance = np.hypot(x[0] - self.centre[0], x[1] - self.centre[1])
        return float(self.size + self.growth * max(0.0, distance - self.radius))

    def across(self, axis: int, x: float) -> float:
        return self.size + self.growth * max(0.0, abs(x - self.centre[axis]) - self.radius)

    def cells(self, reach: float) -> float:
        """Integral of 2 pi t/(s + g max(0, t - a))^2 over t, a the radius or, if that is less, the reach."""
        s, g, a = self.size, self.growth, min(self.radius, reach)
        outer = g * (reach - a) / s
        around = 2 * pi * (a / (s * g) * outer / (1 + outer) + (log1p(outer) - outer / (1 + outer)) / g**2)
        return PER_AREA * (pi * a**2 / s**2 + around)


@dataclass(frozen=True)
class Squares:
    """Elements of some sizes (n,) within squares with `centres` (n, 2) and half sides (n,), growing outside."""

    centres: NDArray[np.float64]
    halves: NDArray[np.float64]
    sizes: NDArray[np.float64]
    growth: float = 0.4

    @property
    def size(self) -> float:
        return float(self.sizes.min())

    def finer(self, refinement: float) -> "Squares":
        """With elements that are smaller by a factor."""
        return replace(self, sizes=np.asarray(self.sizes / refinement, dtype=np.float64))

    def __call__(self, x: NDArray[np.float64]) -> float:
        away = np.maximum(np.abs(x - self.centres) - self.halves[:, None], 0.0)
        return float((self.sizes + self.growth * np.hypot(*away.T)).min())

    def across(self, axis: int, x: float) -> float:
        away = np.maximum(np.abs(x - self.centres[:, axis]) - self.halves, 0.0)
        return float((self.sizes + self.growth * away).min())

    def cells(self, reach: float) -> float:
        """Those in the squares, and around a disc of their area."""
        area, s, g = 4 * self.halves**2, self.size, self.growth
        disc = Disc((0.0, 0.0), sqrt(float(area.sum()) / pi), s, g)
        within = Disc((0.0, 0.0), disc.radius, s, g).cells(min(disc.radius, reach))
        return float(PER_AREA * (area / self.sizes**2).sum() + max(disc.cells(reach) - within, 0.0))


@dataclass(frozen=True)
class Ring:
    """Elements of `size` at the distance `radius` from the origin of the chart, growing away."""

    radius: float
    size: float
    growth: float

    def __call__(self, x: NDArray[np.float64]) -> float:
        return float(self.size + self.growth * abs(np.hypot(x[0], x[1]) - self.radius))

    def across(self, axis: int, x: float) -> float:
        return inf  # a ring belongs to discs, which are no grids

    def cells(self, reach: float) -> float:
        """Number on the inner side alone: the outer side lies beyond the edge."""
        return PER_AREA * 2 * pi * self.radius * reach / (self.size * (self.size + self.growth * reach))


@dataclass(frozen=True)
class Line:
    """Elements of `size` at the line x[axis] = place of a grid, growing away."""

    axis: int
    place: float
    size: float
    growth: float

    def __call__(self, x: NDArray[np.float64]) -> float:
        return self.across(self.axis, float(x[self.axis]))

    def across(self, axis: int, x: float) -> float:
        return self.size + self.growth * abs(x - self.place) if axis == self.axis else inf

    def cells(self, reach: float) -> float:
        """Number in a square with the side `reach`."""
        return PER_AREA * reach**2 / (self.size * (self.size + self.growth * reach))


@dataclass(frozen=True)
class Grading:
    """The smallest size of all features, at most `largest`."""

    features: Sequence[Feature]
    largest: float

    def __call__(self, x: NDArray[np.float64]) -> float:
        centre, radius, size, growth = self._discs
        around = size + growth * np.maximum(0.0, np.hypot(*(x - centre).T) - radius)
        others = (feature(x) for feature in self.features if not isinstance(feature, Disc))
        return float(min([self.largest, around.min(initial=inf), *others]))

    @cached_property
    def _discs(self) -> tuple[NDArray[np.float64], ...]:
        """Centres (n, 2), radii, sizes and growths (n,): there may be hundreds."""
        discs = [f for f in self.features if isinstance(f, Disc)]
        numbers = np.array([[*f.centre, f.radius, f.size, f.growth] for f in discs]).reshape(-1, 5).T
        return numbers[:2].T, *numbers[2:]

    def across(self, axis: int, x: float) -> float:
        """Wanted distance of grid lines, see `Feature`."""
        return min([self.largest, *(feature.across(axis, x) for feature in self.features)])

    def cells(self, shape: Shape) -> float:
        """Approximate number of triangles in a shape; the overlap of features makes it too large, at most by half."""
        share = 0.5 if shape.half else 1.0  # features lie on the mirror line
        around = share * sum(feature.cells(shape.reach) for feature in self.features)
        inner, outer = PER_AREA * shape.area / self.largest**2, 2 * shape.reach / self.largest  # of a thin strip
        finest = min([self.largest, *(feature.size for feature in self.features)])
        return min(inner + outer + around, outer + PER_AREA * shape.area / finest**2)

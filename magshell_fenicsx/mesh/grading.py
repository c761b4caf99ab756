"""Element size over a surface: small where the solution varies over the length sqrt(Rh)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, log1p, pi, sqrt
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.shapes import DiscShape, Shape

Size = Callable[[NDArray[np.float64]], float]
PER_AREA = 4 / sqrt(3)  # triangles of size one per unit area
# of the size, from where triangles are seen to take theirs: sizes grow, and they do not overshoot
# them
TOWARDS = 0.4
ALIKE, ENOUGH = (
    0.5,
    1e-5,
)  # parts whose numbers of triangles differ less, over their own and over all, are not divided
MOST_PARTS, MOST_SIZES = (
    1000,
    5_000_000,
)  # parts of an estimate, and sizes that they need from all features


class Feature(Protocol):
    """A place with small elements around it."""

    @property
    def size(self) -> float:
        """The smallest."""

    def across(self, axis: int, x: float) -> float:
        """Wanted distance of grid lines across an axis, at a coordinate."""

    def __call__(self, x: NDArray[np.float64]) -> float:
        """Wanted element size at a point of the chart."""

    def bound(self, x: NDArray[np.float64], away: NDArray[np.float64]) -> NDArray[np.float64]:
        """Bounds of the sizes at most `away` (n,) from points (n, 2): the largest, of negative ones
        the least.
        """


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

    def bound(self, x: NDArray[np.float64], away: NDArray[np.float64]) -> NDArray[np.float64]:
        beyond = np.hypot(x[:, 0] - self.centre[0], x[:, 1] - self.centre[1]) - self.radius + away
        return np.asarray(self.size + self.growth * np.maximum(beyond, 0.0))

    def cells(self, reach: float) -> float:
        """Number up to the distance `reach`: the integral of 2 pi t/(s + g max(0, t - a))^2 over t.

        a is the radius or, if that is less, the reach.
        """
        s, g, a = self.size, self.growth, min(self.radius, reach)
        outer = g * (reach - a) / s
        around = (
            2
            * pi
            * (a / (s * g) * outer / (1 + outer) + (log1p(outer) - outer / (1 + outer)) / g**2)
        )
        return PER_AREA * (pi * a**2 / s**2 + around)


@dataclass(frozen=True)
class Squares:
    """Elements of some sizes (n,) within squares with `centres` (n, 2) and half sides (n,), growing
    outside.
    """

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

    def bound(self, x: NDArray[np.float64], away: NDArray[np.float64]) -> NDArray[np.float64]:
        beyond = np.abs(x[:, None] - self.centres) - self.halves[:, None]
        inwards = np.minimum(beyond.max(axis=-1), 0.0)
        beyond = np.hypot(*np.moveaxis(np.maximum(beyond, 0.0), -1, 0)) + inwards + away[:, None]
        return np.asarray((self.sizes + self.growth * np.maximum(beyond, 0.0)).min(axis=1))

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

    def bound(self, x: NDArray[np.float64], away: NDArray[np.float64]) -> NDArray[np.float64]:
        beyond = np.abs(np.hypot(x[:, 0], x[:, 1]) - self.radius) + away
        return np.asarray(self.size + self.growth * np.maximum(beyond, 0.0))


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

    def bound(self, x: NDArray[np.float64], away: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(
            self.size + self.growth * np.maximum(np.abs(x[:, self.axis] - self.place) + away, 0.0)
        )


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
        numbers = (
            np.array([[*f.centre, f.radius, f.size, f.growth] for f in discs]).reshape(-1, 5).T
        )
        return numbers[:2].T, *numbers[2:]

    def across(self, axis: int, x: float) -> float:
        """Wanted distance of grid lines, see `Feature`."""
        return min([self.largest, *(feature.across(axis, x) for feature in self.features)])

    def cells(self, shape: Shape) -> float:
        """Approximate number of triangles in a shape: the integral of one over the square of the
        least size.

        Over parts of the shape, which are divided until the sizes in each are nearly alike.
        """
        most = max(
            MOST_PARTS,
            MOST_SIZES
            // max(1, sum(len(f.halves) if isinstance(f, Squares) else 1 for f in self.features)),
        )
        parts, cells = _Parts.first(shape), 0.0
        while len(parts.low):
            x, area, away = parts.measured()
            sizes, largest, least = (self._bound(x, factor * away) for factor in (0.0, 1.0, -1.0))
            now = area / self._bound(x, -TOWARDS * sizes) ** 2
            rough = area / least**2 - area / largest**2
            again = (rough > ALIKE * now) & (rough > ENOUGH * (cells + now.sum()))
            if again.sum() * 4 > most:
                again[:] = False
            cells += float(now[~again].sum())
            parts, most = parts.quarters(again), most - len(again)
        return PER_AREA * cells + 2 * shape.reach / self.largest  # of a thin strip

    def _bound(self, x: NDArray[np.float64], away: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Feature`; of all of them."""
        sizes = np.full(len(x), self.largest)
        for feature in self.features:
            np.minimum(sizes, feature.bound(x, away), out=sizes)
        return sizes


@dataclass(frozen=True)
class _Parts:
    """Parts of a shape between coordinates `low` and `high` (n, 2): of a disc polar ones, else
    those of the chart.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    polar: bool

    @classmethod
    def first(cls, shape: Shape) -> "_Parts":
        polar = isinstance(shape, DiscShape)
        low, high = shape.box
        number = (
            (8, 12 if shape.half else 24)
            if polar
            else np.maximum(1, np.ceil(8 * (high - low) / shape.reach))
        )
        t = [np.linspace(a, b, int(n) + 1) for a, b, n in zip(low, high, number, strict=True)]
        low, high = (
            np.stack(np.meshgrid(*each, indexing="ij"), axis=-1).reshape(-1, 2)
            for each in ([v[:-1] for v in t], [v[1:] for v in t])
        )
        return cls(low, high, polar)

    def measured(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Their centres in the chart (n, 2), areas, and largest distances from the centres (n,)."""
        middle, (width, height) = (self.low + self.high) / 2, (self.high - self.low).T
        if not self.polar:
            return middle, width * height, np.hypot(width, height) / 2
        r, angle = middle.T
        x = r[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        return x, r * width * height, np.hypot(width, self.high[:, 0] * height) / 2

    def quarters(self, chosen: NDArray[np.bool_]) -> "_Parts":
        """Those of some."""
        low, half = self.low[chosen], (self.high - self.low)[chosen] / 2
        low = np.concatenate([low + half * corner for corner in ([0, 0], [0, 1], [1, 0], [1, 1])])
        return _Parts(low, low + np.tile(half, (4, 1)), self.polar)

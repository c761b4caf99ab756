"""Element size over a surface: small where the shell's own length sqrt(Rh) shows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Size = Callable[[NDArray[np.float64]], float]


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


@dataclass(frozen=True)
class Ring:
    """Elements of `size` at the distance `radius` from the origin of the chart, growing away."""

    radius: float
    size: float
    growth: float

    def __call__(self, x: NDArray[np.float64]) -> float:
        return float(self.size + self.growth * abs(np.hypot(x[0], x[1]) - self.radius))


def smallest(features: Sequence[Size], largest: float) -> Size:
    """The size that satisfies every feature, and nowhere above `largest`."""
    return lambda x: min([largest, *(feature(x) for feature in features)])

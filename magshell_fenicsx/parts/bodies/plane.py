"""The distance from a plane."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.bodies.plane import PlaneSection
from magshell_fenicsx.parts.bodies.placed import Placed
from magshell_fenicsx.shape.lines import SEEN, frame

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Plane:
    """A `Distance`: the body is behind `front`, seen along the unit vector `along`."""

    front: Array
    along: Array

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        n = np.broadcast_to(self.along, x.shape)
        return (x - self.front) @ self.along, n, np.zeros((len(x), 3, 3))

    @property
    def lines(self) -> list[Array]:
        """Its outline: places (n, 3) along lines, over R."""
        square = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [1, 1, 0]])
        return [self.front + SEEN * square @ frame(self.along).T]


def plane(section: PlaneSection, placed: Placed) -> Plane:
    """See `Placed`."""
    return Plane(placed.front, placed.direction)

"""The distance from a sphere."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.bodies.sphere import SphereSection
from magshell_fenicsx.parts.bodies.placed import Placed
from magshell_fenicsx.shape.lines import ball

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sphere:
    """A `Distance`."""

    centre: Array
    radius: float

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        r = x - self.centre
        far = np.maximum(np.linalg.norm(r, axis=1), 1e-300)
        n = r / far[:, None]
        return far - self.radius, n, (np.eye(3) - n[:, :, None] * n[:, None, :]) / far[:, None, None]

    @property
    def lines(self) -> list[Array]:
        """Its outline: places (n, 3) along lines, over R."""
        return [self.centre + line for line in ball(self.radius)]


def sphere(section: SphereSection, placed: Placed) -> Sphere:
    """See `Placed`."""
    return Sphere(placed.centre, section.radius / placed.R)

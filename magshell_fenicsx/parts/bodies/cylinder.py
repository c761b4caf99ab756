"""The distance from the round side of a cylinder."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.bodies.cylinder import CylinderSection
from magshell_fenicsx.parts.bodies.placed import Placed
from magshell_fenicsx.parts.bodies.sphere import Sphere
from magshell_fenicsx.shape.lines import SEEN, frame, upright

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cylinder:
    """A `Distance`: that of a sphere, of places without their part along the unit vector `axis`."""

    centre: Array
    axis: Array
    radius: float

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        across = np.eye(3) - np.outer(self.axis, self.axis)
        g, n, N = Sphere(np.zeros(3), self.radius)((x - self.centre) @ across)
        return g, n, across @ N @ across

    @property
    def lines(self) -> list[Array]:
        """Its outline: places (n, 3) along lines, over R."""
        return [self.centre + line @ frame(self.axis).T for line in upright(self.radius, 2 * SEEN)]


def cylinder(section: CylinderSection, placed: Placed) -> Cylinder:
    """See `Placed`."""
    return Cylinder(placed.centre, placed.across(section.axis), section.radius / placed.R)

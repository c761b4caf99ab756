"""The distance from a box with rounded edges."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.bodies.box import BoxSection
from magshell_fenicsx.parts.bodies.placed import Placed
from magshell_fenicsx.parts.bodies.rounded import rounded
from magshell_fenicsx.shape.lines import edges

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Box:
    """A `Distance`: `axes` (3, 3) are its unit vectors as rows, `half` its half sizes along them."""

    centre: Array
    axes: Array
    half: Array
    edge: float

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        y = (x - self.centre) @ self.axes.T
        g, n, N = rounded(np.abs(y) - self.half + self.edge, self.edge)
        basis = np.where(y < 0, -1.0, 1.0)[:, :, None] * self.axes
        return g, np.einsum("na,nai->ni", n, basis), np.einsum("nai,nab,nbj->nij", basis, N, basis)

    @property
    def lines(self) -> list[Array]:
        """Its outline: places (n, 3) along lines, over R."""
        return [self.centre + line @ self.axes for line in edges(-self.half, self.half)]


def box(section: BoxSection, placed: Placed) -> Box:
    """See `Placed`."""
    half, d = np.array(section.size) / placed.R / 2, placed.direction
    first = placed.across(section.axis)
    axes = np.stack([first, np.cross(d, first), d])
    return Box(placed.centre, axes, half, section.edge / placed.R)

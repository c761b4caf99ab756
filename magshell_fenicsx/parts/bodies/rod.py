"""The distance from the flat end of a cylinder, its edge rounded."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.bodies.rod import RodSection
from magshell_fenicsx.parts.bodies.placed import Placed
from magshell_fenicsx.parts.bodies.rounded import rounded
from magshell_fenicsx.shape.lines import SEEN, frame, upright

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rod:
    """A `Distance`: the body is behind the middle `end` of its end, seen along the unit vector `along`."""

    end: Array
    along: Array
    radius: float
    edge: float

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        r, d = x - self.end, self.along
        off = r - (r @ d)[:, None] * d
        far = np.linalg.norm(off, axis=1)
        e = off / np.maximum(far, 1e-300)[:, None]
        q = np.column_stack([far - self.radius + self.edge, r @ d + self.edge])
        g, n, N = rounded(q, self.edge)
        basis = np.stack([e, np.broadcast_to(d, e.shape)], axis=1)  # d(rho, z)/dx
        around = np.eye(3) - np.outer(d, d) - e[:, :, None] * e[:, None, :]
        turned = (n[:, 0] / np.maximum(far, 1e-300))[:, None, None] * around
        H = np.einsum("nai,nab,nbj->nij", basis, N, basis) + np.where(far[:, None, None] > 0, turned, 0.0)
        return g, np.einsum("na,nai->ni", n, basis), H

    @property
    def lines(self) -> list[Array]:
        """Its outline: places (n, 3) along lines, over R."""
        middle = self.end - SEEN * self.along
        return [middle + line @ frame(self.along).T for line in upright(self.radius, 2 * SEEN)]


def rod(section: RodSection, placed: Placed) -> Rod:
    """See `Placed`."""
    return Rod(placed.front, placed.direction, section.radius / placed.R, section.edge / placed.R)

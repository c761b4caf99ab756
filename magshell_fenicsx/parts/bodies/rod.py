"""A cylinder that touches with its flat end, whose edge is rounded: its section of a case and its
signed distance.

The approach is the body's displacement along its direction; distances are those at approach zero.
Lengths are over R, in sections in the case's unit.
"""

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from magshell_fenicsx.parts.bodies.body import BodySection, Distance, PlacedBody, Size, rounded
from magshell_fenicsx.shape import drawn_bodies
from magshell_fenicsx.shape.drawn_bodies import Solid
from magshell_fenicsx.shape.reference_shell import HALF_DRAWN_EXTENT, cylinder_lines, frame_along

Array = NDArray[np.float64]


class RodSection(BodySection):
    """A cylinder along the approach with a flat end, whose edge is rounded."""

    kind: Literal["rod"]
    radius: Size
    """Its radius [the shell's length; over R if that has no unit]"""
    edge: Size
    """Radius of the edge's rounding, at most `radius` [the shell's length; over R if that has no
    unit]"""

    @model_validator(mode="after")
    def _edge_fits(self) -> Self:
        if self.edge > self.radius:
            raise ValueError("edge: a rounding is no larger than the radius")
        return self

    def distance(self, placed_body: PlacedBody) -> Distance:
        return Rod(
            placed_body.front,
            placed_body.direction,
            self.radius / placed_body.R,
            self.edge / placed_body.R,
        )


@dataclass(frozen=True)
class Rod(Distance):
    """Signed distance of a cylinder along the approach with a flat, rounded end; over R.

    Attributes
    ----------
    end
        The middle (3,) of its end.
    along
        Unit vector (3,) of the approach, out of the end.
    radius
        Radius of the cylinder.
    edge
        Radius of the edge's rounding.
    """

    end: Array
    along: Array
    radius: float
    edge: float

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        """Return signed distance (n,), gradient (n, 3), Hessian (n, 3, 3) at places x (n, 3).

        In cylinder coordinates (rho, z) the rod is a corner with a rounded edge: all that is nearer
        than `edge` to its core. The core is a sharp cylinder; its radius is smaller by `edge`, and
        its end is behind the rod's end by `edge`. In space the Hessian also has the component
        n_rho/rho around the axis.
        """
        # cylinder coordinates from the end, and those from the corner of the core
        r, d = x - self.end, self.along
        radial = r - (r @ d)[:, None] * d
        from_axis = np.linalg.norm(radial, axis=1)
        e_rho = radial / np.maximum(from_axis, 1e-300)[:, None]  # zero on the axis
        q = np.column_stack([from_axis - self.radius + self.edge, r @ d + self.edge])
        g, n, N = rounded(q, self.edge)
        # back to space; around the axis the Hessian has n_rho/rho, which counts as 0 on the axis
        basis = np.stack([e_rho, np.broadcast_to(d, e_rho.shape)], axis=1)  # d(rho, z)/dx
        circumferential = np.eye(3) - np.outer(d, d) - e_rho[:, :, None] * e_rho[:, None, :]
        by_rotation = (n[:, 0] / np.maximum(from_axis, 1e-300))[:, None, None] * circumferential
        H = np.einsum("nai,nab,nbj->nij", basis, N, basis)
        H = H + np.where(from_axis[:, None, None] > 0, by_rotation, 0.0)
        return g, np.einsum("na,nai->ni", n, basis), H

    @property
    def lines(self) -> list[Array]:
        middle = self.end - HALF_DRAWN_EXTENT * self.along
        return [
            middle + line @ frame_along(self.along).T
            for line in cylinder_lines(self.radius, 2 * HALF_DRAWN_EXTENT)
        ]

    @property
    def solid(self) -> Solid:
        return drawn_bodies.cylinder(self.radius, 2 * HALF_DRAWN_EXTENT).transformed(
            frame_along(self.along), self.end - HALF_DRAWN_EXTENT * self.along
        )

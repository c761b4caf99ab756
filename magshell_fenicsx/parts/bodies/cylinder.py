"""A cylinder that touches with its round side: its section of a case and its signed distance.

The approach is the body's displacement along its direction; distances are those at approach zero.
Lengths are over R, in sections in the case's unit.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.bodies.body import Axis, BodySection, Distance, PlacedBody, Size
from magshell_fenicsx.parts.bodies.sphere import Sphere
from magshell_fenicsx.shape import drawn_bodies
from magshell_fenicsx.shape.drawn_bodies import Solid
from magshell_fenicsx.shape.reference_shell import HALF_DRAWN_EXTENT, cylinder_lines, frame_along

Array = NDArray[np.float64]


class CylinderBodySection(BodySection):
    """A cylinder without ends, its axis across the approach."""

    kind: Literal["cylinder"]
    radius: Size
    """Its radius [the shell's length; over R if that has no unit]"""
    axis: Axis
    """Along the cylinder, of any length, not along the approach"""

    @property
    def front_offset(self) -> float:
        return self.radius

    def distance(self, placed_body: PlacedBody) -> Distance:
        return Cylinder(
            placed_body.centre, placed_body.axis_across(self.axis), self.radius / placed_body.R
        )


@dataclass(frozen=True)
class Cylinder(Distance):
    """Signed distance of a cylinder without ends; lengths are over R.

    All places are projected onto the plane through `centre` (3,) normal to the unit vector `axis`
    (3,). There it is the distance from a sphere of this radius.
    """

    centre: Array
    axis: Array
    radius: float

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        """Return signed distance (n,), gradient (n, 3), Hessian (n, 3, 3) at places x (n, 3)."""
        projection = np.eye(3) - np.outer(self.axis, self.axis)
        g, n, N = Sphere(np.zeros(3), self.radius)((x - self.centre) @ projection)
        return g, n, projection @ N @ projection

    @property
    def lines(self) -> list[Array]:
        return [
            self.centre + line @ frame_along(self.axis).T
            for line in cylinder_lines(self.radius, 2 * HALF_DRAWN_EXTENT)
        ]

    @property
    def solid(self) -> Solid:
        return drawn_bodies.cylinder(self.radius, 2 * HALF_DRAWN_EXTENT).transformed(
            frame_along(self.axis), self.centre
        )

    @property
    def mirror_vectors(self) -> Sequence[Array]:
        return [self.axis]

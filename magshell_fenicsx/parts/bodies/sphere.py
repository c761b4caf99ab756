"""A sphere: its section of a case and its signed distance, at approach zero and over R."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.bodies.body import BodySection, Distance, PlacedBody, Size
from magshell_fenicsx.shape import drawn_bodies
from magshell_fenicsx.shape.drawn_bodies import Solid
from magshell_fenicsx.shape.reference_shell import sphere_lines

Array = NDArray[np.float64]


class SphereBodySection(BodySection):
    """A ball."""

    kind: Literal["sphere"]
    radius: Size
    """Its radius [the shell's length; over R if that has no unit]"""

    @property
    def front_offset(self) -> float:
        return self.radius

    def distance(self, placed_body: PlacedBody) -> Distance:
        return Sphere(placed_body.centre, self.radius / placed_body.R)


@dataclass(frozen=True)
class Sphere(Distance):
    """Signed distance of a ball over R: the distance from its centre (3,), less its radius."""

    centre: Array
    radius: float

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        """Return signed distance (n,), gradient (n, 3), Hessian (n, 3, 3) at places x (n, 3)."""
        r = x - self.centre
        from_centre = np.maximum(np.linalg.norm(r, axis=1), 1e-300)  # a divisor, also in the centre
        n = r / from_centre[:, None]
        return (
            from_centre - self.radius,
            n,
            (np.eye(3) - n[:, :, None] * n[:, None, :]) / from_centre[:, None, None],
        )

    @property
    def lines(self) -> list[Array]:
        return [self.centre + line for line in sphere_lines(self.radius)]

    @property
    def solid(self) -> Solid:
        return drawn_bodies.globe(self.radius).transformed(np.eye(3), self.centre)

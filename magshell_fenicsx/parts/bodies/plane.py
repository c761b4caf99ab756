"""A plane: its section of a case and its signed distance, at approach zero and over R."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.bodies.body import BodySection, Distance, PlacedBody
from magshell_fenicsx.shape import drawn_bodies
from magshell_fenicsx.shape.drawn_bodies import Solid
from magshell_fenicsx.shape.reference_shell import HALF_DRAWN_EXTENT, circle_line, frame_along

Array = NDArray[np.float64]


class PlaneSection(BodySection):
    """A half-space; its face is normal to the direction of the approach."""

    kind: Literal["plane"]

    def distance(self, placed_body: PlacedBody) -> Distance:
        return Plane(placed_body.front, placed_body.direction)


@dataclass(frozen=True)
class Plane(Distance):
    """Signed distance of a half-space; lengths are over R.

    Attributes
    ----------
    front
        A place (3,) of its face.
    along
        Unit vector (3,) of the approach, out of the face towards the shell.
    """

    front: Array
    along: Array

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        """Return signed distance (n,), gradient (n, 3), Hessian (n, 3, 3) at places x (n, 3)."""
        n = np.broadcast_to(self.along, x.shape)
        return (x - self.front) @ self.along, n, np.zeros((len(x), 3, 3))

    @property
    def lines(self) -> list[Array]:
        return [self.front + circle_line(HALF_DRAWN_EXTENT) @ frame_along(self.along).T]

    @property
    def solid(self) -> Solid:
        return drawn_bodies.disc(HALF_DRAWN_EXTENT).transformed(frame_along(self.along), self.front)

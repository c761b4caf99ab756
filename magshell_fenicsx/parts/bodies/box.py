"""A box with rounded edges, a rigid body: its section of a case and its signed distance.

The approach is the body's displacement along its direction; distances are those at approach zero.
Lengths are over R, in sections in the case's unit.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from magshell_fenicsx.parts.bodies.body import (
    Axis,
    BodySection,
    Distance,
    PlacedBody,
    Size,
    rounded,
)
from magshell_fenicsx.shape import drawn_bodies
from magshell_fenicsx.shape.drawn_bodies import Solid
from magshell_fenicsx.shape.reference_shell import box_lines

Array = NDArray[np.float64]


class BoxSection(BodySection):
    """A box with rounded edges and corners."""

    kind: Literal["box"]
    size: Annotated[list[Size], Field(min_length=3, max_length=3)]
    """Along `axis`, across it and the approach, and along the approach [the shell's length; over R
    if that has no unit]"""
    edge: Size
    """Radius of the rounding, at most half of the smallest size [the shell's length; over R if that
    has no unit]"""
    axis: Axis
    """Along the first size, of any length; its part across the approach counts, and there must be
    one"""

    @property
    def front_offset(self) -> float:
        return self.size[2] / 2

    @property
    def blunt_radius(self) -> float:
        return min(self.size[:2]) / 2

    @model_validator(mode="after")
    def _edge_fits(self) -> Self:
        if 2 * self.edge > min(self.size):
            raise ValueError("edge: a rounding is at most half of the smallest size")
        return self

    def distance(self, placed_body: PlacedBody) -> Distance:
        half = np.array(self.size) / placed_body.R / 2
        return Box(placed_body.centre, placed_body.axes(self.axis), half, self.edge / placed_body.R)


@dataclass(frozen=True)
class Box(Distance):
    """Signed distance of a box with rounded edges; lengths are over R.

    Attributes
    ----------
    centre
        (3,) its middle.
    axes, half
        (3, 3) its unit vectors as rows, and (3,) half its sizes along them.
    edge
        Radius of the rounding.
    """

    centre: Array
    axes: Array
    half: Array
    edge: float

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        """Return signed distance (n,), gradient (n, 3), Hessian (n, 3, 3) at places x (n, 3)."""
        # by symmetry in the octant of positive coordinates, where the core's corner is half - edge
        y = (x - self.centre) @ self.axes.T
        from_corner = np.abs(y) - self.half + self.edge
        g, n, N = rounded(from_corner, self.edge)
        # back to space: the axes with the signs of the place's own octant
        basis = np.where(y < 0, -1.0, 1.0)[:, :, None] * self.axes
        return g, np.einsum("na,nai->ni", n, basis), np.einsum("nai,nab,nbj->nij", basis, N, basis)

    @property
    def lines(self) -> list[Array]:
        return [self.centre + line @ self.axes for line in box_lines(-self.half, self.half)]

    @property
    def solid(self) -> Solid:
        return drawn_bodies.block(self.half).transformed(self.axes.T, self.centre)

    @property
    def possible_mirror_vectors(self) -> Sequence[Array]:
        return [*self.axes]

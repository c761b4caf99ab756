"""Currents in thin wires: the section of a coil, and its field in its own axes, from magpylib.

Lengths are in m, currents in A, fields in T. A source's field is known by values; `Harmonic` takes
derivatives from them, at distances in proportion to the distance from the wire.
"""

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from magshell_fenicsx.parts.magnetism.sources.source import (
    Current,
    FieldOfSource,
    Harmonic,
    Position,
    Size,
    SourceSection,
    magpylib,
)
from magshell_fenicsx.shape.reference_shell import circle_line

Array = NDArray[np.float64]
NOWHERE = "on the wire of"  # words for places without a field


class CoilSection(SourceSection):
    """A current in a thin wire: a circle around its own z axis, or a polygon."""

    kind: Literal["coil"]
    diameter: Size | None = None
    """Of a circle [m]"""
    vertices: Annotated[list[Position], Field(min_length=2, max_length=100_000)] | None = None
    """Corners of a polygon in its own axes, in place of diameter; the first again at the end closes
    it [m]"""
    current: Current
    """By the right-hand rule about its own z axis, or along the polygon [A]"""
    turns: int = Field(default=1, ge=1, le=1_000_000)
    """Turns of the wire"""

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        """Refuse a coil without exactly one shape, or a polygon that repeats a corner."""
        if (self.diameter is None) == (self.vertices is None):
            raise ValueError("give diameter or vertices")
        if self.vertices and any(
            a == b for a, b in zip(self.vertices, self.vertices[1:], strict=False)
        ):
            raise ValueError("vertices: two of them in a row are the same place")
        return self

    def field(self, key: str, R: float) -> FieldOfSource:
        """Return the field of the wire in its own axes.

        `key` is its key in the case file, for messages. R, the unit of formulas, is not used.
        """
        current, currents = self.turns * self.current, magpylib(key).current
        if self.vertices is not None:
            corners = np.array(self.vertices)
            wire = currents.Polyline(current=current, vertices=corners)
            return FieldOfSource(
                Harmonic(wire.getB, lambda x: to_polygon(x, corners)), [corners], NOWHERE
            )
        assert self.diameter
        r = self.diameter / 2
        loop = currents.Circle(current=current, diameter=2 * r)

        def distance(x: Array) -> Array:
            """Return the distance (n,) of places x (n, 3) from the circle."""
            return np.hypot(np.hypot(x[:, 0], x[:, 1]) - r, x[:, 2])

        return FieldOfSource(Harmonic(loop.getB, distance), [circle_line(r)], NOWHERE)


def to_polygon(x: Array, corners: Array) -> Array:
    """Return the distance (n,) of places x (n, 3) from a polygon through `corners` (m, 3)."""
    distance = np.full(len(x), np.inf)
    for a, segment in zip(corners, np.diff(corners, axis=0), strict=False):
        # where the foot of each place is along the segment, from 0 to 1
        position = np.clip((x - a) @ segment / np.sum(segment**2), 0.0, 1.0)
        distance = np.minimum(distance, np.linalg.norm(x - a - position[:, None] * segment, axis=1))
    return distance

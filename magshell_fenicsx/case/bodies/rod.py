"""A cylinder that touches with its flat end."""

from typing import Literal, Self

from pydantic import model_validator

from magshell_fenicsx.parts.bodies.body import BodySection, Size


class RodSection(BodySection):
    """A cylinder along the approach with a flat end, whose edge is rounded."""

    kind: Literal["rod"]
    radius: Size
    """Its radius [the shell's length; over R if that has no unit]"""
    edge: Size
    """Radius of the edge's rounding, at most `radius` [the shell's length; over R if that has no unit]"""

    @model_validator(mode="after")
    def _edge_fits(self) -> Self:
        if self.edge > self.radius:
            raise ValueError("edge: a rounding is no larger than the radius")
        return self

"""A box."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from magshell_fenicsx.parts.bodies.body import Axis, BodySection, Size


class BoxSection(BodySection):
    """A box with rounded edges and corners."""

    kind: Literal["box"]
    size: Annotated[list[Size], Field(min_length=3, max_length=3)]
    """Along `axis`, across it and the approach, and along the approach [the shell's length; over R if that has no
    unit]"""
    edge: Size
    """Radius of the rounding, at most half of the smallest size [the shell's length; over R if that has no unit]"""
    axis: Axis
    """Along the first size, of any length; its part across the approach counts, and there must be one"""

    @property
    def ahead(self) -> float:
        return self.size[2] / 2

    @property
    def blunt(self) -> float:
        return min(self.size[:2]) / 2

    @model_validator(mode="after")
    def _edge_fits(self) -> Self:
        if 2 * self.edge > min(self.size):
            raise ValueError("edge: a rounding is at most half of the smallest size")
        return self

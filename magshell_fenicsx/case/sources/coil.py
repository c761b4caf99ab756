"""Currents in thin wires."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from magshell_fenicsx.parts.magnetism.sources.source import Current, Position, Size, SourceSection


class CoilSection(SourceSection):
    """A current in a thin wire: a circle around its own z axis, or a polygon."""

    kind: Literal["coil"]
    diameter: Size | None = None
    """Of a circle [m]"""
    vertices: Annotated[list[Position], Field(min_length=2, max_length=100_000)] | None = None
    """Corners of a polygon in its own axes, in place of diameter; the first again at the end closes it [m]"""
    current: Current
    """By the right-hand rule about its own z axis, or along the polygon [A]"""
    turns: int = Field(default=1, ge=1, le=1_000_000)
    """Turns of the wire"""

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        if (self.diameter is None) == (self.vertices is None):
            raise ValueError("give diameter or vertices")
        if self.vertices and any(a == b for a, b in zip(self.vertices, self.vertices[1:], strict=False)):
            raise ValueError("vertices: two of them in a row are the same place")
        return self

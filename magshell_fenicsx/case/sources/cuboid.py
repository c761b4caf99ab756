"""A cuboid magnet."""

from typing import Annotated, Literal

from pydantic import Field

from magshell_fenicsx.parts.magnetism.sources.source import MagnetSection, Size


class CuboidSection(MagnetSection):
    """A cuboid along its own axes, uniformly magnetised."""

    kind: Literal["cuboid"]
    dimension: Annotated[list[Size], Field(min_length=3, max_length=3)]
    """Edges along its own axes [m]"""

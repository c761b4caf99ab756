"""A ring magnet."""

from typing import Literal, Self

from pydantic import model_validator

from magshell_fenicsx.parts.magnetism.sources.source import MagnetSection, Size


class RingSection(MagnetSection):
    """A hollow cylinder around its own z axis, uniformly magnetised."""

    kind: Literal["ring"]
    diameter: Size
    """Outer diameter [m]"""
    inner_diameter: Size
    """Of the hole [m]"""
    height: Size
    """Along its own z axis [m]"""

    @model_validator(mode="after")
    def _hollow(self) -> Self:
        if self.inner_diameter >= self.diameter:
            raise ValueError("inner_diameter must be smaller than diameter")
        return self

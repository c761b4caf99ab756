"""A cylinder that touches with its round side."""

from typing import Literal

from magshell_fenicsx.parts.bodies.body import Axis, BodySection, Size


class CylinderSection(BodySection):
    """A cylinder without ends, its axis across the approach."""

    kind: Literal["cylinder"]
    radius: Size
    """Its radius [the shell's length; over R if that has no unit]"""
    axis: Axis
    """Along the cylinder, of any length, not along the approach"""

    @property
    def ahead(self) -> float:
        return self.radius

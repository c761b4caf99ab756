"""A sphere."""

from typing import Literal

from magshell_fenicsx.parts.bodies.body import BodySection, Size


class SphereSection(BodySection):
    """A ball."""

    kind: Literal["sphere"]
    radius: Size
    """Its radius [the shell's length; over R if that has no unit]"""

    @property
    def ahead(self) -> float:
        return self.radius

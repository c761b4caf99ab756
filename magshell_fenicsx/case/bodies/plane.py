"""A plane."""

from typing import Literal

from magshell_fenicsx.parts.bodies.body import BodySection


class PlaneSection(BodySection):
    """A half-space; its face is normal to the direction of the approach."""

    kind: Literal["plane"]

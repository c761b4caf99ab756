"""A sphere magnet."""

from typing import Literal

from magshell_fenicsx.parts.magnetism.sources.source import MagnetSection, Size


class SphereSection(MagnetSection):
    """A sphere, uniformly magnetised: outside it the field of a dipole."""

    kind: Literal["sphere"]
    diameter: Size
    """Diameter [m]"""

"""A cylinder magnet."""

from typing import Literal

from magshell_fenicsx.parts.magnetism.sources.source import MagnetSection, Size


class CylinderSection(MagnetSection):
    """A cylinder around its own z axis, uniformly magnetised."""

    kind: Literal["cylinder"]
    diameter: Size
    """Diameter [m]"""
    height: Size
    """Along its own z axis [m]"""

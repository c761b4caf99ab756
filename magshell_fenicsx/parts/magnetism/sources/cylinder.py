"""A cylinder magnet."""

from types import ModuleType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.sources.source import MagnetSection, Size, Values, to_box
from magshell_fenicsx.shape import drawn_bodies
from magshell_fenicsx.shape.drawn_bodies import Solid
from magshell_fenicsx.shape.reference_shell import cylinder_lines

Array = NDArray[np.float64]


class CylinderSection(MagnetSection):
    """A cylinder around its own z axis, uniformly magnetised."""

    kind: Literal["cylinder"]
    diameter: Size
    """Diameter [m]"""
    height: Size
    """Along its own z axis [m]"""

    def values(self, magnets: ModuleType) -> Values:
        magnet = magnets.Cylinder(dimension=(self.diameter, self.height), polarization=self.vector)
        return magnet.getB  # type: ignore[no-any-return]

    def distance(self, x: Array) -> Array:
        beyond_side = np.hypot(x[:, 0], x[:, 1]) - self.diameter / 2
        return to_box(np.column_stack([beyond_side, np.abs(x[:, 2]) - self.height / 2]))

    def lines(self) -> list[Array]:
        return cylinder_lines(self.diameter / 2, self.height)

    def solid(self) -> Solid:
        return drawn_bodies.cylinder(self.diameter / 2, self.height)

"""A sphere magnet."""

from types import ModuleType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.sources.source import MagnetSection, Size, Values
from magshell_fenicsx.shape import drawn_bodies
from magshell_fenicsx.shape.drawn_bodies import Solid
from magshell_fenicsx.shape.reference_shell import sphere_lines

Array = NDArray[np.float64]


class SphereSection(MagnetSection):
    """A sphere, uniformly magnetised: outside it the field of a dipole."""

    kind: Literal["sphere"]
    diameter: Size
    """Diameter [m]"""

    def values(self, magnets: ModuleType) -> Values:
        magnet = magnets.Sphere(diameter=self.diameter, polarization=self.vector)
        return magnet.getB  # type: ignore[no-any-return]

    def distance(self, x: Array) -> Array:
        return np.asarray(np.linalg.norm(x, axis=1) - self.diameter / 2)

    def lines(self) -> list[Array]:
        return sphere_lines(self.diameter / 2)

    def solid(self) -> Solid:
        return drawn_bodies.globe(self.diameter / 2)

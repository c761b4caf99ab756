"""A ring magnet."""

from types import ModuleType
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from magshell_fenicsx.parts.magnetism.sources.source import MagnetSection, Size, Values, to_box
from magshell_fenicsx.shape import drawn_bodies
from magshell_fenicsx.shape.drawn_bodies import Solid
from magshell_fenicsx.shape.reference_shell import cylinder_lines

Array = NDArray[np.float64]


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

    @property
    def radii(self) -> tuple[float, float]:
        """Radii of the hole and of the ring, in m."""
        return self.inner_diameter / 2, self.diameter / 2

    def values(self, magnets: ModuleType) -> Values:
        magnet = magnets.CylinderSegment(
            dimension=(*self.radii, self.height, 0, 360), polarization=self.vector
        )
        return magnet.getB  # type: ignore[no-any-return]

    def distance(self, x: Array) -> Array:
        inner, outer = self.radii
        off_middle = np.abs(np.hypot(x[:, 0], x[:, 1]) - (inner + outer) / 2)
        return to_box(
            np.column_stack([off_middle - (outer - inner) / 2, np.abs(x[:, 2]) - self.height / 2])
        )

    def lines(self) -> list[Array]:
        return [line for radius in self.radii for line in cylinder_lines(radius, self.height)]

    def solid(self) -> Solid:
        return drawn_bodies.cylinder(self.diameter / 2, self.height, self.inner_diameter / 2)

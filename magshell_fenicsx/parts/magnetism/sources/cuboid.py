"""A cuboid magnet."""

from types import ModuleType
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.parts.magnetism.sources.source import MagnetSection, Size, Values, to_box
from magshell_fenicsx.shape import drawn_bodies
from magshell_fenicsx.shape.drawn_bodies import Solid
from magshell_fenicsx.shape.reference_shell import box_lines

Array = NDArray[np.float64]


class CuboidSection(MagnetSection):
    """A cuboid along its own axes, uniformly magnetised."""

    kind: Literal["cuboid"]
    dimension: Annotated[list[Size], Field(min_length=3, max_length=3)]
    """Edges along its own axes [m]"""

    @property
    def half_edges(self) -> Array:
        """Half its edges (3,) in m."""
        return np.array(self.dimension) / 2

    def values(self, magnets: ModuleType) -> Values:
        magnet = magnets.Cuboid(dimension=2 * self.half_edges, polarization=self.vector)
        return magnet.getB  # type: ignore[no-any-return]

    def distance(self, x: Array) -> Array:
        return to_box(np.abs(x) - self.half_edges)

    def lines(self) -> list[Array]:
        return box_lines(-self.half_edges, self.half_edges)

    def solid(self) -> Solid:
        return drawn_bodies.block(self.half_edges)

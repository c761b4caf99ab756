"""The chart of a grid, triangulated by gmsh: where rims lie in it, which grid lines cannot follow."""

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grid import CLOSE, Grid
from magshell_fenicsx.mesh.shapes import Faces, Glued, within

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RimmedGrid:
    """A grid's rectangle with closed curves, points (n, 2) each, that element edges follow."""

    grid: Grid
    rims: tuple[Array, ...]
    half: bool = False

    @property
    def extent(self) -> Array:
        return np.subtract(self.grid.high, self.grid.low)

    @property
    def area(self) -> float:
        return float(np.prod(self.extent))

    @property
    def reach(self) -> float:
        return float(self.extent.max())

    @property
    def box(self) -> tuple[Array, Array]:
        return np.array(self.grid.low), np.array(self.grid.high)

    @property
    def glued(self) -> tuple[Glued, ...]:
        return tuple((i, self.grid.low[i], self.grid.high[i]) for i in range(2) if self.grid.glued[i])

    def faces(self, occ: Any) -> Faces:
        """The rectangle, the rims with their images across glued sides, and the lines of the grid's `through`."""
        (x0, y0), (x1, y1) = self.grid.low, self.grid.high

        def rectangle() -> tuple[int, int]:
            return 2, occ.addRectangle(x0, y0, 0, x1 - x0, y1 - y0)

        steps = [(-1, 0, 1) if glued else (0,) for glued in self.grid.glued]
        images = [points + np.multiply(step, self.extent) for points in self.rims for step in product(*steps)]
        near = [p for p in images if (p.max(axis=0) > self.grid.low).all() and (p.min(axis=0) < self.grid.high).all()]
        found = [rectangle(), *within(occ, near, rectangle)]
        for axis, other in ((0, 1), (1, 0)):
            for across in self.grid.through[axis]:
                if not self.grid.low[axis] < across < self.grid.high[axis]:
                    continue
                ends = np.array([self.grid.low, self.grid.high])
                ends[:, axis], ends[:, other] = across, (self.grid.low[other], self.grid.high[other])
                found.append((1, occ.addLine(*(occ.addPoint(*end, 0) for end in ends))))
        return found

    def on_edges(self, x: Array) -> dict[str, NDArray[np.bool_]]:
        found = dict[str, NDArray[np.bool_]]()
        for i, name in enumerate(self.grid.sides):
            axis, end = i // 2, (self.grid.low, self.grid.high)[i % 2]
            if name in self.grid.edges and not self.grid.glued[axis]:
                on = np.abs(x[:, axis] - end[axis]) < CLOSE * self.reach
                found[name] = found[name] | on if name in found else on
        return found

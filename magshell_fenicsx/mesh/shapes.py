"""The plane shapes that gmsh triangulates: the chart of the mid-surface, or one half of it."""

from dataclasses import dataclass
from math import pi
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Faces = list[tuple[int, int]]


class Shape(Protocol):
    """A shape for `triangulate`; `area` is the area of the modelled part, `reach` its extent."""

    @property
    def area(self) -> float: ...

    @property
    def reach(self) -> float: ...

    @property
    def half(self) -> bool: ...

    def faces(self, occ: Any) -> Faces:
        """Make the shape's faces with gmsh's OpenCASCADE kernel; elements follow their common edges."""

    def on_edges(self, x: Array) -> dict[str, NDArray[np.bool_]]:
        """Which of the points (n, 2) lie on each named boundary edge."""


@dataclass(frozen=True)
class DiscShape:
    """A disc around the origin; edges `edge`, and "symmetry" of the half with y >= 0.

    Attributes
    ----------
    circle
        Radius of an inner circle that element edges follow (the rim of a dimple).
    edge
        Name of its outer edge.
    """

    radius: float
    half: bool
    circle: float | None = None
    edge: str = "rim"

    @property
    def area(self) -> float:
        return pi * self.radius**2 / (2 if self.half else 1)

    @property
    def reach(self) -> float:
        return self.radius

    def faces(self, occ: Any) -> Faces:
        discs = [
            (2, occ.addDisk(0, 0, 0, r, r)) for r in ([self.radius, self.circle] if self.circle else [self.radius])
        ]
        if not self.half:
            return discs
        above = (2, occ.addRectangle(-2 * self.radius, 0, 0, 4 * self.radius, 2 * self.radius))
        return list(occ.intersect(discs, [above])[0])

    def on_edges(self, x: Array) -> dict[str, NDArray[np.bool_]]:
        edges = {self.edge: np.isclose(np.hypot(x[:, 0], x[:, 1]), self.radius, rtol=1e-9)}
        if self.half:
            edges["symmetry"] = np.abs(x[:, 1]) < 1e-9 * self.radius
        return edges


@dataclass(frozen=True)
class StripShape:
    """0 <= x <= 1, |y| <= width/2; edges "root" (x = 0), "tip", "sides", and "symmetry" of the half with y >= 0."""

    width: float
    half: bool

    @property
    def area(self) -> float:
        return self.width / (2 if self.half else 1)

    @property
    def reach(self) -> float:
        return 1.0

    def faces(self, occ: Any) -> Faces:
        below = 0 if self.half else -self.width / 2
        return [(2, occ.addRectangle(0, below, 0, 1, self.width / 2 - below))]

    def on_edges(self, x: Array) -> dict[str, NDArray[np.bool_]]:
        edges = {
            "root": np.abs(x[:, 0]) < 1e-9,
            "tip": np.abs(x[:, 0] - 1) < 1e-9,
            "sides": np.abs(np.abs(x[:, 1]) - self.width / 2) < 1e-9,
        }
        if self.half:
            edges["symmetry"] = np.abs(x[:, 1]) < 1e-9
        return edges

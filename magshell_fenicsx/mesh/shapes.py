"""The plane shapes that gmsh triangulates, the chart of the mid-surface or half of it; sphere and
plane over a chart.

The sphere of radius 1 is charted by (x, y) = phi (cos theta, sin theta).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import pi
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Faces = list[tuple[int, int]]
Glued = tuple[int, float, float]  # an axis, and the coordinates across it


class Shape(Protocol):
    """A shape for `triangulate`; `area` is the area of the modelled part, `reach` its extent."""

    @property
    def area(self) -> float: ...

    @property
    def reach(self) -> float: ...

    @property
    def box(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the coordinates of the modelled part: of a disc of radius and
        angle.
        """

    @property
    def half(self) -> bool: ...

    @property
    def rims(self) -> tuple[Array, ...]:
        """Closed curves, points (n, 2) each, that elements follow."""

    @property
    def glued(self) -> tuple[Glued, ...]:
        """The pairs of opposite sides that are one line of the surface."""

    def faces(self, occ: Any) -> Faces:
        """Make the shape's faces with gmsh's OpenCASCADE kernel; elements follow their common
        edges.
        """

    def on_edges(self, x: Array) -> dict[str, NDArray[np.bool_]]:
        """Which of the points (n, 2) lie on each named boundary edge."""


@dataclass(frozen=True)
class DiscShape:
    """A disc around the origin; edges `edge`, and "symmetry" of the half with y >= 0.

    A sector has "symmetry" along the positive first axis and "symmetry 2" at its other end.

    Attributes
    ----------
    circles
        Radii of inner circles that element edges follow (rims of dimples).
    rims
        Other closed curves that they follow, points (n, 2) each; parts beyond the edge are left
        out.
    edge
        Name of its outer edge.
    waves
        m of the sector of 180/m degrees that is left of a half; 1 for all of it.
    """

    radius: float
    half: bool
    circles: tuple[float, ...] = ()
    edge: str = "rim"
    rims: tuple[Array, ...] = ()
    waves: int = 1
    glued: ClassVar[tuple[Glued, ...]] = ()

    @property
    def area(self) -> float:
        return pi * self.radius**2 / (2 * self.waves if self.half else 1)

    @property
    def reach(self) -> float:
        return self.radius

    @property
    def box(self) -> tuple[Array, Array]:
        return np.zeros(2), np.array([self.radius, pi / self.waves if self.half else 2 * pi])

    def faces(self, occ: Any) -> Faces:
        discs = [(2, occ.addDisk(0, 0, 0, r, r)) for r in (self.radius, *self.circles)]
        discs += within(occ, self.rims, lambda: (2, occ.addDisk(0, 0, 0, self.radius, self.radius)))
        if not self.half:
            return discs
        if self.waves > 1:
            return list(occ.intersect(discs, [self._wedge(occ)])[0])
        above = (2, occ.addRectangle(-2 * self.radius, 0, 0, 4 * self.radius, 2 * self.radius))
        return list(occ.intersect(discs, [above])[0])

    def _wedge(self, occ: Any) -> tuple[int, int]:
        """The triangle between the two sides of the sector, larger than the disc."""
        side = 2 * self.radius / np.cos(pi / (2 * self.waves))
        ends = [side * self._along, np.array([side, 0.0])]
        corners = [occ.addPoint(*x, 0) for x in (np.zeros(2), ends[1], ends[0])]
        lines = [occ.addLine(corners[i], corners[(i + 1) % 3]) for i in range(3)]
        return 2, occ.addPlaneSurface([occ.addCurveLoop(lines)])

    @property
    def _along(self) -> Array:
        """The direction of the second side."""
        return np.array([np.cos(pi / self.waves), np.sin(pi / self.waves)])

    def on_edges(self, x: Array) -> dict[str, NDArray[np.bool_]]:
        edges = {self.edge: np.isclose(np.hypot(x[:, 0], x[:, 1]), self.radius, rtol=1e-9)}
        if self.half:
            edges["symmetry"] = np.abs(x[:, 1]) < 1e-9 * self.radius
        if self.half and self.waves > 1:
            across = x @ np.array([-self._along[1], self._along[0]])
            edges["symmetry 2"] = np.abs(across) < 1e-9 * self.radius
        return edges


@dataclass(frozen=True)
class StripShape:
    """0 <= x <= 1, |y| <= width/2; edges "root" (x = 0), "tip", "sides", and "symmetry" of the half
    with y >= 0.
    """

    width: float
    half: bool
    rims: tuple[Array, ...] = ()
    glued: ClassVar[tuple[Glued, ...]] = ()

    @property
    def area(self) -> float:
        return self.width / (2 if self.half else 1)

    @property
    def reach(self) -> float:
        return 1.0

    @property
    def box(self) -> tuple[Array, Array]:
        return np.array([0.0, 0.0 if self.half else -self.width / 2]), np.array(
            [1.0, self.width / 2]
        )

    def faces(self, occ: Any) -> Faces:
        below = 0 if self.half else -self.width / 2

        def strip() -> tuple[int, int]:
            return 2, occ.addRectangle(0, below, 0, 1, self.width / 2 - below)

        return [strip(), *within(occ, self.rims, strip)]

    def on_edges(self, x: Array) -> dict[str, NDArray[np.bool_]]:
        edges = {
            "root": np.abs(x[:, 0]) < 1e-9,
            "tip": np.abs(x[:, 0] - 1) < 1e-9,
            "sides": np.abs(np.abs(x[:, 1]) - self.width / 2) < 1e-9,
        }
        if self.half:
            edges["symmetry"] = np.abs(x[:, 1]) < 1e-9
        return edges


def within(occ: Any, rims: Sequence[Array], whole: Callable[[], tuple[int, int]]) -> Faces:
    """The faces within closed curves, points (n, 2) each, as far as they belong to a face that
    `whole` makes.
    """
    pieces: Faces = []
    for points in rims:
        tags = [occ.addPoint(x, y, 0) for x, y in points]
        loop = occ.addCurveLoop([occ.addSpline([*tags, tags[0]])])
        pieces += occ.intersect([(2, occ.addPlaneSurface([loop]))], [whole()])[0]
        occ.remove([(0, tag) for tag in tags])
    return pieces


def sphere(chart: Array) -> Array:
    """Chart (n, 2) -> places (n, 3), which are the normals too."""
    phi = np.hypot(chart[:, 0], chart[:, 1])
    horizontal = np.sinc(phi / np.pi)[:, None] * chart
    return np.column_stack([horizontal, np.cos(phi)])


def flat(chart: Array) -> Array:
    """Chart (x, y) -> the plane z = 0."""
    return np.column_stack([chart, np.zeros(len(chart))])


def upwards(chart: Array) -> Array:
    """The normals (n, 3) of that plane."""
    return np.broadcast_to([0.0, 0.0, 1.0], (len(chart), 3))

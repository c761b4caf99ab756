"""Plane shapes that gmsh triangulates: the chart of the mid-surface, or half of it.

And the embeddings of sphere and plane over a chart, the maps from its coordinates to places in
space. The sphere of radius 1 is charted by (x, y) = phi (cos theta, sin theta), with the angle phi
from the pole and the azimuth theta. A rim is a closed curve that element edges follow, such as the
edge of a dimple. gmsh's kernel makes faces by calls, and names them by dimension and tag. Lengths
are over R.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import pi
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Faces = list[tuple[int, int]]  # dimension and tag of gmsh's entities
GluedSides = tuple[int, float, float]  # an axis, and the coordinates across it of both sides
EDGE_TOLERANCE = 1e-9  # over the radius, or the length of a strip: a point so near is on an edge


class PlaneShape(Protocol):
    """A plane shape that `triangulate` meshes with gmsh."""

    @property
    def area(self) -> float:
        """Area of the modelled part."""

    @property
    def reach(self) -> float:
        """Extent of the shape."""

    @property
    def box(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the coordinates of the modelled part.

        Of a disc they are bounds of radius and angle.
        """

    @property
    def half(self) -> bool:
        """Whether a half or a sector is modelled."""

    @property
    def rims(self) -> tuple[Array, ...]:
        """Closed curves, points (n, 2) each, that elements follow."""

    @property
    def glued(self) -> tuple[GluedSides, ...]:
        """The pairs of opposite sides that are one line of the surface."""

    def faces(self, occ: Any) -> Faces:
        """Make the shape's faces with gmsh's OpenCASCADE kernel.

        Elements follow the edges of all faces.
        """

    def on_edges(self, x: Array) -> dict[str, NDArray[np.bool_]]:
        """Return for each named boundary edge which of the points (n, 2) lie on it, (n,)."""


@dataclass(frozen=True)
class DiscShape:
    """A disc around the origin; edges `edge`, and "symmetry" of the half with y >= 0.

    A sector has "symmetry" along the positive first axis and "symmetry 2" at its other end.

    Attributes
    ----------
    radius
        Radius of the disc.
    half
        Whether the half, or a sector of it, is modelled.
    circles
        Radii of inner circles that element edges follow (rims of dimples).
    edge
        Name of its outer edge.
    rims
        Other closed curves that elements follow, points (n, 2) each; parts beyond the edge are left
        out.
    waves
        m of the sector of 180/m degrees that is left of a half; 1 for all of it.
    """

    radius: float
    half: bool
    circles: tuple[float, ...] = ()
    edge: str = "rim"
    rims: tuple[Array, ...] = ()
    waves: int = 1
    glued: ClassVar[tuple[GluedSides, ...]] = ()

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
        """Make the disc with inner circles and rims, cut to the modelled part."""

        def disc() -> tuple[int, int]:
            """Make a disc and return its dimension and tag."""
            return 2, occ.addDisk(0, 0, 0, self.radius, self.radius)

        # inner discs divide the outer one, so that elements follow their circles
        faces = [(2, occ.addDisk(0, 0, 0, r, r)) for r in (self.radius, *self.circles)]
        faces += faces_within(occ, self.rims, disc)
        if not self.half:
            return faces
        if self.waves > 1:
            return list(occ.intersect(faces, [self._wedge(occ)])[0])
        # a rectangle over y >= 0 that is larger than the disc
        upper = (2, occ.addRectangle(-2 * self.radius, 0, 0, 4 * self.radius, 2 * self.radius))
        half_faces, _ = occ.intersect(faces, [upper])
        return list(half_faces)

    def _wedge(self, occ: Any) -> tuple[int, int]:
        """Make the triangle between the two sides of the sector, larger than the disc."""
        # its third side is then at twice the radius from the origin
        side = 2 * self.radius / np.cos(pi / (2 * self.waves))
        end_of_second, end_of_first = side * self._second_side, np.array([side, 0.0])
        corners = [occ.addPoint(*x, 0) for x in (np.zeros(2), end_of_first, end_of_second)]
        lines = [occ.addLine(corners[i], corners[(i + 1) % 3]) for i in range(3)]
        return 2, occ.addPlaneSurface([occ.addCurveLoop(lines)])

    @property
    def _second_side(self) -> Array:
        """Unit vector (2,) along the second side of the sector."""
        return np.array([np.cos(pi / self.waves), np.sin(pi / self.waves)])

    def on_edges(self, x: Array) -> dict[str, NDArray[np.bool_]]:
        """Return name of an edge -> whether points x (n, 2) lie on it, (n,)."""
        radii = np.hypot(x[:, 0], x[:, 1])
        edges = {self.edge: np.isclose(radii, self.radius, rtol=EDGE_TOLERANCE)}
        if self.half:
            edges["symmetry"] = np.abs(x[:, 1]) < EDGE_TOLERANCE * self.radius
        if self.half and self.waves > 1:
            normal = np.array([-self._second_side[1], self._second_side[0]])
            edges["symmetry 2"] = np.abs(x @ normal) < EDGE_TOLERANCE * self.radius
        return edges


@dataclass(frozen=True)
class StripShape:
    """The rectangle 0 <= x <= 1, |y| <= width/2.

    Edges "root" (x = 0), "tip", "sides", and "symmetry" of the half with y >= 0.
    """

    width: float
    half: bool
    rims: tuple[Array, ...] = ()
    glued: ClassVar[tuple[GluedSides, ...]] = ()

    @property
    def area(self) -> float:
        return self.width / (2 if self.half else 1)

    @property
    def reach(self) -> float:
        return 1.0

    @property
    def box(self) -> tuple[Array, Array]:
        low = np.array([0.0, 0.0 if self.half else -self.width / 2])
        return low, np.array([1.0, self.width / 2])

    def faces(self, occ: Any) -> Faces:
        """Make the rectangle and the faces within the rims."""
        bottom = 0 if self.half else -self.width / 2

        def strip() -> tuple[int, int]:
            """Make a rectangle and return its dimension and tag."""
            return 2, occ.addRectangle(0, bottom, 0, 1, self.width / 2 - bottom)

        return [strip(), *faces_within(occ, self.rims, strip)]

    def on_edges(self, x: Array) -> dict[str, NDArray[np.bool_]]:
        """Return name of an edge -> whether points x (n, 2) lie on it, (n,)."""
        edges = {
            "root": np.abs(x[:, 0]) < EDGE_TOLERANCE,
            "tip": np.abs(x[:, 0] - 1) < EDGE_TOLERANCE,
            "sides": np.abs(np.abs(x[:, 1]) - self.width / 2) < EDGE_TOLERANCE,
        }
        if self.half:
            edges["symmetry"] = np.abs(x[:, 1]) < EDGE_TOLERANCE
        return edges


def faces_within(
    occ: Any, curves: Sequence[Array], make_face: Callable[[], tuple[int, int]]
) -> Faces:
    """Make the faces within closed curves, as far as they lie in another face.

    Parameters
    ----------
    occ
        gmsh's geometry kernel, `gmsh.model.occ`.
    curves
        Points (n, 2) of each curve.
    make_face
        Makes the other face anew at each call, since an intersection consumes it; returns its
        dimension and tag.
    """
    faces: Faces = []
    for points in curves:
        tags = [occ.addPoint(x, y, 0) for x, y in points]
        loop = occ.addCurveLoop([occ.addSpline([*tags, tags[0]])])
        faces += occ.intersect([(2, occ.addPlaneSurface([loop]))], [make_face()])[0]
        occ.remove([(0, tag) for tag in tags])
    return faces


def sphere_embedding(chart: Array) -> Array:
    """Return places (n, 3) of the unit sphere, which are the normals too, at chart (n, 2).

    They are (sin phi cos theta, sin phi sin theta, cos phi).
    """
    phi = np.hypot(chart[:, 0], chart[:, 1])
    # sin(phi)/phi, which is defined at the pole
    horizontal = np.sinc(phi / np.pi)[:, None] * chart
    return np.column_stack([horizontal, np.cos(phi)])


def plane_embedding(chart: Array) -> Array:
    """Return places (n, 3) of the plane z = 0 at chart (x, y)."""
    return np.column_stack([chart, np.zeros(len(chart))])


def plane_normals(chart: Array) -> Array:
    """Return the normals (n, 3) of the plane z = 0."""
    return np.broadcast_to([0.0, 0.0, 1.0], (len(chart), 3))

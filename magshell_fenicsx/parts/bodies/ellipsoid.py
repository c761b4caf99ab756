"""An ellipsoid, a rigid body: its section of a case and its signed distance.

The approach is the body's displacement along its direction; distances are those at approach zero.
Lengths are over R, in sections in the case's unit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.parts.bodies.body import Axis, BodySection, Distance, PlacedBody, Size
from magshell_fenicsx.shape import drawn_bodies
from magshell_fenicsx.shape.drawn_bodies import Solid
from magshell_fenicsx.shape.reference_shell import sphere_lines

Array = NDArray[np.float64]
MAX_NEWTON_ITERATIONS = 60  # which takes about six
# over a semi-axis: the least distance from planes of symmetry, so that the nearest place is one
PLANE_OFFSET = 1e-12
PARAMETER_TOLERANCE = 1e-15  # change of t, over the largest semi-axis squared
# least 1 + distance times curvature: beyond a centre of curvature another place is nearest
MIN_CURVATURE_FACTOR = 1e-9


class EllipsoidSection(BodySection):
    """An ellipsoid, one of its axes along the approach."""

    kind: Literal["ellipsoid"]
    semi_axes: Annotated[list[Size], Field(min_length=3, max_length=3)]
    """Along `axis`, across it and the approach, and along the approach; half of its lengths [the
    shell's length; over R if that has no unit]"""
    axis: Axis
    """Along the first semi-axis, of any length; its part across the approach counts, and there must
    be one"""

    @property
    def front_offset(self) -> float:
        return self.semi_axes[2]

    @property
    def blunt_radius(self) -> float:
        """The smaller radius of curvature of its front, in the case's unit."""
        return min(self.semi_axes[:2]) ** 2 / self.semi_axes[2]

    def distance(self, placed_body: PlacedBody) -> Distance:
        return Ellipsoid(
            placed_body.centre,
            placed_body.axes(self.axis),
            np.array(self.semi_axes) / placed_body.R,
        )


@dataclass(frozen=True)
class Ellipsoid(Distance):
    """Signed distance of an ellipsoid; lengths are over R.

    The nearest place of the surface to y has the coordinates a_i² y_i/(t + a_i²), with the largest
    root t of F(t) = sum (a_i y_i/(t + a_i²))² - 1. F falls and is convex there, so Newton's method
    from a place with 0 <= F <= 2 goes up to the root and never past it.

    Attributes
    ----------
    centre
        (3,) its middle.
    axes, semi
        (3, 3) its unit vectors as rows, and (3,) its semi-axes a_i along them.
    """

    centre: Array
    axes: Array
    semi: Array

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        """Return signed distance (n,), gradient (n, 3), Hessian (n, 3, 3) at places x (n, 3).

        The Hessian has the curvatures k/(1 + g k) of the parallel surface at distance g, where k
        are those of the ellipsoid at the nearest place.
        """
        y = (x - self.centre) @ self.axes.T  # coordinates along the ellipsoid's axes
        foot = self.nearest(y)  # the nearest places of the surface
        normal = foot / self.semi**2  # half the gradient of sum (y_i/a_i)², which is normal to it
        normal_length = np.linalg.norm(normal, axis=1)
        n = normal / normal_length[:, None]
        g = np.einsum("ni,ni->n", y - foot, n)
        # the curvatures of the surface as a tensor S: the second derivative of sum (y_i/a_i)²/2
        # over the length of the first, projected onto the tangent plane
        tangent_projection = np.eye(3) - n[:, :, None] * n[:, None, :]
        second_derivative = np.eye(3) / self.semi**2 / normal_length[:, None, None]
        S = tangent_projection @ second_derivative @ tangent_projection
        curvatures, directions = np.linalg.eigh(S)
        parallel = curvatures / np.maximum(1 + g[:, None] * curvatures, MIN_CURVATURE_FACTOR)
        N = np.einsum("nia,na,nja->nij", directions, parallel, directions)
        return g, n @ self.axes, np.einsum("ai,nab,bj->nij", self.axes, N, self.axes, optimize=True)

    def nearest(self, y: Array) -> Array:
        """Return the places (n, 3) of the surface that are nearest to places y (n, 3).

        Both are coordinates along the ellipsoid's axes, from its centre. They follow from the
        parameter t, the root of F that Newton's method finds (see the class).
        """
        a = self.semi
        size = np.maximum(np.abs(y), PLANE_OFFSET * a)  # |y|: in the octant of positive coordinates
        # the start: the largest of the three terms of F + 1 is then 1, so that 0 <= F <= 2
        t = (a * size - a**2).max(axis=1)
        for _ in range(MAX_NEWTON_ITERATIONS):
            ratio = a * size / (t[:, None] + a**2)
            F = (ratio**2).sum(axis=1) - 1
            slope = -2 * (ratio**2 / (t[:, None] + a**2)).sum(axis=1)  # dF/dt
            step = -F / slope
            t = t + step
            if np.abs(step).max(initial=0.0) <= PARAMETER_TOLERANCE * a.max() ** 2:
                break
        signs = np.where(y < 0, -1.0, 1.0)  # of the place's own octant
        return np.asarray(signs * a**2 * size / (t[:, None] + a**2))

    @property
    def lines(self) -> list[Array]:
        return [self.centre + self.semi * line @ self.axes for line in sphere_lines(1.0)]

    @property
    def solid(self) -> Solid:
        round_one = drawn_bodies.globe(1.0)
        return replace(round_one, points=self.semi * round_one.points).transformed(
            self.axes.T, self.centre
        )

    @property
    def possible_mirror_vectors(self) -> Sequence[Array]:
        return [*self.axes]

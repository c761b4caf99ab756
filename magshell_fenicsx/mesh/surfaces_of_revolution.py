"""Surfaces of revolution about e3: profiles, and the embeddings of charts.

A chart is (rho theta, s) or, up to a pole, t (cos theta, sin theta): theta is the azimuth about e3,
rho a fixed radius, s the length along the meridian, and t its length from the pole. An embedding
maps chart coordinates to places in space. A profile is the meridian, a curve in the plane (r, z)
with its length s as coordinate. With r to the right and z upwards, the normal of the surface
points to the right of the direction of s: on a cylinder with s upwards it points outwards. Lengths
are over R.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
# iterations for a spline's parameter, which converges to the arc length as the square of its steps,
# and of Newton's method for the place nearest to a point
ITERATIONS = 4
GAUSS_POINTS = 6  # on each part of a spline
NEAREST_SAMPLES = 401  # of a spline, to begin the search for the nearest place
POLE_SAMPLES = 2001  # of a profile, to begin the search for the lengths from the pole
PARAMETER_TOLERANCE = 1e-13  # of the parameter of the nearest place
AZIMUTH_TOLERANCE = 1e-9  # rad: an azimuth that is less than the first one by rounding
TINY = 1e-300  # keeps divisions defined at the pole


class Profile(Protocol):
    """A curve in the plane (r, z)."""

    @property
    def length(self) -> float:
        """Length of the curve: the largest s."""

    def __call__(self, s: Array) -> Array:
        """Return places (..., 2) at s (...)."""

    def tangent(self, s: Array) -> Array:
        """Return unit vectors (..., 2) in the direction of s."""

    def nearest_parameter(self, rz: Array) -> float:
        """Return s of the place nearest to a point (2,)."""


@dataclass(frozen=True)
class StraightProfile:
    """A straight profile from `start` to `end`, places (r, z): cylinder, cone, ring."""

    start: tuple[float, float]
    end: tuple[float, float]

    @property
    def length(self) -> float:
        return float(np.hypot(*np.subtract(self.end, self.start)))

    def __call__(self, s: Array) -> Array:
        """Return the places (..., 2) at lengths s (...)."""
        share = np.asarray(s)[..., None] / self.length
        return np.asarray(self.start + share * np.subtract(self.end, self.start))

    def tangent(self, s: Array) -> Array:
        return np.broadcast_to(np.subtract(self.end, self.start) / self.length, (*np.shape(s), 2))

    def nearest_parameter(self, rz: Array) -> float:
        """Return s of the place nearest to a point (2,), by projection."""
        tangent = np.subtract(self.end, self.start) / self.length
        return float(np.clip((rz - self.start) @ tangent, 0.0, self.length))


@dataclass(frozen=True)
class ArcProfile:
    """Arc around (centre, 0) from the angle `start` to `end` (rad, from r towards z).

    Attributes
    ----------
    radius
        Radius of the arc.
    centre
        r of its centre, as of a torus.
    """

    radius: float
    start: float
    end: float
    centre: float = 0.0

    @property
    def length(self) -> float:
        return self.radius * (self.end - self.start)

    def __call__(self, s: Array) -> Array:
        """Return the places (..., 2) at lengths s (...)."""
        angle = self.start + np.asarray(s) / self.radius
        return self.radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1) + [self.centre, 0.0]

    def tangent(self, s: Array) -> Array:
        angle = self.start + np.asarray(s) / self.radius
        return np.stack([-np.sin(angle), np.cos(angle)], axis=-1)

    def nearest_parameter(self, rz: Array) -> float:
        """Return s of the place nearest to a point (2,), by its angle around the centre."""
        angle = np.arctan2(rz[1], rz[0] - self.centre) - self.start
        missing_angle = 2 * np.pi - (self.end - self.start)
        # a point beyond the arc belongs to the nearer end: the angle is cut midway in the gap
        angle = (angle + missing_angle / 2) % (2 * np.pi) - missing_angle / 2
        return float(np.clip(angle, 0.0, self.end - self.start) * self.radius)


class SplineProfile:
    """A smooth profile through points (n, 2), over its arc length.

    Attributes
    ----------
    length
        Length of the curve.
    _curve
        Cubic spline: length s -> place (r, z).
    """

    def __init__(self, points: Array) -> None:
        """Interpolate points (n, 2), and iterate until the parameter is the arc length."""
        # lengths of the parts between points: of the chords, then of the arcs of the last spline
        steps = np.hypot(*np.diff(points, axis=0).T)
        for _ in range(ITERATIONS):
            knots = np.concatenate([[0.0], np.cumsum(steps)])
            self._curve = scipy.interpolate.CubicSpline(knots, points)
            # lengths of the parts by Gauss quadrature of the speed
            x, w = np.polynomial.legendre.leggauss(GAUSS_POINTS)
            s = knots[:-1, None] + np.diff(knots)[:, None] * (x + 1) / 2
            steps = np.diff(knots) / 2 * (np.linalg.norm(self._curve(s, 1), axis=2) @ w)
        self.length = float(knots[-1])

    def __call__(self, s: Array) -> Array:
        """Return the places (..., 2) at lengths s (...)."""
        return np.asarray(self._curve(s))

    def tangent(self, s: Array) -> Array:
        derivative = self._curve(s, 1)
        return np.asarray(derivative / np.linalg.norm(derivative, axis=-1)[..., None])

    def nearest_parameter(self, rz: Array) -> float:
        """Return s of the place nearest to a point (2,): a sample, refined by minimisation."""
        samples = np.linspace(0, self.length, NEAREST_SAMPLES, dtype=np.float64)
        nearest = int(np.argmin(np.linalg.norm(self(samples) - rz, axis=1)))
        neighbours = samples[max(nearest - 1, 0)], samples[min(nearest + 1, NEAREST_SAMPLES - 1)]
        minimum = scipy.optimize.minimize_scalar(
            lambda s: np.sum((self(s) - rz) ** 2),
            bounds=neighbours,
            method="bounded",
            options={"xatol": PARAMETER_TOLERANCE},
        )
        # the minimum may be at a bound, which a bounded search only approaches
        candidates = [float(minimum.x), *(float(s) for s in neighbours)]
        return min(candidates, key=lambda s: float(np.sum((self(np.array(s)) - rz) ** 2)))


@dataclass(frozen=True)
class RevolvedEmbedding:
    """Embedding of the chart (rho theta, s) into space.

    Attributes
    ----------
    rho
        Radius by which the azimuth theta is multiplied in the chart.
    """

    profile: Profile
    rho: float

    def __call__(self, chart: Array) -> Array:
        """Return the places (n, 3) of the chart (n, 2)."""
        theta, (r, z) = chart[:, 0] / self.rho, self.profile(chart[:, 1]).T
        return np.column_stack([r * np.cos(theta), r * np.sin(theta), z])

    def normal(self, chart: Array) -> Array:
        """Return outward normals (n, 3): the profile's tangent turned to its right."""
        theta, (along_r, along_z) = chart[:, 0] / self.rho, self.profile.tangent(chart[:, 1]).T
        return np.column_stack([along_z * np.cos(theta), along_z * np.sin(theta), -along_r])

    def inverse(self, x: Array, first_azimuth: float) -> Array:
        """Return the chart coordinates (2,) of a point (3,).

        The azimuth theta is in [first_azimuth, first_azimuth + 2 pi).
        """
        theta = np.arctan2(x[1], x[0])
        # the tolerance keeps an azimuth that is less by rounding from becoming 2 pi
        from_first_azimuth = (theta - first_azimuth + AZIMUTH_TOLERANCE) % (2 * np.pi)
        theta = first_azimuth + from_first_azimuth - AZIMUTH_TOLERANCE
        s = self.profile.nearest_parameter(np.array([np.hypot(x[0], x[1]), x[2]]))
        return np.array([theta * self.rho, s])


@dataclass(frozen=True)
class CappedEmbedding:
    """Embedding of the chart t (cos theta, sin theta) into space.

    t is the length of the meridian from the pole, which is at the profile's end.
    """

    profile: Profile

    def __call__(self, chart: Array) -> Array:
        """Return the places (n, 3) of the chart (n, 2)."""
        t = np.hypot(chart[:, 0], chart[:, 1])
        r, z = self.profile(self.profile.length - t).T
        return np.column_stack([r[:, None] * _direction(chart, t), z])

    def normal(self, chart: Array) -> Array:
        """Return outward normals (n, 3): the profile's tangent turned to its right."""
        t = np.hypot(chart[:, 0], chart[:, 1])
        along_r, along_z = self.profile.tangent(self.profile.length - t).T
        return np.column_stack([along_z[:, None] * _direction(chart, t), -along_r])

    def from_pole(self, places: Array) -> Array:
        """Return the lengths (n,) of the meridian from the pole to places (n, 3) of the surface."""
        # places (r, z); the nearest sample of the profile is where Newton's method starts
        meridian_places = np.column_stack([np.hypot(places[:, 0], places[:, 1]), places[:, 2]])
        samples = np.linspace(0, self.profile.length, POLE_SAMPLES, dtype=np.float64)
        _, nearest = scipy.spatial.cKDTree(self.profile(samples)).query(meridian_places)
        s = samples[nearest]
        for _ in range(ITERATIONS):  # Newton's method, whose residual vanishes on the surface
            correction = np.sum(
                (meridian_places - self.profile(s)) * self.profile.tangent(s), axis=1
            )
            s = np.clip(s + correction, 0, self.profile.length)
        return np.asarray(self.profile.length - s)

    def inverse(self, x: Array) -> Array:
        """Return the chart (2,) of a point (3,)."""
        rho = np.hypot(x[0], x[1])
        t = self.profile.length - self.profile.nearest_parameter(np.array([rho, x[2]]))
        return t * x[:2] / rho if rho > 0 else np.zeros(2)


def _direction(chart: Array, t: Array) -> Array:
    """Return cos theta and sin theta, (n, 2); zero at the pole."""
    return np.where(t[:, None] > 0, chart / np.maximum(t, TINY)[:, None], 0.0)

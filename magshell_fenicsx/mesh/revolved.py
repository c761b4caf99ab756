"""Surfaces of revolution about e3, charted by (rho theta, s) or, up to their pole, by s (cos theta,
sin theta).

A profile is a curve in the plane (r, z) with the coordinate s. With r to the right and z upwards,
the normal of the surface points to the right of the direction of s: on a cylinder with s upwards it
points outwards.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
# iterations for a spline's parameter, which converges to the arc length as the square of its steps
ROUNDS = 4


class Profile(Protocol):
    """A curve in the plane (r, z)."""

    @property
    def length(self) -> float:
        """Length of the curve: the largest s."""

    def __call__(self, s: Array) -> Array:
        """(..., 2) places at s (...)."""

    def tangent(self, s: Array) -> Array:
        """(..., 2) unit vectors in the direction of s."""

    def foot(self, rz: Array) -> float:
        """s of the place nearest to a point (2,)."""


@dataclass(frozen=True)
class Segment:
    """A straight profile: cylinder, cone, ring."""

    start: tuple[float, float]
    end: tuple[float, float]

    @property
    def length(self) -> float:
        return float(np.hypot(*np.subtract(self.end, self.start)))

    def __call__(self, s: Array) -> Array:
        return np.asarray(
            self.start + np.asarray(s)[..., None] / self.length * np.subtract(self.end, self.start)
        )

    def tangent(self, s: Array) -> Array:
        return np.broadcast_to(np.subtract(self.end, self.start) / self.length, (*np.shape(s), 2))

    def foot(self, rz: Array) -> float:
        along = np.subtract(self.end, self.start) / self.length
        return float(np.clip((rz - self.start) @ along, 0.0, self.length))


@dataclass(frozen=True)
class Arc:
    """Part of a circle around (centre, 0), from the angle `start` to `end` (rad, from r towards z)."""

    radius: float
    start: float
    end: float
    centre: float = 0.0

    @property
    def length(self) -> float:
        return self.radius * (self.end - self.start)

    def __call__(self, s: Array) -> Array:
        angle = self.start + np.asarray(s) / self.radius
        return self.radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1) + [self.centre, 0.0]

    def tangent(self, s: Array) -> Array:
        angle = self.start + np.asarray(s) / self.radius
        return np.stack([-np.sin(angle), np.cos(angle)], axis=-1)

    def foot(self, rz: Array) -> float:
        turn = np.arctan2(rz[1], rz[0] - self.centre) - self.start
        beyond = 2 * np.pi - (self.end - self.start)
        turn = (turn + beyond / 2) % (
            2 * np.pi
        ) - beyond / 2  # a point beyond the arc belongs to the nearer end
        return float(np.clip(turn, 0.0, self.end - self.start) * self.radius)


class Spline:
    """A smooth profile through points (n, 2), over its arc length."""

    def __init__(self, points: Array) -> None:
        steps = np.hypot(*np.diff(points, axis=0).T)
        for _ in range(ROUNDS):  # from chords to arcs
            knots = np.concatenate([[0.0], np.cumsum(steps)])
            self._curve = scipy.interpolate.CubicSpline(knots, points)
            x, w = np.polynomial.legendre.leggauss(6)
            at = knots[:-1, None] + np.diff(knots)[:, None] * (x + 1) / 2
            steps = np.diff(knots) / 2 * (np.linalg.norm(self._curve(at, 1), axis=2) @ w)
        self.length = float(knots[-1])

    def __call__(self, s: Array) -> Array:
        return np.asarray(self._curve(s))

    def tangent(self, s: Array) -> Array:
        along = self._curve(s, 1)
        return np.asarray(along / np.linalg.norm(along, axis=-1)[..., None])

    def foot(self, rz: Array) -> float:
        coarse = np.linspace(0, self.length, 401, dtype=np.float64)
        nearest = int(np.argmin(np.linalg.norm(self(coarse) - rz, axis=1)))
        around = coarse[max(nearest - 1, 0)], coarse[min(nearest + 1, 400)]
        least = scipy.optimize.minimize_scalar(
            lambda s: np.sum((self(s) - rz) ** 2),
            bounds=around,
            method="bounded",
            options={"xatol": 1e-13},
        )
        ends = [float(least.x), *(float(s) for s in around)]
        return min(ends, key=lambda s: float(np.sum((self(np.array(s)) - rz) ** 2)))


@dataclass(frozen=True)
class Revolved:
    """Chart (rho theta, s) -> space."""

    profile: Profile
    rho: float

    def __call__(self, chart: Array) -> Array:
        theta, (r, z) = chart[:, 0] / self.rho, self.profile(chart[:, 1]).T
        return np.column_stack([r * np.cos(theta), r * np.sin(theta), z])

    def normal(self, chart: Array) -> Array:
        """Outward normals (n, 3)."""
        theta, (along_r, along_z) = chart[:, 0] / self.rho, self.profile.tangent(chart[:, 1]).T
        return np.column_stack([along_z * np.cos(theta), along_z * np.sin(theta), -along_r])

    def inverse(self, x: Array, first: float) -> Array:
        """Chart (2,) of a point (3,), theta in [first, first + 2 pi)."""
        theta = np.arctan2(x[1], x[0])
        theta = first + (theta - first + 1e-9) % (2 * np.pi) - 1e-9
        return np.array(
            [theta * self.rho, self.profile.foot(np.array([np.hypot(x[0], x[1]), x[2]]))]
        )


@dataclass(frozen=True)
class Capped:
    """Chart t (cos theta, sin theta), t from the pole at the profile's end -> space."""

    profile: Profile

    def __call__(self, chart: Array) -> Array:
        t = np.hypot(chart[:, 0], chart[:, 1])
        r, z = self.profile(self.profile.length - t).T
        return np.column_stack([r[:, None] * _direction(chart, t), z])

    def normal(self, chart: Array) -> Array:
        """Outward normals (n, 3)."""
        t = np.hypot(chart[:, 0], chart[:, 1])
        along_r, along_z = self.profile.tangent(self.profile.length - t).T
        return np.column_stack([along_z[:, None] * _direction(chart, t), -along_r])

    def from_pole(self, places: Array) -> Array:
        """Length (n,) of the meridian from the pole to places (n, 3) of the surface."""
        rz = np.column_stack([np.hypot(places[:, 0], places[:, 1]), places[:, 2]])
        coarse = np.linspace(0, self.profile.length, 2001, dtype=np.float64)
        s = coarse[scipy.spatial.cKDTree(self.profile(coarse)).query(rz)[1]]
        for _ in range(ROUNDS):  # Newton's method, whose residual vanishes on the surface
            s = np.clip(
                s + np.sum((rz - self.profile(s)) * self.profile.tangent(s), axis=1),
                0,
                self.profile.length,
            )
        return np.asarray(self.profile.length - s)

    def inverse(self, x: Array) -> Array:
        """Chart (2,) of a point (3,)."""
        rho = np.hypot(x[0], x[1])
        t = self.profile.length - self.profile.foot(np.array([rho, x[2]]))
        return t * x[:2] / rho if rho > 0 else np.zeros(2)


def _direction(chart: Array, t: Array) -> Array:
    """cos theta and sin theta, (n, 2); zero at the pole."""
    return np.where(t[:, None] > 0, chart / np.maximum(t, 1e-300)[:, None], 0.0)

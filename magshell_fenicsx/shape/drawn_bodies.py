"""Faces of simple bodies for pictures: triangles in their own axes, and the poles of magnets.

In go radii, heights or edges, in any unit of length; out comes a `Solid`. A face is smooth within,
as its triangles share corners. Faces meet in edges, where each has corners of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
CIRCLE_POINTS = 48  # corners on a circle
AXIS_TOLERANCE = 1e-12  # over the largest radius: a cosine of 90 degrees is not quite zero
AREA_TOLERANCE = 1e-12  # over the largest area: smaller triangles count as flat


@dataclass(frozen=True)
class Solid:
    """A body or a magnet as it is drawn.

    Attributes
    ----------
    points
        (n, 3) corners; two faces that meet in an edge have separate corners there.
    triangles
        (m, 3) numbers of the corners of each triangle.
    name
        Name of the body or the source.
    poles
        (n,) of a magnet: positive on the north pole's half, negative on the other. None or zero for
        a body that is no magnet.
    """

    points: Array
    triangles: NDArray[np.int64]
    name: str = ""
    poles: Array | None = None

    def transformed(self, Q: Array, t: Array, scale: float = 1.0) -> "Solid":
        """Return the body at the places scale Q x + t."""
        return replace(self, points=scale * self.points @ Q.T + t)

    def magnetised(self, polarization: Array, name: str) -> "Solid":
        """Return the body as a magnet of that name with a polarization (3,)."""
        # heights along the polarization: only their sign is a pole
        middle = (self.points.max(axis=0) + self.points.min(axis=0)) / 2
        size = np.linalg.norm(polarization) or 1.0
        poles = np.asarray((self.points - middle) @ polarization / size)
        return replace(self, poles=poles, name=name)

    @property
    def creases(self) -> list[Array]:
        """Lines, each with two ends (2, 3), along the edges where faces end."""
        sides = np.concatenate([self.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
        edges, count = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
        # sides that belong to one triangle alone
        lines = [self.points[pair] for pair in edges[count == 1]]
        return [line for line in lines if np.ptp(line, axis=0).max() > 0]


def revolved(*profiles: Sequence[tuple[float, float]]) -> Solid:
    """Return a solid of revolution about z.

    Parameters
    ----------
    profiles
        Each is a sequence of points (rho, z). A profile gives a smooth face, and the faces of
        several profiles meet in edges.
    """
    t = 2 * np.pi * np.arange(CIRCLE_POINTS) / CIRCLE_POINTS
    points, triangles = [], []
    start, next_on_circle = 0, (np.arange(CIRCLE_POINTS) + 1) % CIRCLE_POINTS
    on_axis = AXIS_TOLERANCE * max(rho for profile in profiles for rho, _ in profile)
    for profile in profiles:
        circles = list[NDArray[np.int64]]()
        for rho, z in profile:
            heights = np.full(CIRCLE_POINTS, z)
            points.append(np.column_stack([rho * np.cos(t), rho * np.sin(t), heights]))
            # on the axis there is one point: all numbers of the circle are the first
            circles.append(start + np.arange(CIRCLE_POINTS) * (rho > on_axis))
            start += CIRCLE_POINTS
        # two triangles for each side of a band between circles
        for low, high in pairwise(circles):
            triangles.append(np.column_stack([low, low[next_on_circle], high[next_on_circle]]))
            triangles.append(np.column_stack([low, high[next_on_circle], high]))
    return _without_flat_triangles(np.concatenate(points), np.concatenate(triangles))


def disc(radius: float) -> Solid:
    """Return a disc normal to z, about the origin."""
    return revolved([(0, 0), (radius, 0)])


def cylinder(radius: float, height: float, hole: float = 0.0) -> Solid:
    """Return a cylinder about z, or a ring with a hole of radius `hole`; centred at the origin."""
    low, high = -height / 2, height / 2
    faces = [
        [(hole, low), (radius, low)],
        [(radius, low), (radius, high)],
        [(radius, high), (hole, high)],
    ]
    return revolved(*faces, *([[(hole, high), (hole, low)]] if hole else []))


def globe(radius: float) -> Solid:
    """Return a sphere about the origin."""
    t = np.linspace(-np.pi / 2, np.pi / 2, CIRCLE_POINTS // 2 + 1)
    return revolved([(radius * float(np.cos(a)), radius * float(np.sin(a))) for a in t])


def block(half: Array) -> Solid:
    """Return a cuboid about the origin; `half` (3,) are half its edges."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    faces = [
        np.insert(square, axis, side, axis=1) * half for axis in range(3) for side in (-1.0, 1.0)
    ]
    # each face has four corners of its own
    triangles = [4 * k + np.array([[0, 1, 2], [0, 2, 3]]) for k in range(6)]
    return Solid(np.concatenate(faces), np.concatenate(triangles))


def _without_flat_triangles(points: Array, triangles: NDArray[np.int64]) -> Solid:
    """Return the solid without the triangles on the axis, which have no area."""
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return Solid(points, triangles[area > AREA_TOLERANCE * area.max()])

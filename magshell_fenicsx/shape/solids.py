"""The faces of simple bodies, for pictures: triangles around their own axes, with the poles of
magnets.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
AROUND = 48  # points of a circle
SAME = 1e-12  # a triangle of less area over that of the largest is none


@dataclass(frozen=True)
class Solid:
    """A body or a magnet as it is drawn.

    Attributes
    ----------
    points
        (n, 3) corners; two faces that meet in an edge have their own there.
    triangles
        (m, 3) their numbers.
    name
        Of the body or the source.
    poles
        (n,) of a magnet: positive on the north pole's half, negative on the other; zero of what is
        no magnet.
    """

    points: Array
    triangles: NDArray[np.int64]
    name: str = ""
    poles: Array | None = None

    def moved(self, Q: Array, t: Array, scale: float = 1.0) -> "Solid":
        """At the places Q x scale + t."""
        return replace(self, points=scale * self.points @ Q.T + t)

    def magnetised(self, along: Array, name: str) -> "Solid":
        """A magnet of that name with its polarization along a vector (3,)."""
        middle = (self.points.max(axis=0) + self.points.min(axis=0)) / 2
        size = np.linalg.norm(along) or 1.0
        return replace(self, poles=np.asarray((self.points - middle) @ along / size), name=name)

    @property
    def creases(self) -> list[Array]:
        """Lines (2, 3) where faces end."""
        sides = np.sort(
            np.concatenate([self.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1
        )
        edges, count = np.unique(sides, axis=0, return_counts=True)
        return [
            self.points[pair]
            for pair in edges[count == 1]
            if np.ptp(self.points[pair], axis=0).max() > 0
        ]


def revolved(*profiles: Sequence[tuple[float, float]]) -> Solid:
    """A solid of revolution about z: of each profile, points (rho, z), a smooth face; faces meet in
    edges.
    """
    t = 2 * np.pi * np.arange(AROUND) / AROUND
    points, triangles = [], []
    start, next_one = 0, (np.arange(AROUND) + 1) % AROUND
    on_axis = SAME * max(
        rho for profile in profiles for rho, _ in profile
    )  # a cosine of 90 degrees is not quite zero
    for profile in profiles:
        rings = list[NDArray[np.int64]]()
        for rho, z in profile:
            points.append(np.column_stack([rho * np.cos(t), rho * np.sin(t), np.full(AROUND, z)]))
            rings.append(
                start + np.arange(AROUND) * (rho > on_axis)
            )  # on the axis there is one point
            start += AROUND
        for low, high in pairwise(rings):
            triangles.append(np.column_stack([low, low[next_one], high[next_one]]))
            triangles.append(np.column_stack([low, high[next_one], high]))
    return _whole(np.concatenate(points), np.concatenate(triangles))


def disc(radius: float) -> Solid:
    """A disc across z."""
    return revolved([(0, 0), (radius, 0)])


def cylinder(radius: float, height: float, hole: float = 0.0) -> Solid:
    """A cylinder or a ring."""
    low, high = -height / 2, height / 2
    faces = [
        [(hole, low), (radius, low)],
        [(radius, low), (radius, high)],
        [(radius, high), (hole, high)],
    ]
    return revolved(*faces, *([[(hole, high), (hole, low)]] if hole else []))


def globe(radius: float) -> Solid:
    """A sphere."""
    t = np.linspace(-np.pi / 2, np.pi / 2, AROUND // 2 + 1)
    return revolved([(radius * float(np.cos(a)), radius * float(np.sin(a))) for a in t])


def block(half: Array) -> Solid:
    """A cuboid of half the sizes (3,)."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    faces = [
        np.insert(square, axis, side, axis=1) * half for axis in range(3) for side in (-1.0, 1.0)
    ]
    triangles = [4 * k + np.array([[0, 1, 2], [0, 2, 3]]) for k in range(6)]
    return Solid(np.concatenate(faces), np.concatenate(triangles))


def _whole(points: Array, triangles: NDArray[np.int64]) -> Solid:
    """Without the triangles on the axis, which have no area."""
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return Solid(points, triangles[area > SAME * area.max()])

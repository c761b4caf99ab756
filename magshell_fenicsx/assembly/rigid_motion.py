"""Rigid motions, each proportional to its amplitude, carried out one after the other.

Moving supports and moving magnetic sources are described by them. Theory: docs/theory.md, moving
supports.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
AmplitudePair = tuple[str, str]


@dataclass(frozen=True)
class RigidMotion:
    """The motion x -> Rot(mu turn) (x - centre) + centre + mu shift.

    Attributes
    ----------
    name
        Name of the amplitude mu.
    shift
        Translation (3,) over R.
    turn
        Rotation vector (3,): the axis times the angle (rad).
    centre
        A place (3,) on the axis, over R.
    """

    name: str
    shift: Array
    turn: Array
    centre: Array

    @property
    def turns(self) -> bool:
        """Whether the motion has a rotation."""
        return bool(self.turn.any())

    @property
    def linear(self) -> "RigidMotion":
        """The rotation of vectors, without translation and centre."""
        return replace(self, shift=np.zeros(3), centre=np.zeros(3))

    def rotation(self, mu: float) -> tuple[Array, Array, Array]:
        """Return Rot(mu turn) (3, 3) and its first two derivatives by mu (Rodrigues)."""
        angle = float(np.linalg.norm(self.turn))
        x, y, z = self.turn / (angle or 1.0)
        N = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        NN, c, s = N @ N, np.cos(mu * angle), np.sin(mu * angle)
        return (
            np.eye(3) + s * N + (1 - c) * NN,
            angle * (c * N + s * NN),
            angle**2 * (c * NN - s * N),
        )


@dataclass(frozen=True)
class MovedPoints:
    """Places after some motions, with their derivatives by the amplitudes.

    Attributes
    ----------
    x
        (n, 3).
    slopes
        Amplitude -> dx/dmu, (n, 3).
    curvatures
        Two amplitudes, in each order -> d2x/dmu_i dmu_j, (n, 3).
    """

    x: Array
    slopes: Mapping[str, Array]
    curvatures: Mapping[AmplitudePair, Array]


def apply_motions(motions: Sequence[RigidMotion], mu: Mapping[str, float], x: Array) -> MovedPoints:
    """Return places (n, 3) after motions with different amplitudes, one after the other."""
    slopes: dict[str, Array] = {}
    curvatures: dict[AmplitudePair, Array] = {}
    for motion in motions:
        Q, Q1, Q2 = (q.T for q in motion.rotation(mu[motion.name]))
        name, arm = motion.name, x - motion.centre
        curvatures = {pair: d @ Q for pair, d in curvatures.items()}
        for other, d in slopes.items():
            curvatures[other, name] = curvatures[name, other] = d @ Q1
        slopes = {other: d @ Q for other, d in slopes.items()}
        slopes[name], curvatures[name, name] = arm @ Q1 + motion.shift, arm @ Q2
        x = arm @ Q + motion.centre + mu[name] * motion.shift
    return MovedPoints(x, slopes, curvatures)


def total_rotation(motions: Sequence[RigidMotion], mu: Mapping[str, float]) -> MovedPoints:
    """Return the rotation of all motions together: its row `x[i]` of (3, 3) is the image of e_i."""
    return apply_motions([motion.linear for motion in motions], mu, np.eye(3))

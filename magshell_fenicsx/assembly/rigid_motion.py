"""Rigid motions, each proportional to its amplitude, carried out one after the other.

Moving supports and moving magnetic sources are described by them. Theory: docs/theory.md, moving
supports.

mu is the amplitude of a motion, R the reference length. Points are rows, so matrices act on them
from the right, transposed.
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
        """The same motion of vectors: the rotation, without translation and centre."""
        return replace(self, shift=np.zeros(3), centre=np.zeros(3))

    def rotation(self, mu: float) -> tuple[Array, Array, Array]:
        """Return Rot(mu turn) (3, 3) and its first two derivatives by mu (Rodrigues' formula)."""
        angle = float(np.linalg.norm(self.turn))
        # N is the matrix of the cross product with the axis; without a turn it is zero
        x, y, z = self.turn / (angle or 1.0)
        N = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        NN, c, s = N @ N, np.cos(mu * angle), np.sin(mu * angle)
        # the rotation, and its first and second derivative by mu
        return (
            np.eye(3) + s * N + (1 - c) * NN,
            angle * (c * N + s * NN),
            angle**2 * (c * NN - s * N),
        )


@dataclass(frozen=True)
class MovedPoints:
    """Places of n points after some motions, with their derivatives by the amplitudes.

    Attributes
    ----------
    x
        (n, 3): the places, over R.
    slopes
        Amplitude -> dx/dmu, (n, 3).
    curvatures
        Pair of amplitudes, in each order -> d2x/dmu_i dmu_j, (n, 3).
    """

    x: Array
    slopes: Mapping[str, Array]
    curvatures: Mapping[AmplitudePair, Array]


def apply_motions(motions: Sequence[RigidMotion], mu: Mapping[str, float], x: Array) -> MovedPoints:
    """Return places after motions, carried out one after the other, with all derivatives.

    Parameters
    ----------
    motions
        Motions with different amplitudes.
    mu
        Amplitude -> its value; it has all of the motions.
    x
        (n, 3): the places before, over R.
    """
    slopes: dict[str, Array] = {}
    curvatures: dict[AmplitudePair, Array] = {}
    for motion in motions:
        # the transposed rotation and its first two derivatives by this amplitude
        Q, Q1, Q2 = (matrix.T for matrix in motion.rotation(mu[motion.name]))
        name, arm = motion.name, x - motion.centre
        # this motion turns the derivatives by two earlier amplitudes
        curvatures = {pair: derivative @ Q for pair, derivative in curvatures.items()}
        # second derivatives by an earlier amplitude and this one, in both orders
        for earlier_name, derivative in slopes.items():
            curvatures[earlier_name, name] = curvatures[name, earlier_name] = derivative @ Q1
        # it turns the first derivatives by earlier amplitudes, too
        slopes = {earlier_name: derivative @ Q for earlier_name, derivative in slopes.items()}
        # derivatives by this amplitude alone
        slopes[name] = arm @ Q1 + motion.shift
        curvatures[name, name] = arm @ Q2
        x = arm @ Q + motion.centre + mu[name] * motion.shift
    return MovedPoints(x, slopes, curvatures)


def total_rotation(motions: Sequence[RigidMotion], mu: Mapping[str, float]) -> MovedPoints:
    """Return the rotation of all motions together, with its derivatives by their amplitudes.

    Row i of its `x` (3, 3) is the image of e_i, so that `x` is the transposed rotation matrix.
    """
    return apply_motions([motion.linear for motion in motions], mu, np.eye(3))

"""Rigid motions, each as large as its amplitude, carried out one after the other."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Pair = tuple[str, str]


@dataclass(frozen=True)
class Motion:
    """x -> Rot(mu turn) (x - centre) + centre + mu shift.

    Attributes
    ----------
    name
        Of the amplitude mu.
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
        return bool(self.turn.any())

    @property
    def linear(self) -> "Motion":
        """The rotation of vectors."""
        return replace(self, shift=np.zeros(3), centre=np.zeros(3))

    def rotation(self, mu: float) -> tuple[Array, Array, Array]:
        """Rot(mu turn) (3, 3) with its first two derivatives by mu (Rodrigues)."""
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
class Moved:
    """Places after some motions.

    Attributes
    ----------
    x
        (n, 3).
    by
        Amplitude -> dx/dmu.
    twice
        Two amplitudes, in each order -> d2x/dmu_i dmu_j.
    """

    x: Array
    by: Mapping[str, Array]
    twice: Mapping[Pair, Array]


def moved(motions: Sequence[Motion], mu: Mapping[str, float], x: Array) -> Moved:
    """Places (n, 3) after motions with different amplitudes, one after the other."""
    by: dict[str, Array] = {}
    twice: dict[Pair, Array] = {}
    for motion in motions:
        Q, Q1, Q2 = (q.T for q in motion.rotation(mu[motion.name]))
        name, arm = motion.name, x - motion.centre
        twice = {pair: d @ Q for pair, d in twice.items()}
        for other, d in by.items():
            twice[other, name] = twice[name, other] = d @ Q1
        by = {other: d @ Q for other, d in by.items()}
        by[name], twice[name, name] = arm @ Q1 + motion.shift, arm @ Q2
        x = arm @ Q + motion.centre + mu[name] * motion.shift
    return Moved(x, by, twice)


def turned(motions: Sequence[Motion], mu: Mapping[str, float]) -> Moved:
    """The rotation of all motions together: vectors as rows of `x` (3, 3), e_i -> x[i]."""
    return moved([motion.linear for motion in motions], mu, np.eye(3))

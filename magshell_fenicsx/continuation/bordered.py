"""The bordered matrix of (u, mu) and its inverse, by block elimination."""

import numpy as np

from magshell_fenicsx.continuation.control import Row, slope
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import Direction, State, System, Vector, dot, max_abs


def plus(a: Direction, factor: float, b: Direction) -> Direction:
    """a + factor b."""
    return a[0] + factor * b[0], a[1] + factor * b[1]


class Bordered:
    """The matrix [K R_mu; c d] at a state.

    Parameters
    ----------
    factors
        The factors of K at the state.
    name
        The amplitude mu.
    row
        The last row, whose gradient is (c, d).

    Attributes
    ----------
    column
        R_mu.
    """

    def __init__(self, system: System, factors: Factorisation, state: State, name: str, row: Row) -> None:
        self.state, self.row, self._mu = state, row, state.mu[name]
        self._comm, self._factors, self._length = system.comm, factors, system.length
        self._gradient = row.gradient(state)
        self.column = system.load(state.u, state.mu, name)
        self._x2 = factors.solve(self.column)
        self._schur = slope(self._comm, self._gradient, (-self._x2, 1.0))
        self._weight = dot(self._comm, self._x2, self._x2)  # dmu counts as the displacement that it causes

    def size(self, step: Direction) -> float:
        """The size of a step: the larger of du, in lengths of the system, and dmu.

        dmu counts relative to mu or as the displacement that it causes, whichever is smaller.
        """
        moved = max_abs(self._comm, self._x2) / self._length
        per_mu = min(moved, 1 / abs(self._mu)) if self._mu else moved
        return max(max_abs(self._comm, step[0]) / self._length, abs(step[1]) * per_mu)

    def solve(self, f: Vector, g: float) -> Direction:
        """(du, dmu) with K du + R_mu dmu = f and c.du + d dmu = g."""
        x1 = self._factors.solve(f)
        dmu = (g - slope(self._comm, self._gradient, (x1, 0.0))) / self._schur
        return x1 - dmu * self._x2, dmu

    @property
    def tangent(self) -> Direction:
        """The solution for f = 0 and g = 1."""
        return np.asarray(-self._x2 / self._schur), 1 / self._schur

    def inner(self, a: Direction, b: Direction) -> float:
        """Inner product in which Broyden's update is the smallest."""
        return dot(self._comm, a[0], b[0]) + self._weight * a[1] * b[1]

    def times(self, du: Vector, dmu: float) -> Direction:
        """The matrix times a direction."""
        return self._factors.times(du) + dmu * self.column, slope(self._comm, self._gradient, (du, dmu))

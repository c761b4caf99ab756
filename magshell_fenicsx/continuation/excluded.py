"""The equations of a bifurcation into modes that a model excludes, with a second number p as
unknown.

Modes of a family m (waves of a meridian) have a tangent K_m of their own at a state of the model,
and the path before them is regular: R(u, mu, p) = 0 and g(u, mu, p) = 0, with K_m v + g b = 0 and b
. v = 1, so that dg = -v . dK_m v. Families do not couple. So where two of them are neutral at once
both equations are regular, and each goes on alone.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.continuation.augmented import Family, Row, Way
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.fold import offset
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.system import State, Vector, dot, max_abs

SOLVES = 40  # of the inverse iteration for an eigenvalue
AGREE = 1e-9  # relative change of the eigenvalue that ends it
DIFFERENCE = 1e-4  # relative, of an amplitude


class Excluding(Family, Protocol):
    """Systems that differ by a number p, and what they exclude."""

    def factored(self, p: float, state: State, m: int) -> Factorisation:
        """The tangent of a family at a state; the next call may overwrite it."""

    def along(self, p: float, state: State, m: int, v: Vector) -> float:
        """v . K_m v."""

    def counts(self, p: float, state: State) -> Sequence[int]:
        """Numbers of unstable directions of the families 1, 2, ..."""


class ExcludedLines:
    """The rows of Newton's step at a state: du = -w_R - dmu w_mu - dp w_p.

    Attributes
    ----------
    v, g
        Null vector and residual of K_m v + g b = 0.
    pull, bend
        Of `Locus`; there is no work along v.
    """

    def __init__(
        self,
        newton: BorderedNewton,
        state: State,
        name: str,
        b: Vector,
        m: int,
        family: Excluding,
        p: float,
        beside: Sequence[tuple[float, float]],
    ) -> None:
        self._system, self._family, self._m, self.pull, self.bend = (
            newton.system,
            family,
            m,
            0.0,
            0.0,
        )
        self._p, self._state, self._b = p, state, b
        system, own, u, mu = newton.system, state.mu[name], state.u, state.mu
        self._factors = newton.factor_at(state)
        self._comm = comm = system.comm
        of_family = family.factored(p, state, m)
        y = of_family.solve(b)
        compliance = dot(comm, b, y)
        self.v: Vector = np.asarray(y / compliance)
        self.g = -1 / compliance
        self._besides = of_family.negative_pivots - (compliance < 0)
        R_p, K_p = 0.0 * u, 0.0
        for weight, q in beside:
            there = State(u, {**family.amplitudes(q), name: own})
            R_p = R_p + weight * family.at(q).system.residual(u, there.mu)
            K_p += weight * family.along(q, there, m, self.v)
        self._w_mu = self._factors.solve(system.load(u, mu, name))
        self._w_p = self._factors.solve(R_p)
        d = DIFFERENCE * (abs(own) or 1.0)
        ahead, back = (
            family.along(p, State(u, {**mu, name: own + step}), m, self.v) for step in (d, -d)
        )
        self._g_mu, self._g_p = (
            -(ahead - back) / (2 * d) - self._by(self._w_mu),
            -K_p - self._by(self._w_p),
        )
        self.balance(system.residual(u, mu))

    def counts(self) -> list[int]:
        """Numbers of unstable directions besides v, of the model and of each family."""
        m, counts = self._m, list(self._family.counts(self._p, self._state))
        counts += [0] * (m - len(counts))
        counts[m - 1] = self._besides
        return [self._factors.negative_pivots, *counts]

    def balance(self, residual: Vector) -> None:
        """Take the residual at a state close by, with the same factors."""
        self._w_R = self._factors.solve(residual)

    def step(self, row: Row, value: float | None, *, settled: bool = False) -> Way:
        """See `augmented.Lines.step`."""
        comm, w_mu, w_p = self._comm, self._w_mu, self._w_p
        w_R = self._w_R if value is not None else 0.0 * w_mu
        g = (0.0 if settled else self.g - self._by(w_R)) if value is not None else 0.0
        c = [-dot(comm, row.du, w) for w in (w_mu, w_p, w_R)] if row.du is not None else [0.0] * 3
        rows = np.array([[self._g_mu, self._g_p], [c[0] + row.dmu, c[1] + row.dp]])
        rest = np.array([g, c[2] + value if value is not None else -1.0])
        size = np.abs(rows).max(axis=1)
        dmu, dp = np.linalg.solve(rows / size[:, None], -rest / size)
        return Way(-w_R - dmu * w_mu - dp * w_p, float(dmu), float(dp))

    def eigenvalue(self, m: int, p: float, state: State) -> float:
        """The eigenvalue of a family's tangent that is nearest to zero; of the model's own tangent
        for m = 0.

        Of the family of v the one across b.
        """
        factors = self._family.factored(p, state, m) if m else self._factors
        return nearest_eigenvalue(factors, self._comm, self._b if m == self._m else None)

    def _by(self, w: Vector) -> float:
        """The derivative of g along a displacement."""
        if not max_abs(self._comm, w):
            return 0.0
        d, state = offset(self._system, w), self._state
        ahead, back = (
            self._family.along(self._p, State(state.u + step * w, state.mu), self._m, self.v)
            for step in (d, -d)
        )
        return -(ahead - back) / (2 * d)


def nearest_eigenvalue(
    factors: Factorisation, comm: MPI.Comm, across: Vector | None = None
) -> float:
    """The eigenvalue nearest to zero of a matrix, of those across a vector."""
    along = None if across is None else factors.solve(across)
    x, value = np.sin(1.0 + np.arange(factors.matrix.getLocalSize()[0]) + comm.rank), np.inf
    for _ in range(SOLVES):
        y = factors.solve(x)
        if across is not None and along is not None:  # the bordered tangent is regular
            y = y - dot(comm, across, y) / dot(comm, across, along) * along
        last, value = value, float(dot(comm, x, x) / dot(comm, x, y))
        if abs(value - last) <= AGREE * abs(value):
            break
        x = y / np.sqrt(dot(comm, y, y))
    return value

"""Newton's method with known solutions deflated: it finds others.

The residual R is multiplied by M, which grows without bound at each known solution u_i. Newton's
step for M R is a multiple of that for R, so it needs neither another matrix nor another solve (P.
E. Farrell, A. Birkisson, S. W. Funke, SIAM Journal on Scientific Computing 37, 2015, A2026):

    M(u) = prod_i (|u - u_i|^-p + sigma),    du = tau d,    K d = -R,    tau = 1/(1 - d . grad M/M)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magshell_fenicsx.continuation.control import Bordered, Metric, Row, plus
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.system import State, Vector

POWER, SHIFT = 2.0, 1.0  # p and sigma
MOST_ITERATIONS = 40
CLOSE = 1e-3  # in lengths of the system: after a shorter step Newton's method itself goes on
NEAR_ONE = 2.0  # there the deflation must change the step by less than this factor
BENT = 0.5  # part of a step that the linear model may leave unexplained
LEAST = 1e-3  # where a shorter part of a step would be needed, a singular tangent is near
LEAP, MOST_LEAPS = 1.0, 4  # in lengths of the system: a step over it


@dataclass(frozen=True)
class Deflation:
    """The operator M of some known solutions; |.| is the root mean square over the system's length."""

    metric: Metric
    known: Sequence[Vector]

    def value(self, u: Vector) -> float:
        """M at u."""
        sizes = (self.metric.norm(u - v, 0.0) for v in self.known)
        return float(np.prod([size**-POWER + SHIFT if size else np.inf for size in sizes]))

    def slope(self, u: Vector, d: Vector) -> float:
        """d . grad M/M at u."""
        total = 0.0
        for v in self.known:
            away = (u - v, 0.0)
            size = self.metric.norm(*away)
            total -= (
                POWER * self.metric.inner(away, (d, 0.0)) / (size**2 * (1 + SHIFT * size**POWER))
                if size
                else np.inf
            )
        return total

    def factor(self, u: Vector, d: Vector) -> float:
        """tau for Newton's step d at u; zero at a known solution."""
        rest = 1 - self.slope(u, d)
        return 1 / rest if rest else np.inf


def deflated(
    newton: BorderedNewton, guess: State, name: str, row: Row, known: Sequence[Vector] = ()
) -> State | None:
    """A state near a solution that is not known and on which a row holds; None if none is found.

    Steps are shortened until the residual changes as the tangent says. Newton's method must confirm
    the result.

    Parameters
    ----------
    name
        The amplitude that the row determines.
    known
        The displacements of the known solutions.
    """
    system, state, part, leaps = newton.system, guess, 1.0, 0
    deflation = Deflation(Metric(system, 1.0), known)
    residual = system.residual(state.u, state.mu), row.residual(state)
    for _ in range(MOST_ITERATIONS):
        matrix = Bordered(system, newton.factor_at(state), state, name, row)
        d = matrix.solve(-residual[0], -residual[1])
        tau, size, M = deflation.factor(state.u, d[0]), matrix.size(d), deflation.value(state.u)
        if not np.isfinite(size) or not np.isfinite(tau) or tau == 0.0:
            return None
        if size <= CLOSE and 1 / NEAR_ONE < tau < NEAR_ONE:
            return state.with_(state.u + d[0], name, state.mu[name] + d[1])
        part, bent = min(1.0, 4 * part), np.inf
        while not bent <= BENT:
            leaps += (leap := part < LEAST)
            if leaps > MOST_LEAPS:
                return None
            part = LEAP / (abs(tau) * size) if leap else part
            ahead = state.with_(
                state.u + part * tau * d[0], name, state.mu[name] + part * tau * d[1]
            )
            residual = system.residual(ahead.u, ahead.mu), row.residual(ahead)
            left = matrix.solve(-residual[0], -residual[1])
            left = plus(
                left, tau * deflation.slope(state.u, left[0]), d
            )  # the next step with the same matrix, over M
            ratio = deflation.value(ahead.u) / M
            rest = (
                ratio * left[0] + (part - 1) * tau * d[0],
                ratio * left[1] + (part - 1) * tau * d[1],
            )
            bent = np.sqrt(matrix.inner(rest, rest) / matrix.inner(d, d)) / abs(part * tau)
            if leap:
                break
            if not bent <= BENT:
                part *= float(np.clip(0.8 * BENT / bent, 0.1, 0.5)) if np.isfinite(bent) else 0.1
        part, state = min(part, 1.0), ahead
    return None

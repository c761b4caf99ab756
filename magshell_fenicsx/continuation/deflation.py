"""Newton's method with known solutions deflated, so that it finds other ones.

The residual R is multiplied by M, which grows without bound at each known solution u_i. Newton's
step for M R is a multiple of that for R, so it needs neither another matrix nor another solve (P.
E. Farrell, A. Birkisson, S. W. Funke, SIAM Journal on Scientific Computing 37, 2015, A2026):

    M(u) = prod_i (|u - u_i|^-p + sigma),    du = tau d,    K d = -R,    tau = 1/(1 - d . grad M/M)

d is Newton's step at u without M, tau d the step with it; grad M/M is the gradient of log M. A row
is a scalar equation that is solved together with equilibrium, R = 0, for u and one amplitude (load
parameter).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magshell_fenicsx.continuation.control import BorderedMatrix, ConstraintRow, Metric, add_scaled
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.system import State, Vector

POWER, SHIFT = 2.0, 1.0  # p and sigma
MAX_ITERATIONS = 40
FINAL_STEP = 1e-3  # in lengths of the system: after a shorter step Newton's method itself goes on
MAX_DEFLATION_FACTOR = 2.0  # there the deflation must change the step by less than this factor
MAX_NONLINEARITY = 0.5  # fraction of a step that the linear model may leave unexplained
# where a shorter fraction of a step would be needed, a singular tangent is near
MIN_STEP_FRACTION = 1e-3
LEAP_LENGTH, MAX_LEAPS = 1.0, 4  # in lengths of the system: a step over a singular tangent


@dataclass(frozen=True)
class Deflation:
    """The deflation operator M of known solutions.

    Its norm |.| is the root mean square of a displacement over the system's length.

    Attributes
    ----------
    metric
        The metric whose norm of a displacement that is.
    known_solutions
        The displacements u_i.
    """

    metric: Metric
    known_solutions: Sequence[Vector]

    def value(self, u: Vector) -> float:
        """Return M at u. Collective."""
        distances = (self.metric.norm(u - v, 0.0) for v in self.known_solutions)
        return float(np.prod([r**-POWER + SHIFT if r else np.inf for r in distances]))

    def slope(self, u: Vector, d: Vector) -> float:
        """Return d . grad M/M at u, for a step d; -inf at a known solution. Collective."""
        slope = 0.0
        for v in self.known_solutions:
            difference = (u - v, 0.0)
            distance = self.metric.norm(*difference)
            if not distance:
                return -np.inf
            # the derivative along d of log(r^-p + sigma), r the distance
            component = self.metric.inner(difference, (d, 0.0))
            slope -= POWER * component / (distance**2 * (1 + SHIFT * distance**POWER))
        return slope

    def factor(self, u: Vector, d: Vector) -> float:
        """Return tau, the factor by which M changes Newton's step d at u; zero at a known solution.

        Collective.
        """
        divisor = 1 - self.slope(u, d)
        return 1 / divisor if divisor else np.inf


def find_deflated(
    newton: BorderedNewton,
    guess: State,
    name: str,
    row: ConstraintRow,
    known_solutions: Sequence[Vector] = (),
) -> State | None:
    """Find a state near an unknown solution on which a row holds. Collective.

    Steps are shortened until the residual changes as the tangent says. Where that needs tiny steps,
    a long one leaps over the singular tangent, a few times. Newton's method must confirm the
    result.

    Parameters
    ----------
    guess
        The state from which the iteration starts.
    name
        The amplitude that the row determines.
    row
        The scalar equation that is solved together with equilibrium.
    known_solutions
        The displacements of the known solutions.

    Returns
    -------
    The state; None if none is found.
    """
    system, state, fraction, leaps = newton.system, guess, 1.0, 0
    deflation = Deflation(Metric(system, 1.0), known_solutions)  # no amplitude is compared
    residual = system.residual(state.u, state.mu), row.residual(state)
    for _ in range(MAX_ITERATIONS):
        matrix = BorderedMatrix(system, newton.factor_at(state), state, name, row)
        newton_step = matrix.solve(-residual[0], -residual[1])
        tau = deflation.factor(state.u, newton_step[0])
        size = matrix.size(newton_step)
        M = deflation.value(state.u)
        if not np.isfinite(size) or not np.isfinite(tau) or tau == 0.0:
            return None
        if size <= FINAL_STEP and 1 / MAX_DEFLATION_FACTOR < tau < MAX_DEFLATION_FACTOR:
            return state.with_(state.u + newton_step[0], name, state.mu[name] + newton_step[1])
        # the step is shortened until the linear model explains enough of its residual
        fraction, nonlinearity = min(1.0, 4 * fraction), np.inf
        while not nonlinearity <= MAX_NONLINEARITY:
            leap = fraction < MIN_STEP_FRACTION
            leaps += leap
            if leaps > MAX_LEAPS:
                return None
            if leap:
                fraction = LEAP_LENGTH / (abs(tau) * size)
            factor = fraction * tau
            trial = state.with_(
                state.u + factor * newton_step[0], name, state.mu[name] + factor * newton_step[1]
            )
            residual = system.residual(trial.u, trial.mu), row.residual(trial)
            next_step = matrix.solve(-residual[0], -residual[1])
            # the next step with the same matrix, over M
            next_step = add_scaled(
                next_step, tau * deflation.slope(state.u, next_step[0]), newton_step
            )
            ratio = deflation.value(trial.u) / M
            # what the linear model of M R leaves of the step, as displacement and amplitude
            unexplained = (
                ratio * next_step[0] + (fraction - 1) * tau * newton_step[0],
                ratio * next_step[1] + (fraction - 1) * tau * newton_step[1],
            )
            relative_square = matrix.inner(unexplained, unexplained) / matrix.inner(
                newton_step, newton_step
            )
            nonlinearity = np.sqrt(relative_square) / abs(factor)
            if leap:
                break
            if not nonlinearity <= MAX_NONLINEARITY:
                shorter = 0.1
                if np.isfinite(nonlinearity):
                    shorter = float(np.clip(0.8 * MAX_NONLINEARITY / nonlinearity, 0.1, 0.5))
                fraction *= shorter
        fraction, state = min(fraction, 1.0), trial
    return None

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
from magshell_fenicsx.continuation.system import Direction, State, Vector

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


@dataclass(frozen=True)
class _DeflatedStep:
    """Newton's step with deflation at an iterate.

    Attributes
    ----------
    matrix
        The bordered matrix at the iterate.
    u
        Displacement of the iterate.
    newton_step
        Newton's step (du, dmu) without deflation, d.
    tau, M
        The factor that deflation gives the step, and the value of M at the iterate.
    """

    deflation: Deflation
    matrix: BorderedMatrix
    u: Vector
    newton_step: Direction
    tau: float
    M: float

    def nonlinearity(
        self, trial_u: Vector, residual: tuple[Vector, float], fraction: float
    ) -> float:
        """Return which part of a step the linear model of M R leaves unexplained. Collective.

        Parameters
        ----------
        trial_u, residual
            The displacement after the step, and the residuals of equilibrium and row there.
        fraction
            The fraction of the deflated step tau d that was taken.
        """
        matrix, deflation = self.matrix, self.deflation
        next_step = matrix.solve(-residual[0], -residual[1])
        # the next step with the same matrix, over M
        next_step = add_scaled(
            next_step, self.tau * deflation.slope(self.u, next_step[0]), self.newton_step
        )
        ratio = deflation.value(trial_u) / self.M
        # the linear model leaves (1 - fraction) of the step: the difference from that, as
        # displacement and amplitude
        unexplained = (
            ratio * next_step[0] + (fraction - 1) * self.tau * self.newton_step[0],
            ratio * next_step[1] + (fraction - 1) * self.tau * self.newton_step[1],
        )
        relative_square = matrix.inner(unexplained, unexplained) / matrix.inner(
            self.newton_step, self.newton_step
        )
        return float(np.sqrt(relative_square) / abs(fraction * self.tau))


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
    # fraction: of the deflated step that is taken; leaps: their number so far
    system, state, fraction, leaps = newton.system, guess, 1.0, 0
    deflation = Deflation(Metric(system, 1.0), known_solutions)  # no amplitude is compared
    residual = system.residual(state.u, state.mu), row.residual(state)
    for _ in range(MAX_ITERATIONS):
        matrix = BorderedMatrix(system, newton.factor_at(state), state, name, row)
        newton_step = matrix.solve(-residual[0], -residual[1])
        tau = deflation.factor(state.u, newton_step[0])
        size = matrix.size(newton_step)
        step = _DeflatedStep(
            deflation, matrix, state.u, newton_step, tau=tau, M=deflation.value(state.u)
        )
        if not np.isfinite([size, tau]).all() or tau == 0.0:
            return None
        # close to a solution the deflation changes little: the undeflated step is the last one
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
            nonlinearity = step.nonlinearity(trial.u, residual, fraction)
            if leap:
                break
            if not nonlinearity <= MAX_NONLINEARITY:
                fraction *= _shortening(nonlinearity)
        fraction, state = min(fraction, 1.0), trial
    return None


def _shortening(nonlinearity: float) -> float:
    """Return the factor, 0.1 to 0.5, of a step that left too large a part unexplained.

    The unexplained part `nonlinearity` grows with the length of the step.
    """
    if not np.isfinite(nonlinearity):
        return 0.1
    return float(np.clip(0.8 * MAX_NONLINEARITY / nonlinearity, 0.1, 0.5))

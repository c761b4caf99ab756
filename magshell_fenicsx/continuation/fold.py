"""Folds: equilibrium with a singular tangent, R(u, mu) = 0 and g(u, mu) = 0, solved for (u, mu).

With g of `augmented.AugmentedTangent`, Newton's method for R = 0 and g = 0 takes one factorisation and
three back-solves an iteration.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magshell_fenicsx.continuation.augmented import AugmentedTangent, first_difference, third
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.system import Amplitudes, State, System, Vector, dot, max_abs

TOLERANCE = 1e-9  # estimated remaining error of u, over the system's length
ROUNDING = 1e-6  # smaller steps along phi that do not shrink are rounding of K, which is 1e-8 to 1e-7
MOST_ITERATIONS = 8
LARGEST_STEP = 10.0  # in lengths; a longer one counts as divergence


class FoldLost(RuntimeError):
    """No fold was found near the guess; the message gives the reason."""


@dataclass(frozen=True)
class Guess:
    """A state near a fold, and the null vector; without that it is computed from the tangent."""

    state: State
    phi: Vector | None = None


@dataclass(frozen=True)
class Fold:
    """A fold in the amplitude `name`.

    Attributes
    ----------
    phi
        Null vector of K; its largest entry is one in magnitude, and the displacement conjugate to
        the amplitude grows along it.
    left
        Null vector of the transposed K: `phi`, but for loads without potential.
    curvature
        Second derivative of the amplitude along the path in units of `phi` times the system's length;
        negative where the amplitude is largest.
    unstable
        Number of unstable directions besides `phi`.
    iterations, factorisations
        Work.
    """

    state: State
    name: str
    phi: Vector
    left: Vector
    curvature: float
    unstable: int
    iterations: int
    factorisations: int

    @property
    def value(self) -> float:
        """The amplitude at the fold."""
        return self.state.mu[self.name]


def find_fold(newton: BorderedNewton, guess: Guess, name: str) -> Fold:
    """The fold in the amplitude `name` near a guess, to 1e-9 lengths if rounding allows that.

    With tiny elements, rounding of K leaves an error of 1e-8 lengths along phi. The amplitude is stationary along phi,
    so it is accurate nevertheless.

    Raises
    ------
    FoldLost
        If Newton's method diverges or takes too long.
    """
    system, state, before = newton.system, guess.state, newton.factorisation.count
    b, steps = guess.phi, list[float]()
    while not steps or _remaining(steps) > TOLERANCE:
        if len(steps) == MOST_ITERATIONS:
            raise FoldLost(f"Newton's method found no fold in {MOST_ITERATIONS} iterations")
        try:
            tangent = AugmentedTangent(newton, state, b if b is not None else _first_shape(newton, state, name))
            du, dmu = _step(system, state, name, tangent)
        except np.linalg.LinAlgError:
            raise FoldLost("the tangent is singular in more than one direction") from None
        b = tangent.v
        steps.append(max_abs(system.comm, du) / system.length)
        growing = len(steps) > 2 and steps[-1] > max(2 * steps[-2], ROUNDING)
        if growing or not steps[-1] <= LARGEST_STEP:
            raise FoldLost("Newton's method diverged on its way to a fold")
        last, state = state, state.with_(state.u + du, name, state.mu[name] + dmu)
    phi = _oriented(system, tangent.improved(last, state), system.load(state.u, state.mu, name))
    pull, cubic = dot(system.comm, phi, system.load(state.u, state.mu, name)), third(system, state, phi)
    return Fold(
        state=state,
        name=name,
        phi=phi,
        left=_left(newton, state, phi) if newton.factorisation.skewed else phi,
        curvature=-dot(system.comm, phi, cubic) * system.length**2 / pull,
        unstable=tangent.unstable,
        iterations=len(steps),
        factorisations=newton.factorisation.count - before,
    )


def sensitivity(system: System, fold: Fold, column: Vector) -> float:
    """Derivative of the fold's amplitude in a parameter p, from R_p at the fold: -(left . R_p)/(left . R_mu).

    For another amplitude, R_p is its load column.
    """
    pull = dot(system.comm, fold.left, system.load(fold.state.u, fold.state.mu, fold.name))
    return -dot(system.comm, fold.left, column) / pull


def predict_fold(system: System, known: Sequence[tuple[float, Fold]], p: float, others: Amplitudes) -> Guess:
    """Extrapolate folds at other values of a parameter to `p`.

    The polynomials through the last one, two and three folds are compared, and the one with the least residual is
    used: for long or uneven steps a quadratic may be worse than no extrapolation.

    Parameters
    ----------
    system
        The system at `p`.
    known
        Parameters and folds, in the unknowns of `system`, in the order of the continuation.
    others
        The other amplitudes at `p`.
    """
    guesses = [_extrapolated(known[-n:], p, others) for n in range(1, min(len(known), 3) + 1)]
    residuals = [system.residual(guess.state.u, guess.state.mu) for guess in guesses]
    return guesses[int(np.argmin([dot(system.comm, R, R) for R in residuals]))]


def _extrapolated(known: Sequence[tuple[float, Fold]], p: float, others: Amplitudes) -> Guess:
    values, folds = [value for value, _ in known], [fold for _, fold in known]
    weights = [_lagrange(values, i, p) for i in range(len(values))]
    u = np.sum([w * fold.state.u for w, fold in zip(weights, folds, strict=True)], axis=0)
    mu = sum(w * fold.value for w, fold in zip(weights, folds, strict=True))
    return Guess(State(u, {**others, folds[-1].name: mu}), folds[-1].phi)


def _first_shape(newton: BorderedNewton, state: State, name: str) -> Vector:
    """Near a fold the response to the load is nearly the null vector."""
    return newton.factor_at(state).solve(newton.system.load(state.u, state.mu, name))


def _left(newton: BorderedNewton, state: State, v: Vector) -> Vector:
    """The null vector of the transposed tangent, by inverse iteration."""
    factors = newton.factor_at(state)
    for _ in range(3):
        v = factors.solve_transposed(v)
        v = np.asarray(v / max_abs(newton.system.comm, v))
    return v


def _step(system: System, state: State, name: str, tangent: AugmentedTangent) -> tuple[Vector, float]:
    """Newton's step du = alpha v - w_R - dmu w_mu; the rows for alpha and dmu are R along v, and g."""
    comm, u, v = system.comm, state.u, tangent.v
    w_R, t_R = tangent.solve(system.residual(u, state.mu))
    w_mu, t_mu = tangent.solve(system.load(u, state.mu, name))
    cubic = third(system, state, v)
    K_mu_v = first_difference(lambda u: system.load(u, state.mu, name), system, u, v)
    turn = dot(comm, cubic, w_mu) - dot(comm, v, K_mu_v)
    rows = [[t_mu, -tangent.g], [turn, -dot(comm, cubic, v)]]
    dmu, alpha = np.linalg.solve(rows, [-t_R, -tangent.g - dot(comm, cubic, w_R)])
    return alpha * v - w_R - dmu * w_mu, float(dmu)


def _oriented(system: System, v: Vector, load: Vector) -> Vector:
    sense = -np.sign(dot(system.comm, v, load))
    return np.asarray(sense * v / max_abs(system.comm, v))


def _remaining(steps: Sequence[float]) -> float:
    """Error after the last of a sequence of steps that shrinks at least as fast as a geometric one."""
    rate = steps[-1] / steps[-2] if len(steps) > 1 else 0.5
    if rate > 0.5 and steps[-1] <= ROUNDING:
        return 0.0
    return steps[-1] * rate / (1 - rate) if rate < 1 else np.inf


def _lagrange(values: Sequence[float], i: int, p: float) -> float:
    """Weight of the value `i` in the polynomial through all."""
    return float(np.prod([(p - v) / (values[i] - v) for j, v in enumerate(values) if j != i]))

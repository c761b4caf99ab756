"""Folds: equilibrium with a singular tangent, R(u, mu) = 0 and g(u, mu) = 0, solved for (u, mu).

With b near the null vector and b . b = 1, the bordered tangent

    K v + g b = 0      v =  K^-1 b / (b . K^-1 b)
    b . v     = 1      g = -1      / (b . K^-1 b)

has g = 0 exactly where K is singular. The gradient of g is -Pi'''(v, v, .): Newton's method for
R = 0 and g = 0 takes one factorisation and three back-solves an iteration (minimal augmentation:
Govaerts, Numerical methods for bifurcations of dynamical equilibria, SIAM 2000, ch. 4).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.solve.newton import BorderedNewton
from magshell_fenicsx.solve.system import Amplitudes, State, System, Vector, dot, max_abs

TOLERANCE = 1e-9  # estimated remaining error of u, over the system's length
ROUNDING = 1e-6  # steps along phi that are smaller and do not shrink: 1e-8 to 1e-7 is what rounding of K leaves
MOST_ITERATIONS = 8
LARGEST_STEP = 10.0  # in lengths; more is a divergence
DIFFERENCE = 1e-2  # in lengths, of u along v; only the speed of convergence depends on the error


class FoldLost(RuntimeError):
    """No fold was found near the guess; the message says why."""


@dataclass(frozen=True)
class Guess:
    """Where a fold may be, and its null vector; without one it is taken from the tangent."""

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
    curvature: float
    unstable: int
    iterations: int
    factorisations: int

    @property
    def value(self) -> float:
        """The amplitude at the fold."""
        return self.state.mu[self.name]


def find_fold(newton: BorderedNewton, guess: Guess, name: str) -> Fold:
    """The fold in the amplitude `name` near a guess, to 1e-9 lengths as far as rounding allows that.

    Rounding of K leaves 1e-8 lengths along phi where elements are tiny; the amplitude, which is
    stationary along phi, is exact all the same.

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
            tangent = _Tangent(newton, state, b if b is not None else _first_shape(newton, state, name))
            du, dmu = _step(system, state, name, tangent)
        except np.linalg.LinAlgError:
            raise FoldLost("the tangent is singular in more than one direction") from None
        b = tangent.v
        steps.append(max_abs(system.comm, du) / system.length)
        growing = len(steps) > 2 and steps[-1] > max(2 * steps[-2], ROUNDING)
        if growing or not steps[-1] <= LARGEST_STEP:
            raise FoldLost("Newton's method diverged on its way to a fold")
        last, state = state, state.with_(state.u + du, name, state.mu[name] + dmu)
    phi = _oriented(system, tangent.improved(last, state), system.load(state.u, name))
    pull, cubic = dot(system.comm, phi, system.load(state.u, name)), _cubic(system, state, phi)
    return Fold(
        state=state,
        name=name,
        phi=phi,
        curvature=-dot(system.comm, phi, cubic) * system.length**2 / pull,
        unstable=tangent.unstable,
        iterations=len(steps),
        factorisations=newton.factorisation.count - before,
    )


def sensitivity(system: System, fold: Fold, column: Vector) -> float:
    """Derivative of the fold's amplitude in a parameter p, from R_p at the fold: -(phi . R_p)/(phi . R_mu).

    For another amplitude, R_p is its load column.
    """
    pull = dot(system.comm, fold.phi, system.load(fold.state.u, fold.name))
    return -dot(system.comm, fold.phi, column) / pull


def predict_fold(system: System, known: Sequence[tuple[float, Fold]], p: float, others: Amplitudes) -> Guess:
    """Extrapolate folds at other values of a parameter to `p`.

    Of the polynomials through the last one, two and three folds, that with the least residual: on
    long or uneven steps a quadratic may be worse than no extrapolation.

    Parameters
    ----------
    system
        At `p`.
    known
        Parameter and fold, in the unknowns of `system`, in the order of the continuation.
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


class _Sprung:
    """A system with a spring on one degree of freedom, as stiff as that itself: regular at a simple fold."""

    def __init__(self, system: System, shape: Vector) -> None:
        self.comm, self.size, self.length = system.comm, system.size, system.length
        self.residual, self.load, self.potential = system.residual, system.load, system.potential
        self._system = system
        _, owner = system.comm.allreduce((float(np.abs(shape).max(initial=0.0)), system.comm.rank), MPI.MAXLOC)
        self.e = np.zeros(system.size)
        if system.comm.rank == owner:
            self.e[int(np.argmax(np.abs(shape)))] = 1.0

    def tangent(self, u: Vector, mu: Amplitudes) -> PETSc.Mat:
        K = self._system.tangent(u, mu)
        first = K.getOwnershipRange()[0]
        here = [first + int(i) for i in np.flatnonzero(self.e)]
        self.stiffness = self.comm.allreduce(sum(abs(K.getValue(i, i)) for i in here))
        for i in here:
            K.setValue(i, i, self.stiffness, addv=True)
        K.assemble()
        return K


class _Tangent:
    """The tangent at a state, bordered by b, from factors of K + s e e with a spring s.

    A factorisation of K itself would break down at the fold; the spring is taken back exactly
    by one more border.
    """

    def __init__(self, newton: BorderedNewton, state: State, b: Vector) -> None:
        self._system = system = newton.system
        newton.system = sprung = _Sprung(system, b)
        try:
            self._factors = newton.factor_at(State(state.u, state.mu))  # a state that nobody else asks for
        finally:
            newton.system = system
        self.unstable = self._factors.negative_pivots  # the spring has made phi stable
        dot_ = partial(dot, system.comm)
        self._b, self._e, self._dot = b / np.sqrt(dot_(b, b)), sprung.e, dot_
        self._p, self._q = self._factors.solve(self._e), self._factors.solve(self._b)
        q = dot_(self._e, self._q)
        self._border = np.array([[1 / sprung.stiffness - dot_(self._e, self._p), q], [q, -dot_(self._b, self._q)]])
        self.v, self.g = self._bordered(np.zeros_like(b), 1.0)

    def solve(self, f: Vector) -> tuple[Vector, float]:
        """K w + t b = f with b . w = 0."""
        return self._bordered(self._factors.solve(f), 0.0)

    def _bordered(self, y: Vector, c: float) -> tuple[Vector, float]:
        """K x + t b = f with b . x = c, from y = (K + s e e)^-1 f; s e . x is the spring's force."""
        force, t = np.linalg.solve(self._border, [self._dot(self._e, y), c - self._dot(self._b, y)])
        return y + force * self._p - t * self._q, float(t)

    def improved(self, old: State, new: State) -> Vector:
        """The null vector at a state close by, by one chord iteration of K v + g b = 0."""
        before, after = (_times_tangent(self._system, state, self.v) for state in (old, new))
        return self.v - self.solve(after - before)[0]


def _first_shape(newton: BorderedNewton, state: State, name: str) -> Vector:
    """Near a fold the response to the load is nearly the null vector."""
    return newton.factor_at(state).solve(newton.system.load(state.u, name))


def _step(system: System, state: State, name: str, tangent: _Tangent) -> tuple[Vector, float]:
    """Newton's step du = alpha v - w_R - dmu w_mu; the rows for alpha and dmu are R along v, and g."""
    comm, u, v = system.comm, state.u, tangent.v
    w_R, t_R = tangent.solve(system.residual(u, state.mu))
    w_mu, t_mu = tangent.solve(system.load(u, name))
    cubic = _cubic(system, state, v)
    K_mu_v = _first_difference(lambda u: system.load(u, name), system, u, v)
    turn = dot(comm, cubic, w_mu) - dot(comm, v, K_mu_v)
    rows = [[t_mu, -tangent.g], [turn, -dot(comm, cubic, v)]]
    dmu, alpha = np.linalg.solve(rows, [-t_R, -tangent.g - dot(comm, cubic, w_R)])
    return alpha * v - w_R - dmu * w_mu, float(dmu)


def _cubic(system: System, state: State, v: Vector) -> Vector:
    """Pi'''(v, v, .), by a second difference of the residual."""
    d = _offset(system, v)
    back, here, ahead = (system.residual(state.u + i * d * v, state.mu) for i in (-1, 0, 1))
    return np.asarray((back - 2 * here + ahead) / d**2)


def _times_tangent(system: System, state: State, v: Vector) -> Vector:
    """K v."""
    return _first_difference(lambda u: system.residual(u, state.mu), system, state.u, v)


def _first_difference(f: Callable[[Vector], Vector], system: System, u: Vector, v: Vector) -> Vector:
    """Derivative of f at u along v."""
    d = _offset(system, v)
    return np.asarray((f(u + d * v) - f(u - d * v)) / (2 * d))


def _offset(system: System, v: Vector) -> float:
    return DIFFERENCE * system.length / max_abs(system.comm, v)


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

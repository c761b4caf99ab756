"""Singular tangents: bordered, so that they are regular, and folds, located and foreseen.

The tangent is bordered by a vector near its null vector. With b . b = 1,

    K v + g b = 0      v =  K^-1 b / (b . K^-1 b)
    b . v     = 1      g = -1      / (b . K^-1 b)

has g = 0 exactly where K is singular, and the gradient of g is -Pi'''(v, v, .) (minimal
augmentation: Govaerts, Numerical methods for bifurcations of dynamical equilibria, SIAM 2000, ch.
4). A fold is R(u, mu) = 0 and g(u, mu) = 0, solved for (u, mu): an iteration of Newton's method
takes one factorisation and three back-solves.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.continuation.control import GivenConjugate
from magshell_fenicsx.continuation.device import FORCE, HeldAlong
from magshell_fenicsx.continuation.modes import NoEigenpair, critical_mode
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import (
    Amplitudes,
    State,
    System,
    Tangent,
    Vector,
    Weighted,
    dot,
    followed,
    max_abs,
    symmetric_part,
)

TOLERANCE = 1e-9  # of u with its component along a direction held, in lengths of the system
MOST_TANGENTS, CONTRACTION = 8, 0.3
ROUNDING = 1e-5  # in lengths: smaller steps that do not shrink are rounding
# in lengths: step of differences along v; only the speed of convergence depends on their error
DIFFERENCE = 1e-2
FOLD_TOLERANCE = 1e-9  # estimated remaining error of u, over the system's length
FOLD_ROUNDING = (
    1e-6  # smaller steps along phi that do not shrink are rounding of K, which is 1e-8 to 1e-7
)
MOST_ITERATIONS = 8
LARGEST_STEP = 10.0  # in lengths; a longer one counts as divergence
FAR = 0.6  # of the amplitude: a fold further ahead is not estimated well


@dataclass(frozen=True)
class _Spring:
    """A spring at the degree of freedom where a shape is largest, as stiff as the diagonal entry
    there.

    Attributes
    ----------
    e
        One at the degree of freedom, zero elsewhere.
    """

    e: Vector
    stiffness: float


def _sprung(tangent: Tangent, shape: Vector, comm: MPI.Comm) -> _Spring:
    """Add the spring to a tangent, which is then regular at a simple fold."""
    K = symmetric_part(tangent)
    size, first = (
        np.abs(shape[: K.getLocalSize()[0]]),
        K.getOwnershipRange()[0],
    )  # without the entries of an edge
    _, owner = comm.allreduce((float(size.max(initial=0.0)), comm.rank), MPI.MAXLOC)
    e = np.zeros_like(shape)
    if comm.rank == owner:
        e[int(np.argmax(size))] = 1.0
    sprung = [first + int(i) for i in np.flatnonzero(e)]
    itself = comm.allreduce(sum(K.getValue(i, i) for i in sprung))
    stiffness = (
        2 * abs(itself) - itself or K.norm(PETSc.NormType.INFINITY) or 1.0
    )  # the sum is positive
    for i in sprung:
        K.setValue(i, i, stiffness, addv=True)
    K.assemble()
    return _Spring(e, stiffness)


class AugmentedTangent:
    """The tangent at a state, bordered by b, from factors of K + s e e with a spring s.

    A factorisation of K itself would break down at the fold. One more border removes the spring
    exactly.
    """

    def __init__(
        self, newton: BorderedNewton, state: State, b: Vector, stress: Sequence[Weighted] = ()
    ) -> None:
        self._system = system = newton.system
        K = system.tangent(state.u, state.mu, stress)
        spring = _sprung(K, b, system.comm)
        self._factors = newton.factorisation
        self._factors.factor(K)
        self.unstable = self._factors.negative_pivots  # not phi, which the spring has made stable
        dot_ = partial(dot, system.comm)
        self._b, self._e, self._dot = b / np.sqrt(dot_(b, b)), spring.e, dot_
        self._p, self._q = self._factors.solve(self._e), self._factors.solve(self._b)
        q = dot_(self._e, self._q)
        self._border = np.array(
            [[1 / spring.stiffness - dot_(self._e, self._p), q], [q, -dot_(self._b, self._q)]]
        )
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
        before, after = (times_tangent(self._system, state, self.v) for state in (old, new))
        return self.v - self.solve(after - before)[0]


def held_along(
    newton: BorderedNewton, guess: State, b: Vector, stress: Sequence[Weighted] = ()
) -> tuple[State, float] | None:
    """The equilibrium with the guess's component along b, which a force along b holds, and its
    estimated error.

    This problem is regular where b is the null vector (the Lyapunov-Schmidt reduction). Where
    forces set in within a step, as between shells that touch, it is solved between soft faces
    first, as `BorderedNewton.solve` does. None if Newton's method fails. `stress` is the stress of
    the guess, see `System.tangent`.

    Raises
    ------
    LinAlgError
        If the tangent is singular in another direction too.
    """
    held = _held_along(newton, guess, b, stress)
    if held or not newton.options.kinks:
        return held
    row = GivenConjugate(
        system := HeldAlong(newton.system, b), FORCE, -dot(system.comm, b, guess.u)
    )
    outcome = newton.on(system).solve(State(guess.u, {**guess.mu, FORCE: 0.0}), FORCE, row)
    return _held_along(newton, State(outcome.state.u, guess.mu), b) if outcome.converged else None


def _held_along(
    newton: BorderedNewton, guess: State, b: Vector, stress: Sequence[Weighted] = ()
) -> tuple[State, float] | None:
    """The same by full steps alone."""
    system, u, tangent, last = (
        newton.system,
        guess.u,
        AugmentedTangent(newton, guess, b, stress),
        np.inf,
    )
    tangents, own = 1, True
    while True:
        du, _ = tangent.solve(system.residual(u, guess.mu))
        size = max_abs(system.comm, du) / system.length
        if size <= TOLERANCE or (own and CONTRACTION * last < size <= ROUNDING):
            return State(u - du, guess.mu), size
        if not own and size > CONTRACTION * last:
            tangent, tangents, own = (
                AugmentedTangent(newton, State(u, guess.mu), b, stress),
                tangents + 1,
                True,
            )
            continue
        if tangents > MOST_TANGENTS or not np.isfinite(size):
            return None
        u, last, own, stress = u - du, size, False, followed(u, -du)


def third(system: System, state: State, v: Vector, residual: Vector | None = None) -> Vector:
    """Pi'''(v, v, .), by a second difference of the residual, which may be known at the state
    itself.
    """
    d = offset(system, v)
    back, ahead = (system.residual(state.u + i * d * v, state.mu) for i in (-1, 1))
    residual = system.residual(state.u, state.mu) if residual is None else residual
    return np.asarray((back - 2 * residual + ahead) / d**2)


def times_tangent(system: System, state: State, v: Vector) -> Vector:
    """K v."""
    return first_difference(lambda u: system.residual(u, state.mu), system, state.u, v)


def first_difference(f: Callable[[Vector], Vector], system: System, u: Vector, v: Vector) -> Vector:
    """Derivative of f at u along v."""
    d = offset(system, v)
    return np.asarray((f(u + d * v) - f(u - d * v)) / (2 * d))


def offset(system: System, v: Vector) -> float:
    """Of a difference along v.

    Raises
    ------
    LinAlgError
        If v is zero.
    """
    size = max_abs(system.comm, v)
    if size == 0.0:
        raise np.linalg.LinAlgError
    return DIFFERENCE * system.length / size


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
        Second derivative of the amplitude along the path in units of `phi` times the system's
        length; negative where the amplitude is largest.
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

    With tiny elements, rounding of K leaves an error of 1e-8 lengths along phi. The amplitude is
    stationary along phi, so it is accurate nevertheless.

    Raises
    ------
    FoldLost
        If Newton's method diverges or takes too long.
    """
    system, state, before = newton.system, guess.state, newton.factorisation.count
    b, steps = guess.phi, list[float]()
    while not steps or _remaining(steps) > FOLD_TOLERANCE:
        if len(steps) == MOST_ITERATIONS:
            raise FoldLost(f"Newton's method found no fold in {MOST_ITERATIONS} iterations")
        try:
            tangent = AugmentedTangent(
                newton, state, b if b is not None else _first_shape(newton, state, name)
            )
            du, dmu = _step(system, state, name, tangent)
        except np.linalg.LinAlgError:
            raise FoldLost("the tangent is singular in more than one direction") from None
        b = tangent.v
        steps.append(max_abs(system.comm, du) / system.length)
        growing = len(steps) > 2 and steps[-1] > max(2 * steps[-2], FOLD_ROUNDING)
        if growing or not steps[-1] <= LARGEST_STEP:
            raise FoldLost("Newton's method diverged on its way to a fold")
        last, state = state, state.with_(state.u + du, name, state.mu[name] + dmu)
    phi = _oriented(system, tangent.improved(last, state), system.load(state.u, state.mu, name))
    pull, cubic = (
        dot(system.comm, phi, system.load(state.u, state.mu, name)),
        third(system, state, phi),
    )
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
    """Derivative of the fold's amplitude in a parameter p, from R_p at the fold: -(left .
    R_p)/(left . R_mu).

    For another amplitude, R_p is its load column.
    """
    pull = dot(system.comm, fold.left, system.load(fold.state.u, fold.state.mu, fold.name))
    return -dot(system.comm, fold.left, column) / pull


def predict_fold(
    system: System, folds: Sequence[tuple[float, Fold]], p: float, others: Amplitudes
) -> Guess:
    """Extrapolate folds at other values of a parameter to `p`.

    The polynomials through the last one, two and three folds are compared, and the one with the
    least residual is used: for long or uneven steps a quadratic may be worse than no extrapolation.

    Parameters
    ----------
    system
        The system at `p`.
    known
        Parameters and folds, in the unknowns of `system`, in the order of the continuation.
    others
        The other amplitudes at `p`.
    """
    guesses = [_extrapolated(folds[-n:], p, others) for n in range(1, min(len(folds), 3) + 1)]
    residuals = [system.residual(guess.state.u, guess.state.mu) for guess in guesses]
    return guesses[int(np.argmin([dot(system.comm, R, R) for R in residuals]))]


def _extrapolated(located: Sequence[tuple[float, Fold]], p: float, others: Amplitudes) -> Guess:
    values, folds = [value for value, _ in located], [fold for _, fold in located]
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


def _step(
    system: System, state: State, name: str, tangent: AugmentedTangent
) -> tuple[Vector, float]:
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
    if rate > 0.5 and steps[-1] <= FOLD_ROUNDING:
        return 0.0
    return steps[-1] * rate / (1 - rate) if rate < 1 else np.inf


def _lagrange(values: Sequence[float], i: int, p: float) -> float:
    """Weight of the value `i` in the polynomial through all."""
    return float(np.prod([(p - v) / (values[i] - v) for j, v in enumerate(values) if j != i]))


def fold_ahead(newton: BorderedNewton, point: Point, name: str) -> Guess | None:
    """A guess of the next fold in the amplitude `name`, growing in size; None if it is far or not
    seen yet.

    Along the softest mode phi (of length one, K phi = lambda phi) with the amplitude a, and with mu
    varied by m, equilibrium is lambda a + c a^2/2 = b m with c = Pi'''(phi, phi, phi) and b = -phi
    . R_mu = lambda phi . du/dmu. The fold is at a = -lambda/c, m = -lambda^2/(2 b c); all other
    modes follow mu linearly. The null vector of the guess points the way that the path goes. One
    factorisation.
    """
    system, state = newton.system, point.state
    comm, mu = system.comm, state.mu[name]
    try:
        mode = critical_mode(newton, state)
    except NoEigenpair:
        return None
    rate, phi = np.asarray(point.du / point.dmu), mode.vector
    along, cubic = dot(comm, phi, rate), dot(comm, phi, third(system, state, phi))
    pull = mode.eigenvalue * along
    if mode.eigenvalue <= 0 or not cubic * pull:
        return None
    step = -(mode.eigenvalue**2) / (2 * cubic * pull)
    if not 0 < step / mu < FAR:
        return None
    u = state.u + step * (rate - along * phi) - mode.eigenvalue / cubic * phi
    return Guess(state.with_(u, name, mu + step), np.sign(step * along) * phi)

"""Folds (limit points): bordered regular tangents at them, location, extrapolation, sensitivity.

The tangent is bordered by a vector near its null vector. With b . b = 1,

    K v + g b = 0      v =  K^-1 b / (b . K^-1 b)
    b . v     = 1      g = -1      / (b . K^-1 b)

has g = 0 exactly where K is singular, and the gradient of g is -Pi'''(v, v, .) (minimal
augmentation: Govaerts, Numerical methods for bifurcations of dynamical equilibria, SIAM 2000, ch.
4). A fold is R(u, mu) = 0 and g(u, mu) = 0, solved for (u, mu): an iteration of Newton's method
takes one factorisation and three back-solves.

R = dPi/du, K = dR/du; mu is the one amplitude (load parameter) that varies, by `name`, R_mu its
load vector. `newton` is the solver of a system with its factorisation, which it overwrites. A dot
is the inner product over all ranks; Pi'''(v, v, .) is a third derivative of the potential as a
vector. phi is the null vector. Lengths are displacements in units of the system's length. `stress`
are weighted displacements: K takes the sum of their stresses in place of the stress of u, since
small errors of a guess u change its own stress much. A holding force along b, of unknown size,
keeps the component of u along b.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.continuation.control import PrescribedConjugate
from magshell_fenicsx.continuation.device import FORCE, HoldingForceSystem
from magshell_fenicsx.continuation.modes import NoEigenpair, critical_mode
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import (
    Amplitudes,
    State,
    System,
    Tangent,
    Vector,
    WeightedDisplacement,
    dot,
    extrapolated_stress,
    max_abs,
    symmetric_part,
)

# error of u in lengths, with its component along a direction held
TOLERANCE = 1e-9
MAX_TANGENTS = 8
CONTRACTION = 0.3  # a tangent is kept while it shortens steps to this fraction
ROUNDING_STEP = 1e-5  # in lengths: smaller steps that do not shrink are rounding
# in lengths: step of differences along v; only the speed of convergence depends on their error
DIFFERENCE_STEP = 1e-2
FOLD_TOLERANCE = 1e-9  # estimated remaining error of u, over the system's length
# smaller steps along phi that do not shrink are rounding of K, which is 1e-8 to 1e-7
FOLD_ROUNDING_STEP = 1e-6
MAX_ITERATIONS = 8
MAX_STEP = 10.0  # in lengths; a longer one counts as divergence
# relative to the norm of K: a smaller diagonal entry is rounding
ROUNDING_OF_DIAGONAL = 1e-12
# of the amplitude: a fold further ahead is not estimated well
MAX_DISTANCE_TO_FOLD = 0.6


@dataclass(frozen=True)
class _Spring:
    """A spring at the degree of freedom where a mode is largest.

    Attributes
    ----------
    e
        One at the degree of freedom, zero elsewhere; this rank's part.
    stiffness
        The number s that is added to the diagonal of the tangent.
    """

    e: Vector
    stiffness: float


def _add_spring(tangent: Tangent, mode: Vector, comm: MPI.Comm) -> _Spring:
    """Add a spring to a tangent in place, which is then regular at a simple fold. Collective.

    The spring acts on the largest entry of the mode, and is about as stiff as the diagonal entry of
    the tangent there.
    """
    K = symmetric_part(tangent)
    magnitudes = np.abs(mode[: K.getLocalSize()[0]])  # without the entries of a border
    first_row = K.getOwnershipRange()[0]
    # the rank that owns the largest entry; e has its one on that rank alone
    _, owner = comm.allreduce((float(magnitudes.max(initial=0.0)), comm.rank), MPI.MAXLOC)
    e = np.zeros_like(mode)
    if comm.rank == owner:
        e[int(np.argmax(magnitudes))] = 1.0
    # the row of that entry in the global matrix; on the other ranks there is none
    rows = [first_row + int(i) for i in np.flatnonzero(e)]
    diagonal = comm.allreduce(sum(K.getValue(i, i) for i in rows))
    # spring and diagonal entry d add up to 2 |d|; where d is rounding, because the mode is this
    # degree of freedom alone, the norm of K is the stiffness
    stiffness, norm = 2 * abs(diagonal) - diagonal, K.norm(PETSc.NormType.INFINITY)
    if stiffness <= ROUNDING_OF_DIAGONAL * norm:
        stiffness = norm or 1.0
    for i in rows:
        K.setValue(i, i, stiffness, addv=True)
    K.assemble()
    return _Spring(e, stiffness)


class AugmentedTangent:
    """The tangent K at a state, bordered by b, from factors of K + s e e with a spring s.

    A factorisation of K itself would break down at the fold. One more border removes the spring
    exactly. The constructor factors, and is collective.

    Parameters
    ----------
    newton
        Its system gives the tangent; its factorisation is overwritten.
    b
        A vector near the null vector, of any length.
    stress
        Weighted displacements whose stress replaces that of the state in K.

    Attributes
    ----------
    v, g
        Solution of K v + g b = 0, b . v = 1: v is the null vector where g = 0.
    unstable
        Number of unstable directions other than v.

    Private fields: `_b` is b with length one, `_e` the spring's e. `_p` and `_q` are (K + s e e)^-1
    times e and b, `_border` is the 2 x 2 Schur complement of K + s e e, `_factors` are its factors.
    `_inner` returns the inner product of two vectors over all ranks.
    """

    def __init__(
        self,
        newton: BorderedNewton,
        state: State,
        b: Vector,
        stress: Sequence[WeightedDisplacement] = (),
    ) -> None:
        """Factor the tangent with a spring, and solve K v + g b = 0, b . v = 1. Collective."""
        self._system = system = newton.system
        K = system.tangent(state.u, state.mu, stress)
        spring = _add_spring(K, b, system.comm)
        self._factors = newton.factorisation
        self._factors.factor(K)
        self.unstable = self._factors.negative_pivots  # not v, which the spring has made stable
        inner = partial(dot, system.comm)
        self._b, self._e, self._inner = b / np.sqrt(inner(b, b)), spring.e, inner
        # the solutions for the spring's e and for b
        self._p, self._q = self._factors.solve(self._e), self._factors.solve(self._b)
        e_dot_q = inner(self._e, self._q)
        # 2 x 2 Schur complement, whose unknowns are the spring's force and the factor of b
        self._border = np.array(
            [
                [1 / spring.stiffness - inner(self._e, self._p), e_dot_q],
                [e_dot_q, -inner(self._b, self._q)],
            ]
        )
        # v and g solve the bordered equations for f = 0 and c = 1
        self.v, self.g = self._solve_bordered(np.zeros_like(b), 1.0)

    def solve(self, f: Vector) -> tuple[Vector, float]:
        """Return w and t with K w + t b = f and b . w = 0. Collective.

        So w is a solution orthogonal to b, and t b the part of f that K cannot balance.
        """
        return self._solve_bordered(self._factors.solve(f), 0.0)

    def _solve_bordered(self, y: Vector, c: float) -> tuple[Vector, float]:
        """Return x and t with K x + t b = f and b . x = c, from y = (K + s e e)^-1 f.

        The force s e . x of the spring is the third unknown, which removes the spring.
        """
        right_side = [self._inner(self._e, y), c - self._inner(self._b, y)]
        force, t = np.linalg.solve(self._border, right_side)
        return y + force * self._p - t * self._q, float(t)

    def null_vector_at(self, old: State, new: State) -> Vector:
        """Return the null vector at a nearby state, by one iteration of the chord method.

        The iteration solves K v + g b = 0, with K of the new state in the equation and the factors
        of this tangent as matrix. Differences of the residual replace K times v. Collective.

        Parameters
        ----------
        old
            The state of this tangent.
        new
            The nearby state.
        """
        old_product, new_product = (
            times_tangent(self._system, state, self.v) for state in (old, new)
        )
        change, _ = self.solve(new_product - old_product)
        return self.v - change


def held_along(
    newton: BorderedNewton, guess: State, b: Vector, stress: Sequence[WeightedDisplacement] = ()
) -> tuple[State, float] | None:
    """Return the equilibrium in which a force along b holds the guess's component along b.

    This problem is regular where b is the null vector (the Lyapunov-Schmidt reduction). Full steps
    of Newton's method may fail where contact forces begin within a step. Then the problem is solved
    first by `BorderedNewton.solve`, between faces that are soft and become harder. Collective.

    Parameters
    ----------
    guess
        A state near the equilibrium; its amplitudes stay.
    b
        The direction of the force, of any length.
    stress
        Weighted displacements whose stress replaces that of the guess in the first tangent.

    Returns
    -------
    The state and its estimated error in lengths of the system; None if Newton's method fails.

    Raises
    ------
    LinAlgError
        If the tangent is singular in another direction too.
    """
    equilibrium = _held_by_full_steps(newton, guess, b, stress)
    if equilibrium or not newton.options.has_onsets:  # no contact forces can begin
        return equilibrium
    # a system in which the force along b is the unknown amplitude; its conjugate, -b . u, is
    # prescribed to be that of the guess
    system = HoldingForceSystem(newton.system, b)
    row = PrescribedConjugate(system, FORCE, -dot(system.comm, b, guess.u))
    start = State(guess.u, {**guess.mu, FORCE: 0.0})
    result = newton.for_system(system).solve(start, FORCE, row)
    if not result.converged:
        return None
    return _held_by_full_steps(newton, State(result.state.u, guess.mu), b)


def _held_by_full_steps(
    newton: BorderedNewton, guess: State, b: Vector, stress: Sequence[WeightedDisplacement] = ()
) -> tuple[State, float] | None:
    """Return the equilibrium near a guess with the guess's component along b, by full steps alone.

    A force along b, of unknown size, keeps that component. One augmented tangent serves several
    steps. It is renewed when the steps do not shrink enough. A tangent is the iterate's own
    (`is_own`) if it was computed there.

    Returns
    -------
    The state and its estimated error in lengths; None if the steps do not converge.
    """
    system, u, last_size = newton.system, guess.u, np.inf
    tangent, tangent_count, is_own = AugmentedTangent(newton, guess, b, stress), 1, True
    while True:
        du, _ = tangent.solve(system.residual(u, guess.mu))
        size = max_abs(system.comm, du) / system.length
        is_rounding = is_own and CONTRACTION * last_size < size <= ROUNDING_STEP
        if size <= TOLERANCE or is_rounding:
            return State(u - du, guess.mu), size
        # an old tangent shortens the step too little: the step is repeated with a new one
        if not is_own and size > CONTRACTION * last_size:
            tangent = AugmentedTangent(newton, State(u, guess.mu), b, stress)
            tangent_count, is_own = tangent_count + 1, True
            continue
        if tangent_count > MAX_TANGENTS or not np.isfinite(size):
            return None
        # the next iterate, with the stress for a tangent there
        stress = extrapolated_stress(u, -du)
        u, last_size, is_own = u - du, size, False


def third_derivative(
    system: System, state: State, v: Vector, residual: Vector | None = None
) -> Vector:
    """Return Pi'''(v, v, .) at a state, by a second difference of the residual. Collective.

    Parameters
    ----------
    residual
        The residual at the state; None: it is computed.
    """
    step = difference_step(system, v)
    backward, forward = (system.residual(state.u + i * step * v, state.mu) for i in (-1, 1))
    residual = system.residual(state.u, state.mu) if residual is None else residual
    return np.asarray((backward - 2 * residual + forward) / step**2)


def times_tangent(system: System, state: State, v: Vector) -> Vector:
    """Return K v by a difference of the residual. Collective."""
    return first_difference(lambda u: system.residual(u, state.mu), system, state.u, v)


def first_difference(f: Callable[[Vector], Vector], system: System, u: Vector, v: Vector) -> Vector:
    """Return the derivative of f at u along v, by a central difference. Collective."""
    step = difference_step(system, v)
    return np.asarray((f(u + step * v) - f(u - step * v)) / (2 * step))


def difference_step(system: System, v: Vector) -> float:
    """Return the factor of v in a difference along it, so that it moves u by little. Collective.

    Raises
    ------
    LinAlgError
        If v is zero.
    """
    size = max_abs(system.comm, v)
    if size == 0.0:
        raise np.linalg.LinAlgError
    return DIFFERENCE_STEP * system.length / size


class FoldLost(RuntimeError):
    """No fold was found near the guess; the message gives the reason."""


@dataclass(frozen=True)
class FoldGuess:
    """A guess of a fold.

    Attributes
    ----------
    state
        A state near the fold.
    phi
        A vector near the null vector; None: it is computed from the tangent.
    """

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
    left_null_vector
        Null vector of the transposed K: `phi`, except for loads without potential.
    curvature
        Second derivative of the amplitude along the path in units of `phi` times the system's
        length; negative where the amplitude is largest.
    unstable
        Number of unstable directions other than `phi`.
    iterations, factorisations
        Work.
    """

    state: State
    name: str
    phi: Vector
    left_null_vector: Vector
    curvature: float
    unstable: int
    iterations: int
    factorisations: int

    @property
    def value(self) -> float:
        """The amplitude at the fold."""
        return self.state.mu[self.name]


def find_fold(newton: BorderedNewton, guess: FoldGuess, name: str) -> Fold:
    """Locate the fold in the amplitude `name` near a guess. Collective.

    The error of u is 1e-9 lengths if rounding allows that. With tiny elements, rounding of K leaves
    an error of 1e-8 lengths along phi. The amplitude is stationary along phi, so it is accurate
    nevertheless.

    Raises
    ------
    FoldLost
        If Newton's method diverges or takes too long, or the tangent is singular in two directions.
    """
    system, state, count = newton.system, guess.state, newton.factorisation.count
    b, sizes = guess.phi, list[float]()
    while not sizes or _remaining_error(sizes) > FOLD_TOLERANCE:
        if len(sizes) == MAX_ITERATIONS:
            raise FoldLost(f"Newton's method found no fold in {MAX_ITERATIONS} iterations")
        try:
            tangent = AugmentedTangent(
                newton, state, b if b is not None else _response_to_load(newton, state, name)
            )
            du, dmu = _newton_step(system, state, name, tangent)
        except np.linalg.LinAlgError:
            raise FoldLost("the tangent is singular in more than one direction") from None
        b = tangent.v  # a better border for the next step
        sizes.append(max_abs(system.comm, du) / system.length)
        grows = len(sizes) > 2 and sizes[-1] > max(2 * sizes[-2], FOLD_ROUNDING_STEP)
        if grows or not sizes[-1] <= MAX_STEP:
            raise FoldLost("Newton's method diverged on its way to a fold")
        last_state, state = state, state.with_(state.u + du, name, state.mu[name] + dmu)
    load = system.load(state.u, state.mu, name)
    # the tangent belongs to the state before the last step; its null vector is corrected, and given
    # the sense in which the conjugate displacement grows
    phi = _oriented(system, tangent.null_vector_at(last_state, state), load)
    work = dot(system.comm, phi, system.load(state.u, state.mu, name))
    cubic = third_derivative(system, state, phi)
    is_symmetric = not newton.factorisation.skewed
    left_null_vector = phi if is_symmetric else _left_null_vector(newton, state, phi)
    return Fold(
        state=state,
        name=name,
        phi=phi,
        left_null_vector=left_null_vector,
        curvature=-dot(system.comm, phi, cubic) * system.length**2 / work,
        unstable=tangent.unstable,
        iterations=len(sizes),
        factorisations=newton.factorisation.count - count,
    )


def fold_by_one_step(
    newton: BorderedNewton, state: State, phi: Vector, name: str
) -> tuple[State, Vector, int]:
    """Return the fold near a good guess by one factorisation. Collective.

    After one step of Newton's method the amplitude is corrected, so that v . R = 0 with v, nearly
    the null vector. What the step has left of the error of u changes it in second order alone.

    Parameters
    ----------
    state, phi
        The guess, and a vector near its null vector.

    Returns
    -------
    The state, nearly its null vector, and the number of other unstable directions at the guess.

    Raises
    ------
    FoldLost
        If the step is too long, or the tangent is singular in two directions.
    """
    system = newton.system
    try:
        tangent = AugmentedTangent(newton, state, phi)
        du, dmu = _newton_step(system, state, name, tangent)
    except np.linalg.LinAlgError:
        raise FoldLost("the tangent is singular in more than one direction") from None
    if not max_abs(system.comm, du) <= MAX_STEP * system.length:
        raise FoldLost("Newton's method diverged on its way to a fold")
    fold_state, v = state.with_(state.u + du, name, state.mu[name] + dmu), tangent.v
    load = system.load(fold_state.u, fold_state.mu, name)
    residual_along_v = dot(system.comm, v, system.residual(fold_state.u, fold_state.mu))
    correction = -residual_along_v / dot(system.comm, v, load)
    return (
        fold_state.with_(fold_state.u, name, fold_state.mu[name] + correction),
        v,
        tangent.unstable,
    )


def residual_multiplier(system: System, fold: Fold) -> Vector:
    """Return w = -l/(l . R_mu) with the left null vector l of a fold; collective.

    The amplitude mu of the fold has the derivative w . R_p by a parameter p. For another amplitude
    R_p is that amplitude's load vector.
    """
    load = system.load(fold.state.u, fold.state.mu, fold.name)
    return np.asarray(-fold.left_null_vector / dot(system.comm, fold.left_null_vector, load))


def predict_fold(
    system: System, folds: Sequence[tuple[float, Fold]], p: float, others: Amplitudes
) -> FoldGuess:
    """Extrapolate the folds at other values of a parameter to its value `p`. Collective.

    The polynomials through the last one, two and three folds each give a guess. The one with the
    least residual is used: for long or uneven steps a quadratic may be worse than no extrapolation.

    Parameters
    ----------
    system
        The system at `p`.
    folds
        Pairs of a parameter value and its fold, in the unknowns of `system`, in the order of the
        continuation.
    others
        The other amplitudes at `p`.
    """
    guesses = [_extrapolated(folds[-n:], p, others) for n in range(1, min(len(folds), 3) + 1)]
    residuals = [system.residual(guess.state.u, guess.state.mu) for guess in guesses]
    return guesses[int(np.argmin([dot(system.comm, R, R) for R in residuals]))]


def _extrapolated(located: Sequence[tuple[float, Fold]], p: float, others: Amplitudes) -> FoldGuess:
    """Extrapolate folds to `p` by the polynomial through all of them.

    Parameters
    ----------
    located
        Pairs of a parameter value and its fold.
    others
        The amplitudes of the guess, apart from that of the folds.
    """
    values, folds = [value for value, _ in located], [fold for _, fold in located]
    weights = [_lagrange_weight(values, i, p) for i in range(len(values))]
    u = np.sum([weight * fold.state.u for weight, fold in zip(weights, folds, strict=True)], axis=0)
    mu = sum(weight * fold.value for weight, fold in zip(weights, folds, strict=True))
    return FoldGuess(State(u, {**others, folds[-1].name: mu}), folds[-1].phi)


def _response_to_load(newton: BorderedNewton, state: State, name: str) -> Vector:
    """Return K^-1 R_mu, the response to the load, which near a fold is nearly the null vector."""
    return newton.factor_at(state).solve(newton.system.load(state.u, state.mu, name))


def _left_null_vector(newton: BorderedNewton, state: State, v: Vector) -> Vector:
    """Return the null vector of the transposed tangent, by inverse iteration from v.

    Its largest entry is one in magnitude. Collective.
    """
    factors = newton.factor_at(state)
    for _ in range(3):  # near a fold one iteration nearly suffices
        v = factors.solve_transposed(v)
        v = np.asarray(v / max_abs(newton.system.comm, v))
    return v


def _newton_step(
    system: System, state: State, name: str, tangent: AugmentedTangent
) -> tuple[Vector, float]:
    """Return Newton's step (du, dmu) for R = 0 and g = 0. Collective.

    du = alpha v - w_R - dmu w_mu leaves a force along b alone. dmu and alpha follow from two linear
    equations: this force is zero, and g + dg = 0.

    Parameters
    ----------
    tangent
        The augmented tangent at the state.
    """
    comm, u, v = system.comm, state.u, tangent.v
    # responses w orthogonal to b; t b are the parts that K cannot balance
    residual = system.residual(u, state.mu)
    w_R, t_R = tangent.solve(residual)
    w_mu, t_mu = tangent.solve(system.load(u, state.mu, name))
    # Pi'''(v, v, .), then (dK/dmu) v as the derivative of R_mu along v
    cubic = third_derivative(system, state, v, residual)
    K_mu_v = first_difference(lambda u: system.load(u, state.mu, name), system, u, v)
    # the derivative of g along (du, dmu) = (-w_mu, 1)
    g_mu = dot(comm, cubic, w_mu) - dot(comm, v, K_mu_v)
    rows = [[t_mu, -tangent.g], [g_mu, -dot(comm, cubic, v)]]
    dmu, alpha = np.linalg.solve(rows, [-t_R, -tangent.g - dot(comm, cubic, w_R)])
    return alpha * v - w_R - dmu * w_mu, float(dmu)


def _oriented(system: System, v: Vector, load: Vector) -> Vector:
    """Return a multiple of v along which the displacement conjugate to a load grows.

    Its largest entry is one in magnitude.

    Parameters
    ----------
    load
        R_mu of the amplitude; its conjugate changes by -v . R_mu along v.
    """
    sense = -np.sign(dot(system.comm, v, load))
    return np.asarray(sense * v / max_abs(system.comm, v))


def _remaining_error(sizes: Sequence[float]) -> float:
    """Return the error after the last step, if sizes shrink like a geometric series or faster.

    It is zero if the last steps are at the level of rounding, and infinite if the sizes grow.

    Parameters
    ----------
    sizes
        Sizes of the steps so far, in lengths of the system.
    """
    # the ratio of the last two sizes; the sum of a geometric series follows
    ratio = sizes[-1] / sizes[-2] if len(sizes) > 1 else 0.5
    if ratio > 0.5 and sizes[-1] <= FOLD_ROUNDING_STEP:
        return 0.0
    return sizes[-1] * ratio / (1 - ratio) if ratio < 1 else np.inf


def _lagrange_weight(values: Sequence[float], i: int, p: float) -> float:
    """Return the weight at p of the value `i` in the polynomial through all values."""
    return float(np.prod([(p - v) / (values[i] - v) for j, v in enumerate(values) if j != i]))


def fold_ahead(newton: BorderedNewton, point: Point, name: str) -> FoldGuess | None:
    """Predict the next fold in the amplitude `name`, for growing magnitude. Collective.

    The prediction is made at `point`, a point of a path. phi is the softest mode, of length one,
    with K phi = lambda phi. The state moves by a phi while mu changes by m. Equilibrium along phi
    is then

        lambda a + c a^2/2 = b m,  c = Pi'''(phi, phi, phi),  b = -phi . R_mu = lambda phi . du/dmu

    The fold is at a = -lambda/c, m = -lambda^2/(2 b c). All other modes follow mu linearly. The
    null vector of the guess points the way that the path goes. The prediction takes one
    factorisation.

    Returns
    -------
    The guess; None if the fold is far, or the path does not show it yet.
    """
    system, state = newton.system, point.state
    comm, mu = system.comm, state.mu[name]
    try:
        mode = critical_mode(newton, state)
    except NoEigenpair:
        return None
    # du/dmu along the path
    rate, phi = np.asarray(point.du / point.dmu), mode.vector
    rate_along_phi = dot(comm, phi, rate)
    cubic = dot(comm, phi, third_derivative(system, state, phi))
    work = mode.eigenvalue * rate_along_phi  # b
    if mode.eigenvalue <= 0 or not cubic * work:
        return None
    # m, then the displacement at the fold: other modes by the rate, phi by a = -lambda/c
    dmu = -(mode.eigenvalue**2) / (2 * cubic * work)
    if not 0 < dmu / mu < MAX_DISTANCE_TO_FOLD:
        return None
    u = state.u + dmu * (rate - rate_along_phi * phi) - mode.eigenvalue / cubic * phi
    return FoldGuess(state.with_(u, name, mu + dmu), np.sign(dmu * rate_along_phi) * phi)

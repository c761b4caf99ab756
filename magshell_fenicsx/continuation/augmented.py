"""The tangent bordered by a vector near its null vector: regular where the tangent itself is singular.

With b . b = 1,

    K v + g b = 0      v =  K^-1 b / (b . K^-1 b)
    b . v     = 1      g = -1      / (b . K^-1 b)

has g = 0 exactly where K is singular, and the gradient of g is -Pi'''(v, v, .) (minimal augmentation:
Govaerts, Numerical methods for bifurcations of dynamical equilibria, SIAM 2000, ch. 4).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.system import (
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
DIFFERENCE = 1e-2  # in lengths: step of differences along v; only the speed of convergence depends on their error


@dataclass(frozen=True)
class _Spring:
    """A spring at the degree of freedom where a shape is largest, as stiff as the diagonal entry there.

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
    size, first = np.abs(shape[: K.getLocalSize()[0]]), K.getOwnershipRange()[0]  # without the entries of an edge
    _, owner = comm.allreduce((float(size.max(initial=0.0)), comm.rank), MPI.MAXLOC)
    e = np.zeros_like(shape)
    if comm.rank == owner:
        e[int(np.argmax(size))] = 1.0
    here = [first + int(i) for i in np.flatnonzero(e)]
    itself = comm.allreduce(sum(K.getValue(i, i) for i in here))
    stiffness = 2 * abs(itself) - itself or K.norm(PETSc.NormType.INFINITY) or 1.0  # the sum is positive
    for i in here:
        K.setValue(i, i, stiffness, addv=True)
    K.assemble()
    return _Spring(e, stiffness)


class AugmentedTangent:
    """The tangent at a state, bordered by b, from factors of K + s e e with a spring s.

    A factorisation of K itself would break down at the fold. One more border removes the spring exactly.
    """

    def __init__(self, newton: BorderedNewton, state: State, b: Vector, stress: Sequence[Weighted] = ()) -> None:
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
        self._border = np.array([[1 / spring.stiffness - dot_(self._e, self._p), q], [q, -dot_(self._b, self._q)]])
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
    """The equilibrium with the guess's component along b, which a force along b holds, and its estimated error.

    This problem is regular where b is the null vector (the Lyapunov-Schmidt reduction).
    None if Newton's method fails. `stress` is the stress of the guess, see `System.tangent`.

    Raises
    ------
    LinAlgError
        If the tangent is singular in another direction too.
    """
    system, u, tangent, last = newton.system, guess.u, AugmentedTangent(newton, guess, b, stress), np.inf
    tangents, own = 1, True
    while True:
        du, _ = tangent.solve(system.residual(u, guess.mu))
        size = max_abs(system.comm, du) / system.length
        if size <= TOLERANCE or (own and CONTRACTION * last < size <= ROUNDING):
            return State(u - du, guess.mu), size
        if not own and size > CONTRACTION * last:
            tangent, tangents, own = AugmentedTangent(newton, State(u, guess.mu), b, stress), tangents + 1, True
            continue
        if tangents > MOST_TANGENTS or not np.isfinite(size):
            return None
        u, last, own, stress = u - du, size, False, followed(u, -du)


def third(system: System, state: State, v: Vector) -> Vector:
    """Pi'''(v, v, .), by a second difference of the residual."""
    d = _offset(system, v)
    back, here, ahead = (system.residual(state.u + i * d * v, state.mu) for i in (-1, 0, 1))
    return np.asarray((back - 2 * here + ahead) / d**2)


def times_tangent(system: System, state: State, v: Vector) -> Vector:
    """K v."""
    return first_difference(lambda u: system.residual(u, state.mu), system, state.u, v)


def first_difference(f: Callable[[Vector], Vector], system: System, u: Vector, v: Vector) -> Vector:
    """Derivative of f at u along v."""
    d = _offset(system, v)
    return np.asarray((f(u + d * v) - f(u - d * v)) / (2 * d))


def _offset(system: System, v: Vector) -> float:
    size = max_abs(system.comm, v)
    if size == 0.0:
        raise np.linalg.LinAlgError
    return DIFFERENCE * system.length / size

"""Simple bifurcations: a tangent that is singular while the load does no work along its null vector
v.

    R(u, mu) + beta b = 0,    g(u, mu) = 0,    v . R_mu = 0

for (u, mu, beta), with g and v of `fold.AugmentedTangent`. This system is regular at a simple
bifurcation. A small imperfection, from the mesh or from rounding, splits the bifurcation; beta is
the force along v that restores it (Govaerts, Numerical methods for bifurcations of dynamical
equilibria, SIAM 2000, ch. 4 and 6). From there the branches that cross the path are entered.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import copysign

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.continuation.control import Hyperplane
from magshell_fenicsx.continuation.fold import AugmentedTangent, first_difference, held_along, third
from magshell_fenicsx.continuation.modes import NoEigenpair, critical_mode
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import (
    State,
    System,
    Vector,
    Weighted,
    dot,
    followed,
    max_abs,
)

TOLERANCE = 1e-9  # of u, in lengths of the system
MOST_ITERATIONS = 10
LARGEST_STEP = 10.0  # in lengths; a longer one counts as divergence
SCATTER = 3.0  # load error in units of the last corrections, which are rounding
# in lengths: after a longer step the state is brought back into equilibrium, except for the force
# along v
NEAR = 1e-5
DIFFERENCE = 1e-4  # relative, of an amplitude
ROUNDING = 1e-2  # in lengths: steps that are smaller and do not shrink are the rounding of g
SIZES = 0.5, 2.0, 8.0  # of the first step off the path, in lengths of the system
SMALLER = (
    0.2,
    0.08,
    0.03,
)  # if the first of these fails, as where the tangent is nearly singular in another direction
SEEN = 1e-4  # a larger relative change of the amplitude is no rounding error
# a branch is asymmetric if the changes of the amplitude in both directions differ by more than this
# part
ODD = 0.1


class BifurcationLost(RuntimeError):
    """No bifurcation was found near the guess."""


@dataclass(frozen=True)
class Bifurcation:
    """A simple bifurcation in one amplitude.

    Attributes
    ----------
    phi
        Null vector of K, of length one.
    response
        Change of u per unit of -mu, without phi. The tangents of both branches are combinations of
        (phi, 0) and (-response, 1).
    unstable
        Number of unstable directions besides `phi`.
    error
        Estimated error of u, without its component along `phi`, over the system's length.
    load_error
        Estimated error of the amplitude, from rounding of the tangent.
    iterations, factorisations
        Work.
    """

    state: State
    phi: Vector
    response: Vector
    unstable: int
    error: float
    load_error: float
    iterations: int
    factorisations: int


def find_bifurcation(
    newton: BorderedNewton, guess: State, phi: Vector, name: str, stress: Sequence[Weighted] = ()
) -> Bifurcation:
    """The bifurcation in the amplitude `name` near a guess, whose null vector is near `phi`.

    `stress` is the stress of the guess, see `System.tangent`.

    Raises
    ------
    BifurcationLost
        If Newton's method diverges or takes too long.
    """
    try:
        return _found(newton, _settled(newton, guess, phi, stress)[0], phi, name)
    except np.linalg.LinAlgError:
        raise BifurcationLost from None


def _found(newton: BorderedNewton, guess: State, phi: Vector, name: str) -> Bifurcation:
    system, state, before = newton.system, guess, newton.factorisation.count
    b, steps, changes = phi, list[float](), list[float]()
    free = name in system.coordinates  # the tangent is then not linear in the amplitude
    while not (_done(steps) and (not free or _kept(changes, state.mu[name]))):
        if len(steps) == MOST_ITERATIONS:
            raise BifurcationLost
        tangent = AugmentedTangent(newton, state, b)
        du, dmu, w_mu = _step(system, state, name, tangent)
        b = tangent.v
        steps.append(max_abs(system.comm, du) / system.length)
        changes.append(abs(dmu))
        if not steps[-1] <= LARGEST_STEP:
            raise BifurcationLost
        last, state = state.u, state.with_(state.u + du, name, state.mu[name] + dmu)
        if steps[-1] > NEAR:  # off equilibrium, a wrong membrane stress spoils the tangent
            state, _ = _settled(newton, state, tangent.v, followed(last, du))
    state, error = _settled(newton, state, tangent.v)
    return Bifurcation(
        state=state,
        phi=np.asarray(b / np.sqrt(dot(system.comm, b, b))),
        response=w_mu,
        unstable=tangent.unstable,
        error=error,
        load_error=SCATTER * max(changes[-2:]),
        iterations=len(steps),
        factorisations=newton.factorisation.count - before,
    )


def _settled(
    newton: BorderedNewton, state: State, v: Vector, stress: Sequence[Weighted] = ()
) -> tuple[State, float]:
    mode = held_along(newton, state, v, stress)
    if mode is None:
        raise BifurcationLost
    return mode


def _step(
    system: System, state: State, name: str, tangent: AugmentedTangent
) -> tuple[Vector, float, Vector]:
    """Newton's step (du, dmu) and w_mu: du = alpha v - w_R - dmu w_mu, alpha and dmu from the rows
    g and v . R_mu.
    """
    comm, u, v = system.comm, state.u, tangent.v
    w_R, _ = tangent.solve(system.residual(u, state.mu))
    w_mu, pull = tangent.solve(system.load(u, state.mu, name))  # pull = v . R_mu
    cubic = third(system, state, v)
    K_mu_v = first_difference(lambda u: system.load(u, state.mu, name), system, u, v)
    both = mixed(system, state, v, w_mu) - K_mu_v
    turn, bend = dot(comm, both, v), dot(comm, v, _load_rate(system, state, name))
    rows = [
        [turn, -dot(comm, cubic, v)],
        [dot(comm, both, w_mu) - dot(comm, K_mu_v, w_mu) + bend, -turn],
    ]
    rest = [-tangent.g - dot(comm, cubic, w_R), -pull - dot(comm, both, w_R)]
    dmu, alpha = np.linalg.solve(rows, rest)
    return alpha * v - w_R - dmu * w_mu, float(dmu), w_mu


def _load_rate(system: System, state: State, name: str) -> Vector:
    """R_mumu by a difference; exactly zero for an amplitude that multiplies its term."""
    mu, d = state.mu[name], DIFFERENCE * (abs(state.mu[name]) or 1.0)
    ahead, back = (system.load(state.u, {**state.mu, name: mu + step}, name) for step in (d, -d))
    return np.asarray((ahead - back) / (2 * d))


def mixed(
    system: System, state: State, v: Vector, w: Vector, residual: Vector | None = None
) -> Vector:
    """Pi'''(v, w, .), by polarisation; the residual at the state may be known."""
    comm = system.comm
    size = max_abs(comm, w) / max_abs(comm, v)
    if size == 0.0:
        return np.zeros_like(v)
    residual = system.residual(state.u, state.mu) if residual is None else residual
    plus, minus = (third(system, state, v + sign * w / size, residual) for sign in (1, -1))
    return np.asarray(size / 4 * (plus - minus))


def _done(sizes: Sequence[float]) -> bool:
    """Whether the last step is below the tolerance, or as small as rounding allows."""
    stalled = len(sizes) > 1 and sizes[-1] > sizes[-2] / 2 and sizes[-1] <= ROUNDING
    return stalled or (bool(sizes) and sizes[-1] <= TOLERANCE)


def _kept(changes: Sequence[float], mu: float) -> bool:
    """Whether the last change of the amplitude is below the tolerance, or as small as rounding
    allows.
    """
    stalled = (
        len(changes) > 1 and changes[-1] > changes[-2] / 2 and changes[-1] <= ROUNDING * abs(mu)
    )
    return stalled or changes[-1] <= TOLERANCE * abs(mu)


@dataclass(frozen=True)
class Branching:
    """Both directions of the branch at a bifurcation.

    Attributes
    ----------
    symmetric
        Whether the amplitude changes equally in both directions (a pitchfork).
    starts
        A point in each direction, with a tangent that leads away; arc length is zero there.
    """

    symmetric: bool
    starts: tuple[Point, Point]


def branching(
    path: Path,
    bifurcation: Point,
    refused: Callable[[Point, Point], bool] = lambda low, high: False,
) -> Branching | None:
    """Leave a path at a located bifurcation along the null vector; None if that or the first points
    are not found.

    Parameters
    ----------
    path
        Controlled by arc length.
    refused
        Whether the straight way from the bifurcation to a first point must not be gone; a nearer
        one is tried then.
    """
    name, state = path.name, bifurcation.state
    try:
        mode = critical_mode(path.newton, state).vector
    except NoEigenpair:
        return None
    mode = np.asarray(mode * path.system.length / largest(path.system.comm, mode))
    branching_point = None
    sizes = list(SIZES)
    while sizes:
        size = sizes.pop(0)
        found = (_step_off(path, state, mode, signed) for signed in (size, -size))
        starts = [point if point and not refused(bifurcation, point) else None for point in found]
        if starts[0] is None or starts[1] is None:
            if branching_point:
                break
            sizes = [smaller for smaller in SMALLER if smaller < size]
            continue
        rises = [point.state.mu[name] - state.mu[name] for point in starts if point]
        symmetric = abs(rises[0] - rises[1]) <= ODD * abs(rises[0] + rises[1])
        branching_point = Branching(symmetric, (starts[0], starts[1]))
        if size < SIZES[0] or max(map(abs, rises)) > SEEN * abs(state.mu[name]):
            break
    return branching_point


def largest(comm: MPI.Comm, v: Vector) -> float:
    """The entry of largest magnitude with its sign, which is the same on any number of ranks."""
    largest_here = float(v[np.argmax(np.abs(v))]) if v.size else 0.0
    return float(max(comm.allgather(largest_here), key=abs))


def _step_off(path: Path, state: State, mode: Vector, size: float) -> Point | None:
    """The point of the branch at a distance along the null vector, with a tangent that leads away.

    First a force along the null vector pushes the system there at the same amplitude. Then the
    force is removed and the amplitude is unknown.
    """
    metric, name, newton = path.metric, path.name, path.newton
    row = Hyperplane(
        metric, name, state, (mode, 0.0), size * metric.inner((mode, 0.0), (mode, 0.0))
    )
    try:
        pushed = held_along(newton, State(state.u + size * mode, state.mu), mode)
    except np.linalg.LinAlgError:  # singular in another direction too
        return None
    if pushed is None:
        return None
    first = path.solve(row, 0.0, pushed[0])
    if isinstance(first, str):
        return None
    return first.per(copysign(metric.norm(first.du, first.dmu), size))

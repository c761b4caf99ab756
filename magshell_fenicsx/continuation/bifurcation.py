"""Simple bifurcations (branch points) as solutions of a regular system, and branch switching.

At a simple bifurcation the tangent is singular while the load does no work along its null vector v:

    R(u, mu) + beta b = 0,    g(u, mu) = 0,    v . R_mu = 0

for (u, mu, beta), with g and v of `fold.AugmentedTangent`. This system is regular at a simple
bifurcation. A small imperfection, from the mesh or from rounding, splits the bifurcation; beta is
the force along v that restores it (Govaerts, Numerical methods for bifurcations of dynamical
equilibria, SIAM 2000, ch. 4 and 6). `switch_branch` enters the branches that cross the path there.

Pi(u; mu) is the potential, R = dPi/du, K = dR/du; mu is the load parameter (amplitude) that varies,
by `name`, R_mu its load vector. `newton` is the solver of the system with its factorisation. A dot
is the inner product over all ranks; Pi'''(v, w, .) is a third derivative as a vector. phi is the
null vector of K. w_R and w_mu solve K w + t b = R and R_mu with b . w = 0. The system's length (a
thickness) is the unit of displacements. `stress` is a list of weighted displacements: K takes the
sum of their stresses in place of the stress of u, since small errors of a guess u change its own
stress much.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import copysign

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.continuation.control import Hyperplane
from magshell_fenicsx.continuation.fold import (
    AugmentedTangent,
    first_difference,
    held_along,
    third_derivative,
)
from magshell_fenicsx.continuation.modes import NoEigenpair, critical_mode
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import (
    State,
    System,
    Vector,
    WeightedDisplacement,
    dot,
    extrapolated_stress,
    max_abs,
)

TOLERANCE = 1e-9  # of u, in lengths of the system
MAX_ITERATIONS = 10
MAX_STEP = 10.0  # in lengths; a longer one counts as divergence
LOAD_ERROR_FACTOR = 3.0  # load error over the last corrections, which are rounding
# in lengths: after a longer step the state is brought back into equilibrium, except for the force
# along v
EQUILIBRIUM_STEP = 1e-5
DIFFERENCE_STEP = 1e-4  # relative, of an amplitude
# in lengths, and relative of the amplitude: steps that are smaller and do not shrink are the
# rounding of g
ROUNDING_STEP = 1e-2
FIRST_STEP_SIZES = 0.5, 2.0, 8.0  # of the first step off the path, in lengths of the system
# the same if the first of these fails, as where the tangent is nearly singular in another direction
SMALLER_STEP_SIZES = 0.2, 0.08, 0.03
LOAD_CHANGE_TOLERANCE = 1e-4  # a larger relative change of the amplitude is no rounding error
# a branch is asymmetric if the changes of the amplitude in both directions differ by more than this
# fraction
ASYMMETRY_TOLERANCE = 0.1


class BifurcationLost(RuntimeError):
    """No bifurcation was found near the guess."""


@dataclass(frozen=True)
class Bifurcation:
    """A simple bifurcation in one amplitude.

    Attributes
    ----------
    state
        The state there, an equilibrium up to the small force along `phi`.
    phi
        Null vector of K, of length one.
    response
        Change of u per unit of -mu, without phi. The tangents of both branches are combinations of
        (phi, 0) and (-response, 1).
    unstable
        Number of unstable directions other than `phi`.
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
    newton: BorderedNewton,
    guess: State,
    phi: Vector,
    name: str,
    stress: Sequence[WeightedDisplacement] = (),
) -> Bifurcation:
    """Locate the bifurcation in the amplitude `name` near a guess. Collective.

    Parameters
    ----------
    phi
        A vector near the null vector of the tangent.
    stress
        Pairs of a weight and a displacement: in the first tangent the weighted sum of their
        stresses replaces the stress of the guess.

    Raises
    ------
    BifurcationLost
        If Newton's method diverges or takes too long, or the tangent is singular in two directions.
    """
    try:
        # the equilibrium near the guess, and its error
        start, _ = _equilibrate(newton, guess, phi, stress)
        return _find_from_equilibrium(newton, start, phi, name)
    except np.linalg.LinAlgError:
        raise BifurcationLost from None


def _find_from_equilibrium(
    newton: BorderedNewton, guess: State, phi: Vector, name: str
) -> Bifurcation:
    """Locate the bifurcation near a guess that is in equilibrium up to a force along phi.

    Newton's method solves the regular system; after a long step the state is brought back into
    equilibrium, except for the force along the null vector.

    Raises
    ------
    BifurcationLost
        If Newton's method diverges or takes too long.
    LinAlgError
        If the tangent is singular in two directions.
    """
    system, state, count = newton.system, guess, newton.factorisation.count
    # b: the border of the tangent; sizes, load_changes: of the steps so far, in lengths and in mu
    b, sizes, load_changes = phi, list[float](), list[float]()
    while True:
        # the convergence of u does not show that of mu where the shell hardly deforms along the
        # path, or where K is not linear in mu
        if _has_converged(sizes) and _load_has_converged(load_changes, state.mu[name]):
            break
        if len(sizes) == MAX_ITERATIONS:
            raise BifurcationLost
        tangent = AugmentedTangent(newton, state, b)
        du, dmu, w_mu = _newton_step(system, state, name, tangent)
        b = tangent.v
        sizes.append(max_abs(system.comm, du) / system.length)
        load_changes.append(abs(dmu))
        if not sizes[-1] <= MAX_STEP:
            raise BifurcationLost
        last_u, state = state.u, state.with_(state.u + du, name, state.mu[name] + dmu)
        if sizes[-1] > EQUILIBRIUM_STEP:
            # off equilibrium the membrane stress is wrong, and with it the tangent: that of the
            # first iteration takes a stress extrapolated along the step
            state, _ = _equilibrate(newton, state, tangent.v, extrapolated_stress(last_u, du))
    state, error = _equilibrate(newton, state, tangent.v)
    return Bifurcation(
        state=state,
        phi=np.asarray(b / np.sqrt(dot(system.comm, b, b))),
        response=w_mu,
        unstable=tangent.unstable,
        error=error,
        load_error=LOAD_ERROR_FACTOR * max(load_changes[-2:]),
        iterations=len(sizes),
        factorisations=newton.factorisation.count - count,
    )


def _equilibrate(
    newton: BorderedNewton, state: State, v: Vector, stress: Sequence[WeightedDisplacement] = ()
) -> tuple[State, float]:
    """Return the equilibrium near a state up to a force along v, and its error in lengths.

    The force keeps the component of the state along v. In the first tangent `stress`, pairs of a
    weight and a displacement, replace the stress of the state.

    Raises
    ------
    BifurcationLost
        If Newton's method fails.
    """
    equilibrium = held_along(newton, state, v, stress)
    if equilibrium is None:
        raise BifurcationLost
    return equilibrium


def _newton_step(
    system: System, state: State, name: str, tangent: AugmentedTangent
) -> tuple[Vector, float, Vector]:
    """Return Newton's step (du, dmu) for the regular system of a bifurcation, and w_mu.

    du = alpha v - w_R - dmu w_mu leaves only a force along b. alpha and dmu follow from the linear
    equations g + dg = 0 and v . R_mu + d(v . R_mu) = 0. w_mu is the response to the load without v.

    Parameters
    ----------
    tangent
        The augmented tangent at the state.
    """
    comm, u, v = system.comm, state.u, tangent.v
    # responses w orthogonal to b, and the part v . R_mu of the load that K cannot balance
    w_R, _ = tangent.solve(system.residual(u, state.mu))
    w_mu, work = tangent.solve(system.load(u, state.mu, name))
    # Pi'''(v, v, .), then (dK/dmu) v as the derivative of R_mu along v
    cubic = third_derivative(system, state, v)
    K_mu_v = first_difference(lambda u: system.load(u, state.mu, name), system, u, v)
    mixed = mixed_third_derivative(system, state, v, w_mu) - K_mu_v  # -d(v . R_mu)/du
    # derivatives of g and of v . R_mu along (du, dmu) = (-w_mu, 1)
    g_mu = dot(comm, mixed, v)
    load_rate = dot(comm, v, _load_rate(system, state, name))
    work_mu = dot(comm, mixed, w_mu) - dot(comm, K_mu_v, w_mu) + load_rate
    rows = [[g_mu, -dot(comm, cubic, v)], [work_mu, -g_mu]]
    right_side = [-tangent.g - dot(comm, cubic, w_R), -work - dot(comm, mixed, w_R)]
    dmu, alpha = np.linalg.solve(rows, right_side)
    return alpha * v - w_R - dmu * w_mu, float(dmu), w_mu


def _load_rate(system: System, state: State, name: str) -> Vector:
    """Return R_mumu, the derivative of the load vector by its own amplitude, by a difference.

    It is exactly zero for an amplitude that multiplies its term.
    """
    mu, mu_step = state.mu[name], DIFFERENCE_STEP * (abs(state.mu[name]) or 1.0)
    forward, backward = (
        system.load(state.u, {**state.mu, name: mu + step}, name) for step in (mu_step, -mu_step)
    )
    return np.asarray((forward - backward) / (2 * mu_step))


def mixed_third_derivative(
    system: System, state: State, v: Vector, w: Vector, residual: Vector | None = None
) -> Vector:
    """Return Pi'''(v, w, .) at a state as a vector. Collective.

    It is the polarisation 4 Pi'''(v, w) = Pi'''(v + w, v + w) - Pi'''(v - w, v - w), with w
    scaled to the size of v.

    Parameters
    ----------
    residual
        The residual at the state; None: it is computed.
    """
    comm = system.comm
    ratio = max_abs(comm, w) / max_abs(comm, v)
    if ratio == 0.0:  # w is zero
        return np.zeros_like(v)
    residual = system.residual(state.u, state.mu) if residual is None else residual
    # along v + w and v - w, with w over the ratio
    plus, minus = (
        third_derivative(system, state, v + sign * w / ratio, residual) for sign in (1, -1)
    )
    return np.asarray(ratio / 4 * (plus - minus))


def _has_converged(sizes: Sequence[float]) -> bool:
    """Return whether the last step is below the tolerance, or as small as rounding allows.

    A small step that is not half as long as the one before counts as rounding.

    Parameters
    ----------
    sizes
        Sizes of the steps so far, in lengths of the system.
    """
    if not sizes:
        return False
    if sizes[-1] <= TOLERANCE:
        return True
    stalled = len(sizes) > 1 and sizes[-1] > sizes[-2] / 2
    return stalled and sizes[-1] <= ROUNDING_STEP


def _load_has_converged(changes: Sequence[float], mu: float) -> bool:
    """Return whether the last change of the amplitude is below the tolerance, or only rounding.

    A small change that is not half as large as the one before counts as rounding.

    Parameters
    ----------
    changes
        Magnitudes of the changes so far, one for each step.
    mu
        The amplitude itself, relative to which a change is small.
    """
    stalled = len(changes) > 1 and changes[-1] > changes[-2] / 2
    is_rounding = stalled and changes[-1] <= ROUNDING_STEP * abs(mu)
    return is_rounding or changes[-1] <= TOLERANCE * abs(mu)


@dataclass(frozen=True)
class BranchSwitch:
    """The branch at a bifurcation, in both directions.

    Attributes
    ----------
    symmetric
        Whether the amplitude changes equally in both directions (a pitchfork).
    starts
        A point in each direction, with a tangent that leads away; arc length is zero there.
    """

    symmetric: bool
    starts: tuple[Point, Point]


def switch_branch(
    path: Path,
    bifurcation: Point,
    refused: Callable[[Point, Point], bool] = lambda low, high: False,
) -> BranchSwitch | None:
    """Leave a path at a located bifurcation along the null vector. Collective.

    Points are solved at a distance along the null vector, in both directions. The distance grows
    until the amplitude changes by more than rounding. If no points are found at the first distance,
    smaller ones are tried.

    Parameters
    ----------
    path
        The path, controlled by arc length.
    refused
        Called with the bifurcation and a first point of the branch. It returns whether the straight
        segment between them must not be passed; a nearer point is tried then.

    Returns
    -------
    The branch in both directions; None if the null vector or the first points are not found.
    """
    name, state = path.name, bifurcation.state
    try:
        mode = critical_mode(path.newton, state).vector
    except NoEigenpair:
        return None
    # its largest entry is one length of the system, positive on any number of ranks
    mode = np.asarray(mode * path.system.length / largest_entry(path.system.comm, mode))
    branch_switch = None
    sizes = list(FIRST_STEP_SIZES)  # the distances still to be tried
    while sizes:
        size = sizes.pop(0)
        # a point in each direction; None if it is not found or refused
        points = (_step_off(path, state, mode, signed) for signed in (size, -size))
        start, opposite_start = (
            point if point and not refused(bifurcation, point) else None for point in points
        )
        if start is None or opposite_start is None:
            if branch_switch:  # the points at the last distance serve
                break
            sizes = [smaller for smaller in SMALLER_STEP_SIZES if smaller < size]
            continue
        # the changes of the amplitude in both directions
        rise, opposite_rise = (
            point.state.mu[name] - state.mu[name] for point in (start, opposite_start)
        )
        symmetric = abs(rise - opposite_rise) <= ASYMMETRY_TOLERANCE * abs(rise + opposite_rise)
        branch_switch = BranchSwitch(symmetric, (start, opposite_start))
        # a smaller change of the amplitude is rounding, which must not decide on the symmetry: then
        # a larger distance is tried
        largest_rise = max(abs(rise), abs(opposite_rise))
        changes_load = largest_rise > LOAD_CHANGE_TOLERANCE * abs(state.mu[name])
        if size < FIRST_STEP_SIZES[0] or changes_load:
            break
    return branch_switch


def largest_entry(comm: MPI.Comm, v: Vector) -> float:
    """Return the entry of largest magnitude with its sign; the same on any number of ranks.

    Collective.
    """
    largest_here = float(v[np.argmax(np.abs(v))]) if v.size else 0.0
    return float(max(comm.allgather(largest_here), key=abs))


def _step_off(path: Path, state: State, mode: Vector, size: float) -> Point | None:
    """Return the first point of the branch at a distance along the null vector. Collective.

    Its tangent leads away from the bifurcation. First a force along the null vector pushes the
    system there at the same amplitude. Then the force is removed, the distance is kept, and the
    amplitude is unknown.

    Parameters
    ----------
    state
        The state at the bifurcation.
    mode
        The null vector, whose largest entry is one length of the system.
    size
        The distance in units of the mode, with the sign of the direction.

    Returns
    -------
    The point, with arc length zero; None if it is not found.
    """
    metric, name, newton = path.metric, path.name, path.newton
    # the row <mode, u - u of the state> = distance
    distance = size * metric.inner((mode, 0.0), (mode, 0.0))
    row = Hyperplane(metric, name, base=state, normal=(mode, 0.0), distance=distance)
    try:
        pushed = held_along(newton, State(state.u + size * mode, state.mu), mode)
    except np.linalg.LinAlgError:  # singular in another direction too
        return None
    if pushed is None:
        return None
    pushed_state, _ = pushed  # and its error
    point = path.solve(row, 0.0, pushed_state)
    if isinstance(point, str):
        return None
    # the tangent per unit of arc length, with the sense of the step
    return point.with_tangent_per(copysign(metric.norm(point.du, point.dmu), size))

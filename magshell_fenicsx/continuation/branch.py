"""The branches that cross a path at a bifurcation."""

from dataclasses import dataclass
from math import copysign

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.continuation.augmented import held_along
from magshell_fenicsx.continuation.control import Hyperplane
from magshell_fenicsx.continuation.events import critical_mode
from magshell_fenicsx.continuation.inverse import NoEigenpair
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import State, Vector

SIZES = 0.5, 2.0, 8.0  # of the first step off the path, in lengths of the system
SEEN = 1e-4  # a larger relative change of the amplitude is no rounding error
ODD = 0.1  # a branch is asymmetric if the changes of the amplitude in both directions differ by more than this part


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


def branching(path: Path, bifurcation: Point) -> Branching | None:
    """Leave a path at a located bifurcation along the null vector; None if that or the first points are not found.

    Parameters
    ----------
    path
        Controlled by arc length.
    """
    name, state = path.name, bifurcation.state
    try:
        mode = critical_mode(path.newton, state).vector
    except NoEigenpair:
        return None
    mode = np.asarray(mode * path.system.length / largest(path.system.comm, mode))
    found = None
    for size in SIZES:
        starts = [_step_off(path, state, mode, signed) for signed in (size, -size)]
        if starts[0] is None or starts[1] is None:
            return found
        rises = [point.state.mu[name] - state.mu[name] for point in starts if point]
        symmetric = abs(rises[0] - rises[1]) <= ODD * abs(rises[0] + rises[1])
        found = Branching(symmetric, (starts[0], starts[1]))
        if max(map(abs, rises)) > SEEN * abs(state.mu[name]):
            break
    return found


def largest(comm: MPI.Comm, v: Vector) -> float:
    """The entry of largest magnitude with its sign, which is the same on any number of ranks."""
    here = float(v[np.argmax(np.abs(v))]) if v.size else 0.0
    return float(max(comm.allgather(here), key=abs))


def _step_off(path: Path, state: State, mode: Vector, size: float) -> Point | None:
    """The point of the branch at a distance along the null vector, with a tangent that leads away.

    First a force along the null vector pushes the system there at the same amplitude. Then the force is removed
    and the amplitude is unknown.
    """
    metric, name, newton = path.metric, path.name, path.newton
    row = Hyperplane(metric, name, state, (mode, 0.0), size * metric.inner((mode, 0.0), (mode, 0.0)))
    try:
        pushed = held_along(newton, State(state.u + size * mode, state.mu), mode)
    except np.linalg.LinAlgError:  # singular in another direction too
        return None
    if pushed is None:
        return None
    found = path.solve(row, 0.0, pushed[0])
    if isinstance(found, str):
        return None
    return found.per(copysign(metric.norm(found.du, found.dmu), size))

"""The tangent of a path at a solution, from the factors of a state near by."""

import numpy as np

from magshell_fenicsx.continuation.bordered import Bordered, plus
from magshell_fenicsx.continuation.control import Row, slope
from magshell_fenicsx.continuation.system import Direction, State, System, Vector, max_abs

MOST_REFINEMENTS = 4
REFINED, SIGN = 1e-3, 1e-2  # relative errors of a tangent's du and dmu
DIFFERENCE = 1e-5  # in lengths: the step of the differences that replace K times a vector


def refined_tangent(
    system: System, matrix: Bordered, t: Direction, state: State, load: Vector, row: Row
) -> Direction | None:
    """The path's tangent at a state, from the matrix of a state near by, by generalised conjugate residuals.

    None if the matrix is too far away.
    """
    comm, gradient = system.comm, row.gradient(state)
    R = system.residual(state.u, state.mu)

    def times(t: Direction) -> Direction:
        return matrix.solve(_stiffness(system, state, R, t[0]) + t[1] * load, slope(comm, gradient, t))

    z, known = plus(t, -1.0, times(t)), list[tuple[Direction, Direction, float]]()
    for _ in range(MOST_REFINEMENTS):
        if max_abs(comm, z[0]) <= REFINED * max_abs(comm, t[0]) and abs(z[1]) <= SIGN * abs(t[1]):
            return t
        p, q = z, times(z)
        for before, image, square in known:
            part = matrix.inner(image, q) / square
            p, q = plus(p, -part, before), plus(q, -part, image)
        known.append((p, q, matrix.inner(q, q)))
        part = matrix.inner(z, q) / known[-1][2]
        t, z = plus(t, part, p), plus(z, -part, q)
    return None


def _stiffness(system: System, state: State, R: Vector, du: Vector) -> Vector:
    """K du by a difference of the residual; R is the residual at the state."""
    size = max_abs(system.comm, du)
    if size == 0.0:
        return du
    small = DIFFERENCE * system.length / size
    return np.asarray((system.residual(state.u + small * du, state.mu) - R) / small)

"""The tangent of a path at a solution, from factors that were made near by."""

import numpy as np

from magshell_fenicsx.continuation.bordered import Bordered, Direction, plus
from magshell_fenicsx.continuation.control import Row
from magshell_fenicsx.continuation.system import State, System, Vector, dot, max_abs

MOST_REFINEMENTS = 4
REFINED, SIGN = 1e-3, 1e-2  # relative errors of a tangent's du and dmu
DIFFERENCE = 1e-5  # lengths, of the differences that stand for K times a vector


def refined_tangent(
    system: System, matrix: Bordered, t: Direction, state: State, load: Vector, row: Row
) -> Direction | None:
    """The tangent at a state from that of a matrix near by, by generalised conjugate residuals; None if too far."""
    comm, (c, d) = system.comm, row.gradient(state)
    R = system.residual(state.u, state.mu)

    def times(t: Direction) -> Direction:
        g = d * t[1] + (dot(comm, c, t[0]) if c is not None else 0.0)
        return matrix.solve(_stiffness(system, state, R, t[0]) + t[1] * load, g)

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
    """K du by a difference of the residual from R, that of the state."""
    size = max_abs(system.comm, du)
    if size == 0.0:
        return du
    small = DIFFERENCE * system.length / size
    return np.asarray((system.residual(state.u + small * du, state.mu) - R) / small)

"""Inverse iteration for the eigenpair of a factored tangent that is nearest to zero."""

import numpy as np

from magshell_fenicsx.solve.factor import Factorisation
from magshell_fenicsx.solve.system import Vector, dot

ITERATIONS = 12


def nearest_to_zero(factors: Factorisation) -> tuple[float, Vector]:
    """Eigenvalue and eigenvector, of length one; of a nearly singular tangent the null vector. Collective."""
    comm = factors.matrix.comm.tompi4py()
    v, value = np.sin(1.0 + np.arange(factors.matrix.getLocalSize()[0]) + comm.rank), 0.0
    for _ in range(ITERATIONS):
        v = v / np.sqrt(dot(comm, v, v))
        w = factors.solve(v)
        value, v = 1 / dot(comm, v, w), w
    return value, v / np.sqrt(dot(comm, v, v))

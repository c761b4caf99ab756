"""An estimate of the condition number of a tangent."""

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import dot


def condition_estimate(factors: Factorisation, size: int, comm: MPI.Comm, iterations: int = 30) -> float:
    """Largest over smallest |eigenvalue| of the matrix last factored; a lower bound, good to some per cent.

    Parameters
    ----------
    size
        Unknowns on this rank.
    iterations
        Power iterations for the largest eigenvalue, and inverse iterations for the smallest.
    """
    largest, inverse = 0.0, 0.0
    a = b = np.sin(1.0 + np.arange(size) + comm.rank)
    for _ in range(iterations):
        a, b = a / np.sqrt(dot(comm, a, a)), b / np.sqrt(dot(comm, b, b))
        a, b = factors.times(a), factors.solve(b)
        largest, inverse = np.sqrt(dot(comm, a, a)), np.sqrt(dot(comm, b, b))
    return float(largest * inverse)

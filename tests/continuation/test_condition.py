"""The condition of a matrix with known eigenvalues."""

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.continuation.factor import Factorisation, condition_estimate


def test_condition_of_a_known_spectrum() -> None:
    """Eigenvalues 1e-3 to 1e4, of both signs, in a random basis: condition 1e7."""
    rng = np.random.default_rng(0)
    values = np.array([1e-3, -0.5, 1.0, 2.0, -30.0, 1e4])
    Q = np.linalg.qr(rng.standard_normal((6, 6)))[0]
    K = PETSc.Mat().createDense((6, 6), array=Q @ np.diag(values) @ Q.T, comm=MPI.COMM_SELF).convert("aij")
    K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    factors = Factorisation(MPI.COMM_SELF)
    factors.factor(K)
    assert condition_estimate(factors, 6, MPI.COMM_SELF) == pytest.approx(1e7, rel=1e-6)

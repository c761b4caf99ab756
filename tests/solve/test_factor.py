"""Factors stay what they were until the next `factor`."""

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.solve.factor import Factorisation


def matrix(diagonal: list[float]) -> PETSc.Mat:
    K = PETSc.Mat().createAIJ([len(diagonal)] * 2, comm=MPI.COMM_SELF)
    K.setUp()
    K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    fill(K, diagonal)
    return K


def fill(K: PETSc.Mat, diagonal: list[float]) -> None:
    for i, value in enumerate(diagonal):
        K.setValue(i, i, value)
    K.assemble()


def test_factors_outlive_the_matrix_they_were_made_of() -> None:
    K, factors = matrix([2.0, 4.0]), Factorisation(MPI.COMM_SELF)
    factors.factor(K)
    fill(K, [-8.0, 1.0])
    assert factors.solve(np.ones(2)) == pytest.approx([0.5, 0.25])
    factors.factor(K)
    assert factors.solve(np.ones(2)) == pytest.approx([-0.125, 1.0])
    assert (factors.negative_pivots, factors.count) == (1, 2)


def test_null_vector_survives_an_exactly_singular_matrix() -> None:
    factors = Factorisation(MPI.COMM_SELF)
    factors.factor(matrix([3.0, 0.0]))
    v = factors.solve(np.ones(2))
    assert abs(v[1]) > 1e10 * abs(v[0])

"""Factors of the sparse part of K + D in place of those of all of it: dense eigenvalues and solutions by NumPy."""

from dataclasses import dataclass

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import Beside, Rest

Array = NDArray[np.float64]
SIZE = 60


@dataclass
class Full:
    """A `Rest` of one rank."""

    D: Array

    def times(self, v: Array) -> Array:
        return self.D @ v

    def scaled(self, factor: float) -> "Full":
        return Full(factor * self.D)

    def over(self, other: Rest) -> float:
        return float(np.sum(self.D * other.D) / np.sum(other.D**2)) if isinstance(other, Full) else 0.0

    def added_to(self, K: PETSc.Mat) -> PETSc.Mat:
        n = len(self.D)
        return matrix(self.D + K.getValues(range(n), range(n)))


def matrix(values: Array) -> PETSc.Mat:
    n = len(values)
    K = PETSc.Mat().createAIJ([n, n], nnz=n, comm=MPI.COMM_SELF)
    K.setValues(range(n), range(n), values)
    K.assemble()
    K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return K


def beside(soft: list[float], moved: float, noise: float) -> tuple[Array, Array]:
    """K with these eigenvalues beside those from 1 to 1e4, and D that adds a number to them and noise to all."""
    random = np.random.default_rng(1)
    Q = np.linalg.qr(random.standard_normal((SIZE, SIZE)))[0]
    eigenvalues = np.concatenate([soft, np.geomspace(1, 1e4, SIZE - len(soft))])
    rest = random.standard_normal((SIZE, SIZE)) * noise
    return (Q * eigenvalues) @ Q.T, moved * Q[:, : len(soft)] @ Q[:, : len(soft)].T + rest + rest.T


@pytest.mark.parametrize(
    ("soft", "moved"),
    [
        ([], 0.0),
        ([0.02], -0.03),  # one more
        ([0.02], -0.01),
        ([-0.02], 0.03),  # one less
        ([-0.02, -0.02, -0.02], 0.03),  # three at once, of one eigenvalue
        ([0.02, 0.02, -0.05, 0.3], -0.03),
        ([1e-6], -2e-3),  # K0 all but singular
        ([0.02, 0.1], -0.02 - 1e-7),  # K all but singular
    ],
)
def test_inertia_and_solutions(soft: list[float], moved: float) -> None:
    """Negative pivots of K + D are its negative eigenvalues, and solutions those of NumPy, from factors of K."""
    K0, D = beside(soft, moved, 1e-5)
    factors, b = Factorisation(MPI.COMM_SELF), np.cos(np.arange(SIZE))
    factors.factor(Beside(matrix(K0), Full(D)))
    eigenvalues = np.linalg.eigvalsh(K0 + D)
    assert factors.doubt < np.inf, "K + D was factored itself"
    assert factors.negative_pivots == np.sum(eigenvalues < 0)
    exact = np.linalg.solve(K0 + D, b)
    error = 1e-9 / min(1.0, 1e2 * np.abs(eigenvalues).min())
    assert np.linalg.norm(factors.solve(b) - exact) < error * np.linalg.norm(exact)
    assert np.linalg.norm(factors.times(exact) - b) < 1e-6 * np.linalg.norm(b)
    assert factors.doubt > 1 or np.sum(np.linalg.eigvalsh(K0 + 2 * D) < 0) == factors.negative_pivots


def test_what_is_not_small() -> None:
    """Where D is as large as K the sum is factored: the inertia is that of all entries."""
    K0, D = beside([], 0.0, 300.0)
    factors = Factorisation(MPI.COMM_SELF)
    factors.factor(Beside(matrix(K0), Full(D)))
    assert factors.doubt == np.inf
    assert factors.negative_pivots == np.sum(np.linalg.eigvalsh(K0 + D) < 0) > 0


def test_an_older_part_is_corrected_where_the_count_depends_on_it() -> None:
    """D of an earlier state, by which K + D is still definite: the count is that of the present, by two products."""
    K, D = beside([0.02], -0.015, 1e-5)
    present, products = 1.5 * D, 0

    def times(v: Array) -> Array:
        nonlocal products
        products += 1
        return present @ v

    factors = Factorisation(MPI.COMM_SELF)
    factors.factor(Beside(matrix(K), Full(D), Full(D), times))
    of_older, of_present = (int(np.sum(np.linalg.eigvalsh(K + each) < 0)) for each in (D, present))
    assert factors.negative_pivots == of_present != of_older
    assert factors.doubt < 1.0
    assert 0 < products <= 2

"""Factors of the sparse part of K + D in place of those of all of it: dense eigenvalues and
solutions by NumPy.
"""

import numpy as np
import pytest
from continuation.toys import Full, dense
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import CorrectedTangent

Array = NDArray[np.float64]
SIZE = 60


def beside(soft: list[float], moved: float, noise: float) -> tuple[Array, Array]:
    """K with these eigenvalues beside those from 1 to 1e4, and D that adds a number to them and
    noise to all.
    """
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
    """Negative pivots of K + D are its negative eigenvalues, and solutions those of NumPy, from
    factors of K.
    """
    K0, D = beside(soft, moved, 1e-5)
    factors, b = Factorisation(MPI.COMM_SELF), np.cos(np.arange(SIZE))
    factors.factor(CorrectedTangent(dense(K0), Full(D)))
    eigenvalues = np.linalg.eigvalsh(K0 + D)
    assert factors.inertia_uncertainty < np.inf, "K + D was factored itself"
    assert factors.negative_pivots == np.sum(eigenvalues < 0)
    exact = np.linalg.solve(K0 + D, b)
    error = 1e-9 / min(1.0, 1e2 * np.abs(eigenvalues).min())
    assert np.linalg.norm(factors.solve(b) - exact) < error * np.linalg.norm(exact)
    assert np.linalg.norm(factors.times(exact) - b) < 1e-6 * np.linalg.norm(b)
    assert (
        factors.inertia_uncertainty > 1
        or np.sum(np.linalg.eigvalsh(K0 + 2 * D) < 0) == factors.negative_pivots
    )


def test_what_is_not_small() -> None:
    """Where D is as large as K the sum is factored: the inertia is that of all entries."""
    K0, D = beside([], 0.0, 300.0)
    factors = Factorisation(MPI.COMM_SELF)
    factors.factor(CorrectedTangent(dense(K0), Full(D)))
    assert factors.inertia_uncertainty == np.inf
    assert factors.negative_pivots == np.sum(np.linalg.eigvalsh(K0 + D) < 0) > 0


def test_an_older_part_is_corrected_where_the_count_depends_on_it() -> None:
    """D of an earlier state, by which K + D is still definite: the count is that of the present, by
    two products.
    """
    K, D = beside([0.02], -0.015, 1e-5)
    present, products = 1.5 * D, 0

    def times(v: Array) -> Array:
        nonlocal products
        products += 1
        return present @ v

    factors = Factorisation(MPI.COMM_SELF)
    factors.factor(CorrectedTangent(dense(K), Full(D), Full(D), times))
    of_older, of_present = (int(np.sum(np.linalg.eigvalsh(K + each) < 0)) for each in (D, present))
    assert factors.negative_pivots == of_present != of_older
    assert factors.inertia_uncertainty < 1.0
    assert 0 < products <= 2


@pytest.mark.parametrize("grown", [1.0, -0.05])
def test_an_older_part_that_was_small_and_is_not_makes_no_count_certain(grown: float) -> None:
    """D of an earlier state is noise beside K, that of the present is not: the eigenvalues of NumPy
    say of which.

    Where D has kept its size the count is certain, where it has moved the softest eigenvalue past
    zero it is not.
    """
    K, D = beside([0.02], 0.0, 1e-6)
    soft = np.linalg.eigh(K)[1][:, :1]
    present = D if grown == 1.0 else D + grown * soft @ soft.T
    factors = Factorisation(MPI.COMM_SELF)
    factors.factor(
        CorrectedTangent(dense(K), Full(D), Full(D), lambda v: present @ v, lambda v: present @ v)
    )
    of_older, of_present = (int(np.sum(np.linalg.eigvalsh(K + each) < 0)) for each in (D, present))
    assert factors.negative_pivots == of_older == 0
    assert (factors.inertia_uncertainty <= 1.0) == (of_present == of_older)

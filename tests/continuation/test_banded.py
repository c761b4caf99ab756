"""Banded Cholesky factors against NumPy's eigenvalues."""

import numpy as np
import pytest
from petsc4py import PETSc

from magshell_fenicsx.continuation.banded import Banded


@pytest.mark.parametrize("seed", range(4))
def test_definite_or_not(seed: int) -> None:
    """Two matrices of one sparsity, combined so that the least eigenvalue crosses zero."""
    random, n = np.random.default_rng(seed), 30
    order = random.permutation(n)  # of a band that the numbering hides
    near = np.abs(order[:, None] - order) <= 3
    A, B = (np.where(near, x + x.T, 0.0) for x in random.standard_normal((2, n, n)))
    A += 100 * np.eye(n)  # definite, and so is A + t B for small t alone
    mats = []
    for M in (A, B):
        K = PETSc.Mat().createAIJ([n, n], comm=PETSc.COMM_SELF)
        K.setUp()
        for i, j in np.argwhere(near):
            K.setValue(i, j, M[i, j])
        K.assemble()
        mats.append(K)
    held = np.array([0, 7], dtype=np.int32)
    banded = Banded(mats[0], held)
    entries = banded.entries([K.getValuesCSR()[2] for K in mats])
    free = np.setdiff1d(np.arange(n), held)

    def least(t: float) -> float:
        return float(np.linalg.eigvalsh((A + t * B)[np.ix_(free, free)])[0])

    seen = {banded.positive(entries, [1.0, t]): least(t) > 0 for t in np.linspace(0, 60, 40)}
    assert seen == {True: True, False: False}

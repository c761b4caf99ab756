"""Banded Cholesky factors against NumPy's eigenvalues."""

import numpy as np
import pytest

from magshell_fenicsx.continuation.factor import Banded


@pytest.mark.parametrize("seed", range(4))
def test_definite_or_not(seed: int) -> None:
    """Two matrices of one sparsity, interpolated so that the least eigenvalue crosses zero."""
    random, n = np.random.default_rng(seed), 30
    order = random.permutation(n)  # of a band that the numbering hides
    near = np.abs(order[:, None] - order) <= 3
    A, B = (np.where(near, x + x.T, 0.0) for x in random.standard_normal((2, n, n)))
    A += 100 * np.eye(n)  # definite, and so is A + t (B - A) for small t alone
    rows, columns = np.nonzero(near)
    held = np.array([0, 7], dtype=np.int32)
    banded = Banded(rows, columns, held)
    bands = banded.bands([A[rows, columns], B[rows, columns]])
    free = np.setdiff1d(np.arange(n), held)

    def least(t: float) -> float:
        return float(np.linalg.eigvalsh((A + t * (B - A))[np.ix_(free, free)])[0])

    seen = {banded.positive(bands, np.array([1.0 - t, t])): least(t) > 0 for t in np.linspace(0, 0.99, 40)}
    assert seen == {True: True, False: False}

"""A test whether small symmetric matrices are positive definite, by LAPACK's banded Cholesky factors."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc
from scipy.linalg import lapack
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

Array = NDArray[np.float64]


class Banded:
    """Weighted sums of matrices that share one sparsity pattern.

    Parameters
    ----------
    pattern
        A matrix with the sparsity pattern, on one rank.
    held
        Rows and columns that are replaced by those of the unit matrix.
    """

    def __init__(self, pattern: PETSc.Mat, held: NDArray[np.int32]) -> None:
        first, columns, _ = pattern.getValuesCSR()
        n = len(first) - 1
        rows = np.repeat(np.arange(n), np.diff(first))
        order = reverse_cuthill_mckee(csr_array((np.ones(len(columns)), columns, first), (n, n)), symmetric_mode=True)
        place = np.empty(n, dtype=np.int64)
        place[order] = np.arange(n)
        i, j = place[rows], place[columns]
        free = np.ones(n, dtype=bool)
        free[held] = False
        self._kept = np.flatnonzero((i >= j) & free[rows] & free[columns])
        i, j = i[self._kept], j[self._kept]
        self._shape = (int((i - j).max(initial=0)) + 1, n)
        self._at = (i - j) + j * self._shape[0]  # in LAPACK's lower band, column by column
        self._ones = place[held]

    def entries(self, values: Sequence[Array]) -> Array:
        """The entries (matrices, kept) of some matrices that `positive` needs."""
        return np.stack([v[self._kept] for v in values])

    def positive(self, entries: Array, weights: Sequence[float]) -> bool:
        """Whether the weighted sum of the matrices is positive definite."""
        band = np.zeros(self._shape, order="F")
        band.ravel(order="K")[self._at] = np.asarray(weights) @ entries
        band[0, self._ones] = 1.0
        return bool(lapack.dpbtrf(band, lower=1, overwrite_ab=1)[1] == 0)

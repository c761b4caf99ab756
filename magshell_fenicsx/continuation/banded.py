"""Sums of small matrices with one pattern, of which only whether they are definite is asked: the modes of waves."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

Array = NDArray[np.float64]


class Banded:
    """Weighted sums of small symmetric matrices that share one sparsity pattern, and whether they are definite.

    LAPACK's banded Cholesky factors answer that.

    Parameters
    ----------
    rows, columns
        Of each entry of the pattern; one triangle is enough.
    held
        Rows and columns that are replaced by those of the unit matrix.
    """

    def __init__(self, rows: NDArray[np.int64], columns: NDArray[np.int64], held: NDArray[np.int32]) -> None:
        n = int(rows.max()) + 1
        both = np.concatenate([rows, columns]), np.concatenate([columns, rows])
        pattern = coo_array((np.ones(2 * len(rows)), both), (n, n)).tocsr()
        order = reverse_cuthill_mckee(pattern, symmetric_mode=True)
        place = np.empty(n, dtype=np.int64)
        place[order] = np.arange(n)
        free = np.ones(n, dtype=bool)
        free[held] = False
        self._kept = np.flatnonzero(free[rows] & free[columns])
        rows, columns = rows[self._kept], columns[self._kept]
        i, j = np.maximum(place[rows], place[columns]), np.minimum(place[rows], place[columns])
        self._shape = (int((i - j).max(initial=0)) + 1, n)
        self._at = (i - j) + j * self._shape[0]  # in LAPACK's lower band, column by column
        self._ones = place[held]

    def bands(self, values: Iterable[Array]) -> Array:
        """The lower bands (matrices, entries) of some matrices, with ones on the diagonal of what is held."""
        values = list(values)
        stacked = np.zeros((len(values), self._shape[0] * self._shape[1]))
        for band, v in zip(stacked, values, strict=True):
            band[self._at] = v.ravel()[self._kept]
        stacked[:, self._ones * self._shape[0]] = 1.0
        return stacked

    def positive(self, bands: Array, weights: Array) -> bool:
        """Whether the weighted sum of some matrices is positive definite; the weights' sum is one."""
        band = (weights @ bands).reshape(self._shape, order="F")
        return bool(lapack.dpbtrf(band, lower=1, overwrite_ab=1)[1] == 0)

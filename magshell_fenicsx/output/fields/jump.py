"""By how much a field that jumps between cells differs from the continuous one that is made of it."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ROUNDING = {"E": 1e-13, "M": 1e-8}  # smaller strains and moments are zero, up to rounding


def relative_jump(values: Array, continuous: Array, weight: Array, zero: float = 0.0) -> float:
    """The weighted rms of the difference between the cells' values and continuous ones, over the rms of the values.

    Parameters
    ----------
    values, continuous
        (cells, points, ...)
    weight
        (cells, points)
    zero
        Of values no larger than this there is none.

    Examples
    --------
    >>> round(relative_jump(np.array([[3.0, 5.0], [3.0, 5.0]]), np.full((2, 2), 4.0), np.ones((2, 2))), 3)
    0.243
    """

    def mean_square(f: Array) -> float:
        squared = (f**2).reshape(*weight.shape, -1).sum(axis=-1)
        return float((weight * squared).sum() / weight.sum())

    size = np.sqrt(mean_square(values))
    return float(np.sqrt(mean_square(values - continuous)) / size) if size > zero else 0.0

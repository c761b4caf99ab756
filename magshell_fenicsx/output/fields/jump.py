"""By how much a field jumps between cells, where a mean at shared nodes makes it continuous."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ROUNDING = 1e-8  # a smaller field is zero, up to rounding


def relative_jump(values: Array, continuous: Array, weight: Array) -> float:
    """The weighted rms of the difference between the cells' values and their mean, over the rms of the values.

    Parameters
    ----------
    values, continuous
        (cells, points, ...) at the cells' nodes.
    weight
        (cells, points)

    Examples
    --------
    >>> round(relative_jump(np.array([[3.0, 5.0], [3.0, 5.0]]), np.full((2, 2), 4.0), np.ones((2, 2))), 3)
    0.243
    """

    def mean_square(f: Array) -> float:
        squared = (f**2).reshape(*weight.shape, -1).sum(axis=-1)
        return float((weight * squared).sum() / weight.sum())

    size = np.sqrt(mean_square(values))
    return float(np.sqrt(mean_square(values - continuous)) / size) if size > ROUNDING else 0.0

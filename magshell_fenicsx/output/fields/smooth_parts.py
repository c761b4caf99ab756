"""The smooth parts of a surface: fields jump between them where remanence, thickness, natural shape or normal do."""

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
JUMP = 1e-3  # of a given field over its largest value
KINK = 0.5  # jump of the normal, some 30 degrees: less is a facet


def smooth_parts(corners: Numbers, sides: Numbers, given: list[Array], normals: Array) -> Numbers:
    """The number of the part to which each cell belongs.

    Parameters
    ----------
    corners
        (m, s) numbers of the nodes of the cells.
    sides
        (e, j) which of these nodes are on each side.
    given
        (m, s, ...) fields at the nodes.
    normals
        (m, s, 3)
    """
    count = len(corners)
    on = corners[:, sides].reshape(-1, sides.shape[1])  # nodes of all sides, cell after cell
    order = np.argsort(on, axis=1)
    key = np.take_along_axis(on, order, axis=1)
    _, first, which, times = np.unique(key, axis=0, return_index=True, return_inverse=True, return_counts=True)
    which = which.ravel()
    twins = np.flatnonzero((times[which] == 2) & (first[which] != np.arange(len(on))))
    pair = np.column_stack([first[which[twins]], twins])

    def jumps(field: Array) -> Array:
        """The largest jump of a field at the nodes of each shared side."""
        values = field.reshape(count, corners.shape[1], -1)[:, sides].reshape(*on.shape, -1)
        one, other = np.take_along_axis(values, order[..., None], axis=1)[pair.T]
        return np.asarray(np.abs(one - other).max(axis=(1, 2)))

    kink = jumps(normals)
    apart = kink > KINK
    for field in given:
        largest = np.abs(field).max() or 1.0
        apart |= jumps(field) > largest * (JUMP + 2 * kink)  # a field along the normal turns with facets
    a, b = (pair[~apart] // len(sides)).T
    together = scipy.sparse.coo_matrix((np.ones(len(a)), (a, b)), (count, count))
    return np.asarray(scipy.sparse.csgraph.connected_components(together, directed=False)[1], np.int64)


def split(numbers: Numbers, parts: Numbers) -> Numbers:
    """The nodes (m, s) of cells, renumbered so that each part has its own.

    Examples
    --------
    >>> split(np.array([[0, 1], [1, 2]]), np.array([0, 1])).tolist()
    [[0, 1], [2, 3]]
    """
    if not parts.any():
        return numbers
    key = np.column_stack([np.repeat(parts, numbers.shape[1]), numbers.ravel()])
    return np.unique(key, axis=0, return_inverse=True)[1].reshape(numbers.shape).astype(np.int64)

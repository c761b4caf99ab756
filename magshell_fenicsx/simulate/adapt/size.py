"""A size function of the whole chart, interpolated from element sizes at points."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grading import Size

Array = NDArray[np.float64]
NEIGHBOURS = 3
LARGEST_CHANGE = 2.5  # largest factor in one round, of a cell relative to the mean and of the mean
STEPS = 8  # sizes per factor of two; coarse steps make the mesh independent of rounding


@dataclass(frozen=True)
class Sampled:
    """The geometric mean of the sizes at the nearest points, weighted by their inverse distances.

    Attributes
    ----------
    points, sizes
        (n, 2) of the chart and (n,).
    """

    points: Array
    sizes: Array

    def __call__(self, x: Array) -> float:
        distance, near = self._tree.query(x, NEIGHBOURS)
        weight = 1 / (distance + 1e-12)
        return float(np.exp(weight @ np.log(self.sizes[near]) / weight.sum()))

    @cached_property
    def _tree(self) -> "scipy.spatial.cKDTree":
        return scipy.spatial.cKDTree(self.points)


def equidistributed(
    old: Size, centres: Array, shares: Array, order: float, reduction: float, least: float
) -> tuple[Sampled, float]:
    """Sizes for which all cells have equal shares in the error, and the error falls by a factor.

    Parameters
    ----------
    old
        Size function of the mesh whose cells have `centres` (n, 2) and `shares` (n,) of the error.
    order
        Power of the size in the error; the share of one cell falls with the power `order` + 2.
    reduction
        Wanted error over the error on the old mesh.
    least
        Smallest size: the thickness, below which only the singularity of a point force remains.

    Returns
    -------
    Sizes, and the factor of the number of cells.
    """
    wish = (np.exp(np.log(shares).mean()) / shares) ** (1 / (order + 2))
    change = _smoothed(centres, np.clip(wish, 1 / LARGEST_CHANGE, LARGEST_CHANGE))
    expected = shares @ change**order / shares.sum()  # a cell becomes change^-2 cells
    change *= np.clip((reduction / expected) ** (1 / order), 1 / LARGEST_CHANGE, LARGEST_CHANGE)
    change = 2 ** (np.round(STEPS * np.log2(change)) / STEPS)
    return Sampled(centres, np.maximum([old(x) for x in centres] * change, least)), float(np.mean(change**-2))


def _smoothed(centres: Array, wish: Array) -> Array:
    """Geometric mean of a cell and its neighbours."""
    near = scipy.spatial.cKDTree(centres).query(centres, NEIGHBOURS + 2)[1]
    return np.asarray(np.exp(np.log(wish)[near].mean(axis=1)))

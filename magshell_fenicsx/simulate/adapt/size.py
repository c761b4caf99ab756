"""Element sizes known at points, as a size function of the whole chart."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grading import Size

Array = NDArray[np.float64]
NEIGHBOURS = 3
LARGEST_CHANGE = 2.5  # of a cell against all others, and of all, in one round
STEPS = 8  # to an octave of the sizes: rounding does not show in the mesh, whatever the number of ranks


@dataclass(frozen=True)
class Sampled:
    """The geometric mean of the sizes at the nearest points, weighed by their inverse distances.

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
    """Sizes with which all cells have equal shares in the error, and that falls by a factor.

    Parameters
    ----------
    old
        Of the mesh whose cells have `centres` (n, 2) and `shares` (n,) of the error.
    order
        The error falls with this power of the size, and the share of one cell with two more.
    reduction
        Wanted error over that of the old mesh.
    least
        Smallest size. Below the thickness a shell has nothing to resolve; a point force would have, but
        without limit.

    Returns
    -------
    Sizes, and how many times more cells these make.
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

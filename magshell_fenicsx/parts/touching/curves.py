"""Points on meridians, and the places of other meridians that are nearest to them."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
Inside = NDArray[np.bool_]


@dataclass(frozen=True)
class Rule:
    """Points on the cells of two shells.

    Attributes
    ----------
    cell, shape, weight
        (n,) number, (n, functions) of that cell, and undeformed area over R^2, all around.
    first
        (n,) whether it is on the first shell.
    normal
        (n, 2) undeformed.
    on_edge
        (n,) whether it is next to a free end.
    """

    cell: Longs
    shape: Array
    weight: Array
    first: Inside
    normal: Array
    on_edge: Inside


@dataclass(frozen=True)
class Faced:
    """Points and the places that are nearest to them.

    Attributes
    ----------
    point, cell, X
        (n,) number of the point, cell of the place, and where it is in that.
    free
        (n,) whether it may move along the curve.
    distance
        (n,) over R.
    """

    point: Longs
    cell: Longs
    X: Array
    free: Inside
    distance: Array

    def of(self, which: Inside | Longs) -> "Faced":
        """Some of them."""
        return Faced(*(getattr(self, each.name)[which] for each in fields(self)))


def beside(nodes: Longs) -> Longs:
    """(cells, 2): the cell beyond each end; -1 where there is none."""
    beyond = np.full((len(nodes), 2), -1, dtype=np.int64)
    of = dict[int, tuple[int, int]]()
    for cell, end in np.ndindex(len(nodes), 2):
        if other := of.get(vertex := int(nodes[cell, end])):
            beyond[cell, end], beyond[other] = other[0], cell
        of[vertex] = cell, end
    return beyond


def nowhere() -> Faced:
    """No places."""
    nothing = np.zeros(0, dtype=np.int64)
    return Faced(nothing, nothing, np.zeros(0), np.zeros(0, dtype=bool), np.zeros(0))

"""Which rank has which cells: a function of the cells alone.

The partitioners that dolfinx calls need not divide the same mesh in the same way again: SCOTCH with
threads does not. Scenes on one mesh with other numbers of the case need the same cells and nodes on
each rank, in the same order: what touches in one scene is given to the other by their numbers.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from magshell_fenicsx.platform import compat

Ranks = NDArray[np.int32]


def partitioner(
    cells: NDArray[np.int64], nodes_of_facet: int, rank: int, size: int
) -> Callable[..., Any]:
    """The partitioner for dolfinx, of cells that the first rank gives; each rank gets one layer of
    ghosts.

    Parameters
    ----------
    cells
        (cells, nodes) of all cells, on every rank.
    nodes_of_facet
        How many nodes cells with a common facet share.
    """
    wanted, offsets = destinations(cells, nodes_of_facet, size)
    if rank:
        wanted, offsets = wanted[:0], offsets[:1]
    return lambda *_: compat.adjacency(wanted, offsets)


def destinations(
    cells: NDArray[np.int64], nodes_of_facet: int, size: int
) -> tuple[Ranks, NDArray[np.int32]]:
    """The ranks that get each cell, its owner first, one cell's after the other's; and where those
    of each cell begin.
    """
    count = len(cells)
    if size == 1:
        return np.zeros(count, np.int32), np.arange(count + 1, dtype=np.int32)
    beside = _beside(cells, nodes_of_facet)
    owner = parts(beside, size)
    cell, other = beside.nonzero()
    ghost = owner[cell] != owner[other]
    own = np.column_stack([np.arange(count), np.full(count, -1)])  # before all ghosts
    rows = np.unique(
        np.concatenate([own, np.column_stack([cell[ghost], owner[other[ghost]]])]), axis=0
    )
    wanted = np.where(rows[:, 1] < 0, owner[rows[:, 0]], rows[:, 1]).astype(np.int32)
    offsets = np.append(0, np.cumsum(np.bincount(rows[:, 0], minlength=count)))
    return wanted, offsets.astype(np.int32)


def parts(beside: csr_array, count: int) -> Ranks:
    """The part of each cell, of `count` parts of about the same size.

    A mesh is divided across the levels of cells that lie one behind the other, and each part again.

    Parameters
    ----------
    beside
        (cells, cells) ones where cells have a common facet.
    """
    size = beside.shape[0]
    part = np.zeros(size, np.int32)
    if count == 1 or not size:
        return part
    order, few = reverse_cuthill_mckee(beside, symmetric_mode=True), count // 2
    cut = round(size * few / count)
    for some, first, number in ((order[:cut], 0, few), (order[cut:], few, count - few)):
        part[some] = first + parts(beside[some][:, some], number)
    return part


def _beside(cells: NDArray[np.int64], nodes_of_facet: int) -> csr_array:
    """Ones where cells have a common facet."""
    count, per_cell = cells.shape
    nodes, number = np.unique(cells, return_inverse=True)
    on = coo_array(
        (np.ones(cells.size, np.int32), (np.repeat(np.arange(count), per_cell), number.ravel())),
        (count, len(nodes)),
    ).tocsr()
    common = (on @ on.T).tocoo()
    i, j = common.coords
    joined = (common.data >= nodes_of_facet) & (i != j)
    return coo_array(
        (np.ones(int(joined.sum()), np.int8), (i[joined], j[joined])), (count, count)
    ).tocsr()

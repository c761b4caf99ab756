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
    """Return the partitioner for dolfinx, of cells that the first rank gives.

    Each rank gets one layer of ghosts.

    Parameters
    ----------
    cells
        (cells, nodes) of all cells, on every rank.
    nodes_of_facet
        How many nodes cells with a common facet share.
    """
    ranks, offsets = destinations(cells, nodes_of_facet, size)
    if rank:
        ranks, offsets = ranks[:0], offsets[:1]
    return lambda *_: compat.adjacency(ranks, offsets)


def destinations(
    cells: NDArray[np.int64], nodes_of_facet: int, size: int
) -> tuple[Ranks, NDArray[np.int32]]:
    """Return the ranks that get each cell, its owner first, one cell after the other, and where
    those of each cell begin.
    """
    count = len(cells)
    if size == 1:
        return np.zeros(count, np.int32), np.arange(count + 1, dtype=np.int32)
    adjacency = _facet_adjacency(cells, nodes_of_facet)
    owner = part_of_cells(adjacency, size)
    cell, other = adjacency.nonzero()
    is_ghost = owner[cell] != owner[other]
    own = np.column_stack([np.arange(count), np.full(count, -1)])  # before all ghosts
    rows = np.unique(
        np.concatenate([own, np.column_stack([cell[is_ghost], owner[other[is_ghost]]])]), axis=0
    )
    ranks = np.where(rows[:, 1] < 0, owner[rows[:, 0]], rows[:, 1]).astype(np.int32)
    offsets = np.append(0, np.cumsum(np.bincount(rows[:, 0], minlength=count)))
    return ranks, offsets.astype(np.int32)


def part_of_cells(adjacency: csr_array, count: int) -> Ranks:
    """Return the part of each cell, of `count` parts of about the same size.

    A mesh is divided across the levels of cells that lie one behind the other, and each part again.

    Parameters
    ----------
    adjacency
        (cells, cells) ones where cells have a common facet.
    """
    size = adjacency.shape[0]
    part = np.zeros(size, np.int32)
    if count == 1 or not size:
        return part
    order, lower_count = reverse_cuthill_mckee(adjacency, symmetric_mode=True), count // 2
    middle = round(size * lower_count / count)
    for cells_of_part, first, number in (
        (order[:middle], 0, lower_count),
        (order[middle:], lower_count, count - lower_count),
    ):
        part[cells_of_part] = first + part_of_cells(
            adjacency[cells_of_part][:, cells_of_part], number
        )
    return part


def _facet_adjacency(cells: NDArray[np.int64], nodes_of_facet: int) -> csr_array:
    """Return a matrix (cells, cells) of ones where cells have a common facet."""
    count, per_cell = cells.shape
    nodes, number = np.unique(cells, return_inverse=True)
    nodes_of_cells = coo_array(
        (np.ones(cells.size, np.int32), (np.repeat(np.arange(count), per_cell), number.ravel())),
        (count, len(nodes)),
    ).tocsr()
    common = (nodes_of_cells @ nodes_of_cells.T).tocoo()
    i, j = common.coords
    has_common_facet = (common.data >= nodes_of_facet) & (i != j)
    return coo_array(
        (np.ones(int(has_common_facet.sum()), np.int8), (i[has_common_facet], j[has_common_facet])),
        (count, count),
    ).tocsr()

"""The sparsity pattern of (3, 3) blocks of a distributed matrix; every rank has the rows of its own nodes."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import scipy
from dolfinx.common import IndexMap
from mpi4py import MPI
from numpy.typing import NDArray

Ints = NDArray[np.int32]
Longs = NDArray[np.int64]


class Pattern:
    """The blocks of this rank, in an order that suits PETSc and communication.

    First come the blocks that couple this rank's n own nodes, row by row; then those that couple own nodes with nodes
    of other ranks; then those in the rows of ghosts, which are added on the owning ranks. These 2 n + ghosts rows of
    blocks form one matrix in compressed sparse rows, the three rows of a block one after the other. The constructor is
    collective.

    Parameters
    ----------
    nodes
        The index map of the nodes.
    coupled
        Rows and columns of blocks: local nodes, ghosts included. The diagonal blocks are always there.

    Attributes
    ----------
    owned
        n.
    starts
        (2 n + ghosts + 1,) number of the first block of every row, and of all blocks.
    columns
        (blocks,) an own node, or n + the place of another in `others`.
    others
        Global numbers, ascending, of the others' nodes.
    """

    def __init__(self, nodes: IndexMap, coupled: Iterable[tuple[Ints, Ints]], comm: MPI.Comm) -> None:
        n, ghosts, first = nodes.size_local, nodes.num_ghosts, nodes.local_range[0]
        self.owned, self._comm = n, comm
        own = np.arange(n, dtype=np.int32)
        numbers = nodes.local_to_global(np.arange(n + ghosts, dtype=np.int32))
        i, j = (np.concatenate(part) for part in zip((own, own), *coupled, strict=True))
        # the blocks that this rank has for others, by rank, and those that others have for it
        theirs = _blocks(i[i >= n] - n, j[i >= n], (ghosts, n + ghosts)).tocoo()
        ranks = nodes.owners[theirs.row] if ghosts else theirs.row
        order = np.argsort(ranks, kind="stable")
        leaving = theirs.row[order] + n, theirs.col[order]
        self._sent = np.bincount(ranks, minlength=comm.size)
        self._received = np.array(comm.alltoall(list(self._sent)))
        arriving = tuple(self._exchange(numbers[x], 1) for x in leaving)
        foreign = (arriving[1] < first) | (arriving[1] >= first + n)
        self.others = np.unique(np.concatenate([numbers[n:], arriving[1][foreign]]))
        places = np.where(foreign, n + np.searchsorted(self.others, arriving[1]), arriving[1] - first)
        self._places = np.concatenate([own, n + np.searchsorted(self.others, numbers[n:])]).astype(np.int32)
        self._width = n + len(self.others)
        came = self._row(arriving[0] - first, places), places
        rows, columns = (np.concatenate(part, dtype=np.int32) for part in zip(self._at(i, j), came, strict=True))
        del i, j
        blocks = _blocks(rows, columns, (2 * n + ghosts, self._width))
        self.starts, self.columns = blocks.indptr, blocks.indices
        self._keys = np.repeat(np.arange(2 * n + ghosts) * self._width, np.diff(self.starts)) + self.columns
        self._leave, self._arrive = (self._entries(*at).ravel() for at in (self._at(*leaving), came))

    def blocks(self, i: Ints, j: Ints) -> Ints:
        """Numbers of the blocks of pairs of local nodes; -1 for a missing block."""
        return self._find(*self._at(i, j))

    def entries(self, i: Ints, j: Ints) -> Longs:
        """Indices (pairs, 3, 3) of the entries of the blocks of pairs of local nodes in the array of values."""
        return self._entries(*self._at(i, j))

    def add_ghosts(self, values: NDArray[np.float64]) -> None:
        """Add the rows of ghosts to the rows of their owners. Collective."""
        np.add.at(values, self._arrive, self._exchange(values[self._leave], 9))

    def csr(self, first: int, last: int) -> tuple[Ints, Ints]:
        """Some rows of blocks in compressed sparse rows: the start of each row, and the columns."""
        starts = self.starts[first : last + 1]
        columns = self.columns[starts[0] : starts[-1]]
        nothing = np.zeros((len(columns), 3, 3), dtype=np.int8)
        shape = (3 * (last - first), 3 * self._width)
        rows = scipy.sparse.bsr_array((nothing, columns, starts - starts[0]), shape=shape).tocsr()
        return rows.indptr, rows.indices

    def _at(self, i: Ints, j: Ints) -> tuple[Any, Any]:
        """Row and column of the block of two local nodes."""
        places = self._places[j]
        return self._row(i, places), places

    def _row(self, i: Any, places: Any) -> Any:
        return i + self.owned * ((i >= self.owned) | (places >= self.owned))

    def _find(self, rows: Any, columns: Any) -> Ints:
        keys = rows * np.int64(self._width) + columns
        found = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        return np.where(self._keys[found] == keys, found, -1).astype(np.int32)

    def _entries(self, rows: Any, columns: Any) -> Longs:
        start, width = self.starts[rows].astype(np.int64), 3 * (self.starts[rows + 1] - self.starts[rows])
        c = np.arange(3)
        first = 6 * start + 3 * self._find(rows, columns)
        return np.asarray(first[:, None, None] + c[:, None] * width[:, None, None] + c)

    def _exchange(self, values: NDArray[Any], size: int) -> NDArray[Any]:
        """Send values, `size` for each block, to the owners of the rows. Collective."""
        values = np.ascontiguousarray(values)
        came = np.empty(size * int(self._received.sum()), dtype=values.dtype)
        self._comm.Alltoallv([values, size * self._sent], [came, size * self._received])
        return came


def _blocks(rows: Ints, columns: Ints, shape: tuple[int, int]) -> "scipy.sparse.csr_array":
    """A matrix with each position once, sorted; its values have no meaning."""
    found = scipy.sparse.coo_array((np.zeros(len(rows), dtype=np.int8), (rows, columns)), shape=shape).tocsr()
    found.sum_duplicates()
    return found

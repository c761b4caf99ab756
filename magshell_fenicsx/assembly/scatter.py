"""The matrix of a vector field, assembled from the matrices of cells and of interior edges.

Its sparsity is that of (3, 3) blocks; every rank has the rows of its own nodes.
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from dolfinx import fem
from dolfinx.common import IndexMap
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.platform.native import native

Ints = NDArray[np.int32]
Longs = NDArray[np.int64]


class Pattern:
    """The blocks of this rank, in an order that suits PETSc and communication.

    First come the blocks that couple this rank's n own nodes, row by row; then those that couple
    own nodes with nodes of other ranks; then those in the rows of ghosts, which are added on the
    owning ranks. These 2 n + ghosts rows of blocks form one matrix in compressed sparse rows, the
    three rows of a block one after the other. The constructor is collective.

    Parameters
    ----------
    nodes
        The index map of the nodes.
    coupled
        Rows and columns of blocks: local nodes, ghosts included. The diagonal blocks are always
        there.

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

    def __init__(
        self, nodes: IndexMap, coupled: Iterable[tuple[Ints, Ints]], comm: MPI.Comm
    ) -> None:
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
        places = np.where(
            foreign, n + np.searchsorted(self.others, arriving[1]), arriving[1] - first
        )
        self._places = np.concatenate([own, n + np.searchsorted(self.others, numbers[n:])]).astype(
            np.int32
        )
        self._width = n + len(self.others)
        came = self._row(arriving[0] - first, places), places
        rows, columns = (
            np.concatenate(part, dtype=np.int32) for part in zip(self._at(i, j), came, strict=True)
        )
        del i, j
        blocks = _blocks(rows, columns, (2 * n + ghosts, self._width))
        self.starts, self.columns = blocks.indptr, blocks.indices
        self._keys = (
            np.repeat(np.arange(2 * n + ghosts) * self._width, np.diff(self.starts)) + self.columns
        )
        self._leave, self._arrive = (
            self._entries(*at).ravel() for at in (self._at(*leaving), came)
        )

    def blocks(self, i: Ints, j: Ints) -> Ints:
        """Numbers of the blocks of pairs of local nodes; -1 for a missing block."""
        return self._find(*self._at(i, j))

    def entries(self, i: Ints, j: Ints) -> Longs:
        """Indices (pairs, 3, 3) of the entries of the blocks of pairs of local nodes in the array
        of values.
        """
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
        places = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        return np.where(self._keys[places] == keys, places, -1).astype(np.int32)

    def _entries(self, rows: Any, columns: Any) -> Longs:
        start, width = (
            self.starts[rows].astype(np.int64),
            3 * (self.starts[rows + 1] - self.starts[rows]),
        )
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
    positions = scipy.sparse.coo_array(
        (np.zeros(len(rows), dtype=np.int8), (rows, columns)), shape=shape
    ).tocsr()
    positions.sum_duplicates()
    return positions


Array = NDArray[np.float64]
FUNCTIONS = """
    void scatter_same(double *, const int32_t *, int32_t, int64_t, int64_t, const int32_t *, const int32_t *,
        const double *);
    void scatter_cross(double *, const int32_t *, int32_t, int64_t, int64_t, const int32_t *, const int32_t *,
        const int32_t *, const double *);
"""


class BlockMatrix:
    """A symmetric matrix; clamped degrees of freedom have ones on the diagonal and zeros beside it.

    PETSc shares the array of its values, so assembly copies and sorts nothing.

    Parameters
    ----------
    coupled
        Batches of pairs of local cells, (n,) on one side and on the other, with blocks that couple
        them.
    clamped
        Homogeneous Dirichlet conditions.
    """

    def __init__(
        self,
        V: fem.FunctionSpace,
        coupled: Sequence[tuple[Ints, ...]],
        clamped: list[fem.DirichletBC],
    ) -> None:
        comm, nodes = V.mesh.comm, V.dofmap.index_map
        self._ffi, self._lib = native(Path(__file__).with_name("scatter.c"), FUNCTIONS, comm)
        self._cells = np.ascontiguousarray(V.dofmap.list)
        self._coupled = [(self._cells[rows], self._cells[columns]) for rows, columns in coupled]
        held = np.zeros((nodes.size_local + nodes.num_ghosts, 3), dtype=bool)
        for bc in clamped:
            held.ravel()[bc.dof_indices()[0]] = True
        self._wholly = np.array(held.all(axis=1))
        self._pattern = pattern = Pattern(nodes, self._free_pairs(), comm)
        self._blocks = pattern.blocks(*_pairs(self._cells, self._cells))
        self._coupling_blocks = [
            np.stack(
                [pattern.blocks(*_pairs(rows, columns)), pattern.blocks(*_pairs(columns, rows))],
                axis=1,
            )
            for rows, columns in self._coupled
        ]
        self._zeros, self._ones = self._held_entries(held)
        n = pattern.owned
        self._values = np.zeros(9 * int(pattern.starts[-1]))
        i, j = pattern.csr(0, n)
        parts = [(i, j, self._values[: len(j)])]
        if comm.size > 1:
            oi, oj = pattern.csr(n, 2 * n)
            oj -= 3 * n
            numbers = (3 * pattern.others[oj // 3] + oj % 3).astype(PETSc.IntType)
            parts.append((oi, numbers, self._values[len(j) : len(j) + len(oj)]))
        size = ((3 * n, None), (3 * n, None))
        self._K = PETSc.Mat().createAIJWithArrays(
            size, parts[0] if comm.size == 1 else tuple(parts), comm=comm
        )
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            self._K.setOption(option, True)

    def clear(self) -> None:
        """Set all values to zero."""
        self._values[:] = 0

    def add_cells(self, K: Array) -> None:
        """Add the matrices of all local cells.

        Parameters
        ----------
        K
            (cells, 9, pairs a <= b of functions): the symmetric parts of the blocks at a, b,
            components in the order of `point_kernels.COMPONENTS`, then their skew parts in that of
            `point_kernels.SKEW`.
        """
        self._scatter("same", self._cells, self._blocks, K)

    def add_coupling(self, batch: int, K: Array) -> None:
        """Add the blocks that couple the two cells of each pair of a batch, and their transposes.

        Parameters
        ----------
        K
            (pairs, 9, functions^2).
        """
        self._scatter("cross", *self._coupled[batch], self._coupling_blocks[batch], K)

    def assemble(self) -> PETSc.Mat:
        """The matrix, summed over the ranks; always the same object. Collective."""
        self._values[self._zeros] = 0
        self._pattern.add_ghosts(self._values)
        self._values[self._ones] = 1
        self._K.stateIncrease()
        return self._K

    def _scatter(self, kind: str, *arrays: NDArray[np.float64] | Ints) -> None:
        def pointer(x: NDArray[np.float64] | Ints) -> object:
            assert x.flags.c_contiguous
            return self._ffi.from_buffer("double[]" if x.dtype == np.float64 else "int32_t[]", x)

        add = getattr(self._lib, f"scatter_{kind}")
        values, starts = pointer(self._values), pointer(self._pattern.starts)
        entities, functions = arrays[0].shape
        add(values, starts, self._pattern.owned, entities, functions, *map(pointer, arrays))

    def _free_pairs(self) -> Iterator[tuple[Ints, Ints]]:
        """Pairs of nodes with a block; a clamped node has only its diagonal block."""
        for rows, columns in self._together():
            i, j = _pairs(rows, columns)
            free = ~(self._wholly[i] | self._wholly[j])
            yield i[free], j[free]

    def _together(self) -> Iterable[tuple[Ints, Ints]]:
        yield self._cells, self._cells
        for rows, columns in self._coupled:
            yield rows, columns
            yield columns, rows

    def _held_entries(self, held: NDArray[np.bool_]) -> tuple[Longs, Longs]:
        """This rank's entries in clamped rows and columns, and the diagonal ones among them."""
        some, own = np.array(held.any(axis=1)), np.arange(self._pattern.owned, dtype=np.int32)
        keys = [own[some[own]] * (len(held) + np.int64(1))]
        for i, j in self._free_pairs():
            touched = some[i] | some[j]
            keys.append(np.unique(i[touched] * np.int64(len(held)) + j[touched]))
        i, j = (x.astype(np.int32) for x in np.divmod(np.unique(np.concatenate(keys)), len(held)))
        entries, rows, columns = (
            self._pattern.entries(i, j),
            held[i][:, :, None],
            held[j][:, None, :],
        )
        diagonal = (
            (i == j)[:, None, None]
            & rows
            & np.eye(3, dtype=bool)
            & (i < self._pattern.owned)[:, None, None]
        )
        return entries[rows | columns], entries[diagonal]


def _pairs(rows: Ints, columns: Ints) -> tuple[Ints, Ints]:
    """All pairs of an entity's nodes, (entities, functions, functions)."""
    i, j = np.broadcast_arrays(rows[:, :, None], columns[:, None, :])
    return i, j

"""The sparse matrix of a vector field, assembled from element matrices of cells and edges.

The sparsity pattern consists of (3, 3) blocks, one for each pair of coupled nodes; every rank has
the rows of its own nodes. Ghosts are local nodes that other ranks own: what a rank computes in
their rows is sent to the owner. Local nodes are numbered own ones first, then ghosts. A block has a
number, in the order of the pattern; its nine values have places in the array of values. Functions
are the shape functions of a cell, one for each of its nodes. Theory: docs/tangent.md.
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

from magshell_fenicsx.platform.native import load_native

Ints = NDArray[np.int32]
Longs = NDArray[np.int64]


class SparsityPattern:
    """The pattern of (3, 3) blocks of this rank, in an order that suits PETSc and communication.

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
        (2 n + ghosts + 1,): number of the first block of every row, and of all blocks.
    columns
        (blocks,): an own node, or n + the position of another in `others`.
    others
        Global numbers, ascending, of nodes of other ranks.

    Private fields: `_columns_of_nodes` has the column of each local node, `_width` is the number of
    columns. `_keys` has row * width + column of each block, ascending. `_sent_entries` and
    `_received_entries` tell where the values stand that `add_ghosts` sends and adds; the numbers of
    their blocks for each rank are `_sent_counts` and `_received_counts`.
    """

    def __init__(
        self, nodes: IndexMap, coupled: Iterable[tuple[Ints, Ints]], comm: MPI.Comm
    ) -> None:
        """Collect the blocks of this rank, and exchange those in the rows of ghosts. Collective."""
        n, ghosts, first_node = nodes.size_local, nodes.num_ghosts, nodes.local_range[0]
        self.owned, self._comm = n, comm
        own_nodes = np.arange(n, dtype=np.int32)
        numbers = nodes.local_to_global(np.arange(n + ghosts, dtype=np.int32))
        # i, j: local nodes of the row and the column of each block, the diagonal ones first
        pairs = zip((own_nodes, own_nodes), *coupled, strict=True)
        i, j = (np.concatenate(nodes_of_pairs) for nodes_of_pairs in pairs)
        # blocks in the rows of ghosts, as local rows and columns, go to the owners of the ghosts;
        # blocks of others come, as global rows and columns
        sent = self._blocks_to_send(nodes, i, j)
        self._received_counts = np.array(comm.alltoall(list(self._sent_counts)))
        received_rows, received_nodes = (
            self._exchange(numbers[local_nodes], size=1) for local_nodes in sent
        )
        # `others`: nodes of other ranks that occur in columns. The column of such a node is n + its
        # position among them, the column of an own node is its local number
        is_foreign = (received_nodes < first_node) | (received_nodes >= first_node + n)
        self.others = np.unique(np.concatenate([numbers[n:], received_nodes[is_foreign]]))
        received_columns = np.where(
            is_foreign,
            n + np.searchsorted(self.others, received_nodes),
            received_nodes - first_node,
        )
        ghost_columns = n + np.searchsorted(self.others, numbers[n:])
        self._columns_of_nodes = np.concatenate([own_nodes, ghost_columns]).astype(np.int32)
        self._width = n + len(self.others)
        # rows and columns in the pattern, of the blocks of this rank's cells and of those that
        # others send; each block is kept once
        received_blocks = self._row(received_rows - first_node, received_columns), received_columns
        all_positions = zip(self._position(i, j), received_blocks, strict=True)
        rows, columns = (np.concatenate(arrays, dtype=np.int32) for arrays in all_positions)
        del i, j  # large
        blocks = _unique_positions(rows, columns, (2 * n + ghosts, self._width))
        self.starts, self.columns = blocks.indptr, blocks.indices
        # a block has the key row * width + column; the keys ascend, so that a search finds a block
        block_rows = np.repeat(np.arange(2 * n + ghosts), np.diff(self.starts))
        self._keys = block_rows * self._width + self.columns
        self._sent_entries = self._entries(*self._position(*sent)).ravel()
        self._received_entries = self._entries(*received_blocks).ravel()

    def _blocks_to_send(self, nodes: IndexMap, i: Ints, j: Ints) -> tuple[Ints, Ints]:
        """Return the blocks in the rows of ghosts, in the order of the ranks that own these.

        Their number for each rank is set as `_sent_counts`.

        Parameters
        ----------
        i, j
            Local nodes of the rows and columns of all blocks.

        Returns
        -------
        Local nodes of the rows and columns, each block once.
        """
        n, ghosts = nodes.size_local, nodes.num_ghosts
        in_ghost_rows = _unique_positions(i[i >= n] - n, j[i >= n], (ghosts, n + ghosts)).tocoo()
        owners = nodes.owners[in_ghost_rows.row] if ghosts else in_ghost_rows.row
        order = np.argsort(owners, kind="stable")
        self._sent_counts = np.bincount(owners, minlength=self._comm.size)
        return in_ghost_rows.row[order] + n, in_ghost_rows.col[order]

    def blocks(self, i: Ints, j: Ints) -> Ints:
        """Return the numbers of the blocks of pairs of local nodes; -1 for a missing block."""
        return self._find(*self._position(i, j))

    def entries(self, i: Ints, j: Ints) -> Longs:
        """Return where the values of blocks that couple pairs of local nodes are stored.

        The indices in the array of values have the shape (pairs, 3, 3).
        """
        return self._entries(*self._position(i, j))

    def add_ghosts(self, values: NDArray[np.float64]) -> None:
        """Add values in the rows of ghosts to those in the rows of their owners. Collective.

        Parameters
        ----------
        values
            (9 blocks,): the values in the order of the pattern, which are changed.
        """
        received = self._exchange(values[self._sent_entries], size=9)
        np.add.at(values, self._received_entries, received)

    def csr(self, first: int, last: int) -> tuple[Ints, Ints]:
        """Return rows of blocks, from `first` up to `last`, as scalar compressed sparse rows.

        Returns
        -------
        tuple
            The start of each scalar row, and the columns.
        """
        starts = self.starts[first : last + 1]
        columns = self.columns[starts[0] : starts[-1]]
        # SciPy expands blocks (3, 3), whose values do not matter, to scalar rows
        values = np.zeros((len(columns), 3, 3), dtype=np.int8)
        shape = (3 * (last - first), 3 * self._width)
        rows = scipy.sparse.bsr_array((values, columns, starts - starts[0]), shape=shape).tocsr()
        return rows.indptr, rows.indices

    def _position(self, i: Ints, j: Ints) -> tuple[Any, Any]:
        """Return the row and the column in the pattern of the blocks of pairs of local nodes."""
        columns = self._columns_of_nodes[j]
        return self._row(i, columns), columns

    def _row(self, i: Any, columns: Any) -> Any:
        """Return the rows of blocks in the pattern: n further down in columns of other ranks.

        Parameters
        ----------
        i
            Local nodes of the rows.
        columns
            Columns of the blocks in the pattern.
        """
        # true counts as 1: rows of ghosts follow n further down, too
        return i + self.owned * ((i >= self.owned) | (columns >= self.owned))

    def _find(self, rows: Any, columns: Any) -> Ints:
        """Return the numbers of the blocks at rows and columns; -1 for a missing block."""
        keys = rows * np.int64(self._width) + columns
        # where each key would be inserted: at the same key if its block exists. A key beyond all
        # others gets the position of the last one
        positions = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        return np.where(self._keys[positions] == keys, positions, -1).astype(np.int32)

    def _entries(self, rows: Any, columns: Any) -> Longs:
        """Return where the values of the blocks at rows and columns are stored, (pairs, 3, 3).

        A row of b blocks has three scalar rows of 3 b values each.
        """
        # the first value of the block: behind 9 values of each block before the row, and 3 of each
        # earlier block in the first scalar row, 9 start + 3 (block - start)
        row_start = self.starts[rows].astype(np.int64)
        first_entry = 6 * row_start + 3 * self._find(rows, columns)
        scalar_row_length = 3 * (self.starts[rows + 1] - self.starts[rows])
        # a value at the components c, d of its block is c scalar rows and d values further
        c, d = np.arange(3)[:, None], np.arange(3)
        return np.asarray(first_entry[:, None, None] + c * scalar_row_length[:, None, None] + d)

    def _exchange(self, values: NDArray[Any], size: int) -> NDArray[Any]:
        """Send values of blocks in the rows of ghosts to the owners of the rows. Collective.

        Parameters
        ----------
        values
            `size` values for each block that is sent, in the order of ranks.

        Returns
        -------
        The values that other ranks have sent, in the order of ranks.
        """
        values = np.ascontiguousarray(values)
        received = np.empty(size * int(self._received_counts.sum()), dtype=values.dtype)
        self._comm.Alltoallv(
            [values, size * self._sent_counts], [received, size * self._received_counts]
        )
        return received


def _unique_positions(
    rows: Ints, columns: Ints, shape: tuple[int, int]
) -> "scipy.sparse.csr_array":
    """Return a matrix with each position once, sorted by rows; its values have no meaning.

    Parameters
    ----------
    rows, columns
        Positions, which may occur several times.
    """
    values = np.zeros(len(rows), dtype=np.int8)
    positions = scipy.sparse.coo_array((values, (rows, columns)), shape=shape).tocsr()
    positions.sum_duplicates()
    return positions


Array = NDArray[np.float64]
C_DECLARATIONS = """
    void scatter_same(double *, const int32_t *, int32_t, int64_t, int64_t, const int32_t *,
        const int32_t *, const double *);
    void scatter_cross(double *, const int32_t *, int32_t, int64_t, int64_t, const int32_t *,
        const int32_t *, const int32_t *, const double *);
"""


class BlockMatrix:
    """A symmetric matrix; the rows and columns of clamped unknowns are those of the identity.

    PETSc shares the array of its values, so assembly copies and sorts nothing. The constructor is
    collective.

    Private fields: `_cells` has the nodes of each cell, `_coupled` those of the two cells of each
    pair, by batch. `_blocks` and `_coupling_blocks` are the numbers of their blocks in `_pattern`.
    `_values` are all values; `_zeros` and `_ones` tell where clamped unknowns have 0 and 1.
    `_fully_clamped` tells which local nodes have no free unknown. `_K` is the matrix of PETSc,
    `_lib` and `_ffi` are the C functions and cffi's interface to them.

    Parameters
    ----------
    V
        Space of the vector field.
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
        """Set up the pattern, the places of element matrices in it, and the matrix. Collective."""
        comm, nodes = V.mesh.comm, V.dofmap.index_map
        source = Path(__file__).with_name("scatter.c")
        self._ffi, self._lib = load_native(source, C_DECLARATIONS, comm)
        # nodes of the cells, and of both cells of each coupled pair
        self._cells = np.ascontiguousarray(V.dofmap.list)
        self._coupled = [(self._cells[rows], self._cells[columns]) for rows, columns in coupled]
        is_clamped = np.zeros((nodes.size_local + nodes.num_ghosts, 3), dtype=bool)
        for bc in clamped:
            is_clamped.ravel()[bc.dof_indices()[0]] = True
        self._fully_clamped = np.array(is_clamped.all(axis=1))
        # the pattern of blocks, and the numbers of the blocks of each cell in it
        self._pattern = pattern = SparsityPattern(nodes, self._free_pairs(), comm)
        self._blocks = pattern.blocks(*_pairs(self._cells, self._cells))
        # for each pair of coupled cells the blocks of its nodes, in both orders of the cells
        self._coupling_blocks = [
            np.stack(
                [pattern.blocks(*_pairs(rows, columns)), pattern.blocks(*_pairs(columns, rows))],
                axis=1,
            )
            for rows, columns in self._coupled
        ]
        # places of values that clamped unknowns fix at 0 and at 1
        self._zeros, self._ones = self._clamped_entries(is_clamped)
        self._values = np.zeros(9 * int(pattern.starts[-1]))
        self._K = self._create_matrix(comm)

    def _create_matrix(self, comm: MPI.Comm) -> PETSc.Mat:
        """Return a matrix of PETSc that shares the array of values. Collective."""
        n = self._pattern.owned
        # the columns of own unknowns: rows of blocks 0 to n
        starts, columns = self._pattern.csr(0, n)
        arrays = [(starts, columns, self._values[: len(columns)])]
        # those of other ranks: rows of blocks n to 2 n
        if comm.size > 1:
            value_start = len(columns)
            starts, columns = self._pattern.csr(n, 2 * n)
            # columns of other ranks' nodes are stored by their position in `others`
            columns -= 3 * n
            global_columns = 3 * self._pattern.others[columns // 3] + columns % 3
            values = self._values[value_start : value_start + len(columns)]
            arrays.append((starts, global_columns.astype(PETSc.IntType), values))
        size = ((3 * n, None), (3 * n, None))
        K = PETSc.Mat().createAIJWithArrays(
            size, arrays[0] if comm.size == 1 else tuple(arrays), comm=comm
        )
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            K.setOption(option, True)
        return K

    def clear(self) -> None:
        """Set all values to zero."""
        self._values[:] = 0

    def add_cells(self, K: Array) -> None:
        """Add the element matrices of all local cells.

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
        batch
            Number of the batch in `coupled`.
        K
            (pairs, 9, functions^2): components (3, 3), row by row, of functions a on the first cell
            and b on the second.
        """
        self._scatter("cross", *self._coupled[batch], self._coupling_blocks[batch], K)

    def assemble(self) -> PETSc.Mat:
        """Return the matrix, summed over the ranks; always the same object. Collective."""
        self._values[self._zeros] = 0
        self._pattern.add_ghosts(self._values)
        self._values[self._ones] = 1
        self._K.stateIncrease()
        return self._K

    def _scatter(self, kind: str, *arrays: NDArray[np.float64] | Ints) -> None:
        """Add element matrices by the C function `scatter_` + kind.

        Parameters
        ----------
        arrays
            Its arrays: nodes of cells, numbers of blocks, and values.
        """

        def pointer(x: NDArray[np.float64] | Ints) -> object:
            """Return the address of an array for C."""
            assert x.flags.c_contiguous
            return self._ffi.from_buffer("double[]" if x.dtype == np.float64 else "int32_t[]", x)

        add = getattr(self._lib, f"scatter_{kind}")
        values, starts = pointer(self._values), pointer(self._pattern.starts)
        entities, functions = arrays[0].shape
        add(values, starts, self._pattern.owned, entities, functions, *map(pointer, arrays))

    def _free_pairs(self) -> Iterator[tuple[Ints, Ints]]:
        """Iterate over the pairs of nodes with a block.

        A fully clamped node has only its diagonal block, which does not occur here.
        """
        for rows, columns in self._coupled_cells():
            i, j = _pairs(rows, columns)
            has_block = ~(self._fully_clamped[i] | self._fully_clamped[j])
            yield i[has_block], j[has_block]

    def _coupled_cells(self) -> Iterable[tuple[Ints, Ints]]:
        """Iterate over the nodes (pairs, functions) of coupled cells, in both orders.

        Every cell is coupled to itself.
        """
        yield self._cells, self._cells
        for rows, columns in self._coupled:
            yield rows, columns
            yield columns, rows

    def _clamped_entries(self, is_clamped: NDArray[np.bool_]) -> tuple[Longs, Longs]:
        """Return where this rank stores entries that clamped unknowns fix at 0 or 1.

        Parameters
        ----------
        is_clamped
            (local nodes, 3).

        Returns
        -------
        Indices of all entries in clamped rows and columns, and of the own diagonal ones of these.
        """
        count, owned = len(is_clamped), self._pattern.owned
        has_clamped, own_nodes = np.array(is_clamped.any(axis=1)), np.arange(owned, dtype=np.int32)
        # pairs i, j of nodes with a clamped unknown, as numbers i * count + j: first the diagonal
        # blocks of own nodes, i = j
        keys = [own_nodes[has_clamped[own_nodes]] * (count + np.int64(1))]
        for i, j in self._free_pairs():
            is_affected = has_clamped[i] | has_clamped[j]
            keys.append(np.unique(i[is_affected] * np.int64(count) + j[is_affected]))
        # each pair of nodes once
        pair_numbers = np.unique(np.concatenate(keys))
        i, j = (x.astype(np.int32) for x in np.divmod(pair_numbers, count))
        # which of the nine values of each block are in a clamped row, or in a clamped column
        entries = self._pattern.entries(i, j)
        in_row, in_column = is_clamped[i][:, :, None], is_clamped[j][:, None, :]
        is_own_diagonal = ((i == j) & (i < owned))[:, None, None] & np.eye(3, dtype=bool)
        return entries[in_row | in_column], entries[in_row & is_own_diagonal]


def _pairs(rows: Ints, columns: Ints) -> tuple[Ints, Ints]:
    """Return all pairs of the nodes of two cells.

    Parameters
    ----------
    rows, columns
        (entities, functions): nodes of the first and of the second cell.

    Returns
    -------
    The first and the second node of each pair, both (entities, functions, functions).
    """
    i, j = np.broadcast_arrays(rows[:, :, None], columns[:, None, :])
    return i, j

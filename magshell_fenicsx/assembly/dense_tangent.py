"""The dense tangent of terms that couple all unknowns, as a correction of the sparse matrix.

The Hessian of such a term has blocks between nodes that are near each other, which are stored, and
all other entries, of which only products with vectors are computed. Stored entries that the sparse
matrix has too are added to it. The remainder is then small compared with it, and a factorisation of
the sparse matrix mostly serves (`continuation.krylov_correction`). The sum is a matrix of PETSc
with all entries, whose factorisation, inertia, limit points and modes are those of any system. Its
memory and the cost of its factorisation grow with the square and the cube of the number of
unknowns. Theory: docs/theory.md, interaction of the magnetisation with its own field.

The matrix is K + D: K sparse, D the correction, a sum of Hessians times factors. Near blocks are
the stored ones, far entries all others; left out are the entries that K has already. A tangent is
inexact, or lagged, if it belongs to an earlier state. Vectors are ordered by nodes, three unknowns
each; every rank has the rows of its own nodes and all columns. Ghosts are local nodes that other
ranks own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from scipy.sparse import bsr_array, csr_array

from magshell_fenicsx.assembly.terms import Term
from magshell_fenicsx.continuation.system import CorrectedTangent, DenseCorrection, Vector
from magshell_fenicsx.platform.native import load_native

Array = NDArray[np.float64]
Indices = NDArray[np.int32]
PRODUCT_COLUMNS = 128  # vectors that are multiplied at once where all entries are needed
C_DECLARATIONS = "\n".join(
    f"void {name}(int64_t, const int32_t *, const int32_t *, const {number} *, const double *,"
    " double *);"
    for name, number in (
        ("multiply_doubles", "double"),
        ("multiply_floats", "float"),
        ("multiply_upper", "float"),
    )
)


class DenseHessian(Protocol):
    """This rank's part of a second derivative, without supports; it does not change.

    Attributes
    ----------
    near_blocks
        (3 local nodes with ghosts, 3 all nodes): the (3, 3) blocks between nodes near each other,
        each row's columns in order.
    """

    @property
    def near_blocks(self) -> bsr_array: ...

    def times_far(self, v: Array) -> Array:
        """Return the product of all entries outside `near_blocks` with vectors. Collective.

        Parameters
        ----------
        v
            (3 all nodes, n), the same on every rank.

        Returns
        -------
        Array
            (3 local nodes with ghosts, n), this rank's part.
        """


@runtime_checkable
class DenseTerm(Term, Protocol):
    """A term whose tangent couples nodes that share no cell and no edge."""

    def hessian(self, *, inexact: bool = False) -> DenseHessian:
        """Return d2Pi/du2; if `inexact`, it may be that of an earlier state. Collective."""

    def add_extrapolated_residual(self, b: Array, factor: float) -> None:
        """Add factor dPi/du to b, extrapolated from forces at earlier states; collective."""

    def extrapolation_holds_along(self, step: Array) -> bool:
        """Return whether extrapolated forces are accurate along a direction. Collective.

        Parameters
        ----------
        step
            A change of all local unknowns, with ghosts.
        """


@dataclass(frozen=True)
class SinglePrecisionBlocks:
    """A sparse matrix of (3, 3) blocks in single precision, for fast products.

    Attributes
    ----------
    starts
        (rows of blocks + 1,): number of the first block of each row.
    columns
        (blocks,): the column of each block, ascending within a row.
    values
        (blocks, 3, 3).
    upper
        Whether the matrix is symmetric and blocks below the diagonal are left out.
    """

    starts: Indices
    columns: Indices
    values: NDArray[np.float32]
    upper: bool

    @classmethod
    def from_blocks(cls, A: bsr_array, *, upper: bool) -> "SinglePrecisionBlocks":
        """Return a copy of a matrix in single precision.

        Parameters
        ----------
        upper
            Whether only the blocks on and above the diagonal are kept; A must be symmetric then.
        """
        if not upper:
            starts = np.asarray(A.indptr, dtype=np.int32)
            columns = np.asarray(A.indices, dtype=np.int32)
            return cls(starts, columns, A.data.astype(np.float32), upper)
        row_of_each_block = np.repeat(np.arange(len(A.indptr) - 1), np.diff(A.indptr))
        is_upper = row_of_each_block <= A.indices
        # the number of upper blocks before each block, and so before the first one of each row
        upper_before = np.append(0, np.cumsum(is_upper, dtype=np.int32))
        starts = upper_before[A.indptr].astype(np.int32)
        columns = A.indices[is_upper].astype(np.int32)
        return cls(starts, columns, A.data[is_upper].astype(np.float32), upper)


class BlockProducts:
    """Products of matrices of (3, 3) blocks with vectors, in C; the constructor is collective.

    The private fields `_lib` and `_ffi` are the compiled library and cffi's interface to it.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        source = Path(__file__).with_name("dense_tangent.c")
        self._ffi, self._lib = load_native(source, C_DECLARATIONS, comm)

    def times(self, A: bsr_array | SinglePrecisionBlocks, v: Array) -> Array:
        """Return A v, both over the unknowns of nodes (3 nodes,).

        The C code for full rows takes v three times; the one for an upper triangle takes it once.
        """
        # `pointer` gives C the address of an array; x is v in the form that the function takes
        pointer, lib = self._ffi.from_buffer, self._lib
        if isinstance(A, SinglePrecisionBlocks):
            starts, columns = A.starts, A.columns
            values = pointer("float[]", A.values)
            multiply = lib.multiply_upper if A.upper else lib.multiply_floats
            x = np.ascontiguousarray(v) if A.upper else _three_times(v)
        else:
            starts = np.asarray(A.indptr, dtype=np.int32)
            columns = np.asarray(A.indices, dtype=np.int32)
            values = pointer("double[]", np.ascontiguousarray(A.data))
            multiply, x = lib.multiply_doubles, _three_times(v)
        row_count = len(starts) - 1
        product = np.empty(3 * row_count)
        multiply(
            row_count,
            pointer("int32_t[]", starts),
            pointer("int32_t[]", columns),
            values,
            pointer("double[]", x),
            pointer("double[]", product),
        )
        return product


def _three_times(v: Array) -> Array:
    """Return (nodes, 9): the three components of each node, three times, for the C code."""
    return np.tile(v.reshape(-1, 3), 3)


@dataclass(frozen=True)
class ScaledHessian:
    """The Hessian of a term times a factor, in the rows of this rank's own unknowns.

    Attributes
    ----------
    near_blocks
        Stored blocks, summed over the ranks.
    single_blocks
        The same in single precision, for products that need not be better.
    hessian
        The Hessian, for its products with entries that are not stored.
    left_out
        Entries that are not counted, since the sparse matrix has them; None: all count.
    """

    factor: float
    near_blocks: bsr_array
    single_blocks: SinglePrecisionBlocks
    hessian: DenseHessian
    left_out: csr_array | None = None


@dataclass(frozen=True)
class DenseRemainder:
    """Scaled Hessians without the rows and columns of supports.

    It is a `continuation.system.DenseCorrection`.

    Attributes
    ----------
    matrix
        The object that multiplies and sums Hessians.
    parts
        The Hessians, whose sum this is.
    """

    matrix: "DenseTangent"
    parts: Sequence[ScaledHessian]

    def times(self, v: Vector) -> Vector:
        """Return the product with a vector. Collective."""
        # which of the own unknowns, and which of all, are clamped
        own_fixed, all_fixed = self.matrix.fixed
        all_entries = np.concatenate(self.matrix.comm.allgather(v))
        x = np.where(all_fixed, 0.0, all_entries)
        return np.where(own_fixed, 0.0, self.matrix.product(self.parts, x, single=True))

    def scaled(self, factor: float) -> "DenseRemainder":
        """Return the correction times a factor."""
        parts = [replace(part, factor=factor * part.factor) for part in self.parts]
        return DenseRemainder(self.matrix, parts)

    def multiple_of(self, other: DenseCorrection) -> float:
        """Return c if this correction is c times another one; 0 if it is no known multiple."""
        if not isinstance(other, DenseRemainder) or len(other.parts) != len(self.parts):
            return 0.0
        pairs = list(zip(self.parts, other.parts, strict=True))
        # the ratio of each part to that of the other correction: all must be equal
        factors = {own_part.factor / other_part.factor for own_part, other_part in pairs}
        same_hessians = all(
            own_part.hessian is other_part.hessian for own_part, other_part in pairs
        )
        return factors.pop() if len(factors) == 1 and same_hessians else 0.0

    def added_to(self, K: PETSc.Mat) -> PETSc.Mat:
        """Return K plus this correction, with all entries; reused by the next call. Collective."""
        return self.matrix.sum(K, self.parts)


class DenseTangent:
    """A symmetric matrix with all entries, always the same object.

    Clamped unknowns are treated as in `scatter.BlockMatrix`. The constructor is collective.

    Private fields: `_owned` and `_ghosts` count own nodes and ghosts of this rank, `_count` all
    nodes; `_first` is the global number of the first own node. `_ghost_numbers` are the global
    numbers of the ghosts, `_ghost_owners` their ranks. `_products` multiplies blocks with vectors.
    `_dense` has the entries in own columns, those in other columns, and the matrix of PETSc with
    both. `_blocks_of_terms` has for each term its latest Hessian, with its near blocks in double
    and single precision. `_latest_common` has near blocks, and their entries in the latest pattern.
    `_shared_arrays` keeps the arrays of `_dense` alive.

    Parameters
    ----------
    V
        Space of the displacement.
    clamped
        Homogeneous Dirichlet conditions.

    Attributes
    ----------
    fixed
        Whether unknowns are clamped: an array of the own ones, and one of all.
    """

    def __init__(self, V: fem.FunctionSpace, clamped: Sequence[fem.DirichletBC]) -> None:
        """Gather which unknowns are clamped, and the owners of ghosts. Collective."""
        comm, nodes = V.mesh.comm, V.dofmap.index_map
        self._owned, self._ghosts = nodes.size_local, nodes.num_ghosts
        self._first, self._count = nodes.local_range[0], nodes.size_global
        self._ghost_numbers = nodes.local_to_global(
            np.arange(self._owned, self._owned + self._ghosts, dtype=np.int32)
        )
        self._ghost_owners = nodes.owners
        n = 3 * self._owned
        is_clamped = np.zeros(n, dtype=bool)
        for bc in clamped:
            dofs = bc.dof_indices()[0]
            is_clamped[dofs[dofs < n]] = True
        self._products = BlockProducts(comm)
        self.comm = comm
        self.fixed = is_clamped, np.concatenate(comm.allgather(is_clamped))
        self._dense: tuple[Array, Array, PETSc.Mat] | None = None
        self._blocks_of_terms: dict[str, tuple[DenseHessian, bsr_array, SinglePrecisionBlocks]] = {}
        self._latest_common: tuple[bsr_array, csr_array] | None = None

    def _create_dense(self) -> tuple[Array, Array, PETSc.Mat]:
        """Create a matrix of PETSc with all entries. Collective.

        Returns
        -------
        The entries in columns of own unknowns, those in columns of others, and the matrix, which
        shares the memory of both arrays.
        """
        n, first_column, column_count = 3 * self._owned, 3 * self._first, 3 * self._count
        kind = PETSc.IntType
        # PETSc stores a matrix as two, that of own columns and that of all others. Each has three
        # arrays: starts of rows, columns and values
        inner, outer = np.zeros((n, n)), np.zeros((n, column_count - n))
        inner_columns = np.arange(n, dtype=kind)
        arrays = [(_row_starts(n, n), np.tile(inner_columns, n), inner.reshape(-1))]
        if self.comm.size > 1:
            outer_columns = np.delete(
                np.arange(column_count, dtype=kind), np.s_[first_column : first_column + n]
            )
            outer_starts = _row_starts(n, column_count - n)
            arrays.append((outer_starts, np.tile(outer_columns, n), outer.reshape(-1)))
        size = ((n, None), (n, None))
        K = PETSc.Mat().createAIJWithArrays(
            size, arrays[0] if len(arrays) == 1 else tuple(arrays), comm=self.comm
        )
        self._shared_arrays = arrays  # PETSc does not keep them alive
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            K.setOption(option, True)
        return inner, outer, K

    def corrected(
        self, K: PETSc.Mat, terms: Sequence[tuple[float, DenseTerm]], *, inexact: bool = False
    ) -> CorrectedTangent:
        """Return a sparse matrix with the tangents of terms, as K + D. Collective.

        Entries that K has are added to it. All other entries of the terms make up D.

        Parameters
        ----------
        K
            The sparse matrix, which is changed.
        terms
            Pairs of a factor and its term.
        inexact
            Whether the tangents may belong to an earlier state.

        Returns
        -------
        K with the correction D; its lagged part is the whole tangent of the terms.
        """
        starts, columns, values = K.getValuesCSR()
        scaled = [self.scaled_hessian(factor, term, inexact=inexact) for factor, term in terms]
        # of each term K takes the entries in its pattern; the remainder leaves them out
        remainders = list[ScaledHessian]()
        for part in scaled:
            common = self._common_entries(starts, columns, part)
            values += part.factor * common.data
            remainders.append(replace(part, left_out=common))
        K.setValuesCSR(starts, columns, values)
        K.assemble()
        return CorrectedTangent(K, DenseRemainder(self, remainders), DenseRemainder(self, scaled))

    def _common_entries(
        self, starts: NDArray[np.intp], columns: NDArray[np.intp], part: ScaledHessian
    ) -> csr_array:
        """Return a term's entries, without its factor, in the pattern of a sparse matrix.

        They are computed once for each pattern, and are zero at supports.

        Parameters
        ----------
        starts, columns
            The pattern in compressed sparse rows, of own unknowns.
        part
            The Hessian of the term; its factor is not used.
        """
        # the latest ones serve for the same blocks and the same pattern, which contact changes
        if self._latest_common is not None:
            latest_blocks, common = self._latest_common
            if latest_blocks is part.near_blocks and _has_pattern(common, starts, columns):
                return common
        rows = np.repeat(np.arange(len(starts) - 1), np.diff(starts))  # of each entry
        own_fixed, all_fixed = self.fixed
        free = ~(own_fixed[rows] | all_fixed[columns])
        values = np.where(free, _entries(part.near_blocks, rows, columns), 0.0)
        common = csr_array((values, columns, starts), part.near_blocks.shape)
        self._latest_common = part.near_blocks, common
        return common

    def sum(self, K: PETSc.Mat, parts: Sequence[ScaledHessian]) -> PETSc.Mat:
        """Return a sparse matrix K plus scaled Hessians (`parts`), with all entries. Collective.

        The next call overwrites the result.
        """
        n, first_column, (own_fixed, all_fixed) = 3 * self._owned, 3 * self._first, self.fixed
        # arrays of the entries in own and in other columns, and the matrix of PETSc with both
        self._dense = inner, outer, matrix = self._dense or self._create_dense()
        # On one rank the rows are the matrix's own memory.
        rows = inner if self.comm.size == 1 else np.empty((n, 3 * self._count))
        rows[:] = 0.0
        for part in parts:
            rows += part.factor * self._all_rows(part)
        rows[own_fixed], rows[:, all_fixed] = 0.0, 0.0
        # the sparse matrix is added last: at supports it has the identity
        starts, columns, values = K.getValuesCSR()
        row_of_each_entry = np.repeat(np.arange(n), np.diff(starts))
        rows[row_of_each_entry, columns] += values
        # on several ranks the rows are copied into both parts of the matrix of PETSc
        if self.comm.size > 1:
            inner[:] = rows[:, first_column : first_column + n]
            outer[:] = np.delete(rows, np.s_[first_column : first_column + n], axis=1)
        matrix.stateIncrease()
        return matrix

    def scaled_hessian(
        self, factor: float, term: DenseTerm, *, inexact: bool = False
    ) -> ScaledHessian:
        """Return the Hessian of a term times a factor. Collective.

        Its stored blocks are summed over the ranks, once for each Hessian.

        Parameters
        ----------
        inexact
            Whether it may be the Hessian of an earlier state.
        """
        hessian = term.hessian(inexact=inexact)
        # (Hessian, its near blocks in double and in single precision), for the same Hessian
        blocks = self._blocks_of_terms.get(term.name)
        if blocks is None or blocks[0] is not hessian:
            near_blocks = self._sum_blocks(hessian.near_blocks)
            # on one rank the matrix is square and symmetric
            single = SinglePrecisionBlocks.from_blocks(near_blocks, upper=self.comm.size == 1)
            blocks = self._blocks_of_terms[term.name] = hessian, near_blocks, single
        _, near_blocks, single = blocks
        return ScaledHessian(factor, near_blocks, single, hessian)

    def rows(self, term: DenseTerm) -> Array:
        """Return the rows (own unknowns, all) of a term's Hessian, without constraints. Collective.

        Rows and columns of clamped unknowns are not made zero.
        """
        return self._all_rows(self.scaled_hessian(1.0, term))

    def product(self, parts: Sequence[ScaledHessian], x: Array, *, single: bool = False) -> Array:
        """Return the sum of scaled Hessians times a vector, without constraints. Collective.

        Parameters
        ----------
        parts
            The scaled Hessians.
        x
            (3 all nodes,): the vector, the same on every rank.
        single
            Whether stored blocks are taken in single precision.

        Returns
        -------
        Array
            (3 own nodes,).
        """
        product = np.zeros(3 * self._owned)
        for part in parts:
            # this rank's part at local nodes, then the stored blocks at own nodes
            far = part.hessian.times_far(x[:, None]).reshape(-1, 3)
            near = self._products.times(part.single_blocks if single else part.near_blocks, x)
            product += part.factor * (near + self._sum_rows(far).ravel())
            if part.left_out is not None:
                product -= part.factor * (part.left_out @ x)
        return product

    def times(self, terms: Sequence[tuple[float, DenseTerm]], v: Array) -> Array:
        """Return the tangents of terms times a vector v, both with ghosts. Collective.

        Ghosts are zero in the product.

        Parameters
        ----------
        terms
            Pairs of a factor and its term.
        """
        n = 3 * self._owned
        x, product = np.concatenate(self.comm.allgather(v[:n])), np.zeros_like(v)
        hessians = [self.scaled_hessian(factor, term) for factor, term in terms]
        product[:n] = self.product(hessians, x)
        return product

    def _all_rows(self, part: ScaledHessian) -> Array:
        """Return all entries of own rows of a Hessian, without its factor. Collective.

        Products with unit vectors give the entries that are not stored. Entries that the Hessian
        `part` leaves out are zero.
        """
        left_out = 0.0 if part.left_out is None else part.left_out.toarray()
        rows = part.near_blocks.toarray() - left_out
        for first_column in range(0, 3 * self._count, PRODUCT_COLUMNS):
            count = min(PRODUCT_COLUMNS, 3 * self._count - first_column)
            # the unit vectors of `count` columns from the first one on
            unit_vectors = np.eye(3 * self._count, count, -first_column)
            far = part.hessian.times_far(unit_vectors).reshape(-1, 3, count)
            far_columns = self._sum_rows(far).reshape(len(rows), -1)
            rows[:, first_column : first_column + PRODUCT_COLUMNS] += far_columns
        return np.asarray(rows)

    def _sum_rows(self, rows: Array) -> Array:
        """Return the sum over ranks of the rows of own nodes. Collective.

        Parameters
        ----------
        rows
            (local nodes, ...): this rank's parts, those of ghosts after own ones.
        """
        if self.comm.size == 1:
            return rows
        own_rows, ghost_rows = rows[: self._owned].copy(), rows[self._owned :]
        # each rank gets the global numbers and the rows of those ghosts that it owns
        sent = [(self._ghost_numbers[i], ghost_rows[i]) for i in self._ghosts_of_ranks]
        for numbers, received_rows in self.comm.alltoall(sent):
            np.add.at(own_rows, numbers - self._first, received_rows)
        return own_rows

    def _sum_blocks(self, rows: bsr_array) -> bsr_array:
        """Return the sum over ranks of the rows of own unknowns. Collective.

        Parameters
        ----------
        rows
            (3 local nodes, 3 all nodes): this rank's part, rows of ghosts after own ones.
        """
        if self.comm.size == 1:
            return rows
        n = 3 * self._owned
        own_rows, ghost_entries = rows.tocsr()[:n], rows.tocsr()[n:].tocoo()
        # the ghost, counted from the first one, and the component of each entry's row
        nodes, components = ghost_entries.row // 3, ghost_entries.row % 3
        # each rank gets the entries (global row, column, value) in rows of its own nodes
        sent = list[tuple[NDArray[np.generic], ...]]()
        for ghosts_of_rank in self._ghosts_of_ranks:
            mask = np.isin(nodes, ghosts_of_rank)
            global_rows = 3 * self._ghost_numbers[nodes[mask]] + components[mask]
            sent.append((global_rows, ghost_entries.col[mask], ghost_entries.data[mask]))
        for global_rows, columns, values in self.comm.alltoall(sent):
            positions = global_rows - 3 * self._first, columns
            own_rows = own_rows + csr_array((values, positions), own_rows.shape)
        blocks = own_rows.tobsr((3, 3))
        blocks.sort_indices()
        return blocks

    @cached_property
    def _ghosts_of_ranks(self) -> list[NDArray[np.intp]]:
        """For each rank the ghosts that it owns, counted from the first ghost."""
        return [np.flatnonzero(self._ghost_owners == rank) for rank in range(self.comm.size)]


def _row_starts(rows: int, width: int) -> NDArray[np.generic]:
    """Return the starts (rows + 1,) of rows with `width` entries each; both may be zero."""
    if width == 0:
        return np.zeros(rows + 1, dtype=PETSc.IntType)
    return np.arange(0, rows * width + 1, width, dtype=PETSc.IntType)


def _has_pattern(matrix: csr_array, starts: NDArray[np.intp], columns: NDArray[np.intp]) -> bool:
    """Return whether a matrix has a pattern of compressed sparse rows."""
    return np.array_equal(matrix.indices, columns) and np.array_equal(matrix.indptr, starts)


def _entries(blocks: bsr_array, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Array:
    """Return entries of a matrix of (3, 3) blocks; zero where there is no block.

    Parameters
    ----------
    blocks
        The matrix, each row's columns in order.
    rows, columns
        (n,) places of the entries.
    """
    # a block has the key row * width + column, by blocks; the keys ascend
    width, count = blocks.shape[1] // 3, len(blocks.indptr) - 1
    block_rows = np.repeat(np.arange(count, dtype=np.int64), np.diff(blocks.indptr))
    block_keys = block_rows * width + blocks.indices
    entry_keys = rows.astype(np.int64) // 3 * width + columns // 3
    if not len(block_keys):
        return np.zeros(len(entry_keys))
    # the block of each entry by a search for its key; another key is found if there is no block
    positions = np.minimum(np.searchsorted(block_keys, entry_keys), len(block_keys) - 1)
    values = blocks.data[positions, rows % 3, columns % 3]
    return np.where(block_keys[positions] == entry_keys, values, 0.0)

"""Terms whose tangent has entries outside the sparsity pattern of cells and interior edges.

The entries of contact couple some further unknowns, and change from state to state. The sum with
the sparse matrix has a pattern of its own, with room for entries that are expected soon. This
pattern and the symbolic factorisation are reused until an entry falls outside. Where a term couples
all unknowns, its tangent is dense (`assembly.dense_tangent.DenseTangent`). Theory: docs/theory.md,
contact between shells, and parts that act on each other.

An entry of a matrix is a global row, a global column and a value; unknowns are numbered by nodes,
three each. Room is the pattern of entries that may come. Each rank has the rows of its own
unknowns; fixed unknowns are clamped. The factor of a term is the value of its amplitude (load
parameter).
"""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from scipy.sparse import coo_array, csr_array, kron

from magshell_fenicsx.assembly.dense_tangent import DenseTangent, DenseTerm
from magshell_fenicsx.assembly.terms import Term

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
Entries: TypeAlias = tuple[Longs, Longs, Array]  # global rows and columns, and values
Factors: TypeAlias = Mapping[str, float]  # of terms, by name


class AddedTangent(Protocol):
    """The tangents of some terms, times factors: a matrix that is added to the sparse tangent."""

    def sum(self, K: PETSc.Mat, factors: Factors) -> PETSc.Mat:
        """Return a matrix plus the tangents of the terms. Collective.

        Parameters
        ----------
        factors
            Term name -> factor of its tangent.
        """

    def times(self, v: Array, factors: Factors) -> Array:
        """Return this rank's part of the tangents' product with v, both with ghosts. Collective.

        Parameters
        ----------
        factors
            Term name -> factor of its tangent.
        """


@runtime_checkable
class FieldDifferentiable(Protocol):
    """A term without a form that has derivatives by the fields in it."""

    @property
    def amplitude(self) -> str | None: ...

    def by_field(
        self, name: str, direction: fem.Function, energy: float, force: float
    ) -> tuple[fem.Function, Array] | None:
        """Return derivatives by the values of a field in the term. Collective.

        Parameters
        ----------
        name
            Name of the field.
        direction
            The direction v of the force.
        energy, force
            Factors in the number energy Pi + force v . dPi/du that is differentiated.

        Returns
        -------
        The field, and the derivatives by its values in own cells; None if the term has no field of
        that name.
        """


def added_tangents(
    V: fem.FunctionSpace, terms: Sequence[Term], clamped: Sequence[fem.DirichletBC]
) -> list[AddedTangent]:
    """Return the added tangents of the nonlocal and the dense terms in a list. Collective.

    The dense ones come last, as their sum has all entries.

    Parameters
    ----------
    V
        Space of the displacement.
    clamped
        Homogeneous Dirichlet conditions.
    """
    tangents = list[AddedTangent]()
    if nonlocal_terms := [t for t in terms if isinstance(t, NonlocalTerm)]:
        tangents.append(NonlocalEntries(V, nonlocal_terms, clamped))
    if dense_terms := [t for t in terms if isinstance(t, DenseTerm)]:
        tangents.append(DenseTangent(V, dense_terms, clamped))
    return tangents


@runtime_checkable
class NonlocalTerm(Protocol):
    """A term whose tangent has entries outside the sparsity pattern of the others."""

    name: str

    def entries(self) -> Entries:
        """Return this rank's part of d2Pi/du2: global rows and columns, and values. Collective.

        Entries come in any order; those at the same place are summed.
        """

    def coupled_pairs(self) -> tuple[Longs, Longs]:
        """Return pairs of global nodes between which this rank may have entries. Collective.

        They are a function of `pattern_key`, and of nothing that was evaluated before: a resumed
        run has the same pattern.
        """

    @property
    def pattern_key(self) -> float:
        """A number of the present state that changes where `coupled_pairs` does."""


class NonlocalEntries:
    """Sum of the sparse tangent and of nonlocal terms, whose entries change from state to state.

    It is an `AddedTangent`. The constructor is collective.

    Private fields: `_ranges` has the first unknown of each rank and the number of all, `_own` is
    the slice of own unknowns, `_fixed` tells of all unknowns whether they are clamped.
    `_block_size` is the number of unknowns of a node. `_sum` is the latest sum with room for
    expected entries; these were expected at the pattern keys `_pattern_keys` of the terms.

    Parameters
    ----------
    V
        Space of the displacement.
    clamped
        Homogeneous Dirichlet conditions.
    """

    def __init__(
        self,
        V: fem.FunctionSpace,
        terms: Sequence[NonlocalTerm],
        clamped: Sequence[fem.DirichletBC],
    ) -> None:
        """Gather the ranges of all ranks' unknowns, and which of them are clamped. Collective."""
        self._terms, self._comm = terms, V.mesh.comm
        sizes = self._comm.allgather(V.dofmap.index_map.size_local)
        self._block_size = V.dofmap.index_map_bs
        self._ranges = self._block_size * np.array([0, *np.cumsum(sizes)])
        self._own = slice(*self._ranges[self._comm.rank : self._comm.rank + 2])
        is_clamped = np.zeros(self._own.stop - self._own.start, dtype=bool)
        for bc in clamped:
            dofs = bc.dof_indices()[0]
            is_clamped[dofs[dofs < len(is_clamped)]] = True
        self._fixed = np.concatenate(self._comm.allgather(is_clamped))
        self._sum: _MatrixSum | None = None
        self._pattern_keys: tuple[tuple[str, float], ...] = ()

    def sum(self, K: PETSc.Mat, factors: Factors) -> PETSc.Mat:
        """Return a sparse matrix plus the tangents of the nonlocal terms. Collective.

        The result is K itself if there are no entries. Else it is mostly the same object, with a
        pattern that has room for the expected entries.

        Parameters
        ----------
        factors
            Term name -> factor of its tangent.
        """
        weighted_entries = self._entries(factors)
        if not weighted_entries:
            return K
        all_entries = _weighted_sum(weighted_entries)
        # the entries in own rows, (own unknowns, all), without those of clamped unknowns
        added = _owned_rows(self._comm, self._ranges, self._fixed, all_entries)
        if not self._comm.allreduce(added.nnz):
            return K
        matrix_sum = self._sum_with_room(K, factors)
        if self._comm.allreduce(matrix_sum.has_room_for(added), MPI.MIN):
            return matrix_sum.update(added)
        # an unexpected entry: a matrix for this state alone
        return _MatrixSum(K, _pattern_of(added), self._own.start).update(added)

    def _sum_with_room(self, K: PETSc.Mat, factors: Factors) -> "_MatrixSum":
        """Return the sum of K with room for all expected entries. Collective.

        It is made anew where the terms expect other entries, or K is another object. Terms whose
        factor in `factors` is zero do not count.
        """
        keys = tuple((t.name, t.pattern_key) for t in self._terms if factors.get(t.name, 0.0))
        matrix_sum = self._sum if self._pattern_keys == keys else None
        if matrix_sum is None or matrix_sum.sparse.handle != K.handle:
            matrix_sum = _MatrixSum(K, self._expected_pattern(factors), self._own.start)
            self._sum, self._pattern_keys = matrix_sum, keys
        return matrix_sum

    def times(self, v: Array, factors: Factors) -> Array:
        """Return this rank's part of the tangents' product with v, both with ghosts. Collective.

        `factors` maps the name of a term to the factor of its tangent. Ghosts are zero in the
        product.
        """
        product, size = np.zeros_like(v), self._own.stop - self._own.start
        if entries := self._entries(factors):
            # the product of this rank's entries, with rows of all unknowns
            local = times(entries, np.concatenate(self._comm.allgather(v[:size])))
            product[:size] = self._comm.allreduce(local)[self._own]
        return product

    def _entries(self, factors: Factors) -> list[tuple[float, Entries]]:
        """Return pairs of a factor and its term's entries, without those whose factor is zero."""
        return [(factor, t.entries()) for t in self._terms if (factor := factors.get(t.name, 0.0))]

    def _expected_pattern(self, factors: Factors) -> csr_array:
        """Return the pattern (own unknowns, all) of expected entries of the terms. Collective.

        Terms whose factor in `factors` is zero do not count.
        """
        pairs = [t.coupled_pairs() for t in self._terms if factors.get(t.name, 0.0)]
        rows, columns = (np.concatenate(nodes) for nodes in zip(*pairs, strict=True))
        # the pattern (own nodes, all nodes), where several terms may have the same pair
        size = self._block_size
        flags, no_node = np.ones(len(rows), np.bool_), np.zeros(len(self._fixed) // size, np.bool_)
        nodes = _owned_rows(self._comm, self._ranges // size, no_node, (rows, columns, flags))
        # all components of the first node with all of the second, but for clamped unknowns
        pattern = kron(nodes, np.ones((size, size), np.bool_), format="bsr").tocsr()
        clamped_rows = np.repeat(self._fixed[self._own], np.diff(pattern.indptr))
        pattern.data = ~(clamped_rows | self._fixed[pattern.indices])
        pattern.eliminate_zeros()
        pattern.sort_indices()
        return _pattern_of(pattern)


class _MatrixSum:
    """A sparse matrix plus changing entries, in a fixed pattern; the constructor is collective.

    The fixed pattern is the union of the sparse matrix's pattern and of the room; `_values` are its
    values, row by row. `_at_sparse` and `_at_room` are the places of both patterns' entries in
    them. `_room_keys` has the number row * width + column for each entry of the room, ascending.
    `_is_own` tells which values are in columns of own unknowns. `_matrix` is the matrix of PETSc,
    which shares the memory of `_arrays`: starts, columns and values of its one or two parts.

    Parameters
    ----------
    sparse
        The sparse matrix, which is always the same object.
    room
        (own unknowns, all): ones where entries can be.
    first
        Global number of the first own unknown.
    """

    def __init__(self, sparse: PETSc.Mat, room: csr_array, first: int) -> None:
        """Create the matrix of PETSc with the union of both patterns. Collective."""
        self.sparse, self.room = sparse, room
        starts, columns, _ = sparse.getValuesCSR()
        ones = np.ones(len(columns), dtype=np.int8)
        # Bit 1 marks the entries of the sparse matrix, bit 2 those of the room.
        union = csr_array((ones, columns, starts), room.shape) + 2 * room
        self._at_sparse, self._at_room = (np.flatnonzero(union.data & bit) for bit in (1, 2))
        self._room_keys = _entry_keys(room)
        # PETSc stores columns of own unknowns apart from the others
        self._is_own = (union.indices >= first) & (union.indices < first + room.shape[0])
        self._values = np.zeros(union.nnz)
        kind = PETSc.IntType
        # PETSc shares these arrays.
        self._arrays = [(union.indptr.astype(kind), union.indices.astype(kind), self._values)]
        if sparse.comm.size > 1:
            self._arrays = [
                _selected_columns(union, self._is_own, first),
                _selected_columns(union, ~self._is_own, 0),
            ]
        self._matrix = PETSc.Mat().createAIJWithArrays(
            sparse.getSizes(),
            self._arrays[0] if len(self._arrays) == 1 else tuple(self._arrays),
            comm=sparse.comm,
        )
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            self._matrix.setOption(option, True)

    def has_room_for(self, added: csr_array) -> bool:
        """Return whether the pattern contains the entries of this rank.

        Parameters
        ----------
        added
            (own unknowns, all): the entries.
        """
        keys = _entry_keys(added)
        # a key that is missing would be inserted before another one, or at the end
        positions = np.searchsorted(self._room_keys, keys)
        if positions.max(initial=0) >= len(self._room_keys):
            return False
        return bool((self._room_keys[positions] == keys).all())

    def update(self, added: csr_array) -> PETSc.Mat:
        """Return the sum of the present sparse matrix and of entries within the room.

        `added` (own unknowns, all) has the entries. The result is always the same object.
        """
        # into the union of both patterns; PETSc sees the same memory on one rank
        self._values[:] = 0.0
        _, _, sparse_values = self.sparse.getValuesCSR()
        self._values[self._at_sparse] = sparse_values
        # the place of each entry in the room, then in the union
        positions = np.searchsorted(self._room_keys, _entry_keys(added))
        self._values[self._at_room[positions]] += added.data
        # on several ranks the values are copied into the two parts of PETSc
        if self.sparse.comm.size > 1:
            masks = self._is_own, ~self._is_own
            for (_, _, values), mask in zip(self._arrays, masks, strict=True):
                values[:] = self._values[mask]
        self._matrix.stateIncrease()
        return self._matrix


def with_entries(K: PETSc.Mat, entries: Entries, fixed: NDArray[np.bool_]) -> PETSc.Mat:
    """Return a new matrix: K with further entries, except those of fixed unknowns. Collective.

    It is K itself if no rank has entries.

    Parameters
    ----------
    entries
        Global rows and columns, and values; entries at one place are summed.
    fixed
        (all unknowns,): whether each is fixed.
    """
    ranges = np.asarray(K.getOwnershipRanges())
    added = _owned_rows(K.comm.tompi4py(), ranges, fixed, entries)
    if not K.comm.tompi4py().allreduce(added.nnz):
        return K
    return _MatrixSum(K, _pattern_of(added), int(ranges[K.comm.rank])).update(added)


def _owned_rows(
    comm: MPI.Comm, ranges: Longs, fixed: NDArray[np.bool_], entries: tuple[Longs, Longs, Any]
) -> csr_array:
    """Send entries to the ranks that own their rows, and sum them there. Collective.

    Parameters
    ----------
    ranges
        (ranks + 1,): the first unknown of each rank, and the number of all.
    fixed
        (all unknowns,): whether each is fixed; its entries are left out.
    entries
        Global rows and columns, and values.

    Returns
    -------
    (own unknowns, all) the matrix of the entries in own rows.
    """
    rows, columns, values = entries
    free = ~(fixed[rows] | fixed[columns])
    selected = rows[free], columns[free], values[free]
    if comm.size > 1:
        # the last rank whose first unknown is not beyond the row
        owner = np.searchsorted(ranges, selected[0], side="right") - 1
        sent = list[tuple[Any, ...]]()
        for rank in range(comm.size):
            is_of_rank = owner == rank
            sent.append(tuple(array[is_of_rank] for array in selected))
        received = comm.alltoall(sent)
        selected = tuple(np.concatenate(arrays) for arrays in zip(*received, strict=True))
    own_rows, own_columns, own_values = selected
    first_row, end_row = ranges[comm.rank : comm.rank + 2]
    shape = end_row - first_row, len(fixed)
    return coo_array((own_values, (own_rows - first_row, own_columns)), shape).tocsr()


def _weighted_sum(weighted_entries: list[tuple[float, Entries]]) -> Entries:
    """Return the entries of all terms in one list, with the values times the terms' factors.

    Parameters
    ----------
    weighted_entries
        Pairs of a factor and a term's entries.
    """
    rows = np.concatenate([rows for _, (rows, _, _) in weighted_entries])
    columns = np.concatenate([columns for _, (_, columns, _) in weighted_entries])
    values = np.concatenate([factor * values for factor, (_, _, values) in weighted_entries])
    return rows, columns, values


def times(entries: list[tuple[float, Entries]], v: Array) -> Array:
    """Return this rank's part of the product of entries with a vector of all unknowns.

    Parameters
    ----------
    entries
        Pairs of a factor and entries: global rows and columns, and values.

    Returns
    -------
    Array
        As long as v.
    """
    product = np.zeros_like(v)
    for factor, (rows, columns, values) in entries:
        product += np.bincount(rows, factor * values * v[columns], len(v))
    return product


def pairs_of(nodes: Longs) -> tuple[Longs, Longs]:
    """Return all ordered pairs of nodes that share a row of an array (n, k), each pair once.

    Cells in contact share many nodes: there are far fewer such pairs than n k^2. A product of
    sparse flags finds them without a list of all.

    Returns
    -------
    The first and the second node of each pair, both (pairs,).
    """
    rows = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    flags, shape = np.ones(nodes.size, dtype=np.bool_), (len(nodes), nodes.max(initial=-1) + 1)
    has_node = coo_array((flags, (rows, nodes.ravel())), shape).tocsr()
    i, j = (has_node.T @ has_node).nonzero()
    return i.astype(np.int64), j.astype(np.int64)


def _pattern_of(matrix: csr_array) -> csr_array:
    """Return a matrix of the same pattern, with ones in place of all entries."""
    ones = np.ones(matrix.nnz, dtype=np.int8)
    return csr_array((ones, matrix.indices, matrix.indptr), matrix.shape)


def _entry_keys(matrix: csr_array) -> Longs:
    """Return a number row * width + column for the place of each entry, ascending."""
    rows = np.repeat(np.arange(matrix.shape[0], dtype=np.int64), np.diff(matrix.indptr))
    return np.asarray(rows * matrix.shape[1] + matrix.indices)


def _selected_columns(
    matrix: csr_array, mask: NDArray[np.bool_], first: int
) -> tuple[Any, Any, Array]:
    """Return the arrays of a matrix of PETSc with some entries of a matrix.

    Parameters
    ----------
    mask
        (entries,): which entries are selected.
    first
        Number from which columns are counted.

    Returns
    -------
    Starts of the rows, columns, and zeros as values.
    """
    # the number of selected entries before each entry: at the start of a row it is the new start
    selected_before = np.concatenate([[0], np.cumsum(mask)])
    starts = selected_before[matrix.indptr]
    columns = matrix.indices[mask] - first
    return starts.astype(PETSc.IntType), columns.astype(PETSc.IntType), np.zeros(len(columns))

"""Tangents of terms that couple all unknowns: they are added to the sparse one, with all entries.

Memory grows with the square of the number of unknowns, the cost of the factors with its cube. The
sum is a matrix of PETSc, whose factorisation, inertia, limit points and modes are those of any
system.

Vectors are ordered by nodes, three unknowns each; every rank has the rows of its own nodes and all
columns. Ghosts are local nodes that other ranks own.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.terms import Term

Array = NDArray[np.float64]


@runtime_checkable
class DenseTerm(Term, Protocol):
    """A term whose tangent couples all unknowns."""

    def add_hessian(self, rows: Array, factor: float) -> None:
        """Add factor d2Pi/du2, this rank's part and without supports, to a matrix. Collective.

        Parameters
        ----------
        rows
            (3 local nodes, 3 all nodes), rows of ghosts after own ones.
        """


class DenseTangent:
    """Sum of the sparse tangent and of terms that couple all unknowns, always the same object.

    It is a `nonlocal_terms.AddedTangent`. Clamped unknowns are treated as in
    `scatter.BlockMatrix`. The constructor is collective.

    Private fields: `_owned` and `_ghosts` count own nodes and ghosts of this rank, `_count` all
    nodes; `_first` is the global number of the first own node. `_ghost_numbers` are the global
    numbers of the ghosts, `_ghost_owners` their ranks. `_fixed` tells of the own unknowns, and of
    all, whether they are clamped. `_sum` has the entries in own columns, those in other columns,
    and the matrix of PETSc with both; None before the first sum. `_shared_arrays` keeps the arrays
    of that matrix alive.

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
        terms: Sequence[DenseTerm],
        clamped: Sequence[fem.DirichletBC],
    ) -> None:
        """Gather which unknowns are clamped, and the owners of ghosts. Collective."""
        self._terms, self._comm, nodes = terms, V.mesh.comm, V.dofmap.index_map
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
        self._fixed = is_clamped, np.concatenate(self._comm.allgather(is_clamped))
        self._sum: tuple[Array, Array, PETSc.Mat] | None = None

    def sum(self, K: PETSc.Mat, factors: Mapping[str, float]) -> PETSc.Mat:
        """Return a sparse matrix plus the tangents of the terms, with all entries. Collective.

        The result is K itself if all factors are zero. Else the next call overwrites it.

        Parameters
        ----------
        factors
            Term name -> factor of its tangent.
        """
        if not any(factors.get(t.name, 0.0) for t in self._terms):
            return K
        n, first_column, (own_fixed, all_fixed) = 3 * self._owned, 3 * self._first, self._fixed
        # arrays of the entries in own and in other columns, and the matrix of PETSc with both
        self._sum = inner, outer, matrix = self._sum or self._create_sum()
        # on one rank the rows are the matrix's own memory
        rows = self.rows(factors, inner if self._comm.size == 1 else None)
        rows[own_fixed], rows[:, all_fixed] = 0.0, 0.0
        # the sparse matrix is added last: at supports it has the identity
        starts, columns, values = K.getValuesCSR()
        row_of_each_entry = np.repeat(np.arange(n), np.diff(starts))
        rows[row_of_each_entry, columns] += values
        # on several ranks the rows are copied into both parts of the matrix of PETSc
        if self._comm.size > 1:
            own_columns = np.s_[first_column : first_column + n]
            inner[:], outer[:] = rows[:, own_columns], np.delete(rows, own_columns, axis=1)
        matrix.stateIncrease()
        return matrix

    def times(self, v: Array, factors: Mapping[str, float]) -> Array:
        """Return this rank's part of the tangents' product with v, both with ghosts. Collective.

        Ghosts are zero in the product.

        Parameters
        ----------
        factors
            Term name -> factor of its tangent.
        """
        n = 3 * self._owned
        all_entries, product = np.concatenate(self._comm.allgather(v[:n])), np.zeros_like(v)
        product[:n] = self.rows(factors) @ all_entries
        return product

    def rows(self, factors: Mapping[str, float], out: Array | None = None) -> Array:
        """Return the rows of own unknowns of the terms' tangent, without supports. Collective.

        Parameters
        ----------
        factors
            Term name -> factor of its tangent.
        out
            Array for the result, on one rank; None: a new one.

        Returns
        -------
        Array
            (3 own nodes, 3 all nodes).
        """
        width = 3 * self._count
        rows = np.empty((3 * (self._owned + self._ghosts), width)) if out is None else out
        rows[:] = 0.0
        for term in self._terms:
            if factor := factors.get(term.name, 0.0):
                term.add_hessian(rows, factor)
        if self._comm.size == 1:
            return rows
        own_rows, ghost_rows = rows[: 3 * self._owned].copy(), rows[3 * self._owned :]
        own_blocks = own_rows.reshape(self._owned, 3, width)
        ghost_blocks = ghost_rows.reshape(self._ghosts, 3, width)
        # each rank gets the global numbers and the rows of those ghosts that it owns
        sent = [(self._ghost_numbers[i], ghost_blocks[i]) for i in self._ghosts_of_ranks]
        for numbers, received_blocks in self._comm.alltoall(sent):
            np.add.at(own_blocks, numbers - self._first, received_blocks)
        return own_rows

    def _create_sum(self) -> tuple[Array, Array, PETSc.Mat]:
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
        if self._comm.size > 1:
            outer_columns = np.delete(
                np.arange(column_count, dtype=kind), np.s_[first_column : first_column + n]
            )
            outer_starts = _row_starts(n, column_count - n)
            arrays.append((outer_starts, np.tile(outer_columns, n), outer.reshape(-1)))
        size = ((n, None), (n, None))
        K = PETSc.Mat().createAIJWithArrays(
            size, arrays[0] if len(arrays) == 1 else tuple(arrays), comm=self._comm
        )
        self._shared_arrays = arrays  # PETSc does not keep them alive
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            K.setOption(option, True)
        return inner, outer, K

    @cached_property
    def _ghosts_of_ranks(self) -> list[NDArray[np.intp]]:
        """For each rank the ghosts that it owns, counted from the first ghost."""
        return [np.flatnonzero(self._ghost_owners == rank) for rank in range(self._comm.size)]


def _row_starts(rows: int, width: int) -> NDArray[np.generic]:
    """Return the starts (rows + 1,) of rows with `width` entries each; both may be zero."""
    if width == 0:
        return np.zeros(rows + 1, dtype=PETSc.IntType)
    return np.arange(0, rows * width + 1, width, dtype=PETSc.IntType)

"""The tangent of a system in which all unknowns act on each other: the sparse matrix and dense rows.

The sum is a matrix of PETSc with all its entries, so factors, inertia, folds and modes are those of any system. Its
memory and its factors grow with the square and the cube of the number of unknowns.
"""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.terms import Term

Array = NDArray[np.float64]


@runtime_checkable
class WholeTerm(Term, Protocol):
    """A term whose tangent couples nodes that share no cell and no edge."""

    def add_rows(self, rows: Array, factor: float) -> None:
        """Add factor d2Pi/du2, without supports, to this rank's part of its rows.

        Parameters
        ----------
        rows
            (local nodes with ghosts, 3, all nodes, 3).
        """


class WholeMatrix:
    """A symmetric matrix with all entries, always the same object; clamped unknowns as in `scatter.BlockMatrix`.

    Parameters
    ----------
    clamped
        Homogeneous Dirichlet conditions.
    """

    def __init__(self, V: fem.FunctionSpace, clamped: Sequence[fem.DirichletBC]) -> None:
        comm, nodes = V.mesh.comm, V.dofmap.index_map
        self._comm, self._owned, self._ghosts = comm, nodes.size_local, nodes.num_ghosts
        self._first, self._count = nodes.local_range[0], nodes.size_global
        self._numbers = nodes.local_to_global(np.arange(self._owned, self._owned + self._ghosts, dtype=np.int32))
        self._owners = nodes.owners
        n, first, whole = 3 * self._owned, 3 * self._first, 3 * self._count
        held = np.zeros(n, dtype=bool)
        for bc in clamped:
            dofs = bc.dof_indices()[0]
            held[dofs[dofs < n]] = True
        self._held = held, np.concatenate(comm.allgather(held))
        kind = PETSc.IntType
        self._inner, self._outer = np.zeros((n, n)), np.zeros((n, whole - n))
        outside = np.delete(np.arange(whole, dtype=kind), np.s_[first : first + n])
        starts = [np.arange(0, n * width + 1, width or 1, dtype=kind)[: n + 1] for width in (n, whole - n)]
        starts[1] = starts[1] if whole > n else np.zeros(n + 1, dtype=kind)
        parts = [(starts[0], np.tile(np.arange(n, dtype=kind), n), self._inner.reshape(-1))]
        if comm.size > 1:
            parts.append((starts[1], np.tile(outside, n), self._outer.reshape(-1)))
        size = ((n, None), (n, None))
        self._K = PETSc.Mat().createAIJWithArrays(size, parts[0] if comm.size == 1 else tuple(parts), comm=comm)
        self._kept = parts  # the arrays that PETSc shares
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            self._K.setOption(option, True)

    def sum(self, K: PETSc.Mat, terms: Sequence[tuple[float, WholeTerm]]) -> PETSc.Mat:
        """A sparse matrix plus terms times factors. Collective."""
        n, first = 3 * self._owned, 3 * self._first
        alone = self._comm.size == 1
        into = self._inner.reshape(self._owned, 3, self._count, 3) if alone else None  # nothing is copied
        rows = self._own(self.rows(terms, into)).reshape(n, 3 * self._count)
        own, everywhere = self._held
        rows[own], rows[:, everywhere] = 0.0, 0.0
        starts, columns, values = K.getValuesCSR()
        rows[np.repeat(np.arange(n), np.diff(starts)), columns] += values
        if not alone:
            self._inner[:] = rows[:, first : first + n]
            self._outer[:] = np.delete(rows, np.s_[first : first + n], axis=1)
        self._K.stateIncrease()
        return self._K

    def rows(self, terms: Sequence[tuple[float, WholeTerm]], into: Array | None = None) -> Array:
        """This rank's part of the rows of its nodes, ghosts too, see `WholeTerm`; in an array if given. Collective."""
        rows = np.empty((self._owned + self._ghosts, 3, self._count, 3)) if into is None else into
        rows[:] = 0.0
        for factor, term in terms:
            term.add_rows(rows, factor)
        return rows

    def times(self, terms: Sequence[tuple[float, WholeTerm]], v: Array) -> Array:
        """This rank's part of the terms' product with a vector, both with ghosts. Collective."""
        whole = np.concatenate(self._comm.allgather(v[: 3 * self._owned]))
        return np.asarray(self.rows(terms).reshape(len(v), -1) @ whole)

    def _own(self, rows: Array) -> Array:
        """The rows of own nodes, summed over the ranks."""
        own, ghosts = rows[: self._owned], rows[self._owned :]
        if self._comm.size == 1:
            return own
        leaving = [np.flatnonzero(self._owners == rank) for rank in range(self._comm.size)]
        for numbers, part in self._comm.alltoall([(self._numbers[i], ghosts[i]) for i in leaving]):
            np.add.at(own, numbers - self._first, part)
        return own

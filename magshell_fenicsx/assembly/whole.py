"""The tangent of a system in which all unknowns act on each other: the sparse matrix and dense rows.

Both are kept apart, as factors of the sparse one mostly serve (`continuation.beside`). Their sum is one of PETSc with
all entries, of which factors, inertia, folds and modes are those of any system. Its memory and its factors grow
with the square and the cube of the number of unknowns.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.terms import Term
from magshell_fenicsx.continuation.system import Beside, Vector

Array = NDArray[np.float64]


@runtime_checkable
class WholeTerm(Term, Protocol):
    """A term whose tangent couples nodes that share no cell and no edge."""

    def rows(self, *, rough: bool = False) -> Array:
        """This rank's part of d2Pi/du2, without supports, (local nodes with ghosts, 3, all nodes, 3). Collective.

        Nobody writes into it. If `rough`, it may be that of an earlier state.
        """


@dataclass(frozen=True)
class Dense:
    """Terms times factors, without the rows and columns of supports: a `continuation.system.Rest`."""

    matrix: "WholeMatrix"
    parts: Sequence[tuple[float, Array]]  # factors, and this rank's rows (own unknowns, all)

    def times(self, v: Vector) -> Vector:
        """See `Rest`."""
        own, everywhere = self.matrix.held
        whole = np.where(everywhere, 0.0, np.concatenate(self.matrix.comm.allgather(v)))
        return np.where(own, 0.0, sum(factor * (rows @ whole) for factor, rows in self.parts))

    def scaled(self, factor: float) -> "Dense":
        """See `Rest`."""
        return Dense(self.matrix, [(factor * each, rows) for each, rows in self.parts])

    def added_to(self, K: PETSc.Mat) -> PETSc.Mat:
        """See `Rest`."""
        return self.matrix.sum(K, self.parts)


class WholeMatrix:
    """A symmetric matrix with all entries, always the same object; clamped unknowns as in `scatter.BlockMatrix`.

    Parameters
    ----------
    clamped
        Homogeneous Dirichlet conditions.
    """

    def __init__(self, V: fem.FunctionSpace, clamped: Sequence[fem.DirichletBC]) -> None:
        comm, nodes = V.mesh.comm, V.dofmap.index_map
        self._owned, self._ghosts = nodes.size_local, nodes.num_ghosts
        self._first, self._count = nodes.local_range[0], nodes.size_global
        self._numbers = nodes.local_to_global(np.arange(self._owned, self._owned + self._ghosts, dtype=np.int32))
        self._owners = nodes.owners
        n = 3 * self._owned
        held = np.zeros(n, dtype=bool)
        for bc in clamped:
            dofs = bc.dof_indices()[0]
            held[dofs[dofs < n]] = True
        self.comm, self.held = comm, (held, np.concatenate(comm.allgather(held)))
        self._whole: tuple[Array, Array, PETSc.Mat] | None = None
        self._summed: dict[str, tuple[Array, Array]] = {}

    def _made(self) -> tuple[Array, Array, PETSc.Mat]:
        """The entries in columns of own nodes and in others, which the third, their matrix, shares."""
        n, first, whole = 3 * self._owned, 3 * self._first, 3 * self._count
        kind = PETSc.IntType
        inner, outer = np.zeros((n, n)), np.zeros((n, whole - n))
        outside = np.delete(np.arange(whole, dtype=kind), np.s_[first : first + n])
        starts = [np.arange(0, n * width + 1, width or 1, dtype=kind)[: n + 1] for width in (n, whole - n)]
        starts[1] = starts[1] if whole > n else np.zeros(n + 1, dtype=kind)
        parts = [(starts[0], np.tile(np.arange(n, dtype=kind), n), inner.reshape(-1))]
        if self.comm.size > 1:
            parts.append((starts[1], np.tile(outside, n), outer.reshape(-1)))
        size = ((n, None), (n, None))
        K = PETSc.Mat().createAIJWithArrays(size, parts[0] if len(parts) == 1 else tuple(parts), comm=self.comm)
        self._kept = parts  # the arrays that PETSc shares
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            K.setOption(option, True)
        return inner, outer, K

    def beside(self, K: PETSc.Mat, terms: Sequence[tuple[float, WholeTerm]], *, rough: bool = False) -> Beside:
        """A sparse matrix and terms times factors beside it. Collective."""
        return Beside(K, Dense(self, [(factor, self.rows(term, rough=rough)) for factor, term in terms]))

    def sum(self, K: PETSc.Mat, parts: Sequence[tuple[float, Array]]) -> PETSc.Mat:
        """A sparse matrix plus rows times factors. Collective."""
        n, first, (own, everywhere) = 3 * self._owned, 3 * self._first, self.held
        self._whole = inner, outer, matrix = self._whole or self._made()
        rows = inner if self.comm.size == 1 else np.empty((n, 3 * self._count))  # nothing is copied
        rows[:] = 0.0
        for factor, part in parts:
            rows += factor * part
        rows[own], rows[:, everywhere] = 0.0, 0.0
        starts, columns, values = K.getValuesCSR()
        rows[np.repeat(np.arange(n), np.diff(starts)), columns] += values
        if self.comm.size > 1:
            inner[:] = rows[:, first : first + n]
            outer[:] = np.delete(rows, np.s_[first : first + n], axis=1)
        matrix.stateIncrease()
        return matrix

    def rows(self, term: WholeTerm, *, rough: bool = False) -> Array:
        """The rows (own unknowns, all) of a term, summed over the ranks, supports too. Collective."""
        parts, (summed_before, summed) = term.rows(rough=rough), self._summed.get(term.name, (None, np.empty(0)))
        if summed_before is not parts:
            summed = self._own(parts).reshape(3 * self._owned, -1)
            self._summed[term.name] = parts, summed
        return summed

    def times(self, terms: Sequence[tuple[float, WholeTerm]], v: Array) -> Array:
        """This rank's part of the terms' product with a vector, both with ghosts. Collective."""
        whole = np.concatenate(self.comm.allgather(v[: 3 * self._owned]))
        return np.asarray(sum(factor * (term.rows().reshape(len(v), -1) @ whole) for factor, term in terms))

    def _own(self, rows: Array) -> Array:
        """The rows of own nodes, summed over the ranks."""
        if self.comm.size == 1:
            return rows
        own, ghosts = rows[: self._owned].copy(), rows[self._owned :]
        leaving = [np.flatnonzero(self._owners == rank) for rank in range(self.comm.size)]
        for numbers, part in self.comm.alltoall([(self._numbers[i], ghosts[i]) for i in leaving]):
            np.add.at(own, numbers - self._first, part)
        return own

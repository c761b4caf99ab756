"""Terms whose tangent has entries outside the pattern of the others: of some unknowns, or of all of them.

The couplings of contact change from state to state: their entries are added to a copy of the sparse matrix. Where all
unknowns act on each other, the sum is a matrix of PETSc with all its entries, so factors, inertia, folds and modes are
those of any system; its memory and its factors grow with the square and the cube of the number of unknowns.
"""

from collections.abc import Mapping, Sequence
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
import scipy
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.terms import Term

Array = NDArray[np.float64]
Entries: TypeAlias = tuple[NDArray[np.int64], NDArray[np.int64], Array]  # global rows and columns, and values
Factors: TypeAlias = Mapping[str, float]  # of terms, by name


class Couplings(Protocol):
    """What some terms, times factors, add to a tangent."""

    def sum(self, K: PETSc.Mat, factors: Factors) -> PETSc.Mat:
        """A sparse matrix and these terms. Collective."""

    def times(self, v: Array, factors: Factors) -> Array:
        """This rank's part of the terms' product with a vector, both with ghosts. Collective."""


def couplings(V: fem.FunctionSpace, terms: Sequence[Term], clamped: Sequence[fem.DirichletBC]) -> list[Couplings]:
    """Those of terms, most of which have none; `clamped` are homogeneous conditions."""
    some = [t for t in terms if isinstance(t, Coupled)]
    of_all = [t for t in terms if isinstance(t, WholeTerm)]
    found: list[Couplings] = [ChangingEntries(V, some, clamped)] if some else []
    return [*found, WholeMatrix(V, of_all, clamped)] if of_all else found


def _held(V: fem.FunctionSpace, clamped: Sequence[fem.DirichletBC]) -> NDArray[np.bool_]:
    """Whether each own unknown is clamped."""
    size = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
    held = np.zeros(size, dtype=bool)
    for bc in clamped:
        dofs = bc.dof_indices()[0]
        held[dofs[dofs < size]] = True
    return held


@runtime_checkable
class Coupled(Protocol):
    """A term whose tangent has entries outside the pattern of the others."""

    name: str

    def entries(self) -> Entries:
        """This rank's part of d2Pi/du2, in any order; entries at the same place are added up. Collective."""


class ChangingEntries:
    """The entries of coupled terms."""

    def __init__(self, V: fem.FunctionSpace, terms: Sequence[Coupled], clamped: Sequence[fem.DirichletBC]) -> None:
        self._terms, self._comm = terms, V.mesh.comm
        self._own = slice(*(3 * at for at in V.dofmap.index_map.local_range))
        self._fixed = np.concatenate(self._comm.allgather(_held(V, clamped)))

    def sum(self, K: PETSc.Mat, factors: Factors) -> PETSc.Mat:
        """See `Couplings`; K itself if there are no entries."""
        entries = self._entries(factors)
        return with_entries(K, entries, self._fixed) if entries else K

    def times(self, v: Array, factors: Factors) -> Array:
        """See `Couplings`."""
        found, size = np.zeros_like(v), self._own.stop - self._own.start
        if entries := self._entries(factors):
            parts = times(entries, np.concatenate(self._comm.allgather(v[:size])))
            found[:size] = self._comm.allreduce(parts)[self._own]
        return found

    def _entries(self, factors: Factors) -> list[tuple[float, Entries]]:
        return [(factor, t.entries()) for t in self._terms if (factor := factors.get(t.name, 0.0))]


def with_entries(K: PETSc.Mat, entries: list[tuple[float, Entries]], fixed: NDArray[np.bool_]) -> PETSc.Mat:
    """A matrix and entries with factors, without those in fixed rows and columns; K itself if there are none.

    Collective.

    Parameters
    ----------
    fixed
        Whether each unknown, by its global number, is zero.
    """
    rows, columns = (np.concatenate([each[k] for _, each in entries]) for k in range(2))
    values = np.concatenate([factor * each[2] for factor, each in entries])
    kept = ~(fixed[rows] | fixed[columns])
    comm, (first, last) = K.comm.tompi4py(), K.getOwnershipRange()
    if not comm.allreduce(int(kept.sum())):
        return K
    own = (rows[kept], columns[kept], values[kept])
    if comm.size > 1:
        owner = np.searchsorted(K.getOwnershipRanges(), own[0], side="right") - 1
        sent = [tuple(each[owner == rank] for each in own) for rank in range(comm.size)]
        own = tuple(np.concatenate(each) for each in zip(*comm.alltoall(sent), strict=True))
    found = scipy.sparse.coo_array((own[2], (own[0] - first, own[1])), (last - first, len(fixed))).tocsr()
    csr = found.indptr.astype(PETSc.IntType), found.indices.astype(PETSc.IntType), found.data
    besides = PETSc.Mat().createAIJ(K.getSizes(), csr=csr, comm=K.comm)
    whole = K.copy()
    whole.axpy(1.0, besides, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    besides.destroy()
    for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
        whole.setOption(option, True)
    return whole


def times(entries: list[tuple[float, Entries]], v: Array) -> Array:
    """This rank's part of the product of entries with a vector of all unknowns, as long as that."""
    found = np.zeros_like(v)
    for factor, (rows, columns, values) in entries:
        np.add.at(found, rows, factor * values * v[columns])
    return found


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
    terms
        What it is the sum of, beside a sparse matrix.
    clamped
        Homogeneous Dirichlet conditions.
    """

    def __init__(self, V: fem.FunctionSpace, terms: Sequence[WholeTerm], clamped: Sequence[fem.DirichletBC]) -> None:
        self._terms = terms
        comm, nodes = V.mesh.comm, V.dofmap.index_map
        self._comm, self._owned, self._ghosts = comm, nodes.size_local, nodes.num_ghosts
        self._first, self._count = nodes.local_range[0], nodes.size_global
        self._numbers = nodes.local_to_global(np.arange(self._owned, self._owned + self._ghosts, dtype=np.int32))
        self._owners = nodes.owners
        n, first, whole = 3 * self._owned, 3 * self._first, 3 * self._count
        held = _held(V, clamped)
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

    def sum(self, K: PETSc.Mat, factors: Factors) -> PETSc.Mat:
        """See `Couplings`."""
        n, first = 3 * self._owned, 3 * self._first
        rows = self._own(self.rows(factors)).reshape(n, 3 * self._count)
        here, everywhere = self._held
        rows[here], rows[:, everywhere] = 0.0, 0.0
        starts, columns, values = K.getValuesCSR()
        rows[np.repeat(np.arange(n), np.diff(starts)), columns] += values
        self._inner[:] = rows[:, first : first + n]
        self._outer[:] = np.delete(rows, np.s_[first : first + n], axis=1) if self._outer.size else 0.0
        self._K.stateIncrease()
        return self._K

    def rows(self, factors: Factors) -> Array:
        """This rank's part of the rows of its nodes, ghosts too, see `WholeTerm`. Collective."""
        rows = np.zeros((self._owned + self._ghosts, 3, self._count, 3))
        for term in self._terms:
            if factor := factors.get(term.name, 0.0):
                term.add_rows(rows, factor)
        return rows

    def times(self, v: Array, factors: Factors) -> Array:
        """See `Couplings`."""
        whole = np.concatenate(self._comm.allgather(v[: 3 * self._owned]))
        return np.asarray(self.rows(factors).reshape(len(v), -1) @ whole)

    def _own(self, rows: Array) -> Array:
        """The rows of own nodes, summed over the ranks."""
        own, ghosts = rows[: self._owned], rows[self._owned :]
        if self._comm.size == 1:
            return own
        leaving = [np.flatnonzero(self._owners == rank) for rank in range(self._comm.size)]
        for numbers, part in self._comm.alltoall([(self._numbers[i], ghosts[i]) for i in leaving]):
            np.add.at(own, numbers - self._first, part)
        return own

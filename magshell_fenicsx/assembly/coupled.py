"""Terms whose tangent has entries outside the pattern of the others: between some unknowns, or
between all of them.

The couplings of contact change from state to state: the sum with the sparse matrix has a pattern of
its own, which has room for what couples soon. It is kept, and with it what the factorisation knows
of it, until an entry is outside. Where all unknowns act on each other, the rest stands beside it
(`assembly.whole.WholeMatrix`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from scipy.sparse import coo_array, csr_array

from magshell_fenicsx.assembly.terms import Term
from magshell_fenicsx.assembly.whole import WholeMatrix, WholeTerm
from magshell_fenicsx.continuation.system import Beside

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
Entries: TypeAlias = tuple[Longs, Longs, Array]  # global rows and columns, and values
Factors: TypeAlias = Mapping[str, float]  # of terms, by name


class Couplings(Protocol):
    """What some terms, times factors, add to a tangent."""

    def sum(self, K: PETSc.Mat, factors: Factors) -> PETSc.Mat:
        """A sparse matrix and these terms. Collective."""

    def times(self, v: Array, factors: Factors) -> Array:
        """This rank's part of the terms' product with a vector, both with ghosts. Collective."""


@runtime_checkable
class KnowsFields(Protocol):
    """A term without a form that knows its derivatives by the fields in it."""

    @property
    def amplitude(self) -> str | None: ...

    def by_field(
        self, name: str, direction: fem.Function, energy: float, force: float
    ) -> tuple[fem.Function, Array] | None:
        """A field, and the derivatives of energy Pi + force v . dPi/du by its values in own cells.
        Collective.

        None if the term has no field of that name.
        """


def couplings(
    V: fem.FunctionSpace, terms: Sequence[Term], clamped: Sequence[fem.DirichletBC]
) -> list[Couplings]:
    """What the terms among these add that are `Coupled`; `clamped` are homogeneous conditions."""
    coupled = [t for t in terms if isinstance(t, Coupled)]
    return [ChangingEntries(V, coupled, clamped)] if coupled else []


def of_all(
    V: fem.FunctionSpace, terms: Sequence[Term], clamped: Sequence[fem.DirichletBC]
) -> "OfAll | None":
    """What the terms among these add that are a `WholeTerm`; None if there are none."""
    whole_terms = [t for t in terms if isinstance(t, WholeTerm)]
    return OfAll(WholeMatrix(V, clamped), whole_terms) if whole_terms else None


@dataclass(frozen=True)
class OfAll:
    """Those of terms in which all unknowns act on each other: what stands beside the sparse
    tangent.
    """

    matrix: WholeMatrix
    terms: Sequence[WholeTerm]

    def beside(self, K: PETSc.Mat, factors: Factors, *, rough: bool) -> PETSc.Mat | Beside:
        """A sparse matrix and these terms; if `rough`, those of an earlier state. Collective."""
        terms = self._among(factors)
        return self.matrix.beside(K, terms, rough=rough) if terms else K

    def times(self, v: Array, factors: Factors) -> Array:
        """See `Couplings`."""
        return self.matrix.times(self._among(factors), v)

    def _among(self, factors: Factors) -> list[tuple[float, WholeTerm]]:
        return [(factor, t) for t in self.terms if (factor := factors.get(t.name, 0.0))]


@runtime_checkable
class Coupled(Protocol):
    """A term whose tangent has entries outside the pattern of the others."""

    name: str

    def entries(self) -> Entries:
        """This rank's part of d2Pi/du2, in any order; entries at the same place are added up.

        Collective.
        """

    def around(self) -> tuple[Longs, Longs]:
        """Pairs of global nodes, in any order, between which this rank may have entries.
        Collective.

        It is a function of `since`, and of nothing that was evaluated before: a resumed run has the
        same pattern.
        """

    @property
    def since(self) -> float:
        """A number of the present state that changes where `around` does."""


class ChangingEntries:
    """The entries of coupled terms, which change from state to state."""

    def __init__(
        self, V: fem.FunctionSpace, terms: Sequence[Coupled], clamped: Sequence[fem.DirichletBC]
    ) -> None:
        self._terms, self._comm = terms, V.mesh.comm
        sizes = self._comm.allgather(V.dofmap.index_map.size_local)
        self._size = V.dofmap.index_map_bs
        self._ranges = self._size * np.array([0, *np.cumsum(sizes)])
        self._own = slice(*self._ranges[self._comm.rank : self._comm.rank + 2])
        held = np.zeros(self._own.stop - self._own.start, dtype=bool)
        for bc in clamped:
            dofs = bc.dof_indices()[0]
            held[dofs[dofs < len(held)]] = True
        self._fixed = np.concatenate(self._comm.allgather(held))
        self._sum: _Sum | None = None
        self._since: tuple[tuple[str, float], ...] = ()

    def sum(self, K: PETSc.Mat, factors: Factors) -> PETSc.Mat:
        """See `Couplings`; K itself if there are no entries, else mostly the same object."""
        entries = self._entries(factors)
        if not entries:
            return K
        rows, columns = (np.concatenate([each[k] for _, each in entries]) for k in range(2))
        values = np.concatenate([factor * each[2] for factor, each in entries])
        added = _owned(self._comm, self._ranges, self._fixed, (rows, columns, values))
        if not self._comm.allreduce(added.nnz):
            return K
        since = tuple((t.name, t.since) for t in self._terms if factors.get(t.name, 0.0))
        if self._sum is None or self._since != since or self._sum.of.handle != K.handle:
            self._sum, self._since = _Sum(K, self._room(factors), self._own.start), since
        if self._comm.allreduce(self._sum.has(added), MPI.MIN):
            return self._sum.filled(added)
        return _Sum(K, _ones(added), self._own.start).filled(added)

    def times(self, v: Array, factors: Factors) -> Array:
        """See `Couplings`."""
        product, size = np.zeros_like(v), self._own.stop - self._own.start
        if entries := self._entries(factors):
            parts = times(entries, np.concatenate(self._comm.allgather(v[:size])))
            product[:size] = self._comm.allreduce(parts)[self._own]
        return product

    def _entries(self, factors: Factors) -> list[tuple[float, Entries]]:
        return [(factor, t.entries()) for t in self._terms if (factor := factors.get(t.name, 0.0))]

    def _room(self, factors: Factors) -> csr_array:
        """The pattern in which there is room. Collective."""
        parts = [t.around() for t in self._terms if factors.get(t.name, 0.0)]
        rows, columns = (np.concatenate(each) for each in zip(*parts, strict=True))
        count = len(self._fixed) // self._size
        rows, columns = np.divmod(np.unique(rows * count + columns), count)
        i, j = (
            self._size * each[:, None, None] + np.arange(self._size) for each in (rows, columns)
        )
        i, j = np.broadcast_arrays(i.transpose(0, 2, 1), j)
        ones = np.ones(i.size, dtype=np.int8)
        return _ones(_owned(self._comm, self._ranges, self._fixed, (i.ravel(), j.ravel(), ones)))


class _Sum:
    """A sparse matrix plus changing entries, in a pattern that is kept; the constructor is
    collective.

    Parameters
    ----------
    of
        The sparse matrix, which is always the same object.
    room
        (own unknowns, all) ones where entries can be.
    first
        Number of the first own unknown.
    """

    def __init__(self, of: PETSc.Mat, room: csr_array, first: int) -> None:
        self.of, self.room = of, room
        starts, columns, _ = of.getValuesCSR()
        both = (
            csr_array((np.ones(len(columns), dtype=np.int8), columns, starts), room.shape)
            + 2 * room
        )
        self._of, self._at_room = (np.flatnonzero(both.data & bit) for bit in (1, 2))
        self._keys = _keys(room)
        own = (both.indices >= first) & (both.indices < first + room.shape[0])
        self._own = own
        self._values = np.zeros(both.nnz)
        kind = PETSc.IntType
        parts = [(both.indptr.astype(kind), both.indices.astype(kind), self._values)]
        if of.comm.size > 1:
            parts = [_part(both, own, first), _part(both, ~own, 0)]
        self._parts = parts  # the arrays that PETSc shares
        self._whole = PETSc.Mat().createAIJWithArrays(
            of.getSizes(), parts[0] if len(parts) == 1 else tuple(parts), comm=of.comm
        )
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            self._whole.setOption(option, True)

    def has(self, added: csr_array) -> bool:
        """Whether there is room for entries of this rank."""
        keys = _keys(added)
        at = np.searchsorted(self._keys, keys)
        return bool(at.max(initial=0) < len(self._keys) and (self._keys[at] == keys).all())

    def filled(self, added: csr_array) -> PETSc.Mat:
        """The sum as both are now."""
        self._values[:] = 0.0
        self._values[self._of] = self.of.getValuesCSR()[2]
        self._values[self._at_room[np.searchsorted(self._keys, _keys(added))]] += added.data
        if self.of.comm.size > 1:
            for (_, _, values), which in zip(self._parts, (self._own, ~self._own), strict=True):
                values[:] = self._values[which]
        self._whole.stateIncrease()
        return self._whole


def with_entries(K: PETSc.Mat, entries: Entries, fixed: NDArray[np.bool_]) -> PETSc.Mat:
    """A new matrix with entries too, without those of `fixed` unknowns; K itself if there are none.

    Collective.
    """
    ranges = np.asarray(K.getOwnershipRanges())
    added = _owned(K.comm.tompi4py(), ranges, fixed, entries)
    if not K.comm.tompi4py().allreduce(added.nnz):
        return K
    return _Sum(K, _ones(added), int(ranges[K.comm.rank])).filled(added)


def _owned(
    comm: MPI.Comm, ranges: Longs, fixed: NDArray[np.bool_], entries: tuple[Longs, Longs, Any]
) -> csr_array:
    """The rows of own unknowns of entries that ranks have, summed, without those of fixed unknowns.

    Collective.
    """
    rows, columns, values = entries
    kept = ~(fixed[rows] | fixed[columns])
    own = rows[kept], columns[kept], values[kept]
    if comm.size > 1:
        owner = np.searchsorted(ranges, own[0], side="right") - 1
        sent = [tuple(each[owner == rank] for each in own) for rank in range(comm.size)]
        own = tuple(np.concatenate(each) for each in zip(*comm.alltoall(sent), strict=True))
    first, last = ranges[comm.rank : comm.rank + 2]
    return coo_array((own[2], (own[0] - first, own[1])), (last - first, len(fixed))).tocsr()


def times(entries: list[tuple[float, Entries]], v: Array) -> Array:
    """This rank's part of the product of entries with a vector of all unknowns, as long as that."""
    product = np.zeros_like(v)
    for factor, (rows, columns, values) in entries:
        product += np.bincount(rows, factor * values * v[columns], len(v))
    return product


def pairs_of(nodes: Longs) -> tuple[Longs, Longs]:
    """All pairs of nodes in each row (n, k)."""
    i, j = np.broadcast_arrays(nodes[:, :, None], nodes[:, None, :])
    return i.ravel(), j.ravel()


def _ones(matrix: csr_array) -> csr_array:
    """Its pattern."""
    return csr_array(
        (np.ones(matrix.nnz, dtype=np.int8), matrix.indices, matrix.indptr), matrix.shape
    )


def _keys(matrix: csr_array) -> Longs:
    """A number of each place, ascending."""
    rows = np.repeat(np.arange(matrix.shape[0], dtype=np.int64), np.diff(matrix.indptr))
    return np.asarray(rows * matrix.shape[1] + matrix.indices)


def _part(both: csr_array, which: NDArray[np.bool_], first: int) -> tuple[Any, Any, Array]:
    """Starts, columns from `first`, and values of some entries."""
    starts = np.concatenate([[0], np.cumsum(which)])[both.indptr]
    columns = both.indices[which] - first
    return starts.astype(PETSc.IntType), columns.astype(PETSc.IntType), np.zeros(len(columns))

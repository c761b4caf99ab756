"""Terms whose tangent has entries outside the pattern of the others: between some unknowns, or between all of them.

The couplings of contact change from state to state: their entries are added to a copy of the sparse matrix. Where all
unknowns act on each other, the rest stands beside it (`assembly.whole.WholeMatrix`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
import scipy
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.terms import Term
from magshell_fenicsx.assembly.whole import WholeMatrix, WholeTerm
from magshell_fenicsx.continuation.system import Beside

Array = NDArray[np.float64]
Entries: TypeAlias = tuple[NDArray[np.int64], NDArray[np.int64], Array]  # global rows and columns, and values
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

    def by_field(self, direction: fem.Function, energy: float, force: float) -> tuple[fem.Function, Array]:
        """A field, and the derivatives of energy Pi + force v . dPi/du by its values in own cells. Collective."""


def couplings(V: fem.FunctionSpace, terms: Sequence[Term], clamped: Sequence[fem.DirichletBC]) -> list[Couplings]:
    """What the terms among these add that are `Coupled`; `clamped` are homogeneous conditions."""
    coupled = [t for t in terms if isinstance(t, Coupled)]
    return [ChangingEntries(V, coupled, clamped)] if coupled else []


def of_all(V: fem.FunctionSpace, terms: Sequence[Term], clamped: Sequence[fem.DirichletBC]) -> "OfAll | None":
    """What the terms among these add that are a `WholeTerm`; None if there are none."""
    whole_terms = [t for t in terms if isinstance(t, WholeTerm)]
    return OfAll(WholeMatrix(V, clamped), whole_terms) if whole_terms else None


@dataclass(frozen=True)
class OfAll:
    """Those of terms in which all unknowns act on each other: what stands beside the sparse tangent."""

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
        """This rank's part of d2Pi/du2, in any order; entries at the same place are added up. Collective."""


class ChangingEntries:
    """The entries of coupled terms, which change from state to state."""

    def __init__(self, V: fem.FunctionSpace, terms: Sequence[Coupled], clamped: Sequence[fem.DirichletBC]) -> None:
        self._terms, self._comm = terms, V.mesh.comm
        self._own = slice(*(V.dofmap.index_map_bs * at for at in V.dofmap.index_map.local_range))
        held = np.zeros(self._own.stop - self._own.start, dtype=bool)
        for bc in clamped:
            dofs = bc.dof_indices()[0]
            held[dofs[dofs < len(held)]] = True
        self._fixed = np.concatenate(self._comm.allgather(held))

    def sum(self, K: PETSc.Mat, factors: Factors) -> PETSc.Mat:
        """See `Couplings`; K itself if there are no entries."""
        entries = self._entries(factors)
        return with_entries(K, entries, self._fixed) if entries else K

    def times(self, v: Array, factors: Factors) -> Array:
        """See `Couplings`."""
        product, size = np.zeros_like(v), self._own.stop - self._own.start
        if entries := self._entries(factors):
            parts = times(entries, np.concatenate(self._comm.allgather(v[:size])))
            product[:size] = self._comm.allreduce(parts)[self._own]
        return product

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
    rows_of_rank = scipy.sparse.coo_array((own[2], (own[0] - first, own[1])), (last - first, len(fixed))).tocsr()
    csr = rows_of_rank.indptr.astype(PETSc.IntType), rows_of_rank.indices.astype(PETSc.IntType), rows_of_rank.data
    besides = PETSc.Mat().createAIJ(K.getSizes(), csr=csr, comm=K.comm)
    whole = K.copy()
    whole.axpy(1.0, besides, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    besides.destroy()
    for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
        whole.setOption(option, True)
    return whole


def times(entries: list[tuple[float, Entries]], v: Array) -> Array:
    """This rank's part of the product of entries with a vector of all unknowns, as long as that."""
    product = np.zeros_like(v)
    for factor, (rows, columns, values) in entries:
        np.add.at(product, rows, factor * values * v[columns])
    return product

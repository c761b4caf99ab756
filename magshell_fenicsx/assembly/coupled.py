"""Terms whose couplings change from state to state, such as contact: their part of the tangent beside the fixed one."""

from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
import scipy
from numpy.typing import NDArray
from petsc4py import PETSc

Array = NDArray[np.float64]
Entries: TypeAlias = tuple[NDArray[np.int64], NDArray[np.int64], Array]  # global rows and columns, and values


@runtime_checkable
class Coupled(Protocol):
    """A term whose tangent has entries outside the pattern of the others."""

    name: str

    def entries(self) -> Entries:
        """This rank's part of d2Pi/du2, in any order; entries at the same place are added up. Collective."""


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

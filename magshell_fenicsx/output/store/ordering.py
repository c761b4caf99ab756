"""Nodal values in an order that does not depend on the number of ranks."""

import numpy as np
import scipy
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import Vector
from magshell_fenicsx.input.source import CaseError

Array = NDArray[np.float64]
CLOSE = 1e-9  # nodes at a smaller distance, over the mesh's size, are equal


class Ordering:
    """The nodes of a function space, numbered once and identified by their positions.

    Parameters
    ----------
    V
        A space distributed over all ranks, or the same space on every rank.
    comm
        The communicator of all ranks.
    known
        On rank 0, the (n, 3) positions on the affine mesh in the order to use, or None for the present order.

    Raises
    ------
    CaseError
        On every rank, if the nodes differ from `known`.

    Attributes
    ----------
    places
        (n, 3) positions in the order in use.
    size, last
        Number of values on this rank, and whether it is the last rank of the space.
    """

    def __init__(self, V: fem.FunctionSpace, comm: MPI.Comm, known: Array | None = None) -> None:
        self._within, self._comm = V.mesh.comm, comm
        self._values = V.dofmap.index_map_bs
        mine = V.tabulate_dof_coordinates()[: V.dofmap.index_map.size_local]
        present = self._within.allgather(mine)
        known = comm.bcast(known)
        if known is None:
            self.places: Array = np.concatenate(present)
            first = sum(len(part) for part in present[: self._within.rank])
            self._mine: NDArray[np.int64] = first + np.arange(len(mine))
        else:
            self.places, self._mine = known, self._found(known, mine, comm)
        self._parts = self._within.allgather(self._mine)
        self.size, self.last = len(self._mine) * self._values, self._within.rank == self._within.size - 1

    def _found(self, known: Array, mine: Array, comm: MPI.Comm) -> NDArray[np.int64]:
        """The numbers of this rank's nodes among the known ones."""
        distance, number = scipy.spatial.cKDTree(known).query(mine)
        parts = self._within.allgather(number)
        one_to_one = np.array_equal(np.sort(np.concatenate(parts)), np.arange(len(known)))
        close = np.all(distance < CLOSE * np.abs(known).max())
        if not comm.allreduce(bool(one_to_one and close), MPI.LAND):
            raise CaseError(
                "--resume: the mesh differs from the checkpoint's; give another folder, or --overwrite in place of "
                "--resume"
            )
        return np.asarray(number)

    def gather(self, u: Vector) -> Array:
        """All values (n, components) of a displacement on rank 0 of its space; empty on other ranks."""
        parts = self._within.gather(u)
        whole = np.empty((len(self.places), self._values)) if parts else np.empty((0, self._values))
        for where, part in zip(self._parts, parts or [], strict=False):
            whole[where] = part.reshape(-1, self._values)
        return whole

    def scatter(self, whole: Array) -> Vector:
        """This rank's part of values that every rank has."""
        return np.asarray(whole.reshape(-1, self._values)[self._mine].ravel())

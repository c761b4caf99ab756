"""A mesh as a whole, whatever its ranks: its pieces that are not connected, and its cells on every
rank.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True)
class CellsOfAll:
    """The cells of all ranks, on each of them.

    Attributes
    ----------
    nodes
        (cells, k) global numbers.
    own
        Those of this rank.
    """

    nodes: NDArray[np.intp]
    own: range
    comm: MPI.Comm

    @classmethod
    def of(cls, V: fem.FunctionSpace) -> "CellsOfAll":
        """Of a space; collective."""
        comm, index, count = (
            V.mesh.comm,
            V.dofmap.index_map,
            V.mesh.topology.index_map(V.mesh.topology.dim).size_local,
        )
        local = V.dofmap.list[:count]
        nodes = index.local_to_global(local.ravel().astype(np.int32)).reshape(local.shape)
        first = sum(comm.allgather(count)[: comm.rank])
        return cls(
            np.concatenate(comm.allgather(nodes)).astype(np.intp), range(first, first + count), comm
        )

    def gathered(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values of this rank's cells (those of ghosts after them are left out) -> of all;
        collective.
        """
        return over_ranks(self.comm, values[: len(self.own)])


def over_ranks(comm: MPI.Comm, values: NDArray[Any]) -> NDArray[Any]:
    """The rows of all ranks, one rank's after the other's; collective."""
    return np.concatenate(comm.allgather(values)) if comm.size > 1 else np.array(values)


def whole(f: fem.Function) -> NDArray[np.float64]:
    """The values (nodes, components) of all ranks, by global numbers; collective."""
    V = f.function_space
    size = V.dofmap.bs
    return over_ranks(
        V.mesh.comm, f.x.array[: size * V.dofmap.index_map.size_local].reshape(-1, size)
    )


def add_own(
    b: NDArray[np.float64], forces: NDArray[np.float64], own: tuple[int, int], comm: MPI.Comm
) -> None:
    """Add the forces (nodes, 3) that ranks have on any nodes to the local vectors of their owners;
    collective.

    Parameters
    ----------
    own
        Number of the first degree of freedom of this rank, and how many it has.
    """
    start, size = own
    summed = np.asarray(comm.allreduce(forces)) if comm.size > 1 else forces
    b[:size] += summed.ravel()[start : start + size]


def pieces(V: fem.FunctionSpace) -> NDArray[np.int32]:
    """The number of the piece of each local node, ghosts included, the same on all ranks;
    collective.
    """
    comm, index, cells = V.mesh.comm, V.dofmap.index_map, V.dofmap.list
    count, mine = _components(
        np.repeat(cells[:, 0], cells.shape[1]), cells.ravel(), index.size_local + index.num_ghosts
    )
    counts = comm.allgather(count)
    code = mine + sum(counts[: comm.rank])
    owners = fem.Function(V)
    owners.x.array.reshape(-1, V.dofmap.bs)[:] = code[:, None]
    owners.x.scatter_forward()
    same = np.unique(
        np.column_stack([code, owners.x.array.reshape(-1, V.dofmap.bs)[:, 0].astype(np.int64)]),
        axis=0,
    )
    joined = np.concatenate(comm.allgather(same))
    return np.asarray(_components(joined[:, 0], joined[:, 1], sum(counts))[1][code], dtype=np.int32)


def _components(
    one: NDArray[np.int64], other: NDArray[np.int64], count: int
) -> tuple[int, NDArray[np.int32]]:
    graph = coo_array((np.ones(len(one), dtype=np.int8), (one, other)), (count, count))
    number, labels = connected_components(graph, directed=False)
    return int(number), labels

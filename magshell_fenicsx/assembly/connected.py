"""The pieces of a mesh that are not connected."""

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def pieces(V: fem.FunctionSpace) -> NDArray[np.int32]:
    """The number of the piece of each local node, ghosts included, the same on all ranks; collective."""
    comm, index, cells = V.mesh.comm, V.dofmap.index_map, V.dofmap.list
    count, mine = _components(
        np.repeat(cells[:, 0], cells.shape[1]), cells.ravel(), index.size_local + index.num_ghosts
    )
    counts = comm.allgather(count)
    code = mine + sum(counts[: comm.rank])
    owners = fem.Function(V)
    owners.x.array.reshape(-1, V.dofmap.bs)[:] = code[:, None]
    owners.x.scatter_forward()
    same = np.unique(np.column_stack([code, owners.x.array.reshape(-1, V.dofmap.bs)[:, 0].astype(np.int64)]), axis=0)
    joined = np.concatenate(comm.allgather(same))
    return np.asarray(_components(joined[:, 0], joined[:, 1], sum(counts))[1][code], dtype=np.int32)


def _components(one: NDArray[np.int64], other: NDArray[np.int64], count: int) -> tuple[int, NDArray[np.int32]]:
    graph = coo_array((np.ones(len(one), dtype=np.int8), (one, other)), (count, count))
    number, labels = connected_components(graph, directed=False)
    return int(number), labels

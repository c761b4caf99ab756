"""A distributed mesh seen as a whole: its cells and nodal values gathered on every rank.

Terms that couple any two cells, such as contact and magnetic interaction, need all cells on each
rank. Nodes are numbered globally as in the index map of their space.

Own nodes and cells belong to this rank; ghosts are local copies of nodes and cells of other ranks.
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
class GlobalCells:
    """The cells of all ranks, on each rank.

    Attributes
    ----------
    nodes
        (cells, k): global numbers of the nodes of each cell.
    own_range
        Rows of the cells that this rank owns.
    """

    nodes: NDArray[np.intp]
    own_range: range
    comm: MPI.Comm

    @classmethod
    def gather(cls, V: fem.FunctionSpace) -> "GlobalCells":
        """Gather the cells of a space from all ranks, in the order of ranks. Collective."""
        comm, index_map, topology = V.mesh.comm, V.dofmap.index_map, V.mesh.topology
        count = topology.index_map(topology.dim).size_local
        local_nodes = V.dofmap.list[:count]
        flat_nodes = local_nodes.ravel().astype(np.int32)
        nodes = index_map.local_to_global(flat_nodes).reshape(local_nodes.shape)
        # cells of lower ranks come before
        first_cell = sum(comm.allgather(count)[: comm.rank])
        all_nodes = np.concatenate(comm.allgather(nodes)).astype(np.intp)
        return cls(all_nodes, range(first_cell, first_cell + count), comm)

    def gather_values(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the values at all cells, in the order of `nodes`. Collective.

        Parameters
        ----------
        values
            (local cells, ...) of this rank; rows of ghost cells, which come last, are left out.
        """
        return gather_rows(self.comm, values[: len(self.own_range)])


def gather_rows(comm: MPI.Comm, values: NDArray[Any]) -> NDArray[Any]:
    """Return the rows of all ranks, in the order of ranks; collective."""
    return np.concatenate(comm.allgather(values)) if comm.size > 1 else np.array(values)


def global_values(f: fem.Function) -> NDArray[np.float64]:
    """Return the nodal values (nodes, components) of all ranks, by global numbers. Collective."""
    V = f.function_space
    block_size = V.dofmap.bs
    owned = f.x.array[: block_size * V.dofmap.index_map.size_local]
    return gather_rows(V.mesh.comm, owned.reshape(-1, block_size))


def add_to_owners(
    b: NDArray[np.float64],
    forces: NDArray[np.float64],
    owned_dofs: tuple[int, int],
    comm: MPI.Comm,
) -> None:
    """Sum forces on all nodes over the ranks, and add each to its owner's vector. Collective.

    Parameters
    ----------
    b
        Local vector, which is changed.
    forces
        (nodes, 3): this rank's part, by global numbers of nodes.
    owned_dofs
        Global number of this rank's first degree of freedom, and how many it owns.
    """
    start, size = owned_dofs
    summed = np.asarray(comm.allreduce(forces)) if comm.size > 1 else forces
    b[:size] += summed.ravel()[start : start + size]


def component_numbers(V: fem.FunctionSpace) -> NDArray[np.int32]:
    """Return the connected component of the mesh to which each local node belongs. Collective.

    Returns
    -------
    NDArray
        (local nodes, ghosts included): numbers of components, the same on all ranks.
    """
    comm, index_map, cells = V.mesh.comm, V.dofmap.index_map, V.dofmap.list
    # the components on this rank: edges go from the first node of each cell to all of its nodes
    count, local_labels = _graph_components(
        np.repeat(cells[:, 0], cells.shape[1]),
        cells.ravel(),
        index_map.size_local + index_map.num_ghosts,
    )
    counts = comm.allgather(count)
    # labels of different ranks are made different
    labels = local_labels + sum(counts[: comm.rank])
    # where two ranks share a node, their components are one. A field over the nodes, whose values
    # ghosts get from the owners, gives each local node the label on the owning rank
    owner_field = fem.Function(V)
    nodal = owner_field.x.array.reshape(-1, V.dofmap.bs)
    nodal[:] = labels[:, None]
    owner_field.x.scatter_forward()
    owner_labels = nodal[:, 0].astype(np.int64)
    # a graph whose nodes are the labels of all ranks: an edge links two labels of one node
    links = np.unique(np.column_stack([labels, owner_labels]), axis=0)
    all_links = np.concatenate(comm.allgather(links))
    link_starts, link_ends = all_links.T
    _, merged_labels = _graph_components(link_starts, link_ends, sum(counts))
    return np.asarray(merged_labels[labels], dtype=np.int32)


def component_count(V: fem.FunctionSpace) -> int:
    """Return the number of connected components of the mesh; collective."""
    return 1 + int(V.mesh.comm.allreduce(int(component_numbers(V).max(initial=0)), MPI.MAX))


def _graph_components(
    starts: NDArray[np.int64], ends: NDArray[np.int64], count: int
) -> tuple[int, NDArray[np.int32]]:
    """Find the connected components of a graph of `count` nodes.

    Parameters
    ----------
    starts, ends
        The two nodes of each edge.

    Returns
    -------
    The number of components, and the component of each node.
    """
    graph = coo_array((np.ones(len(starts), dtype=np.int8), (starts, ends)), (count, count))
    number, labels = connected_components(graph, directed=False)
    return int(number), labels

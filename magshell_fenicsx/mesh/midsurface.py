"""The mid-surface: an affine dolfinx mesh and, apart from it, the placement r0.

The kernels see only the affine mesh, so their Jacobian is constant and one compiled
kernel serves every shape; the shape itself is the vector field r0, interpolated at
the nodes of the displacement's own element, so that rigid motions are exact.
"""

from dataclasses import dataclass
from functools import cached_property

import basix
import basix.ufl
import numpy as np
from dolfinx import fem, mesh
from dolfinx.cpp.io import perm_gmsh
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import PatchMesh, check_orientation
from magshell_fenicsx.platform import compat

ORDERS = {3: 1, 6: 2, 10: 3}  # nodes of a triangle -> its order


@dataclass(frozen=True)
class Midsurface:
    """A mid-surface on all ranks.

    Attributes
    ----------
    mesh
        Affine triangles (topological dimension 2 in space), with one layer of ghosts.
    edges
        Name -> facets (local numbers) of that boundary edge.
    points
        Name -> (3,) position of a vertex.
    """

    mesh: mesh.Mesh
    edges: dict[str, NDArray[np.int32]]
    points: dict[str, NDArray[np.float64]]
    _patch: PatchMesh

    def charted(self, V: fem.FunctionSpace) -> NDArray[np.float64]:
        """Chart coordinates (cells, nodes, 2 | 3) of the nodes of each cell of this rank, in its own chart."""
        patch = self._patch
        order = ORDERS[patch.cells.shape[1]]
        geometry = basix.create_element(
            basix.ElementFamily.P, basix.CellType.triangle, order, basix.LagrangeVariant.equispaced
        )
        to_dolfinx = perm_gmsh(mesh.CellType.triangle, patch.cells.shape[1])
        values = geometry.tabulate(0, compat.interpolation_points(V))[0, :, :, 0]
        cells = patch.cells[self._original_cells]
        return np.asarray(np.einsum("qk,ckd->cqd", values, patch.nodes[cells[:, to_dolfinx]]))

    def placement(self, V: fem.FunctionSpace) -> fem.Function:
        """The undeformed placement r0 in the Lagrange space `V` (vector valued)."""
        chart, r0 = self.charted(V), fem.Function(V, name="r0")
        places = self._patch.embedding(chart.reshape(-1, chart.shape[-1]))
        r0.x.array.reshape(-1, 3)[V.dofmap.list] = places.reshape(*chart.shape[:2], 3)
        r0.x.scatter_forward()
        return r0

    @property
    def read(self) -> bool:
        """Whether it was meshed elsewhere, and may be faceted or folded."""
        return self._patch.nodes.shape[1] == 3

    @cached_property
    def patches(self) -> dict[str, NDArray[np.bool_]]:
        """Name -> whether each cell of this rank, ghosts included, belongs to that part of the surface."""
        return {name: inside[self._original_cells] for name, inside in self._patch.patches.items()}

    @property
    def _original_cells(self) -> NDArray[np.int64]:
        """This rank's cells, ghosts included, in the numbers of the triangulation."""
        cell_map = self.mesh.topology.index_map(self.mesh.topology.dim)
        return np.asarray(self.mesh.topology.original_cell_index[: cell_map.size_local + cell_map.num_ghosts])


def distribute(patch: PatchMesh, comm: MPI.Comm) -> Midsurface:
    """Make the mid-surface of all ranks from the triangulation, which each of them has: it is small.

    Raises
    ------
    MeshError
        On every rank, if the normals of the triangulation disagree.
    """
    check_orientation(patch)
    vertices, corners = np.unique(patch.corners, return_inverse=True)
    corners = corners.reshape(-1, 3).astype(np.int64)
    xyz = patch.embedding(patch.nodes[vertices])
    first = comm.rank == 0
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(3,))
    domain = mesh.create_mesh(
        comm,
        cells=corners if first else corners[:0],
        x=xyz if first else xyz[:0],
        e=element,
        partitioner=compat.shared_facets(),
    )
    position = {name: patch.embedding(x[None])[0] for name, x in patch.points.items()}
    return Midsurface(domain, _named_facets(domain, patch, vertices), position, patch)


def _named_facets(domain: mesh.Mesh, patch: PatchMesh, vertices: NDArray[np.int64]) -> dict[str, NDArray[np.int32]]:
    """Find the facets of each named edge by the vertex numbers of the triangulation."""
    domain.topology.create_connectivity(1, 2)
    domain.topology.create_connectivity(1, 0)
    facets = mesh.exterior_facet_indices(domain.topology)
    # a rank may have no part of any edge, and dolfinx divides by their number
    ends = mesh.entities_to_geometry(domain, 1, facets) if len(facets) else np.empty((0, 2), dtype=np.int32)
    numbers = np.sort(vertices[domain.geometry.input_global_indices[ends]], axis=1)
    found = {}
    for name, pairs in patch.edges.items():
        wanted = {(a, b) for a, b in np.sort(pairs, axis=1)}
        inside = [(a, b) in wanted for a, b in numbers]
        found[name] = facets[np.array(inside, dtype=bool)]
    return found

"""The mid-surface: an affine dolfinx mesh and, separate from it, the placement r0.

The kernels use the affine mesh alone. So their Jacobian is constant, and one compiled kernel serves
every shape. The shape itself is the vector field r0. It is interpolated at the nodes of the
displacement's own element, so that rigid motions are exact.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import basix
import basix.ufl
import numpy as np
from dolfinx import fem, mesh
from dolfinx.cpp.io import perm_gmsh
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.mesh.partition import partitioner
from magshell_fenicsx.mesh.patch import (
    Deviated,
    Deviation,
    Embedding,
    GivenField,
    PatchMesh,
    as_set,
    check_orientation,
)
from magshell_fenicsx.platform import compat

Array = NDArray[np.float64]
ORDERS = {3: 1, 6: 2, 10: 3}  # nodes of a triangle -> its order


def nodal_normals(nodes: Array, cells: NDArray[np.int64]) -> Array:
    """Unit normals (n, 3): means over the triangles (m, 3 | 6 | 10) around each node, with their
    angles as weights.
    """
    count = cells.shape[1]
    element = basix.create_element(
        basix.ElementFamily.P,
        basix.CellType.triangle,
        ORDERS[count],
        basix.LagrangeVariant.equispaced,
    )
    ordered = cells[:, perm_gmsh(mesh.CellType.triangle, count)]
    a1, a2 = np.einsum(
        "dqk,ckx->dcqx", element.tabulate(1, element.points)[1:, :, :, 0], nodes[ordered]
    )
    angles = np.full(ordered.shape, np.pi)
    for corner, (e, f) in enumerate(
        ((a1, a2), (a2 - a1, -a1), (-a2, a1 - a2))
    ):  # vertices come first
        cosine = np.sum(_unit(e[:, corner]) * _unit(f[:, corner]), axis=1)
        angles[:, corner] = np.arccos(np.clip(cosine, -1, 1))
    total = np.zeros_like(nodes)
    np.add.at(total, ordered, angles[..., None] * _unit(np.cross(a1, a2)))
    return _unit(total)


def _unit(v: Array) -> Array:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300))


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
        """Chart coordinates (cells, nodes, 2 | 3) of the nodes of each cell of this rank, in its
        own chart.

        Of several shells, and of a mesh file, they are places in space.
        """
        return self._charted(compat.interpolation_points(V))[..., :3]

    def charted_by_shell(self, V: fem.FunctionSpace) -> NDArray[np.float64]:
        """The same, of several shells that have charts in that of each cell's shell, where others
        may be too.
        """
        if not getattr(self._patch.embedding, "charts", False):
            return self.charted(V)
        return self._charted(compat.interpolation_points(V))[..., 3:5]

    def _charted(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The same at reference points (q, 2), with the normals of a mesh file that has
        imperfections.
        """
        return at_reference_points(
            self._patch.nodes, self._patch.cells[self._original_cells], points
        )

    def deviation(
        self, points: NDArray[np.float64], besides: Sequence[Deviation] = ()
    ) -> NDArray[np.float64] | None:
        """w0 over R at reference points (q, 2) of each cell, (cells, q); None where there are no
        imperfections.
        """
        embedding = self._patch.embedding
        if not isinstance(embedding, Deviated):
            return None
        return self.at(points, replace(embedding, deviations=(*embedding.deviations, *besides)).w0)

    def at(self, points: NDArray[np.float64], of: Embedding) -> NDArray[np.float64]:
        """A function of nodes of the triangulation at reference points (q, 2) of each cell, (cells,
        q, ...).
        """
        chart = self._charted(points)
        values = of(chart.reshape(-1, chart.shape[-1]))
        return np.asarray(values.reshape(*chart.shape[:2], *values.shape[1:]))

    def reshaped(self, embedding: Embedding) -> PatchMesh:
        """The triangulation with another map to space."""
        return replace(self._patch, embedding=embedding)

    def placement(self, V: fem.FunctionSpace) -> fem.Function:
        """The undeformed placement r0 in the Lagrange space `V` (vector valued)."""
        return self._field(V, "r0", self._patch.embedding)

    def growth(self, V: fem.FunctionSpace, deviations: Sequence[Deviation]) -> fem.Function:
        """What further deviations add to the placement in the same space."""
        drawn = self._patch.embedding
        assert isinstance(drawn, Deviated)
        return self._field(V, "growth", lambda chart: drawn.along_normal(chart, deviations))

    def _field(self, V: fem.FunctionSpace, name: str, of: Embedding) -> fem.Function:
        function = fem.Function(V, name=name)
        function.x.array.reshape(-1, 3)[V.dofmap.list] = self.at(compat.interpolation_points(V), of)
        function.x.scatter_forward()
        return function

    @property
    def patch(self) -> PatchMesh:
        """The triangulation, whole on every rank."""
        return self._patch

    @property
    def read(self) -> bool:
        """Whether it comes from a mesh file, and so may have facets or folds."""
        return self._patch.nodes.shape[1] != 2

    @property
    def kinked(self) -> bool:
        """Whether cells may meet at angles: in a mesh file, also that of one of several shells, and
        at joints.
        """
        charts = getattr(self._patch.embedding, "charts", not self.read)
        return any(self._patch.joints) or not charts

    @cached_property
    def patches(self) -> dict[str, NDArray[np.bool_]]:
        """Name -> whether each cell of this rank, ghosts included, belongs to that part of the
        surface.
        """
        return {name: inside[self._original_cells] for name, inside in self._patch.patches.items()}

    @property
    def shells(self) -> tuple[str, ...]:
        """Their names, where there are several."""
        return self._patch.shells

    def beside(self, point: str) -> NDArray[np.bool_] | None:
        """Whether each cell of this rank, ghosts too, is of the shell of a named point; None if
        there is one shell.

        Another shell may have a vertex at the same place, or a sheet that stands on this one at a
        T-junction.
        """
        if self._patch.feet:
            standing = np.unique(
                np.concatenate([self._patch.edges[name].ravel() for name in self._patch.feet])
            )
            stands = np.asarray(np.isin(self._patch.corners, standing).any(axis=1))
            return np.asarray(~stands[self._original_cells])
        if not hasattr(self._patch.embedding, "charts"):
            return None
        shells = np.rint(
            self._patch.nodes[self._patch.cells[:, 0], -1]
        )  # the last number of a node is its shell's
        return np.asarray((shells == np.rint(self._patch.points[point][-1]))[self._original_cells])

    @cached_property
    def joints(self) -> list[NDArray[np.float64] | None]:
        """For each joint a number of each cell of this rank, ghosts too: 1 on its one edge, -1 on
        the other, else 0.

        A T-junction has None.
        """
        return [
            both and (1.0 * both[0] - 1.0 * both[1])[self._original_cells]
            for both in self._patch.joints
        ]

    @cached_property
    def feet(self) -> dict[str, NDArray[np.bool_]]:
        """Name of an edge at a T-junction of a mesh file -> whether it stands on each cell of this
        rank.
        """
        return {name: on[self._original_cells] for name, on in self._patch.feet.items()}

    @cached_property
    def given(self) -> NDArray[np.int64]:
        """This rank's cells among the triangles that were given, see `PatchMesh.given`."""
        assert self._patch.given is not None
        return self._patch.given[self._original_cells]

    def in_cells(self, field: GivenField) -> Array:
        """The values (cells, nodes, size) in this rank's cells, ghosts included."""
        return field.in_cells(self.given)

    def function(self, field: GivenField) -> fem.Function:
        """The same as a function on this mesh, of the shape (size,)."""
        f = fem.Function(
            fem.functionspace(self.mesh, ("DG", field.degree, (field.size,))), name=field.name
        )
        f.x.array.reshape(-1, field.size)[f.function_space.dofmap.list] = self.in_cells(field)
        return f

    @property
    def _original_cells(self) -> NDArray[np.int64]:
        """This rank's cells, ghosts included, in the numbers of the triangulation."""
        cell_map = self.mesh.topology.index_map(self.mesh.topology.dim)
        return np.asarray(
            self.mesh.topology.original_cell_index[: cell_map.size_local + cell_map.num_ghosts]
        )


def distribute(patch: PatchMesh, comm: MPI.Comm) -> Midsurface:
    """Make the mid-surface on all ranks from the triangulation, which every rank has: it is small.

    Raises
    ------
    MeshError
        On every rank, if the normals of the triangulation disagree.
    """
    check_orientation(patch)
    vertices, corners = np.unique(patch.corners, return_inverse=True)
    corners = corners.reshape(-1, 3).astype(np.int64)
    xyz = patch.embedding(patch.nodes[vertices])
    domain = create_mesh(
        comm, basix.ufl.element("Lagrange", "triangle", 1, shape=(3,)), corners, xyz
    )
    position = {name: patch.embedding(x[None])[0] for name, x in patch.points.items()}
    return Midsurface(domain, _named_facets(domain, patch, vertices), position, patch)


def create_mesh(
    comm: MPI.Comm, element: Any, cells: NDArray[np.int64], x: NDArray[np.float64]
) -> mesh.Mesh:
    """A mesh on all ranks, from cells and node positions (n, 3) that every rank has.

    Of the same cells it has the same numbers on the same ranks.
    """
    facet = element.basix_element.entity_closure_dofs[-2][0]
    first = comm.rank == 0
    return mesh.create_mesh(
        comm,
        cells=cells if first else cells[:0],
        x=x if first else x[:0],
        e=element,
        partitioner=partitioner(cells, len(facet), comm.rank, comm.size),
    )


def at_reference_points(
    nodes: NDArray[np.float64], cells: NDArray[np.int64], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Coordinates (m, q, d) of reference points (q, 2) in triangles (m, 3 | 6 | 10) in gmsh's
    order.
    """
    count = cells.shape[1]
    geometry = basix.create_element(
        basix.ElementFamily.P,
        basix.CellType.triangle,
        ORDERS[count],
        basix.LagrangeVariant.equispaced,
    )
    values = geometry.tabulate(0, points)[0, :, :, 0]
    to_dolfinx = perm_gmsh(mesh.CellType.triangle, count)
    return np.asarray(np.einsum("qk,ckd->cqd", values, nodes[cells[:, to_dolfinx]]))


def _named_facets(
    domain: mesh.Mesh, patch: PatchMesh, vertices: NDArray[np.int64]
) -> dict[str, NDArray[np.int32]]:
    """Find the facets of each named edge by the vertex numbers of the triangulation."""
    domain.topology.create_connectivity(1, 2)
    domain.topology.create_connectivity(1, 0)
    facets = mesh.exterior_facet_indices(domain.topology)
    # a rank may have no part of any edge, and dolfinx divides by their number
    ends = (
        mesh.entities_to_geometry(domain, 1, facets)
        if len(facets)
        else np.empty((0, 2), dtype=np.int32)
    )
    numbers = np.sort(vertices[domain.geometry.input_global_indices[ends]], axis=1)
    named = {}
    for name, pairs in patch.edges.items():
        wanted = as_set(pairs)
        inside = [(a, b) in wanted for a, b in numbers]
        named[name] = facets[np.array(inside, dtype=bool)]
    return named

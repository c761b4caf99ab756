"""The mid-surface: an affine dolfinx mesh and, separate from it, the reference placement r0.

The kernels use the affine mesh alone. So their Jacobian is constant, and one compiled kernel serves
every shape. The shape itself is the vector field r0. It is interpolated at the nodes of the
displacement's own element, so that rigid motions are exact.

`distribute` makes a `Midsurface` of a triangulation that every rank has, a `PatchMesh`. A node of
that has coordinates in a chart (d = 2), or is a place in space: alone (d = 3), with a normal
(d = 6), or followed by the coordinates in its shell and the shell's number (d = 10, see
`multi_shell`). An embedding maps nodes to places in space. The deviation w0 is the distance of the
imperfect from the perfect surface along the normal. A user's field is a function on the mesh of a
program. Reference points are those of the reference triangle. Lengths are over R.
"""

from collections.abc import Mapping, Sequence
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

from magshell_fenicsx.mesh.patch import (
    DeviatedEmbedding,
    Deviation,
    Embedding,
    PatchMesh,
    UserField,
    as_set,
    check_orientation,
)
from magshell_fenicsx.platform import compat

Array = NDArray[np.float64]
ORDERS = {3: 1, 6: 2, 10: 3}  # nodes of a triangle -> its order


def nodal_normals(nodes: Array, cells: NDArray[np.int64]) -> Array:
    """Return unit normals (n, 3) at the nodes of a triangulation in space.

    A normal is the mean over the triangles (m, 3 | 6 | 10) around the node, with their angles as
    weights.
    """
    count = cells.shape[1]
    element = basix.create_element(
        basix.ElementFamily.P,
        basix.CellType.triangle,
        ORDERS[count],
        basix.LagrangeVariant.equispaced,
    )
    dolfinx_cells = cells[:, perm_gmsh(mesh.CellType.triangle, count)]
    # tangents (cells, nodes, 3)
    a1, a2 = np.einsum(
        "dqk,ckx->dcqx", element.tabulate(1, element.points)[1:, :, :, 0], nodes[dolfinx_cells]
    )
    # angle of each triangle at its nodes: pi at nodes on its sides. At inner nodes any angle gives
    # the same normal, as they have one triangle alone
    angles = np.full(dolfinx_cells.shape, np.pi)
    # the two sides that leave each vertex; vertices are the first nodes
    sides_at_vertices = ((a1, a2), (a2 - a1, -a1), (-a2, a1 - a2))
    for vertex, (e, f) in enumerate(sides_at_vertices):
        cosine = np.sum(_unit(e[:, vertex]) * _unit(f[:, vertex]), axis=1)
        angles[:, vertex] = np.arccos(np.clip(cosine, -1, 1))
    total = np.zeros_like(nodes)
    np.add.at(total, dolfinx_cells, angles[..., None] * _unit(np.cross(a1, a2)))
    return _unit(total)


def _unit(v: Array) -> Array:
    """Return vectors (..., d) over their lengths."""
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300))


@dataclass(frozen=True)
class Midsurface:
    """A mid-surface on all ranks.

    Arrays over cells have this rank's cells, ghosts included.

    Attributes
    ----------
    mesh
        Affine triangles (topological dimension 2 in space), with one layer of ghosts.
    edges
        Name -> facets (local numbers) of that boundary edge.
    inner_lines
        Name -> facets of that line within the surface, those of other ranks beside it included.
    points
        Name -> (3,) position of a vertex.
    _patch
        The triangulation, complete on every rank; `_original_cells` has this rank's cells in it.
    """

    mesh: mesh.Mesh
    edges: dict[str, NDArray[np.int32]]
    inner_lines: dict[str, NDArray[np.int32]]
    points: dict[str, NDArray[np.float64]]
    _patch: PatchMesh

    def chart_coordinates(self, V: fem.FunctionSpace) -> NDArray[np.float64]:
        """Return the coordinates (cells, nodes, 2 | 3) of the nodes of `V`, in each cell's chart.

        Of several shells, and of a mesh file, they are places in space, the first three numbers of
        a node.
        """
        return self._node_coordinates(compat.interpolation_points(V))[..., :3]

    def chart_coordinates_by_shell(self, V: fem.FunctionSpace) -> NDArray[np.float64]:
        """Return coordinates (cells, nodes, 2) of the nodes of each cell in its shell's chart.

        Charts of several shells may overlap. Without charts they are places in space, as those of
        `chart_coordinates`.
        """
        # only the embedding of several shells has this attribute; their nodes are ten numbers, in
        # which the chart of the shell follows the place in space
        if not getattr(self._patch.embedding, "has_charts", False):
            return self.chart_coordinates(V)
        return self._node_coordinates(compat.interpolation_points(V))[..., 3:5]

    def _node_coordinates(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return coordinates as in `PatchMesh.nodes` at points of each cell, (cells, q, d).

        They are interpolated from the nodes of the cell. For a mesh file with imperfections they
        are places and normals.

        Parameters
        ----------
        points
            (q, 2) in the reference triangle.
        """
        return at_reference_points(
            self._patch.nodes, self._patch.cells[self._original_cells], points
        )

    def deviation(
        self, points: NDArray[np.float64], further: Sequence[Deviation] = ()
    ) -> NDArray[np.float64] | None:
        """Return w0 over R at reference points (q, 2) of each cell, (cells, q).

        None without imperfections. `further` deviations are added.
        """
        embedding = self._patch.embedding
        if not isinstance(embedding, DeviatedEmbedding):
            return None
        deviations = (*embedding.deviations, *further)
        return self.evaluate(points, replace(embedding, deviations=deviations).w0)

    def evaluate(self, points: NDArray[np.float64], function: Embedding) -> NDArray[np.float64]:
        """Return a function of nodes of the triangulation at points of each cell, (cells, q, ...).

        Parameters
        ----------
        points
            (q, 2) in the reference triangle.
        function
            Coordinates as in `PatchMesh.nodes` (n, d) -> values (n, ...).
        """
        coordinates = self._node_coordinates(points)
        values = function(coordinates.reshape(-1, coordinates.shape[-1]))
        return np.asarray(values.reshape(*coordinates.shape[:2], *values.shape[1:]))

    def with_embedding(self, embedding: Embedding) -> PatchMesh:
        """Return the triangulation with another map to space."""
        return replace(self._patch, embedding=embedding)

    def placement(self, V: fem.FunctionSpace) -> fem.Function:
        """Return the reference placement r0 in the Lagrange space `V` (vector valued)."""
        return self._vector_field(V, "r0", self._patch.embedding)

    def growth(self, V: fem.FunctionSpace, deviations: Sequence[Deviation]) -> fem.Function:
        """Return the displacement over R by further deviations, in the space `V`."""
        embedding = self._patch.embedding
        assert isinstance(embedding, DeviatedEmbedding)
        return self._vector_field(
            V, "growth", lambda chart: embedding.along_normal(chart, deviations)
        )

    def _vector_field(self, V: fem.FunctionSpace, name: str, values: Embedding) -> fem.Function:
        """Return a function in the vector space `V` whose nodal values are a map of coordinates.

        Parameters
        ----------
        values
            Coordinates as in `PatchMesh.nodes` (n, d) -> values (n, 3).
        """
        function = fem.Function(V, name=name)
        nodal = self.evaluate(compat.interpolation_points(V), values)
        function.x.array.reshape(-1, 3)[V.dofmap.list] = nodal
        function.x.scatter_forward()
        return function

    @property
    def patch(self) -> PatchMesh:
        """The triangulation, complete on every rank."""
        return self._patch

    @property
    def from_mesh_file(self) -> bool:
        """Whether the nodes are places in space: of a mesh file or of several shells.

        Such a surface may have facets or creases.
        """
        return self._patch.nodes.shape[1] != 2

    @property
    def kinked(self) -> bool:
        """Whether cells may meet at angles: at joints, and on a shell from a mesh file."""
        has_charts = getattr(self._patch.embedding, "has_charts", not self.from_mesh_file)
        return any(self._patch.joints) or not has_charts

    @cached_property
    def patches(self) -> dict[str, NDArray[np.bool_]]:
        """Name -> (cells,) whether each cell belongs to that part of the surface."""
        return {name: mask[self._original_cells] for name, mask in self._patch.patches.items()}

    @property
    def shells(self) -> tuple[str, ...]:
        """Names of the shells, where there are several."""
        return self._patch.shells

    def cells_of_point(self, point: str) -> NDArray[np.bool_] | None:
        """Return whether each cell (cells,) is on the shell of a named point; None for one shell.

        Another shell may have a vertex at the same place. At T-junctions of a mesh file, cells of
        the sheets that end there are excluded.
        """
        if self._patch.t_junctions:
            # triangles with a vertex on the edge that ends there
            edges = [self._patch.edges[name].ravel() for name in self._patch.t_junctions]
            vertices = np.unique(np.concatenate(edges))
            ends_on_sheet = np.asarray(np.isin(self._patch.corners, vertices).any(axis=1))
            return np.asarray(~ends_on_sheet[self._original_cells])
        if not hasattr(self._patch.embedding, "has_charts"):
            return None  # one shell
        # several shells: the last number of a node is that of its shell
        shell_of_cell = np.rint(self._patch.nodes[self._patch.cells[:, 0], -1])
        shell_of_point = np.rint(self._patch.points[point][-1])
        return np.asarray((shell_of_cell == shell_of_point)[self._original_cells])

    @cached_property
    def joints(self) -> list[NDArray[np.float64] | None]:
        """Sides (cells,) of each joint: 1 in cells on its first edge, -1 on its second, else 0.

        None for a T-junction.
        """
        # masks: whether each triangle is on the first and on the second edge; None stays None
        return [
            masks and (1.0 * masks[0] - 1.0 * masks[1])[self._original_cells]
            for masks in self._patch.joints
        ]

    @cached_property
    def t_junctions(self) -> dict[str, NDArray[np.bool_]]:
        """Name of an edge at a T-junction of a mesh file -> whether it ends on each cell."""
        return {name: mask[self._original_cells] for name, mask in self._patch.t_junctions.items()}

    @cached_property
    def source_triangles(self) -> NDArray[np.int64]:
        """This rank's cells among those of a program, (cells, 2).

        They are the number of each, and 1 where its orientation is reversed.
        """
        assert self._patch.source_triangles is not None
        return self._patch.source_triangles[self._original_cells]

    def in_cells(self, field: UserField) -> Array:
        """Return the values (cells, nodes, size) of a user's field."""
        return field.in_cells(self.source_triangles)

    def function(self, field: UserField) -> fem.Function:
        """Return a user's field as a discontinuous function on this mesh, of the shape (size,)."""
        V = fem.functionspace(self.mesh, ("DG", field.degree, (field.size,)))
        function = fem.Function(V, name=field.name)
        function.x.array.reshape(-1, field.size)[V.dofmap.list] = self.in_cells(field)
        return function

    @property
    def _original_cells(self) -> NDArray[np.int64]:
        """This rank's cells, ghosts included, in the numbers of the triangulation."""
        cell_map = self.mesh.topology.index_map(self.mesh.topology.dim)
        return np.asarray(
            self.mesh.topology.original_cell_index[: cell_map.size_local + cell_map.num_ghosts]
        )


def distribute(patch: PatchMesh, comm: MPI.Comm) -> Midsurface:
    """Make the mid-surface on all ranks of a triangulation that every rank has; collective.

    Raises
    ------
    MeshError
        On every rank, if the normals of the triangulation disagree.
    """
    check_orientation(patch)
    # only vertices: the mesh is affine, and inner nodes of the triangles give r0 alone
    vertices, corners = np.unique(patch.corners, return_inverse=True)
    corners = corners.reshape(-1, 3).astype(np.int64)
    xyz = patch.embedding(patch.nodes[vertices])
    domain = create_mesh(
        comm, basix.ufl.element("Lagrange", "triangle", 1, shape=(3,)), corners, xyz
    )
    position = {name: patch.embedding(x[None])[0] for name, x in patch.points.items()}
    domain.topology.create_connectivity(1, 2)
    domain.topology.create_connectivity(1, 0)
    border = mesh.exterior_facet_indices(domain.topology)
    edges = _named_facets(domain, border, patch.edges, vertices)
    facet_map = domain.topology.index_map(1)
    facets = np.arange(facet_map.size_local + facet_map.num_ghosts, dtype=np.int32)
    inner_lines = _named_facets(domain, facets, patch.inner_lines, vertices)
    return Midsurface(domain, edges, inner_lines, position, patch)


def create_mesh(
    comm: MPI.Comm, element: Any, cells: NDArray[np.int64], x: NDArray[np.float64]
) -> mesh.Mesh:
    """Return a distributed mesh of cells and nodes (n, 3) that every rank has; collective.

    For the same cells, numbers and ranks of the mesh are the same.
    """
    # rank 0 gives all cells, so that their numbers do not depend on how they were divided
    is_first_rank = comm.rank == 0
    return mesh.create_mesh(
        comm,
        cells=cells if is_first_rank else cells[:0],
        x=x if is_first_rank else x[:0],
        e=element,
        partitioner=compat.shared_facet_partitioner(),
    )


def at_reference_points(
    nodes: NDArray[np.float64], cells: NDArray[np.int64], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return coordinates (m, q, d) at reference points (q, 2) of triangles.

    Parameters
    ----------
    nodes
        (n, d) coordinates.
    cells
        (m, 3 | 6 | 10) node numbers in gmsh's order.
    """
    count = cells.shape[1]
    geometry = basix.create_element(
        basix.ElementFamily.P,
        basix.CellType.triangle,
        ORDERS[count],
        basix.LagrangeVariant.equispaced,
    )
    # shape functions (q, nodes), in dolfinx's order of the nodes
    values = geometry.tabulate(0, points)[0, :, :, 0]
    to_dolfinx = perm_gmsh(mesh.CellType.triangle, count)
    return np.asarray(np.einsum("qk,ckd->cqd", values, nodes[cells[:, to_dolfinx]]))


def _named_facets(
    domain: mesh.Mesh,
    facets: NDArray[np.int32],
    lines: Mapping[str, NDArray[np.int64]],
    vertices: NDArray[np.int64],
) -> dict[str, NDArray[np.int32]]:
    """Return the local facets of each named line, found by the vertex numbers of the triangulation.

    Parameters
    ----------
    facets
        Local facets among which they are.
    lines
        Name -> pairs of vertices.
    vertices
        Node of the triangulation for each vertex of the mesh, in the order of its making.
    """
    if not lines:
        return {}
    # a rank may have no part of any edge, and dolfinx divides by their number
    ends = np.empty((0, 2), dtype=np.int32)
    if len(facets):
        ends = mesh.entities_to_geometry(domain, 1, facets)
    # numbers of the triangulation for both ends of each facet
    numbers = np.sort(vertices[domain.geometry.input_global_indices[ends]], axis=1)
    facets_of_lines = {}
    for name, pairs in lines.items():
        pairs_of_line = as_set(pairs)
        is_on_line = [(a, b) in pairs_of_line for a, b in numbers]
        facets_of_lines[name] = facets[np.array(is_on_line, dtype=bool)]
    return facets_of_lines

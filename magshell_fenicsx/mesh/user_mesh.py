"""A user's dolfinx mesh of triangles in space: its triangles, fields on it, displacements for it.

Every rank has all triangles, in the order in which they were made, whatever the number of ranks:
they are few. A scene, the model of a problem with its solver, has a mesh of its own, distributed in
its own way; fields go there and displacements come back cell by cell.

A cell's number is its place in the order in which the cells were given to dolfinx, which is the
same for any number of ranks; local numbers are those of one rank. Own cells are without ghosts.
"""

from collections.abc import Mapping
from typing import Any, NoReturn

import basix
import numpy as np
from dolfinx import fem, mesh
from dolfinx.cpp.io import perm_gmsh
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import MeshError, Pairs, SurfaceTriangles, UserField
from magshell_fenicsx.platform import compat

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
TRIANGLE = basix.CellType.triangle
NODES_BY_ORDER = {1: 3, 2: 6, 3: 10}  # order of a triangle -> its nodes
MeshPart = int | NDArray[np.int32]  # a value of tags, or local numbers of facets or cells


class UserMesh:
    """A mesh to which fields belong and for which displacements are made.

    All methods are collective.

    Attributes
    ----------
    mesh, comm
        The dolfinx mesh, and its communicator.
    _element
        Lagrange element of the geometry.
    _owned
        Number of this rank's own cells.
    _numbers
        Number of each local cell, own cells first, ghosts included.
    _spaces
        Degree -> space of displacements that was made for it.

    Parameters
    ----------
    domain
        Triangles of order 1 to 3 in space.

    Raises
    ------
    MeshError
        If the mesh is of another kind.
    """

    def __init__(self, domain: mesh.Mesh) -> None:
        """Check the mesh, and number its cells in the order of their making; collective."""
        self.mesh, self.comm = domain, domain.comm
        cell_type, dimension = domain.topology.cell_name(), domain.geometry.dim
        if cell_type != "triangle":
            raise MeshError(
                f"mesh: its cells are of the kind {cell_type}; a mid-surface has triangles"
            )
        if dimension != 3:
            raise MeshError(
                f"mesh: its nodes have {dimension} coordinates; a mid-surface is in space: gdim=3"
            )
        self._element = domain.ufl_domain().ufl_coordinate_element().basix_element
        if (order := self._element.degree) not in NODES_BY_ORDER:
            raise MeshError(f"mesh: its triangles are of order {order}; allowed are 1, 2 and 3")
        cell_map = domain.topology.index_map(2)
        self._owned = cell_map.size_local
        self._numbers = self._original_numbers(cell_map)
        self._spaces: dict[int, fem.FunctionSpace] = {}

    def __reduce__(self) -> NoReturn:
        """Refuse to be pickled."""
        raise TypeError(
            "a dolfinx mesh belongs to its process and cannot be pickled: make the problem in each "
            "process, or write the mesh to a file that a case names"
        )

    def triangles(
        self,
        edges: Mapping[str, MeshPart],
        patches: Mapping[str, MeshPart],
        facet_tags: mesh.MeshTags | None = None,
        cell_tags: mesh.MeshTags | None = None,
    ) -> SurfaceTriangles:
        """Return the triangles of all ranks with named edges and patches; collective.

        Nodes are numbered in the order in which the cells name them, whatever the number of ranks.

        Parameters
        ----------
        edges, patches
            Name -> a value of `facet_tags` or `cell_tags`, or local facets or cells.

        Raises
        ------
        MeshError
            On every rank, if tags are missing or have no such value.
        """
        nodes, ids = self._nodes_of_owned_cells()
        cells = self._gather_cells(ids)
        # number the used nodes in the order in which they first stand in the cells
        used, first_index, index_of_used = np.unique(cells, return_index=True, return_inverse=True)
        order = np.argsort(first_index)
        # position of a node in `used` -> its number
        number = np.empty(len(used), dtype=np.int64)
        number[order] = np.arange(len(used))
        places = self._gather_cells(nodes).reshape(-1, 3)[first_index[order]]
        # by name: vertex pairs of an edge in dolfinx's global numbers, and local cells of a patch
        pairs_of_edges = {
            name: self._vertex_pairs(self._entities_of_part(f"edges.{name}", part, facet_tags, 1))
            for name, part in edges.items()
        }
        cells_of_patches = {
            name: self._entities_of_part(f"patches.{name}", part, cell_tags, 2)
            for name, part in patches.items()
        }
        return SurfaceTriangles(
            places,
            number[index_of_used].reshape(cells.shape),
            {name: number[np.searchsorted(used, ends)] for name, ends in pairs_of_edges.items()},
            {name: self._cell_mask(local, len(cells)) for name, local in cells_of_patches.items()},
            self,
        )

    def field(self, function: fem.Function | fem.Constant, name: str) -> UserField:
        """Return a function on this mesh as a field, a polynomial in each triangle; collective.

        The field reads the function again in `UserField.update`.

        Parameters
        ----------
        function
            The function; a constant is a field of degree zero.
        name
            Name of the field in messages.

        Raises
        ------
        MeshError
            If the function is on another mesh, or is no Lagrange or DG function.
        """
        if isinstance(function, fem.Constant):
            return self._constant_field(function, name)
        V = function.function_space
        if V.mesh._cpp_object is not self.mesh._cpp_object:
            raise MeshError(f"{name}: is a function on another mesh than that of the shell")
        family = getattr(V.ufl_element(), "element_family", None)
        if family != basix.ElementFamily.P or len(function.ufl_shape) > 1:
            raise MeshError(
                f"{name}: is a function of {V.ufl_element()}; "
                "allowed are Lagrange and DG, scalars or vectors: interpolate it into such a space"
            )
        element = V.element.basix_element
        nodes = lagrange_element(element.degree)
        # from nodal values of the function to those of the field, whose nodes are others
        table = element.tabulate(0, nodes.points)[0, :, :, 0]

        def read() -> Array:
            """Return the function's values at the nodes of all triangles; collective."""
            values = function.x.array.reshape(-1, V.dofmap.bs)[V.dofmap.list[: self._owned]]
            nodal = self._gather_cells(np.matmul(table, np.asarray(values, dtype=float)))
            return _finite(nodal, name)

        return UserField(name, element.degree, read(), swapped_nodes(nodes), self, read)

    def _constant_field(self, constant: fem.Constant, name: str) -> UserField:
        """Return a number or a vector as a field of degree zero; collective.

        Parameters
        ----------
        name
            Name of the field in messages.

        Raises
        ------
        MeshError
            If it is a matrix, or on another mesh.
        """
        if constant.ufl_domain() != self.mesh.ufl_domain():
            raise MeshError(f"{name}: is a constant on another mesh than that of the shell")
        if len(constant.ufl_shape) > 1:
            raise MeshError(f"{name}: is a matrix; allowed are numbers and vectors")
        cell_count = self.mesh.topology.index_map(2).size_global

        def read() -> Array:
            """Return the constant in all triangles."""
            value = np.atleast_1d(np.array(constant.value, dtype=float))
            return _finite(np.tile(value, (cell_count, 1, 1)), name)

        nodes = swapped_nodes(lagrange_element(0))
        return UserField(name, 0, read(), nodes, self, read)

    def displacement(
        self, u: fem.Function, source_triangles: Numbers, scale: float
    ) -> fem.Function:
        """Return a field of a scene as a function on this mesh; collective.

        Parameters
        ----------
        u
            A vector Lagrange function on the scene's mesh.
        source_triangles
            (cells, 2) of the scene's cells, ghosts perhaps included: the number of each cell in
            this mesh, and 1 where its orientation is reversed.
        scale
            Divisor of the values, for the units of this mesh.
        """
        V = u.function_space
        degree, owned = V.element.basix_element.degree, V.mesh.topology.index_map(2).size_local
        nodal = u.x.array.reshape(-1, 3)[V.dofmap.list[:owned]] / scale
        number, is_reversed = source_triangles[:owned].T
        # in a reversed cell the second and the third vertex are exchanged
        nodal_of_reversed = nodal[:, swapped_nodes(V.element.basix_element)]
        nodal = np.where(is_reversed[:, None, None] == 1, nodal_of_reversed, nodal)
        # every rank gets the values of all cells, and takes those of its own
        cell_count = self.mesh.topology.index_map(2).size_global
        nodal_of_all = np.zeros((cell_count, *nodal.shape[1:]))
        for numbers, values in self.comm.allgather((number, nodal)):
            nodal_of_all[numbers] = values
        # a space is made once for each degree
        W = self._spaces.get(degree) or fem.functionspace(self.mesh, ("Lagrange", degree, (3,)))
        self._spaces[degree] = W
        displacement = fem.Function(W, name="u")
        displacement.x.array.reshape(-1, 3)[W.dofmap.list] = nodal_of_all[self._numbers]
        return displacement

    def put_displacement(
        self, u: fem.Function, target: fem.Function, source_triangles: Numbers, scale: float
    ) -> None:
        """Put a function on this mesh into a field of a scene, as `displacement` reversed.

        Collective.

        Parameters
        ----------
        u
            A vector Lagrange function on this mesh, of the degree of the scene's field.
        target
            The vector Lagrange function on the scene's mesh.
        source_triangles, scale
            Those of `displacement`.
        """
        V, W = target.function_space, u.function_space
        u.x.scatter_forward()  # a program may have set its own values alone
        nodal_of_own = u.x.array.reshape(-1, 3)[W.dofmap.list[: self._owned]]
        nodal_of_all = self._gather_cells(nodal_of_own) * scale
        element = V.element.basix_element
        field = UserField("u", element.degree, nodal_of_all, swapped_nodes(element))
        target.x.array.reshape(-1, 3)[V.dofmap.list] = field.in_cells(source_triangles)

    def _original_numbers(self, cell_map: Any) -> Numbers:
        """Return the number of each local cell, ghosts included, in the order of their making.

        For a part of another mesh, which has no such order, it is dolfinx's global number.
        """
        local_count = cell_map.size_local + cell_map.num_ghosts
        original_numbers = compat.original_cells(self.mesh)[:local_count]
        numbers_of_all_ranks = np.concatenate(self.comm.allgather(original_numbers[: self._owned]))
        has_all = len(numbers_of_all_ranks) == cell_map.size_global
        if has_all and (np.sort(numbers_of_all_ranks) == np.arange(cell_map.size_global)).all():
            return original_numbers
        # not all numbers from 0 on are there: the mesh is a part of another one
        return np.asarray(cell_map.local_to_global(np.arange(local_count, dtype=np.int32)))

    def _gather_cells(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return values of the cells of all ranks, in the order of the cells' numbers; collective.

        Parameters
        ----------
        values
            (owned cells, ...) values of this rank's own cells.
        """
        numbers_and_values = self.comm.allgather((self._numbers[: self._owned], values))
        numbers, all_values = (
            np.concatenate(arrays) for arrays in zip(*numbers_and_values, strict=True)
        )
        return np.asarray(all_values[np.argsort(numbers)])

    def _nodes_of_owned_cells(self) -> tuple[Array, Numbers]:
        """Return places (cells, nodes, 3) and global numbers of nodes of this rank's cells.

        The nodes of a cell are equispaced and in gmsh's order.
        """
        geometry, dofs = self.mesh.geometry, compat.geometry_dofs(self.mesh)[: self._owned]
        places = geometry.x[dofs]
        if self._element.lagrange_variant != basix.LagrangeVariant.equispaced:
            degree = self._element.degree
            equispaced = basix.create_element(
                basix.ElementFamily.P, TRIANGLE, degree, basix.LagrangeVariant.equispaced
            )
            places = np.matmul(self._element.tabulate(0, equispaced.points)[0, :, :, 0], places)
        node_numbers = geometry.index_map().local_to_global(dofs.ravel().astype(np.int32))
        node_numbers = node_numbers.reshape(dofs.shape)
        # the inverse of the permutation from gmsh's to dolfinx's order
        order = np.argsort(perm_gmsh(mesh.CellType.triangle, dofs.shape[1]))
        return np.asarray(places[:, order]), np.asarray(node_numbers[:, order])

    def _entities_of_part(
        self, key: str, part: MeshPart, tags: mesh.MeshTags | None, dimension: int
    ) -> NDArray[np.int32]:
        """Return the local facets (dimension 1) or cells (dimension 2) of a named part; collective.

        Parameters
        ----------
        key
            Key with which messages begin.
        part
            A value of the tags, or local numbers.

        Raises
        ------
        MeshError
            On every rank, if no rank has any, or if those of one rank are not of this mesh.
        """
        tags_name = "facet_tags" if dimension == 1 else "cell_tags"
        entities_name = "facets" if dimension == 1 else "cells"
        # this rank's entities, or its error; a value is looked up in the tags
        entities: NDArray[np.int32] = np.empty(0, dtype=np.int32)
        error = ""
        by_value = isinstance(part, int | np.integer)
        if not by_value:
            error = self._error_of_numbers(np.asarray(part), dimension, entities_name)
            entities = entities if error else np.asarray(part, dtype=np.int32)
        elif tags is None or tags.dim != dimension:
            error = f"is a value of tags: give {tags_name}"
        elif not compat.tags_belong_to(tags, self.mesh):
            error = f"{tags_name} belong to another mesh than that of the shell"
        else:
            entities = np.asarray(tags.find(part))
        # all ranks raise the first error together
        if first_error := next(filter(None, self.comm.allgather(error)), ""):
            raise MeshError(
                f"{key}: {part}: {first_error}" if by_value else f"{key}: {first_error}"
            )
        # a value must be that of an entity on some rank; the message names the values there are
        values = [] if tags is None else np.unique(tags.values)
        values_of_ranks = self.comm.allgather(values)
        allowed = sorted({int(value) for of_rank in values_of_ranks for value in of_rank})
        if not self.comm.allreduce(len(entities)) and by_value:
            raise MeshError(
                f"{key}: {part}: {tags_name} have no such value, "
                f"only {', '.join(map(str, allowed)) or 'none'}"
            )
        return entities

    def _error_of_numbers(self, numbers: NDArray[Any], dimension: int, entities_name: str) -> str:
        """Return what is wrong with local numbers of facets or cells; "" if they are right."""
        self.mesh.topology.create_entities(dimension)
        entities = self.mesh.topology.index_map(dimension)
        count = entities.size_local + entities.num_ghosts
        holds_no_integers = numbers.size > 0 and numbers.dtype.kind not in "iu"
        if numbers.ndim != 1 or holds_no_integers:
            hint = ": np.flatnonzero(...) of a mask" if numbers.dtype.kind == "b" else ""
            return (
                f"is neither a value of tags nor a list of local numbers of {entities_name}{hint}"
            )
        numbers_outside = numbers[(numbers < 0) | (numbers >= count)]
        if not len(numbers_outside):
            return ""
        return f"{numbers_outside[0]}: this process has {entities_name} 0 to {count - 1}"

    def _vertex_pairs(self, facets: NDArray[np.int32]) -> Pairs:
        """Return global vertex numbers (e, 2) of facets of all ranks, each once; collective."""
        topology = self.mesh.topology
        # 1 facets, 2 cells, 0 vertices: what `entities_to_geometry` needs
        for dimensions in ((1, 2), (1, 0), (2, 1)):
            topology.create_connectivity(*dimensions)
        ends = np.empty((0, 2), np.int32)
        if len(facets):  # dolfinx takes no empty list
            ends = mesh.entities_to_geometry(self.mesh, 1, facets)[:, :2]
        numbers = self.mesh.geometry.index_map().local_to_global(
            np.asarray(ends, dtype=np.int32).ravel()
        )
        pairs = np.concatenate(
            self.comm.allgather(np.asarray(numbers, dtype=np.int64).reshape(-1, 2))
        )
        return np.asarray(np.unique(np.sort(pairs, axis=1), axis=0))

    def _cell_mask(self, local_cells: NDArray[np.int32], count: int) -> NDArray[np.bool_]:
        """Return whether each cell (count,) is in the list of any rank; collective."""
        mask = np.zeros(count, dtype=bool)
        for numbers in self.comm.allgather(self._numbers[local_cells]):
            mask[numbers] = True
        return mask


def _finite(values: Array, name: str) -> Array:
    """Return values unchanged, if all are numbers.

    Raises
    ------
    MeshError
        If one is not; `name` begins the message.
    """
    if not np.isfinite(values).all():
        raise MeshError(f"{name}: has values that are not numbers")
    return values


def lagrange_element(degree: int) -> basix.finite_element.FiniteElement:
    """Return the element at whose nodes a `UserField` of a degree has its values."""
    variant = basix.LagrangeVariant.gll_warped
    return basix.create_element(
        basix.ElementFamily.P, TRIANGLE, degree, variant, discontinuous=True
    )


def swapped_nodes(element: basix.finite_element.FiniteElement) -> Numbers:
    """Return the number of each node (nodes,) with the second and the third vertex exchanged.

    This exchanges the two coordinates of the reference triangle.
    """
    distances = np.linalg.norm(element.points[:, None, ::-1] - element.points[None], axis=2)
    return np.asarray(np.argmin(distances, axis=1))

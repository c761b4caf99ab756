"""A dolfinx mesh of triangles in space as a program gives it: its triangles, the fields on it,
displacements for it.

Every rank has all triangles, in the order in which they were made, whatever the number of ranks:
they are few. A scene has a mesh of its own, distributed in its own way; fields go there and
displacements come back cell by cell.
"""

from collections.abc import Mapping
from typing import Any

import basix
import numpy as np
from dolfinx import fem, mesh
from dolfinx.cpp.io import perm_gmsh
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import GivenField, MeshError, Pairs, Triangles
from magshell_fenicsx.platform import compat

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
TRIANGLE, NODES = basix.CellType.triangle, {1: 3, 2: 6, 3: 10}  # nodes of a triangle by its order
Part = int | NDArray[np.int32]  # a value of tags, or local numbers of facets or cells


class Home:
    """A mesh to which fields belong and for which displacements are made; all methods are
    collective.

    Parameters
    ----------
    domain
        Triangles of order 1 to 3 in space.

    Raises
    ------
    MeshError
        If it is of another kind.
    """

    def __init__(self, domain: mesh.Mesh) -> None:
        self.mesh, self.comm = domain, domain.comm
        kind, dimension = domain.topology.cell_name(), domain.geometry.dim
        if kind != "triangle":
            raise MeshError(f"mesh: its cells are of the kind {kind}; a mid-surface has triangles")
        if dimension != 3:
            raise MeshError(
                f"mesh: its nodes have {dimension} coordinates; a mid-surface is in space: gdim=3"
            )
        self._element = domain.ufl_domain().ufl_coordinate_element().basix_element
        if (order := self._element.degree) not in NODES:
            raise MeshError(f"mesh: its triangles are of order {order}; allowed are 1, 2 and 3")
        cells = domain.topology.index_map(2)
        self._owned = cells.size_local
        self._numbers = self._original(cells)
        self._spaces: dict[int, fem.FunctionSpace] = {}

    def triangles(
        self,
        edges: Mapping[str, Part],
        patches: Mapping[str, Part],
        facet_tags: mesh.MeshTags | None = None,
        cell_tags: mesh.MeshTags | None = None,
    ) -> Triangles:
        """Its triangles with named edges and patches, each a value of the tags or local facets or
        cells.

        Raises
        ------
        MeshError
            On every rank, if tags are missing or have no such value.
        """
        nodes, ids = self._places()
        cells = self._gathered(ids)
        used, first, again = np.unique(cells, return_index=True, return_inverse=True)
        order = np.argsort(first)  # nodes in the order of the cells, too
        number = np.empty(len(used), dtype=np.int64)
        number[order] = np.arange(len(used))
        given = self._gathered(nodes).reshape(-1, 3)[first[order]]
        pairs = {
            name: self._ends(self._chosen(f"edges.{name}", part, facet_tags, 1))
            for name, part in edges.items()
        }
        inside = {
            name: self._chosen(f"patches.{name}", part, cell_tags, 2)
            for name, part in patches.items()
        }
        return Triangles(
            given,
            number[again].reshape(cells.shape),
            {name: number[np.searchsorted(used, ends)] for name, ends in pairs.items()},
            {name: self._among(cells_in, len(cells)) for name, cells_in in inside.items()},
            self,
        )

    def field(self, function: fem.Function, name: str) -> GivenField:
        """A function on this mesh, polynomials in each triangle.

        Raises
        ------
        MeshError
            If it is on another mesh, or is none of these.
        """
        V = function.function_space
        if V.mesh._cpp_object is not self.mesh._cpp_object:
            raise MeshError(f"{name}: is a function on another mesh than that of the shell")
        family = getattr(V.ufl_element(), "element_family", None)
        if family != basix.ElementFamily.P or len(function.ufl_shape) > 1:
            raise MeshError(
                f"{name}: is a function of {V.ufl_element()}; allowed are Lagrange and DG, scalars or vectors: "
                "interpolate it into such a space"
            )
        element = V.element.basix_element
        nodes = stored(element.degree)
        table = element.tabulate(0, nodes.points)[0, :, :, 0]
        values = function.x.array.reshape(-1, V.dofmap.bs)[V.dofmap.list[: self._owned]]
        nodal = self._gathered(np.matmul(table, np.asarray(values, dtype=float)))
        if not np.isfinite(nodal).all():
            raise MeshError(f"{name}: has values that are not numbers")
        return GivenField(name, element.degree, nodal, swapped(nodes), self)

    def displacement(self, u: fem.Function, given: Numbers, scale: float) -> fem.Function:
        """A field of a scene as a function on this mesh.

        Parameters
        ----------
        u
            A vector Lagrange function on the scene's mesh.
        given
            Its cells as `PatchMesh.given` tells them, ghosts perhaps included.
        scale
            What its values are divided by.
        """
        V = u.function_space
        degree, owned = V.element.basix_element.degree, V.mesh.topology.index_map(2).size_local
        nodal = u.x.array.reshape(-1, 3)[V.dofmap.list[:owned]] / scale
        number, turned = given[:owned].T
        nodal = np.where(
            turned[:, None, None] == 1, nodal[:, swapped(V.element.basix_element)], nodal
        )
        whole = np.zeros((self.mesh.topology.index_map(2).size_global, *nodal.shape[1:]))
        for numbers, values in self.comm.allgather((number, nodal)):
            whole[numbers] = values
        W = self._spaces.get(degree) or fem.functionspace(self.mesh, ("Lagrange", degree, (3,)))
        self._spaces[degree] = W
        displacement = fem.Function(W, name="u")
        displacement.x.array.reshape(-1, 3)[W.dofmap.list] = whole[self._numbers]
        return displacement

    def _original(self, cells: Any) -> Numbers:
        """The number of each local cell, ghosts included, in the order in which all were made."""
        local = cells.size_local + cells.num_ghosts
        made = compat.original_cells(self.mesh)[:local]
        every = np.concatenate(self.comm.allgather(made[: self._owned]))
        if (
            len(every) == cells.size_global
            and (np.sort(every) == np.arange(cells.size_global)).all()
        ):
            return made
        return np.asarray(
            cells.local_to_global(np.arange(local, dtype=np.int32))
        )  # a part of another mesh

    def _gathered(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values of this rank's own cells, of all ranks in their order."""
        parts = self.comm.allgather((self._numbers[: self._owned], values))
        numbers, all_values = (np.concatenate(each) for each in zip(*parts, strict=True))
        return np.asarray(all_values[np.argsort(numbers)])

    def _places(self) -> tuple[Array, Numbers]:
        """Coordinates (cells, nodes, 3) and global numbers of the nodes of this rank's own cells,
        in gmsh's order.
        """
        geometry, dofs = self.mesh.geometry, compat.corner_numbers(self.mesh)[: self._owned]
        x = geometry.x[dofs]
        if self._element.lagrange_variant != basix.LagrangeVariant.equispaced:
            degree = self._element.degree
            even = basix.create_element(
                basix.ElementFamily.P, TRIANGLE, degree, basix.LagrangeVariant.equispaced
            )
            x = np.matmul(self._element.tabulate(0, even.points)[0, :, :, 0], x)
        ids = (
            geometry.index_map().local_to_global(dofs.ravel().astype(np.int32)).reshape(dofs.shape)
        )
        order = np.argsort(perm_gmsh(mesh.CellType.triangle, dofs.shape[1]))
        return np.asarray(x[:, order]), np.asarray(ids[:, order])

    def _chosen(
        self, key: str, part: Part, tags: mesh.MeshTags | None, dimension: int
    ) -> NDArray[np.int32]:
        """Local facets or cells.

        Raises
        ------
        MeshError
            On every rank, if there are none on any, or what one rank has is of no part of this
            mesh.
        """
        what, named = ("facet_tags", "facets") if dimension == 1 else ("cell_tags", "cells")
        chosen: NDArray[np.int32] = np.empty(0, dtype=np.int32)
        said = ""
        by_value = isinstance(part, int | np.integer)
        if not by_value:
            said = self._strange(np.asarray(part), dimension, named)
            chosen = chosen if said else np.asarray(part, dtype=np.int32)
        elif tags is None or tags.dim != dimension:
            said = f"is a value of tags: give {what}"
        elif not compat.tags_of(tags, self.mesh):
            said = f"{what} belong to another mesh than that of the shell"
        else:
            chosen = np.asarray(tags.find(part))
        if wrong := next(filter(None, self.comm.allgather(said)), ""):
            raise MeshError(f"{key}: {part}: {wrong}" if by_value else f"{key}: {wrong}")
        values = [] if tags is None else np.unique(tags.values)
        allowed = sorted({int(value) for each in self.comm.allgather(values) for value in each})
        if not self.comm.allreduce(len(chosen)) and by_value:
            raise MeshError(
                f"{key}: {part}: {what} have no such value, only {', '.join(map(str, allowed)) or 'none'}"
            )
        return chosen

    def _strange(self, numbers: NDArray[Any], dimension: int, named: str) -> str:
        """What is wrong with local numbers of facets or cells on this rank; empty if nothing is."""
        self.mesh.topology.create_entities(dimension)
        entities = self.mesh.topology.index_map(dimension)
        count = entities.size_local + entities.num_ghosts
        if numbers.ndim != 1 or (len(numbers) and numbers.dtype.kind not in "iu"):
            hint = ": np.flatnonzero(...) of a mask" if numbers.dtype.kind == "b" else ""
            return f"is neither a value of tags nor a list of local numbers of {named}{hint}"
        outside = numbers[(numbers < 0) | (numbers >= count)]
        return f"{outside[0]}: this process has {named} 0 to {count - 1}" if len(outside) else ""

    def _ends(self, facets: NDArray[np.int32]) -> Pairs:
        """Global numbers (e, 2) of the vertices of facets of all ranks."""
        topology = self.mesh.topology
        for dimensions in ((1, 2), (1, 0), (2, 1)):
            topology.create_connectivity(*dimensions)
        ends = (
            mesh.entities_to_geometry(self.mesh, 1, facets)[:, :2]
            if len(facets)
            else np.empty((0, 2), np.int32)
        )
        numbers = self.mesh.geometry.index_map().local_to_global(
            np.asarray(ends, dtype=np.int32).ravel()
        )
        pairs = np.concatenate(
            self.comm.allgather(np.asarray(numbers, dtype=np.int64).reshape(-1, 2))
        )
        return np.asarray(np.unique(np.sort(pairs, axis=1), axis=0))

    def _among(self, cells: NDArray[np.int32], count: int) -> NDArray[np.bool_]:
        """Whether each cell of all ranks is among these local ones."""
        among = np.zeros(count, dtype=bool)
        for numbers in self.comm.allgather(self._numbers[cells]):
            among[numbers] = True
        return among


def stored(degree: int) -> basix.finite_element.FiniteElement:
    """The element at whose nodes a `GivenField` of a degree has its values."""
    variant = basix.LagrangeVariant.gll_warped
    return basix.create_element(
        basix.ElementFamily.P, TRIANGLE, degree, variant, discontinuous=True
    )


def swapped(element: basix.finite_element.FiniteElement) -> Numbers:
    """The number of each node with the second and the third vertex exchanged."""
    apart = np.linalg.norm(element.points[:, None, ::-1] - element.points[None], axis=2)
    return np.asarray(np.argmin(apart, axis=1))

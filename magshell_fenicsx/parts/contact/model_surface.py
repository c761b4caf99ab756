"""The contacts of a model: from its mid-surface on each rank to the cells that contacts search.

In goes the mid-surface as a model has it (`ModelSurface`), out come the terms of all pairs of a
case (`surface_contacts`). The cells are gathered on all ranks, and those of a half or a sector are
copied until they make the whole. See `surface_contact` for the energy, and docs/theory.md, Contact.

Images or copies are the modelled half or sector and what its symmetry makes of it. The sides of a
pair are the cells of its two members. A shell that keeps its volume gets thinner as its area grows.
Growth is the natural stretch, an amplitude; the natural shape is what a shell would have without
stress. J0 is the undeformed area at a node. Nodes are those of the placement's element; ghosts are
cells of other ranks at the border of this one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from dolfinx import fem, mesh
from numpy.typing import NDArray

from magshell_fenicsx.assembly.free_parameters import SettableNumber
from magshell_fenicsx.assembly.global_mesh import GlobalCells, gather_rows, global_values
from magshell_fenicsx.mesh.mirror import Image, Mirror
from magshell_fenicsx.parts.contact.contact_section import WHOLE_SHELL, Pair
from magshell_fenicsx.parts.contact.face_offsets import FaceOffsets
from magshell_fenicsx.parts.contact.field_derivatives import ContactFields
from magshell_fenicsx.parts.contact.projection import Cells, Longs
from magshell_fenicsx.parts.contact.segments import Segments
from magshell_fenicsx.parts.contact.surface_contact import SurfaceContact, SurfaceContactGeometry
from magshell_fenicsx.parts.contact.symmetry_images import ContactWithImages, Images
from magshell_fenicsx.parts.gap import GrownSurface

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class ModelSurface:
    """The mid-surface of a model on this rank, as contact needs it.

    Attributes
    ----------
    r0, u
        Undeformed placement and displacement over R, in one space.
    patches
        Name of a patch -> whether each cell of this rank, ghosts included, belongs to it.
    h
        Thickness over R; where it varies, that of the first shell.
    degree
        Degree of the quadrature.
    thickness
        Factor of h, (1,) per node; None for 1.
    thins
        (cells, 1) or one number for all: 1 in cells whose thickness follows from their area, as of
        rubber, else 0.
    images
        For a half or a sector: the copies that make the whole, itself first. Empty for a whole.
    facets_on_planes
        For a half or a sector: the facets of this rank on each of its planes of symmetry.
    natural
        The natural shape; None if it is the undeformed one.
    planes
        The planes of symmetry.
    """

    r0: fem.Function
    u: fem.Function
    patches: Mapping[str, Flags]
    h: float
    degree: int
    thickness: fem.Function | None = None
    thins: Array | int = 0
    images: Sequence[Image] = ()
    facets_on_planes: Sequence[NDArray[np.int32]] = ()
    natural: GrownSurface | None = None
    planes: Sequence[Mirror] = ()

    @property
    def space(self) -> fem.FunctionSpace:
        """The space of the placement and the displacement."""
        return self.r0.function_space

    @property
    def topology(self) -> mesh.Topology:
        """The topology of the mesh."""
        return self.space.mesh.topology

    @cached_property
    def own_nodes(self) -> Longs:
        """(own cells, functions): local numbers of the nodes of this rank's own cells."""
        return np.asarray(self.space.dofmap.list[: self.topology.index_map(2).size_local])

    @cached_property
    def keeps_volume(self) -> Flags:
        """(local cells,): whether the thickness of each cell follows from its area."""
        index_map = self.topology.index_map(2)
        count = index_map.size_local + index_map.num_ghosts
        return np.broadcast_to(np.asarray(self.thins) > 0, (count, 1))[:, 0]

    @property
    def grows(self) -> bool:
        """Whether the volume depends on an amplitude, the natural stretch."""
        return self.natural is not None and self.natural.stretch is not None

    @property
    def volume_factors(self) -> Array:
        """The volume over h J0 at nodes, (powers, own cells, functions), by powers of the growth.

        Where nothing grows there is one power: the factor of the thickness.
        """
        factor = np.ones(self.own_nodes.shape)
        if self.thickness is not None:
            dofs = self.thickness.function_space.dofmap.list[: len(factor)]
            factor = self.thickness.x.array[dofs]
        if not (self.natural and self.grows):
            return np.array([factor])
        # (2, local cells, nodes, 3): undeformed tangents at the nodes of cells, by the derivatives
        # of shape functions there
        V = self.space
        element = V.element.basix_element
        slopes = element.tabulate(1, element.points)[1:, ..., 0]
        nodal = self.r0.x.array.reshape(-1, 3)[V.dofmap.list]
        tangents = np.einsum("dqk,nki->dnqi", slopes, nodal)
        # volumes of the natural shape over J0, by powers of the growth from 0 to 3
        coefficients = self.natural.volume_coefficients(tangents, element.points)
        # elsewhere the volume does not grow: 1, and zero for the three higher powers
        coefficients[:, ~self.keeps_volume] = np.eye(4)[0][:, None, None]
        return np.asarray(factor * coefficients[:, : len(factor)])  # of own cells, which come first


@dataclass(frozen=True)
class _AllCells:
    """The cells of all ranks that contacts search, with the values in each cell.

    Attributes
    ----------
    cells
        The cells with their element and nodes.
    r0
        (nodes, 3) undeformed places over R.
    same_place
        (nodes,) for each node the first node at its place.
    volume_factors, keeps_volume
        See `ModelSurface`.
    patches
        Name of a patch -> whether each cell belongs to it; `WHOLE_SHELL` has all cells.
    images
        The copies among the cells; None without symmetry.
    """

    cells: Cells
    r0: Array
    same_place: Longs
    volume_factors: Array
    keeps_volume: Flags
    patches: Mapping[str, Flags]
    images: Images | None = field(default=None)

    @classmethod
    def gather(cls, surface: ModelSurface, global_cells: GlobalCells) -> "_AllCells":
        """Return the cells of all ranks, without images; collective."""
        topology, count = surface.topology, len(global_cells.own_range)  # own cells come first
        own_corners = topology.connectivity(2, 0).array[: 3 * count].astype(np.int32)
        corners = topology.index_map(0).local_to_global(own_corners).reshape(-1, 3)
        element = surface.space.element.basix_element
        cells = Cells(element, global_cells.nodes, global_cells.gather_values(corners))
        r0 = global_values(surface.r0)
        factors = [
            global_cells.gather_values(factors_of_power)
            for factors_of_power in surface.volume_factors
        ]
        patches = {
            name: global_cells.gather_values(is_inside)
            for name, is_inside in surface.patches.items()
        }
        patches[WHOLE_SHELL] = np.ones(len(cells.nodes), dtype=bool)
        keeps_volume = global_cells.gather_values(surface.keeps_volume)
        same_place = np.arange(len(r0))  # without images each node is alone at its place
        return cls(cells, r0, same_place, np.array(factors), keeps_volume, patches)

    def with_images(self, surface: ModelSurface) -> "_AllCells":
        """Return the cells of all copies of a half or a sector; collective.

        The copies share vertices on planes of symmetry, and nodes there count as one place.
        """
        images, facets = Images(surface.images, len(self.r0)), surface.facets_on_planes
        # global numbers of nodes and vertices on planes of symmetry
        nodes = _nodes_of_facets(surface.space, facets)
        vertices = _vertices_of_facets(surface.topology, facets)
        return replace(
            self,
            cells=images.cells(self.cells, self.r0, vertices),
            r0=images.places(self.r0),
            same_place=images.shared_numbers(self.r0, nodes).ravel(),
            volume_factors=np.array(
                [images.repeat(factors_of_power) for factors_of_power in self.volume_factors]
            ),
            keeps_volume=images.repeat(self.keeps_volume),
            patches={name: images.repeat(is_inside) for name, is_inside in self.patches.items()},
            images=images,
        )


def surface_contacts(pairs: Sequence[Pair], surface: ModelSurface) -> list[SurfaceContact]:
    """Return the contacts of pairs on a mid-surface; collective.

    Parameters
    ----------
    pairs
        Pairs of shells or patches that may touch.

    Raises
    ------
    MeshError
        On every rank, if the surfaces of a pair overlap undeformed.
    """
    if not pairs:
        return []
    # vertices of cells, cells of vertices, and vertices of edges, which the gathering below needs
    for dims in ((2, 0), (0, 2), (1, 0)):
        surface.topology.create_connectivity(*dims)
    global_cells, index_map = GlobalCells.gather(surface.space), surface.space.dofmap.index_map
    all_cells = _AllCells.gather(surface, global_cells)
    # number of this rank's first degree of freedom, and how many it has
    first_node, _ = index_map.local_range
    own_dofs = 3 * first_node, 3 * index_map.size_local
    if surface.images:
        all_cells = all_cells.with_images(surface)
    geometry = _contact_geometry(surface, global_cells, all_cells, own_dofs)
    contacts = list[SurfaceContact]()
    for pair in pairs:
        sides = all_cells.patches[pair.names[0]], all_cells.patches[pair.names[1]]
        contact = (
            ContactWithImages(all_cells.images, own_dofs, pair, geometry, sides)
            if all_cells.images
            else SurfaceContact(pair, geometry, sides)
        )
        contact.refuse_overlap()
        contacts.append(contact)
    return contacts


def _contact_geometry(
    surface: ModelSurface,
    global_cells: GlobalCells,
    all_cells: _AllCells,
    own_dofs: tuple[int, int],
) -> SurfaceContactGeometry:
    """Return the cells of the model with all that the contacts of its pairs share.

    Parameters
    ----------
    own_dofs
        Number of the first degree of freedom of this rank in the model, and how many it has.
    """
    cells, r0, images = all_cells.cells, all_cells.r0, all_cells.images
    element, first_cell = surface.space.element.basix_element, global_cells.own_range.start
    if images:
        # this rank first takes the forces on all unknowns of all copies; `ContactWithImages` then
        # adds those on its own unknowns of the model
        own_dofs = 0, r0.size
    growth: SettableNumber | None = surface.natural.stretch if surface.natural else None
    offsets = None  # where the thickness is h everywhere and in all states
    if surface.thickness is not None or all_cells.keeps_volume.any():
        offsets = FaceOffsets(
            cells,
            r0,
            surface.h,
            all_cells.volume_factors,
            all_cells.keeps_volume,
            all_cells.same_place,
            growth,
        )
    # on whole cells the degree of the model's quadrature; on small parts of cells less is enough
    own_cells, degrees = np.array(global_cells.own_range), (surface.degree, element.degree)
    segments = Segments(cells, own_cells, r0, degrees, surface.h, surface.planes)
    own_rows = slice(first_cell, global_cells.own_range.stop)
    return SurfaceContactGeometry(
        cells=cells,
        r0=r0,
        u=surface.u,
        h=surface.h,
        segments=segments,
        fields=ContactFields(surface.r0, surface.thickness, global_cells.nodes, own_rows),
        offsets=offsets,
        owned_dofs=own_dofs,
        local_cells=(first_cell, len(surface.keeps_volume)),
        comm=surface.space.mesh.comm,
    )


def _nodes_of_facets(V: fem.FunctionSpace, facets: Sequence[NDArray[np.int32]]) -> Longs:
    """Return the global numbers of the nodes on facets of all ranks; collective."""
    all_facets = np.concatenate([*facets, np.empty(0, np.int32)])  # also where there are none
    local = fem.locate_dofs_topological(V, 1, all_facets, remote=False)
    numbers = V.dofmap.index_map.local_to_global(local)
    return np.asarray(np.unique(gather_rows(V.mesh.comm, numbers)))


def _vertices_of_facets(topology: mesh.Topology, facets: Sequence[NDArray[np.int32]]) -> Longs:
    """Return the global numbers of the vertices of facets of all ranks; collective."""
    vertices_of_facet = topology.connectivity(1, 0)
    local = [vertices_of_facet.links(int(facet)) for facet in np.concatenate(facets)]
    flat = np.concatenate([*local, np.empty(0, np.int32)]).astype(np.int32)
    numbers = topology.index_map(0).local_to_global(flat)
    return np.asarray(np.unique(gather_rows(topology.comm, numbers)))

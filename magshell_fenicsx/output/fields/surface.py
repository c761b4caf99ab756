"""The deformed mid-surface gathered on rank 0, for pictures and for ParaView.

A `Surface` has the nodes of the whole shell or body, and fields at the nodes. A `SurfaceGatherer`
makes it from a state of a shell model. Half shells and sectors are completed by symmetry.

- A state has the displacement u and the amplitudes mu: load parameters, by name.
- An imperfection grows if an amplitude multiplies it; its deviation w0 is the distance of the drawn
  surface from the perfect one.
- Samples are quadrature points in cells, to which smooth strains E and moments M are fitted: they
  are recovered.
- A smooth part of the surface ends where the normal or a prescribed field jumps.
- A jet is a map with its first and second derivatives by the reference coordinates, at points.
- Each rank owns some cells; fields at nodes are (cells, nodes of a cell, ...) before they are
  gathered, and (nodes, ...) on rank 0 after that. In the arrays of a rank owned cells come first,
  then ghosts.
- h and R are thickness and reference length; lengths are over R.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import basix
import basix.ufl
import numpy as np
import scipy
from dolfinx import fem, mesh
from dolfinx.cpp.io import perm_vtk
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.mesh.mirror import Mirror, Sector, rotation
from magshell_fenicsx.mesh.patch import Deviation
from magshell_fenicsx.models.shell.law import Law, LawByShell
from magshell_fenicsx.models.shell.spatial_fields import inside_cells
from magshell_fenicsx.output.fields.contact_peak import ContactPeak, contact_peak
from magshell_fenicsx.output.fields.point_fields import PointFields, mises_fields, rubber_fields
from magshell_fenicsx.output.fields.recovery import (
    RecoveredShell,
    components_in_space,
    smooth_parts,
    split,
)
from magshell_fenicsx.shape.drawn_bodies import Solid
from magshell_fenicsx.shells.stress_resultants import StressResultants

if TYPE_CHECKING:  # one of them is built
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel

TRIANGLE, LAGRANGE_TRIANGLE, LAGRANGE_HEXAHEDRON = 5, 69, 72  # VTK's numbers of cell types
HEXAHEDRON_NODES = 27
# least degree of the quadrature rule whose points are samples of strains and moments
SAMPLE_DEGREE, SAMPLE_DEGREE_OF_LARGE_MESHES = 6, 4
LARGE_MESH = 20_000  # cells, whose recovery would take a quarter of a gigabyte with more samples
GAP = "gap_over_h"  # to the faces of bodies, and of other parts of the shell: the least in a cell
# of bodies and of parts of the shell, over E h/R; nan where cells are too wide
PRESSURE = "contact_pressure"
# auxiliary fields: whether a cell is pressed all over, the pressure of such cells, and whether
# there is a gap to a body
RESOLVED, RESOLVED_PRESSURE, GAP_OPEN = "evenly_pressed", "pressure_of_even", "open"
LARGEST_CLOSED_GAP = 1e-2  # over h
SHELL = "shell"  # the number of the shell, where there are several
W0 = "w0_over_h"  # the imperfections: the deviation of the drawn surface from the perfect one
# fields of a half shell that may be symmetric or antisymmetric to its plane
FIELDS_OF_EITHER_PARITY = {"Br", "Ba", "J"}
SAME_PLACE_TOLERANCE = 1e-9  # over R: distance of nodes from each other, or from a plane
NODES_OF_FIT = 12  # nearest nodes of a linear fit
EXTENT_TOLERANCE = 1e-2  # relative extent of the nodes of a fit; smaller ones are left out
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Surface:
    """Nodes of the whole mid-surface or of a whole solid, with fields; lengths are over R.

    Attributes
    ----------
    r0, u, n0
        (n, 3) undeformed placement, displacement and undeformed unit normal of each node.
    cells
        (m, k) node numbers of triangles of the displacement's degree, or of hexahedra, in VTK's
        order.
    fields
        Name -> (n,), (n, 3) or (n, 3, 3) values at the nodes. E, M: strain and bending moment,
        tensors in space that are tangent to the undeformed surface. E_total: the strain from the
        drawn shape, where there is a natural shape. E_1, E_2, M_1, M_2: principal values of E and
        M, the larger first. w0_over_h: the imperfections, where there are some; a solid has no
        other field. Further names are those of `point_fields.PointFields`,
        `point_fields.rubber_fields` and, where stresses are wanted, `point_fields.mises_fields` and
        `StressResultants.forces_of`.
    outlines
        Places (n, 3) along lines that outline the sources of the applied field, and bodies.
    jump
        Jump of the bending moments M between cells: the rms of the samples' difference from the
        recovered field, over their rms. None for a solid.
    strain_jump
        The same measure for the strains E.
    solids
        The faces of sources and bodies.
    shells
        Names of several shells, in the order of their numbers in the field `shell`. Nodes that two
        shells share are double.
    contact_peak
        Largest pressure and force per length of the contact; None without touch.
    remanence_rotates
        Whether the remanence turns with the material and does not stretch. Files of fields do not
        say it: pictures have it from the case.
    """

    r0: Array
    u: Array
    n0: Array
    cells: NDArray[np.int64]
    fields: dict[str, Array]
    outlines: tuple[Array, ...] = ()
    jump: float | None = None
    strain_jump: float | None = None
    solids: tuple[Solid, ...] = ()
    shells: tuple[str, ...] = ()
    contact_peak: ContactPeak | None = None
    remanence_rotates: bool = False

    @property
    def is_body(self) -> bool:
        """Whether the cells are hexahedra."""
        return self.cells.shape[1] == HEXAHEDRON_NODES

    @property
    def w(self) -> Array:
        """Inward normal displacement -u . n0 over R, (n,)."""
        return np.asarray(-np.einsum("ij,ij->i", self.u, self.n0))


class SurfaceGatherer:
    """Gather the displacement and the fields of one shell from all ranks, at any of its states.

    Fields that do not depend on the displacement are computed and gathered once. Strains and
    moments are recovered from samples inside the cells, in each smooth part of the surface. All
    other fields are means of the cells that share a node.
    """

    def __init__(self, model: "ShellModel") -> None:
        """Prepare the gathering for all states of a model; collective.

        `_element` has the equidistant nodes at which fields are given, at `_reference_nodes` in the
        reference triangle. `_reference_samples` are the places of samples there, with
        `_sample_weights`. `_owned_cells` is the number of this rank's cells. Rank 0 has
        `_recovered`, which fits fields to samples; on other ranks it stays None. The other fields
        are set by `_set_placement` and `_split_nodes`.
        """
        self._model = model
        domain, degree = model.V.mesh, model.degree
        self.comm = domain.comm
        # VTK's nodes are equidistant, the displacement's are not; each edge and each cell has
        # equally many nodes of both kinds
        self._element = basix.create_element(
            basix.ElementFamily.P, basix.CellType.triangle, degree, basix.LagrangeVariant.equispaced
        )
        self._reference_nodes = self._element.points
        cells = domain.topology.index_map(2)
        sample_degree = (
            SAMPLE_DEGREE if cells.size_global < LARGE_MESH else SAMPLE_DEGREE_OF_LARGE_MESHES
        )
        self._reference_samples, self._sample_weights = basix.make_quadrature(
            basix.CellType.triangle, max(sample_degree, degree)
        )
        self._owned_cells = cells.size_local
        # a space of functions numbers each node once that cells share: (cells, nodes of a cell)
        V = fem.functionspace(domain, basix.ufl.wrap_element(self._element))
        local_nodes = V.dofmap.list[: self._owned_cells]
        numbers = V.dofmap.index_map.local_to_global(local_nodes.ravel().astype(np.int32))
        numbers = numbers.reshape(local_nodes.shape)
        self._recovered: RecoveredShell | None = None
        # without displacement and amplitudes: no imperfection has grown
        undeformed = model.system.at_state(State(model.zero(), {}))
        undeformed.evaluate(lambda: self._set_placement({}, self._gather_cells(numbers)))

    def _set_placement(
        self, mu: Mapping[str, float], numbers: NDArray[np.int64] | None = None
    ) -> None:
        """Set all that depends on the undeformed placement: fields, recovery, averages; collective.

        `_fields` computes fields of a displacement at nodes, `_resultants` strains and moments at
        samples. `_to_space` maps components in tangent frames to components in space. `_constant`
        has the fields that no displacement changes. `_averaging_matrix` takes values at the nodes
        of all cells to means at the nodes of the surface. `_r0` and `_n0` are placement and unit
        normals at the nodes.

        Parameters
        ----------
        mu
            Amplitudes, those of growing imperfections among them.
        numbers
            Global node numbers (cells, nodes of a cell) of all cells; given at the first call
            alone.
        """
        model, loads = self._model, self._model.loads
        r = self._jet(model.r0, self._reference_nodes)
        r_at_samples = self._jet(model.r0, self._reference_samples)
        thickness_at_nodes = self._thickness(self._reference_nodes)
        thickness_at_samples = self._thickness(self._reference_samples)
        made_of = self._cell_materials()  # None if all cells have one material
        self._fields = PointFields(
            r,
            model.material,
            field=loads.magnetic,
            thickness=thickness_at_nodes,
            contacts=loads.contacts,
            remanence=loads.remanence,
            natural=loads.natural,
            made_of=made_of,
        )
        self._resultants = StressResultants(
            r_at_samples, model.material, thickness_at_samples, loads.natural, made_of
        )
        self._to_space = components_in_space(self._resultants.frame)
        if numbers is not None:  # at the first call: which nodes cells share never changes
            self._split_nodes(numbers, r=r[0], r_at_samples=r_at_samples[0])
        self._averaging_matrix = self._weighted_mean()
        # imperfections and shell numbers are constant fields too
        deviation = model.midsurface.deviation(
            self._reference_nodes, deviations_at(loads.growing_imperfections, mu)
        )
        if deviation is not None:
            self._fields.constant[W0] = np.asarray(
                deviation[: self._owned_cells] / model.material.h
            )
        if self._model.midsurface.shells:
            self._fields.constant[SHELL] = self._shell_numbers()
        # from the nodes of each cell to the nodes of the surface
        n0 = self._averaged(self._fields.n0)
        self._r0, self._n0 = self._averaged(r[0]), n0 / np.linalg.norm(n0, axis=-1)[..., None]
        self._constant = {
            name: self._averaged(values) for name, values in self._fields.constant.items()
        }

    def _split_nodes(self, numbers: NDArray[np.int64], r: Array, r_at_samples: Array) -> None:
        """Split the nodes of all cells between smooth parts, and set the recovery; collective.

        A smooth part ends where a prescribed field or the normal jumps. A node there gets a number
        of its own in each part. `_numbers` are the new numbers in dolfinx's order of the nodes of a
        cell, `_cells` the same in VTK's order.

        Parameters
        ----------
        numbers
            (cells, nodes of a cell) global node numbers of all cells.
        r, r_at_samples
            Placement (cells, points, 3) of this rank's cells, at the nodes and at the samples.
        """
        # gather what rank 0 needs from the cells of all ranks
        prescribed_fields = [
            self._gather_cells(field) for field in self._prescribed_fields(r) if field.size
        ]
        sample_area = self._resultants.frame.area * self._sample_weights
        r, n0, samples, weight = (
            self._gather_cells(values) for values in (r, self._fields.n0, r_at_samples, sample_area)
        )
        self._numbers = numbers
        if self.comm.rank:  # rank 0 alone recovers fields
            return
        # nodes on each side of a cell: of the element's entities of dimension 1
        sides = np.array(self._element.entity_closure_dofs[1])
        part_of_cell = smooth_parts(numbers, sides, prescribed_fields, n0)
        self._numbers = split(numbers, part_of_cell)
        to_vtk = np.argsort(perm_vtk(mesh.CellType.triangle, numbers.shape[1]))
        self._cells = self._numbers[:, to_vtk]
        shape_functions = self._element.tabulate(0, self._reference_samples)[0, :, :, 0]
        self._recovered = RecoveredShell(
            self._numbers,
            self._reference_nodes,
            nodes=r,
            normals=n0,
            samples=samples,
            weight=weight,
            table=shape_functions,
            degree=self._model.degree,
        )

    def _prescribed_fields(self, r: Array) -> list[Array]:
        """Return the fields whose jumps end a smooth part, at the nodes of this rank's cells.

        They are remanence, susceptibility, natural shape, number of the shell, number of the law of
        elasticity, and thickness; each is (cells, nodes of a cell, ...). `r` (cells, nodes of a
        cell, 3) is the placement.
        """
        loads, fields = self._model.loads, self._fields
        prescribed_fields = [fields.Br, fields.susceptibility]
        if loads.natural:
            prescribed_fields += loads.natural.tensors_at(inside_cells(r), fields.n0)
        thickness = self._thickness(self._reference_nodes)
        if self._model.midsurface.shells:
            prescribed_fields.append(self._shell_numbers())
        materials = self._cell_materials()
        if isinstance(self._model.material.law, LawByShell) and materials is not None:
            law_numbers = materials[:, None, 3]
            prescribed_fields.append(np.repeat(law_numbers, r.shape[1], axis=1))
        if thickness is not None:
            prescribed_fields.append(thickness)
        return prescribed_fields

    def gather(self, u: Vector, mu: Mapping[str, float] | None = None) -> Surface | None:
        """Return the displaced surface with its fields at the amplitudes `mu`; collective.

        Parameters
        ----------
        u
            This rank's part of the displacement.
        mu
            Amplitude -> value; contact fields are left out if there is none.

        Returns
        -------
        The surface on rank 0; None on other ranks.
        """
        state = State(u, dict(mu or {}))
        return self._model.system.at_state(state).evaluate(lambda: self._surface_at(state))

    def _surface_at(self, state: State) -> Surface | None:
        """Return the surface at the state that the model has been set to; collective.

        On rank 0; None on other ranks.
        """
        if self._model.growing:  # imperfections that amplitudes multiply move the placement
            self._set_placement(state.mu)
        # fields that are averaged between the cells at a node
        jet = self._jet(self._model.u, self._reference_nodes, order=1)
        values = self._fields.values_of(jet, state.mu)

        def at_cell_nodes(of_cells: Array) -> Array:
            """Return values (cells, nodes of a cell) of owned cells, from one of each cell."""
            return np.repeat(
                of_cells[: self._owned_cells, None], len(self._reference_nodes), axis=1
            )

        if state.mu:  # of a mode there are no amplitudes, and no contact
            add_contact(values, self._model, state, at_cell_nodes)
        mirror = self._model.mirror if self._model.multiplicity > 1 else None
        peak = contact_peak(self._model, state, mirror) if state.mu else None
        averaged = {
            name: self._averaged(values_at_cells) for name, values_at_cells in values.items()
        }
        u_at_nodes, law = self._averaged(jet[0]), self._law_at_nodes()
        # fields that are recovered from samples in cells: strains and moments
        u_at_samples = self._jet(self._model.u, self._reference_samples)
        stresses = self._resultants.values_of(u_at_samples, state.mu)
        if self._model.loads.stress:
            stresses |= self._resultants.forces_of(u_at_samples, state.mu)
        tensors = {
            name: self._gather_cells(np.einsum("...ia,...a->...i", self._to_space, S))
            for name, S in stresses.items()
        }
        if not self._recovered:  # on other ranks than 0
            return None
        recovered, jumps = self._recovered.fields(tensors, self._n0)
        recovered |= rubber_fields(recovered, law) | mises_fields(recovered)
        fields = self._constant | recovered | averaged
        # contact pressure only where the mesh resolves it
        fields = resolved_pressure(self._cells, fields)
        return Surface(
            r0=self._r0,
            u=u_at_nodes,
            n0=self._n0,
            cells=self._cells,
            fields=fields,
            jump=jumps["M"],
            strain_jump=jumps["E"],
            shells=self._model.midsurface.shells,
            contact_peak=peak,
        )

    def _shell_numbers(self) -> Array:
        """Return (cells, nodes) the number of the shell to which each owned cell belongs."""
        midsurface = self._model.midsurface
        # a mask of cells for each shell: argmax finds the number of the shell that has the cell
        in_shells = [midsurface.patches[name][: self._owned_cells] for name in midsurface.shells]
        numbers = np.argmax(in_shells, axis=0)[:, None].astype(np.float64)
        return np.repeat(numbers, len(self._reference_nodes), axis=1)

    def _gather_cells(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the values of all ranks' cells on rank 0; other ranks get their own values back.

        Collective. The first axis of the values counts the owned cells of a rank.
        """
        values_of_ranks = self.comm.gather(values)
        return values if self.comm.rank else np.concatenate(values_of_ranks)

    def _jet(self, f: fem.Function, points: Array, order: int = 2) -> Array:
        """Return f and its derivatives f,_1, f,_2, f,_11, f,_12, f,_22 in each owned cell.

        Derivatives are in reference coordinates, at the reference `points`. Shape: (6, cells,
        points, 3) for `order` 2, (3, ...) for `order` 1.
        """
        table = self._model.V.element.basix_element.tabulate(order, points)[:, :, :, 0]
        coefficients = f.x.array.reshape(-1, 3)[self._model.V.dofmap.list[: self._owned_cells]]
        return np.asarray(np.matmul(table[:, None], coefficients))

    def _thickness(self, points: Array) -> Array | None:
        """Return h(x)/h (cells, points) at reference points of each owned cell; None if uniform."""
        factor = self._model.thickness
        if factor is None:
            return None
        V = factor.function_space
        values = V.element.basix_element.tabulate(0, points)[0, :, :, 0]
        return np.asarray(factor.x.array[V.dofmap.list[: self._owned_cells]] @ values.T)

    def _cell_materials(self) -> Array | None:
        """Return the material (cells, 4) of each owned cell; None if the shell has one material.

        The four numbers are modulus over that of the first shell, Poisson's ratio, density ratio
        and number of the law of elasticity.
        """
        materials = self._model.cell_materials
        if materials is None:
            return None
        cell_dofs = materials.function_space.dofmap.list[: self._owned_cells, 0]
        return np.asarray(materials.x.array.reshape(-1, 4)[cell_dofs])

    def _law_at_nodes(self) -> Law:
        """Return the law of elasticity at the nodes; collective.

        Where shells have materials of their own, it holds arrays (nodes,), which are right on rank
        0 only.
        """
        materials, law = self._cell_materials(), self._model.material.law
        if materials is None:
            return law
        count = len(self._reference_nodes)
        modulus, nu, _, law_number = (
            self._averaged(np.repeat(values[:, None], count, axis=1)) for values in materials.T
        )
        return law.with_material(modulus, nu, law_number)

    def _weighted_mean(self) -> "scipy.sparse.csr_matrix | None":
        """Return the sparse matrix of the area-weighted mean over the cells that share a node.

        Its rows are nodes and its columns the nodes of all cells, cell after cell. On rank 0; None
        on other ranks. Collective.
        """
        weights = self._gather_cells(self._fields.weight).ravel()
        if self.comm.rank:
            return None
        node_numbers = self._numbers.ravel()
        # area of each cell at a node over the area of all cells there
        share = weights / np.bincount(node_numbers, weights)[node_numbers]
        return scipy.sparse.csr_matrix((share, (node_numbers, np.arange(len(node_numbers)))))

    def _averaged(self, values: Array) -> Array:
        """Return the area-weighted mean over the cells that share a node; collective.

        `values` (cells, nodes of a cell, ...) are those of owned cells. Rank 0 gets (nodes, ...);
        other ranks get `values` back.
        """
        values_of_all, matrix = self._gather_cells(values), self._averaging_matrix
        if matrix is None:
            return values
        averaged = np.asarray(matrix @ values_of_all.reshape(matrix.shape[1], -1))
        return averaged.reshape(-1, *values.shape[2:])


def add_contact(
    values: dict[str, Array],
    model: "ShellModel | MeridianModel",
    state: State,
    at_nodes: Callable[[Array], Array],
) -> None:
    """Add contact pressure and gap between shells to fields at the nodes of cells; collective.

    Besides the pressure it adds what `resolved_pressure` takes out again: `RESOLVED`, one in a cell
    that is in contact all over; `RESOLVED_PRESSURE`, the pressure of such a cell; `GAP_OPEN`, one
    where there is a gap to a body.

    Parameters
    ----------
    values
        Name -> (cells, nodes of a cell). The gap to bodies is there already, over h.
    model, state
        The model, which computes the pressure and the gap of each cell at the state.
    at_nodes
        Function from a value of each local cell to (cells, nodes of a cell).
    """
    pressure = model.cell_pressures(state)  # None without contact
    if pressure is not None:
        resolved = at_nodes(model.cells_evenly_pressed(state).astype(np.float64))
        gap_to_bodies = values.get(GAP, np.zeros(resolved.shape))
        values[PRESSURE] = at_nodes(pressure)
        values[RESOLVED] = resolved
        values[RESOLVED_PRESSURE] = values[PRESSURE] * resolved
        values[GAP_OPEN] = np.where(gap_to_bodies > LARGEST_CLOSED_GAP, 1.0, 0.0)
    gap = model.cell_gaps(state)
    if gap is not None:
        gap_of_shells = at_nodes(gap) / model.material.h
        values[GAP] = np.minimum(values.get(GAP, np.inf), gap_of_shells)


def resolved_pressure(cells: NDArray[np.int64], fields: dict[str, Array]) -> dict[str, Array]:
    """Return the fields with the contact pressure only where the mesh resolves it.

    The mean pressure of a cell that is pressed only in part is no pressure at a point. Next to an
    evenly pressed cell, such a cell is the edge of the contact zone. At its nodes the pressure is
    zero where the gap is open, and the mean of the cells elsewhere. Away from evenly pressed cells
    a positive pressure becomes nan.

    Parameters
    ----------
    cells
        (m, k) node numbers.
    fields
        Name -> values (n,) at nodes, the means of the cells that meet there. The auxiliary fields
        that `add_contact` adds are read here and left out of the result.
    """
    if PRESSURE not in fields:
        return fields
    auxiliary = {RESOLVED, RESOLVED_PRESSURE, GAP_OPEN}
    shown_fields = {name: values for name, values in fields.items() if name not in auxiliary}
    # a node is in the zone if one of its cells is evenly pressed
    in_zone = fields[RESOLVED] > 0
    # the edge of the zone: the other nodes of cells that touch the zone
    touches_zone = in_zone[cells].any(axis=1)
    in_zone_or_edge = in_zone.copy()
    in_zone_or_edge[cells[touches_zone]] = True
    # the mean over evenly pressed cells alone: both fields are means over all cells at the node
    pressure_in_zone = fields[RESOLVED_PRESSURE] / np.where(in_zone, fields[RESOLVED], 1.0)
    edge_is_open = in_zone_or_edge & (fields[GAP_OPEN] > 0)
    pressure_outside = np.where(edge_is_open, 0.0, shown_fields[PRESSURE])
    pressure = np.where(in_zone, pressure_in_zone, pressure_outside)
    shown_fields[PRESSURE] = np.where((pressure > 0) & ~in_zone_or_edge, np.nan, pressure)
    return shown_fields


def deviations_at(
    imperfections: Mapping[str, tuple[Deviation, ...]], mu: Mapping[str, float]
) -> list[Deviation]:
    """Return each growing imperfection times its amplitude.

    Parameters
    ----------
    imperfections
        Amplitude -> deviations w0 over R, functions of places (n, 3).
    mu
        Amplitude -> value; a missing one is zero.
    """

    def times(deviation: Deviation, factor: float) -> Deviation:
        """Return a deviation times a factor, as a function of places."""
        return lambda places: factor * deviation(places)

    return [
        times(deviation, mu.get(name, 0.0))
        for name, deviations in imperfections.items()
        for deviation in deviations
    ]


def rotated_surface(surface: Surface, azimuth: float) -> Surface:
    """Return the surface rotated about e3 by `azimuth` (rad), into the user's frame."""
    return _transformed(surface, rotation(azimuth))


def completed(surface: Surface, mirror: Array) -> Surface:
    """Return a half surface together with its mirror image.

    `mirror` is the plane's unit normal (3,), followed by its offset if that is not zero. Seen from
    outside, the image's triangles have the opposite orientation.
    """
    normal, offset = mirror[:3], float(mirror[3:].sum())
    image = _transformed(surface, np.eye(3) - 2 * np.outer(normal, normal))
    image = replace(image, r0=image.r0 + 2 * offset * normal)  # the plane need not pass the origin

    # magnetic fields may be antisymmetric: their image then has the opposite sign
    sign = _parity(surface, normal, offset)
    for name in FIELDS_OF_EITHER_PARITY & surface.fields.keys():
        image.fields[name] *= sign

    def with_image(values: Array, values_of_image: Array) -> Array:
        """Return the values at the nodes of the half, then those at the nodes of its image."""
        return np.concatenate([values, values_of_image])

    return Surface(
        r0=with_image(surface.r0, image.r0),
        u=with_image(surface.u, image.u),
        n0=with_image(surface.n0, image.n0),
        cells=np.concatenate([surface.cells, surface.cells + len(surface.r0)]),
        fields={name: with_image(f, image.fields[name]) for name, f in surface.fields.items()},
        outlines=surface.outlines,
        jump=surface.jump,
        strain_jump=surface.strain_jump,
        solids=surface.solids,
        shells=surface.shells,
        contact_peak=surface.contact_peak,
        remanence_rotates=surface.remanence_rotates,
    )


def completed_by_symmetry(surface: Surface, mirror: Mirror) -> Surface:
    """Return the surface of the whole shell from that of its modelled half or sector."""
    surface_and_image = completed(surface, mirror.plane)
    if not isinstance(mirror, Sector):
        return surface_and_image
    # the sector and its mirror image are copied around the axis. Those images of the symmetry that
    # have a positive sign are rotations about e3, the identity among them
    turns = [image.Q.T for image in mirror.images if image.sign > 0]
    copies = [_transformed(surface_and_image, Q) for Q in turns]
    count = len(surface_and_image.r0)

    def of_all_copies(values_of: Callable[[Surface], Array]) -> Array:
        """Return the values that a function takes from a surface, of one copy after the other."""
        return np.concatenate([values_of(copy) for copy in copies])

    def field_of_all_copies(name: str) -> Array:
        """Return the values of a field of one copy after the other."""
        return of_all_copies(lambda s: s.fields[name])

    return replace(
        surface_and_image,
        r0=of_all_copies(lambda s: s.r0),
        u=of_all_copies(lambda s: s.u),
        n0=of_all_copies(lambda s: s.n0),
        cells=np.concatenate([surface_and_image.cells + k * count for k in range(len(copies))]),
        fields={name: field_of_all_copies(name) for name in surface_and_image.fields},
    )


def on_nodes_of(surface: Surface, target: Surface) -> Surface:
    """Return the surface with displacement and fields at the nodes of another mesh of the shell.

    Around each node of `target` a linear function is fitted to the nearest nodes of `surface`; its
    value at the node is the result. Errors are of second order in the distance of these nodes. If
    both meshes are the same, `surface` itself is returned.
    """
    has_same_nodes = (
        surface.r0.shape == target.r0.shape
        and np.abs(surface.r0 - target.r0).max() < SAME_PLACE_TOLERANCE
    )
    if has_same_nodes:
        return surface
    distance, nearest_nodes = scipy.spatial.cKDTree(surface.r0).query(target.r0, NODES_OF_FIT)
    offsets = surface.r0[nearest_nodes] - target.r0[:, None]
    reach = np.maximum(distance.max(axis=1), SAME_PLACE_TOLERANCE)[:, None]
    # from one at the target to exp(-4) at the farthest of these nodes
    weight = np.exp(-((2 * distance / reach) ** 2))[..., None]
    # the functions 1, x, y, z at the nearest nodes, for each target node
    ones = np.ones((*nearest_nodes.shape, 1))
    basis = np.concatenate([ones, offsets / reach[..., None]], axis=2)
    # row 0 of the pseudo-inverse gives the fit's constant, its value at the target node
    fit = np.linalg.pinv(weight * basis, rcond=EXTENT_TOLERANCE)
    interpolation = fit[:, 0] * weight[..., 0]  # (target nodes, nearest nodes) factors of values

    def interpolated(f: Array) -> Array:
        """Return values at the target nodes, from values f (n, ...) at the nodes of the surface."""
        return np.asarray(np.einsum("nk,nk...->n...", interpolation, f[nearest_nodes]))

    fields = {name: interpolated(f) for name, f in surface.fields.items()}
    return replace(
        surface,
        r0=target.r0,
        u=interpolated(surface.u),
        n0=target.n0,
        cells=target.cells,
        fields=fields,
    )


def _parity(surface: Surface, normal: Array, offset: float) -> float:
    """Return the sign of a mirror image of Br and Ba: 1 if it continues them, else -1.

    Both fields have the same sign. It follows from the nodes at the plane: from the applied field
    Ba there; where Ba is missing or zero, from the remanence Br. The sign is 1 if the vectors at
    the plane are mostly tangential to it, and -1 if they are mostly normal. It is 1 too if their
    length varies much along the plane, or if both fields are zero there.

    Parameters
    ----------
    surface
        The modelled half.
    normal, offset
        The plane is normal . x = offset, over R.
    """
    on_plane = np.abs(surface.r0 @ normal - offset) < SAME_PLACE_TOLERANCE
    for name in ("Ba", "Br"):
        vectors = surface.fields.get(name, np.zeros((len(on_plane), 3)))[on_plane]
        magnitude = np.nan_to_num(np.linalg.norm(vectors, axis=1))
        if magnitude.max(initial=0.0) > 0:  # the first of the two fields that is there
            jumps = magnitude.min() < magnitude.max() / 2
            # a tangential vector equals its image, a normal one is the opposite of its image
            normal_part = np.nansum((vectors @ normal) ** 2)
            is_tangential = 2 * normal_part <= np.sum(magnitude**2)
            return 1.0 if jumps or is_tangential else -1.0
    return 1.0


def _transformed(surface: Surface, Q: Array) -> Surface:
    """Return a surface with vectors v -> v Q, row by row, and tensors T -> Q^T T Q.

    Places, displacements, normals, fields, outlines and solids are transformed.
    """

    def transformed(f: Array) -> Array:
        """Return scalars (n,) unchanged, vectors (n, 3) and tensors (n, 3, 3) transformed."""
        if f.ndim == 1:
            return f
        return f @ Q if f.ndim == 2 else Q.T @ f @ Q

    fields = {name: transformed(f) for name, f in surface.fields.items()}
    lines = tuple(line @ Q for line in surface.outlines)
    solids = tuple(solid.transformed(Q.T, np.zeros(3)) for solid in surface.solids)
    r0, u, n0 = (transformed(f) for f in (surface.r0, surface.u, surface.n0))
    return replace(surface, r0=r0, u=u, n0=n0, fields=fields, outlines=lines, solids=solids)

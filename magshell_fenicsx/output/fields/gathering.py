"""Gatherers: they collect the nodal fields of a model on rank 0, for pictures and for ParaView.

Input: the displacement u and the amplitudes mu of a state. Output: a `surface.Surface`. The
gatherer of a meridian returns the surface of revolution that the meridian sweeps, in flat
triangles.

- An amplitude is a load parameter, by name; mu maps names to values. An imperfection grows if an
  amplitude multiplies it.
- A jet is a map with its first and second derivatives at points.
- Samples are quadrature points inside cells; recovery fits smooth fields to strains and moments
  there. The jump of samples is the rms of their difference from the smooth field, over their rms.
- E and M are membrane strain and bending moment, with components 11, 12 and 22.
- w0 is the deviation of the drawn surface from the perfect one. h and R are thickness and reference
  length; lengths are over R.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import basix
import numpy as np
from dolfinx import fem, mesh
from dolfinx.cpp.io import perm_vtk
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.mesh.patch import DeviatedEmbedding
from magshell_fenicsx.models.shell.spatial_fields import inside_cells
from magshell_fenicsx.output.fields.contact_peak import contact_peak
from magshell_fenicsx.output.fields.point_fields import (
    PointFields,
    mises_fields,
    principal_fields,
    rubber_fields,
)
from magshell_fenicsx.output.fields.recovery import ROUNDING, Recovery, relative_jump, smooth_parts
from magshell_fenicsx.output.fields.surface import (
    SHELL,
    W0,
    Surface,
    SurfaceGatherer,
    add_contact,
    deviations_at,
    resolved_pressure,
)
from magshell_fenicsx.shells.revolution import ENDS, Revolution
from magshell_fenicsx.shells.stress_resultants import StressResultants

if TYPE_CHECKING:  # one of them is built
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel
    from magshell_fenicsx.shells.solid import SolidModel

Array = NDArray[np.float64]


class RevolvedGatherer:
    """Gather displacement and fields of a meridian on the surface of revolution that it sweeps.

    Every rank has the whole meridian; rank 0 of `comm` makes the surface. Strains and moments are
    recovered from samples in the cells of the meridian. Arrays have the cells in their order along
    the meridian, `swept.order`; a circle of nodes is swept by one end of a cell.
    """

    def __init__(self, model: "MeridianModel", comm: MPI.Comm) -> None:
        """Prepare the gathering for all states of a model of a meridian.

        `_inner` (q, 1) are the samples in the reference cell, and `rule` (q,) their weights.
        `_swept` is the swept surface. `_recovered` takes samples to the ends of cells. The other
        fields are set by `_set_placement`.
        """
        self.comm, self._model = comm, model
        # Gauss points: as many as a second derivative of the displacement has coefficients
        self._inner, rule = basix.make_quadrature(basix.CellType.interval, 2 * model.degree - 3)
        self._swept = Revolution(model)
        self._set_placement({})  # without amplitudes: no imperfection has grown
        # only now are kinks known: fields may jump there, so that circles of nodes become double
        if len(kinks := self._kinks()):
            self._swept = Revolution(model, kinks=kinks)
            self._set_placement({})
        self._recovered = RecoveredMeridian(self._swept, self._model, self._inner, rule)

    def _set_placement(self, mu: Mapping[str, float]) -> None:
        """Set all that depends on the undeformed placement: fields, stresses, constant parts.

        `mu` has the amplitudes of growing imperfections. "At ends" means at both ends of each cell,
        where values are shown; "at samples" is where strains and moments are computed. `_fields`
        computes fields of a displacement at ends, `_resultants` strains and moments at samples.
        `_law` is the law of elasticity at ends, `_at_ends` has the tangent frames there, and
        `_constant` the fields that no displacement changes.
        """
        model, swept, loads = self._model, self._swept, self._model.loads
        r, r_at_samples = swept.jets(model.r0), swept.inner_jets(model.r0, self._inner)
        thickness_at_ends, thickness_at_samples = (
            None if model.thickness is None else swept.scalars(model.thickness, points)
            for points in (ENDS, self._inner)
        )
        made_of = self._cell_materials()  # None if all cells have one material
        self._law = model.material.law_in(made_of)
        self._fields = PointFields(
            r,
            model.material,
            field=loads.magnetic,
            thickness=thickness_at_ends,
            contacts=loads.contacts,
            remanence=loads.remanence,
            natural=loads.natural,
            made_of=made_of,
        )
        self._resultants = StressResultants(
            r_at_samples, model.material, thickness_at_samples, loads.natural, made_of
        )
        self._at_ends = StressResultants(r, model.material, thickness_at_ends).frame
        # imperfections and shell numbers are constant fields too
        if isinstance(model.meridian.embedding, DeviatedEmbedding):
            s, embedding = model.meridian.cells.ravel(), model.meridian.embedding
            deviations = (*embedding.deviations, *deviations_at(loads.growing_imperfections, mu))
            imperfect = replace(embedding, deviations=deviations)
            # the chart is (s, 0): all around the axis the deviation is the same
            w0 = imperfect.w0(np.column_stack([s, 0 * s])) / model.material.h
            self._fields.constant[W0] = np.asarray(w0.reshape(-1, 2))
        # a mask of cells for each shell: argmax finds the number of the shell that has the cell
        if cells_in_shells := [*model.meridian.patches.values()]:
            shell_number = np.argmax(cells_in_shells, axis=0)[swept.order, None].astype(np.float64)
            self._fields.constant[SHELL] = np.asarray(np.repeat(shell_number, 2, axis=1))
        self._constant = self._swept_fields(self._fields.constant)

    def _cell_materials(self) -> Array | None:
        """Return the material (cells, 4) of each cell; None if all cells have one material.

        The four numbers are modulus over that of the first shell, Poisson's ratio, density ratio
        and number of the law of elasticity.
        """
        cell_materials = self._model.cell_materials
        if cell_materials is None:
            return None
        cell_dofs = cell_materials.function_space.dofmap.list[self._swept.order, 0]
        return np.asarray(cell_materials.x.array.reshape(-1, 4)[cell_dofs])

    def _kinks(self) -> list[int]:
        """Return the numbers of the cells before which the normal or a prescribed field jumps."""
        model, fields = self._model, self._fields
        # prescribed fields at both ends of cells: those that the case has
        prescribed_fields = [values for values in (fields.Br, fields.susceptibility) if values.size]
        if model.loads.natural:
            places = inside_cells(fields.jet[0])
            prescribed_fields += model.loads.natural.tensors_at(places, fields.n0)
        if model.thickness is not None:
            prescribed_fields.append(self._swept.scalars(model.thickness))
        sides = np.array([[0], [1]])  # a side of an interval is one of its ends
        # the number of the smooth part of each cell, which changes between cells along the meridian
        part_numbers = smooth_parts(self._swept.ends, sides, prescribed_fields, fields.n0)
        return [int(i) + 1 for i in np.flatnonzero(np.diff(part_numbers))]

    def gather(self, u: Vector, mu: Mapping[str, float] | None = None) -> Surface | None:
        """Return the displaced surface with its fields at the amplitudes `mu`.

        On rank 0; None on other ranks.
        """
        if self.comm.rank:
            return None
        state = State(u, dict(mu or {}))
        return self._model.system.at_state(state).evaluate(lambda: self._surface_at(state))

    def _surface_at(self, state: State) -> Surface:
        """Return the surface at the state that the model has been set to."""
        if self._model.growing:  # imperfections that amplitudes multiply move the placement
            self._set_placement(state.mu)
        swept = self._swept
        # strains and moments are recovered from samples, other fields are computed at ends
        u_at_samples = swept.inner_jets(self._model.u, self._inner)
        stresses = self._resultants.values_of(u_at_samples, state.mu)
        if self._model.loads.stress:
            stresses |= self._resultants.forces_of(u_at_samples, state.mu)
        # by name, "E" and "M": components at the ends, and the jump of the samples
        components, jumps = self._recovered.components(stresses)
        tensors = {name: self._at_ends.tensor(S) for name, S in components.items()}
        values = (
            tensors
            | principal_fields(components)
            | mises_fields(tensors)
            | self._fields.values_of(swept.jets(self._model.u), state.mu)
        )

        def at_both_ends(of_cells: Array) -> Array:
            """Return values (cells, 2) at the ends, from one value of each cell of the model."""
            return np.repeat(of_cells[swept.order, None], 2, axis=1)

        if state.mu:  # of a mode there are no amplitudes, and no contact
            add_contact(values, self._model, state, at_both_ends)
        values |= rubber_fields(values, self._law)
        # at the nodes of the swept surface, with contact pressure only where the mesh resolves it
        fields = resolved_pressure(swept.cells, self._constant | self._swept_fields(values))
        return Surface(
            r0=swept.r0,
            u=swept.displacement(state.u),
            n0=swept.n0,
            cells=swept.cells,
            fields=fields,
            jump=jumps["M"],
            strain_jump=jumps["E"],
            shells=self._model.meridian.shells,
            contact_peak=contact_peak(self._model, state) if state.mu else None,
        )

    def _swept_fields(self, fields: Mapping[str, Array]) -> dict[str, Array]:
        """Return fields at the nodes of the swept surface, from cell ends (cells, 2, ...).

        Where two cells share a circle of nodes, the field is their mean, weighted by area.
        """
        return {
            name: self._swept.on_parallels(values, self._fields.weight)
            for name, values in fields.items()
        }


class RecoveredMeridian:
    """Recover tensor components at the cell ends of a meridian from samples in its cells.

    Components are along and across the meridian. At a pole they are even functions of the arc
    length: the cell there is fitted together with its mirror image.

    Parameters
    ----------
    swept
        Surface of revolution, with the order of the cells.
    model
        Model of the meridian.
    inner, rule
        (q, 1) samples in the reference cell, and their weights (q,).

    The field `_recovery` fits a polynomial to the samples around each vertex. `_to_ends` and
    `_to_samples` are matrices from the coefficients of all polynomials to values at cell ends and
    at samples. `_pole_cells` are the numbers of the cells at poles, and `_weight` (cells, q) are
    the lengths that samples stand for.
    """

    def __init__(
        self, swept: Revolution, model: "MeridianModel", inner: Array, rule: Array
    ) -> None:
        """Set the recovery, and the matrices from its coefficients to cell ends and to samples.

        Here s (cells, 2) is the parameter along the meridian at the ends of cells; `ends` (cells,
        2) are the numbers of vertices there, and `vertices` is the parameter of each vertex.
        """
        s, ends, poles = model.meridian.cells, swept.ends, model.meridian.poles
        length, cells = np.diff(s), np.arange(len(s))
        samples = s[:, :1] + length * inner[:, 0]
        vertices = np.empty(ends.max() + 1)
        vertices[ends] = s
        # the cells of which one end is at a pole, and the number of this end, 0 or 1
        pole_cells, pole_end = np.nonzero(np.isclose(s[..., None], poles).any(axis=2))
        self._pole_cells = pole_cells
        pole, other_end = s[pole_cells, pole_end], s[pole_cells, 1 - pole_end]
        # each of them gets a mirror image, with one new vertex beyond the pole
        new_vertices = len(vertices) + np.arange(len(pole_cells))
        vertices = np.concatenate([vertices, 2 * pole - other_end])
        images = np.column_stack([ends[pole_cells, pole_end], new_vertices])
        samples_of_images = 2 * pole[:, None] - samples[pole_cells]
        self._recovery = Recovery(
            cells=np.concatenate([ends, images]),
            samples=np.concatenate([samples, samples_of_images])[..., None],
            weight=np.concatenate([length, length[pole_cells]]) * rule,
            vertices=vertices[:, None],
            frames=np.ones((len(vertices), 1, 1)),
            degree=model.degree,
        )
        self._weight = length * rule
        count = len(inner)
        # barycentric coordinates of the samples, by which polynomials of both ends are blended
        hats = np.column_stack([1 - inner[:, 0], inner[:, 0]])
        self._to_samples = self._recovery.evaluation_matrix(
            np.repeat(cells, count), samples.reshape(-1, 1), np.tile(hats, (len(cells), 1))
        )
        # at an end one of the two coordinates is one, the other zero
        self._to_ends = self._recovery.evaluation_matrix(
            np.repeat(cells, 2),
            vertices[ends].reshape(-1, 1),
            np.tile(np.eye(2), (len(cells), 1)),
        )

    def components(
        self, stresses: Mapping[str, Array]
    ) -> tuple[dict[str, Array], dict[str, float]]:
        """Return components at the ends of cells recovered from samples, and the samples' jumps.

        Parameters
        ----------
        stresses
            Name, such as "E" or "M" -> (cells, q, 3) components 11, 12 and 22 at the samples.

        Returns
        -------
        at_ends
            Name -> (cells, 2, 3).
        jumps
            "E" and "M" -> rms of the samples' difference from the recovered field, over their rms.
        """
        at_ends, jumps = {}, {}
        for name, S in stresses.items():
            # the mirror image of a cell at a pole has the cell's own values: the field is even
            coefficients = self._recovery.coefficients(np.concatenate([S, S[self._pole_cells]]))
            at_ends[name] = (self._to_ends @ coefficients).reshape(-1, 2, 3)
            if name in ROUNDING:  # of E and M alone, up to a size that is zero
                smooth_at_samples = (self._to_samples @ coefficients).reshape(S.shape)
                jumps[name] = relative_jump(S, smooth_at_samples, self._weight, ROUNDING[name])
        return at_ends, jumps


class BodyGatherer:
    """Gather the displacement of a solid; its field n0 is the direction of the thickness."""

    def __init__(self, model: "SolidModel") -> None:
        """Gather all that the displacement does not change; collective.

        `_cells` are the numbers of the nodes of all cells in VTK's order, `_r0` and `_n0` place and
        direction at all nodes, and `_fields` the imperfections, if there are some.
        """
        self._model, self.comm = model, model.V.mesh.comm
        V = model.V
        cells = V.dofmap.list[: V.mesh.topology.index_map(3).size_local]  # without ghosts
        local_nodes = cells.ravel().astype(np.int32)
        numbers = V.dofmap.index_map.local_to_global(local_nodes).reshape(cells.shape)
        # VTK numbers the nodes of a cell in another order than dolfinx
        to_vtk = np.argsort(perm_vtk(mesh.CellType.hexahedron, cells.shape[1]))
        self._cells = self._gather_nodes(numbers[:, to_vtk])
        self._fields: dict[str, Array] = {}
        if model.body.w0 is not None:
            owned = model.body.at_nodes(V, model.body.w0)[: V.dofmap.index_map.size_local]
            self._fields[W0] = self._gather_nodes(owned / model.material.h)
        self._r0, self._n0 = self._nodes(model.r0), self._nodes(_thickness_directions(model.r0))

    def gather(self, u: Vector, mu: Mapping[str, float] | None = None) -> Surface | None:
        """Return the displaced body with its imperfections; collective.

        On rank 0; None on other ranks. `mu` is not used here: a solid has no field that depends on
        amplitudes.
        """
        system = self._model.system
        # the first `size` numbers are the displacements of this rank's own nodes
        displacement = self._gather_nodes(system.with_ghosts(u)[: system.size].reshape(-1, 3))
        if self.comm.rank:
            return None
        return Surface(self._r0, displacement, self._n0, self._cells, self._fields)

    def _nodes(self, f: fem.Function) -> Array:
        """Return the values (n, 3) of f at the owned nodes of all ranks on rank 0; collective.

        Nodes are in global order. Other ranks get their own values.
        """
        return self._gather_nodes(f.x.array[: self._model.system.size].reshape(-1, 3))

    def _gather_nodes(self, part: NDArray[Any]) -> NDArray[Any]:
        """Return the values of all ranks, one after the other, on rank 0; collective.

        Other ranks get their own values back.
        """
        values_of_ranks = self.comm.gather(part.copy())
        return np.concatenate(values_of_ranks) if self.comm.rank == 0 else part


def _thickness_directions(r0: fem.Function) -> fem.Function:
    """Return the unit vectors along the thickness of a solid at its nodes, as a function.

    They are tangents of the third reference direction of its hexahedra.
    """
    V = r0.function_space
    element = V.element.basix_element
    # derivatives of the shape functions: 0 is the value, 3 the derivative by the third coordinate
    slopes = element.tabulate(1, element.points)[3, :, :, 0]
    tangents = np.einsum("vk,cki->cvi", slopes, r0.x.array.reshape(-1, 3)[V.dofmap.list])
    n0 = fem.Function(V)
    n0.x.array.reshape(-1, 3)[V.dofmap.list] = (
        tangents / np.linalg.norm(tangents, axis=2)[..., None]
    )
    return n0


class Gatherer(Protocol):
    """What collects displacement and fields of one model on rank 0; collective."""

    comm: MPI.Comm

    def gather(self, u: Vector, mu: Mapping[str, float] | None = None) -> Surface | None:
        """Return the displaced nodes with their fields at the amplitudes `mu`.

        On rank 0; None on other ranks. `u` is this rank's part of the displacement.
        """


def gatherer(model: "ShellModel | MeridianModel | SolidModel", comm: MPI.Comm) -> Gatherer:
    """Return the gatherer for a model of a meridian, a shell or a solid."""
    if model.axisymmetric:
        return RevolvedGatherer(model, comm)
    return SurfaceGatherer(model) if model.thin else BodyGatherer(model)

"""The axisymmetric shell as a system of terms on its meridian, and its displacement at one place.

Lengths in R, energies in E h R^2, of the whole shell. Amplitudes (load parameters, by name) as in
`ShellModel`, such as "pressure" (p/p_c) and "force" (F R/(2 pi D)).

The meridian is the profile curve, with the parameter s; several shells with one axis e3 share one
parameter. The displacement is u = (U, W) along e_rho and e_z. Ends are the boundary points of the
meridian off the axis; a condition is an end's support. A body is a shell, or several joined ones.
Waves are displacements that vary as cos(m theta) around the axis; the model itself has none. A
growing imperfection is a deviation that an amplitude scales. A lid is the surface that closes a
moving end under a live pressure. "Numbers" are the values in the forms that one problem has and
another does not; with those of another problem, the same forms serve it.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem, SystemVariables
from magshell_fenicsx.assembly.free_parameters import (
    FreeParameter,
    PlacementAmplitudes,
    SettableNumber,
    make_parameters,
)
from magshell_fenicsx.assembly.kernels import KernelLog, underived
from magshell_fenicsx.assembly.prescribed_motion import EdgePressure, Lid
from magshell_fenicsx.continuation.system import Amplitudes, State, Vector
from magshell_fenicsx.mesh.patch import Deviation, Embedding
from magshell_fenicsx.models.axisymmetric.meridian import Meridian
from magshell_fenicsx.models.domains import meridian_domain
from magshell_fenicsx.models.shell.edges import FOLD_ANGLE
from magshell_fenicsx.models.shell.parameters import Condition, Material, default_penalty
from magshell_fenicsx.models.shell.spatial_fields import cell_geometry, formula_field
from magshell_fenicsx.models.shell.thickness import Thickness, material_field, thickness_field
from magshell_fenicsx.parts.forces.meridian_loads import RevolutionIntegrals, dead_loads, pole_force
from magshell_fenicsx.parts.joints import Creases
from magshell_fenicsx.parts.loads import Loads, forces
from magshell_fenicsx.parts.magnetism.applied import field_parameters
from magshell_fenicsx.parts.natural.shape import Shape, natural_field
from magshell_fenicsx.parts.pressure.openings import (
    ends_within,
    meridian_openings,
    side_field,
    side_of,
)
from magshell_fenicsx.parts.supports.on_meridian import RigidMotions, supports
from magshell_fenicsx.parts.supports.support_motion import (
    PRESSURE,
    Support,
    enclosed,
    motions_of,
    moving,
    rotation_of,
)
from magshell_fenicsx.parts.supports.supports import NOT_HELD, held_on, unresisted
from magshell_fenicsx.platform import compat
from magshell_fenicsx.shells.energy_factory import INTERIOR, EnergyFactory
from magshell_fenicsx.shells.model_base import ThinModel
from magshell_fenicsx.shells.waves import Waves, largest_wave_number

if TYPE_CHECKING:
    from magshell_fenicsx.parts.contact.meridian_contact import MeridianContact
    from magshell_fenicsx.shells.t_junctions import MeridianTJunction

Array = NDArray[np.float64]
AXIAL_TOLERANCE = (
    1e-9  # largest axial component of a motion of length one that is a translation across the axis
)


@dataclass(frozen=True)
class Probe:
    """Interpolation of the displacement at a place, turned to the place's azimuth.

    Attributes
    ----------
    nodes, weights
        Nodes of the cell that holds the place, and its shape functions there.
    turn
        (2, 3) e_rho and e_z at the azimuth of the place.
    normal
        n0 (3,) there.
    """

    nodes: NDArray[np.int32]
    weights: Array
    turn: Array
    normal: Array

    @staticmethod
    def at_parameter(s: float, azimuth: float, r0: fem.Function) -> "Probe":
        """Return the probe at a parameter s of the meridian with placement `r0`.

        `azimuth` is in radians.
        """
        V = r0.function_space
        ends = V.mesh.geometry.x[compat.geometry_dofs(V.mesh), 0]
        # the cell that s is in, or least far out of: rounding may put s beside all cells
        cell = int(np.argmin(np.maximum(ends.min(axis=1) - s, s - ends.max(axis=1))))
        first_end, last_end = ends[cell]
        reference_place = np.array([[(s - first_end) / (last_end - first_end)]])
        tables = V.element.basix_element.tabulate(1, reference_place)
        shape_values, shape_slopes = tables[:, 0, :, 0]
        nodes = V.dofmap.list[cell]
        turn = np.array([[np.cos(azimuth), np.sin(azimuth), 0.0], [0.0, 0.0, 1.0]])
        # derivatives of the placement; the normal is the tangent turned by 90 degrees
        rho_s, z_s = shape_slopes @ r0.x.array.reshape(-1, 2)[nodes]
        normal = np.array([-z_s, rho_s]) / np.hypot(rho_s, z_s)
        return Probe(nodes, shape_values, turn, normal @ turn)

    def __call__(self, u: Vector) -> Array:
        """Return u/R (3,) at the place, from the nodal values u of (U, W)."""
        return np.asarray(self.weights @ u.reshape(-1, 2)[self.nodes] @ self.turn)

    def rows(self, size: int) -> Array:
        """Return the matrix (3, size) that gives u/R at the place from a vector u of that size."""
        matrix = np.zeros((3, size // 2, 2))
        matrix[:, self.nodes] = np.einsum("n,ki->ink", self.weights, self.turn)
        return matrix.reshape(3, size)


class MeridianModel(ThinModel):
    """A Koiter shell of revolution with axisymmetric loads; every rank holds all of it.

    Parameters
    ----------
    meridian
        Mesh of the meridian and its placement.
    degree
        Degree of displacement and placement, 2 to 5.
    conditions
        Conditions of named ends, and of a named point on the axis; other ends are free.
    loads
        A force at the pole; dead forces along e3 at the pole, on ends and areas, dead pressures and
        moments on ends; an applied field along e3, its gradient diag(a, a, b), a remanence that is
        the same along every meridian and has no component across it.
    sigma
        Penalty of the C0 interior penalty form; None takes `default_penalty`.
    thickness
        Factor of the thickness, the same along every meridian; None for 1.
    assembled
        Whether to make the system; a model that only serves its `numbers` needs none.

    Attributes
    ----------
    system
        The equations that solvers take, for u = (U, W) along e_rho and e_z.
    multiplicity
        1: the model is the whole shell.
    normals
        n0 (3,) at the named points.
    supports
        Name of an end -> its support.
    loads, load_size, load_sizes
        All that loads the model; by amplitude, the sum of the sizes of its dead loads over E h R,
        as a number and as forms.
    V, r0, u
        Space of the displacement; placement and displacement over R.
    factory
        Factory that makes the energies.
    fields
        Applied fields that are known by their values.
    without_potential
        Ends at which a live pressure has no potential.
    growing
        The placement with amplitudes of growing imperfections; None without.
    held
        Supports of the axis and the ends.
    energies
        The terms, as functions of the displacement's jet.
    kernels
        Names and compile time of the forms in use.
    thickness
        h(x)/h, free to jump from cell to cell; None for 1.
    cell_materials
        `parameters.ShellMaterial.numbers` of each cell; None where all shells have one material.
    shell_contacts, t_junction_terms
        The contacts of shells with each other, and their T-junctions.
    _volume
        Compiled form of Delta V/R^3.
    _probe_by_point
        Name of a point -> `Probe` that gives the displacement there.
    """

    shell_contacts: "Sequence[MeridianContact]"

    thin: Literal[True] = True
    axisymmetric: Literal[True] = True
    multiplicity = 1
    axes: ClassVar[list[int]] = [0, 2]  # U and W are along e1 and e3, at the azimuth zero

    def __init__(
        self,
        meridian: Meridian,
        material: Material,
        degree: int,
        conditions: Mapping[str, Condition],
        loads: Loads,
        sigma: float | None = None,
        thickness: Thickness | None = None,
        *,
        assembled: bool = True,
    ) -> None:
        """Make the energies of the model and, if `assembled`, its system."""
        self.meridian, self.material, self.degree = meridian, material, degree
        self.conditions = conditions
        self.sigma = default_penalty(degree) if sigma is None else sigma
        self.load_size, self.load_sizes = {}, {}
        self.kernels = KernelLog()
        self.V = fem.functionspace(meridian.mesh, ("Lagrange", degree, (2,)))
        self.r0, self.u = meridian.placement(self.V), fem.Function(self.V, name="u")
        self.loads = self._in_cells(loads)
        self.growing = self._growing_placement()
        patches = meridian.patches
        self.thickness = thickness_field(thickness, self.r0, patches) if thickness else None
        self.cell_materials: fem.Function | None = None
        if material.shells:
            self.cell_materials = material_field(material.shells, meridian.mesh, patches)
        self.factory = factory = self._make_factory()
        self.held = supports(meridian, conditions)
        self.energies = [factory.membrane(), factory.bending(), factory.interior_edges()]
        self.supports = self._add_supports()
        is_enclosed = self._add_field_and_pressure()
        self.energies += self.user_and_body_energies(meridian.ends)
        self._add_forces()
        if assembled:
            self._assemble(is_enclosed)

    def _in_cells(self, loads: Loads) -> Loads:
        """Return the loads with functions of the mesh in place of formulas and patches.

        Formulas become fields, and magnetisations of patches become values in each cell.
        """
        formula_to_field = partial(formula_field, self.r0)
        user_terms = tuple(term.with_functions(formula_to_field) for term in loads.user_terms)
        loads = replace(loads, user_terms=user_terms)
        patches, cell_count = self.meridian.patches, len(self.meridian.order)
        for name in ("magnetic", "remanence"):
            if magnetisation := getattr(loads, name):
                loads = replace(loads, **{name: magnetisation.on_cells(patches, cell_count)})
        return loads

    def _growing_placement(self) -> PlacementAmplitudes | None:
        """Return the placement with amplitudes of growing imperfections; None if none grows."""
        shapes = {
            name: self.meridian.growth(self.V, deviations)
            for name, deviations in self.loads.growing_imperfections.items()
        }
        return PlacementAmplitudes(self.r0, shapes, self.material.h) if shapes else None

    def _make_factory(self) -> EnergyFactory:
        """Return the factory that makes the energies of this shell.

        `self.loads` gets the natural shape cell by cell.
        """
        meridian, loads = self.meridian, self.loads
        pressed_cells = side_field(loads.pressed_sides, meridian) if loads.pressed_sides else None
        free_constants: dict[str, fem.Constant] = {}
        natural_shape = self._natural_shape(free_constants)
        initial_placement = self.growing and self.growing.initial_placement
        return EnergyFactory(
            meridian_domain(self.r0, initial_placement),
            self.u,
            self.material,
            self.sigma,
            self.kernels,
            self.thickness,
            natural_shape,
            free_constants,
            # small angles between cells need only jumps of rotations
            has_folds=meridian.largest_fold(self.r0) > FOLD_ANGLE,
            pressed_sides=pressed_cells,
            creases=Creases.of_joints(loads.joints, meridian) if loads.joints else None,
            cell_materials=self.cell_materials,
        )

    def _natural_shape(self, free_constants: dict[str, fem.Constant]) -> Shape | None:
        """Return the natural shape, the one without stress; None if it is the undeformed one.

        Its amplitudes are added to `free_constants`, name -> constant. `self.loads` gets the shape
        cell by cell in place of patch by patch.
        """
        if not self.loads.natural:
            return None
        natural = self.loads.natural.on_cells(self.meridian.patches, len(self.meridian.order))
        self.loads = replace(self.loads, natural=natural)
        field = natural_field(natural, cell_geometry(self.r0), self.V)
        return Shape.from_field(field, natural, free_constants)

    def _add_supports(self) -> dict[str, Support]:
        """Add the energies of clamped ends and of ends on a mirror plane to `energies`.

        Returns the supports by the name of their end.
        """
        # energies of several clamped ends need a name each
        clamped_count = list(self.conditions.values()).count("clamped")
        supports_by_end = {}
        # facets of each end, and the components of (U, W) that are zero there
        for name, (facets, components) in self.held.by_name.items():
            edge, turn = "", None
            if self.conditions[name] == "clamped":
                edge = f"{name} clamped edges" if clamped_count > 1 else "clamped edges"
                turn = rotation_of(self.loads, name, self.V)
                self.energies.append(self.factory.clamped_edges(edge, facets, turn))
            constraints = held_on(self.V, 0, facets, components)
            supports_by_end[name] = Support.from_conditions(constraints, edge, turn)
        if len(self.held.mirror):
            e3 = np.array([0.0, 0.0, 1.0])
            self.energies.append(self.factory.mirror_edges(self.held.mirror, e3))
        return supports_by_end

    def _add_field_and_pressure(self) -> bool:
        """Add the energies of magnetisation and of a live pressure to `energies`.

        Sets `without_potential`, the ends at which a live pressure has no potential. Returns
        whether moving supports close all openings with lids.
        """
        factory, meridian, loads = self.factory, self.meridian, self.loads
        if loads.magnetic:
            self.energies += factory.magnetic(loads.magnetic)
        free_ends, self.without_potential = meridian_openings(
            meridian, self.conditions, loads.pressed_sides
        )
        is_enclosed = enclosed(loads, free_ends, self.without_potential)
        self.without_potential += ends_within(factory.pressed_sides)
        if loads.pressure:
            energy = factory.pressure(loads.pressure_profile, potential=not self.without_potential)
            self.energies.append(energy)
        return is_enclosed

    def _add_forces(self) -> None:
        """Add the energies of forces at the pole and of dead loads to `energies`.

        Sets `load_size` and `load_sizes`: by amplitude, the sum of the sizes of its dead loads as a
        number, and as forms that depend on the placement.
        """
        measures = RevolutionIntegrals(self.meridian, self.domain)
        for name, force in self.loads.forces.items():
            energy = pole_force(name, force, self.force_unit, measures, self.kernels)
            self.energies.append(energy)
        for name, dead in self.loads.dead.items():
            if forces(dead):  # else there are moments alone, whose energies come below
                energy, size, sizes = dead_loads(name, dead, measures, self.kernels)
                self.load_size[name], self.load_sizes[name] = size, sizes
                self.energies.append(energy)
            self.energies += self.factory.dead_energies(name, dead, self.meridian.ends)

    def _assemble(self, is_enclosed: bool) -> None:
        """Make the system, contacts, T-junctions and probes of the model.

        `is_enclosed` tells whether moving supports close all openings.
        """
        factory, loads = self.factory, self.loads
        # a pressure does work on the volume that the surface sweeps
        has_swept_volume = loads.pressure or is_enclosed
        volume = factory.swept_volume() if has_swept_volume else factory.volume_change(np.zeros(3))
        # terms, of which that of interior edges gives the sparsity pattern
        terms = [factory.term(energy) for energy in self.energies]
        pattern_term = next(term for term in terms if term.name == INTERIOR)
        # parameters of energies that may vary, by name
        parameters: dict[str, FreeParameter] = {
            **make_parameters(factory.free_constants, terms, self.u, self.kernels)
        }
        parameters |= field_parameters(factory.fields, terms, self.u, self.kernels)
        self.fields = factory.fields
        if self.growing:
            parameters |= self.growing.parameters(terms, parameters)
        edge_pressure = self._edge_pressure() if is_enclosed else None
        motion = moving(self.r0, self.supports, loads, edge_pressure)
        self.shell_contacts = self._make_shell_contacts()
        for contact in self.shell_contacts:
            # parameters that change a contact too, such as the thickness of a natural shape
            parameters |= contact.growth_parameters(parameters)
        self.t_junction_terms = self._make_t_junctions()
        # requested now, taken below: the system's forms compile meanwhile
        volume_request = self.kernels.request_form("volume energy", underived(volume))
        self.system = FiniteElementSystem(
            self.u,
            [*terms, *self.shell_contacts, *self.t_junction_terms],
            self.held.axisymmetric_conditions(self.V),
            pattern_term,
            self.material.h,
            variables=SystemVariables(parameters, motion, self.contact_history),
        )
        self._volume = volume_request()
        self._probe_by_point = {
            name: Probe.at_parameter(*place, self.r0)
            for name, place in self.meridian.points.items()
        }
        self.normals = {name: probe.normal for name, probe in self._probe_by_point.items()}

    @property
    def shell_cells(self) -> Mapping[str, NDArray[np.bool_]]:
        return {name: self.meridian.patches[name] for name in self.meridian.shells}

    def _make_shell_contacts(self) -> "Sequence[MeridianContact]":
        """Return the contacts between parts of the shell; empty without contact pairs."""
        if not self.loads.pairs:
            return []
        # imported late: few shells have a contact
        from magshell_fenicsx.parts.contact.meridian_contact import (
            ModelMeridian,
            meridian_contacts,
        )

        model = ModelMeridian(
            self.r0,
            self.u,
            self.meridian.patches,
            self.material.h,
            self.domain.contact_rule,
            self.thickness,
            self.factory.law_of_cells.thins,
            self.factory.natural,
        )
        return meridian_contacts(self.loads.pairs, model)

    def _make_t_junctions(self) -> "list[MeridianTJunction]":
        """Return the terms that tie ends to other shells on which they stand."""
        # a joint without cells of its own is a T-junction
        if all(joint_cells is not None for joint_cells in self.meridian.joints):
            return []
        from magshell_fenicsx.shells.t_junctions import meridian_t_junction_terms

        return meridian_t_junction_terms(self)

    def numbers(self) -> dict[str, list[Array]] | None:
        """Return all values that the terms take from the problem, by the names of terms.

        The arrays are views, so that they can be set. The name "placement" has the nodal values of
        r0. None if the terms depend on more than such values, as with contact or moving supports.
        Then the forms cannot serve another problem.
        """
        # terms with data that follow the state
        follows_state = any(
            (
                self.growing,
                self.contacts,
                self.loads.pairs,
                self.fields,
                self.factory.saturated,
                self.loads.moves,
            )
        )
        # energies whose numbers are not the parameters of a density
        has_other_numbers = any(e.density is None or e.reference_turn for e in self.energies)
        if follows_state or has_other_numbers:
            return None
        # free constants have amplitudes as values, which are not numbers of the problem
        free_constants = {id(constant) for constant in self.factory.free_constants.values()}
        values_by_term = {"placement": [self.r0.x.array]}
        for e in self.energies:
            assert e.density
            parameters = [p for p in e.density.parameters if id(p) not in free_constants]
            values_by_term[e.name] = [
                p.value if isinstance(p, fem.Constant) else p.x.array for p in parameters
            ]
        return values_by_term

    def with_numbers(
        self, model: "MeridianModel", numbers: SettableNumber, value: float
    ) -> "MeridianModel":
        """Return a copy of this model that has the numbers of another one, but its own forms.

        Parameters
        ----------
        model
            The other model, of which meridian and material are taken.
        numbers
            The setting that puts the other model's numbers into the forms, when its value is set.
        value
            Its value for the copy; every evaluation sets it.
        """
        copied_model = copy(self)
        copied_model.system = self.system.with_number("numbers of the case", numbers, value)
        copied_model.meridian, copied_model.material = model.meridian, model.material
        largest = largest_wave_number(model.meridian, model.material.h)
        copied_model.waves = self.waves.for_system(copied_model.system, largest)
        return copied_model

    @cached_property
    def waves(self) -> Waves:
        """Waves around the axis, which an axisymmetric model cannot have. Compiles kernels."""
        arguments = self.system, self.energies, self.meridian, self.domain, self.held, self.kernels
        return Waves(*arguments, [*self.shell_contacts, *self.t_junction_terms])

    @property
    def symmetry_breaking_modes(self) -> Waves:
        """The waves, as modes of the shell that the model excludes."""
        return self.waves

    def growth(self, deviations: Sequence[Deviation]) -> fem.Function:
        """Return the change of the placement by further deviations."""
        return self.meridian.growth(self.V, deviations)

    def at_nodes(self, function: Embedding) -> Array:
        """Return the values (cells, nodes, ...) of a function of the chart at cells' nodes.

        The function takes (s, azimuth); the azimuth is zero.
        """
        s = self.V.tabulate_dof_coordinates()[:, 0]
        return np.asarray(function(np.column_stack([s, 0 * s]))[self.V.dofmap.list])

    def chart(self) -> Array:
        """Coordinates (n, 1) of the nodes along the meridian."""
        return np.asarray(self.V.tabulate_dof_coordinates()[:, :1])

    def rigid_motions(self, amplitudes: Amplitudes) -> RigidMotions:
        """Return the rigid motions of the undeformed shell that no support or spring resists.

        Where supports leave waves free, it compiles their kernels. Motions along e3 are
        axisymmetric; turns about e3 are waves m = 0, motions across e3 waves m = 1.
        """
        state, comm = State(self.zero(), dict(amplitudes)), self.V.mesh.comm
        # motions of a shell that nothing holds: along e3, about e3 and across it
        motions = self.held.rigid_motions(self.r0)

        def unresisted_waves(waves: Array, m: int) -> Array:
            """Return the motions that neither supports nor energy resist, of waves m (n, size)."""
            with_zeros = partial(_with_zeros, self.held.unknowns_of_waves(self.r0, m))
            return unresisted(waves, with_zeros, lambda: self.waves.tangent(state, m), comm)

        tangent = partial(self.system.tangent, state.u, state.mu)
        axial = unresisted(motions.axial, self.system.zero_at_supports, tangent, comm)
        return RigidMotions(
            axial, unresisted_waves(motions.torsional, 0), unresisted_waves(motions.transverse, 1)
        )

    def free_motion(self, amplitudes: Amplitudes) -> str:
        """Return a message that names a rigid motion left free; empty if there is none."""
        motions = self.rigid_motions(amplitudes)
        if len(motions.axial):
            return NOT_HELD + "move along (0, 0, 1)"
        if len(motions.transverse):
            # [2::3]: coefficients W; a translation across the axis has none, a turn has
            turns_alone = (
                len(motions.transverse) == 1
                and np.abs(motions.transverse[0][2::3]).max() > AXIAL_TOLERANCE
            )
            return NOT_HELD + ("turn" if turns_alone else "move along (1, 0, 0)")
        return ""

    def displacement(self, u: Vector, point: str) -> Array:
        """u/R (3,) at a named point."""
        return self._probe_by_point[point](u)

    def probe(self, point: str) -> Array:
        """Return the matrix (3, size) that maps u to the displacement of a named point."""
        return self._probe_by_point[point].rows(self.system.size)

    def _edge_pressure(self) -> EdgePressure:
        """Return the work along e3 of a live pressure on lids, one at each moving end.

        Ends of shells without pressure have none. A lid is a disc of the end's radius, whose normal
        continues the pressed side.
        """
        # parameter s of each end
        ends = {name: self.meridian.parameter(name) for name in self.meridian.ends}
        lids = [
            Lid.disc(
                self.meridian.section(np.array([s]))[0, 0],  # radius of the end
                motions,
                last=(side > 0) != self.meridian.begins(name),
            )
            for name, s in ends.items()
            # 1: pressed from outside, -1: from inside, 0: not pressed
            if (side := side_of(name, self.loads.pressed_sides))
            and (motions := motions_of(self.loads, name))
        ]
        return EdgePressure(PRESSURE, self.material.classical_pressure / self.material.h, lids)


def _with_zeros(unknowns: NDArray[np.int32], v: Vector) -> Vector:
    """Return a copy of a vector with zeros at some unknowns."""
    v = np.array(v)
    v[unknowns] = 0.0
    return v

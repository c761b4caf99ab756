"""The axisymmetric shell as a system of terms on its meridian, and its displacement at one place.

Lengths in R, energies in E h R^2, of the whole shell. Amplitudes as in `ShellModel`:
"pressure" is p/p_c, "force" is F R/(2 pi D), "lambda_m" is lambda_m.
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
from magshell_fenicsx.parts.forces.meridian_loads import Around, dead_loads, pole_force
from magshell_fenicsx.parts.joints import Creases
from magshell_fenicsx.parts.loads import Loads, forces
from magshell_fenicsx.parts.magnetism.applied import field_parameters
from magshell_fenicsx.parts.natural.shape import Shape, natural_field
from magshell_fenicsx.parts.pressure.openings import meridian_openings, on_cells, side_of
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
from magshell_fenicsx.shells.waves import SymmetryBreakingWaves, Waves, largest_wave_number

if TYPE_CHECKING:
    from magshell_fenicsx.parts.contact.meridian_contact import MeridianContact
    from magshell_fenicsx.shells.t_junctions import MeridianTJunction

Array = NDArray[np.float64]
AXIAL_TOLERANCE = (
    1e-9  # largest axial component of a motion of length one that is a translation across the axis
)


@dataclass(frozen=True)
class Probe:
    """Interpolation in the cell of a place, whose displacement is turned to the azimuth of the
    place.

    Attributes
    ----------
    nodes, weights
        Of the cell, and its shape functions there.
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
        """Return the probe at a parameter of the meridian with the placement `r0`."""
        V = r0.function_space
        ends = V.mesh.geometry.x[compat.geometry_dofs(V.mesh), 0]
        cell = int(np.argmin(np.maximum(ends.min(axis=1) - s, s - ends.max(axis=1))))
        local = np.array([[(s - ends[cell, 0]) / (ends[cell, 1] - ends[cell, 0])]])
        values, slopes = V.element.basix_element.tabulate(1, local)[:, 0, :, 0]
        nodes = V.dofmap.list[cell]
        turn = np.array([[np.cos(azimuth), np.sin(azimuth), 0.0], [0.0, 0.0, 1.0]])
        rho_s, z_s = slopes @ r0.x.array.reshape(-1, 2)[nodes]
        normal = np.array([-z_s, rho_s]) / np.hypot(rho_s, z_s)
        return Probe(nodes, values, turn, normal @ turn)

    def __call__(self, u: Vector) -> Array:
        """u/R (3,) there."""
        return np.asarray(self.weights @ u.reshape(-1, 2)[self.nodes] @ self.turn)

    def rows(self, size: int) -> Array:
        """(3, size): the same as a matrix."""
        matrix = np.zeros((3, size // 2, 2))
        matrix[:, self.nodes] = np.einsum("n,ki->ink", self.weights, self.turn)
        return matrix.reshape(3, size)


class MeridianModel(ThinModel):
    """A Koiter shell of revolution with axisymmetric loads; every rank holds all of it.

    Parameters
    ----------
    degree
        Of displacement and placement, 2 to 5.
    conditions
        Of the named ends, and of a named point on the axis; ends that are not named are free.
    loads
        A force at the pole; dead forces along e3 at the pole, on ends and areas, dead pressures and
        moments on ends; an applied field along e3, its gradient diag(a, a, b), a remanence that is
        the same along every meridian and has no component across it.
    sigma
        Penalty of the C0 interior penalty form; None takes `default_penalty`.
    thickness
        What multiplies the thickness, the same along every meridian; None for 1.
    assembled
        False for what is asked for its `numbers` alone: it has no system.

    Attributes
    ----------
    system, multiplicity, normals, supports
        See `ModelBase`; u = (U, W) along e_rho and e_z.
    held
        Where the displacement is zero.
    energies
        The terms, as functions of the displacement's jet.
    kernels
        Names and compile time of the forms in use.
    thickness
        h(x)/h, free to jump from cell to cell; None for 1.
    cell_materials
        Of each cell the `parameters.OwnMaterial` of its shell; None where all have one.
    touchings, t_junction_terms
        The contacts of shells with each other, and their T-junctions.
    """

    shell_contacts: "Sequence[MeridianContact]"

    thin: Literal[True] = True
    axisymmetric: Literal[True] = True
    multiplicity = 1
    axes: ClassVar[list[int]] = [0, 2]

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
        self.meridian, self.material, self.degree = meridian, material, degree
        self.conditions = conditions
        self.kernels = KernelLog()
        self.V = V = fem.functionspace(meridian.mesh, ("Lagrange", degree, (2,)))
        self.r0, self.u = meridian.placement(V), fem.Function(V, name="u")
        of_place = partial(formula_field, self.r0)
        loads = self.loads = replace(
            loads, own=tuple(term.with_functions(of_place) for term in loads.own)
        )
        patches, count = meridian.patches, len(meridian.order)
        for name in ("magnetic", "remanence"):
            if magnetisation := getattr(loads, name):
                loads = self.loads = replace(loads, **{name: magnetisation.on(patches, count)})
        self.sigma = default_penalty(degree) if sigma is None else sigma
        shapes = {
            name: meridian.growth(V, deviations) for name, deviations in loads.growing.items()
        }
        self.growing = PlacementAmplitudes(self.r0, shapes, material.h) if shapes else None
        self.thickness = thickness_field(thickness, self.r0, patches) if thickness else None
        self.cell_materials: fem.Function | None = None
        if material.shells:
            self.cell_materials = material_field(material.shells, meridian.mesh, patches)
        pressed_cells = on_cells(loads.pressed, meridian) if loads.pressed else None
        free_constants, shape = dict[str, fem.Constant](), None
        if loads.natural:
            loads = self.loads = replace(
                loads, natural=(natural := loads.natural.on(patches, count))
            )
            shape = Shape.of(
                natural_field(natural, cell_geometry(self.r0), V), natural, free_constants
            )
        domain = meridian_domain(self.r0, self.growing and self.growing.initial_placement)
        of_shell = material, self.sigma, self.kernels, self.thickness, shape, free_constants
        is_folded = meridian.largest_fold(self.r0) > FOLD_ANGLE
        creases = Creases.of(loads.joints, meridian) if loads.joints else None
        self.factory = factory = EnergyFactory(
            domain,
            self.u,
            *of_shell,
            is_folded,
            pressed=pressed_cells,
            creases=creases,
            cell_materials=self.cell_materials,
        )
        measures = Around(meridian, domain)
        self.held = supports(meridian, conditions)
        self.energies = [factory.membrane(), factory.bending(), factory.interior_edges()]
        self.supports = {}
        for name, (facets, components) in self.held.named.items():
            edge, turn = "", None
            if conditions[name] == "clamped":
                several = list(conditions.values()).count("clamped") > 1
                edge, turn = (
                    f"{name} clamped edges" if several else "clamped edges",
                    rotation_of(loads, name, V),
                )
                self.energies.append(factory.clamped_edges(edge, facets, turn))
            self.supports[name] = Support.of(held_on(V, 0, facets, components), edge, turn)
        if len(self.held.mirror):
            self.energies.append(factory.mirror_edges(self.held.mirror, np.array([0.0, 0.0, 1.0])))
        if loads.magnetic:
            self.energies += factory.magnetic(loads.magnetic)
        free_ends, self.without_potential = meridian_openings(meridian, conditions, loads.pressed)
        closed = enclosed(loads, free_ends, self.without_potential)
        if loads.pressure:
            self.energies.append(factory.pressure(potential=not self.without_potential))
        self.energies += self.user_and_body_energies(meridian.ends)
        for name, force in loads.forces.items():
            self.energies.append(pole_force(name, force, self.force_unit, measures, self.kernels))
        self.load_size, self.load_sizes = {}, {}
        for name, dead in loads.dead.items():
            if forces(dead):
                energy, self.load_size[name], self.load_sizes[name] = dead_loads(
                    name, dead, measures, self.kernels
                )
                self.energies.append(energy)
            self.energies += factory.dead_energies(name, dead, meridian.ends)
        if assembled:
            self._assemble(closed)

    def _assemble(self, closed: bool) -> None:
        """Make the system; `closed`: of openings that a pressure closes."""
        factory, meridian, loads, V = self.factory, self.meridian, self.loads, self.V
        swept = loads.pressure or closed
        volume = factory.swept_volume() if swept else factory.volume_change(np.zeros(3))
        terms = [factory.term(energy) for energy in self.energies]
        pattern, constraints = (
            next(term for term in terms if term.name == INTERIOR),
            self.held.held(V),
        )
        parameters: dict[str, FreeParameter] = {
            **make_parameters(factory.free_constants, terms, self.u, self.kernels)
        }
        parameters |= field_parameters(factory.fields, terms, self.u, self.kernels)
        self.fields = factory.fields
        if self.growing:
            parameters |= self.growing.parameters(terms, parameters)
        moves = moving(self.r0, self.supports, loads, self._edge_pressure() if closed else None)
        stiffnesses = dict(pressing.history for pressing, _ in self.contacts.values())
        self.shell_contacts = []
        if loads.pairs:
            from magshell_fenicsx.parts.contact.meridian_contact import (
                ModelMeridian,
                meridian_contacts,
            )

            model = ModelMeridian(
                self.r0,
                self.u,
                meridian.patches,
                self.material.h,
                factory.domain.contact_rule,
                self.thickness,
                factory.law_of_cells.thins,
                factory.natural,
            )
            self.shell_contacts = meridian_contacts(loads.pairs, model)
        for contact in self.shell_contacts:
            stiffnesses |= contact.history
            parameters |= contact.entered(parameters)
        self.t_junction_terms: list[MeridianTJunction] = []
        if any(joint_cells is None for joint_cells in meridian.joints):
            from magshell_fenicsx.shells.t_junctions import meridian_t_junction_terms

            self.t_junction_terms = meridian_t_junction_terms(self)
        volume_request = self.kernels.request_form("volume energy", underived(volume))
        self.system = FiniteElementSystem(
            self.u,
            [*terms, *self.shell_contacts, *self.t_junction_terms],
            constraints,
            pattern,
            self.material.h,
            variables=SystemVariables(parameters, moves, stiffnesses),
        )
        self._volume = volume_request()
        self._probe_by_point = {
            name: Probe.at_parameter(*place, self.r0) for name, place in meridian.points.items()
        }
        self.normals = {name: probe.normal for name, probe in self._probe_by_point.items()}

    def numbers(self) -> dict[str, list[Array]] | None:
        """Return all values that its terms take from the problem, by term, as views; None if a term
        takes others too.
        """
        has_contacts = self.contacts or self.loads.pairs
        follows = (
            self.growing
            or has_contacts
            or self.fields
            or self.factory.saturated
            or self.loads.moves
        )
        if follows or any(e.density is None or e.reference_turn for e in self.energies):
            return None
        free_constants = {
            id(constant) for constant in self.factory.free_constants.values()
        }  # amplitudes
        values = {"placement": [self.r0.x.array]}
        for e in self.energies:
            assert e.density
            parameters = [p for p in e.density.parameters if id(p) not in free_constants]
            values[e.name] = [
                p.value if isinstance(p, fem.Constant) else p.x.array for p in parameters
            ]
        return values

    def with_numbers(
        self, model: "MeridianModel", numbers: SettableNumber, value: float
    ) -> "MeridianModel":
        """Return this model with the numbers of another one, which all evaluations put in place by
        that value.
        """
        other = copy(self)
        other.system = self.system.with_number("numbers of the case", numbers, value)
        other.meridian, other.material = model.meridian, model.material
        other.symmetry_breaking_modes = SymmetryBreakingWaves(
            self.waves.for_system(
                other.system, largest_wave_number(model.meridian, model.material.h)
            )
        )
        return other

    @cached_property
    def symmetry_breaking_modes(self) -> SymmetryBreakingWaves:
        """The waves around the axis, which an axisymmetric model does not see. Compiles kernels."""
        arguments = self.system, self.energies, self.meridian, self.domain, self.held, self.kernels
        return SymmetryBreakingWaves(
            Waves(*arguments, [*self.shell_contacts, *self.t_junction_terms])
        )

    @property
    def waves(self) -> Waves:
        """Around the axis."""
        return self.symmetry_breaking_modes.waves

    def growth(self, deviations: Sequence[Deviation]) -> fem.Function:
        """Return the change of the placement by further deviations."""
        return self.meridian.growth(self.V, deviations)

    def at_nodes(self, function: Embedding) -> Array:
        """Return the values of a function of charts at the nodes of each cell, (cells, nodes,
        ...).
        """
        s = self.V.tabulate_dof_coordinates()[:, 0]
        return np.asarray(function(np.column_stack([s, 0 * s]))[self.V.dofmap.list])

    def chart(self) -> Array:
        """Coordinates (n, 1) of the nodes along the meridian."""
        return np.asarray(self.V.tabulate_dof_coordinates()[:, :1])

    def rigid_motions(self, amplitudes: Amplitudes) -> RigidMotions:
        """Return the rigid motions of the undeformed shell that neither supports nor springs
        resist.

        Where supports leave waves free, it compiles their kernels.
        """
        state, comm = State(self.zero(), dict(amplitudes)), self.V.mesh.comm
        motions = self.held.rigid_motions(self.r0)

        def unresisted_waves(waves: Array, m: int) -> Array:
            with_zeros = partial(_with_zeros, self.held.unknowns_of_waves(self.r0, m))
            return unresisted(waves, with_zeros, lambda: self.waves.tangent(state, m), comm)

        tangent = partial(self.system.tangent, state.u, state.mu)
        axial = unresisted(motions.along, self.system.zero_at_supports, tangent, comm)
        return RigidMotions(
            axial, unresisted_waves(motions.around, 0), unresisted_waves(motions.across, 1)
        )

    def free_motion(self, amplitudes: Amplitudes) -> str:
        """Return a rigid motion that is left free, as a message; empty if there is none."""
        motions = self.rigid_motions(amplitudes)
        if len(motions.along):
            return NOT_HELD + "move along (0, 0, 1)"
        if len(motions.across):
            turns_alone = (
                len(motions.across) == 1 and np.abs(motions.across[0][2::3]).max() > AXIAL_TOLERANCE
            )
            return NOT_HELD + ("turn" if turns_alone else "move along (1, 0, 0)")
        return ""

    def displacement(self, u: Vector, point: str) -> Array:
        """u/R (3,) at a named point."""
        return self._probe_by_point[point](u)

    def probe(self, point: str) -> Array:
        """Return rows (3, size) that give the displacement at a named point, see `ModelBase`."""
        return self._probe_by_point[point].rows(self.system.size)

    def _edge_pressure(self) -> EdgePressure:
        """Return the work of a live pressure at the ends that move, along e3: on each is a lid."""
        ends = {name: self.meridian.parameter(name) for name in self.meridian.ends}
        lids = [
            Lid.disc(
                self.meridian.section(np.array([s]))[0, 0],
                motions,
                last=(side > 0) != self.meridian.begins(name),
            )
            for name, s in ends.items()
            if (side := side_of(name, self.loads.pressed))
            and (motions := motions_of(self.loads, name))
        ]
        return EdgePressure(PRESSURE, self.material.classical_pressure / self.material.h, lids)


def _with_zeros(unknowns: NDArray[np.int32], v: Vector) -> Vector:
    """Return a vector with zeros at some unknowns."""
    v = np.array(v)
    v[unknowns] = 0.0
    return v

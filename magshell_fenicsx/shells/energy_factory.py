"""Energies of a thin shell, each integrated from one density over the mid-surface or its meridian.

`EnergyFactory` makes an energy only when a scene asks for it, so unused ones are never compiled.
Lengths are over R, energies over E h R²; h is the thickness, R the reference length.

A jet holds a map's value and derivatives at a point; r0, u, and v denote jets of the placement, the
displacement, and a test function. A density is a function of jets and of parameters: constants, or
fields on the mesh. `per_area` turns a density per undeformed area into one per area of the
coordinates, as `Density.function` needs it. An amplitude is a load parameter, by name; an energy
with an amplitude is multiplied by it, and one without has the factor 1. A free parameter is a
`fem.Constant` of the energies that a path may vary.

`group` and `column` of an energy name its group of terms and its column in reported energies. A
field "in space" is an applied flux density known by its values at displaced places, as of a magnet;
else the field is uniform or linear in space. The natural shape is the one without stress. A shell
thins where its thickness follows from the deformation, as in rubber. Facets are the sides of cells
along an edge of the surface.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.memo import PointField
from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.models.domains import Energy, Facets, HeldEdge, IntegrationDomain
from magshell_fenicsx.models.shell import densities, edges
from magshell_fenicsx.models.shell.antisymmetric import antisymmetric_edge
from magshell_fenicsx.models.shell.energy import (
    Constants,
    Density,
    HessianTerm,
    MomentTerm,
    Parameter,
    ShellTerm,
    constants_of,
    elastic_density,
    per_area,
)
from magshell_fenicsx.models.shell.kinematics import (
    ALL_DERIVATIVES,
    FIRST_DERIVATIVES,
    SECOND_DERIVATIVES,
    VALUE_AND_FIRST,
    Edge,
    Jet,
)
from magshell_fenicsx.models.shell.law import Law, LawByShell
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import DeadLoad, Material
from magshell_fenicsx.models.shell.spatial_fields import pattern_field
from magshell_fenicsx.models.shell.thickness import thickness_weighted
from magshell_fenicsx.parts.bodies.body_contact import (
    BodyContact,
    ContactBody,
    contact_energy,
    thinned_energy,
)
from magshell_fenicsx.parts.gap import thickness_ratio_at_points
from magshell_fenicsx.parts.joints import AMPLITUDE as FOLD
from magshell_fenicsx.parts.joints import Creases
from magshell_fenicsx.parts.loads import moments, potentials
from magshell_fenicsx.parts.magnetism.applied import AppliedField
from magshell_fenicsx.parts.magnetism.fields import FIELD
from magshell_fenicsx.parts.magnetism.laws import LINEAR, full_density, magnetic_densities
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.parts.magnetism.saturation import SIZE
from magshell_fenicsx.parts.magnetism.soft_magnet import TERM, Sheet, SoftMagnet
from magshell_fenicsx.parts.natural.shape import Shape, grown
from magshell_fenicsx.parts.pressure.profile import PressureProfile

Array = NDArray[np.float64]
AnyTerm = TypeVar("AnyTerm", bound=FormTerm)
INTERIOR = "interior edges"  # name of their energy


@dataclass(frozen=True)
class EnergyFactory:
    """Factory of the energies of one shell, and of the terms of its system.

    An `Energy` is a function of the displacement's jet (value and derivatives); a `FormTerm` is its
    form at the model's displacement u.

    Attributes
    ----------
    domain
        Mid-surface or meridian that integrals run over, with the placement.
    u
        Displacement over R.
    sigma
        Penalty of the C0 interior penalty form.
    log
        Log that compiles forms, with their names and compile times.
    thickness
        Field (1,) of the thickness over h; None where it is h everywhere.
    natural
        The natural shape; None if it is the undeformed one.
    free_constants
        Constants of the free parameters, by name; energies add theirs.
    has_folds
        Whether cells meet at angles that are not small.
    fields
        Applied fields, known by values, that were made; `magnetic` adds its own.
    held_edges
        Edges whose energies were made: those that hold the normal, and those on mirror planes.
    pressed_sides
        Side of a live pressure in each cell, (1,): 1 from outside, -1 from inside, 0 without; None
        for 1.
    creases
        Joints with springs or hinges.
    cell_materials
        Material numbers (4,) of each cell: modulus over the first shell's, Poisson's ratio, mass
        density over the first shell's, number of the law. None where all shells have one material.
    saturated
        Magnetisation state of a soft material that saturates: empty, or one field that was made.
    """

    domain: IntegrationDomain
    u: fem.Function
    material: Material
    sigma: float
    log: KernelLog
    thickness: fem.Function | None = None
    natural: Shape | None = None
    free_constants: Constants = field(default_factory=dict)
    has_folds: bool = False
    fields: list[AppliedField] = field(default_factory=list)
    held_edges: list[HeldEdge] = field(default_factory=list)
    pressed_sides: fem.Function | None = None
    creases: Creases | None = None
    cell_materials: fem.Function | None = None
    saturated: list[PointField] = field(default_factory=list)

    def term(self, energy: Energy) -> FormTerm:
        """Return an energy as a term of the system: its form at the model's displacement u.

        The term's class depends on the energy: a `FormTerm` without a density, a `ShellTerm` with
        one, a `MomentTerm` for a moment on an edge.
        """
        # the modelled part's energy over the domain's: 2 pi for a meridian
        domain, work = self.domain, None
        factor = domain.revolution_factor
        if energy.work:  # a load without potential
            jets = domain.jet(self.u), domain.jet(ufl.TestFunction(self.u.function_space))
            work = factor * energy.work(*jets)

        def form() -> ufl.Form:
            """Return the form at the displacement of the model, which takes long to write."""
            return factor * energy.form_of(domain.jet(self.u))

        def make(kind: Callable[..., AnyTerm], *density: Density) -> AnyTerm:
            """Return a term of a class, whose constructor takes a density or none."""
            arguments = energy.name, *density, form, self.u, self.log, energy.amplitude
            term = kind(*arguments, linear=energy.linear, work=work)
            term.group, term.column = energy.group or energy.name, energy.column
            return term

        if energy.density is None:
            return make(FormTerm)
        if energy.reference_turn is None:
            return make(ShellTerm, energy.density)
        # a moment on an edge does work on the turn since a reference turn
        moment = make(MomentTerm, energy.density)
        moment.set_reference_turn(*energy.reference_turn)
        return moment

    def membrane(self) -> Energy:
        """Return the energy of in-plane strain."""
        density = self._elastic_density(Density(per_area(densities.membrane), ()))
        return self.domain.energy("membrane", density, column="stretching")

    def prestress(self) -> Density:
        """Return the density of the geometric stiffness, the tangent's part by membrane stress.

        The density takes the jet of a further displacement v after u. Its first parameter is the
        change (3,) of the membrane strain that makes the stress, constant in each cell.
        """
        strain = fem.Function(fem.functionspace(self.domain.mesh, ("DG", 0, (3,))))
        return self._elastic_density(Density(per_area(densities.prestress), (strain,)))

    def bending(self) -> Energy:
        """Return the energy of the change of curvature."""
        density = self._elastic_density(
            Density(per_area(densities.bending), (), parts=ALL_DERIVATIVES)
        )
        return self.domain.energy("bending", density, column="bending")

    def interior_edges(self) -> Energy:
        """Return the C0 interior penalty energy of rotation jumps on edges between cells.

        On edges with creases, their springs or hinges take its place. Where creases grow, the part
        of the rest angle that has grown, 0 to 1, is the free parameter `FOLD`.
        """
        # jumps of small rotations, or finite angles between cells
        edge_energy = edges.fold if self.has_folds else edges.interior
        density = self._elastic_density(
            Density(edge_energy, (self._penalty,), ALL_DERIVATIVES, SECOND_DERIVATIVES, sides=2)
        )
        if self.creases:
            no_growth = self._constant(0.0)
            density = self.creases.replace_at_joints(
                density,
                self.free_constants.setdefault(FOLD, no_growth) if self.creases.grow else no_growth,
            )
        return self.domain.energy(INTERIOR, density, column="bending")

    def clamped_edges(self, name: str, facets: Facets, turn: fem.Constant | None = None) -> Energy:
        """Return the interior penalty energy of boundary edges that hold the normal.

        `turn` is the rotation matrix of an edge that moves; None for a fixed edge. The edges are
        added to `held_edges`.
        """
        parameters = (self._penalty,) if turn is None else (self._penalty, turn)
        density = self._elastic_density(
            Density(edges.clamped, parameters, ALL_DERIVATIVES, SECOND_DERIVATIVES, facets)
        )
        self.held_edges.append(HeldEdge(facets, turn=turn))
        return self.domain.energy(name, density, column="bending")

    def mirror_edges(self, facets: Facets, normal: Array, name: str = "mirror edges") -> Energy:
        """Return the interior penalty energy of edges on a mirror plane.

        `normal` (3,) is the plane's unit normal. The edges are added to `held_edges`.
        """
        plane = self._constant(normal)
        density = self._elastic_density(
            Density(
                edges.symmetric, (self._penalty, plane), ALL_DERIVATIVES, SECOND_DERIVATIVES, facets
            )
        )
        self.held_edges.append(HeldEdge(facets, plane=plane))
        return self.domain.energy(name, density, column="bending")

    def edge_moment(self, name: str, facets: Facets, intensity: float, amplitude: str) -> Energy:
        """Return the energy of a moment about the edge's first tangent; collective.

        `intensity` is the moment per undeformed length, in E h R, at an amplitude of one. The turn
        of the edge is counted from a reference turn, which the term sets.
        """
        # cosine and sine of the reference angle, zero at first
        reference_turn = self._constant(np.array([1.0, 0.0]))
        density = Density(edges.turning, (self._constant(intensity), reference_turn), facets=facets)
        length = fem.assemble_scalar(self.log.compile(f"{name} length", self.domain.length(facets)))
        total_length = self.domain.revolution_factor * self._over_ranks(length)
        work_per_radian = intensity * total_length
        return self.domain.energy(
            name, density, amplitude, reference_turn=(reference_turn, work_per_radian)
        )

    def dead_energies(
        self, name: str, loads: Sequence[DeadLoad], edges_named: Mapping[str, Facets]
    ) -> list[Energy]:
        """Return the energies of an amplitude's dead moments and user potentials; collective.

        Parameters
        ----------
        name
            Name of the amplitude.
        loads
            Dead loads of the amplitude; forces among them are left out here.
        edges_named
            Edge name -> its facets.
        """
        energies = []
        for i, load in enumerate(moments(loads)):
            moment_name = f"{name} moment {load.edge} {i}"
            facets = edges_named[load.edge]
            energies.append(self.edge_moment(moment_name, facets, load.moment, name))
        return energies + [self.user_energy(term, amplitude=name) for term in potentials(loads)]

    def antisymmetric_edges(self, facets: Facets, normal: Array) -> HessianTerm:
        """Return the edges' term in the tangent that antisymmetric displacements of a half have.

        It is the Hessian in v, at v = 0, of the edges' energy with the displacement u + v. `normal`
        (3,) is the plane's unit normal.
        """
        domain, parameters = self.domain, (self._penalty, self._constant(normal))
        density = self._elastic_density(
            Density(antisymmetric_edge, parameters, ALL_DERIVATIVES, facets=facets)
        )
        v = fem.Function(self.u.function_space)
        jets = domain.j0, domain.jet(self.u), domain.jet(v)
        arguments = *jets, domain.covector, domain.cell_area, *density.parameters
        energy = density.function(*arguments) * domain.ds(facets)
        return HessianTerm("antisymmetric edges", density, energy, v, self.log)

    def magnetic(self, field: Magnetisation) -> list[Energy]:
        """Return the energies of the shell's magnetisation in the applied field.

        A remanence has the energy chosen in `field.energy`, linear in the field, whose strength is
        its amplitude. A soft magnet has one energy, quadratic in the field. A field in space is
        known by its values at the displaced places; it is added to `fields`.
        """
        applied = None
        if field.in_space:
            applied = AppliedField(
                field.in_space, self.domain.r0, self.u, self.domain.rule, field.driven
            )
            self.fields.append(applied)
        if field.soft is None:
            return self.remanent(field, applied)
        # a soft magnet alone has no remanence
        energies = [] if field.soft.alone else self.remanent(field, applied)
        return [*energies, self.soft_magnetic(field, field.soft, applied)]

    def soft_magnetic(
        self, field: Magnetisation, soft_magnet: SoftMagnet, applied: AppliedField | None
    ) -> Energy:
        """Return the energy of a soft-magnetic shell in the applied field.

        It is quadratic in the amplitudes of the field, or saturates. So no amplitude multiplies it
        as a whole: they are free parameters within it. `applied` is a field known by its values,
        else None.
        """
        sheet, scale = Sheet(field), self._constant(soft_magnet.scale)
        law, *parameters = self._of_sheet(sheet, soft_magnet, applied)
        # only a field that varies in space depends on the place
        parts = FIRST_DERIVATIVES if field.uniform else VALUE_AND_FIRST
        density = Density(per_area(sheet.energy_per_area), (law, scale, *parameters), parts=parts)
        return self.domain.energy(
            TERM, self._with_thickness(density), group="magnetic", column="magnetic"
        )

    def induced(self, field: Magnetisation) -> dict[str, ufl.Form]:
        """Return the forms that give the mean induced polarisation.

        Returns
        -------
        dict[str, ufl.Form]
            "induced x", "induced y" and "induced z": integrals of the polarisation over the
            undeformed volume of the modelled part, over h. "induced volume": that volume. Empty
            without a soft material.
        """
        if field.soft is None:
            return {}
        # `magnetic`, called before, added the field in space last
        sheet, applied = Sheet(field), self.fields[-1] if field.in_space else None
        law, *parameters = self._of_sheet(sheet, field.soft, applied)
        # the volume over h is the integral of 1 over the area, weighted with the thickness
        by_name = {"volume": Density(per_area(lambda r0, u, one: one), (self._constant(1.0),))}
        for axis, e in zip("xyz", np.eye(3), strict=True):
            by_name[axis] = Density(per_area(sheet.induced), (law, self._constant(e), *parameters))
        return {
            f"induced {name}": self._over_area(self._with_thickness(density))
            for name, density in by_name.items()
        }

    def _of_sheet(
        self, sheet: Sheet, soft_magnet: SoftMagnet, applied: AppliedField | None
    ) -> list[Parameter]:
        """Return the parameters of a soft-magnetic sheet's densities, in the order of `Sheet`.

        First the susceptibility, or the magnetisation state where the material saturates. Then the
        amplitudes, and last the vectors of the field or its polynomial in space.
        """
        chi = soft_magnet.susceptibility
        if callable(chi):  # a function of the place
            susceptibility_field = pattern_field(
                chi, self.domain.r0, name="susceptibility", key="magnetic.susceptibility", size=1
            )
            law = susceptibility_field[0]  # its one component, as a number
        else:
            law = self._constant(chi)
        amplitudes = [
            # an amplitude's constant is shared by all energies
            self.free_constants.setdefault(name, self._constant(0.0))
            for name in sheet.amplitudes
        ]
        if soft_magnet.saturation is not None:
            if not self.saturated:  # the energy and the observed forms share the state
                self.saturated.append(self._saturated(sheet, law, amplitudes, applied))
            law = self.saturated[0]
        vectors = map(self._constant, sheet.vectors)
        polynomials = [applied.polynomial] if applied else []
        return [law, *amplitudes, *vectors, *polynomials]

    def _saturated(
        self,
        sheet: Sheet,
        chi: Parameter,
        amplitudes: Sequence[fem.Constant],
        applied: AppliedField | None,
    ) -> PointField:
        """Return the magnetisation state of a saturating material at the quadrature points.

        The state holds two Taylor polynomials of the energy in the field, at u and at u = 0; see
        `saturation`. It is computed again when the placement, u or the field have changed. `chi` is
        the susceptibility.
        """
        domain, followed = self.domain, (self.domain.r0, self.u)
        # the coefficients of both polynomials at each quadrature point
        saturation = PointField(domain.mesh, domain.rule, 2 * SIZE)
        jets_at_points = domain.tables(domain.r0.function_space, saturation.points)

        def places_and_normals() -> list[Array]:
            """Return undeformed places, displacements, present and undeformed unit normals."""
            # [:3]: value and both first derivatives
            r0, u = (jets_at_points(f.x.array)[:3] for f in followed)
            # normals of the deformed and of the undeformed surface
            area_vectors = [np.cross(r[1], r[2]) for r in (r0 + u, r0)]
            return [
                r0[0],
                u[0],
                *(m / np.linalg.norm(m, axis=-1, keepdims=True) for m in area_vectors),
            ]

        return sheet.saturated(chi, amplitudes, applied, saturation, followed, places_and_normals)

    def remanent(self, field: Magnetisation, applied: AppliedField | None) -> list[Energy]:
        """Return the energies of a remanence, linear in the applied field with its amplitudes.

        A field known by its values (`applied`) has one energy. Otherwise each uniform direction of
        the field has its own amplitude, and a field gradient one more energy. An approximate energy
        (`field.energy`) is a sum of several energies, by name.
        """
        pattern, domain, thins = field.remanent, self.domain, self.material.law.thins_somewhere
        full = full_density(field.law, thins=thins)  # the exact density, in a uniform field
        Br = pattern_field(pattern, domain.r0)[0] if callable(pattern) else self._constant(pattern)
        if applied:
            # the same density, with the field's value at the displaced place
            density = self._magnetised(
                field, densities.in_space(full), Br, applied.polynomial, parts=VALUE_AND_FIRST
            )
            return [domain.energy("magnetic", density, FIELD.name, column="magnetic")]
        # name -> density, of the exact energy or of the parts of an approximate one
        chosen_densities = magnetic_densities(field.law, field.energy, thins=thins)
        energies = []
        for amplitude, suffix, Ba in field.uniform_parts:
            for name, density_function in chosen_densities.items():
                energy = domain.energy(
                    name + suffix,
                    self._magnetised(field, density_function, Br, self._constant(Ba)),
                    amplitude,
                    linear=name in LINEAR,
                    group=name,
                    column="magnetic",
                )
                energies.append(energy)
        if field.gradient is not None:
            in_gradient = densities.in_gradient(full)
            gradient = self._constant(field.gradient)
            density = self._magnetised(field, in_gradient, Br, gradient, parts=VALUE_AND_FIRST)
            energies.append(
                domain.energy("magnetic gradient", density, FIELD.name, column="magnetic")
            )
        return energies

    def _magnetised(
        self,
        field: Magnetisation,
        density_function: Callable[..., Expr],
        *parameters: Parameter,
        parts: tuple[str, ...] = FIRST_DERIVATIVES,
    ) -> Density:
        """Return a density of the remanence, weighted with the thickness.

        `density_function` is per undeformed area and takes r0, u and `parameters`; `parts` are the
        parts of u's jet that it depends on. Where the thickness follows from the deformation, the
        density has the natural shape too.
        """
        density = Density(per_area(density_function), parameters, parts=parts)
        thins = self.material.law.thins_somewhere and field.law == "deformation"
        return self._with_thickness(self._thinning(density) if thins else density)

    def pressure(self, profile: PressureProfile | None, *, potential: bool) -> Energy:
        """Return the energy of a live pressure with the amplitude p/p_c.

        With `potential` it is p Delta V. Otherwise the virtual work of a follower load takes the
        place of the energy's gradient. A `profile` multiplies p at the deformed place; None for 1.
        """
        # pressure at an amplitude of one: p_c over E h/R
        unit = self._constant(self.material.classical_pressure / self.material.h)
        swept_and_work: tuple[Callable[..., Expr], ...] = (
            (profile.swept_integral, profile.work)
            if profile
            else (densities.swept_volume, densities.follower_pressure_work)
        )
        swept, follower_work = map(self._on_pressed, swept_and_work)
        parameters = (unit,) if self.pressed_sides is None else (unit, self.pressed_sides)
        density = Density(
            swept, parameters, parts=VALUE_AND_FIRST, work=None if potential else follower_work
        )
        return self.domain.energy("pressure", density, "pressure", from_initial=True)

    def _on_pressed(self, density_function: Callable[..., Expr]) -> Callable[..., Expr]:
        """Return the density of a pressure on the pressed cells alone.

        It takes `pressed_sides` as a further, last parameter; without pressed sides it is
        unchanged.
        """
        if self.pressed_sides is None:
            return density_function
        # the last argument is the field of sides, with one component: 1, -1 or 0
        return lambda *given: given[-1][0] * density_function(*given[:-1])

    def swept_volume(self) -> ufl.Form:
        """Return Delta V/R^3 of the modelled part, swept by the pressed cells.

        Points move straight from their undeformed places to their present ones.
        """
        return self._volume_integral(
            self._on_pressed(densities.swept_volume),
            *([] if self.pressed_sides is None else [self.pressed_sides]),
        )

    def volume_change(self, origin: Array) -> ufl.Form:
        """Return Delta V/R^3 of the modelled part, the volume between its surface and a point.

        `origin` (3,) over R is that point. It lies on all symmetry planes, so they add nothing.
        """
        return self._volume_integral(
            densities.volume, *([self._constant(origin)] if origin.any() else [])
        )

    def _volume_integral(
        self, density_function: Callable[..., Expr], *parameters: Expr
    ) -> ufl.Form:
        """Return the integral over the cells of a volume's density, from the initial placement.

        The initial placement has no imperfection that grows; `parameters` follow the jets.
        """
        jets = self.domain.jets_from_initial(self.domain.jet(self.u))
        return (
            self.domain.revolution_factor * density_function(*jets, *parameters) * self.domain.dx()
        )

    def user_energy(
        self, term: OwnTerm, facets: Facets | None = None, amplitude: str | None = None
    ) -> Energy:
        """Return the energy of a user's term, or of a term that a part of the package adds.

        Parameters
        ----------
        facets
            Facets of the term's edge; None for the surface.
        amplitude
            Amplitude in place of the term's name.
        """
        assert term.density  # a term without a density only observes
        # parts of the jet (such as "r" and "r1") that are needed of the placement but not of u
        reference_parts = tuple(part for part in term.placement_parts if part not in term.parts)
        density_function = _per_coordinates(term, term.at_point(term.density))
        parts = (*term.parts, *reference_parts)
        density = Density(
            density_function,
            self._parameters(term),
            parts=parts,
            linear=reference_parts,
            facets=facets,
        )
        density = self._mass_weighted(density) if term.of_volume else density
        return self.domain.energy(term.name, density, amplitude or term.name, linear=term.linear)

    def observed(self, term: OwnTerm, facets: Facets | None = None) -> dict[str, ufl.Form]:
        """Return the integrals over the modelled part that a term observes, by column name.

        `facets` are those of the term's edge; None for the surface.
        """
        parameters = self._parameters(term)
        by_column = {
            column: Density(
                _per_coordinates(term, term.at_point(observed_density)), parameters, facets=facets
            )
            for column, observed_density in term.observed.items()
        }
        if term.of_volume:
            by_column = {
                column: self._mass_weighted(density) for column, density in by_column.items()
            }
        return {column: self._over_area(density) for column, density in by_column.items()}

    def contact(self, contact: ContactBody) -> tuple[Energy, BodyContact]:
        """Return the energy of contact with a rigid body, and its state.

        Returns
        -------
        energy
            Penalty energy; the body's approach is a free parameter.
        body_contact
            State of the contact at quadrature points.
        """
        domain = self.domain
        # the body's displacement towards the shell over h, an amplitude
        approach = self.free_constants.setdefault(contact.amplitude, self._constant(0.0))
        rule, thins = domain.contact_rule, self.material.law.thins_somewhere
        thins_at = None
        if thins:
            thins_at = thickness_ratio_at_points(
                domain, self.u, self.natural, self.law_of_cells.thins
            )
        body_contact = BodyContact(
            contact, self.material.h, domain, self.u, approach, self.thickness, thins_at
        )
        parameters = body_contact.parameters
        # the gap depends on the place; where the shell thins, on its stretch too
        if thins:
            density = self._thinning(
                Density(per_area(thinned_energy), parameters, VALUE_AND_FIRST, quadrature=rule)
            )
        else:
            density = Density(per_area(contact_energy), parameters, ("r",), quadrature=rule)
        return domain.energy(f"contact {contact.body}", density), body_contact

    def _over_area(self, density: Density) -> ufl.Form:
        """Return the integral of a density at u over the modelled part."""
        return self.domain.revolution_factor * self.domain.integral(
            density, self.domain.jet(self.u)
        )

    def _parameters(self, term: OwnTerm) -> tuple[Parameter, ...]:
        return constants_of(term, self.domain.mesh, self.free_constants)

    def _constant(self, value: float | Array) -> fem.Constant:
        return self.domain.constant(value)

    def _over_ranks(self, value: float) -> float:
        return float(self.domain.mesh.comm.allreduce(value))

    def _with_thickness(self, density: Density) -> Density:
        """Return a density over E h weighted with h(x)/h, where that is not 1."""
        return density if self.thickness is None else thickness_weighted(density, self.thickness)

    def _thinning(self, density: Density) -> Density:
        """Return a density of a shell that thins, on the natural shape and by the law of each cell.

        The density's function takes a keyword `thins`: 1 where the thickness follows from the area,
        else 0. With laws that differ by shell it is each cell's own.
        """
        law, cell_materials = self.material.law, self.cell_materials
        density = grown(density, self.natural) if self.natural else density
        if cell_materials is None or not isinstance(law, LawByShell):
            return density

        def thinned(*arguments: Expr, **keywords: Any) -> Expr:
            """Return the density with the keyword `thins` of the cell's own law."""
            # the last parameter holds the cell's modulus, Poisson's ratio, mass density and law
            *own_arguments, material_numbers = arguments
            law_of_cell = law.with_material(
                material_numbers[0], material_numbers[1], material_numbers[3]
            )
            return density.function(*own_arguments, thins=law_of_cell.thins, **keywords)

        return replace(density, function=thinned, parameters=(*density.parameters, cell_materials))

    @property
    def law_of_cells(self) -> Law:
        """Material law of this rank's cells, for arrays (cells, n) of values at places in cells."""
        materials = self.cell_materials
        if materials is None:
            return self.material.law_in(None)
        dof_of_cells = materials.function_space.dofmap.list[:, 0]
        return self.material.law_in(materials.x.array.reshape(-1, 4)[dof_of_cells])

    def _mass_weighted(self, density: Density) -> Density:
        """Return a density per mass times thickness and mass density, where these vary."""
        density = self._with_thickness(density)
        if self.cell_materials is None:
            return density
        # component 2 of the material numbers is the mass density
        return thickness_weighted(density, self.cell_materials, 2)

    def _elastic_density(self, density: Density) -> Density:
        """Return an elastic density with the law, the thickness and the natural shape."""
        law = self.material.law
        # as constants, so that other numbers of the law need no new kernel
        law_constants = (self._constant(number) for number in law.numbers)
        density = elastic_density(
            density, law.with_numbers(*law_constants), self.thickness, self.cell_materials
        )
        return grown(density, self.natural) if self.natural else density

    @property
    def _penalty(self) -> fem.Constant:
        return self._constant(self.sigma)


def _per_coordinates(term: OwnTerm, density_function: Callable[..., Expr]) -> Callable[..., Expr]:
    """Return a term's density per area of the surface's coordinates.

    On an edge it is per length of the edge's parameter, with the arguments of `Density.function` on
    boundary edges.
    """
    if term.on is None:
        return per_area(density_function)

    def on_edge(r0: Jet, u: Jet, m: Expr, area: Expr, *parameters: Expr) -> Expr:
        # m: the edge's covector; the cell's area is for penalties, of which a term has none
        edge = Edge.of(r0, m)
        return density_function(r0, u, edge, *parameters) * edge.stretch

    return on_edge

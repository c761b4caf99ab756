"""The densities as terms: each compiled once, and only when a scene calls for it."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import ufl
from dolfinx import fem, mesh
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.models.shell import densities, edges
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.antisymmetric import antisymmetric_edge
from magshell_fenicsx.models.shell.energy import (
    Density,
    HessianTerm,
    MomentTerm,
    Parameter,
    ShellTerm,
    cell_quadrature,
    edge_quadrature,
    per_area,
)
from magshell_fenicsx.models.shell.free import Constants, constants_of
from magshell_fenicsx.models.shell.kinematics import CURVED, MOVED, SECOND, Jet
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import ACROSS, Magnetisation, Material
from magshell_fenicsx.models.shell.patterns import pattern_field
from magshell_fenicsx.models.shell.thickness import thick
from magshell_fenicsx.parts.bodies.contact import (
    Contact,
    Pressing,
    contact_energy,
    contact_pressure,
    contact_quadrature,
    pressed_radius,
)
from magshell_fenicsx.parts.magnetism.applied import AppliedField
from magshell_fenicsx.parts.magnetism.laws import FULL, LINEAR, magnetic_densities
from magshell_fenicsx.parts.natural.shape import Shape, grown


@dataclass(frozen=True)
class TermFactory:
    """Makes the terms of one shell; all share the fields r0 and u."""

    r0: fem.Function
    u: fem.Function
    material: Material
    sigma: float
    degree: int
    log: KernelLog
    thickness: fem.Function | None = None
    natural: Shape | None = None
    free: Constants = field(default_factory=dict)  # of parameters that enter freely
    folded: bool = False  # whether cells meet at angles that are not small
    fields: list[AppliedField] = field(default_factory=list)  # those made
    drawn: fem.Function | None = None  # the placement that volumes count from; None for r0

    def membrane(self) -> ShellTerm:
        density = Density(per_area(densities.membrane), (self._constant(self.material.nu),))
        return self._cells("membrane", self._thick(self._grown(density), None))

    def prestress(self) -> Density:
        """The part of the tangent that membrane stress makes; its last parameter but the thickness is the strain."""
        strain = fem.Function(fem.functionspace(self._domain, ("DG", 0, (3,))))
        density = Density(per_area(densities.prestress), (self._constant(self.material.nu), strain))
        return self._thick(self._grown(density), None)

    def bending(self) -> ShellTerm:
        density = Density(per_area(densities.bending), self._nu_h(), parts=CURVED)
        return self._cells("bending", self._thick(self._grown(density), 1))

    def interior_edges(self) -> ShellTerm:
        parameters = self._penalised() if self.thickness is None else (*self._penalised(), self.thickness)
        of = edges.folded if self.folded else edges.interior
        density = self._grown(Density(of, parameters, CURVED, SECOND, sides=2))
        r0, u = ((j.side("+"), j.side("-")) for j in self.jets())
        m = kin.facet_covector(self._domain)
        width = ufl.avg(ufl.CellVolume(self._domain)) / ufl.avg(ufl.FacetArea(self._domain))
        sided = [(p("+"), p("-")) if isinstance(p, fem.Function) else p for p in density.parameters]
        energy = density.of(r0, u, (m("+"), m("-")), width, *sided)
        return ShellTerm("interior edges", density, energy * self.interior_measure(), self.u, self.log)

    def clamped_edges(self, name: str, facets: NDArray[np.int32], turn: fem.Constant | None = None) -> ShellTerm:
        """`turn` is the rotation of an edge that moves."""
        parameters = (*self._penalised(), *([] if turn is None else [turn]))
        density = Density(edges.clamped, parameters, CURVED, SECOND, facets)
        return self._edges(name, self._thick(self._grown(density), 1))

    def mirror_edges(
        self, facets: NDArray[np.int32], normal: NDArray[np.float64], name: str = "mirror edges"
    ) -> ShellTerm:
        parameters = (*self._penalised(), self._constant(normal))
        density = Density(edges.symmetric, parameters, CURVED, SECOND, facets)
        return self._edges(name, self._thick(self._grown(density), 1))

    def edge_moment(self, name: str, facets: NDArray[np.int32], intensity: float, amplitude: str) -> MomentTerm:
        """A moment per length about the edge's first tangent; in E h R."""
        past = self._constant(np.array([1.0, 0.0]))
        density = Density(edges.turning, (self._constant(intensity), past), facets=facets)
        energy = density.of(*self.jets(), *self.edge_geometry(), *density.parameters) * self.ds(facets)
        along = kin.conormal(self.jets()[0], self.edge_geometry()[0])[2]
        length = self.log.compile(f"{name} length", along * self.ds(facets))
        total = self._domain.comm.allreduce(fem.assemble_scalar(length))
        term = MomentTerm(name, density, energy, self.u, self.log, amplitude)
        term.count_from(past, intensity * total)
        return term

    def antisymmetric_edges(self, facets: NDArray[np.int32], normal: NDArray[np.float64]) -> HessianTerm:
        """The mirror plane's edges under antisymmetric displacements."""
        parameters = (*self._penalised(), self._constant(normal))
        density = self._grown(Density(antisymmetric_edge, parameters, CURVED, facets=facets))
        v = fem.Function(self.u.function_space)
        jets = (*self.jets(), kin.jet(v, self._domain))
        energy = density.of(*jets, *self.edge_geometry(), *density.parameters) * self.ds(facets)
        return HessianTerm("antisymmetric edges", density, energy, v, self.log)

    def magnetic(self, field: Magnetisation) -> list[ShellTerm]:
        """The terms of the chosen energy, linear in the applied field, with the amplitude lambda_m."""
        pattern = field.remanent
        Br = pattern_field(pattern, self.r0)[0] if callable(pattern) else self._constant(pattern)
        if field.in_space:
            known = AppliedField(field.in_space, self.r0, self.u, cell_quadrature(self.degree), field.driven)
            self.fields.append(known)
            of = densities.in_space(FULL[field.law])
            density = self._thick(Density(per_area(of), (Br, known.polynomial), parts=MOVED), None)
            return [self._cells("magnetic", density, "lambda_m", follow=known.follow)]
        directions = [("lambda_m", "", field.applied)]
        directions += [(name, name.replace("lambda_", " "), Ba) for name, Ba in zip(ACROSS, field.across, strict=False)]
        terms = [
            self._cells(
                name + suffix,
                self._thick(Density(per_area(of), (Br, self._constant(Ba))), None),
                amplitude,
                linear=name in LINEAR,
            )
            for amplitude, suffix, Ba in directions
            for name, of in magnetic_densities(field.law, field.energy).items()
        ]
        if field.gradient is not None:
            parameters = (Br, self._constant(field.gradient))
            density = Density(per_area(densities.in_gradient(FULL[field.law])), parameters, parts=MOVED)
            terms.append(self._cells("magnetic gradient", self._thick(density, None), "lambda_m"))
        return terms

    def pressure(self, *, potential: bool) -> ShellTerm:
        """Amplitude p/p_c of a live pressure: the potential p Delta V, or its virtual work where it has none."""
        unit = self._constant(self.material.classical_pressure / self.material.h)
        work = None if potential else densities.following
        return self._cells(
            "pressure", Density(densities.swept, (unit,), parts=MOVED, work=work), "pressure", drawn=True
        )

    def swept_volume(self) -> ufl.Form:
        """Delta V/R^3 of the modelled part when its points move straight to their places."""
        return densities.swept(*self._jets_from_drawn()) * self.dx()

    def own(self, term: OwnTerm, amplitude: str | None = None) -> ShellTerm:
        """The energy of a part or one's own, with the amplitude of its name or another."""
        still = tuple(part for part in term.placed_parts if part not in term.parts)  # asked for of r0 alone
        parameters = self._parameters(term)
        density = Density(per_area(term.density), parameters, parts=(*term.parts, *still), linear=still)
        return self._cells(term.name, density, amplitude or term.name, linear=term.linear)

    def observed(self, term: OwnTerm) -> dict[str, ufl.Form]:
        """What it observes."""
        arguments = (*self.jets(), *self._parameters(term))
        return {column: per_area(of)(*arguments) * self.dx() for column, of in term.observed.items()}

    def contact(self, contact: Contact) -> tuple[ShellTerm, Pressing, dict[str, fem.Form]]:
        """The energy of a body, what it knows of it, and the integrals of its pressure and of that times its radius."""
        rule, approach = contact_quadrature(self.degree), self.free.setdefault(contact.amplitude, self._constant(0.0))
        known = Pressing(contact, self.material.h, self.r0, self.u, approach, rule, self.thickness)
        parameters = known.parameters
        density = Density(per_area(contact_energy), parameters, ("r",), quadrature=rule)
        term = self._cells(f"contact {contact.body}", density, follow=known.follow)
        arguments, dx = (*self.jets(), *parameters), self.dx(rule)
        of_radius = pressed_radius(self._constant(contact.front), self._constant(contact.direction))
        seen: dict[str, Callable[..., Expr]] = {"pressure": contact_pressure, "radius": of_radius}
        return term, known, {name: per_area(of)(*arguments) * dx for name, of in seen.items()}

    def _parameters(self, term: OwnTerm) -> tuple[fem.Constant, ...]:
        return constants_of(term, self._domain, self.free)

    def volume_change(self, origin: NDArray[np.float64]) -> ufl.Form:
        """Delta V/R^3 of the modelled part, between it and a point of all its symmetry planes."""
        return (
            densities.volume(*self._jets_from_drawn(), *([self._constant(origin)] if origin.any() else [])) * self.dx()
        )

    @property
    def _domain(self) -> mesh.Mesh:
        return self.u.function_space.mesh

    def jets(self) -> tuple[Jet, Jet]:
        return kin.jet(self.r0, self._domain), kin.jet(self.u, self._domain)

    def _jets_from_drawn(self) -> tuple[Jet, Jet]:
        """Those of the drawn placement and of the displacement from there."""
        r0, u = self.jets()
        drawn = kin.jet(self.drawn, self._domain) if self.drawn else r0
        return (drawn, r0 + u - drawn) if self.drawn else (r0, u)

    def _constant(self, value: float | NDArray[np.float64]) -> fem.Constant:
        return fem.Constant(self._domain, value)

    def _thick(self, density: Density, h_at: int | None) -> Density:
        """The density with the thickness as it varies, if it does; `h_at` as of `thickness.thick`."""
        return density if self.thickness is None else thick(density, self.thickness, h_at)

    def _grown(self, density: Density) -> Density:
        """The density of the natural shape, if there is one."""
        return grown(density, self.natural) if self.natural else density

    def _nu_h(self) -> tuple[Parameter, Parameter]:
        return self._constant(self.material.nu), self._constant(self.material.h)

    def _penalised(self) -> tuple[Parameter, ...]:
        return *self._nu_h(), self._constant(self.sigma)

    def dx(self, rule: int | None = None) -> ufl.Measure:
        metadata = {"quadrature_degree": rule or cell_quadrature(self.degree)}
        return ufl.Measure("dx", domain=self._domain, metadata=metadata)

    def _edge_rule(self) -> dict[str, int]:
        return {"quadrature_degree": edge_quadrature(self.degree)}

    def interior_measure(self) -> ufl.Measure:
        return ufl.dS(domain=self._domain, metadata=self._edge_rule())

    def ds(self, facets: NDArray[np.int32]) -> ufl.Measure:
        tags = mesh.meshtags(self._domain, 1, facets, np.ones_like(facets))
        return ufl.Measure("ds", domain=self._domain, subdomain_data=tags, metadata=self._edge_rule())(1)

    def edge_geometry(self) -> tuple[Expr, Expr]:
        """Covector and width of a boundary edge."""
        return kin.facet_covector(self._domain), ufl.CellVolume(self._domain) / ufl.FacetArea(self._domain)

    def _cells(
        self,
        name: str,
        density: Density,
        amplitude: str | None = None,
        *,
        linear: bool = False,
        follow: Callable[[], None] | None = None,
        drawn: bool = False,
    ) -> ShellTerm:
        jets, work = self._jets_from_drawn() if drawn else self.jets(), None
        energy = density.of(*jets, *density.parameters) * self.dx(density.quadrature)
        if density.work:
            v = kin.jet(ufl.TestFunction(self.u.function_space), self._domain)
            work = density.work(*self.jets(), v, *density.parameters) * self.dx()
        return ShellTerm(name, density, energy, self.u, self.log, amplitude, linear=linear, work=work, follow=follow)

    def _edges(self, name: str, density: Density) -> ShellTerm:
        assert density.facets is not None
        energy = density.of(*self.jets(), *self.edge_geometry(), *density.parameters) * self.ds(density.facets)
        return ShellTerm(name, density, energy, self.u, self.log)

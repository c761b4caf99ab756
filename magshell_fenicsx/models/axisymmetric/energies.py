"""The shell's densities integrated over the meridian, per radian of the azimuth.

Each energy is a function of the jet of a displacement, so that the same one serves the
axisymmetric displacement and the waves added to it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import ufl
from dolfinx import fem, mesh
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.models.axisymmetric import jets
from magshell_fenicsx.models.axisymmetric.meridian import Meridian
from magshell_fenicsx.models.axisymmetric.pattern import pattern_field
from magshell_fenicsx.models.shell import densities, edges
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.densities import MagneticDensity
from magshell_fenicsx.models.shell.energy import Density
from magshell_fenicsx.models.shell.free import Constants, constants_of
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import Magnetisation, Material
from magshell_fenicsx.parts.bodies.contact import Contact, Pressing, contact_energy, contact_pressure, pressed_radius
from magshell_fenicsx.parts.magnetism.applied import AppliedField
from magshell_fenicsx.parts.magnetism.laws import FULL, LINEAR, magnetic_densities
from magshell_fenicsx.parts.natural.shape import Forms, Shape

INTERIOR = "interior edges"
CONTACT = 6  # degree of the rule of a contact over that of the displacement: points are cheap on a meridian
Facets = NDArray[np.int32]
Integral = Callable[[Expr], ufl.Form]


@dataclass(frozen=True)
class Energy:
    """One term: its energy per radian as a function of the displacement's jet; see `Term`.

    `work` of the jets of u and v is the virtual work of a load without potential, quadratic in u.
    """

    name: str
    of: Callable[[Jet], ufl.Form]
    amplitude: str | None = None
    linear: bool = False
    work: Callable[[Jet, Jet], ufl.Form] | None = None
    follow: Callable[[], None] | None = None

    def added(self, u: Jet, v: Jet) -> ufl.Form:
        """A form with the Hessian in v, at v = 0, of the energy of u + v; a work gives its symmetric part."""
        if self.work is None:
            return self.of(u + v)
        return 0.25 * (self.work(u + v, v) - self.work(u - v, v))


@dataclass(frozen=True)
class EnergyFactory:
    """Makes the energies of one meridian; all share the placement r0.

    Attributes
    ----------
    thickness
        What multiplies h, (1,); None for 1.
    natural
        The natural shape; None if it is the drawn one.
    """

    meridian: Meridian
    r0: fem.Function
    material: Material
    sigma: float
    degree: int
    thickness: fem.Function | None = None
    natural: Shape | None = None
    free: Constants = field(default_factory=dict)  # of parameters that enter freely
    fields: list[AppliedField] = field(default_factory=list)  # those made
    drawn: fem.Function | None = None  # the placement that volumes count from; None for r0

    def membrane(self) -> Energy:
        j0, t, nu = self.j0, self._t, self.constant(self.material.nu)
        natural = self._natural()
        return self._cells("membrane", lambda u: t * densities.membrane(j0, u, nu, natural))

    def bending(self) -> Energy:
        j0, t, (nu, h) = self.j0, self._t, self._nu_h()
        natural = self._natural()
        return self._cells("bending", lambda u: t * densities.bending(j0, u, nu, t * h, natural))

    def interior_edges(self) -> Energy:
        """Folds between cells: the interior edges of the meridian are circles."""
        j0, nu, h, sigma = self.j0, *self._nu_h(), self.constant(self.sigma)
        dS = ufl.Measure("dS", domain=self.meridian.mesh)
        t = self.thickness and (self.thickness("+"), self.thickness("-"))
        m, width = self.covector(), ufl.avg(self.width())
        plus, minus = self._natural("+"), self._natural("-")
        natural = (plus, minus) if plus and minus else None

        def energy(u: Jet) -> ufl.Form:
            r0, v = ((j.side("+"), j.side("-")) for j in (j0, u))
            return edges.interior(r0, v, (m("+"), m("-")), width, nu, h, sigma, t, natural=natural) * dS

        return Energy(INTERIOR, energy)

    def clamped_edges(self, name: str, facets: Facets, turn: fem.Constant | None = None) -> Energy:
        """The normal is held at an end, which may turn."""
        return self._ends(name, edges.clamped, facets, *([] if turn is None else [turn]))

    def mirror_edges(self, facets: Facets) -> Energy:
        """A plane normal to e3 mirrors the shell at some ends."""
        return self._ends("mirror edges", edges.symmetric, facets, self.constant(np.array([0.0, 0.0, 1.0])))

    def moment(self, name: str, facets: Facets, density: Density, amplitude: str) -> Energy:
        """A moment per length about an edge; `density` as of `TermFactory.edge_moment`."""
        j0, ds, m, width = self.j0, self.ds(facets), self.covector(), self.width()
        return Energy(name, lambda u: density.of(j0, u, m, width, *density.parameters) * ds, amplitude)

    def magnetic(self, field: Magnetisation, u: fem.Function) -> list[Energy]:
        """The terms of the chosen energy for axisymmetric fields; all have the amplitude lambda_m.

        A field in space is known at the displacement u, of the meridian.
        """
        j0, t, pattern = self.j0, self._t, field.remanent
        Br = pattern_field(pattern, self.r0)[0] if callable(pattern) else self.constant(pattern)

        def term(name: str, density: MagneticDensity, Ba: Expr) -> Energy:
            return self._cells(name, lambda u: t * density(j0, u, Br, Ba), "lambda_m", linear=name in LINEAR)

        if field.in_space:
            known = AppliedField(field.in_space, self.r0, u, self._quadrature, field.driven)
            self.fields.append(known)
            return [
                replace(term("magnetic", densities.in_space(FULL[field.law]), known.polynomial), follow=known.follow)
            ]
        Ba = self.constant(field.applied)
        terms = [term(name, density, Ba) for name, density in magnetic_densities(field.law, field.energy).items()]
        if field.gradient is not None:
            density = densities.in_gradient(FULL[field.law])
            terms.append(term("magnetic gradient", density, self.constant(field.gradient)))
        return terms

    def pressure(self, *, potential: bool) -> Energy:
        """Amplitude p/p_c of a live pressure: the potential p Delta V, or its virtual work where it has none."""
        j0, unit = self.j0, self.constant(self.material.classical_pressure / self.material.h)

        def work(u: Jet, v: Jet) -> ufl.Form:
            return densities.following(j0, u, v, unit) * self.dx()

        return Energy("pressure", lambda u: unit * self.swept_volume(u), "pressure", work=None if potential else work)

    def swept_volume(self, u: Jet) -> ufl.Form:
        """Delta V/R^3 per radian when its points move straight to their places."""
        return densities.swept(*self._from_drawn(u)) * self.dx()

    def own(self, term: OwnTerm, amplitude: str | None = None) -> Energy:
        """The energy of a part or one's own, with the amplitude of its name or another; it shares the symmetry."""
        return self._cells(term.name, self._surface(term, term.density), amplitude or term.name, linear=term.linear)

    def observed(self, term: OwnTerm, u: Jet) -> dict[str, ufl.Form]:
        """What it observes, of the whole shell."""
        return {
            column: 2 * np.pi * self._cells(column, self._surface(term, of)).of(u)
            for column, of in term.observed.items()
        }

    def contact(self, contact: Contact, u: fem.Function) -> tuple[Energy, Pressing, dict[str, ufl.Form]]:
        """As that of `shell.terms`; the integrals are of the whole shell."""
        rule, approach = CONTACT * self.degree, self.free.setdefault(contact.amplitude, self.constant(0.0))
        known = Pressing(contact, self.material.h, self.r0, u, approach, rule, self.thickness)
        j0, parameters = self.j0, known.parameters
        dx = ufl.Measure("dx", domain=self.meridian.mesh, metadata={"quadrature_degree": rule})

        def over(of: Callable[..., Expr]) -> Callable[[Jet], ufl.Form]:
            return lambda v: of(j0, v, *parameters) * kin.area_ratio(j0) * dx

        of_radius = pressed_radius(self.constant(contact.front), self.constant(contact.direction))
        seen: dict[str, Callable[..., Expr]] = {"pressure": contact_pressure, "radius": of_radius}
        integrals = {name: 2 * np.pi * over(of)(jets.revolved(u)) for name, of in seen.items()}
        return Energy(f"contact {contact.body}", over(contact_energy), follow=known.follow), known, integrals

    def _surface(self, term: OwnTerm, of: Callable[..., Expr]) -> Callable[[Jet], Expr]:
        j0, parameters = self.j0, constants_of(term, self.meridian.mesh, self.free)
        return lambda u: of(j0, u, *parameters)

    def volume_change(self, u: Jet) -> ufl.Form:
        """Delta V/R^3 per radian."""
        return densities.volume(*self._from_drawn(u)) * self.dx()

    def _from_drawn(self, u: Jet) -> tuple[Jet, Jet]:
        """The jets of the drawn placement and of the displacement from there."""
        if self.drawn is None:
            return self.j0, u
        drawn = jets.revolved(self.drawn)
        return drawn, self.j0 + u - drawn

    def area(self) -> Integral:
        """Over the undeformed area, per radian as all of these."""
        ratio = kin.area_ratio(self.j0)
        return lambda f: f * ratio * self.dx()

    def around(self, facets: Facets) -> Integral:
        """Along the undeformed circle of an end."""
        return lambda f: f * self.r0[0] * self.ds(facets)

    def at_pole(self) -> Integral:
        """The value on the axis, over 2 pi."""
        return lambda f: f / (2 * np.pi) * self.ds(self.meridian.axis)

    def patch(self, radius: float) -> Integral:
        """Of f (1 - d^2/radius^2)^2, d the distance in space from the pole."""
        a, pole = self.constant(radius), self.constant(self.meridian.section(np.zeros(1))[0])
        inside = 1 - ufl.dot(self.r0 - pole, self.r0 - pole) / a**2
        weight, over = ufl.conditional(ufl.gt(inside, 0), inside**2, 0), self.area()
        return lambda f: over(weight * f)

    @property
    def j0(self) -> Jet:
        """Of the placement."""
        return jets.revolved(self.r0)

    def constant(self, value: float | NDArray[np.float64]) -> fem.Constant:
        """A number or a vector in a form."""
        return fem.Constant(self.meridian.mesh, value)

    @property
    def _t(self) -> Expr | float:
        return 1.0 if self.thickness is None else self.thickness[0]

    def _natural(self, side: str = "") -> Forms | None:
        if self.natural is None:
            return None
        field, *amplitudes = self.natural.parameters
        if not side:
            return self.natural.forms(self.j0, field, *amplitudes)
        return self.natural.forms(self.j0.side(side), field(side), *amplitudes)

    def _nu_h(self) -> tuple[fem.Constant, fem.Constant]:
        return self.constant(self.material.nu), self.constant(self.material.h)

    def dx(self) -> ufl.Measure:
        """Of the cells, in the meridian's parameter."""
        return ufl.Measure("dx", domain=self.meridian.mesh, metadata={"quadrature_degree": self._quadrature})

    @property
    def _quadrature(self) -> int:
        return 2 * self.degree + 2  # one point more than the surface's 2k: on the axis the densities are rational

    def ds(self, facets: Facets) -> ufl.Measure:
        """Of some ends."""
        tags = mesh.meshtags(self.meridian.mesh, 0, facets, np.ones_like(facets))
        return ufl.Measure("ds", domain=self.meridian.mesh, subdomain_data=tags)(1)

    def covector(self) -> Expr:
        """Of an edge, see `kinematics.conormal`: its length is then that per radian."""
        return ufl.as_vector([ufl.FacetNormal(self.meridian.mesh)[0], 0])

    def width(self) -> Expr:
        """Half the length of a cell, as the triangles of the surface have half their height."""
        return ufl.CellVolume(self.meridian.mesh) / 2 * ufl.sqrt(ufl.dot(self.j0.r1, self.j0.r1))

    def _cells(
        self, name: str, density: Callable[[Jet], Expr], amplitude: str | None = None, *, linear: bool = False
    ) -> Energy:
        over = self.area()
        return Energy(name, lambda u: over(density(u)), amplitude, linear)

    def _ends(self, name: str, density: Callable[..., Expr], facets: Facets, *rest: Expr) -> Energy:
        """The bending energy of ends whose normal does not turn freely."""
        j0, t, nu, h, sigma = self.j0, self._t, *self._nu_h(), self.constant(self.sigma)
        ds, m, width, natural = self.ds(facets), self.covector(), self.width(), self._natural()
        return Energy(name, lambda u: t * density(j0, u, m, width, nu, t * h, sigma, *rest, natural=natural) * ds)

"""The shell's densities integrated over the meridian, per radian of the azimuth.

Each energy is a function of the jet of a displacement, so that the same one serves the
axisymmetric displacement and the waves added to it.
"""

from collections.abc import Callable
from dataclasses import dataclass

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
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import Magnetisation, Material
from magshell_fenicsx.models.shell.terms import LINEAR, MAGNETIC_TERMS

INTERIOR = "interior edges"


@dataclass(frozen=True)
class Energy:
    """One term: its energy per radian as a function of the displacement's jet; see `Term`."""

    name: str
    of: Callable[[Jet], ufl.Form]
    amplitude: str | None = None
    linear: bool = False


@dataclass(frozen=True)
class EnergyFactory:
    """Makes the energies of one meridian; all share the placement r0."""

    meridian: Meridian
    r0: fem.Function
    material: Material
    sigma: float
    degree: int

    def membrane(self) -> Energy:
        j0, nu = self._j0, self._constant(self.material.nu)
        return self._cells("membrane", lambda u: densities.membrane(j0, u, nu))

    def bending(self) -> Energy:
        j0, nu, h = self._j0, *self._nu_h()
        return self._cells("bending", lambda u: densities.bending(j0, u, nu, h))

    def interior_edges(self) -> Energy:
        """Folds between cells: the interior edges of the meridian are circles."""
        j0, nu, h, sigma = self._j0, *self._nu_h(), self._constant(self.sigma)
        dS = ufl.Measure("dS", domain=self.meridian.mesh)
        nus = {s: (self._conormal(j0)(s), 0) for s in "+-"}
        width, radius = ufl.avg(self._width(j0)), ufl.avg(self.r0[0])

        def jump(j: Jet) -> Expr:
            return edges.fold_jump(j.side("+"), j.side("-"), nus["+"], nus["-"])

        def energy(u: Jet) -> ufl.Form:
            M = sum(densities.normal_moment(j0.side(s), u.side(s), *nus[s], nu, h) for s in "+-") / 2
            return edges.edge_density(M, jump(j0 + u) - jump(j0), width, nu, h, sigma) * radius * dS

        return Energy(INTERIOR, energy)

    def clamped_edges(self, facets: NDArray[np.int32]) -> Energy:
        """The normal is held at n0 at some ends."""
        j0, nu, h, sigma = self._j0, *self._nu_h(), self._constant(self.sigma)
        tags = mesh.meshtags(self.meridian.mesh, 0, facets, np.ones_like(facets))
        ds = ufl.Measure("ds", domain=self.meridian.mesh, subdomain_data=tags)(1)
        nu1 = self._conormal(j0)

        def energy(u: Jet) -> ufl.Form:
            r = j0 + u
            M = densities.normal_moment(j0, u, nu1, 0, nu, h)
            J = -ufl.dot(kin.normal(j0) - kin.normal(r), r.r1 * nu1)
            return edges.edge_density(M, J, self._width(j0), nu, h, sigma) * self.r0[0] * ds

        return Energy("clamped edges", energy)

    def magnetic(self, field: Magnetisation) -> list[Energy]:
        """The terms of the chosen energy for axisymmetric fields; all have the amplitude lambda_m."""
        j0, pattern = self._j0, field.remanent
        Br = pattern_field(pattern, self.r0) if callable(pattern) else self._constant(pattern)
        Ba = self._constant(field.applied)

        def term(name: str, density: Callable[[Jet, Jet, Expr, Expr], Expr]) -> Energy:
            return self._cells(name, lambda u: density(j0, u, Br, Ba), "lambda_m", linear=name in LINEAR)

        terms = [term(name, density) for name, density in MAGNETIC_TERMS[field.energy].items()]
        if field.gradient is not None:
            G = self._constant(field.gradient)
            terms.append(
                self._cells("magnetic gradient", lambda u: densities.magnetic_gradient(j0, u, Br, G), "lambda_m")
            )
        return terms

    def pressure(self) -> Energy:
        """Amplitude p/p_c; potential p Delta V, of a live pressure."""
        unit = self._constant(self.material.classical_pressure / self.material.h)
        return Energy("pressure", lambda u: unit * self.volume_change(u), "pressure")

    def own(self, term: OwnTerm) -> Energy:
        """One's own energy, with the amplitude of its name; it shares the symmetry."""
        j0, parameters = self._j0, [self._constant(np.asarray(p, dtype=float)) for p in term.parameters]
        return self._cells(term.name, lambda u: term.density(j0, u, *parameters), term.name, linear=term.linear)

    def volume_change(self, u: Jet) -> ufl.Form:
        """Delta V/R^3 per radian."""
        return densities.volume(self._j0, u) * self._dx()

    def patch(self, radius: float) -> Callable[[Expr], ufl.Form]:
        """Integral of f (1 - d^2/radius^2)^2 per radian, d the distance in space from the pole."""
        a = self._constant(radius)
        pole = self._constant(self.meridian.embedding(np.zeros((1, 2)))[0, [0, 2]])
        inside = 1 - ufl.dot(self.r0 - pole, self.r0 - pole) / a**2
        weight = ufl.conditional(ufl.gt(inside, 0), inside**2, 0) * kin.area_ratio(self._j0)
        return lambda f: weight * f * self._dx()

    @property
    def _j0(self) -> Jet:
        return jets.revolved(self.r0)

    def _constant(self, value: float | NDArray[np.float64]) -> fem.Constant:
        return fem.Constant(self.meridian.mesh, value)

    def _nu_h(self) -> tuple[fem.Constant, fem.Constant]:
        return self._constant(self.material.nu), self._constant(self.material.h)

    def _dx(self) -> ufl.Measure:
        # one point more than the surface's 2k: on the axis the densities are rational
        return ufl.Measure("dx", domain=self.meridian.mesh, metadata={"quadrature_degree": 2 * self.degree + 2})

    def _conormal(self, j0: Jet) -> Expr:
        """nu^1 of the undeformed outward unit conormal; nu^2 = 0."""
        return ufl.FacetNormal(self.meridian.mesh)[0] / ufl.sqrt(ufl.dot(j0.r1, j0.r1))

    def _width(self, j0: Jet) -> Expr:
        """Half the length of a cell, as the triangles of the surface have half their height."""
        return ufl.CellVolume(self.meridian.mesh) / 2 * ufl.sqrt(ufl.dot(j0.r1, j0.r1))

    def _cells(
        self, name: str, density: Callable[[Jet], Expr], amplitude: str | None = None, *, linear: bool = False
    ) -> Energy:
        ratio = kin.area_ratio(self._j0)
        return Energy(name, lambda u: density(u) * ratio * self._dx(), amplitude, linear)

"""The densities as terms: each compiled once, and only when a scene calls for it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import ufl
from dolfinx import fem, mesh
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.shell import densities, edges
from magshell_fenicsx.shell import kinematics as kin
from magshell_fenicsx.shell.antisymmetric import HessianTerm, antisymmetric_edge
from magshell_fenicsx.shell.kinematics import Jet
from magshell_fenicsx.shell.parameters import MIRROR_NORMAL, MagneticEnergy, Magnetisation, Material
from magshell_fenicsx.shell.patterns import pattern_field
from magshell_fenicsx.solve.kernels import KernelLog
from magshell_fenicsx.solve.terms import FormTerm

Density = Callable[[Jet, Jet, Expr, Expr], Expr]
FIRST: dict[str, Density] = {"U1": densities.magnetic_first}
TORQUE: dict[str, Density] = {"Uq": densities.magnetic_torque}
SECOND: dict[str, Density] = {**FIRST, **TORQUE, "Utau": densities.magnetic_tau}
MAGNETIC_TERMS: dict[MagneticEnergy, dict[str, Density]] = {
    "full": {"magnetic": densities.magnetic},
    "first": FIRST,
    "torque": TORQUE,
    "second": SECOND,
    "second_consistent": {**SECOND, "couple": densities.magnetic_couple},
}
LINEAR = ("U1", "couple")


@dataclass(frozen=True)
class TermFactory:
    """Makes the terms of one shell; all share the fields r0 and u."""

    r0: fem.Function
    u: fem.Function
    material: Material
    sigma: float
    degree: int
    log: KernelLog

    def membrane(self) -> FormTerm:
        return self._cells("membrane", densities.membrane(*self._jets(), self._constant(self.material.nu)))

    def bending(self) -> FormTerm:
        return self._cells("bending", densities.bending(*self._jets(), *self._nu_h()))

    def interior_edges(self) -> FormTerm:
        density = edges.interior(*self._jets(), self._domain, *self._nu_h(), self._constant(self.sigma))
        return self._term("interior edges", density * ufl.dS(domain=self._domain, metadata=self._edge_rule()))

    def clamped_edges(self, facets: NDArray[np.int32]) -> FormTerm:
        density = edges.clamped(*self._jets(), self._domain, *self._nu_h(), self._constant(self.sigma))
        return self._term("clamped edges", density * self._ds(facets))

    def mirror_edges(self, facets: NDArray[np.int32]) -> FormTerm:
        m = self._constant(MIRROR_NORMAL)
        density = edges.symmetric(*self._jets(), self._domain, *self._nu_h(), self._constant(self.sigma), m)
        return self._term("mirror edges", density * self._ds(facets))

    def antisymmetric_edges(self, facets: NDArray[np.int32]) -> HessianTerm:
        """The mirror plane's edges under antisymmetric displacements."""
        V = self.u.function_space
        m, v = self._constant(MIRROR_NORMAL), fem.Function(V)
        jets = (*self._jets(), kin.jet(v, self._domain))
        density = antisymmetric_edge(*jets, self._domain, *self._nu_h(), self._constant(self.sigma), m)
        gradient = ufl.derivative(density * self._ds(facets), v, ufl.TestFunction(V))
        hessian = ufl.derivative(gradient, v, ufl.TrialFunction(V))
        return HessianTerm("antisymmetric edges", self.log.compile("antisymmetric edges tangent", hessian))

    def magnetic(self, field: Magnetisation) -> list[FormTerm]:
        """The terms of the chosen energy, linear in the applied field, with the amplitude lambda_m."""
        pattern = field.remanent
        Br = pattern_field(pattern, self.r0) if callable(pattern) else self._constant(pattern)
        directions = [("lambda_m", "", field.applied)]
        if field.across is not None:
            directions.append(("lambda_across", " across", field.across))
        terms = [
            self._cells(name + suffix, density(*self._jets(), Br, self._constant(Ba)), amplitude, linear=name in LINEAR)
            for amplitude, suffix, Ba in directions
            for name, density in MAGNETIC_TERMS[field.energy].items()
        ]
        if field.gradient is not None:
            density = densities.magnetic_gradient(*self._jets(), Br, self._constant(field.gradient))
            terms.append(self._cells("magnetic gradient", density, "lambda_m"))
        return terms

    def pressure(self) -> FormTerm:
        """Amplitude p/p_c; potential p Delta V, of a live pressure."""
        unit = self._constant(self.material.classical_pressure / self.material.h)
        return self._term("pressure", unit * self.volume_change(), "pressure")

    def volume_change(self) -> ufl.Form:
        """Delta V/R^3 of the modelled part."""
        return densities.volume(*self._jets()) * self._dx()

    @property
    def _domain(self) -> mesh.Mesh:
        return self.u.function_space.mesh

    def _jets(self) -> tuple[kin.Jet, kin.Jet]:
        return kin.jet(self.r0, self._domain), kin.jet(self.u, self._domain)

    def _constant(self, value: float | NDArray[np.float64]) -> fem.Constant:
        return fem.Constant(self._domain, value)

    def _nu_h(self) -> tuple[fem.Constant, fem.Constant]:
        return self._constant(self.material.nu), self._constant(self.material.h)

    def _dx(self) -> ufl.Measure:
        return ufl.Measure("dx", domain=self._domain, metadata={"quadrature_degree": 2 * self.degree})

    def _edge_rule(self) -> dict[str, int]:
        # two degrees below the cells' rule: F at w/h = 20 moves by 2e-5, the edges cost a fifth less
        return {"quadrature_degree": 2 * self.degree - 2}

    def _ds(self, facets: NDArray[np.int32]) -> ufl.Measure:
        tags = mesh.meshtags(self._domain, 1, facets, np.ones_like(facets))
        return ufl.Measure("ds", domain=self._domain, subdomain_data=tags, metadata=self._edge_rule())(1)

    def _cells(self, name: str, density: Expr, amplitude: str | None = None, *, linear: bool = False) -> FormTerm:
        energy = density * kin.area_ratio(kin.jet(self.r0, self._domain)) * self._dx()
        return FormTerm(name, energy, self.u, self.log, amplitude, linear=linear)

    def _term(self, name: str, energy: ufl.Form, amplitude: str | None = None) -> FormTerm:
        return FormTerm(name, energy, self.u, self.log, amplitude)

"""The densities as terms: each compiled once, and only when a scene calls for it."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import ufl
from dolfinx import fem, mesh
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.terms import DensityTerm
from magshell_fenicsx.mesh.hexahedra import OUTER, Body
from magshell_fenicsx.models.shell.energy import per_area
from magshell_fenicsx.models.shell.free import Constants, constants_of
from magshell_fenicsx.models.shell.kinematics import SECOND, Jet
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import Magnetisation
from magshell_fenicsx.models.solid import densities
from magshell_fenicsx.models.solid.material import NeoHookean

WHOLE, REDUCED = 5, 3  # quadrature degrees: three and two points in each direction
VALUE, GRADIENT, ON_FACE = (0,), (1, 2, 3), (0, 1, 2)  # parts of a displacement's jet: value, reference derivatives


@dataclass(frozen=True)
class Density:
    """The one source of a term's form and of its point Hessians.

    Attributes
    ----------
    of
        In the body of (X, u, H, *parameters) per volume, see `densities`; on its outer face of
        (X, X1, X2, u, u1, u2, *parameters) per area of the reference cell.
    parts
        The parts of the displacement's jet that it depends on.
    degree
        Of the quadrature.
    """

    of: Callable[..., Expr]
    parameters: tuple[fem.Constant, ...]
    parts: tuple[int, ...] = GRADIENT
    degree: int = WHOLE
    on_face: bool = False


class SolidTerm(DensityTerm[Density]):
    """A term of a solid."""


@dataclass(frozen=True)
class TermFactory:
    """Makes the terms of one body."""

    body: Body
    u: fem.Function
    material: NeoHookean
    h: float
    log: KernelLog
    free: Constants = field(default_factory=dict)  # of parameters that enter freely

    def distortion(self) -> SolidTerm:
        return self._bulk("distortion", Density(densities.distortion, self._constants(self.material.shear, self.h)))

    def compression(self) -> SolidTerm:
        """With two quadrature points in each direction: more constraints on J than that would lock the element.

        The same as a discontinuous trilinear pressure, eliminated (Malkus and Hughes, Comput. Methods Appl.
        Mech. Eng. 15, 1978), so the tangent is that of displacements alone and its inertia tells stability.
        """
        parameters = self._constants(self.material.bulk, self.h)
        return self._bulk("compression", Density(densities.compression, parameters, degree=REDUCED))

    def magnetic(self, field: Magnetisation) -> list[SolidTerm]:
        """The terms, linear in the applied field, with the amplitude lambda_m."""
        assert not callable(field.remanent)
        directions = [("lambda_m", "", field.applied)]
        if field.across is not None:
            directions.append(("lambda_across", " across", field.across))
        terms = []
        for amplitude, suffix, Ba in directions:
            density = Density(densities.magnetic, self._constants(field.remanent, Ba, self.h))
            terms.append(self._bulk("magnetic" + suffix, density, amplitude, linear=True))
        if field.gradient is not None:
            parameters = self._constants(field.remanent, field.gradient, self.h)
            density = Density(densities.magnetic_gradient, parameters, VALUE + GRADIENT)
            terms.append(self._bulk("magnetic gradient", density, "lambda_m"))
        return terms

    def pressure(self, classical: float, origin: NDArray[np.float64]) -> SolidTerm:
        """Amplitude p/p_c, `classical` being p_c/E; on the outer face, `origin` in the mirror plane of a half."""
        parameters = self._constants(classical / self.h, *([origin] if origin.any() else []))
        density = Density(densities.pressure, parameters, ON_FACE, on_face=True)
        return SolidTerm("pressure", density, self._on_face(density), self.u, self.log, "pressure")

    def own(self, term: OwnTerm) -> SolidTerm:
        """The energy of a part or one's own on the outer face, with the amplitude of its name."""
        density = self._surface(term, term.density)
        energy = self._on_face(density)
        return SolidTerm(term.name, density, energy, self.u, self.log, term.name, linear=term.linear)

    def observed(self, term: OwnTerm) -> dict[str, ufl.Form]:
        """What it observes on the outer face."""
        return {column: self._on_face(self._surface(term, of)) for column, of in term.observed.items()}

    def _surface(self, term: OwnTerm, of: Callable[..., Expr]) -> Density:
        """Of the mid-surface's density the same on the outer face, per area of the reference cell."""
        flat = [ufl.zero(3)] * len(SECOND)

        def on_face(X: Expr, X1: Expr, X2: Expr, u: Expr, u1: Expr, u2: Expr, *parameters: Expr) -> Expr:
            return per_area(of)(Jet(X, X1, X2, *flat), Jet(u, u1, u2, *flat), *parameters)

        parameters = constants_of(term, self.u.function_space.mesh, self.free)
        return Density(on_face, parameters, ON_FACE, on_face=True)

    def volume_change(self, origin: NDArray[np.float64]) -> ufl.Form:
        """Delta V/R^3 under the outer face of the modelled part."""
        parameters = self._constants(1.0, *([origin] if origin.any() else []))
        return self._on_face(Density(densities.pressure, parameters, on_face=True))

    def outer_measure(self) -> ufl.Measure:
        """Area of the undeformed outer face."""
        facets = np.sort(self.body.faces[OUTER])
        return face_measure(self.body.mesh, facets)

    def _bulk(self, name: str, density: Density, amplitude: str | None = None, *, linear: bool = False) -> SolidTerm:
        domain, u = self.body.mesh, self.u
        X = ufl.SpatialCoordinate(domain)
        dx = ufl.Measure("dx", domain=domain, metadata={"quadrature_degree": density.degree})
        energy = density.of(X, u, ufl.grad(u), *density.parameters) * dx
        return SolidTerm(name, density, energy, self.u, self.log, amplitude, linear=linear)

    def _on_face(self, density: Density) -> ufl.Form:
        domain, u = self.body.mesh, self.u
        X, J = ufl.SpatialCoordinate(domain), ufl.Jacobian(domain)
        X1, X2 = J[:, 0], J[:, 1]
        area = ufl.cross(X1, X2)
        per_area = density.of(X, X1, X2, u, ufl.grad(u) * X1, ufl.grad(u) * X2, *density.parameters)
        return per_area / ufl.sqrt(ufl.dot(area, area)) * self.outer_measure()

    def _constants(self, *values: float | NDArray[np.float64]) -> tuple[fem.Constant, ...]:
        return tuple(fem.Constant(self.body.mesh, value) for value in values)


def face_measure(domain: mesh.Mesh, facets: NDArray[np.int32]) -> ufl.Measure:
    """Undeformed area of some facets, given in ascending order."""
    tags = mesh.meshtags(domain, 2, facets, np.ones_like(facets))
    return ufl.Measure("ds", domain=domain, subdomain_data=tags, metadata={"quadrature_degree": WHOLE})(1)

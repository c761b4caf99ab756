"""Inertia: the consistent mass of a model, and the inertia of supports that move.

Masses are over rho h R^4 with times over R sqrt(rho/E), so that energies are over E h R^2 as all
others. The displacement is u + E(mu(t)), with E at nodes that move with supports. So the mass is
that of all nodes: M (u'' + E'') and M (u' + E').

mu are the amplitudes of motions, by name: functions of time. At a kink their first derivative
jumps, so that a time has a limit from before and one from after. A wave m around an axisymmetric
shell is U cos(m theta) e_rho + V sin(m theta) e_theta + W cos(m theta) e_z, known by coefficients
(U + V, V, W) at the meridian's nodes. rho is the mass density.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import reduce
from operator import mul
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc
from petsc4py import PETSc
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.continuation.system import Amplitudes, Vector
from magshell_fenicsx.models import domains
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.platform import compat

if TYPE_CHECKING:  # a run builds only one kind of model
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel
    from magshell_fenicsx.shells.solid import SolidModel

Model: TypeAlias = "ShellModel | MeridianModel | SolidModel"


def mass(model: Model) -> PETSc.Mat:
    """Return the consistent mass matrix of the modelled part, without rotary inertia; collective.

    Rows and columns at supports are zero.
    """
    M, projection = mass_matrix(_mass_form(model), model.system.clamped), model.system.projection
    # oblique supports hold directions that are no coordinates
    return projection.mass(M) if projection else M


def mass_with_supports(model: Model) -> PETSc.Mat:
    """Return the consistent mass matrix with the rows and columns at supports; collective."""
    return mass_matrix(_mass_form(model), [])


def _mass_form(model: Model) -> fem.Form:
    """Return the compiled form of the mass: the product of displacements, weighted with it."""
    factor = mass_factor(model)
    name = "mass" if factor is None else "weighted mass"
    return model.kernels.compile(
        name, displacement_product(model, 1.0 if factor is None else factor)
    )


def mass_factor(model: Model) -> Expr | None:
    """Return the factor of a shell's mass per area: thickness times density; None for 1.

    A solid has the thickness in its shape.
    """
    factors = [] if model.thickness is None else [model.thickness[0]]
    if model.cell_materials is not None:
        factors.append(model.cell_materials[2])
    return reduce(mul, factors) if factors else None


def displacement_product(model: Model, factor: Expr | float) -> ufl.Form:
    """Return the form of the integral of factor u . v over the undeformed modelled part."""
    product = factor * ufl.dot(ufl.TrialFunction(model.V), ufl.TestFunction(model.V))
    return _integral(model, model.domain.revolution_factor * product if model.thin else product)


def wave_product(model: "MeridianModel", factor: Expr | float) -> ufl.Form:
    """Return the form of the weighted product of two waves with coefficients (U + V, V, W).

    It does not depend on the wave number m >= 1, since cos² and sin² have the integral pi around
    e3. Only values of the waves count, which do not depend on m either: m = 1 stands for all.
    """
    V = model.waves.V
    # jets of both waves: of the coefficients of the cosine, then of the sine
    cosine, sine = zip(
        *(domains.wave_jets(f, 1) for f in (ufl.TrialFunction(V), ufl.TestFunction(V))), strict=True
    )
    return _integral(model, factor * np.pi * sum(ufl.dot(a.r, b.r) for a, b in (cosine, sine)))


def mass_along(model: Model, phi: Vector, wave: int | None = None) -> FormTerm:
    """Return phi . M phi as a term that depends on the placement.

    Its derivative by the placement tells how a mode's frequency changes with the shape. `phi` holds
    this rank's values of a displacement. With a `wave` number they are the coefficients (U + V, V,
    W) of that wave.
    """
    factor = mass_factor(model)
    if wave is None:
        V, product = model.V, displacement_product(model, 1.0 if factor is None else factor)
    else:
        assert model.axisymmetric
        V, product = model.waves.V, wave_product(model, 1.0 if factor is None else factor)
    direction = fem.Function(V, name="phi")
    direction.x.array[: len(phi)] = phi
    direction.x.scatter_forward()
    # phi in place of both arguments of the product
    energy = ufl.replace(product, dict.fromkeys(product.arguments(), direction))
    name = "mass along a displacement" if wave is None else "mass along a wave"
    return FormTerm(name, energy, model.system.u, model.kernels, linear=True)


def _integral(model: Model, f: Expr) -> ufl.Form:
    """Return the integral of f over the undeformed area, on a meridian per radian.

    Of a solid it is the integral over the volume, divided by the thickness.
    """
    domain, degree = model.V.mesh, model.degree
    # the product has twice the degree, the area ratio some more
    dx = ufl.Measure("dx", domain=domain, metadata={"quadrature_degree": 2 * degree + 2})
    if not model.thin:
        return f / model.material.h * dx
    return f * kin.area_ratio(model.domain.j0) * dx


def mass_matrix(product: fem.Form, constraints: list[fem.DirichletBC]) -> PETSc.Mat:
    """Return the matrix of an inner product, with zeros in constrained rows and columns.

    So constrained degrees of freedom have no finite eigenvalue, whatever the tangent's diagonal is
    there. Collective.
    """
    M = fem_petsc.create_matrix(product)
    # zeros are no entries: the tangent has none in constrained rows either
    M.setOption(PETSc.Mat.Option.IGNORE_ZERO_ENTRIES, True)
    compat.add_matrix(M, product, constraints)
    M.assemble()
    return M


Rates = Mapping[str, tuple[float, float]]  # motion -> first and second derivative by time


class SupportInertia:
    """Inertia of supports that move in time; a `continuation.motion.MovingSupports`.

    Parameters
    ----------
    system
        System whose supports move.
    mass
        Mass matrix of all nodes, supports too.
    amplitudes_at
        Function of a time and of whether it is the time just before (matters at a kink). It returns
        the amplitudes, and for each motion its first and second derivative by time.
    first_velocity
        Velocity of the supports before the begin; None if they were at rest.

    Attributes
    ----------
    names
        Amplitudes of the motions.
    _system, _mass
        The parameters.
    _moving
        Prescribed motion of the system's supports, with its derivatives by the amplitudes.
    _at, _carried
        The parameters `amplitudes_at` and `first_velocity`.
    _x, _y
        A vector and its product with the mass, filled again at each product.
    """

    def __init__(
        self,
        system: FiniteElementSystem,
        mass: PETSc.Mat,
        amplitudes_at: Callable[[float, bool], tuple[Amplitudes, Rates]],
        first_velocity: Vector | None = None,
    ) -> None:
        """Take the motions of the system's supports; parameters are those of the class."""
        assert system.moving
        self._system = system
        self._moving = system.moving
        self._mass = mass
        self._at = amplitudes_at
        self._carried = first_velocity
        self.names = system.moving.names
        self._x, self._y = mass.createVecs()

    def velocity(self, t: float, is_before: bool) -> Vector:
        """Return the velocity of nodes that move with supports at time t, zero elsewhere.

        `is_before` takes the limit from before a kink.
        """
        if t <= 0 and is_before:  # before the begin there are no amplitudes
            return np.zeros(self._system.size) if self._carried is None else self._carried
        mu, rates = self._at(t, is_before)
        return self._sum(rate * self._moving.rate(mu, name) for name, (rate, _) in rates.items())

    def acceleration(self, t: float, is_before: bool) -> Vector:
        """Return the acceleration of nodes that move with supports at time t, zero elsewhere.

        `is_before` takes the limit from before a kink.
        """
        mu, rates = self._at(t, is_before)
        # E'' = dE/dmu mu'' + d2E/dmu_a dmu_b mu_a' mu_b', with rates (mu', mu'') of each motion;
        # `rate` is the first and `bend` the second derivative of E by amplitudes
        from_second_rates = self._sum(
            second_rate * self._moving.rate(mu, name) for name, (_, second_rate) in rates.items()
        )
        # pairs of motions, with the product of their first rates
        pairs = ((a, b, rates[a][0] * rates[b][0]) for a in rates for b in rates)
        from_first_rates = self._sum(
            product * self._moving.bend(mu, a, b) for a, b, product in pairs
        )
        return from_second_rates + from_first_rates

    def displacement_rate(self, mu: Amplitudes, name: str) -> Vector:
        """Return dE/dmu (local size,) of the motion `name`."""
        return self._sum([self._moving.rate(mu, name)])

    def times(self, x: Vector) -> Vector:
        """Return the mass of all nodes times a vector; collective."""
        self._x.setArray(x)
        self._mass.mult(self._x, self._y)
        return np.array(self._y.array_r)

    def zeroed_at_supports(self, x: Vector) -> Vector:
        """Return a vector with zeros at supports."""
        return self._system.zero_at_supports(x)

    def _sum(self, parts: Iterable[Vector]) -> Vector:
        """Return the sum of local vectors with ghosts, without the ghosts."""
        total = np.sum([np.zeros(len(self._system.u.x.array)), *parts], axis=0)
        return np.array(total[: self._system.size])

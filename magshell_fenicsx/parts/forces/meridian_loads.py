"""Loads on a meridian that keep their direction: energies that are linear in u.

A meridian is the curve in (rho, z) that a shell of revolution has all around the axis e3; vectors
have three components (rho, theta, z). Integrals are per radian: those all around are 2 pi times as
much. An integral is a function here, from an integrand to its form. A dead load is a force at a
point of the axis (`pole`), on an end, or per area; a pattern is a load by formula. u and r0 are
displacement and undeformed placement, a jet is a map with its derivatives at quadrature points.
Sizes of loads are over E h R, lengths over R.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.models.axisymmetric.meridian import Meridian
from magshell_fenicsx.models.domains import Energy, Facets, IntegrationDomain
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.models.shell.parameters import (
    AreaForce,
    DeadLoad,
    EdgeForce,
    Force,
    PointForce,
)
from magshell_fenicsx.models.shell.spatial_fields import ADDED_LOAD_DEGREE, pattern_field
from magshell_fenicsx.models.shell.thickness import patch_of
from magshell_fenicsx.parts.forces.load_vectors import patch_indicator
from magshell_fenicsx.parts.loads import forces

Integral = Callable[[Expr], ufl.Form]


@dataclass(frozen=True)
class RevolutionIntegrals:
    """Integrals over parts of a surface of revolution, per radian.

    The methods `end`, `pole`, `area` and `patch` return an integral as a function: from an
    integrand to its form.

    Attributes
    ----------
    meridian, domain
        The meridian, and the integrals of its forms.
    parts, measures
        The facets of each end or point that is loaded, and the measure of each within one measure
        of the boundary.
    """

    meridian: Meridian
    domain: IntegrationDomain
    parts: Sequence[Facets] = ()
    measures: Sequence[ufl.Measure] = ()

    def with_parts(self, loads: Sequence[DeadLoad]) -> "RevolutionIntegrals":
        """Return these integrals with one boundary measure for all ends and points of some loads.

        A form may have only one measure of the boundary, so loads of one form have to share it.
        """
        parts = list[Facets]()
        for load in forces(loads):
            if isinstance(load, AreaForce):
                continue
            facets = (
                self.meridian.facets_at(load.point)
                if isinstance(load, PointForce)
                else self.meridian.ends[load.edge]
            )
            # several loads at one place need one part
            if not any(np.array_equal(facets, part) for part in parts):
                parts.append(facets)
        return replace(self, parts=parts, measures=self.domain.measures_on(parts) if parts else [])

    def _ds(self, facets: Facets) -> ufl.Measure:
        """Return the measure of facets: that of the part with them, or else one of their own."""
        for part, ds in zip(self.parts, self.measures, strict=True):
            if np.array_equal(part, facets):
                return ds
        return self.domain.ds(facets)

    def end(self, name: str, *, mean: bool = False) -> Integral:
        """Return the integral along the undeformed circle of a named end, per radian: f rho.

        With `mean` it is the mean f of the circle over 2 pi, so that 2 pi times it is the mean.
        """
        ds = self._ds(self.meridian.ends[name])
        return lambda f: f / (2 * np.pi) * ds if mean else f * self.domain.r0[0] * ds

    def pole(self, point: str) -> Integral:
        """Return the "integral" over a named point on the axis: the value there, over 2 pi.

        All around the axis, that is times 2 pi, it is the value itself.
        """
        ds = self._ds(self.meridian.facets_at(point))
        return lambda f: f / (2 * np.pi) * ds

    def area(self, load: AreaForce) -> Integral:
        """Return the integral over the undeformed area, or over the patch of a load."""
        integral = self.domain.over_area()
        if load.patch is None:
            return integral
        indicator = patch_indicator(self.domain.mesh, patch_of(self.meridian.patches, load.patch))
        return lambda f: integral(indicator * f)

    def patch(self, radius: float, point: str) -> Integral:
        """Return the integral weighted by (1 - d^2/radius^2)^2 within a radius, over R.

        d is the distance from a named point on the axis.
        """
        parameter = np.array([self.meridian.points[point][0]])  # along the meridian
        a = self.domain.constant(radius)
        pole = self.domain.constant(self.meridian.section(parameter)[0])
        depth = 1 - ufl.dot(self.domain.r0 - pole, self.domain.r0 - pole) / a**2
        weight = ufl.conditional(ufl.gt(depth, 0), depth**2, 0)
        integral = self.domain.over_area()
        return lambda f: integral(weight * f)


def dead_loads(
    name: str, loads: Sequence[DeadLoad], integrals: RevolutionIntegrals, log: KernelLog
) -> tuple[Energy, float, Sequence[ufl.Form]]:
    """Return the energy of dead loads without moments, the sum of their sizes, and its forms.

    Vectors are along e3, and points are on the axis. The size of a force is its length, that of a
    distributed load the integral of its density's length.

    Parameters
    ----------
    name
        Name of the amplitude.
    loads
        The dead loads, of which moments and potentials are passed over.

    Returns
    -------
    energy
        The energy, linear in u.
    total_size
        The sum of the sizes over E h R.
    size_forms
        The size of each load as a form, which shows how it depends on the placement.
    """
    integrals = integrals.with_parts(loads)
    terms = list[tuple[Expr, Integral]]()  # density and integral of each load
    total_size, size_forms = 0.0, list[ufl.Form]()
    for load in forces(loads):
        integral = _integral_of_load(load, integrals)
        if not isinstance(load, PointForce) and callable(load.force):
            density, size, size_form = _density_of_pattern(load, integral, integrals, log)
        else:
            density, size, size_form = _density_of_vector(load, integral, integrals, log)
        terms.append((density, integral))
        total_size += size
        size_forms.append(size_form)

    def energy(u: Jet) -> ufl.Form:
        # a sum of forms needs a form to begin with, not 0
        (first_density, first_integral), *others = terms
        return sum(
            (integral(-ufl.dot(density, u.r)) for density, integral in others),
            first_integral(-ufl.dot(first_density, u.r)),
        )

    return Energy(name, energy, name, linear=True), total_size, size_forms


def _density_of_pattern(
    load: EdgeForce | AreaForce, integral: Integral, integrals: RevolutionIntegrals, log: KernelLog
) -> tuple[Expr, float, ufl.Form]:
    """Return the density (3,) of a load by formula, its size, and the size as a form.

    The size is the integral of the density's length.
    """
    assert callable(load.force)
    # the pattern as a field, and the integral of its length over all of the surface, if known
    density, size_everywhere = pattern_field(load.force, integrals.domain.r0, ADDED_LOAD_DEGREE)
    density_length = ufl.sqrt(ufl.dot(density, density))
    is_everywhere = isinstance(load, AreaForce) and load.patch is None
    size = (
        size_everywhere
        if size_everywhere is not None and is_everywhere
        else _integral(density_length, integral, log)
    )
    return density, size, 2 * np.pi * integral(density_length)


def _density_of_vector(
    load: PointForce | EdgeForce | AreaForce,
    integral: Integral,
    integrals: RevolutionIntegrals,
    log: KernelLog,
) -> tuple[Expr, float, ufl.Form]:
    """Return the density (3,) of a vector or a pressure, its size, and the size as a form.

    The size is the density's length times a measure: the length of an end, an area, or 1 of a total
    force and of a point.
    """
    domain = integrals.domain
    measure = _circumferential_integral(integral, integrals, log)
    if isinstance(load, AreaForce) and isinstance(load.force, float):  # a pressure
        density = -kin.normal(domain.j0) * domain.constant(load.force)
        density_length = abs(load.force)
    else:
        vector = np.asarray(load.force)
        density, density_length = domain.constant(vector), float(np.linalg.norm(vector))
    size_form = 2 * np.pi * integral(domain.constant(density_length))
    return density, density_length * measure, size_form


def _integral_of_load(
    load: PointForce | EdgeForce | AreaForce, integrals: RevolutionIntegrals
) -> Integral:
    """Return the integral over what a load acts on; of a total force on an end it is the mean."""
    if isinstance(load, PointForce):
        return integrals.pole(load.point)
    if isinstance(load, EdgeForce):
        return integrals.end(load.edge, mean=load.total)
    return integrals.area(load)


def pole_force(
    name: str, force: Force, unit: float, integrals: RevolutionIntegrals, log: KernelLog
) -> Energy:
    """Return the energy of a force on the axis, against the outward normal.

    The force is at a point, or on a patch around it.

    Parameters
    ----------
    name
        Name of the amplitude, the force over `unit`.
    force
        The name of its point, and the radius of its patch over R; 0 for a point.
    unit
        Unit of the force over E h R.
    """
    integral = (
        integrals.patch(force.patch, force.point) if force.patch else integrals.pole(force.point)
    )
    # the normal is e3 where a cell begins at the point, and -e3 at an end of the meridian
    parameter = integrals.meridian.points[force.point][0]
    is_begin = np.isclose(integrals.meridian.cells[:, 0], parameter).any()
    # divided by the weight's integral, so that the total force is exact on any mesh
    density = integrals.domain.constant(
        (1.0 if is_begin else -1.0) * unit / _circumferential_integral(integral, integrals, log)
    )
    return Energy(name, lambda u: integral(density * u.r[2]), name, linear=True)


def _circumferential_integral(
    integral: Integral, integrals: RevolutionIntegrals, log: KernelLog
) -> float:
    """Return the integral of 1, all around the axis: a length, an area, or 1 of a point."""
    return _integral(integrals.domain.constant(1.0), integral, log)


def _integral(f: Expr, integral: Integral, log: KernelLog) -> float:
    """Return the integral of f all around the axis: 2 pi times that per radian."""
    return float(2 * np.pi * fem.assemble_scalar(log.compile("load measure", integral(f))))

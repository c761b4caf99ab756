"""Loads that keep their direction and leave the rotation, as energies on the meridian that are
linear in u.
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
from magshell_fenicsx.parts.forces.load_vectors import within
from magshell_fenicsx.parts.loads import forces

Integral = Callable[[Expr], ufl.Form]


@dataclass(frozen=True)
class Around:
    """Integrals over parts of a surface of revolution, per radian as those of its domain."""

    meridian: Meridian
    domain: IntegrationDomain
    parts: Sequence[Facets] = ()
    measures: Sequence[ufl.Measure] = ()

    def with_parts(self, loads: Sequence[DeadLoad]) -> "Around":
        """With one measure for the ends and points of all loads of a form."""
        parts = list[Facets]()
        for load in forces(loads):
            if isinstance(load, AreaForce):
                continue
            of = (
                self.meridian.facets_at(load.point)
                if isinstance(load, PointForce)
                else self.meridian.ends[load.edge]
            )
            if not any(np.array_equal(of, part) for part in parts):
                parts.append(of)
        return replace(self, parts=parts, measures=self.domain.measures_on(parts) if parts else [])

    def _ds(self, facets: Facets) -> ufl.Measure:
        each = zip(self.parts, self.measures, strict=True)
        return next(
            (ds for part, ds in each if np.array_equal(part, facets)), None
        ) or self.domain.ds(facets)

    def end(self, name: str, *, mean: bool = False) -> Integral:
        """Along the undeformed circle of an end, or the mean over that."""
        ds = self._ds(self.meridian.ends[name])
        return lambda f: f / (2 * np.pi) * ds if mean else f * self.domain.r0[0] * ds

    def pole(self, point: str) -> Integral:
        """The value at a point on the axis, over 2 pi."""
        ds = self._ds(self.meridian.facets_at(point))
        return lambda f: f / (2 * np.pi) * ds

    def area(self, load: AreaForce) -> Integral:
        """Over the undeformed area, or that of one of several shells."""
        over = self.domain.over_area()
        if load.patch is None:
            return over
        marked = within(self.domain.mesh, patch_of(self.meridian.patches, load.patch))
        return lambda f: over(marked * f)

    def patch(self, radius: float, point: str) -> Integral:
        """Of f (1 - d^2/radius^2)^2, d the distance in space from a point on the axis."""
        at = np.array([self.meridian.points[point][0]])
        a, pole = self.domain.constant(radius), self.domain.constant(self.meridian.section(at)[0])
        inside = 1 - ufl.dot(self.domain.r0 - pole, self.domain.r0 - pole) / a**2
        weight, over = ufl.conditional(ufl.gt(inside, 0), inside**2, 0), self.domain.over_area()
        return lambda f: over(weight * f)


def dead_loads(
    name: str, loads: Sequence[DeadLoad], on: Around, log: KernelLog
) -> tuple[Energy, float, Sequence[ufl.Form]]:
    """All except the moments, with an amplitude's name; the sum of their sizes over E h R, and its
    forms.

    Vectors are along e3, and points are on the axis.
    """
    parts, size, sizes, on = (
        list[tuple[Expr, Integral]](),
        0.0,
        list[ufl.Form](),
        on.with_parts(loads),
    )
    for load in forces(loads):
        if isinstance(load, PointForce):
            over = on.pole(load.point)
        elif isinstance(load, EdgeForce):
            over = on.end(load.edge, mean=load.total)
        else:
            over = on.area(load)
        if not isinstance(load, PointForce) and callable(load.force):
            along, whole = pattern_field(load.force, on.domain.r0, ADDED_LOAD_DEGREE)
            parts.append((along, over))
            fitted = whole is not None and isinstance(load, AreaForce) and load.patch is None
            per = ufl.sqrt(ufl.dot(along, along))
            size += whole if fitted and whole is not None else _integral(per, over, log)
            sizes.append(2 * np.pi * over(per))
            continue
        whole = _whole(over, on, log)
        if isinstance(load, AreaForce) and isinstance(load.force, float):
            along, strength = (
                -kin.normal(on.domain.j0) * on.domain.constant(load.force),
                abs(load.force),
            )
        else:
            vector = np.asarray(load.force)
            along, strength = on.domain.constant(vector), float(np.linalg.norm(vector))
        parts.append((along, over))
        size += strength * whole
        sizes.append(2 * np.pi * over(on.domain.constant(strength)))

    def energy(u: Jet) -> ufl.Form:
        return sum(
            (over(-ufl.dot(along, u.r)) for along, over in parts[1:]),
            parts[0][1](-ufl.dot(parts[0][0], u.r)),
        )

    return Energy(name, energy, name, linear=True), size, sizes


def pole_force(name: str, force: Force, unit: float, on: Around, log: KernelLog) -> Energy:
    """A force against the outward normal at a point on the axis, or spread over a patch of that
    radius.
    """
    over = on.patch(force.patch, force.point) if force.patch else on.pole(force.point)
    begins = np.isclose(
        on.meridian.cells[:, 0], on.meridian.points[force.point][0]
    ).any()  # the normal is e3 there
    share = on.domain.constant((1.0 if begins else -1.0) * unit / _whole(over, on, log))
    return Energy(name, lambda u: over(share * u.r[2]), name, linear=True)


def _whole(over: Integral, on: Around, log: KernelLog) -> float:
    """The integral of 1, all around."""
    return _integral(on.domain.constant(1.0), over, log)


def _integral(f: Expr, over: Integral, log: KernelLog) -> float:
    return float(2 * np.pi * fem.assemble_scalar(log.compile("load measure", over(f))))

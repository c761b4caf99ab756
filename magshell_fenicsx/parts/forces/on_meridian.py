"""Loads that keep their direction and leave the rotation, as energies on the meridian that are linear in u."""

from collections.abc import Sequence

import numpy as np
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.models.axisymmetric.energies import Energy, EnergyFactory, Integral
from magshell_fenicsx.models.axisymmetric.pattern import pattern_field
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.models.shell.parameters import AreaForce, DeadLoad, EdgeForce, EdgeMoment, PointForce, Potential
from magshell_fenicsx.models.shell.patterns import FINER


def dead_loads(name: str, loads: Sequence[DeadLoad], factory: EnergyFactory, log: KernelLog) -> tuple[Energy, float]:
    """All except the moments, with an amplitude's name, and the sum of their sizes over E h R.

    Vectors are along e3, and points are on the axis.
    """
    parts, size = list[tuple[Expr, Integral]](), 0.0
    for load in loads:
        if isinstance(load, EdgeMoment | Potential):
            continue
        if isinstance(load, PointForce):
            over = factory.at_pole()
        elif isinstance(load, EdgeForce):
            over = factory.around(factory.meridian.ends[load.edge])
        else:
            over = factory.area()
        if not isinstance(load, PointForce) and callable(load.force):
            along, whole = pattern_field(load.force, factory.r0, FINER)
            parts.append((along, over))
            fitted = whole is not None and isinstance(load, AreaForce)
            size += whole if fitted and whole is not None else _integral(ufl.sqrt(ufl.dot(along, along)), over, log)
            continue
        whole = _whole(over, factory, log)
        if isinstance(load, AreaForce) and isinstance(load.force, float):
            along, strength = -kin.normal(factory.j0) * factory.constant(load.force), abs(load.force)
        else:
            vector = np.asarray(load.force) / (whole if isinstance(load, EdgeForce) and load.total else 1.0)
            along, strength = factory.constant(vector), float(np.linalg.norm(vector))
        parts.append((along, over))
        size += strength * whole

    def energy(u: Jet) -> ufl.Form:
        return sum((over(-ufl.dot(along, u.r)) for along, over in parts[1:]), parts[0][1](-ufl.dot(parts[0][0], u.r)))

    return Energy(name, energy, name, linear=True), size


def pole_force(name: str, patch: float, unit: float, factory: EnergyFactory, log: KernelLog) -> Energy:
    """A force against e3 at the pole, or spread over a patch of that radius."""
    over = factory.patch(patch) if patch else factory.at_pole()
    share = factory.constant(unit / _whole(over, factory, log))
    return Energy(name, lambda u: over(share * u.r[2]), name, linear=True)


def _whole(over: Integral, factory: EnergyFactory, log: KernelLog) -> float:
    """The integral of 1, all around."""
    return _integral(factory.constant(1.0), over, log)


def _integral(f: Expr, over: Integral, log: KernelLog) -> float:
    return float(2 * np.pi * fem.assemble_scalar(log.compile("load measure", over(f))))

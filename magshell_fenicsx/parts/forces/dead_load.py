"""Dead loads at points, on edges and areas: the entries of their load vectors."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import ufl
from dolfinx import fem, mesh
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.input.expressions import ByFormula, Inwards, function
from magshell_fenicsx.mesh.midsurface import Midsurface
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.energy import edge_quadrature
from magshell_fenicsx.models.shell.parameters import (
    AreaForce,
    DeadLoad,
    EdgeForce,
    EdgeMoment,
    Loads,
    PointForce,
    Potential,
)
from magshell_fenicsx.models.shell.patterns import FINER, Pattern, pattern_field, pattern_on_edge
from magshell_fenicsx.models.shell.thickness import patch_of
from magshell_fenicsx.parts.forces.dead import DeadLoadSection, potential
from magshell_fenicsx.parts.forces.load_vector import Entries, Weighted, entries, point_entries
from magshell_fenicsx.parts.part import Account, Context, Modelled

Array = NDArray[np.float64]


def dead_load(load: DeadLoadSection, name: str, context: Context, modelled: Modelled) -> DeadLoad:
    """A load as the model takes it; `name` is for its energy, if it has one."""
    mirror = modelled.mirror
    shared = mirror is not None and (load.edge is None or mirror.other(load.edge) == load.edge)
    Q, scales = rotation(modelled.turn), context.scales
    E, t, R = scales.E, scales.h, scales.R
    if load.potential is not None:
        return Potential(potential(name, load.potential, Q, scales))
    if load.varies:
        unit = E * t if load.edge else E * t / R
        pattern = _pattern(load, Q, R, 1 / unit)
        return EdgeForce(load.edge, pattern, total=False) if load.edge else AreaForce(_over(load), pattern)
    force = np.asarray((0.5 if shared else 1.0) * (Q @ (load.force or np.zeros(3))) / (E * t * R))
    if load.at is not None:
        return PointForce(load.at, force)
    if load.edge is not None and load.moment is not None:
        return EdgeMoment(load.edge, load.moment / (E * t * R))
    if load.edge is not None and load.force is not None:
        return EdgeForce(load.edge, force, total=True)
    if load.edge is not None:
        assert load.per_length is not None
        return EdgeForce(load.edge, np.asarray(Q @ np.array(load.per_length, dtype=float) / (E * t)), total=False)
    if load.pressure is not None:
        assert isinstance(load.pressure, float | int)
        return AreaForce(_over(load), load.pressure * R / (E * t))
    assert load.per_area is not None
    return AreaForce(_over(load), np.asarray(Q @ np.array(load.per_area, dtype=float) * R / (E * t)))


def _over(load: DeadLoadSection) -> str | None:
    return None if load.over == "all" else load.over


def _pattern(load: DeadLoadSection, Q: Array, length: float, factor: float) -> Pattern:
    """The load of a formula in the model's frame; a pressure is against the normal."""
    if load.vector is not None:
        return ByFormula([function(v) for v in load.vector], Q, length, factor, vectors=True)
    assert load.pressure is not None
    return Inwards(ByFormula([function(load.pressure)], Q, length, factor))


def account(context: Context, loads: Loads) -> Account:
    """Forces and dead loads."""
    patches = [force.patch * context.shell.R_over_h for force in loads.forces.values()]
    words = [f"force on a patch of radius {patch:g} h" if patch else "force at a point" for patch in patches]
    if dead := loads.all_dead:
        words.append(f"{len(dead)} dead load{'s' * (len(dead) > 1)}")
    return Account(words, [] if loads.forces else ["force: none"])


class Measures(Protocol):
    """Where the loads of a model are.

    Attributes
    ----------
    normal
        The undeformed outward normal.
    """

    normal: Expr

    def edge(self, name: str) -> Weighted:
        """Undeformed length of a named edge."""

    def area(self, patch: str | None) -> Weighted:
        """Undeformed area of a named patch, or of all."""

    def field(self, pattern: Pattern, edge: str | None) -> tuple[Expr, float | None]:
        """A pattern on the undeformed mid-surface or an edge, and the integral of its size as of `pattern_field`."""

    def at_point(self, name: str, force: NDArray[np.float64]) -> Entries:
        """The load vector of a force at a named vertex."""


@dataclass(frozen=True)
class DeadLoads:
    """Dead loads together.

    Attributes
    ----------
    entries
        l with l . u = their work at u, in E h R^2.
    size
        The sum of their sizes over E h R: of a force its length, of a distributed one that of its integral's
        density.
    """

    entries: Entries
    size: float


def assemble_dead_loads(loads: Sequence[DeadLoad], V: fem.FunctionSpace, on: Measures, log: KernelLog) -> DeadLoads:
    """The load vector of all but the moments; collective."""
    parts, size = list[Entries](), 0.0

    def constant(value: float | NDArray[np.float64]) -> fem.Constant:
        return fem.Constant(V.mesh, value)

    def spread(along: Expr, measure: Weighted) -> None:
        parts.append(entries(V, along, measure, log))

    def spread_pattern(pattern: Pattern, measure: Weighted, edge: str | None = None, *, part: bool = False) -> float:
        """The integral of its size."""
        along, whole = on.field(pattern, edge)
        spread(along, measure)
        if whole is not None and not part:
            return whole
        form = log.compile("load size", ufl.sqrt(ufl.dot(along, along)) * measure)
        return float(V.mesh.comm.allreduce(fem.assemble_scalar(form)))

    for load in loads:
        if isinstance(load, PointForce):
            parts.append(on.at_point(load.point, load.force))
            size += float(np.linalg.norm(load.force))
        elif isinstance(load, EdgeForce):
            ds = on.edge(load.edge)
            if callable(load.force):
                size += spread_pattern(load.force, ds, load.edge)
                continue
            length = ds.total(V, log)
            force = np.asarray(load.force / length) if load.total else load.force
            spread(constant(force), ds)
            size += float(np.linalg.norm(force)) * length
        elif isinstance(load, AreaForce):
            dx = on.area(load.patch)
            if callable(load.force):
                size += spread_pattern(load.force, dx, part=load.patch is not None)
                continue
            if isinstance(load.force, float):
                along, strength = -constant(load.force) * on.normal, abs(load.force)
            else:
                along, strength = constant(load.force), float(np.linalg.norm(load.force))
            spread(along, dx)
            size += strength * dx.total(V, log)
        else:
            assert isinstance(load, EdgeMoment | Potential)  # no load vectors
    vector = np.zeros(3 * V.dofmap.index_map.size_local)
    for dofs, values in parts:
        np.add.at(vector, dofs, values)
    dofs = np.flatnonzero(vector).astype(np.int32)
    return DeadLoads((dofs, vector[dofs]), size)


def within(domain: mesh.Mesh, patch: NDArray[np.bool_]) -> fem.Function:
    """One in the cells of a patch, zero in the others."""
    found = fem.Function(fem.functionspace(domain, ("DG", 0)))
    found.x.array[found.function_space.dofmap.list[:, 0]] = patch
    return found


class SurfaceMeasures:
    """`Measures` of a mid-surface."""

    def __init__(self, r0: fem.Function, midsurface: Midsurface, degree: int) -> None:
        self._V, self._midsurface, self._degree, self._r0 = r0.function_space, midsurface, degree, r0
        self._j0 = kin.jet(r0, midsurface.mesh)
        self.normal = kin.normal(self._j0)

    def edge(self, name: str) -> Weighted:
        domain, facets = self._midsurface.mesh, self._midsurface.edges[name]
        tags = mesh.meshtags(domain, 1, facets, np.ones_like(facets))
        rule = {"quadrature_degree": edge_quadrature(self._degree) + 2}
        ds = ufl.Measure("ds", domain=domain, subdomain_data=tags, metadata=rule)(1)
        return Weighted(kin.conormal(self._j0, kin.facet_covector(domain))[2], ds)

    def area(self, patch: str | None) -> Weighted:
        domain = self._midsurface.mesh
        dx = ufl.Measure("dx", domain=domain, metadata={"quadrature_degree": 2 * self._degree})
        weight = kin.area_ratio(self._j0)
        if patch is not None:
            weight = weight * within(domain, patch_of(self._midsurface.patches, patch))
        return Weighted(weight, dx)

    def field(self, pattern: Pattern, edge: str | None) -> tuple[Expr, float | None]:
        if edge is None:
            return pattern_field(pattern, self._r0, FINER)
        return pattern_on_edge(pattern, self._r0, self._midsurface.edges[edge], FINER)

    def at_point(self, name: str, force: NDArray[np.float64]) -> Entries:
        return point_entries(self._V, self._midsurface.points[name], force)

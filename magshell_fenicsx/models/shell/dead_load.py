"""Dead loads on edges and areas: the entries of their load vectors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import ufl
from dolfinx import fem, mesh
from dolfinx.la import InsertMode
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.mesh.midsurface import Midsurface
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.energy import edge_quadrature
from magshell_fenicsx.models.shell.parameters import AreaForce, DeadLoad, EdgeForce, EdgeMoment, PointForce
from magshell_fenicsx.models.shell.point_load import Entries, point_entries
from magshell_fenicsx.models.shell.thickness import patch_of


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


def assemble_dead_loads(
    loads: Sequence[DeadLoad], r0: fem.Function, midsurface: Midsurface, degree: int, log: KernelLog
) -> DeadLoads:
    """The load vector of all but the moments; collective."""
    V, parts, size = r0.function_space, [], 0.0
    forms = _Forms(r0, degree, log)
    for load in loads:
        if isinstance(load, PointForce):
            parts.append(point_entries(V, midsurface.points[load.point], load.force))
            size += float(np.linalg.norm(load.force))
        elif isinstance(load, EdgeForce):
            ds = forms.edge(midsurface.edges[load.edge])
            length = forms.total(ds)
            force = np.asarray(load.force / length) if load.total else load.force
            parts.append(forms.entries(ufl.dot(forms.constant(force), ufl.TestFunction(V)) * ds))
            size += float(np.linalg.norm(force)) * length
        elif isinstance(load, AreaForce):
            inside = None if load.patch is None else patch_of(midsurface.patches, load.patch)
            dx = forms.area(inside)
            if isinstance(load.force, float):
                along, strength = -kin.normal(forms.j0) * forms.constant(load.force), abs(load.force)
            else:
                along, strength = forms.constant(load.force), float(np.linalg.norm(load.force))
            parts.append(forms.entries(ufl.dot(along, ufl.TestFunction(V)) * dx))
            size += strength * forms.total(dx)
        else:
            assert isinstance(load, EdgeMoment)
    vector = np.zeros(3 * V.dofmap.index_map.size_local)
    for dofs, values in parts:
        np.add.at(vector, dofs, values)
    dofs = np.flatnonzero(vector).astype(np.int32)
    return DeadLoads((dofs, vector[dofs]), size)


class _Forms:
    """Integrals over the undeformed surface."""

    def __init__(self, r0: fem.Function, degree: int, log: KernelLog) -> None:
        self._V, self._degree, self._log = r0.function_space, degree, log
        self._domain = self._V.mesh
        self.j0 = kin.jet(r0, self._domain)

    def constant(self, value: float | NDArray[np.float64]) -> fem.Constant:
        return fem.Constant(self._domain, value)

    def edge(self, facets: NDArray[np.int32]) -> "_Weighted":
        """Undeformed length: a factor to integrands."""
        tags = mesh.meshtags(self._domain, 1, facets, np.ones_like(facets))
        rule = {"quadrature_degree": edge_quadrature(self._degree) + 2}
        ds = ufl.Measure("ds", domain=self._domain, subdomain_data=tags, metadata=rule)(1)
        return _Weighted(kin.conormal(self.j0, kin.facet_covector(self._domain))[2], ds)

    def area(self, inside: NDArray[np.bool_] | None) -> "_Weighted":
        """Undeformed area, of some cells or all."""
        dx = ufl.Measure("dx", domain=self._domain, metadata={"quadrature_degree": 2 * self._degree})
        weight = kin.area_ratio(self.j0)
        if inside is not None:
            within = fem.Function(fem.functionspace(self._domain, ("DG", 0)))
            within.x.array[within.function_space.dofmap.list[:, 0]] = inside
            weight = weight * within
        return _Weighted(weight, dx)

    def total(self, measure: "_Weighted") -> float:
        """Length or area."""
        form = self._log.compile("load measure", self.constant(1.0) * measure)
        return float(self._domain.comm.allreduce(fem.assemble_scalar(form)))

    def entries(self, form: ufl.Form) -> Entries:
        """Owned entries of a linear form."""
        load = fem.assemble_vector(self._log.compile("load vector", form))
        load.scatter_reverse(InsertMode.add)
        owned = 3 * self._V.dofmap.index_map.size_local
        dofs = np.flatnonzero(load.array[:owned]).astype(np.int32)
        return dofs, load.array[dofs]


@dataclass(frozen=True)
class _Weighted:
    """A measure with its density."""

    weight: Expr
    measure: ufl.Measure

    def __rmul__(self, integrand: Expr) -> ufl.Form:
        return integrand * self.weight * self.measure

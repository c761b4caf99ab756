"""The entries of load vectors, from measures on an undeformed shell or body; of a force at a vertex or on a patch."""

from dataclasses import dataclass

import basix
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.la import InsertMode
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.platform import compat

Entries = tuple[NDArray[np.int32], NDArray[np.float64]]
COARSE = 0.15  # of the integral that a patch has on a plane; at a corner it has a quarter


@dataclass(frozen=True)
class Weighted:
    """A measure with its density."""

    weight: Expr
    measure: ufl.Measure

    def __rmul__(self, integrand: Expr) -> ufl.Form:
        return integrand * self.weight * self.measure

    def total(self, V: fem.FunctionSpace, log: KernelLog, name: str = "load measure") -> float:
        """Length, area or whatever it measures; collective."""
        form = log.compile(name, fem.Constant(V.mesh, 1.0) * self)
        return float(V.mesh.comm.allreduce(fem.assemble_scalar(form)))


def entries(V: fem.FunctionSpace, along: Expr, on: Weighted, log: KernelLog, name: str = "load vector") -> Entries:
    """Owned entries of l with l . u = integral of along . u."""
    load = fem.assemble_vector(log.compile(name, ufl.dot(along, ufl.TestFunction(V)) * on))
    load.scatter_reverse(InsertMode.add)
    dofs = np.flatnonzero(load.array[: 3 * V.dofmap.index_map.size_local]).astype(np.int32)
    return dofs, load.array[dofs]


def smooth(x: Expr, radius: Expr) -> Expr:
    """(1 - x.x/radius^2)^2 within the radius: 1 in the middle of a patch, 0 at its rim."""
    inside = 1 - ufl.dot(x, x) / radius**2
    return ufl.conditional(ufl.gt(inside, 0), inside**2, 0)


def averaged(
    V: fem.FunctionSpace, direction: NDArray[np.float64], on: Weighted, log: KernelLog, radius: float | None = None
) -> Entries:
    """l with l . u = average of direction . u; the total is exact on any mesh.

    Parameters
    ----------
    radius
        Of the `smooth` patch on a surface whose area must be known to the mesh.

    Raises
    ------
    MeshError
        On every rank, if the mesh is too coarse to know the patch.
    """
    total = on.total(V, log, "patch weight")
    if radius is not None and not COARSE <= total / (np.pi * radius**2 / 3) <= 1 / COARSE:
        raise MeshError(
            f"loading.patch: its radius is {radius:.3g} R, which the mesh is too coarse for: choose a smaller "
            "mesh.size, or 0 for a force at a point"
        )
    dofs, values = entries(V, fem.Constant(V.mesh, direction), on, log, "patch load")
    return dofs, np.asarray(values / total)


def point_entries(V: fem.FunctionSpace, x: NDArray[np.float64], direction: NDArray[np.float64]) -> Entries:
    """l with l . u = direction . u(x) for a vertex x: owned degrees of freedom and values."""
    near = fem.locate_dofs_geometrical(V, lambda points: np.linalg.norm(points.T - x, axis=1) < 1e-9)
    owned = near[near < V.dofmap.index_map.size_local]
    dofs = (3 * owned[:, None] + np.arange(3)).ravel().astype(np.int32)
    return dofs, np.tile(direction, len(owned))


def patch_entries(
    r0: fem.Function, x: NDArray[np.float64], radius: float, direction: NDArray[np.float64], degree: int, log: KernelLog
) -> Entries:
    """l with l . u = average of direction . u around x, with the weight (1 - d^2/radius^2)^2.

    d is the distance from x in space. The weight's integral is taken with the same
    quadrature, so that the total force is exact on any mesh.

    Raises
    ------
    MeshError
        On every rank, if the mesh is too coarse to know the patch.
    """
    V = r0.function_space
    domain = V.mesh
    centre, a = (fem.Constant(domain, v) for v in (x, radius))
    dx = ufl.Measure("dx", domain=domain, metadata={"quadrature_degree": 2 * degree})
    weight = smooth(r0 - centre, a) * kin.area_ratio(kin.jet(r0, domain))
    return averaged(V, direction, Weighted(weight, dx), log, radius)


def vertex_normal(r0: fem.Function, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit normal of the undeformed mid-surface at a vertex, averaged over its triangles."""
    V = r0.function_space
    corners = basix.geometry(basix.CellType.triangle)
    gradients = V.element.basix_element.tabulate(1, corners)[1:, :, :, 0]
    owned = V.mesh.topology.index_map(2).size_local
    nodes = r0.x.array.reshape(-1, 3)[V.dofmap.list[:owned]]
    a1, a2 = np.einsum("dvk,cki->dcvi", gradients, nodes)
    near = np.linalg.norm(V.mesh.geometry.x[compat.corner_numbers(V.mesh)[:owned]] - x, axis=2) < 1e-9
    total = V.mesh.comm.allreduce(np.cross(a1[near], a2[near]).sum(axis=0))
    return np.asarray(total / np.linalg.norm(total))

"""A concentrated dead load: the entries of its load vector, at a vertex or spread over a patch."""

import basix
import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.parts.forces.load_vector import Entries, Weighted, averaged, smooth
from magshell_fenicsx.platform import compat


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

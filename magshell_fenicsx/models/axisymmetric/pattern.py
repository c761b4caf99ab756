"""Normals along the meridian, and a magnetisation that varies along it."""

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.patterns import Pattern


def pattern_field(pattern: Pattern, r0: fem.Function) -> fem.Function:
    """The pattern at the nodes of every cell, free to jump from cell to cell; along (e_rho, e_theta, e_z)."""
    V = r0.function_space
    rho, z = np.moveaxis(r0.x.array.reshape(-1, 2)[V.dofmap.list], -1, 0)
    Q = fem.functionspace(V.mesh, ("DG", V.element.basix_element.degree, (3,)))
    field = fem.Function(Q, name="Br")
    field.x.array.reshape(-1, 3)[Q.dofmap.list] = pattern(np.stack([rho, 0 * rho, z], axis=-1), cell_normals(r0))
    return field


def cell_normals(r0: fem.Function) -> NDArray[np.float64]:
    """Undeformed unit normal at each node of each cell, (cells, nodes, 3) along (e_rho, e_theta, e_z)."""
    V = r0.function_space
    element = V.element.basix_element
    slopes = element.tabulate(1, element.points)[1, :, :, 0]
    rho_s, z_s = np.moveaxis(r0.x.array.reshape(-1, 2)[V.dofmap.list], -1, 0) @ slopes.T
    return np.asarray(np.stack([-z_s, 0 * z_s, rho_s], axis=-1) / np.hypot(rho_s, z_s)[..., None])


def nodal_normals(r0: fem.Function) -> NDArray[np.float64]:
    """Unit normals (nodes, 3) at the azimuth 0, averaged over the cells that meet."""
    normals = np.zeros((len(r0.x.array) // 2, 3))
    np.add.at(normals, r0.function_space.dofmap.list, cell_normals(r0))
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])

"""Normals along the meridian, and a magnetisation and a thickness that vary along it."""

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.patterns import Pattern, inside
from magshell_fenicsx.models.shell.thickness import Thickness, nodal_thickness


def pattern_field(pattern: Pattern, r0: fem.Function) -> fem.Function:
    """The pattern at the nodes of every cell, free to jump from cell to cell; along (e_rho, e_theta, e_z)."""
    V = r0.function_space
    Q = fem.functionspace(V.mesh, ("DG", V.element.basix_element.degree, (3,)))
    field = fem.Function(Q, name="Br")
    field.x.array.reshape(-1, 3)[Q.dofmap.list] = pattern(inside(_nodes(r0)), cell_normals(r0))
    return field


def thickness_field(thickness: Thickness, r0: fem.Function) -> fem.Function:
    """h(x)/h at the nodes of every cell; see `models.shell.thickness`."""
    assert thickness.of_position
    nodes = _nodes(r0)
    return nodal_thickness(thickness.of_position(*np.moveaxis(nodes, -1, 0)), nodes, r0.function_space)


def _nodes(r0: fem.Function) -> NDArray[np.float64]:
    """Undeformed places (cells, nodes, 3) at the azimuth 0."""
    return np.insert(r0.x.array.reshape(-1, 2)[r0.function_space.dofmap.list], 1, 0.0, axis=-1)


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

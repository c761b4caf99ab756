"""Normals along the meridian, and a magnetisation and a thickness that vary along it."""

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.patterns import Pattern, cells_of, inside, shown
from magshell_fenicsx.models.shell.thickness import Thickness, nodal_thickness, refuse_unfit

Array = NDArray[np.float64]


def pattern_field(pattern: Pattern, r0: fem.Function, finer: int = 0) -> tuple[fem.Function, float | None]:
    """The pattern along (e_rho, e_theta, e_z) in every cell; see `shell.patterns.pattern_field`."""
    V = r0.function_space
    Q = fem.functionspace(V.mesh, ("DG", V.element.basix_element.degree + finer, (3,)))
    field = fem.Function(Q, name="Br")
    nodes, normals = places(r0, Q.element.basix_element.points)
    fit = shown(pattern, cells_of(r0), pattern(inside(nodes), normals), Q.element.basix_element)
    field.x.array.reshape(-1, 3)[Q.dofmap.list] = fit.nodal
    return field, None if fit.smooth else 2 * np.pi * fit.size


def thickness_field(thickness: Thickness, r0: fem.Function) -> fem.Function:
    """h(x)/h at the nodes of every cell; see `models.shell.thickness`."""
    nodes, _ = places(r0)
    values = thickness.at(nodes)
    refuse_unfit(values, nodes, r0.function_space.mesh.comm)
    return nodal_thickness(thickness.shown(cells_of(r0), values), nodes, r0.function_space)


def places(r0: fem.Function, at: Array | None = None) -> tuple[Array, Array]:
    """The nodes of every cell, or other reference points (n, 1), and the normals there: (cells, n, 3) each."""
    V = r0.function_space
    element = V.element.basix_element
    table = element.tabulate(1, element.points if at is None else at)[..., 0]
    (rho, z), (rho_s, z_s) = (np.moveaxis(v, -1, 0) for v in np.einsum("dvk,cki->dcvi", table, _nodes(r0)))
    normals = np.stack([-z_s, 0 * z_s, rho_s], axis=-1) / np.hypot(rho_s, z_s)[..., None]
    return np.stack([rho, 0 * rho, z], axis=-1), np.asarray(normals)


def _nodes(r0: fem.Function) -> Array:
    """rho and z (cells, nodes, 2)."""
    return np.asarray(r0.x.array.reshape(-1, 2)[r0.function_space.dofmap.list])


def nodal_normals(r0: fem.Function) -> Array:
    """Unit normals (nodes, 3) at the azimuth 0, averaged over the cells that meet."""
    normals = np.zeros((len(r0.x.array) // 2, 3))
    np.add.at(normals, r0.function_space.dofmap.list, places(r0)[1])
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])

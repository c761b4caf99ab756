"""Normals at the nodes of a triangulation in space."""

import basix
import numpy as np
from dolfinx import mesh
from dolfinx.cpp.io import perm_gmsh
from numpy.typing import NDArray

Array = NDArray[np.float64]
ORDERS = {3: 1, 6: 2, 10: 3}  # nodes of a triangle -> its order


def nodal_normals(nodes: Array, cells: NDArray[np.int64]) -> Array:
    """Unit normals (n, 3): means over the triangles (m, 3 | 6 | 10) around each node, with their angles as weights."""
    count = cells.shape[1]
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType.triangle, ORDERS[count], basix.LagrangeVariant.equispaced
    )
    ordered = cells[:, perm_gmsh(mesh.CellType.triangle, count)]
    a1, a2 = np.einsum("dqk,ckx->dcqx", element.tabulate(1, element.points)[1:, :, :, 0], nodes[ordered])
    angles = np.full(ordered.shape, np.pi)
    for corner, (e, f) in enumerate(((a1, a2), (a2 - a1, -a1), (-a2, a1 - a2))):  # vertices come first
        cosine = np.sum(_unit(e[:, corner]) * _unit(f[:, corner]), axis=1)
        angles[:, corner] = np.arccos(np.clip(cosine, -1, 1))
    total = np.zeros_like(nodes)
    np.add.at(total, ordered, angles[..., None] * _unit(np.cross(a1, a2)))
    return _unit(total)


def _unit(v: Array) -> Array:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300))

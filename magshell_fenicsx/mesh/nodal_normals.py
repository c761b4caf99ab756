"""Normals at the nodes of a triangulation in space."""

import basix
import numpy as np
from dolfinx import mesh
from dolfinx.cpp.io import perm_gmsh
from numpy.typing import NDArray

Array = NDArray[np.float64]
ORDERS = {3: 1, 6: 2, 10: 3}  # nodes of a triangle -> its order


def nodal_normals(nodes: Array, cells: NDArray[np.int64]) -> Array:
    """Unit normals (n, 3): means over the triangles (m, 3 | 6 | 10) around each node, with their areas as weights."""
    count = cells.shape[1]
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType.triangle, ORDERS[count], basix.LagrangeVariant.equispaced
    )
    ordered = cells[:, perm_gmsh(mesh.CellType.triangle, count)]
    a1, a2 = np.einsum("dqk,ckx->dcqx", element.tabulate(1, element.points)[1:, :, :, 0], nodes[ordered])
    total = np.zeros_like(nodes)
    np.add.at(total, ordered, np.cross(a1, a2))
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1)[:, None], 1e-300))

"""Orthonormal coordinates of flat cells, and the transformation from reference coordinates."""

import numpy as np
from dolfinx import mesh
from numpy.typing import NDArray

from magshell_fenicsx.platform import compat

Array = NDArray[np.float64]


def cell_frames(domain: mesh.Mesh) -> Array:
    """(local cells, 4): p, q, s and the Jacobian determinant of each triangle in space.

    With X, Y the reference coordinates and x along the first edge, d/dx = p d/dX and d/dy = q d/dX + s d/dY.
    """
    corners = domain.geometry.x[compat.corner_numbers(domain)]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = np.linalg.norm(first, axis=1)
    along = first / length[:, None]
    shift = np.einsum("ci,ci->c", second, along)
    height = np.linalg.norm(second - shift[:, None] * along, axis=1)
    return np.column_stack([1 / length, -shift / (length * height), 1 / height, length * height])

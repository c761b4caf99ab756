"""The surface that a meridian sweeps, as flat triangles for pictures and for ParaView."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.axisymmetric.model import MeridianModel
from magshell_fenicsx.axisymmetric.pattern import cell_normals
from magshell_fenicsx.solve.system import Vector

Array = NDArray[np.float64]


class Revolution:
    """The vertices of a meridian turned into `sectors` equal angles.

    Attributes
    ----------
    r0, n0
        (n, 3) undeformed placement and unit normal, lengths in R; the pole comes first.
    cells
        (m, 3) node numbers of triangles with the outer side up.
    """

    def __init__(self, model: MeridianModel, sectors: int = 96) -> None:
        V = model.V
        self._vertices = np.argsort(V.tabulate_dof_coordinates()[:, 0])[:: model.degree]
        theta = np.arange(sectors) * 2 * np.pi / sectors
        self._e_rho = np.column_stack([np.cos(theta), np.sin(theta), 0 * theta])
        normals = np.zeros((len(model.r0.x.array) // 2, 3))
        np.add.at(normals, V.dofmap.list, cell_normals(model.r0))
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        self.r0, self.n0 = self._turned(model.r0.x.array.reshape(-1, 2)), self._turned(normals[:, [0, 2]])
        self.cells = self._triangles(len(self._vertices) - 1, sectors)

    def displacement(self, u: Vector) -> Array:
        """The displacement of the nodes, (n, 3) over R."""
        return self._turned(u.reshape(-1, 2))

    def _turned(self, nodal: Array) -> Array:
        """(rho, z) components at the meridian's nodes -> vectors at the pole and on the circles."""
        along = nodal[self._vertices]
        circles = along[1:, None, :1] * self._e_rho + along[1:, None, 1:] * np.array([0.0, 0.0, 1.0])
        return np.concatenate([[[0.0, 0.0, along[0, 1]]], circles.reshape(-1, 3)])

    @staticmethod
    def _triangles(circles: int, sectors: int) -> NDArray[np.int64]:
        here = np.arange(sectors)
        there = (here + 1) % sectors
        cap = np.column_stack([0 * here, 1 + here, 1 + there])
        inner = 1 + sectors * np.arange(circles - 1)[:, None]
        a, b, c, d = inner + here, inner + there, inner + sectors + here, inner + sectors + there
        bands = [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, c, d), (a, d, b))]
        return np.concatenate([cap, *bands])

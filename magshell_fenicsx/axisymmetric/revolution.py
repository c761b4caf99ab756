"""The surface that a meridian sweeps, as flat triangles for pictures and for ParaView."""

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.axisymmetric.model import MeridianModel
from magshell_fenicsx.axisymmetric.pattern import cell_normals
from magshell_fenicsx.results.interpretation import SurfaceGeometry
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
        self._model, V = model, model.V
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

    def geometry(self) -> tuple[SurfaceGeometry, Array]:
        """Bases and curvature at the vertices, and r0 (n, 3), along (e_rho, e_theta, e_z) at theta = 0."""
        r = self._jets(self._model.r0)
        rho = r[0, :, 0]
        zero = np.zeros_like(rho)
        a = np.stack([self._lifted(r[1]), np.column_stack([zero, rho, zero])], axis=1)
        m = np.cross(a[:, 0], a[:, 1])
        n0: Array = m / np.linalg.norm(m, axis=1)[:, None]
        b11, b22 = np.einsum("vi,vi->v", n0, self._lifted(r[2])), -n0[:, 0] * rho
        b0 = np.stack([np.column_stack([b11, zero]), np.column_stack([zero, b22])], axis=1)
        return SurfaceGeometry(a, n0, b0), self._lifted(r[0])

    def slopes(self) -> Array:
        """u,_1 and u,_2 of the model's present u there, (n, 2, 3)."""
        u = self._jets(self._model.u)
        zero = np.zeros(u.shape[1])
        return np.stack([self._lifted(u[1]), np.column_stack([zero, u[0, :, 0], zero])], axis=1)

    def repeated(self, along: Array) -> Array:
        """A scalar (vertices,) at the pole and on the circles."""
        return np.concatenate([along[:1], np.repeat(along[1:], len(self._e_rho))])

    def _jets(self, f: fem.Function) -> Array:
        """f, f' and f'' at the vertices, (3, vertices, 2), each from the cell below; a little off the pole."""
        V = f.function_space
        order = np.argsort(V.tabulate_dof_coordinates()[V.dofmap.list].mean(axis=1)[:, 0])
        nodes = f.x.array.reshape(-1, 2)[V.dofmap.list[order]]
        table = V.element.basix_element.tabulate(2, np.array([[1e-3], [1.0]]))[:, :, :, 0]
        values = np.einsum("dvk,cki->dcvi", table, nodes)
        return np.concatenate([values[:, :1, 0], values[:, :, 1]], axis=1)

    @staticmethod
    def _lifted(v: Array) -> Array:
        """(n, 2) along (e_rho, e_z) -> (n, 3) along (e_rho, e_theta, e_z)."""
        return np.insert(v, 1, 0.0, axis=1)

    def _turned(self, nodal: Array) -> Array:
        """(rho, z) components at the meridian's nodes -> vectors at the pole and on the circles."""
        return self.turned(nodal[self._vertices])

    def turned(self, along: Array) -> Array:
        """(rho, z) components at the vertices -> vectors at the pole and on the circles."""
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

"""The deformed mid-surface gathered on rank 0, for pictures and for ParaView."""

from dataclasses import dataclass

import basix
import basix.ufl
import numpy as np
from dolfinx import fem, mesh
from dolfinx.cpp.io import perm_vtk
from numpy.typing import NDArray

from magshell_fenicsx.shell.model import ShellModel
from magshell_fenicsx.solve.system import Vector

LAGRANGE_TRIANGLE = 69  # VTK's number of the triangle of arbitrary order


@dataclass(frozen=True)
class Surface:
    """Nodes of the whole mid-surface, in lengths of R.

    Attributes
    ----------
    r0, u, n0
        (n, 3) undeformed placement, displacement, undeformed normal.
    cells
        (m, k) node numbers of triangles of the displacement's degree, in VTK's order.
    """

    r0: NDArray[np.float64]
    u: NDArray[np.float64]
    n0: NDArray[np.float64]
    cells: NDArray[np.int64]

    @property
    def w(self) -> NDArray[np.float64]:
        """Inward normal displacement -u . n0 over R, (n,)."""
        return np.asarray(-np.einsum("ij,ij->i", self.u, self.n0))


class SurfaceGatherer:
    """Gathers displacements of one model; what does not change is gathered once."""

    def __init__(self, model: ShellModel) -> None:
        self._model = model
        domain, degree = model.V.mesh, model.degree
        self.comm = domain.comm
        # VTK's nodes are equidistant, the displacement's are not
        element = basix.ufl.element(
            "Lagrange", "triangle", degree, lagrange_variant=basix.LagrangeVariant.equispaced, shape=(3,)
        )
        self._V = fem.functionspace(domain, element)
        self._field = fem.Function(self._V)
        self._r0 = self._nodes(model.r0)
        map_ = self._V.dofmap.index_map
        owned = domain.topology.index_map(2).size_local
        local = self._V.dofmap.list[:owned]
        numbers = map_.local_to_global(local.ravel().astype(np.int32)).reshape(local.shape)
        cells = self.comm.gather(numbers[:, np.argsort(perm_vtk(mesh.CellType.triangle, local.shape[1]))])
        normals = self.comm.gather((numbers, self._cell_normals(owned)))
        if self.comm.rank == 0:
            self._cells = np.concatenate(cells)
            total = np.zeros((map_.size_global, 3))
            for where, n in normals:
                np.add.at(total, where, n)
            self._n0 = total / np.linalg.norm(total, axis=1)[:, None]

    def gather(self, u: Vector) -> Surface | None:
        """The surface with a displacement, on rank 0; None elsewhere."""
        self._model.system.set(u)
        nodes = self._nodes(self._model.u)
        return Surface(self._r0, nodes, self._n0, self._cells) if self.comm.rank == 0 else None

    def _nodes(self, f: fem.Function) -> NDArray[np.float64]:
        """Values at the owned nodes of all ranks, in global order, on rank 0."""
        self._field.interpolate(f)
        owned = self._field.x.array.reshape(-1, 3)[: self._V.dofmap.index_map.size_local]
        parts = self.comm.gather(owned.copy())
        return np.concatenate(parts) if self.comm.rank == 0 else owned

    def _cell_normals(self, owned: int) -> NDArray[np.float64]:
        """Undeformed normal at each node of each owned cell, (cells, nodes, 3)."""
        V = self._model.V
        gradients = V.element.basix_element.tabulate(1, self._V.element.interpolation_points())[1:, :, :, 0]
        nodes = self._model.r0.x.array.reshape(-1, 3)[V.dofmap.list[:owned]]
        a1, a2 = np.einsum("dvk,cki->dcvi", gradients, nodes)
        m = np.cross(a1, a2)
        return np.asarray(m / np.linalg.norm(m, axis=2)[:, :, None])


def turned(surface: Surface, azimuth: float) -> Surface:
    """The surface turned about e3 (rad): from the model's frame back to the user's."""
    Q = np.array([[np.cos(azimuth), np.sin(azimuth), 0], [-np.sin(azimuth), np.cos(azimuth), 0], [0, 0, 1]])
    return Surface(surface.r0 @ Q, surface.u @ Q, surface.n0 @ Q, surface.cells)


def completed(surface: Surface) -> Surface:
    """A half surface (y >= 0) with its mirror image; mirrored cells keep their outward side by VTK's own flag."""
    flip = np.array([1.0, -1.0, 1.0])
    count = len(surface.r0)
    return Surface(
        np.concatenate([surface.r0, flip * surface.r0]),
        np.concatenate([surface.u, flip * surface.u]),
        np.concatenate([surface.n0, flip * surface.n0]),
        np.concatenate([surface.cells, surface.cells + count]),
    )

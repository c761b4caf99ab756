"""The deformed mid-surface gathered on rank 0, for pictures and for ParaView."""

from dataclasses import dataclass, replace

import basix
import basix.ufl
import numpy as np
from dolfinx import fem, mesh
from dolfinx.cpp.io import perm_vtk
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.axisymmetric.model import MeridianModel
from magshell_fenicsx.axisymmetric.revolution import Revolution
from magshell_fenicsx.results.interpretation import SurfaceGeometry, Torque, magnetic_loads
from magshell_fenicsx.shell.model import ShellModel
from magshell_fenicsx.solve.system import Vector

TRIANGLE, LAGRANGE_TRIANGLE, LAGRANGE_HEXAHEDRON = 5, 69, 72  # VTK's numbers; the flat triangle, cells of any order
HEXAHEDRON_NODES = 27
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Surface:
    """Nodes of the whole mid-surface, or of the whole body of a solid, in lengths of R.

    Attributes
    ----------
    r0, u, n0
        (n, 3) undeformed placement, displacement, undeformed normal.
    cells
        (m, k) node numbers of triangles of the displacement's degree or of hexahedra, in VTK's order.
    fields
        Name -> (n,) or (n, 3): the magnetic loads, where the field is uniform.
    """

    r0: Array
    u: Array
    n0: Array
    cells: NDArray[np.int64]
    fields: dict[str, Array]

    @property
    def is_body(self) -> bool:
        """Whether its cells are hexahedra."""
        return self.cells.shape[1] == HEXAHEDRON_NODES

    @property
    def w(self) -> Array:
        """Inward normal displacement -u . n0 over R, (n,)."""
        return np.asarray(-np.einsum("ij,ij->i", self.u, self.n0))


class SurfaceGatherer:
    """Gathers displacements of one model; what does not change is computed and gathered once."""

    def __init__(self, model: ShellModel) -> None:
        self._model = model
        domain, degree, map_ = model.V.mesh, model.degree, model.V.dofmap.index_map
        self.comm = domain.comm
        # VTK's nodes are equidistant, the displacement's are not; there are as many of them on edges and in cells
        element = basix.create_element(
            basix.ElementFamily.P, basix.CellType.triangle, degree, basix.LagrangeVariant.equispaced
        )
        self._places = element.points
        self._table = model.V.element.basix_element.tabulate(2, self._places)[:, :, :, 0]
        self._owned = domain.topology.index_map(2).size_local
        V = fem.functionspace(domain, basix.ufl.wrap_element(element))  # numbers nodes that two cells share alike
        local = V.dofmap.list[: self._owned]
        numbers = V.dofmap.index_map.local_to_global(local.ravel().astype(np.int32)).reshape(local.shape)
        self._size, self._numbers = map_.size_global, self.comm.gather(numbers)
        cells = self.comm.gather(numbers[:, np.argsort(perm_vtk(mesh.CellType.triangle, local.shape[1]))])
        self._cells = np.concatenate(cells) if self.comm.rank == 0 else numbers
        r = self._at_nodes(model.r0, 6)
        g = _geometry(r)
        n0 = self._averaged(g.n0)
        self._r0, self._n0 = self._averaged(r[0]), n0 / np.linalg.norm(n0, axis=1)[:, None]
        self._loads: dict[str, Array] = {}
        self._torque: Torque | None = None
        field = model.loads.magnetic
        if field and field.gradient is None:
            h = model.material.h if model.thickness is None else model.material.h * self._thickness(model.thickness)
            loads, self._torque = magnetic_loads(g, field, r[0], h)
            self._loads = {name: self._averaged(value) for name, value in loads.items()}

    def gather(self, u: Vector) -> Surface | None:
        """The surface with a displacement, on rank 0; None elsewhere."""
        self._model.system.set(u)
        jet = self._at_nodes(self._model.u, 3)
        nodes, fields = self._averaged(jet[0]), dict(self._loads)
        if self._torque:
            fields["tau"] = self._averaged(self._torque(np.moveaxis(jet[1:], 0, -2)))
        return Surface(self._r0, nodes, self._n0, self._cells, fields) if self.comm.rank == 0 else None

    def _at_nodes(self, f: fem.Function, parts: int) -> Array:
        """The first of f, f,_1, f,_2, f,_11, f,_12, f,_22 in reference coordinates at each owned cell's nodes."""
        coefficients = f.x.array.reshape(-1, 3)[self._model.V.dofmap.list[: self._owned]]
        return np.asarray(np.matmul(self._table[:parts, None], coefficients))

    def _thickness(self, factor: fem.Function) -> Array:
        """h(x)/h at each owned cell's nodes."""
        V = factor.function_space
        element = V.element.basix_element
        values = element.tabulate(0, self._places)[0, :, :, 0]
        return np.asarray(factor.x.array[V.dofmap.list[: self._owned]] @ values.T)

    def _averaged(self, values: Array) -> Array:
        """Mean over the cells that share a node, in global order, on rank 0."""
        parts = self.comm.gather(values)
        if self.comm.rank:
            return values
        where = np.concatenate([numbers.ravel() for numbers in self._numbers])
        whole = np.concatenate(parts).reshape(len(where), -1)
        count = np.bincount(where, minlength=self._size)
        sums = [np.bincount(where, weights=column, minlength=self._size) for column in whole.T]
        return (np.stack(sums, axis=1) / count[:, None]).reshape(-1, *values.shape[2:])


def _geometry(r: Array) -> SurfaceGeometry:
    """Bases and curvature of a jet (6, ..., 3)."""
    m = np.cross(r[1], r[2])
    n0: Array = m / np.linalg.norm(m, axis=-1)[..., None]
    b11, b12, b22 = np.einsum("d...i,...i->d...", r[3:], n0)
    b0 = np.stack([np.stack([b11, b12], -1), np.stack([b12, b22], -1)], -2)
    return SurfaceGeometry(np.moveaxis(r[1:3], 0, -2), n0, b0)


class RevolvedGatherer:
    """The surface that a meridian sweeps, as flat triangles."""

    def __init__(self, model: MeridianModel, comm: MPI.Comm) -> None:
        self.comm, self._model, self._swept = comm, model, Revolution(model)
        self._loads: dict[str, Array] = {}
        self._torque: Torque | None = None
        field = model.loads.magnetic
        if field and field.gradient is None:
            geometry, r0 = self._swept.geometry()
            loads, self._torque = magnetic_loads(geometry, field, r0, model.material.h)
            self._loads = {name: self._around(values) for name, values in loads.items()}

    def gather(self, u: Vector) -> Surface | None:
        """The surface with a displacement, on rank 0; None elsewhere."""
        if self.comm.rank:
            return None
        swept, fields = self._swept, dict(self._loads)
        self._model.system.set(u)
        if self._torque:
            fields["tau"] = self._around(self._torque(swept.slopes()))
        return Surface(swept.r0, swept.displacement(u), swept.n0, swept.cells, fields)

    def _around(self, values: Array) -> Array:
        return self._swept.turned(values[:, [0, 2]]) if values.ndim == 2 else self._swept.repeated(values)


def turned(surface: Surface, azimuth: float) -> Surface:
    """The surface turned about e3 (rad): from the model's frame back to the user's."""
    Q = np.array([[np.cos(azimuth), np.sin(azimuth), 0], [-np.sin(azimuth), np.cos(azimuth), 0], [0, 0, 1]])
    fields = {name: f @ Q if f.ndim == 2 else f for name, f in surface.fields.items()}
    return replace(surface, r0=surface.r0 @ Q, u=surface.u @ Q, n0=surface.n0 @ Q, fields=fields)


def completed(surface: Surface) -> Surface:
    """A half surface (y >= 0) with its mirror image; seen from outside, its triangles run the other way round."""
    flip = np.array([1.0, -1.0, 1.0])

    def both(f: Array) -> Array:
        return np.concatenate([f, flip * f if f.ndim == 2 else f])

    return Surface(
        both(surface.r0),
        both(surface.u),
        both(surface.n0),
        np.concatenate([surface.cells, surface.cells + len(surface.r0)]),
        {name: both(f) for name, f in surface.fields.items()},
    )

"""The gatherer of each model: it collects nodal fields on rank 0 for pictures and ParaView."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from dolfinx import fem, mesh
from dolfinx.cpp.io import perm_vtk
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import Vector
from magshell_fenicsx.models.axisymmetric.model import MeridianModel
from magshell_fenicsx.models.shell.model import ShellModel
from magshell_fenicsx.models.solid.model import SolidModel
from magshell_fenicsx.output.fields.revolved import RevolvedGatherer
from magshell_fenicsx.output.fields.surface import W0, Surface, SurfaceGatherer

Array = NDArray[np.float64]


class BodyGatherer:
    """Gathers the displacement of one solid; n0 is the direction of the thickness."""

    def __init__(self, model: SolidModel) -> None:
        self._model, self.comm = model, model.V.mesh.comm
        V = model.V
        cells = V.dofmap.list[: V.mesh.topology.index_map(3).size_local]
        numbers = V.dofmap.index_map.local_to_global(cells.ravel().astype(np.int32)).reshape(cells.shape)
        to_vtk = np.argsort(perm_vtk(mesh.CellType.hexahedron, cells.shape[1]))
        self._cells = self._on_first(numbers[:, to_vtk])
        self._fields: dict[str, Array] = {}
        if model.body.w0 is not None:
            owned = model.body.at_nodes(V, model.body.w0)[: V.dofmap.index_map.size_local]
            self._fields[W0] = self._on_first(owned / model.material.h)
        self._r0, self._n0 = self._nodes(model.r0), self._nodes(_outwards(model.r0))

    def gather(self, u: Vector, mu: Mapping[str, float] | None = None) -> Surface | None:
        """The displaced body on rank 0; None on other ranks."""
        nodes = self._on_first(self._model.system.with_ghosts(u)[: self._model.system.size].reshape(-1, 3))
        return Surface(self._r0, nodes, self._n0, self._cells, self._fields) if self.comm.rank == 0 else None

    def _nodes(self, f: fem.Function) -> Array:
        """Values at the owned nodes of all ranks, in global order, on rank 0."""
        return self._on_first(f.x.array[: self._model.system.size].reshape(-1, 3))

    def _on_first(self, part: NDArray[Any]) -> NDArray[Any]:
        parts = self.comm.gather(part.copy())
        return np.concatenate(parts) if self.comm.rank == 0 else part


def _outwards(r0: fem.Function) -> fem.Function:
    """The unit vector in the direction of the thickness, at the nodes."""
    V = r0.function_space
    element = V.element.basix_element
    by_third = element.tabulate(1, element.points)[3, :, :, 0]
    along = np.einsum("vk,cki->cvi", by_third, r0.x.array.reshape(-1, 3)[V.dofmap.list])
    n0 = fem.Function(V)
    n0.x.array.reshape(-1, 3)[V.dofmap.list] = along / np.linalg.norm(along, axis=2)[..., None]
    return n0


class Gatherer(Protocol):
    """Gathers the displacement and fields of one model; collective."""

    comm: MPI.Comm

    def gather(self, u: Vector, mu: Mapping[str, float] | None = None) -> Surface | None:
        """The displaced nodes with their fields at the amplitudes mu, on rank 0; None on other ranks."""


def gatherer(model: ShellModel | MeridianModel | SolidModel, comm: MPI.Comm) -> Gatherer:
    """The gatherer of a model."""
    if model.axisymmetric:
        return RevolvedGatherer(model, comm)
    return SurfaceGatherer(model) if model.thin else BodyGatherer(model)

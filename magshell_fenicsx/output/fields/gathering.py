"""The gatherer of each model: it collects nodal fields on rank 0 for pictures and ParaView."""

from collections.abc import Mapping
from typing import Protocol

from mpi4py import MPI

from magshell_fenicsx.continuation.system import Vector
from magshell_fenicsx.models.axisymmetric.model import MeridianModel
from magshell_fenicsx.models.shell.model import ShellModel
from magshell_fenicsx.models.solid.model import SolidModel
from magshell_fenicsx.output.fields.body import BodyGatherer
from magshell_fenicsx.output.fields.revolved import RevolvedGatherer
from magshell_fenicsx.output.fields.surface import Surface, SurfaceGatherer


class Gatherer(Protocol):
    """Gathers the displacement and fields of one model; collective."""

    comm: MPI.Comm

    def gather(self, u: Vector, mu: Mapping[str, float] | None = None) -> Surface | None:
        """The displaced nodes with their fields at the amplitudes mu, on rank 0; None on other ranks."""


def gatherer(model: ShellModel | MeridianModel | SolidModel, comm: MPI.Comm) -> Gatherer:
    """The gatherer of a model."""
    if isinstance(model, MeridianModel):
        return RevolvedGatherer(model, comm)
    return BodyGatherer(model) if isinstance(model, SolidModel) else SurfaceGatherer(model)

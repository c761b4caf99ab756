"""A moment on an edge: a term whose potential goes on counting beyond half a turn."""

import numpy as np
import ufl
from dolfinx import fem

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.models.shell.energy import Density, ShellTerm


class MomentTerm(ShellTerm):
    """-Pi = intensity times the edge's angle, integrated; its derivatives know no turns, the energy counts them.

    The angle is told from where the edge was when the energy was last asked for, so that between two
    such times, points of a path, it must turn by less than pi.

    Parameters
    ----------
    density
        Its last parameter is the turn that the angle is told from; see `edges.turning`.
    whole
        Intensity times the edge's length: -Pi of one radian.
    """

    def __init__(
        self, name: str, density: Density, energy: ufl.Form, u: fem.Function, log: KernelLog, whole: float
    ) -> None:
        super().__init__(name, density, energy, u, log, "load")
        past = density.parameters[-1]
        assert isinstance(past, fem.Constant)
        self._past, self._whole, self._comm = past, whole, u.function_space.mesh.comm
        self._turned = 0.0

    def energy(self) -> float:
        """Collective: all ranks must agree on the turn."""
        on_this_rank = super().energy()
        since = -float(self._comm.allreduce(on_this_rank)) / self._whole  # mean angle
        share = on_this_rank - (self._turned * self._whole if self._comm.rank == 0 else 0.0)
        self._turned += since
        self._past.value = np.array([np.cos(self._turned), np.sin(self._turned)])
        return share

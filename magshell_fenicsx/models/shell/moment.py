"""A moment on an edge: a term whose potential goes on counting beyond half a turn."""

import numpy as np
from dolfinx import fem

from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.models.shell.energy import ShellTerm


class Counted(FormTerm):
    """-Pi = intensity times the edge's angle, integrated; its derivatives know no turns, the energy counts them.

    The angle is counted from where the edge was at the last accepted point, so that between two of these it must
    turn by less than pi.
    """

    def count_from(self, past: fem.Constant, whole: float) -> None:
        """Count the turns.

        Parameters
        ----------
        past
            The turn that the angle is counted from; see `edges.turning`.
        whole
            Intensity times the edge's length: -Pi of one radian.
        """
        self._past, self._whole, self._comm = past, whole, self._u.function_space.mesh.comm
        self._turned = 0.0

    def energy(self) -> float:
        return super().energy() - (self._turned * self._whole if self._comm.rank == 0 else 0.0)

    def accept(self) -> None:
        """Count from the present displacement on. Collective: all ranks must agree on the turn."""
        self._turned -= float(self._comm.allreduce(super().energy())) / self._whole  # mean angle
        self._past.value = np.array([np.cos(self._turned), np.sin(self._turned)])


class MomentTerm(Counted, ShellTerm):
    """That of a shell."""

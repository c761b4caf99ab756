"""Supports that move: what is held, and the bodies that the motions of the loads make of them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.motion import Motion
from magshell_fenicsx.assembly.moving import Body, Moving
from magshell_fenicsx.models.shell.parameters import Loads


@dataclass(frozen=True)
class Support:
    """What a named edge, point or patch holds.

    Attributes
    ----------
    dofs
        Local numbers, with ghosts, of the components of the displacement.
    edge
        Name of the term that holds the normal of a clamped edge; "" without.
    turn
        The rotation in that term, if a motion turns the edge.
    """

    dofs: NDArray[np.int32]
    edge: str = ""
    turn: fem.Constant | None = None

    @classmethod
    def of(cls, held: Iterable[fem.DirichletBC], edge: str = "", turn: fem.Constant | None = None) -> "Support":
        dofs = [bc.dof_indices()[0] for bc in held]
        return cls(np.unique(np.concatenate(dofs)).astype(np.int32), edge, turn)


def motions_of(loads: Loads, name: str) -> Sequence[Motion]:
    """The motions of a support, in the order of the loads."""
    return [move.motion for move in loads.moves if name in move.names]


def rotation_of(loads: Loads, name: str, V: fem.FunctionSpace) -> fem.Constant | None:
    """The rotation of a clamped edge, to be set; None if no motion turns it."""
    turns = any(motion.turns for motion in motions_of(loads, name))
    return fem.Constant(V.mesh, np.eye(3)) if turns else None


def moving(r0: fem.Function, supports: Mapping[str, Support], loads: Loads) -> Moving | None:
    """The nodes that move; None without motions."""
    moved = {name: motions_of(loads, name) for name in supports}
    bodies = [Body(moved[name], s.dofs, s.edge, s.turn) for name, s in supports.items() if moved[name]]
    return Moving(r0, bodies) if bodies else None

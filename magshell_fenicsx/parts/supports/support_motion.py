"""Supports that move: their unknowns, and the rigid bodies that the loads' motions make of them."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.prescribed_motion import (
    EdgeCurve,
    EdgePressure,
    Lid,
    PrescribedMotion,
    RigidBody,
    end_corners,
)
from magshell_fenicsx.assembly.rigid_motion import RigidMotion
from magshell_fenicsx.parts.loads import Loads

PRESSURE = "pressure"  # its amplitude
SupportKind = Literal["point", "part", "plane"]
PRECEDENCE: tuple[SupportKind, ...] = ("point", "part", "plane")


@dataclass(frozen=True)
class Support:
    """Unknowns that a named edge, point or patch holds.

    Attributes
    ----------
    dofs
        Local numbers, with ghosts, of the held components of the displacement.
    edge
        Name of the term that holds the normal of a clamped edge; "" without.
    turn
        The rotation in that term, if a motion turns the edge.
    kind
        Whether it is a point, a part (an edge or a patch), or a mirror plane, in the direction of
        its normal alone. Of the supports that hold a component, those that come first in
        `PRECEDENCE` have its force.
    """

    dofs: NDArray[np.int32]
    edge: str = ""
    turn: fem.Constant | None = None
    kind: SupportKind = "part"

    @classmethod
    def from_conditions(
        cls,
        conditions: Iterable[fem.DirichletBC],
        edge: str = "",
        turn: fem.Constant | None = None,
        *,
        kind: SupportKind = "part",
    ) -> "Support":
        dofs = [bc.dof_indices()[0] for bc in conditions]
        return cls(np.unique(np.concatenate(dofs)).astype(np.int32), edge, turn, kind)


def motions_of(loads: Loads, name: str) -> Sequence[RigidMotion]:
    """Return the motions of a support, in the order of the loads."""
    return [move.motion for move in loads.moves if name in move.names]


def rotation_of(loads: Loads, name: str, V: fem.FunctionSpace) -> fem.Constant | None:
    """Return a constant for the rotation of a clamped edge; None if no motion turns it."""
    turns = any(motion.turns for motion in motions_of(loads, name))
    return fem.Constant(V.mesh, np.eye(3)) if turns else None


def moving(
    r0: fem.Function,
    supports: Mapping[str, Support],
    loads: Loads,
    edge_pressure: EdgePressure | None = None,
) -> PrescribedMotion | None:
    """Return the prescribed motion of the supports' nodes; None without motions."""
    motions_of_supports = {name: motions_of(loads, name) for name in supports}
    bodies = [
        RigidBody(motions_of_supports[name], s.dofs, s.edge, s.turn)
        for name, s in supports.items()
        if motions_of_supports[name]
    ]
    return PrescribedMotion(r0, bodies, edge_pressure) if bodies else None


def enclosed(loads: Loads, free_edges: Iterable[str], without_potential: Collection[str]) -> bool:
    """Return whether closing surfaces on moving edges close the shell.

    All edges must be held, move, or lie in planes of symmetry.
    """
    return (
        bool(loads.moves)
        and not without_potential
        and all(motions_of(loads, name) for name in free_edges)
    )


def pressed_edges(
    r0: fem.Function,
    curves: Mapping[str, EdgeCurve],
    planes: Collection[str],
    loads: Loads,
    unit: float,
    closing: NDArray[np.float64] | None,
) -> EdgePressure:
    """Return the live pressure on the closing surfaces at moving edges; collective.

    Edges that move alike have one lid, if together they are closed or end on planes of symmetry.

    Parameters
    ----------
    curves
        Of the edges that move and of those on planes of symmetry, by name.
    planes
        The names of these.
    unit
        Of the pressure.
    closing
        A point (3,) of all planes of symmetry; None if they have none.
    """
    comm, x = r0.function_space.mesh.comm, r0.x.array.reshape(-1, 3)
    edges_by_motion = dict[tuple[object, ...], list[str]]()
    for name in curves:
        if motions := motions_of(loads, name):
            motion_key = tuple(
                (m.name, *(part.tobytes() for part in (m.shift, m.turn, m.centre))) for m in motions
            )
            edges_by_motion.setdefault(motion_key, []).append(name)
    on_planes = np.concatenate(
        [np.empty(0, np.int64), *(curves[name].corners.ravel() for name in planes)]
    )
    on_any = np.concatenate(comm.allgather(on_planes))
    lids = []
    for names in edges_by_motion.values():
        of_lid = [curves[name] for name in names]
        open_at = end_corners(of_lid, comm)
        if not len(open_at) or (closing is not None and np.isin(open_at, on_any).all()):
            origin = np.zeros(3) if closing is None else closing
            lids.append(Lid.cone(of_lid, x, motions_of(loads, names[0]), origin, comm))
    return EdgePressure(
        PRESSURE, unit, lids, [curves[name] for names in edges_by_motion.values() for name in names]
    )

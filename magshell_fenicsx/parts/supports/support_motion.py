"""Supports that move: their unknowns, and the rigid bodies that the loads' motions make of them.

A rigid motion is a shift and a turn in proportion to an amplitude (load parameter). A lid is a
rigid surface that closes a moving edge, so that a live pressure, which follows the surface, acts
on a closed volume. p_c is the unit of pressures, E h/R the one of models: Young's modulus E,
thickness h, reference length R. `loads.moves` has all motions, each with the names of its supports.
"""

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
        Whether it is a point, a part (an edge or a patch), or a mirror plane, which holds the
        direction of its normal alone. Where several supports hold a component, those whose kind
        comes first in `PRECEDENCE` have its force.
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
        """Return the support that holds the unknowns of some conditions, each unknown once."""
        dofs = [bc.dof_indices()[0] for bc in conditions]
        return cls(np.unique(np.concatenate(dofs)).astype(np.int32), edge, turn, kind)


def motions_of(loads: Loads, name: str) -> Sequence[RigidMotion]:
    """Return the rigid motions that loads prescribe to a named support, in their order."""
    return [move.motion for move in loads.moves if name in move.names]


def rotation_of(loads: Loads, name: str, V: fem.FunctionSpace) -> fem.Constant | None:
    """Return a constant for the rotation matrix of a clamped edge; None if nothing turns it."""
    turns = any(motion.turns for motion in motions_of(loads, name))
    return fem.Constant(V.mesh, np.eye(3)) if turns else None


def moving(
    r0: fem.Function,
    supports: Mapping[str, Support],
    loads: Loads,
    edge_pressure: EdgePressure | None = None,
) -> PrescribedMotion | None:
    """Return the prescribed motion of the supports' nodes; None if no load moves a support.

    Parameters
    ----------
    r0
        Undeformed placement of the nodes.
    supports
        Name -> unknowns that the support holds.
    edge_pressure
        Live pressure on the closing surfaces at moving edges; None without.
    """
    motions_of_supports = {name: motions_of(loads, name) for name in supports}
    bodies = [
        RigidBody(motions_of_supports[name], support.dofs, support.edge, support.turn)
        for name, support in supports.items()
        if motions_of_supports[name]
    ]
    return PrescribedMotion(r0, bodies, edge_pressure) if bodies else None


def enclosed(loads: Loads, free_edges: Iterable[str], without_potential: Collection[str]) -> bool:
    """Return whether the shell and closing surfaces on its moving edges enclose a volume.

    Parameters
    ----------
    free_edges
        Names of the edges that may move, at which the pressed surface ends.
    without_potential
        Names of those of them at which a live pressure has no potential; with any, there is no
        volume.
    """
    if not loads.moves or without_potential:
        return False
    return all(motions_of(loads, name) for name in free_edges)


def pressed_edges(
    r0: fem.Function,
    curves: Mapping[str, EdgeCurve],
    planes: Collection[str],
    loads: Loads,
    unit: float,
    closing: NDArray[np.float64] | None,
) -> EdgePressure:
    """Return the live pressure on the closing surfaces (lids) at moving edges; collective.

    Edges that move alike share one lid, if together they are closed or end on planes of symmetry.

    Parameters
    ----------
    r0
        Undeformed placement of the nodes.
    curves
        Name -> curve, of the edges that move and of those on planes of symmetry.
    planes
        Names of the edges on planes of symmetry.
    unit
        The pressure of an amplitude of one, p_c over E h/R.
    closing
        A point (3,) of all planes of symmetry, where lids have their tip; None if they have none.
    """
    comm, x = r0.function_space.mesh.comm, r0.x.array.reshape(-1, 3)
    # the edges that move alike: equal motions have equal keys, with the bytes of their arrays
    edges_by_motion = dict[tuple[object, ...], list[str]]()
    for name in curves:
        if motions := motions_of(loads, name):
            motion_key = tuple(
                (m.name, m.shift.tobytes(), m.turn.tobytes(), m.centre.tobytes()) for m in motions
            )
            edges_by_motion.setdefault(motion_key, []).append(name)
    # the corners of cells on planes of symmetry, of all ranks
    corners_on_planes = np.concatenate(
        [np.empty(0, np.int64), *(curves[name].corners.ravel() for name in planes)]
    )
    all_corners_on_planes = np.concatenate(comm.allgather(corners_on_planes))
    lids = []
    for names in edges_by_motion.values():
        curves_of_lid = [curves[name] for name in names]
        open_corners = end_corners(curves_of_lid, comm)  # at which the edges end
        is_closed = not len(open_corners)
        ends_on_planes = closing is not None and np.isin(open_corners, all_corners_on_planes).all()
        # other edges leave a gap, which no lid closes
        if is_closed or ends_on_planes:
            origin = np.zeros(3) if closing is None else closing
            lids.append(Lid.cone(curves_of_lid, x, motions_of(loads, names[0]), origin, comm))
    moving_edges = [name for names in edges_by_motion.values() for name in names]
    return EdgePressure(PRESSURE, unit, lids, [curves[name] for name in moving_edges])

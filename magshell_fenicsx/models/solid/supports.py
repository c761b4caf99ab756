"""What holds a solid: whole faces above clamped edges and in mirror planes, else the mid-surface alone."""

from collections.abc import Mapping

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.sliding import Constraint, held_along
from magshell_fenicsx.mesh.hexahedra import MIDDLE, Body
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.models.shell.parameters import Condition, Held
from magshell_fenicsx.models.shell.supports import held_at_vertex, held_on, plane_of

ALL = (0, 1, 2)
ROUNDING = 1e-9


def supports(
    body: Body, r0: fem.Function, conditions: Mapping[str, Condition]
) -> tuple[list[Constraint], list[Mirror]]:
    """What is held, and the planes of symmetry, but for the mirror plane of a half model; collective.

    Raises
    ------
    MeshError
        On every rank, if an edge lies in no plane of symmetry.
    """
    V = r0.function_space
    middle = in_middle(body, V)
    held: list[Constraint] = []
    planes: list[Mirror] = []
    for name, condition in conditions.items():
        components = condition.components if isinstance(condition, Held) else ALL
        if condition in ("free", "symmetry"):
            continue
        nodes = None if condition == "clamped" else middle
        if condition == "plane":
            planes.append(plane := plane_of(r0, body.faces[name], name))
            held.append(held_along(V, 2, body.faces[name], plane.normal))
        elif name in body.faces:
            held += held_on(V, 2, body.faces[name], components, nodes)
        elif name in body.patches:
            held += held_on(V, 3, np.flatnonzero(body.patches[name]).astype(np.int32), components, nodes)
        else:
            held += held_at_vertex(V, body.points[name], components)
    return held, planes


def in_middle(body: Body, V: fem.FunctionSpace) -> NDArray[np.bool_]:
    """Which nodes, ghosts included, lie in the middle of the thickness."""
    return np.asarray(np.abs(body.at_nodes(V, body.heights) - MIDDLE) < ROUNDING)

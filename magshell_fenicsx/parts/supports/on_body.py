"""What holds a solid: whole faces above clamped edges and in mirror planes, else the mid-surface alone."""

from collections.abc import Mapping

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.sliding import Constraint, held_along
from magshell_fenicsx.mesh.hexahedra import MIDDLE, Body
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.models.shell.parameters import Condition, Held
from magshell_fenicsx.parts.supports.moved import Support
from magshell_fenicsx.parts.supports.supports import held_at_vertex, held_on, plane_of

ALL = (0, 1, 2)
ROUNDING = 1e-9


def supports(
    body: Body, r0: fem.Function, conditions: Mapping[str, Condition]
) -> tuple[list[Constraint], list[Mirror], dict[str, Support]]:
    """What is held, the planes of symmetry but the mirror plane of a half model, and each support; collective.

    Raises
    ------
    MeshError
        On every rank, if an edge lies in no plane of symmetry.
    """
    V = r0.function_space
    middle = in_middle(body, V)
    held: list[Constraint] = []
    planes: list[Mirror] = []
    named: dict[str, Support] = {}
    on_planes: dict[str, Support] = {}
    for name, condition in conditions.items():
        components = condition.components if isinstance(condition, Held) else ALL
        if condition in ("free", "symmetry"):
            continue
        nodes = None if condition == "clamped" else middle
        if condition == "plane":
            planes.append(plane := plane_of(r0, body.faces[name], name))
            held.append(held_along(V, 2, body.faces[name], plane.normal))
            on_planes[name] = Support.of(held_on(V, 2, body.faces[name], ALL))
            continue
        if name in body.faces:
            here = held_on(V, 2, body.faces[name], components, nodes)
        elif name in body.patches:
            here = held_on(V, 3, np.flatnonzero(body.patches[name]).astype(np.int32), components, nodes)
        else:
            here = held_at_vertex(V, body.points[name], components)
        held += here
        named[name] = Support.of(here)
    return held, planes, named | on_planes


def in_middle(body: Body, V: fem.FunctionSpace) -> NDArray[np.bool_]:
    """Which nodes, ghosts included, lie in the middle of the thickness."""
    return np.asarray(np.abs(body.at_nodes(V, body.heights) - MIDDLE) < ROUNDING)

"""What holds a solid: whole faces above clamped edges and in mirror planes, else the mid-surface alone."""

from collections.abc import Mapping

import numpy as np
from dolfinx import fem

from magshell_fenicsx.mesh.hexahedra import MIDDLE, Body
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell.parameters import Condition, Held
from magshell_fenicsx.models.shell.supports import STRAIGHT, held_at_vertex, held_on, open_to_pressure, plane_of

ALL = (0, 1, 2)
ROUNDING = 1e-9


def supports(
    body: Body, r0: fem.Function, conditions: Mapping[str, Condition], *, pressed: bool
) -> list[fem.DirichletBC]:
    """All but the mirror plane of a half model; collective.

    Raises
    ------
    MeshError
        On every rank, if an edge lies in no plane of symmetry, or in one that is open to a live pressure.
    """
    V = r0.function_space
    in_middle = np.abs(body.at_nodes(V, body.heights) - MIDDLE) < ROUNDING
    found = []
    for name, condition in conditions.items():
        components = condition.components if isinstance(condition, Held) else ALL
        if condition in ("free", "symmetry"):
            continue
        if condition == "plane":
            axis, place = plane_of(V, r0, body.faces[name], name)
            if pressed and abs(place) > STRAIGHT:
                raise MeshError(open_to_pressure(name))
            components = (axis,)
        if name in body.faces or name in body.patches:
            where = (
                (2, body.faces[name])
                if name in body.faces
                else (3, np.flatnonzero(body.patches[name]).astype(np.int32))
            )
            whole = condition in ("clamped", "plane")
            found += held_on(V, *where, components, None if whole else in_middle)
        else:
            found += held_at_vertex(V, body.points[name], components)
    return found

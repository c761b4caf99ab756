"""What a problem asks of its surface, against what the surface has: its edges, points and patches."""

from collections.abc import Collection, Mapping

import numpy as np

from magshell_fenicsx.mesh.patch import MeshError, PatchMesh
from magshell_fenicsx.models.shell.parameters import Condition, Held, Loads
from magshell_fenicsx.models.shell.thickness import Thickness, patch_of
from magshell_fenicsx.parts.pressure.openings import moving, without_potential
from magshell_fenicsx.parts.registered import SEEN
from magshell_fenicsx.parts.supports.supports import refuse_unknown


def refuse_unfit(
    patch: PatchMesh, conditions: Mapping[str, Condition], loads: Loads, thickness: Thickness | None
) -> None:
    """See that every name is there.

    Raises
    ------
    MeshError
        With the name.
    """
    refuse_unknown(patch.edges, patch.points, patch.patches, conditions, loads)
    _refuse_ambiguous(patch.edges, patch.points, conditions)
    for room in SEEN:
        room.refuse_unfit(loads, patch)
    for name in (thickness and thickness.patches) or {}:
        patch_of(patch.patches, name, "shell.thickness_factor")


def refuse_unfit_ends(
    ends: Collection[str], points: Collection[str], conditions: Mapping[str, Condition], loads: Loads
) -> None:
    """The same of a meridian, which has ends and points.

    Raises
    ------
    MeshError
        With the name.
    """
    refuse_unknown(ends, points, [], conditions, loads)
    _refuse_ambiguous(ends, points, conditions)


def _refuse_ambiguous(edges: Collection[str], points: Collection[str], conditions: Mapping[str, Condition]) -> None:
    for name, condition in conditions.items():
        if isinstance(condition, Held) and name in edges and name in points:
            raise MeshError(f"boundary.{name}: is an edge and a point; give the point another name")


def open_edges(patch: PatchMesh, conditions: Mapping[str, Condition]) -> tuple[str, ...]:
    """The edges at which a live pressure has no potential."""
    sides = {name: {(int(a), int(b)) for a, b in np.sort(edge, axis=1)} for name, edge in patch.edges.items()}
    return without_potential(
        moving(sides, conditions), conditions, lambda name: patch.embedding(patch.nodes[np.unique(patch.edges[name])])
    )

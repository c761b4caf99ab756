"""What a plan asks of its surface, against what the surface has: its edges, points and patches."""

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import MeshError, PatchMesh
from magshell_fenicsx.models.shell.parameters import AreaForce, Condition, Held, Loads
from magshell_fenicsx.models.shell.patterns import by_patch
from magshell_fenicsx.models.shell.supports import open_to_pressure, refuse_unknown
from magshell_fenicsx.models.shell.thickness import Thickness, patch_of


def refuse_unfit(
    patch: PatchMesh, conditions: Mapping[str, Condition], loads: Loads, thickness: Thickness | None
) -> None:
    """See that every name is there, and that no edge is open to a live pressure.

    Raises
    ------
    MeshError
        With the name.
    """
    refuse_unknown(patch.edges, patch.points, patch.patches, conditions, loads)
    _refuse_ambiguous(patch.edges, patch.points, conditions)
    if loads.magnetic and loads.magnetic.patches:
        by_patch(loads.magnetic.patches, patch.patches, len(patch.cells))
    for name in (thickness and thickness.patches) or {}:
        patch_of(patch.patches, name)
    for load in loads.all_dead:
        if isinstance(load, AreaForce) and load.patch is not None:
            patch_of(patch.patches, load.patch)
    if loads.pressure:
        _refuse_open(patch, conditions)


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
    for name in ends if loads.pressure else ():
        if not _closes(conditions.get(name, "free")):
            raise MeshError(open_to_pressure(name))


def _refuse_ambiguous(edges: Collection[str], points: Collection[str], conditions: Mapping[str, Condition]) -> None:
    for name, condition in conditions.items():
        if isinstance(condition, Held) and name in edges and name in points:
            raise MeshError(f"boundary.{name}: is an edge and a point; give the point another name")


def _refuse_open(patch: PatchMesh, conditions: Mapping[str, Condition]) -> None:
    """p int x.n/3 is the work of a live pressure only up to (p/3) of the line integral of dx.(x cross t) on its edges.

    It vanishes where the edge cannot move, or stays in a plane through the origin; where a plane of the user's
    is, the model sees.
    """
    pairs = {name: _pairs(edge) for name, edge in patch.edges.items()}
    closed = set().union(*(pairs[name] for name, c in conditions.items() if name in pairs and _closes(c)))
    for name, edge in pairs.items():
        if edge - closed:
            raise MeshError(open_to_pressure(name))


def _pairs(edge: NDArray[np.int64]) -> set[tuple[int, int]]:
    return {(int(a), int(b)) for a, b in np.sort(edge, axis=1)}


def _closes(condition: Condition) -> bool:
    if isinstance(condition, Held):
        return len(condition.components) == 3
    return condition != "free"

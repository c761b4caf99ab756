"""What a triangulation from outside must be to carry a shell; every refusal names a place."""

from collections.abc import Mapping

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import MeshError

Array = NDArray[np.float64]
Cells = NDArray[np.int64]
TURNED = {3: [0, 2, 1], 6: [0, 2, 1, 5, 4, 3], 10: [0, 2, 1, 8, 7, 6, 5, 4, 3, 9]}  # the other way round, gmsh's order
SAME_PLACE = 1e-9  # of the extent


def said_place(x: Array) -> str:
    return f"({x[0]:.4g}, {x[1]:.4g}, {x[2]:.4g})"


def _directed(cells: Cells) -> Cells:
    """(3 m, 2) edges as the triangles run through them: first edges of all, then second, then third."""
    return np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]])


def oriented(nodes: Array, cells: Cells) -> Cells:
    """The triangles (m, 3 | 6 | 10) with one side, that of the larger area, up; lengths in places are over R.

    Raises
    ------
    MeshError
        If a triangle has no area, an edge more than two triangles, the surface only one side or several pieces.
    """
    a, b, c = (nodes[cells[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    flat = np.flatnonzero(areas <= 1e-12 * np.linalg.norm(b - a, axis=1) ** 2)
    if len(flat):
        raise MeshError(f"the triangle at {said_place(a[flat[0]])} has no area")
    edges = _directed(cells)
    pairs, which, times = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    if (times > 2).any():
        crowded = nodes[pairs[times > 2][0]].mean(axis=0)
        raise MeshError(f"more than two triangles meet at the edge around {said_place(crowded)}")
    order = np.argsort(which.ravel(), kind="stable")
    first = np.cumsum(times)[times == 2] - 2
    one, other = order[first], order[first + 1]
    agree = edges[one, 0] != edges[other, 0]  # neighbours run through their edge in opposite directions
    m = len(cells)
    left, right = one % m, other % m
    # every triangle twice, either way round: a surface with two sides is two separate copies
    rows = np.concatenate([left, left + m])
    columns = np.concatenate([np.where(agree, right, right + m), np.where(agree, right + m, right)])
    graph = scipy.sparse.coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * m, 2 * m))
    _, copy = scipy.sparse.csgraph.connected_components(graph, directed=False)
    if (copy[:m] == copy[m:]).any():
        place = nodes[edges[one[~agree][0]]].mean(axis=0)
        raise MeshError(
            f"the surface has only one side: its normals cannot agree across the edge around {said_place(place)}"
        )
    as_first = copy[:m] == copy[0]
    elsewhere = np.flatnonzero(~as_first & (copy[m:] != copy[0]))
    if len(elsewhere):
        raise MeshError(_torn(nodes, cells, int(elsewhere[0])))
    if areas[~as_first].sum() > areas[as_first].sum():
        as_first = ~as_first
    return np.where(as_first[:, None], cells, cells[:, TURNED[cells.shape[1]]])


def _torn(nodes: Array, cells: Cells, apart: int) -> str:
    place = nodes[cells[apart, 0]]
    vertices = np.unique(cells[:, :3])
    near = scipy.spatial.cKDTree(nodes[vertices]).query_pairs(
        SAME_PLACE * np.ptp(nodes, axis=0).max(), output_type="ndarray"
    )
    if len(near):
        place = nodes[vertices[near[0, 0]]]
        return f"the surface is torn: there are two nodes at {said_place(place)}, and its parts are not connected"
    return f"the surface is in several pieces; one is at {said_place(place)}"


def border_edges(nodes: Array, cells: Cells, named: Mapping[str, Cells]) -> dict[str, Cells]:
    """The named curves (e, 2) as far as the surface ends there, all of whose ends must have a name.

    Raises
    ------
    MeshError
        Where the surface ends without a name (a hole, or nodes that are there twice), or touches
        itself in a vertex.
    """
    edges = np.sort(_directed(cells), axis=1)
    pairs, times = np.unique(edges, axis=0, return_counts=True)
    border = pairs[times == 1]
    known = {(int(a), int(b)) for lines in named.values() for a, b in np.sort(lines, axis=1)}
    unnamed = [(int(a), int(b)) for a, b in border if (int(a), int(b)) not in known]
    if unnamed:
        place = nodes[list(unnamed[0])].mean(axis=0)
        vertices = np.unique(cells[:, :3])
        extent = np.ptp(nodes[vertices], axis=0).max()
        here = nodes[unnamed[0][0]]
        twice = np.sum(np.linalg.norm(nodes[vertices] - here, axis=1) < SAME_PLACE * extent) > 1
        if twice:
            raise MeshError(f"there are two nodes at {said_place(here)}: the triangles beside it are not connected")
        raise MeshError(
            f"the surface ends at the edge around {said_place(place)}, which belongs to no physical curve: "
            "close the hole, or name the edge (an edge without a condition is free)"
        )
    ends, times = np.unique(border, return_counts=True)
    if (times > 2).any():
        raise MeshError(f"the surface touches itself in the vertex {said_place(nodes[ends[times > 2][0]])}")
    ending = {(int(a), int(b)) for a, b in border}
    kept = {
        name: lines[[(int(a), int(b)) in ending for a, b in np.sort(lines, axis=1)]] for name, lines in named.items()
    }
    return {name: lines for name, lines in kept.items() if len(lines)}

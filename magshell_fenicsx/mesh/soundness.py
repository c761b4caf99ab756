"""Whether a triangulation from a file can carry a shell; each refusal names a place."""

from collections.abc import Mapping

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import MeshError, as_set, border_pairs, directed_sides, on_border, place_text

Array = NDArray[np.float64]
Cells = NDArray[np.int64]
TURNED = {
    3: [0, 2, 1],
    6: [0, 2, 1, 5, 4, 3],
    10: [0, 2, 1, 8, 7, 6, 5, 4, 3, 9],
}  # nodes of a reversed triangle, gmsh's order
SAME_PLACE = 1e-9  # of the extent


def oriented(nodes: Array, cells: Cells) -> Cells:
    """The triangles (m, 3 | 6 | 10) in one orientation, that of the larger area.

    Raises
    ------
    MeshError
        If a triangle has no area, an edge has more than two triangles, or the surface has one side or several pieces.
    """
    a, b, c = (nodes[cells[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    flat = np.flatnonzero(areas <= 1e-12 * np.linalg.norm(b - a, axis=1) ** 2)
    if len(flat):
        raise MeshError(f"the triangle at {place_text(a[flat[0]])} has no area")
    edges = directed_sides(cells)
    pairs, which, times = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    if (times > 2).any():
        crowded = nodes[pairs[times > 2][0]].mean(axis=0)
        raise MeshError(f"more than two triangles meet at the edge around {place_text(crowded)}")
    order = np.argsort(which.ravel(), kind="stable")
    first = np.cumsum(times)[times == 2] - 2
    one, other = order[first], order[first + 1]
    agree = edges[one, 0] != edges[other, 0]  # neighbours run through their edge in opposite directions
    m = len(cells)
    left, right = one % m, other % m
    # each triangle counts twice, once in each orientation: an orientable surface then has two separate copies
    rows = np.concatenate([left, left + m])
    columns = np.concatenate([np.where(agree, right, right + m), np.where(agree, right + m, right)])
    graph = scipy.sparse.coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * m, 2 * m))
    _, copy = scipy.sparse.csgraph.connected_components(graph, directed=False)
    if (copy[:m] == copy[m:]).any():
        place = nodes[edges[one[~agree][0]]].mean(axis=0)
        raise MeshError(
            f"the surface has only one side: its normals cannot agree across the edge around {place_text(place)}"
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
        return f"the surface is torn: there are two nodes at {place_text(place)}, and its parts are not connected"
    return f"the surface is in several pieces; one is at {place_text(place)}"


def border_edges(nodes: Array, cells: Cells, named: Mapping[str, Cells]) -> dict[str, Cells]:
    """The part of each named curve (e, 2) that is a border of the surface; every border edge needs a name.

    Raises
    ------
    MeshError
        If a border edge has no name (a hole, or a node that stands twice in the file), or if the surface touches
        itself in a vertex.
    """
    border = border_pairs(directed_sides(cells))
    known = {pair for lines in named.values() for pair in as_set(lines)}
    unnamed = [(int(a), int(b)) for a, b in border if (int(a), int(b)) not in known]
    if unnamed:
        place = nodes[list(unnamed[0])].mean(axis=0)
        vertices = np.unique(cells[:, :3])
        extent = np.ptp(nodes[vertices], axis=0).max()
        here = nodes[unnamed[0][0]]
        twice = np.sum(np.linalg.norm(nodes[vertices] - here, axis=1) < SAME_PLACE * extent) > 1
        if twice:
            raise MeshError(f"there are two nodes at {place_text(here)}: the triangles beside it are not connected")
        raise MeshError(
            f"the surface ends at the edge around {place_text(place)}, which belongs to no physical curve: "
            "close the hole, or name the edge (an edge without a condition is free)"
        )
    ends, times = np.unique(border, return_counts=True)
    if (times > 2).any():
        raise MeshError(f"the surface touches itself in the vertex {place_text(nodes[ends[times > 2][0]])}")
    return on_border(named, border)

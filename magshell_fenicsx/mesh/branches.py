"""Surfaces whose edges have three and more triangles: sheets that are joined by T-junctions.

Of the triangles at such an edge the two that are nearest to one plane go on; each other one ends there, with nodes of
its own, and stands on these two.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from magshell_fenicsx.mesh.patch import border_pairs, directed_sides

Array = NDArray[np.float64]
Cells = NDArray[np.int64]
NAME = "junction"


@dataclass(frozen=True)
class Foot:
    """The edge of a sheet that stands on another one.

    Attributes
    ----------
    pairs
        (e, 2) its vertices.
    on
        (m,) whether each triangle is one of those that go on there.
    """

    pairs: Cells
    on: NDArray[np.bool_]


def separated(nodes: Array, cells: Cells) -> tuple[Cells, Cells, dict[str, Foot]]:
    """Triangles (m, 3 | 6 | 10) of which an edge has two at most.

    Returns
    -------
    origin
        (n,) for each node, of which new ones stand after all others, the one from which it was taken, or itself.
    cells
        With new nodes.
    feet
        What was taken apart.
    """
    m = len(cells)
    pairs, which, times = np.unique(
        np.sort(directed_sides(cells), axis=1), axis=0, return_inverse=True, return_counts=True
    )
    if (times <= 2).all():
        return np.arange(len(nodes)), cells, {}
    order = np.argsort(which.ravel(), kind="stable")
    firsts = np.concatenate([[0], np.cumsum(times)])
    on = dict[int, tuple[int, int]]()
    joined, ending = list[tuple[int, int]](), list[tuple[int, int]]()  # triangles; edges and triangles
    for edge in np.flatnonzero(times > 1):
        around = [int(side) % m for side in order[firsts[edge] : firsts[edge + 1]]]
        if len(around) == 2:
            joined.append((around[0], around[1]))
            continue
        away = {cell: _away(nodes, pairs[edge], cells[cell, :3]) for cell in around}
        best = min(combinations(around, 2), key=lambda both: round(float(away[both[0]] @ away[both[1]]), 9))
        joined.append(best)
        on[int(edge)] = best
        ending += [(int(edge), cell) for cell in around if cell not in best]
    cells, apart = _with_own_nodes(len(nodes), cells, joined, np.unique(pairs[times > 2]))
    sheets, origin = _sheets(m, joined), np.append(np.arange(len(nodes)), apart)
    feet = dict[str, Foot]()
    for sheet in dict.fromkeys(sheets[cell] for _, cell in ending):
        of = [(edge, cell) for edge, cell in ending if sheets[cell] == sheet]
        own, beside = list[list[int]](), np.zeros(m, dtype=bool)
        for edge, cell in of:
            own.append([int(c) for c in cells[cell, :3] if origin[c] in pairs[edge]])
            beside[list(on[edge])] = True
        feet[NAME if not feet else f"{NAME}_{len(feet) + 1}"] = Foot(np.array(own), beside)
    return origin, cells, feet


def _away(nodes: Array, edge: Cells, corners: Cells) -> Array:
    """The unit vector in a triangle, away from its edge."""
    a, b = nodes[edge]
    (third,) = (corner for corner in corners if corner not in edge)
    along = (b - a) / np.linalg.norm(b - a)
    off = nodes[third] - a
    off = off - off @ along * along
    return np.asarray(off / np.linalg.norm(off))


def _sheets(count: int, joined: list[tuple[int, int]]) -> NDArray[np.int32]:
    """The sheet of each triangle."""
    one, other = np.array(joined, dtype=np.int64).reshape(-1, 2).T
    graph = scipy.sparse.coo_array((np.ones(len(one)), (one, other)), (count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def _with_own_nodes(
    total: int, cells: Cells, joined: list[tuple[int, int]], vertices: Cells
) -> tuple[Cells, list[int]]:
    """Triangles that share nodes with those that they are joined to, and of which nodes new ones are copies.

    The nodes are looked at that are, or lie between, these vertices.
    """
    cells, apart = np.array(cells), list[int]()
    touched = np.isin(cells[:, :3], vertices).any(axis=1)
    of_node = dict[int, list[int]]()
    for cell in np.flatnonzero(touched):
        for node in cells[cell]:
            of_node.setdefault(int(node), []).append(int(cell))
    beside = dict[int, set[int]]()
    for one, other in joined:
        beside.setdefault(one, set()).add(other)
        beside.setdefault(other, set()).add(one)
    for node, around in of_node.items():
        if node not in vertices and node in cells[:, :3]:
            continue
        left = set(around)
        first = True
        while left:
            group, ahead = set[int](), [min(left)]
            while ahead:
                cell = ahead.pop()
                if cell in left:
                    left.discard(cell)
                    group.add(cell)
                    ahead += [c for c in beside.get(cell, ()) if c in left]
            if not first:
                for cell in group:
                    cells[cell][cells[cell] == node] = total + len(apart)
                apart.append(node)
            first = False
    return cells, apart


def renamed(edges: Mapping[str, Cells], cells: Cells, origin: Cells) -> dict[str, Cells]:
    """Named curves (e, 2) with the border's new nodes."""
    border = border_pairs(directed_sides(cells))
    of = dict[tuple[int, ...], list[Cells]]()
    for pair in border:
        of.setdefault(tuple(sorted(int(origin[node]) for node in pair)), []).append(pair)
    return {
        name: np.array([new for pair in pairs for new in of.get(tuple(sorted(map(int, pair))), [pair])])
        for name, pairs in edges.items()
    }

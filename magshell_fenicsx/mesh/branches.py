"""Surfaces whose edges have three and more triangles: sheets that are joined by T-junctions.

Of the triangles at such an edge the two that are nearest to one plane go on; each other one ends
there, with nodes of its own, and stands on these two.
"""

from collections.abc import Iterable, Iterator, Mapping
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
    """The triangles (m, 3 | 6 | 10) of a surface, taken apart until each edge has two at most.

    Returns
    -------
    origin
        (n,) the old node at the place of each node; the new ones stand after the old ones, which
        are their own.
    cells
        With new nodes.
    feet
        Name of an edge that was taken apart -> the sides of its sheet, and on what they stand.
    """
    m = len(cells)
    pairs, which, times = np.unique(
        np.sort(directed_sides(cells), axis=1), axis=0, return_inverse=True, return_counts=True
    )
    if (times <= 2).all():
        return np.arange(len(nodes)), cells, {}
    by_edge = np.argsort(which.ravel(), kind="stable")
    firsts = np.concatenate([[0], np.cumsum(times)])
    going_on = dict[int, tuple[int, int]]()  # edge -> triangles
    joined, ending = (
        list[tuple[int, int]](),
        list[tuple[int, int]](),
    )  # triangles; edges and triangles
    for edge in np.flatnonzero(times > 1):
        around = [int(side) % m for side in by_edge[firsts[edge] : firsts[edge + 1]]]
        if len(around) == 2:
            joined.append((around[0], around[1]))
            continue
        away = {cell: _away(nodes, pairs[edge], cells[cell, :3]) for cell in around}
        flattest = min(
            combinations(around, 2), key=lambda two: round(float(away[two[0]] @ away[two[1]]), 9)
        )
        joined.append(flattest)
        going_on[int(edge)] = flattest
        ending += [(int(edge), cell) for cell in around if cell not in flattest]
    cells, copied = _with_own_nodes(len(nodes), cells, joined, np.unique(pairs[times > 2]))
    sheets, origin = _sheets(m, joined), np.append(np.arange(len(nodes)), copied)
    feet = dict[str, Foot]()
    for sheet in dict.fromkeys(sheets[cell] for _, cell in ending):
        sides, on = list[list[int]](), np.zeros(m, dtype=bool)
        for edge, cell in ending:
            if sheets[cell] == sheet:
                sides.append(
                    [int(corner) for corner in cells[cell, :3] if origin[corner] in pairs[edge]]
                )
                on[list(going_on[edge])] = True
        feet[NAME if not feet else f"{NAME}_{len(feet) + 1}"] = Foot(np.array(sides), on)
    return origin, cells, feet


def _away(nodes: Array, edge: Cells, corners: Cells) -> Array:
    """The unit vector (3,) in a triangle, normal to its edge and away from it."""
    a, b = nodes[edge]
    (third,) = (corner for corner in corners if corner not in edge)
    along = (b - a) / np.linalg.norm(b - a)
    off = nodes[third] - a
    away = off - off @ along * along
    return np.asarray(away / np.linalg.norm(away))


def _sheets(count: int, joined: list[tuple[int, int]]) -> NDArray[np.int32]:
    """(count,) the number of the sheet of each triangle, from pairs that go on in each other."""
    one, other = np.array(joined, dtype=np.int64).reshape(-1, 2).T
    graph = scipy.sparse.coo_array((np.ones(len(one)), (one, other)), (count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def _with_own_nodes(
    total: int, cells: Cells, joined: list[tuple[int, int]], vertices: Cells
) -> tuple[Cells, list[int]]:
    """Triangles that share nodes with those alone that they are joined to.

    Returns
    -------
    cells
        With new nodes, whose numbers begin at `total`, in place of some of these vertices and of
        nodes between them.
    copied
        The old node of each new one.
    """
    cells, copied = np.array(cells), list[int]()
    touched = np.isin(cells[:, :3], vertices).any(axis=1)
    cells_of_node = dict[int, list[int]]()
    for cell in np.flatnonzero(touched):
        for node in cells[cell]:
            cells_of_node.setdefault(int(node), []).append(int(cell))
    neighbours = dict[int, set[int]]()
    for one, other in joined:
        neighbours.setdefault(one, set()).add(other)
        neighbours.setdefault(other, set()).add(one)
    for node, around in cells_of_node.items():
        if node not in vertices and node in cells[:, :3]:
            continue
        for later, group in enumerate(_groups(around, neighbours)):
            if later:  # the first group keeps the node
                for cell in group:
                    cells[cell][cells[cell] == node] = total + len(copied)
                copied.append(node)
    return cells, copied


def _groups(cells: Iterable[int], neighbours: Mapping[int, set[int]]) -> Iterator[set[int]]:
    """The cells in groups that are connected by neighbours among them."""
    left = set(cells)
    while left:
        group, ahead = set[int](), [min(left)]
        while ahead:
            cell = ahead.pop()
            if cell in left:
                left.discard(cell)
                group.add(cell)
                ahead += [other for other in neighbours.get(cell, ()) if other in left]
        yield group


def renamed(edges: Mapping[str, Cells], cells: Cells, origin: Cells) -> dict[str, Cells]:
    """Named curves (e, 2), whose sides on the border have its new nodes."""
    border = border_pairs(directed_sides(cells))
    new_sides = dict[tuple[int, ...], list[Cells]]()
    for side in border:
        new_sides.setdefault(tuple(sorted(int(origin[node]) for node in side)), []).append(side)
    return {
        name: np.array(
            [new for side in pairs for new in new_sides.get(tuple(sorted(map(int, side))), [side])]
        )
        for name, pairs in edges.items()
    }

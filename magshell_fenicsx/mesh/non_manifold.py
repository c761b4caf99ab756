"""Non-manifold edges of a mesh file: an edge with three and more triangles is a T-junction.

Of the triangles at such an edge the two that are nearest to one plane are one sheet; each other one
ends there, with nodes of its own, and is tied to these two by the model. A sheet is a set of
triangles that are connected through ordinary edges. Edges and sides are given by pairs of vertices;
cells have 3, 6 or 10 nodes in gmsh's order, vertices first.
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
JUNCTION_NAME = "junction"  # of the first T-junction of a mesh; further ones have a number
COSINE_DIGITS = 9  # decimals of the cosine between triangles: differences below are rounding


@dataclass(frozen=True)
class TJunction:
    """The edge of a sheet that ends on another one.

    Attributes
    ----------
    pairs
        (e, 2) vertices of the edge.
    supports
        (m,) whether each triangle is one of those that the sheet ends on.
    """

    pairs: Cells
    supports: NDArray[np.bool_]


def separate_sheets(nodes: Array, cells: Cells) -> tuple[Cells, Cells, dict[str, TJunction]]:
    """Take a triangulation (m, 3 | 6 | 10) apart until each edge has two triangles at most.

    At an edge with more triangles the two nearest to one plane stay together. The sheets of all
    others end there.

    Parameters
    ----------
    nodes, cells
        (n, 3) places, and node numbers.

    Returns
    -------
    origin
        For each node the old node at its place. New nodes stand after the old ones.
    cells
        Triangles with new nodes.
    t_junctions
        Name -> an edge at which a sheet was taken off.
    """
    m = len(cells)
    # vertices of each edge, the edge of each side of a triangle, and the triangles of each edge
    pairs, edge_of_side, triangle_counts = np.unique(
        np.sort(directed_sides(cells), axis=1), axis=0, return_inverse=True, return_counts=True
    )
    if (triangle_counts <= 2).all():
        return np.arange(len(nodes)), cells, {}
    # sides sorted by edge, and where those of each edge begin
    sides_by_edge = np.argsort(edge_of_side.ravel(), kind="stable")
    first_of_edge = np.concatenate([[0], np.cumsum(triangle_counts)])
    supporting_cells = dict[int, tuple[int, int]]()  # by edge
    neighbours = list[tuple[int, int]]()  # pairs of triangles of one sheet
    ending_cells = list[tuple[int, int]]()  # edges, and triangles whose sheet ends there
    for edge in np.flatnonzero(triangle_counts > 1):
        sides = sides_by_edge[first_of_edge[edge] : first_of_edge[edge + 1]]
        # side n is one of triangle n % m: all first sides come first, then second, then third ones
        cells_at_edge = [int(side) % m for side in sides]
        if len(cells_at_edge) == 2:
            neighbours.append((cells_at_edge[0], cells_at_edge[1]))
            continue
        flattest = _flattest_pair(nodes, cells, pairs[edge], cells_at_edge)
        neighbours.append(flattest)
        supporting_cells[int(edge)] = flattest
        ending_cells += [(int(edge), cell) for cell in cells_at_edge if cell not in flattest]
    # triangles of different sheets get different nodes at the T-junctions
    vertices = np.unique(pairs[triangle_counts > 2])  # of T-junctions
    cells, copied_nodes = _with_own_nodes(len(nodes), cells, neighbours, vertices)
    origin = np.append(np.arange(len(nodes)), copied_nodes)
    # each sheet that ends somewhere is one T-junction
    sheets = _sheet_numbers(m, neighbours)
    t_junctions = dict[str, TJunction]()
    for sheet in dict.fromkeys(sheets[cell] for _, cell in ending_cells):
        ends_of_sheet = [(edge, cell) for edge, cell in ending_cells if sheets[cell] == sheet]
        end_pairs, supports = list[list[int]](), np.zeros(m, dtype=bool)
        for edge, cell in ends_of_sheet:
            end_pairs.append(_side_at_edge(cells[cell], pairs[edge], origin))
            supports[list(supporting_cells[edge])] = True
        suffix = f"_{len(t_junctions) + 1}" if t_junctions else ""  # the first one has no number
        t_junctions[JUNCTION_NAME + suffix] = TJunction(np.array(end_pairs), supports)
    return origin, cells, t_junctions


def _side_at_edge(cell: Cells, edge: Cells, origin: Cells) -> list[int]:
    """Return the two vertices of a triangle at an edge, as new nodes.

    Parameters
    ----------
    cell
        (3 | 6 | 10,) new nodes of the triangle.
    edge
        (2,) old vertices of the edge.
    origin
        The old node of each new one.
    """
    corners = [int(corner) for corner in cell[:3]]
    return [corner for corner in corners if origin[corner] in edge]


def _flattest_pair(
    nodes: Array, cells: Cells, edge: Cells, cells_at_edge: list[int]
) -> tuple[int, int]:
    """Return the two triangles at an edge, of three or more, that are nearest to one plane.

    Parameters
    ----------
    edge
        (2,) vertices of the edge.
    cells_at_edge
        Numbers of the triangles there.
    """
    conormals = {cell: _conormal(nodes, edge, cells[cell, :3]) for cell in cells_at_edge}

    def cosine(two_cells: tuple[int, int]) -> float:
        """Return the cosine between two triangles at the edge; -1 if they lie in one plane."""
        first, second = two_cells
        return round(float(conormals[first] @ conormals[second]), COSINE_DIGITS)

    return min(combinations(cells_at_edge, 2), key=cosine)


def _conormal(nodes: Array, edge: Cells, corners: Cells) -> Array:
    """Return the unit vector (3,) in a triangle, normal to its edge and away from it."""
    a, b = nodes[edge]
    (apex,) = (corner for corner in corners if corner not in edge)
    tangent = (b - a) / np.linalg.norm(b - a)
    offset = nodes[apex] - a
    normal_part = offset - offset @ tangent * tangent
    return np.asarray(normal_part / np.linalg.norm(normal_part))


def _sheet_numbers(count: int, neighbours: list[tuple[int, int]]) -> NDArray[np.int32]:
    """Return the number of the sheet of each triangle (count,).

    Parameters
    ----------
    neighbours
        Pairs of triangles that belong to one sheet.
    """
    first, second = np.array(neighbours, dtype=np.int64).reshape(-1, 2).T
    graph = scipy.sparse.coo_array((np.ones(len(first)), (first, second)), (count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def _with_own_nodes(
    total: int, cells: Cells, neighbours: list[tuple[int, int]], vertices: Cells
) -> tuple[Cells, list[int]]:
    """Give triangles nodes that they share with triangles of their own sheet only.

    Parameters
    ----------
    total
        Number of nodes.
    neighbours
        Pairs of triangles of one sheet.
    vertices
        Ends of the edges with more than two triangles.

    Returns
    -------
    cells
        Triangles in which copies replace some of the vertices, and nodes on sides between them. The
        numbers of new nodes begin at `total`.
    copied_nodes
        The old node of each new one.
    """
    cells, copied_nodes = np.array(cells), list[int]()
    # node -> the triangles around it that touch a junction
    is_at_junction = np.isin(cells[:, :3], vertices).any(axis=1)
    cells_of_node = dict[int, list[int]]()
    for cell in np.flatnonzero(is_at_junction):
        for node in cells[cell]:
            cells_of_node.setdefault(int(node), []).append(int(cell))
    # triangle -> its neighbours in the same sheet
    neighbours_of_cell = dict[int, set[int]]()
    for first, second in neighbours:
        neighbours_of_cell.setdefault(first, set()).add(second)
        neighbours_of_cell.setdefault(second, set()).add(first)
    for node, cells_at_node in cells_of_node.items():
        # a vertex of no junction is in one sheet; a node between two vertices may be on a junction
        is_vertex_in_one_sheet = node not in vertices and node in cells[:, :3]
        if is_vertex_in_one_sheet:
            continue
        # each group is of one sheet: the first one keeps the node, each further one gets a copy
        _, *further_groups = _connected_groups(cells_at_node, neighbours_of_cell)
        for group in further_groups:
            new_node = total + len(copied_nodes)
            for cell in group:
                cells[cell][cells[cell] == node] = new_node
            copied_nodes.append(node)
    return cells, copied_nodes


def _connected_groups(
    cells: Iterable[int], neighbours: Mapping[int, set[int]]
) -> Iterator[set[int]]:
    """Yield the cells around a node in groups that are connected without leaving these cells.

    Parameters
    ----------
    neighbours
        Cell -> all its neighbours.
    """
    remaining = set(cells)
    while remaining:
        # a group grows from one cell to its neighbours, as long as there are any; it begins at the
        # cell with the lowest number, so that the groups come in the same order in each run
        group, queue = set[int](), [min(remaining)]
        while queue:
            cell = queue.pop()
            if cell in remaining:
                remaining.discard(cell)
                group.add(cell)
                queue += [
                    neighbour for neighbour in neighbours.get(cell, ()) if neighbour in remaining
                ]
        yield group


def edges_with_new_nodes(
    edges: Mapping[str, Cells], cells: Cells, origin: Cells
) -> dict[str, Cells]:
    """Return named curves (e, 2) in the new nodes of `separate_sheets`.

    Each side of a curve becomes all border sides at the same place: several, where several sheets
    end there. A side that is on no border keeps its nodes.

    Parameters
    ----------
    edges
        Name -> (e, 2) pairs of old nodes.
    cells, origin
        Triangles, and the old node of each node; results of `separate_sheets`.
    """
    border = border_pairs(directed_sides(cells))
    # the two old nodes of a side -> all border sides there, in new nodes
    border_sides = dict[tuple[int, ...], list[Cells]]()
    for side in border:
        old_nodes = tuple(sorted(int(origin[node]) for node in side))
        border_sides.setdefault(old_nodes, []).append(side)
    new_edges = dict[str, Cells]()
    for name, pairs in edges.items():
        sides = list[Cells]()
        for side in pairs:
            sides += border_sides.get(tuple(sorted(map(int, side))), [side])
        new_edges[name] = np.array(sides)
    return new_edges

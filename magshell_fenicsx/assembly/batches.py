"""Cells and edges in batches that share their reference tables, and the matrices of cells and of
pairs of cells.

The matrices are made of Hessians at points, and multiply vectors.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.point_kernels import COMPONENTS, SKEW, Pair, Pairs
from magshell_fenicsx.assembly.shape_tables import EDGES, Table, cell_rule, edge_covector, edge_rule
from magshell_fenicsx.platform import compat

POINTS = 2048  # most points of a batch; its Hessians take a few megabytes
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Rule:
    """Quadrature points on the reference cell.

    Attributes
    ----------
    points
        (q, 2) for each side: the same points in space.
    tables
        Shape functions there, for each side.
    weights
        (q,) of the quadrature.
    """

    points: tuple[NDArray[np.float64], ...]
    tables: tuple[Table, ...]
    weights: NDArray[np.float64]


@dataclass(frozen=True)
class Batch:
    """Entities with the same rule.

    Attributes
    ----------
    cells
        (n,) local cells, for each side.
    geometry
        (n, 2 sides + 1): the covectors of the edge in the reference coordinates of each side (see
        `shape_tables.edge_covector`), and the width of the cells over it; (n, 0) for cells.
    """

    cells: tuple[NDArray[np.int32], ...]
    rule: Rule
    geometry: NDArray[np.float64]

    @property
    def size(self) -> int:
        """Number of points of all entities."""
        return len(self.cells[0]) * len(self.rule.weights)


Chosen: TypeAlias = (
    NDArray[np.bool_] | None
)  # local cells that count, None for all; an edge counts with one of them


def cell_batches(V: fem.FunctionSpace, degree: int, chosen: Chosen = None) -> list[Batch]:
    """Batches of the owned cells."""
    X, w = cell_rule(degree)
    rule = Rule((X,), (Table.tabulate(V.element.basix_element, X),), w)
    cells = np.arange(V.mesh.topology.index_map(2).size_local, dtype=np.int32)
    counted = cells if chosen is None else cells[chosen[cells]]
    return [Batch((part,), rule, np.empty((len(part), 0))) for part in _chunks(counted, len(w))]


def interior_batches(V: fem.FunctionSpace, degree: int, chosen: Chosen = None) -> list[Batch]:
    """Batches of the owned interior edges."""
    cells, edges, backwards = interior_edges(V)
    return list(
        _edge_batches(V, degree, *_counted(cells, np.column_stack([edges, backwards]), chosen))
    )


def boundary_batches(
    V: fem.FunctionSpace, degree: int, facets: NDArray[np.int32], chosen: Chosen = None
) -> list[Batch]:
    """Batches of those boundary edges that this rank owns."""
    return list(_edge_batches(V, degree, *_counted(*boundary_edges(V, facets), chosen)))


def _counted(
    cells: NDArray[np.int32], kinds: NDArray[np.int32], chosen: Chosen
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    which = slice(None) if chosen is None else chosen[cells].any(axis=1)
    return cells[which], kinds[which]


def interior_edges(
    V: fem.FunctionSpace,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.bool_]]:
    """The owned interior edges: cells (n, 2), number in each cell (n, 2), whether the cells'
    orientations differ.
    """
    topology = V.mesh.topology
    topology.create_connectivity(1, 2)
    links = topology.connectivity(1, 2)
    facets = np.flatnonzero(
        np.diff(links.offsets[: topology.index_map(1).size_local + 1]) == 2
    ).astype(np.int32)
    cells = links.array[links.offsets[facets][:, None] + np.arange(2)]
    edges = np.column_stack([_local_edges(V, facets, cells[:, side]) for side in range(2)])
    starts = [_corner(V, cells[:, side], edges[:, side]) for side in range(2)]
    return cells, edges, starts[0] != starts[1]


def boundary_edges(
    V: fem.FunctionSpace, facets: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The owned ones of some boundary edges: cells (n, 1), number in the cell (n, 1)."""
    topology = V.mesh.topology
    topology.create_connectivity(1, 2)
    links = topology.connectivity(1, 2)
    facets = facets[facets < topology.index_map(1).size_local]
    cells = links.array[links.offsets[facets]]
    return cells[:, None], _local_edges(V, facets, cells)[:, None]


def _edge_batches(
    V: fem.FunctionSpace, degree: int, cells: NDArray[np.int32], kinds: NDArray[np.int32]
) -> Iterator[Batch]:
    """Group edges by their number in the cell of each side and, with two sides, by relative
    orientation.
    """
    sides = cells.shape[1]
    for kind in np.unique(kinds, axis=0):
        backwards = (False, bool(kind[-1]))[:sides]
        rules = [
            edge_rule(degree, int(edge), back)
            for edge, back in zip(kind[:sides], backwards, strict=True)
        ]
        X, w = tuple(points for points, _ in rules), rules[0][1]
        rule = Rule(X, tuple(Table.tabulate(V.element.basix_element, x) for x in X), w)
        covectors = np.concatenate([edge_covector(int(edge)) for edge in kind[:sides]])
        for part in _chunks(np.flatnonzero((kinds == kind).all(axis=1)).astype(np.int32), len(w)):
            both = tuple(np.ascontiguousarray(side) for side in cells[part].T)
            width = edge_width(V, both, np.full(len(part), kind[0]))
            geometry = np.column_stack([np.tile(covectors, (len(part), 1)), width])
            yield Batch(both, rule, geometry)


def _chunks(entities: NDArray[np.int32], points: int) -> list[NDArray[np.int32]]:
    size = max(POINTS // points, 1)
    return [entities[i : i + size] for i in range(0, len(entities), size)]


def _local_edges(
    V: fem.FunctionSpace, facets: NDArray[np.int32], cells: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Number of each facet in its cell."""
    V.mesh.topology.create_connectivity(2, 1)
    edges = V.mesh.topology.connectivity(2, 1).array.reshape(-1, 3)[cells]
    return np.asarray(np.argmax(edges == facets[:, None], axis=1), dtype=np.int32)


def _corner(
    V: fem.FunctionSpace, cells: NDArray[np.int32], edges: NDArray[np.int32]
) -> NDArray[np.int32]:
    """The vertex at which an edge starts in a cell."""
    first = np.array(EDGES)[:, 0][edges]
    return np.asarray(compat.corner_numbers(V.mesh)[cells, first])


def edge_width(
    V: fem.FunctionSpace, cells: tuple[NDArray[np.int32], ...], edges: NDArray[np.int32]
) -> NDArray[np.float64]:
    """Flat area of the cells, averaged over the sides, over the flat length of their edge (its
    number on side 0).
    """
    corners = [V.mesh.geometry.x[compat.corner_numbers(V.mesh)[side]] for side in cells]
    areas = [
        np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1) / 2 for x in corners
    ]
    start, end = (corners[0][np.arange(len(edges)), ends] for ends in np.array(EDGES)[edges].T)
    return np.asarray(sum(areas) / len(areas) / np.linalg.norm(end - start, axis=1))


class Contraction:
    """K[ac, bd] = sum over points and parts of w D_i[a] D_j[b] H[ic, jd].

    The products of the shape functions' derivatives are the same for all entities of a rule. For a
    symmetric (skew) block they are symmetric (skew) in a, b, so only a <= b is computed.
    """

    def __init__(self, rule: Rule, pairs: Pairs) -> None:
        w, tables = rule.weights, rule.tables
        self._symmetric = [table.symmetric(w, pairs.same) for table in tables]
        self._skew = [table.skew(w, pairs.skew) for table in tables] if pairs.skew else []
        self._cross = tables[0].cross(w, tables[1], pairs.cross) if pairs.cross else None

    def same(self, blocks: "Blocks", side: int) -> Array:
        """(entities, 9, pairs a <= b) of one side: the symmetric parts, then the skew parts."""
        symmetric = self._symmetric[side]
        K = np.zeros((len(blocks.skew[side]), 9, symmetric.shape[1]))
        K[:, :6] = _product(blocks.symmetric[side], symmetric)
        if self._skew:
            K[:, 6:] = _product(blocks.skew[side], self._skew[side])
        return K

    def cross(self, blocks: "Blocks") -> Array:
        """(entities, 9, functions^2)."""
        assert self._cross is not None
        return _product(blocks.cross, self._cross)


class Blocks:
    """Hessians at the points of a batch, sorted for the contraction: (entities, components, points,
    pairs).
    """

    def __init__(self, batch: Batch, pairs: Pairs) -> None:
        entities, points = len(batch.cells[0]), len(batch.rule.weights)
        self._pairs = pairs
        self.symmetric = [np.zeros((entities, 6, points, len(pairs.same))) for _ in batch.cells]
        self.skew = [np.zeros((entities, 3, points, len(pairs.skew))) for _ in batch.cells]
        self.cross = np.zeros((entities, 9, points, len(pairs.cross)))

    def add(self, values: Array, factor: float, pairs: Pairs) -> None:
        """Add the Hessians of one term, as they come from `point_hessian`; `values` is overwritten."""
        values *= factor
        first = 0
        for target, rows, columns in self._targets(pairs):
            entities, components, points, _ = target.shape
            last = first + components * len(columns)
            part = values[:, first:last].reshape(entities, points, components, len(columns))
            target[..., _places(rows, columns)] += part.transpose(0, 2, 1, 3)
            first = last

    def _targets(self, pairs: Pairs) -> Iterator[tuple[Array, tuple[Pair, ...], tuple[Pair, ...]]]:
        """The arrays, their pairs and the pairs of a term, in the order of `point_hessian`."""
        for symmetric, skew in zip(self.symmetric, self.skew, strict=True):
            yield symmetric, self._pairs.same, pairs.same
            yield skew, self._pairs.skew, pairs.skew
        yield self.cross, self._pairs.cross, pairs.cross


def _product(H: Array, products: Array) -> Array:
    entities, components = H.shape[:2]
    return np.asarray(H.reshape(entities * components, -1) @ products).reshape(
        entities, components, -1
    )


def _places(all_pairs: tuple[Pair, ...], some: tuple[Pair, ...]) -> slice | list[int]:
    """The indices of some pairs among all, as a slice if they are contiguous."""
    places = [all_pairs.index(pair) for pair in some]
    if places and places == list(range(places[0], places[-1] + 1)):
        return slice(places[0], places[-1] + 1)
    return places


Ints = NDArray[np.int32]


def add_own(y: Array, K: Array, nodes: Ints, x: Array) -> None:
    """Add the matrices (cells, 9, pairs a <= b) of cells times x (nodes, 3) to y; see
    `BlockMatrix.add_cells`.
    """
    a, b = np.triu_indices(nodes.shape[1])
    blocks = np.empty((len(K), len(a), 3, 3))
    for number, (c, d) in enumerate(COMPONENTS):
        blocks[:, :, c, d] = blocks[:, :, d, c] = K[:, number]
    for number, (c, d) in enumerate(SKEW, len(COMPONENTS)):
        blocks[:, :, c, d] += K[:, number]
        blocks[:, :, d, c] -= K[:, number]
    np.add.at(y, nodes[:, a], np.einsum("epcd,epd->epc", blocks, x[nodes[:, b]]))
    beside = a < b
    np.add.at(
        y,
        nodes[:, b[beside]],
        np.einsum("epdc,epd->epc", blocks[:, beside], x[nodes[:, a[beside]]]),
    )


def add_coupled(y: Array, K: Array, rows: Ints, columns: Ints, x: Array) -> None:
    """Add the blocks (pairs of cells, 9, functions^2) and their transposes; see
    `BlockMatrix.add_coupling`.
    """
    n = rows.shape[1]
    blocks = K.reshape(len(K), 3, 3, n, n)
    np.add.at(y, rows, np.einsum("ecdab,ebd->eac", blocks, x[columns]))
    np.add.at(y, columns, np.einsum("ecdab,eac->ebd", blocks, x[rows]))

"""Batches of cells and of edges that share reference tables, and element matrices from Hessians.

Element matrices of cells and of pairs of cells are contractions of Hessians at points with shape
functions. They multiply vectors here, or are scattered into a sparse matrix (`scatter`). Theory:
docs/tangent.md.

W is a density, an energy per area as a function of vectors z_i at a point: a field's value and
derivatives (`shape_tables`). Its Hessian consists of (3, 3) blocks for pairs i, j of vectors,
stored as a symmetric part of six components and a skew part of three. An entity is a cell or an
edge; an edge has one or two sides, its cells. Local edges of a triangle are numbered 0 to 2.
`degree` is the degree of a quadrature.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.point_kernels import COMPONENTS, SKEW, BlockPairs, IndexPair
from magshell_fenicsx.assembly.shape_tables import (
    EDGES,
    ShapeTable,
    cell_rule,
    edge_covector,
    edge_rule,
)
from magshell_fenicsx.platform import compat

MAX_BATCH_POINTS = 2048  # in a batch, whose Hessians then take a few megabytes
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class EntityRule:
    """A quadrature on the reference cell, over a cell or over an edge with one or two sides.

    Attributes
    ----------
    points
        (q, 2) for each side: the same points in space, in the reference coordinates of its cell.
    tables
        Shape functions at these points, for each side.
    weights
        (q,) of the quadrature.
    """

    points: tuple[NDArray[np.float64], ...]
    tables: tuple[ShapeTable, ...]
    weights: NDArray[np.float64]


@dataclass(frozen=True)
class EntityBatch:
    """Cells or edges with the same rule.

    Attributes
    ----------
    cells
        (n,) for each side: local cells.
    rule
        The quadrature that all of them share.
    geometry
        (n, 2 sides): the covectors of the edge in the reference coordinates of each side (see
        `shape_tables.edge_covector`); (n, 0) for cells.
    """

    cells: tuple[NDArray[np.int32], ...]
    rule: EntityRule
    geometry: NDArray[np.float64]

    @property
    def size(self) -> int:
        """Number of the quadrature points of all entities."""
        return len(self.cells[0]) * len(self.rule.weights)


# (local cells,) which cells count, None for all; an edge counts with one of its cells.
CellMask: TypeAlias = NDArray[np.bool_] | None


def cell_batches(V: fem.FunctionSpace, degree: int, mask: CellMask = None) -> list[EntityBatch]:
    """Return batches of the owned cells of a mesh of triangles.

    Parameters
    ----------
    V
        Space of the shape functions.
    degree
        Degree of the quadrature.
    mask
        (local cells,): which cells count; None: all.
    """
    points, weights = cell_rule(degree)
    # one side; cells have no geometry of their own
    rule = EntityRule((points,), (ShapeTable.tabulate(V.element.basix_element, points),), weights)
    cells = np.arange(V.mesh.topology.index_map(2).size_local, dtype=np.int32)
    counted = cells if mask is None else cells[mask[cells]]
    chunks = _chunks(counted, len(weights))
    return [EntityBatch((chunk,), rule, np.empty((len(chunk), 0))) for chunk in chunks]


def interior_batches(V: fem.FunctionSpace, degree: int, mask: CellMask = None) -> list[EntityBatch]:
    """Return batches of the owned interior edges, with two sides.

    Edges of one batch have the same local numbers in both cells and the same relative orientation,
    so that they share the quadrature points.

    Parameters
    ----------
    mask
        (local cells,): an edge counts with one of its cells; None: all edges.
    """
    cells, edges, are_opposite = interior_edges(V)
    # edges of one kind have the same local numbers and the same relative orientation
    kinds = np.column_stack([edges, are_opposite.astype(np.int32)])
    counted_cells, counted_kinds = _masked(cells, kinds, mask)
    return list(_edge_batches(V, degree, counted_cells, counted_kinds))


def boundary_batches(
    V: fem.FunctionSpace, degree: int, facets: NDArray[np.int32], mask: CellMask = None
) -> list[EntityBatch]:
    """Return batches of some boundary edges, as far as this rank owns them.

    Parameters
    ----------
    facets
        Local numbers of the edges.
    mask
        (local cells,): an edge counts with its cell; None: all edges.
    """
    cells, edges = boundary_edges(V, facets)  # an edge's kind is its local number alone
    counted_cells, counted_kinds = _masked(cells, edges, mask)
    return list(_edge_batches(V, degree, counted_cells, counted_kinds))


def _masked(
    cells: NDArray[np.int32], kinds: NDArray[np.int32], mask: CellMask
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the cells and the kinds of those edges that have at least one counted cell.

    Parameters
    ----------
    cells, kinds
        (n, sides): the cells of each edge; (n, ...): the numbers that make edges of one kind.
    mask
        (local cells,): which cells count; None: all.
    """
    rows = slice(None) if mask is None else mask[cells].any(axis=1)
    return cells[rows], kinds[rows]


def interior_edges(
    V: fem.FunctionSpace,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.bool_]]:
    """Return the owned interior edges of a mesh of triangles.

    Returns
    -------
    tuple
        Cells (n, 2), local numbers of the edge in each cell (n, 2), and (n,) whether the cells run
        along it in opposite directions.
    """
    topology = V.mesh.topology
    topology.create_connectivity(1, 2)
    cells_of_edges = topology.connectivity(1, 2)
    # own edges with two cells
    cell_counts = np.diff(cells_of_edges.offsets[: topology.index_map(1).size_local + 1])
    facets = np.flatnonzero(cell_counts == 2).astype(np.int32)
    # the two cells of a facet follow one another in the flat array
    first_positions = cells_of_edges.offsets[facets]
    cells = cells_of_edges.array[first_positions[:, None] + np.arange(2)]
    edges = np.column_stack([_local_edges(V, facets, cells[:, side]) for side in range(2)])
    # two cells run in opposite directions if the edge starts at different vertices in them
    first_starts, second_starts = (_corner(V, cells[:, side], edges[:, side]) for side in range(2))
    return cells, edges, first_starts != second_starts


def boundary_edges(
    V: fem.FunctionSpace, facets: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the cells of some boundary edges, as far as this rank owns them.

    Parameters
    ----------
    facets
        Local numbers of the edges.

    Returns
    -------
    tuple
        Cells (n, 1), and local numbers of the edge in each cell (n, 1).
    """
    topology = V.mesh.topology
    topology.create_connectivity(1, 2)
    cells_of_edges = topology.connectivity(1, 2)
    facets = facets[facets < topology.index_map(1).size_local]
    cells = cells_of_edges.array[cells_of_edges.offsets[facets]]
    return cells[:, None], _local_edges(V, facets, cells)[:, None]


def _edge_batches(
    V: fem.FunctionSpace, degree: int, cells: NDArray[np.int32], kinds: NDArray[np.int32]
) -> Iterator[EntityBatch]:
    """Iterate over batches of edges, each of one kind: all its edges share the quadrature points.

    Parameters
    ----------
    degree
        Degree of the quadrature.
    cells
        (n, sides): the cells of each edge.
    kinds
        (n, ...): local numbers of the edge in the cell of each side and, with two sides, whether
        the cells run along it in opposite directions.
    """
    sides = cells.shape[1]
    for kind in np.unique(kinds, axis=0):
        # what all edges of this kind share
        edge_numbers = [int(edge) for edge in kind[:sides]]
        rule = _edge_quadrature(V, degree, edge_numbers, opposite=bool(kind[-1]))
        covectors = np.concatenate([edge_covector(number) for number in edge_numbers])
        edges = np.flatnonzero((kinds == kind).all(axis=1)).astype(np.int32)
        for chunk in _chunks(edges, len(rule.weights)):
            cells_of_sides = tuple(np.ascontiguousarray(side) for side in cells[chunk].T)
            yield EntityBatch(cells_of_sides, rule, np.tile(covectors, (len(chunk), 1)))


def _edge_quadrature(
    V: fem.FunctionSpace, degree: int, edge_numbers: list[int], *, opposite: bool
) -> EntityRule:
    """Return a quadrature over an edge, with the shape functions of the cell on each side.

    Parameters
    ----------
    edge_numbers
        Local number of the edge in the cell of each side.
    opposite
        Whether the two cells run along the edge in opposite directions; ignored with one side. Then
        the points on the second side run backwards, and are the same points in space.
    """
    reversed_sides = (False, opposite)[: len(edge_numbers)]
    points_and_weights = [
        edge_rule(degree, number, is_reversed)
        for number, is_reversed in zip(edge_numbers, reversed_sides, strict=True)
    ]
    points_of_sides = tuple(points for points, _ in points_and_weights)
    _, weights = points_and_weights[0]  # all sides have the same ones
    tables = tuple(ShapeTable.tabulate(V.element.basix_element, x) for x in points_of_sides)
    return EntityRule(points_of_sides, tables, weights)


def _chunks(entities: NDArray[np.int32], points: int) -> list[NDArray[np.int32]]:
    """Split entities into parts whose points are at most `MAX_BATCH_POINTS`, or one entity.

    Parameters
    ----------
    points
        Number of quadrature points of each entity.
    """
    size = max(MAX_BATCH_POINTS // points, 1)
    return [entities[i : i + size] for i in range(0, len(entities), size)]


def _local_edges(
    V: fem.FunctionSpace, facets: NDArray[np.int32], cells: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Return the local number 0 to 2 of each facet in its cell, (n,)."""
    V.mesh.topology.create_connectivity(2, 1)
    edges = V.mesh.topology.connectivity(2, 1).array.reshape(-1, 3)[cells]
    return np.asarray(np.argmax(edges == facets[:, None], axis=1), dtype=np.int32)


def _corner(
    V: fem.FunctionSpace, cells: NDArray[np.int32], edges: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Return the vertex at which each edge starts in its cell.

    Parameters
    ----------
    cells, edges
        (n,): cells, and local numbers of the edges in them.
    """
    first_corners = np.array(EDGES)[:, 0][edges]
    return np.asarray(compat.geometry_dofs(V.mesh)[cells, first_corners])


class Contraction:
    """The contraction K[ac, bd] = sum over points and pairs i, j of w D_i[a] D_j[b] H[ic, jd].

    w are the weights. D_i are the derivatives of the shape functions, in the order of the vectors
    z_i, H the Hessians at points; a and b count functions, c and d components. Products of two D
    are the same for all entities of a rule. For a symmetric (skew) block they are symmetric (skew)
    in a, b, so only a <= b is computed. The private fields `_symmetric` and `_skew` have these
    products for each side, and `_cross` between the sides, as arrays (points * pairs, functions).

    Parameters
    ----------
    rule
        The quadrature with its shape functions.
    pairs
        The pairs i, j of derivatives that occur.
    """

    def __init__(self, rule: EntityRule, pairs: BlockPairs) -> None:
        w, tables = rule.weights, rule.tables
        self._symmetric = [table.symmetric(w, pairs.within_side) for table in tables]
        self._skew = [table.skew(w, pairs.skew) for table in tables] if pairs.skew else []
        self._cross = tables[0].cross(w, tables[1], pairs.cross) if pairs.cross else None

    def within_side(self, blocks: "HessianBlocks", side: int) -> Array:
        """Return the element matrices of the cells on one side.

        Parameters
        ----------
        blocks
            The Hessians at the points of a batch.
        side
            Number of the side, 0 or 1.

        Returns
        -------
        Array
            (entities, 9, pairs a <= b): six symmetric components, then three skew ones.
        """
        symmetric = self._symmetric[side]
        # (entities, components, pairs of functions)
        K = np.zeros((len(blocks.skew[side]), 9, symmetric.shape[1]))
        K[:, :6] = _product(blocks.symmetric[side], symmetric)
        if self._skew:
            K[:, 6:] = _product(blocks.skew[side], self._skew[side])
        return K

    def cross(self, blocks: "HessianBlocks") -> Array:
        """Return the blocks (entities, 9, functions^2) that couple the two sides."""
        assert self._cross is not None
        return _product(blocks.cross, self._cross)


class HessianBlocks:
    """Hessians at the points of a batch, ordered for the contraction.

    Parameters
    ----------
    pairs
        The pairs of vectors whose blocks the terms have, all together; kept as `_pairs`.

    Attributes
    ----------
    symmetric, skew
        (entities, 6 or 3 components, points, pairs) for each side.
    cross
        (entities, 9, points, pairs).
    """

    def __init__(self, batch: EntityBatch, pairs: BlockPairs) -> None:
        entities, points = len(batch.cells[0]), len(batch.rule.weights)
        self._pairs = pairs
        self.symmetric = [
            np.zeros((entities, 6, points, len(pairs.within_side))) for _ in batch.cells
        ]
        self.skew = [np.zeros((entities, 3, points, len(pairs.skew))) for _ in batch.cells]
        self.cross = np.zeros((entities, 9, points, len(pairs.cross)))

    def add(self, values: Array, factor: float, pairs: BlockPairs) -> None:
        """Add the Hessians of one term times a factor.

        Parameters
        ----------
        values
            (points, columns) from a kernel of `point_hessian`: for each side the symmetric and the
            skew parts, then the cross blocks. They are overwritten.
        pairs
            The pairs of vectors whose blocks this term has.
        """
        values *= factor
        first_column = 0
        # each array of blocks, the pairs of all terms in it, and the pairs that this term has
        for target, all_pairs, term_pairs in self._targets(pairs):
            entities, components, points, _ = target.shape
            end_column = first_column + components * len(term_pairs)
            # the blocks for this array are consecutive columns of the values
            block = values[:, first_column:end_column].reshape(
                entities, points, components, len(term_pairs)
            )
            target[..., _positions(all_pairs, term_pairs)] += block.transpose(0, 2, 1, 3)
            first_column = end_column

    def _targets(
        self, pairs: BlockPairs
    ) -> Iterator[tuple[Array, tuple[IndexPair, ...], tuple[IndexPair, ...]]]:
        """Iterate over the arrays of blocks, in the order of the values of a Hessian's kernel.

        Yields
        ------
        The array, the pairs of vectors for which it has blocks, and the pairs that a term has.
        """
        for symmetric, skew in zip(self.symmetric, self.skew, strict=True):
            yield symmetric, self._pairs.within_side, pairs.within_side
            yield skew, self._pairs.skew, pairs.skew
        yield self.cross, self._pairs.cross, pairs.cross


def _product(H: Array, products: Array) -> Array:
    """Return Hessians times products of shape functions, summed over points and pairs.

    Parameters
    ----------
    H
        (entities, components, points, pairs).
    products
        (points * pairs, functions).

    Returns
    -------
    (entities, components, functions).
    """
    entities, components = H.shape[:2]
    flat = np.asarray(H.reshape(entities * components, -1) @ products)
    return flat.reshape(entities, components, -1)


def _positions(
    all_pairs: tuple[IndexPair, ...], term_pairs: tuple[IndexPair, ...]
) -> slice | list[int]:
    """Return the indices of a term's pairs among all pairs, as a slice if they are contiguous.

    For example slice(1, 3) for the pairs (b, c) among (a, b, c), and [0, 2] for (a, c).
    """
    positions = [all_pairs.index(pair) for pair in term_pairs]
    if positions and positions == list(range(positions[0], positions[-1] + 1)):
        return slice(positions[0], positions[-1] + 1)
    return positions


Ints = NDArray[np.int32]


def add_cell_products(y: Array, K: Array, nodes: Ints, x: Array) -> None:
    """Add the products of the element matrices of cells with a vector x to a vector y.

    Parameters
    ----------
    y, x
        (nodes, 3): the result, which is changed, and the vector.
    K
        (cells, 9, pairs a <= b of functions): six symmetric components, then three skew ones.
    nodes
        (cells, functions): local nodes of each cell.
    """
    # the pairs a <= b of functions, in the order of K
    a, b = np.triu_indices(nodes.shape[1])
    blocks = _full_blocks(K)  # (cells, pairs, 3, 3)
    # rows of a by columns of b; e counts cells, p pairs, c and d components
    products = np.einsum("epcd,epd->epc", blocks, x[nodes[:, b]])
    np.add.at(y, nodes[:, a], products)
    # blocks below the diagonal, rows of b by columns of a, are transposes of those above
    upper = a < b
    transposed_products = np.einsum("epdc,epd->epc", blocks[:, upper], x[nodes[:, a[upper]]])
    np.add.at(y, nodes[:, b[upper]], transposed_products)


def _full_blocks(K: Array) -> Array:
    """Return blocks (cells, pairs, 3, 3), each the sum of its symmetric and its skew part.

    Parameters
    ----------
    K
        (cells, 9, pairs): six symmetric components, then three skew ones.
    """
    blocks = np.empty((len(K), K.shape[2], 3, 3))
    for number, (c, d) in enumerate(COMPONENTS):
        blocks[:, :, c, d] = blocks[:, :, d, c] = K[:, number]
    for number, (c, d) in enumerate(SKEW, len(COMPONENTS)):
        blocks[:, :, c, d] += K[:, number]
        blocks[:, :, d, c] -= K[:, number]
    return blocks


def add_coupling_products(y: Array, K: Array, rows: Ints, columns: Ints, x: Array) -> None:
    """Add the products of blocks that couple two cells with a vector x to a vector y.

    The products of the transposed blocks are added too.

    Parameters
    ----------
    y, x
        (nodes, 3): the result, which is changed, and the vector.
    K
        (pairs of cells, 9, functions^2): components (3, 3), row by row, of a function on the first
        cell and one on the second.
    rows, columns
        (pairs of cells, functions): nodes of the first and the second cell.
    """
    n = rows.shape[1]
    # e counts pairs of cells, c and d components, a and b functions on the first and second cell
    blocks = K.reshape(len(K), 3, 3, n, n)
    np.add.at(y, rows, np.einsum("ecdab,ebd->eac", blocks, x[columns]))
    np.add.at(y, columns, np.einsum("ecdab,eac->ebd", blocks, x[rows]))

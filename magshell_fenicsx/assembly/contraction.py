"""Hessians at points to the matrices of cells and of pairs of cells, and such matrices times a vector."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.batches import Batch, Rule
from magshell_fenicsx.assembly.point_kernels import COMPONENTS, SKEW, Pair, Pairs

Array = NDArray[np.float64]


class Contraction:
    """K[ac, bd] = sum over points and parts of w D_i[a] D_j[b] H[ic, jd].

    The products of the shape functions' derivatives are the same for all entities of a rule. For a symmetric (skew)
    block they are symmetric (skew) in a, b, so only a <= b is computed.
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
    """Hessians at the points of a batch, sorted for the contraction: (entities, components, points, pairs)."""

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
        for target, here, those in self._targets(pairs):
            entities, components, points, _ = target.shape
            last = first + components * len(those)
            part = values[:, first:last].reshape(entities, points, components, len(those))
            target[..., _places(here, those)] += part.transpose(0, 2, 1, 3)
            first = last

    def _targets(self, pairs: Pairs) -> Iterator[tuple[Array, tuple[Pair, ...], tuple[Pair, ...]]]:
        """The arrays, their pairs and the pairs of a term, in the order of `point_hessian`."""
        for symmetric, skew in zip(self.symmetric, self.skew, strict=True):
            yield symmetric, self._pairs.same, pairs.same
            yield skew, self._pairs.skew, pairs.skew
        yield self.cross, self._pairs.cross, pairs.cross


def _product(H: Array, products: Array) -> Array:
    entities, components = H.shape[:2]
    return np.asarray(H.reshape(entities * components, -1) @ products).reshape(entities, components, -1)


def _places(all_pairs: tuple[Pair, ...], some: tuple[Pair, ...]) -> slice | list[int]:
    """The indices of some pairs among all, as a slice if they are contiguous."""
    places = [all_pairs.index(pair) for pair in some]
    if places and places == list(range(places[0], places[-1] + 1)):
        return slice(places[0], places[-1] + 1)
    return places


Ints = NDArray[np.int32]


def add_own(y: Array, K: Array, nodes: Ints, x: Array) -> None:
    """Add the matrices (cells, 9, pairs a <= b) of cells times x (nodes, 3) to y; see `BlockMatrix.add_cells`."""
    a, b = np.triu_indices(nodes.shape[1])
    blocks = np.empty((len(K), len(a), 3, 3))
    for number, (c, d) in enumerate(COMPONENTS):
        blocks[:, :, c, d] = blocks[:, :, d, c] = K[:, number]
    for number, (c, d) in enumerate(SKEW, len(COMPONENTS)):
        blocks[:, :, c, d] += K[:, number]
        blocks[:, :, d, c] -= K[:, number]
    np.add.at(y, nodes[:, a], np.einsum("epcd,epd->epc", blocks, x[nodes[:, b]]))
    beside = a < b
    np.add.at(y, nodes[:, b[beside]], np.einsum("epdc,epd->epc", blocks[:, beside], x[nodes[:, a[beside]]]))


def add_coupled(y: Array, K: Array, here: Ints, there: Ints, x: Array) -> None:
    """Add the blocks (pairs of cells, 9, functions^2) and their transposes; see `BlockMatrix.add_coupling`."""
    n = here.shape[1]
    blocks = K.reshape(len(K), 3, 3, n, n)
    np.add.at(y, here, np.einsum("ecdab,ebd->eac", blocks, x[there]))
    np.add.at(y, there, np.einsum("ecdab,eac->ebd", blocks, x[here]))

"""An octree of cells: which boxes act on each other by multipoles, and which cells directly.

Boxes of level k are cubes of a grid of 2^k places along each axis; level 0 is the root, the last
level the finest. A box holds the cells whose middles are in it, of one part and one group. A part
is a set of connected cells; a group holds copies (the modelled cells and their images) whose boxes
are images of each other. An offset is the vector between the grid places of two boxes; pairs with
one offset share a translation matrix G: boxes a and b with multipoles Y have the energy
Y(b) . G Y(a). A box's key is (part, group, place in the grid). Own cells are those of this rank.
Lengths are over R.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.multipoles import COUNT, ends, translations

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
# sum of the radii of two boxes over the distance of their middles, up to which multipoles serve
MAX_RADII_OVER_DISTANCE = 0.5
CELLS_PER_BOX = 4  # about as many cells in a box of the finest level
MAX_DEPTH = 10
ROOT_BOX_FACTOR = 1.0137  # no simple number: cells of a regular mesh are not on sides of boxes


@dataclass(frozen=True)
class Level:
    """The boxes of one size.

    Attributes
    ----------
    width
        Side of the boxes over R.
    keys
        (boxes, 5) the part, the group, and the place in the grid.
    middle
        (boxes, 3) centres over R.
    of_cell
        (cells,) the box of each cell.
    parent
        (boxes,) box of the level before; empty at the first level.
    one, other
        (pairs,) boxes that act on each other by multipoles; `one` has cells of this rank.
    offset
        (pairs,) number of the vector between them.
    """

    width: float
    keys: Ints
    middle: Array
    of_cell: Ints
    parent: Ints
    one: Ints
    other: Ints
    offset: Ints


@dataclass(frozen=True)
class Tree:
    """Levels from the largest boxes to the smallest, and how boxes act on each other.

    Attributes
    ----------
    levels
        The boxes of each size.
    G
        (offsets, sum of `multipoles.ends`) entries of `multipoles.translations` that are not zero,
        for boxes of width one.
    near
        (own cells, cells) whether two cells act on each other directly.
    """

    levels: Sequence[Level]
    G: Array
    near: NDArray[np.bool_]


class Octree:
    """Boxes for cells that move; the places of the undeformed cells choose their size.

    Parameters
    ----------
    places
        (cells, 3) of the undeformed cells, over R.
    parts
        (cells,) part of each cell.
    groups
        (cells,) cells of different groups act on each other directly: copies whose boxes are not
        images of each other.
    own_cells
        The cells of this rank.
    acts_on_itself
        Whether a part acts on itself, too.

    Attributes
    ----------
    _places, _own_cells, _acts_on_itself
        The parameters of these names.
    _size, _origin
        Width over R and lower corner (3,) of the root box, which holds all cells.
    _depth
        How often boxes are halved from the root to the finest level.
    _kinds
        (cells, 2) part and group of each cell.
    _translations
        Entries of translation matrices, by the offset of their boxes.
    """

    def __init__(
        self, places: Array, parts: Ints, groups: Ints, own_cells: range, *, acts_on_itself: bool
    ) -> None:
        """Choose the size of the finest boxes; parameters are those of the class."""
        self._places, self._own_cells, self._acts_on_itself = places, own_cells, acts_on_itself
        self._kinds = np.column_stack([parts, groups])
        lowest, highest = places.min(axis=0), places.max(axis=0)
        # if all cells are at one place, any width will do
        self._size = float((highest - lowest).max()) * ROOT_BOX_FACTOR or 1.0
        # the box is central, so that mirror planes of the shell halve it
        self._origin = (lowest + highest - self._size) / 2
        self._depth = 0
        # halve boxes until they hold about `CELLS_PER_BOX` cells each
        while self._depth < MAX_DEPTH:
            filled_boxes = np.unique(self._keys(places), axis=0)  # at this depth
            if len(places) <= CELLS_PER_BOX * len(filled_boxes):
                break
            self._depth += 1
        self._translations: dict[tuple[int, ...], Array] = {}

    @cached_property
    def step(self) -> float:
        """Quarter of the width of the finest boxes.

        Cells that move by less than half of it stay in their boxes.
        """
        return float(self._size / 2**self._depth / 4)

    def steps_moved(self, places: Array) -> Ints:
        """Return the numbers of steps (cells, 3) by which cells have moved.

        `places` (cells, 3) are over R. Boxes follow from these numbers alone.
        """
        return np.asarray(np.rint((places - self._places) / self.step), dtype=np.int64)

    def tree(self, steps: Ints, radii: Array) -> Tree:
        """Return the boxes of cells that have moved, and how they act on each other.

        Pairs of boxes are followed from large to small ones. Where both are far apart for their
        size they act by multipoles; pairs that remain at the finest level act directly. `steps`
        (cells, 3) are the numbers of steps, of the length `step`, by which cells have moved.
        `radii` (cells,) over R are those of balls about the cells that contain their charges.
        """
        places = self._places + self.step * steps
        levels = list[Level]()
        pairs: Ints = np.zeros((0, 2), dtype=np.int64)
        of_parents: Ints = np.zeros(0, dtype=np.int64)  # the box of each cell at the level before
        offsets: dict[tuple[int, ...], int] = {}  # vector between boxes -> its number
        for boxes, of_cell, middle, width in self._boxes_of_levels(places):
            # pairs of boxes: at the root all of them, then the children of those that remain
            parent = np.zeros(0, dtype=np.int64)
            if not levels:
                pairs = np.stack(
                    np.meshgrid(*2 * [np.arange(len(boxes))], indexing="ij"), axis=-1
                ).reshape(-1, 2)
            else:
                parent = np.empty(len(boxes), dtype=np.int64)
                parent[of_cell] = of_parents
                pairs = _children(pairs, parent, len(levels[-1].keys))
            pairs = self._counted(pairs, boxes, of_cell)
            # pairs that are far for their size act by multipoles, and the others remain
            radius = _radii_of_boxes(places, radii, of_cell, middle)
            is_separated = _are_separated(pairs, boxes, middle, radius)
            (one, other), pairs = pairs[is_separated].T, pairs[~is_separated]
            # numbers of the vectors between these boxes; a new vector gets the next number
            vectors = [tuple(map(int, offset)) for offset in boxes[one, 2:] - boxes[other, 2:]]
            offset_numbers = np.array(
                [offsets.setdefault(offset, len(offsets)) for offset in vectors], dtype=np.int64
            )
            # by offset: C then reads each translation matrix once
            order = np.argsort(offset_numbers, kind="stable")
            levels.append(
                Level(
                    width=width,
                    keys=boxes,
                    middle=middle,
                    of_cell=of_cell,
                    parent=parent,
                    one=one[order],
                    other=other[order],
                    offset=offset_numbers[order],
                )
            )
            of_parents = of_cell
        # pairs of boxes that remain at the finest level
        of_cell, count = levels[-1].of_cell, len(levels[-1].keys)
        acts_directly = np.zeros((count, count), dtype=bool)
        acts_directly[pairs[:, 0], pairs[:, 1]] = True
        near_cells: NDArray[np.bool_] = acts_directly[
            of_cell[self._own_cells.start : self._own_cells.stop, None], of_cell
        ]
        return Tree(levels, self._translation_matrices(list(offsets)), near_cells)

    def _boxes_of_levels(self, places: Array) -> Iterator[tuple[Ints, Ints, Array, float]]:
        """Yield the boxes of cells at `places` (cells, 3), level by level from the root.

        Yields
        ------
        boxes
            (boxes, 5) keys: part, group and place in the grid of the level.
        of_cell
            (cells,) the box of each cell.
        middle
            (boxes, 3) centres over R.
        width
            Side of the boxes over R.
        """
        keys = self._keys(places)
        for k in range(self._depth + 1):
            # a place in the finest grid, halved for each level between
            grid = np.column_stack([keys[:, :2], keys[:, 2:] >> (self._depth - k)])
            boxes, of_cell = np.unique(grid, axis=0, return_inverse=True)
            width = self._size / 2**k
            middle = self._origin + (boxes[:, 2:] + 0.5) * width
            yield boxes, of_cell.reshape(-1), middle, width

    def _counted(self, pairs: Ints, boxes: Ints, of_cell: Ints) -> Ints:
        """Return those of the pairs (n, 2) of boxes that count on this rank.

        The first box of a pair must have own cells, since other pairs are left to other ranks. A
        pair of boxes of one part counts only if parts act on themselves. `boxes` (boxes, 5) are
        the keys of the boxes, `of_cell` (cells,) is the box of each cell.
        """
        has_own_cells = np.zeros(len(boxes), dtype=bool)
        has_own_cells[of_cell[self._own_cells.start : self._own_cells.stop]] = True
        pairs = pairs[has_own_cells[pairs[:, 0]]]
        if not self._acts_on_itself:
            pairs = pairs[boxes[pairs[:, 0], 0] != boxes[pairs[:, 1], 0]]
        return pairs

    def _keys(self, places: Array) -> Ints:
        """Return part, group and place in the finest grid of cells, (cells, 5)."""
        grid_places = np.floor((places - self._origin) * (2**self._depth / self._size)).astype(
            np.int64
        )
        return np.column_stack([self._kinds, grid_places])

    def _translation_matrices(self, offsets: list[tuple[int, ...]]) -> Array:
        """Return the entries of translation matrices that are not zero, one row for each offset.

        An offset is the vector between two boxes of the width one. Matrices are kept for later
        trees.
        """
        new_offsets = [offset for offset in offsets if offset not in self._translations]
        if new_offsets:
            # each row of a matrix begins with its entries that are not zero
            is_nonzero = np.arange(COUNT) < ends()[:, None]
            matrices = translations(np.array(new_offsets, dtype=np.float64))
            self._translations.update(zip(new_offsets, matrices[:, is_nonzero], strict=True))
        if not offsets:
            return np.zeros((0, ends().sum()))
        return np.stack([self._translations[offset] for offset in offsets])


def _radii_of_boxes(places: Array, radii: Array, of_cell: Ints, middle: Array) -> Array:
    """Return the radius (boxes,) of a ball about each box's middle with all charges of the box.

    Cells have balls of the given `radii` (cells,) about their `places` (cells, 3), and are in the
    boxes `of_cell` (cells,) with the middles `middle` (boxes, 3).
    """
    radius = np.zeros(len(middle))
    np.maximum.at(radius, of_cell, np.linalg.norm(places - middle[of_cell], axis=-1) + radii)
    return radius


def _are_separated(pairs: Ints, boxes: Ints, middle: Array, radius: Array) -> NDArray[np.bool_]:
    """Return whether each pair (n, 2) of boxes is far for its size, and of one group.

    `boxes` (boxes, 5) are the keys of the boxes, `middle` (boxes, 3) their middles, and `radius`
    (boxes,) the radii of the balls with their charges.
    """
    distance = np.linalg.norm(middle[pairs[:, 0]] - middle[pairs[:, 1]], axis=-1)
    is_far = radius[pairs].sum(axis=1) < MAX_RADII_OVER_DISTANCE * distance
    is_of_one_group = boxes[pairs[:, 0], 1] == boxes[pairs[:, 1], 1]
    return np.asarray(is_far & is_of_one_group)


def _children(pairs: Ints, parent: Ints, parents: int) -> Ints:
    """Return all pairs of children (m, 2) of pairs (n, 2) of boxes.

    `parent` (children,) is the parent of each box, `parents` the number of parents. A pair of
    parents with a and b children has a b pairs of children.
    """
    # children sorted by parent, so that each parent has one slice
    order, child_counts = np.argsort(parent, kind="stable"), np.bincount(parent, minlength=parents)
    first_of_parent = np.concatenate([[0], np.cumsum(child_counts)])
    # each pair of parents has the product of both numbers of children as pairs of children
    counts_of_both = child_counts[pairs]
    pair_counts = counts_of_both.prod(axis=1)
    # for each pair of children: number of its pair of parents, and its number among that pair's
    parent_pair = np.repeat(np.arange(len(pairs)), pair_counts)
    pairs_before = np.cumsum(pair_counts) - pair_counts
    number = np.arange(len(parent_pair)) - np.repeat(pairs_before, pair_counts)
    # the second child runs fastest
    second_count = counts_of_both[parent_pair, 1]
    first_child, second_child = number // second_count, number % second_count
    # from numbers among the children of a parent to numbers of boxes
    first_parent, second_parent = pairs[parent_pair].T
    return np.column_stack(
        [
            order[first_of_parent[first_parent] + first_child],
            order[first_of_parent[second_parent] + second_child],
        ]
    )

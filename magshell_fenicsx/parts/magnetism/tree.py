"""Boxes of cells, each in eight of half its size: which act on each other by multipoles, and which
cells directly.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.multipoles import COUNT, ends, translations

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
# sum of the radii of two boxes over the distance of their middles, up to which multipoles serve
APART = 0.5
CELLS = 4  # in a box of the finest level, about
DEEPEST = 10
ROOM = 1.0137  # no simple number: cells of a regular mesh are not on sides of boxes


@dataclass(frozen=True)
class Level:
    """The boxes of one size.

    Attributes
    ----------
    keys
        (boxes, 5) the part, the group, and the place in the grid.
    middle
        (boxes, 3)
    of_cell
        (cells,) the box of each cell.
    parent
        (boxes,) at the level before, and nothing at the first.
    one, other
        (pairs,) boxes that act on each other by multipoles; the first has cells of this rank.
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
    """Levels from the largest boxes to the smallest.

    Attributes
    ----------
    G
        (offsets, sum of `multipoles.ends`) what is not zero in `multipoles.translations`, of boxes
        of size one.
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
        (cells, 3) of the undeformed cells.
    parts
        (cells,) the number of each one's part.
    groups
        (cells,) cells of different groups act on each other directly: copies whose boxes are not
        images of each other.
    own
        The cells of this rank.
    itself
        Whether a part acts on itself, too.
    """

    def __init__(
        self, places: Array, parts: Ints, groups: Ints, own: range, *, itself: bool
    ) -> None:
        self._places, self._own, self._itself, self._kinds = (
            places,
            own,
            itself,
            np.column_stack([parts, groups]),
        )
        lowest, highest = places.min(axis=0), places.max(axis=0)
        self._size = float((highest - lowest).max()) * ROOM or 1.0
        self._origin = (
            lowest + highest - self._size
        ) / 2  # a mirror plane of the whole is one of the boxes
        self._depth = 0
        while self._depth < DEEPEST and len(places) > CELLS * len(
            np.unique(self._keys(places), axis=0)
        ):
            self._depth += 1
        self._translations: dict[tuple[int, ...], Array] = {}

    @cached_property
    def step(self) -> float:
        """Cells that move by less than half of this stay in their boxes."""
        return float(self._size / 2**self._depth / 4)

    def moved(self, places: Array) -> Ints:
        """How many steps cells have moved: the boxes follow from this alone."""
        return np.asarray(np.rint((places - self._places) / self.step), dtype=np.int64)

    def tree(self, steps: Ints, radii: Array) -> Tree:
        """The boxes of cells that have moved; `radii` (cells,) contain their charges."""
        places = self._places + self.step * steps
        keys, levels = self._keys(places), list[Level]()
        pairs: Ints = np.zeros((0, 2), dtype=np.int64)
        grids = [
            np.column_stack([keys[:, :2], keys[:, 2:] >> (self._depth - k)])
            for k in range(self._depth + 1)
        ]
        boxes_of_levels, before = list[tuple[Ints, Ints, Array, float]](), None
        for k, grid in enumerate(grids):
            boxes, of_cell = np.unique(grid, axis=0, return_inverse=True)
            width = self._size / 2**k
            boxes_of_levels.append(
                (boxes, of_cell.reshape(-1), self._origin + (boxes[:, 2:] + 0.5) * width, width)
            )
        offsets: dict[tuple[int, ...], int] = {}
        for k, (boxes, of_cell, middle, width) in enumerate(boxes_of_levels):
            own = np.zeros(len(boxes), dtype=bool)
            own[of_cell[self._own.start : self._own.stop]] = True
            radius = np.zeros(len(boxes))
            np.maximum.at(
                radius, of_cell, np.linalg.norm(places - middle[of_cell], axis=-1) + radii
            )
            if before is None:
                parent = np.zeros(0, dtype=np.int64)
                pairs = np.stack(
                    np.meshgrid(*2 * [np.arange(len(boxes))], indexing="ij"), axis=-1
                ).reshape(-1, 2)
            else:
                parent = np.empty(len(boxes), dtype=np.int64)
                parent[of_cell] = boxes_of_levels[k - 1][1]
                pairs = _children(pairs, parent, len(before))
            pairs = pairs[own[pairs[:, 0]]]
            if not self._itself:
                pairs = pairs[boxes[pairs[:, 0], 0] != boxes[pairs[:, 1], 0]]
            distance = np.linalg.norm(middle[pairs[:, 0]] - middle[pairs[:, 1]], axis=-1)
            far = (radius[pairs].sum(axis=1) < APART * distance) & (
                boxes[pairs[:, 0], 1] == boxes[pairs[:, 1], 1]
            )
            (one, other), pairs = pairs[far].T, pairs[~far]
            vectors = [tuple(map(int, each)) for each in boxes[one, 2:] - boxes[other, 2:]]
            which = np.array(
                [offsets.setdefault(each, len(offsets)) for each in vectors], dtype=np.int64
            )
            order = np.argsort(which, kind="stable")
            levels.append(
                Level(width, boxes, middle, of_cell, parent, one[order], other[order], which[order])
            )
            before = boxes
        of_cell, count = boxes_of_levels[-1][1], len(boxes_of_levels[-1][0])
        beside = np.zeros((count, count), dtype=bool)
        beside[pairs[:, 0], pairs[:, 1]] = True
        near: NDArray[np.bool_] = beside[of_cell[self._own.start : self._own.stop, None], of_cell]
        return Tree(levels, self._translated(list(offsets)), near)

    def _keys(self, places: Array) -> Ints:
        at = np.floor((places - self._origin) * (2**self._depth / self._size)).astype(np.int64)
        return np.column_stack([self._kinds, at])

    def _translated(self, offsets: list[tuple[int, ...]]) -> Array:
        new = [each for each in offsets if each not in self._translations]
        if new:
            given = np.arange(COUNT) < ends()[:, None]
            self._translations.update(
                zip(new, translations(np.array(new, dtype=np.float64))[:, given], strict=True)
            )
        return (
            np.stack([self._translations[each] for each in offsets])
            if offsets
            else np.zeros((0, ends().sum()))
        )


def _children(pairs: Ints, parent: Ints, parents: int) -> Ints:
    """All pairs of children of pairs of boxes."""
    order, count = np.argsort(parent, kind="stable"), np.bincount(parent, minlength=parents)
    first = np.concatenate([[0], np.cumsum(count)])
    sizes = count[pairs]
    each = sizes.prod(axis=1)
    of = np.repeat(np.arange(len(pairs)), each)
    within = np.arange(len(of)) - np.repeat(np.cumsum(each) - each, each)
    one, other = within // sizes[of, 1], within % sizes[of, 1]
    return np.column_stack([order[first[pairs[of, 0]] + one], order[first[pairs[of, 1]] + other]])

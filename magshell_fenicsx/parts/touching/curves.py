"""Points on meridians, and the places of other meridians that are nearest to them."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.touching.nearest import BULGE

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
Inside = NDArray[np.bool_]


@dataclass(frozen=True)
class Rule:
    """Points on the cells of two shells.

    Attributes
    ----------
    cell, shape, weight
        (n,) number, (n, functions) of that cell, and undeformed area over R^2, all around.
    first
        (n,) whether it is on the first shell.
    normal
        (n, 2) undeformed.
    on_edge
        (n,) whether it is next to a free end.
    """

    cell: Longs
    shape: Array
    weight: Array
    first: Inside
    normal: Array
    on_edge: Inside


@dataclass(frozen=True)
class Faced:
    """Points and the places that are nearest to them.

    Attributes
    ----------
    point, cell, X
        (n,) number of the point, cell of the place, and where it is in that.
    free
        (n,) whether it may move along the curve.
    distance
        (n,) over R.
    """

    point: Longs
    cell: Longs
    X: Array
    free: Inside
    distance: Array

    def of(self, which: Inside | Longs) -> "Faced":
        """Some of them."""
        return Faced(*(getattr(self, each.name)[which] for each in fields(self)))


def beside(nodes: Longs) -> Longs:
    """(cells, 2): the cell beyond each end; -1 where there is none."""
    beyond = np.full((len(nodes), 2), -1, dtype=np.int64)
    of = dict[int, tuple[int, int]]()
    for cell, end in np.ndindex(len(nodes), 2):
        if other := of.get(vertex := int(nodes[cell, end])):
            beyond[cell, end], beyond[other] = other[0], cell
        of[vertex] = cell, end
    return beyond


class Close:
    """Which cells of the other shell points may be near to: from circles about cells, then from chords.

    Parameters
    ----------
    nodes
        (cells, functions) of all cells, the ends first.
    sides
        Whether each cell belongs to the first shell, and to the second.
    element
        Of basix.
    """

    def __init__(self, rule: Rule, nodes: Longs, sides: tuple[Inside, Inside], element: Any) -> None:
        self._one, self._other = (np.flatnonzero(side) for side in sides)
        self._counts = np.bincount(rule.cell, minlength=len(nodes))
        self._starts = np.zeros_like(self._counts)  # points of a cell follow each other
        self._starts[rule.cell[::-1]] = np.arange(len(rule.cell))[::-1]
        at = np.linspace(0.0, 1.0, 20 * element.degree + 1, dtype=np.float64)[:, None]
        inner = np.abs(element.tabulate(0, at)[0, :, 2:, 0])
        self._bulge = BULGE * float(inner.sum(axis=1).max(initial=0.0))  # of a curve, over that of its nodes
        self._part = element.points[2:, :1]

    def __call__(self, x: Array, nodal: Array, reach: float) -> tuple[Longs, Longs]:
        """Points and cells, among them all of less than this distance.

        Parameters
        ----------
        x, nodal
            Places of all points (n, 2), and of the nodes of all cells (cells, functions, 2).
        """
        point, cell = self._in_circles(nodal, reach)
        a, chord = nodal[:, 0], nodal[:, 1] - nodal[:, 0]
        off = nodal[:, 2:] - a[:, None] - self._part * chord[:, None]
        most = self._bulge * np.linalg.norm(off, axis=2).max(axis=1, initial=0.0)
        way, along = x[point] - a[cell], chord[cell]
        part = np.clip(np.sum(way * along, axis=1) / np.sum(chord * chord, axis=1)[cell], 0.0, 1.0)
        near = np.linalg.norm(way - part[:, None] * along, axis=1) - most[cell] < reach
        return point[near], cell[near]

    def _in_circles(self, nodal: Array, reach: float) -> tuple[Longs, Longs]:
        """Points of cells that are near to cells, and these."""
        one, other, centres = self._one, self._other, nodal.mean(axis=1)
        radii = BULGE * np.sqrt(np.sum((nodal - centres[:, None]) ** 2, axis=2).max(axis=1))
        way = centres[one][:, None] - centres[other]
        i, j = np.nonzero(np.sum(way * way, axis=2) < (radii[one][:, None] + radii[other] + reach) ** 2)
        of, cell = np.concatenate([one[i], other[j]]), np.concatenate([other[j], one[i]])
        count = self._counts[of]
        first = np.repeat(self._starts[of] - np.cumsum(count) + count, count)
        return first + np.arange(len(first)), np.repeat(cell, count)


def nowhere() -> Faced:
    """No places."""
    nothing = np.zeros(0, dtype=np.int64)
    return Faced(nothing, nothing, np.zeros(0), np.zeros(0, dtype=bool), np.zeros(0))

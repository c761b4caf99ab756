"""Adaptive sampling: find parts of cells where samples miss values of formulas, however small.

The ranges of a formula and of its derivatives in a box (`input/enclosure.py`) are compared with
values at a few places. A part is divided while the difference of both may change the integral of
the formula's variation. So a step or a Gaussian of any width is found, at a cost that grows like
the logarithm of one over the width.

- A part is a piece of a cell: the image X = corner + sides X' of the reference cell in itself. Its
  children are the pieces that it is divided into; d is the dimension of cells.
- The range of a formula is an interval that surely contains its values in a box in space.
- The variation of f is the integral of |f - mean of f|.
- `hidden` is how far f may leave the range of its samples; times the area it is a hidden integral.
- `open` is the share of the variation that stays hidden where the search gives up.
- Own cells are those of this rank; they come first, ghosts follow and do not count in sums.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import basix
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.input.expressions import FormulaGroup

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
BATCH_SIZE = 4096  # parts that are evaluated together
MAX_OPEN_VARIATION = 5e-3  # of the integral of the variation: what ranges may leave open
# of the integral of |f|: so little may be open whatever the variation, as of a step at a rim
MAX_OPEN_INTEGRAL = 1e-4
# of the difference of values: both sides of a step are seen, and little is left open
STEP_SHARE = 0.9
SLOPE_RATIO = 8.0  # times what values show: derivatives that differ less hide nothing
DIVIDED_SHARE = 0.03  # of the largest part of that: what is divided now, before others
VALUE_TOLERANCE = 1e-9  # of the largest value
MIN_SIZE, MAX_VALUE = 1e-7, 1e150  # over R, and a value
MAX_PARTS = 60_000  # parts in all
# corner and scale along each axis of the parts of an interval, of a triangle, and of a body's cell
# (in its surface)
CHILDREN: dict[int, list[tuple[tuple[float, ...], tuple[float, ...]]]] = {
    1: [((0.0,), (0.5,)), ((0.5,), (0.5,))],
    2: [
        ((x, y), (s, s))
        for x, y, s in ((0, 0, 0.5), (0.5, 0, 0.5), (0, 0.5, 0.5), (0.5, 0.5, -0.5))
    ],
    3: [((x, y, 0.0), (0.5, 0.5, 1.0)) for x in (0.0, 0.5) for y in (0.0, 0.5)],
}


@dataclass(frozen=True)
class SubCells:
    """Parts of cells: images X = corner + sides * X' of the reference cell, each in a cell.

    Attributes
    ----------
    cell
        (parts,) number of the cell of each part.
    corner, sides
        (parts, d) place and signed size in the reference cell.
    """

    cell: Numbers
    corner: Array
    sides: Array

    def __getitem__(self, which: slice | NDArray[np.bool_]) -> "SubCells":
        return SubCells(self.cell[which], self.corner[which], self.sides[which])

    def in_each_cell(self, cells: Numbers) -> "SubCells":
        """Return these parts in each of the cells (n,) with the given numbers: (n * parts)."""
        count = len(cells)
        numbers = np.repeat(cells, len(self.cell))
        return SubCells(numbers, np.tile(self.corner, (count, 1)), np.tile(self.sides, (count, 1)))

    @classmethod
    def concatenate(cls, groups: "Sequence[SubCells]") -> "SubCells":
        def joined(name: str) -> NDArray[Any]:
            """Return one array of all groups."""
            return np.concatenate([getattr(group, name) for group in groups])

        return cls(*map(joined, ("cell", "corner", "sides")))

    def batches(self) -> "list[SubCells]":
        """Return these parts in groups of at most `BATCH_SIZE`."""
        return [self[i : i + BATCH_SIZE] for i in range(0, len(self.cell), BATCH_SIZE)]

    def divided(self) -> "SubCells":
        """Return the children of all parts: first all of the first part, and so on."""
        d = self.corner.shape[1]
        children = CHILDREN[d]
        # of the children of the reference cell, (children, d) each
        corners, scales = (np.array(v, dtype=float) for v in zip(*children, strict=True))
        # of the children of all parts, (parts, children, d) each
        new_corners = self.corner[:, None] + self.sides[:, None] * corners
        new_sides = self.sides[:, None] * scales
        numbers = np.repeat(self.cell, len(children))
        return SubCells(numbers, new_corners.reshape(-1, d), new_sides.reshape(-1, d))

    def rule(self, points: Array, weights: Array) -> tuple[Array, Array]:
        """Return points (parts, q, d) and weights (parts, q) of a quadrature rule on each part.

        `points` (q, d) and `weights` (q,) are the rule on the reference cell. Sides may be negative
        where a child is turned over.
        """
        X = self.corner[:, None] + self.sides[:, None] * points
        return X, np.abs(self.sides.prod(axis=1))[:, None] * weights


# parts -> places (parts, q, 3), the corners first, and areas (parts,)
PlacesOfParts = Callable[[SubCells], tuple[Array, Array]]


@dataclass(frozen=True)
class Lattice:
    """Places in the reference cell at which formulas are sampled.

    Attributes
    ----------
    places
        (n, d), the corners first.
    corners
        Number of corners.
    pairs
        For each axis, numbers (pairs, 2) of neighbouring places along it.
    count
        Number of parts of each side.
    """

    places: Array
    corners: int
    pairs: list[Numbers]
    count: int

    @classmethod
    def make(cls, kind: basix.CellType, count: int) -> "Lattice":
        """Return the lattice that divides each side of the reference cell into `count` parts."""
        corners = basix.geometry(kind)
        # the boundary is included, so that the corners occur twice among all places
        lattice_places = basix.create_lattice(
            kind, count, basix.LatticeType.equispaced, exterior=True
        )
        # along each axis, neighbours are places of the lattice that differ by one step
        differences = lattice_places[None] - lattice_places[:, None]
        steps = np.eye(corners.shape[1]) / count
        # they are counted among all places, where the corners come first
        pairs = [
            np.argwhere(np.abs(differences - step).max(axis=-1) < 1e-9) + len(corners)
            for step in steps
        ]
        return cls(np.concatenate([corners, lattice_places]), len(corners), pairs, count)

    def bent(self, f: Array) -> Array:
        """Return how much the slopes of f differ within each part: (parts, formulas).

        `f` (parts, n, formulas) are values at the places. Slopes are differences of neighbours over
        their distance in the part; the ranges of slopes along each axis are added up.
        """
        slopes = (self.count * (f[:, pairs[:, 1]] - f[:, pairs[:, 0]]) for pairs in self.pairs)
        return np.asarray(sum(np.ptp(slope, axis=1) for slope in slopes))


@dataclass(frozen=True)
class RefinedParts:
    """Parts that need no further division, on this rank.

    Attributes
    ----------
    parts
        The n parts.
    area, centre, size
        (n,) areas, (n, 3) middles and (n,) largest sides of their boxes.
    variance
        (n,) mean of |f - mean of f|^2 in each part.
    variation
        Integral of |f - mean of f|.
    open
        Part of the variation that samples may miss, where too many parts would be needed; else 0.
    """

    parts: SubCells
    area: Array
    centre: Array
    size: Array
    variance: Array
    variation: float
    open: float


def refine_where_hidden(
    formulas: FormulaGroup,
    first_parts: SubCells,
    places_of: PlacesOfParts,
    lattice: Lattice,
    owned: int,
    comm: MPI.Comm = MPI.COMM_SELF,
) -> RefinedParts:
    """Return the first parts, divided as far as samples may miss values of formulas; collective.

    Parameters
    ----------
    formulas
        The formulas, with their ranges in boxes.
    first_parts
        Parts of this rank's cells.
    places_of
        Function from parts to their places (parts, q, 3), the corners first, and areas (parts,).
    lattice
        Places in each part.
    owned
        Number of this rank's own cells, which come first and alone count in sums.
    comm
        The ranks that share the cells.

    Notes
    -----
    In each pass only the parts with the largest hidden integrals are divided. The search ends if
    the sum of hidden integrals is negligible, or at `MAX_PARTS`.
    """
    parts, samples = first_parts, _sample(formulas, first_parts, places_of, lattice)
    part_count = 0
    while True:
        is_own = parts.cell < owned
        part_count = max(part_count, comm.allreduce(int(is_own.sum())))
        deviations, variation = _deviations(samples, is_own, comm)
        hidden_integrals = _hidden_integrals(samples, comm)
        largest_hidden = comm.allreduce(float(hidden_integrals[is_own].max(initial=0.0)), MPI.MAX)
        hidden_integral = comm.allreduce(float(hidden_integrals[is_own].sum()))
        negligible = MAX_OPEN_INTEGRAL * _integral_of_size(samples, is_own, comm)
        threshold = MAX_OPEN_VARIATION * variation / max(comm.allreduce(int(is_own.sum())), 1)
        # parts that hide more than their share, the worst of them first
        to_divide = (hidden_integrals > threshold) & (
            hidden_integrals >= DIVIDED_SHARE * min(largest_hidden, np.finfo(float).max)
        )
        if hidden_integral <= max(MAX_OPEN_VARIATION * variation, negligible):
            break
        if part_count > MAX_PARTS or not comm.allreduce(int((to_divide & is_own).sum())):
            break
        smaller = parts[to_divide].divided()
        parts = SubCells.concatenate([parts[~to_divide], smaller])
        new_samples = _sample(formulas, smaller, places_of, lattice)
        samples = _Samples.concatenate([samples.select(~to_divide), new_samples])
    variances = (deviations**2).mean(axis=1)
    share = hidden_integral / max(variation, np.finfo(float).tiny)
    open_share = share if part_count > MAX_PARTS else 0.0
    return RefinedParts(
        parts, samples.area, samples.centre, samples.size, variances, variation, open_share
    )


def _deviations(
    samples: "_Samples", is_own: NDArray[np.bool_], comm: MPI.Comm
) -> tuple[Array, float]:
    """Return |f - mean of f| at the samples (parts, places), and its integral; collective.

    Mean and integral are those over the parts of all ranks; `is_own` (parts,) tells which parts of
    this rank count.
    """
    area = samples.area * is_own
    integral = comm.allreduce(area @ samples.values.mean(axis=1))
    mean = integral / comm.allreduce(float(area.sum()))
    deviations = np.linalg.norm(samples.values - mean, axis=-1)
    return deviations, comm.allreduce(float((area * deviations.mean(axis=1)).sum()))


def _hidden_integrals(samples: "_Samples", comm: MPI.Comm) -> Array:
    """Return the hidden integral of each part (parts,); collective.

    It is zero where `hidden` is negligible beside the largest value, or the part is tiny.
    """
    largest = comm.allreduce(float(np.abs(samples.values).max(initial=0.0)), MPI.MAX)
    can_hide = (samples.hidden > VALUE_TOLERANCE * largest) & (samples.size > MIN_SIZE)
    return np.where(can_hide, samples.area * samples.hidden, 0.0)


def _integral_of_size(samples: "_Samples", is_own: NDArray[np.bool_], comm: MPI.Comm) -> float:
    """Return the integral of |f| over the parts of all ranks, by samples; collective.

    `is_own` (parts,) tells which parts of this rank count.
    """
    area = samples.area * is_own
    own_integral = float(area @ np.linalg.norm(samples.values, axis=-1).mean(axis=1))
    return float(comm.allreduce(own_integral))


@dataclass(frozen=True)
class _Samples:
    """Samples of formulas in parts of cells.

    Attributes
    ----------
    area, centre, size
        (parts,), (parts, 3) and (parts,): size is the largest side of the part's box.
    hidden
        (parts,) how far formulas may leave the range of their values between the places.
    values
        (parts, places, formulas).
    """

    area: Array
    centre: Array
    size: Array
    hidden: Array
    values: Array

    def select(self, selection: NDArray[np.bool_]) -> "_Samples":
        """Return the samples of selected parts, by flags (parts,)."""
        return _Samples(*(getattr(self, name)[selection] for name in self.__dataclass_fields__))

    @classmethod
    def concatenate(cls, groups: "Sequence[_Samples]") -> "_Samples":
        def joined(name: str) -> NDArray[Any]:
            """Return one array of all groups."""
            return np.concatenate([getattr(samples, name) for samples in groups])

        return cls(*map(joined, cls.__dataclass_fields__))


def _sample(
    formulas: FormulaGroup, parts: SubCells, places_of: PlacesOfParts, lattice: Lattice
) -> _Samples:
    """Sample formulas in each part, and estimate how far they may leave the range of the samples.

    Ranges of the formulas, and of their slopes, are taken in the box around a part's places. The
    box is enlarged for a curved part, which bulges out of it.

    Parameters
    ----------
    places_of
        Function from parts to their places (parts, q, 3), the corners first, and areas (parts,).
    lattice
        The same places in the reference cell, with pairs of neighbours.
    """
    x, area = places_of(parts)
    low, high = x.min(axis=1), x.max(axis=1)
    # in a flat part the means of all places and of the corners agree
    off_centre = np.abs(x.mean(axis=1) - x[:, : lattice.corners].mean(axis=1))
    bulge = off_centre.max(axis=1, initial=0.0)[:, None]
    bulge = np.where(bulge > VALUE_TOLERANCE, bulge, 0.0)
    # (parts, formulas) each: least and largest value in the box, and the range of slopes times the
    # box's sides
    lower, upper, slope_range = formulas.bounds(low - bulge, high + bulge)
    values = formulas.values(x.reshape(-1, 3))
    f = values.reshape(*x.shape[:2], values.shape[1])  # a rank may have no parts
    f = np.where(np.isfinite(f), f, 0.0)
    upper, lower = (np.clip(v, -MAX_VALUE, MAX_VALUE) for v in (upper, lower))
    # the range beyond most of the samples' range, but not more than slopes allow between places
    beyond_samples = np.maximum(upper - lower - STEP_SHARE * np.ptp(f, axis=1), 0.0)
    hidden = np.minimum(beyond_samples, slope_range / lattice.count)
    # nothing is hidden if slopes vary about as much as the samples show: `bent` is the range of
    # slopes between neighbouring samples
    is_shown = slope_range <= SLOPE_RATIO * lattice.bent(f)
    hidden = np.where(is_shown, 0.0, hidden).sum(axis=1)
    return _Samples(area, x.mean(axis=1), (high - low).max(axis=1), hidden, f)

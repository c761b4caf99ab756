"""Formulas on cells: interpolated where they are smooth, else the polynomials with the same
moments.

A formula that varies within a cell, or jumps there, is not what its values at the nodes show: a
load on a disc between the nodes would be none. The polynomial p of the displacement's degree k with

    integral of p q = integral of f q    over the cell, for each polynomial q of the degree k,

does the same work on every displacement, up to the curvature of the cell. Its integrals come from
parts of the cell that are divided until each agrees with its own parts. Where f is a polynomial of
the degree k, p is f.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import basix
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.input.expressions import FormulaGroup
from magshell_fenicsx.models.shell.adaptive_sampling import (
    BATCH_SIZE,
    CHILDREN,
    Lattice,
    SubCells,
    refine_where_hidden,
)

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
Values = Callable[
    [Array, Array], Array
]  # places and normals (cells, n, 3) -> (cells, n, components)
Element: TypeAlias = basix.finite_element.FiniteElement
INTERVAL, TRIANGLE = basix.CellType.interval, basix.CellType.triangle
INTERPOLATION_TOLERANCE = 1e-4  # of the integral of |f|: interpolated formulas differ by less
SMOOTH_CELL_TOLERANCE = 1e-6  # of the largest value: cells that differ by less stay interpolated
PART_TOLERANCE = 5e-8  # of the integral of |f|: a part of a cell that differs by more is divided
MAX_DIVISIONS, MAX_PARTS = 9, 400_000  # divisions, parts of all cells
VISIBLE_SHARE = 0.01  # of what the polynomials leave: a cell that counts
FIRST_DIVISIONS = {1: 8, 2: 2, 3: 2}  # divisions of every cell, by its dimension
LATTICE_DIVISIONS = {
    1: 8,
    2: 4,
    3: 2,
}  # places along each side of a part whose range is compared with them
RULE_DEGREE = {1: 7, 2: 6, 3: 4}  # degree of the rule on each part


@dataclass(frozen=True)
class CellGeometry:
    """The cells of this rank with their places, polynomials in each.

    Attributes
    ----------
    element
        Of the placement.
    nodal
        (cells, nodes, 3) of a surface, an edge (without normals) or a body, of whose cells the
        third axis is across; (cells, nodes, 2) of a meridian, rho and z.
    owned
        How many are this rank's own; they come first.
    """

    element: Element
    nodal: Array
    owned: int
    comm: MPI.Comm

    @property
    def dimension(self) -> int:
        return {INTERVAL: 1, TRIANGLE: 2}.get(self.element.cell_type, 3)

    def evaluate(
        self, X: Array, cells: Numbers | slice = slice(None)
    ) -> tuple[Array, Array, Array]:
        """Places and normals (cells, n, 3), and length or area over that of the reference cell
        (cells, n).

        At reference points (n, dimension), or at points (cells, n, dimension) of each cell.
        """
        nodal, d = self.nodal[cells], self.dimension
        table = self.element.tabulate(1, X.reshape(-1, d))[..., 0]
        table = table.reshape(1 + d, *X.shape[:-1], nodal.shape[1])
        x, *slopes = (np.matmul(each, nodal) for each in table)
        if d == 1:
            if x.shape[-1] == 3:
                return x, np.zeros_like(x), np.linalg.norm(slopes[0], axis=-1)
            (rho, z), (rho_s, z_s) = np.moveaxis(x, -1, 0), np.moveaxis(slopes[0], -1, 0)
            length = np.hypot(rho_s, z_s)
            normals = np.stack([-z_s, 0 * z_s, rho_s], axis=-1) / length[..., None]
            return np.stack([rho, 0 * rho, z], axis=-1), normals, rho * length
        m = np.cross(slopes[0], slopes[1])
        size = np.linalg.norm(m, axis=-1)
        return x, m / size[..., None], size

    def sum_over_ranks(self, of_cells: Array) -> Array:
        """The sum over the cells of all ranks; collective."""
        return np.asarray(self.comm.allreduce(of_cells[: self.owned].sum(axis=0)))


@dataclass(frozen=True)
class ProjectedFormula:
    """A formula on cells.

    Attributes
    ----------
    nodal
        (cells, nodes, components): as they were where the formula is smooth.
    smooth
        Whether it is everywhere, on all ranks.
    size
        The integral of |f|.
    missed
        By how much integrals of f may still be wrong, over that of |f|.
    rest
        The root of the integral of |f - p|^2 over that of |f|^2, of all cells.
    widest
        The largest side of a cell that misses a visible part of that.
    open
        The part of the integral of |f| that may not have been seen, if more than it should be.
    """

    nodal: Array
    smooth: bool
    size: float
    missed: float = 0.0
    rest: float = 0.0
    widest: float = 0.0
    open: float = 0.0


def project_formula(
    values: Values,
    cells: CellGeometry,
    nodal: Array,
    element: Element,
    degree: int,
    *,
    bounded: bool = False,
    formulas: FormulaGroup | None = None,
) -> ProjectedFormula:
    """A formula whose values at the nodes of each cell are known; collective.

    Parameters
    ----------
    nodal, element
        (cells, nodes, components) at the points of the element.
    degree
        Of the polynomials with the same moments, at most that of the element.
    bounded
        Whether they stay between the least and the largest value in a cell; of their moments the
        first is kept.
    formulas
        What varies in them, so that nothing between the places is missed.
    """
    d, parts = cells.dimension, _uniform_parts(cells)
    X, w = (v.reshape(-1, *v.shape[2:]) for v in sampling_points(cells))
    x, normals, area = cells.evaluate(X)
    f = values(x, normals)
    off = np.linalg.norm(np.matmul(element.tabulate(0, X)[0, :, :, 0], nodal) - f, axis=-1)
    magnitude, area = np.linalg.norm(f, axis=-1), area * w
    square_of = (area * magnitude**2).sum(axis=1)
    sums = cells.sum_over_ranks(
        np.stack([*((area * v).sum(axis=1) for v in (magnitude, off)), square_of], axis=-1)
    )
    size, differs, square = map(float, sums)
    scale, sizes = area.sum(axis=1) / w.sum(), (area * magnitude).sum(axis=1)
    narrow = (
        _find_hidden_detail(values, formulas, cells, np.einsum("q,cqi->ci", w, f))
        if formulas
        else _HiddenDetail.none(len(scale))
    )
    hidden = scale * narrow.hidden
    more = float(cells.sum_over_ranks(hidden))
    size += more
    if not (
        differs + more > INTERPOLATION_TOLERANCE * size
        or more > INTERPOLATION_TOLERANCE * narrow.variation
    ):
        return ProjectedFormula(nodal, smooth=True, size=size, open=narrow.open)
    largest = cells.comm.allreduce(float(magnitude.max(initial=0.0)), MPI.MAX)
    chosen = np.flatnonzero(
        (off @ w > SMOOTH_CELL_TOLERANCE * largest * w.sum()) | (hidden > PART_TOLERANCE * size)
    )
    ahead = narrow.parts_of(chosen, parts)
    space = basix.create_element(
        basix.ElementFamily.P, element.cell_type, degree, basix.LagrangeVariant.gll_warped
    )
    integrals = _moments(
        values, cells, chosen, scale, ahead, PART_TOLERANCE * size, space, nodal.shape[-1]
    )
    moments, sizes[chosen], squares, missed = integrals
    Y, v = basix.make_quadrature(element.cell_type, 2 * degree)
    phi = space.tabulate(0, Y)[0, :, :, 0]
    p = np.linalg.solve(phi.T @ (v[:, None] * phi), moments)
    unshown, lost = np.zeros(len(scale)), squares - np.einsum("q,cqi->c", v, np.matmul(phi, p) ** 2)
    unshown[chosen] = scale[chosen] * np.maximum(lost, 0.0)
    size, rest = float(cells.sum_over_ranks(sizes)), float(cells.sum_over_ranks(unshown))
    side = np.sqrt(2.0) * scale ** (1 / min(d, 2))
    widest = cells.comm.allreduce(
        float(side[unshown > VISIBLE_SHARE * rest].max(initial=0.0)), MPI.MAX
    )
    at_nodes = np.matmul(space.tabulate(0, element.points)[0, :, :, 0], p)
    if bounded:
        mean = np.einsum("q,cqi->ci", v, np.matmul(phi, p))[:, None] / v.sum()
        at_nodes = _bounded(
            at_nodes, mean, np.matmul(space.tabulate(0, X)[0, :, :, 0], p), f[chosen]
        )
    new = nodal.copy()
    new[chosen] = at_nodes
    nothing = np.finfo(float).tiny  # a formula that is zero but on a line
    square_of[chosen] = scale[chosen] * squares
    share = float(np.sqrt(rest / max(square, float(cells.sum_over_ranks(square_of)), nothing)))
    return ProjectedFormula(
        new, False, size, missed / max(size, nothing), share, widest, narrow.open
    )


def _uniform_parts(cells: CellGeometry) -> SubCells:
    """The parts in which every cell is looked at first."""
    d = cells.dimension
    parts = SubCells(np.zeros(1, np.int64), np.zeros((1, d)), np.ones((1, d)))
    for _ in range(FIRST_DIVISIONS[d]):
        parts = parts.divided()
    return parts


def sampling_points(cells: CellGeometry) -> tuple[Array, Array]:
    """Their places (parts, q, d) in the reference cell, and weights (parts, q)."""
    return _uniform_parts(cells).rule(
        *basix.make_quadrature(cells.element.cell_type, RULE_DEGREE[cells.dimension])
    )


@dataclass(frozen=True)
class _HiddenDetail:
    """What is between the places of whole cells.

    Attributes
    ----------
    hidden
        By how much integrals over the reference cell differ from those of the places (cells,).
    variation
        The integral of |f - its mean|.
    leaves, deep
        Parts of divided cells, and whether each cell is one (cells,).
    open
        See `ProjectedFormula`.
    """

    hidden: Array
    variation: float
    refine_where_hidden: SubCells
    deep: NDArray[np.bool_]
    open: float

    @classmethod
    def none(cls, cells: int, variation: float = 0.0, open_: float = 0.0) -> "_HiddenDetail":
        none = SubCells(np.empty(0, np.int64), np.empty((0, 0)), np.empty((0, 0)))
        return cls(np.zeros(cells), variation, none, np.zeros(cells, bool), open_)

    def parts_of(self, chosen: Numbers, alike: SubCells) -> SubCells:
        """Of some cells: those that are alike, but of the divided ones the leaves, none larger."""
        deep = self.deep[chosen]
        if not deep.any():
            return alike.in_each_cell(chosen)
        parts, largest = (
            self.leaves[np.isin(self.leaves.cell, chosen)],
            1.001 * np.abs(alike.sides[0, 0]),
        )
        small, wide = list[SubCells](), np.abs(parts.sides[:, 0]) > largest
        while wide.any():
            small.append(parts[~wide])
            parts = parts[wide].divided()
            wide = np.abs(parts.sides[:, 0]) > largest
        return SubCells.concatenate([alike.in_each_cell(chosen[~deep]), *small, parts])


def _find_hidden_detail(
    values: Values, formulas: FormulaGroup, cells: CellGeometry, coarse: Array
) -> _HiddenDetail:
    """Integrals (cells, components) compared with those over leaves, see `adaptive_sampling.leaves`;
    collective.
    """
    d, kind = cells.dimension, cells.element.cell_type
    lattice, (points, weights) = (
        Lattice.make(kind, LATTICE_DIVISIONS[d]),
        basix.make_quadrature(kind, RULE_DEGREE[d]),
    )

    def look(parts: SubCells) -> tuple[Array, Array]:
        X, w = parts.rule(
            lattice.places, np.full(len(lattice.places), weights.sum() / len(lattice.places))
        )
        x, _, area = cells.evaluate(X, parts.cell)
        return x, (area * w).sum(axis=1)

    first = SubCells(np.zeros(1, np.int64), np.zeros((1, d)), np.ones((1, d))).in_each_cell(
        np.arange(len(cells.nodal))
    )
    seen = refine_where_hidden(formulas, first, look, lattice, cells.owned, cells.comm)
    deep = np.zeros(len(cells.nodal), bool)
    divided = np.abs(seen.parts.sides[:, 0]) < 1
    deep[seen.parts.cell[divided]] = True
    fine, parts = np.where(deep[:, None], 0.0, coarse), seen.parts[divided]
    for some in parts.batches():
        X, w = some.rule(points, weights)
        x, normals, _ = cells.evaluate(X, some.cell)
        np.add.at(fine, some.cell, np.einsum("pq,pqi->pi", w, values(x, normals)))
    hidden = np.linalg.norm(fine - coarse, axis=1)
    if not cells.sum_over_ranks(hidden) > 0:
        return _HiddenDetail.none(len(hidden), seen.variation, seen.open)
    return _HiddenDetail(hidden, seen.variation, parts, deep, seen.open)


def _moments(
    values: Values,
    cells: CellGeometry,
    chosen: Numbers,
    scale: Array,
    ahead: SubCells,
    threshold: float,
    space: Element,
    components: int,
) -> tuple[Array, Array, Array, float]:
    """Integrals of f times each function (cells, functions, components), of |f| and |f|^2 (cells,),
    and their error.

    Over the reference cell, but of |f| and the error over the surface; collective.
    """
    points, weights = basix.make_quadrature(space.cell_type, RULE_DEGREE[cells.dimension])
    number = np.zeros(len(cells.nodal), np.int64)
    number[chosen] = np.arange(len(chosen))

    def evaluated(some: SubCells) -> tuple[Array, Array, Array, Array]:
        X, w = some.rule(points, weights)
        x, normals, area = cells.evaluate(X, some.cell)
        return X, w, area * w, values(x, normals)

    def integrals(w: Array, f: Array) -> Array:
        return np.asarray(np.einsum("pq,pqi->pi", w, f))

    by_cell = np.zeros((len(chosen), space.dim, components))
    sizes, squares, errors, each = (
        np.zeros(len(chosen)),
        np.zeros(len(chosen)),
        0.0,
        len(CHILDREN[cells.dimension]),
    )
    whole = [integrals(w, f) for _, w, _, f in map(evaluated, ahead.batches())]
    for depth in range(MAX_DIVISIONS + 1):
        last = depth == MAX_DIVISIONS or cells.comm.allreduce(len(ahead.cell)) > MAX_PARTS
        rest, left = list[SubCells](), list[Array]()
        for now, before in zip(ahead.batches(), whole, strict=True):
            smaller = now.divided()
            X, w, area, f = evaluated(smaller)
            fine = integrals(w, f)
            error = scale[now.cell] * np.linalg.norm(
                fine.reshape(len(before), each, -1).sum(axis=1) - before, axis=1
            )
            done = (error <= threshold) | last
            errors += float((error[done & (now.cell < cells.owned)] ** 2).sum())
            kept = np.repeat(done, each)
            at, size = number[smaller.cell[kept]], np.linalg.norm(f[kept], axis=-1)
            if len(at):  # Basix tabulates no empty set of points
                phi = space.tabulate(0, X[kept].reshape(-1, X.shape[-1]))[0, :, :, 0].reshape(
                    *size.shape, space.dim
                )
                np.add.at(
                    by_cell, at, np.matmul(np.swapaxes(w[kept][..., None] * phi, 1, 2), f[kept])
                )
                np.add.at(sizes, at, (area[kept] * size).sum(axis=1))
                np.add.at(squares, at, (w[kept] * size**2).sum(axis=1))
            rest.append(smaller[~kept])
            left.append(fine[~kept])
        ahead = SubCells.concatenate(rest) if rest else ahead
        if not cells.comm.allreduce(len(ahead.cell)):
            break
        together = np.concatenate([np.empty((0, components)), *left])
        whole = [together[i : i + BATCH_SIZE] for i in range(0, len(together), BATCH_SIZE)]
    return by_cell, sizes, squares, float(np.sqrt(cells.comm.allreduce(errors)))


def _bounded(at_nodes: Array, mean: Array, between: Array, f: Array) -> Array:
    """Polynomials (cells, nodes, components) drawn towards their means until they have no values
    that f has not.
    """
    low, high = f.min(axis=1, keepdims=True), f.max(axis=1, keepdims=True)
    every = np.concatenate([at_nodes, between], axis=1)
    share = np.ones_like(mean)
    for bound, extreme in (
        (low, every.min(axis=1, keepdims=True)),
        (high, every.max(axis=1, keepdims=True)),
    ):
        away = extreme - mean
        share = np.minimum(
            share, np.where(np.abs(away) > 0, (bound - mean) / np.where(away == 0, 1.0, away), 1.0)
        )
    return np.asarray(mean + np.clip(share, 0.0, 1.0) * (at_nodes - mean))

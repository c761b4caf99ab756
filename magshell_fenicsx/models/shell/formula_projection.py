"""Formulas on cells: interpolated where smooth, else the polynomials with the same moments.

A formula that varies within a cell, or jumps there, is not what its values at the nodes show: a
load on a disc between the nodes would vanish. The polynomial p of the displacement's degree k with

    integral of p q = integral of f q    over the cell, for each polynomial q of the degree k,

does the same work on every displacement, up to the curvature of the cell. Its integrals come from
parts of the cell that are divided until each agrees with its own parts. Where f is a polynomial of
the degree k, p is f.

- In: f as a function of places and normals, and the cells. Out: nodal values of the polynomials.
- Cells are those of a surface, a meridian, an edge or a body; d is their dimension.
- A part is a piece of a cell of the same kind, by its image in the reference cell. Its own parts,
  or children, are the pieces that it is divided into.
- Samples are the values of f at the quadrature points of all cells' first parts; detail that they
  miss is hidden. `refine_where_hidden` finds it by ranges of the formulas in boxes.
- `scale` is the size of a cell over the size of the reference cell.
- The variation of f is the integral of |f - its mean|.
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
        Element of the placement.
    nodal
        (cells, nodes, 3) of a surface, an edge (without normals) or a body, of whose cells the
        third axis is across; (cells, nodes, 2) of a meridian, rho and z.
    owned
        Number of cells that this rank owns; they come first.
    comm
        The ranks that share the cells.
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
        """Return places and normals (cells, n, 3), and the ratio of sizes (cells, n).

        The ratio is the length or area over that of the reference cell. On a meridian it is rho
        times the length, so that integrals are per radian around the axis. Normals on an edge are
        zero.

        Parameters
        ----------
        X
            Reference points (n, dimension), or (cells, n, dimension) in each cell.
        cells
            Numbers of the cells; by default all.
        """
        nodal, d = self.nodal[cells], self.dimension
        # values and first derivatives of the shape functions, then of the place
        table = self.element.tabulate(1, X.reshape(-1, d))[..., 0]
        table = table.reshape(1 + d, *X.shape[:-1], nodal.shape[1])
        x, *slopes = (np.matmul(derivative_table, nodal) for derivative_table in table)
        if d == 1 and x.shape[-1] == 3:  # an edge in space
            return x, np.zeros_like(x), np.linalg.norm(slopes[0], axis=-1)
        if d == 1:  # a meridian
            (rho, z), (rho_s, z_s) = np.moveaxis(x, -1, 0), np.moveaxis(slopes[0], -1, 0)
            length = np.hypot(rho_s, z_s)
            normals = np.stack([-z_s, 0 * z_s, rho_s], axis=-1) / length[..., None]
            return np.stack([rho, 0 * rho, z], axis=-1), normals, rho * length
        # a surface, or the surfaces across the third axis of a body's cells
        m = np.cross(slopes[0], slopes[1])
        area = np.linalg.norm(m, axis=-1)
        return x, m / area[..., None], area

    def sum_over_ranks(self, of_cells: Array) -> Array:
        """Return the sum of values (cells, ...) over the owned cells of all ranks; collective."""
        return np.asarray(self.comm.allreduce(of_cells[: self.owned].sum(axis=0)))


@dataclass(frozen=True)
class ProjectedFormula:
    """A formula on cells.

    Attributes
    ----------
    nodal
        (cells, nodes, components) values; in cells where the formula is smooth, the interpolant's.
    smooth
        Whether the formula is smooth everywhere, on all ranks.
    size
        Integral of |f|.
    missed
        Error that integrals of f may still have, over that of |f|.
    rest
        The error of the polynomials p: root of the integral of |f - p|^2 over that of |f|^2.
    widest
        Largest side of the cells that contribute a visible part to `rest`.
    open
        Part of the integral of |f| that samples may have missed, if it is more than allowed.
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
    """Return a formula on cells: its interpolant, or polynomials with the same moments; collective.

    Parameters
    ----------
    values
        Function of places and normals (cells, n, 3) -> values (cells, n, components).
    cells
        The cells of this rank.
    nodal, element
        Values (cells, nodes, components) at the nodes of the element.
    degree
        Degree of the polynomials with the same moments, at most that of the element.
    bounded
        Whether the polynomials stay between the least and the largest value in a cell; of their
        moments only the first is then kept.
    formulas
        Formulas that vary, whose ranges show what happens between the places; None without.

    Notes
    -----
    Only cells in which the interpolant is off, or which hide detail, get new polynomials.
    """
    X, weights = (v.reshape(-1, *v.shape[2:]) for v in sampling_points(cells))
    x, normals, area_ratio = cells.evaluate(X)
    f = values(x, normals)
    interpolated = np.matmul(element.tabulate(0, X)[0, :, :, 0], nodal)
    interpolation_error = np.linalg.norm(interpolated - f, axis=-1)
    magnitude, area = np.linalg.norm(f, axis=-1), area_ratio * weights
    sizes = (area * magnitude).sum(axis=1)
    errors = (area * interpolation_error).sum(axis=1)
    squares = (area * magnitude**2).sum(axis=1)
    sums = cells.sum_over_ranks(np.stack([sizes, errors, squares], axis=-1))
    size, total_error, total_square = map(float, sums)
    scale = area.sum(axis=1) / weights.sum()
    if formulas:
        # integrals over the reference cell from samples, which the parts' integrals may contradict
        detail = _find_hidden_detail(values, formulas, cells, np.einsum("q,cqi->ci", weights, f))
    else:
        detail = _HiddenDetail.without_detail(len(scale))
    hidden_by_cell = scale * detail.hidden
    hidden_integral = float(cells.sum_over_ranks(hidden_by_cell))
    size += hidden_integral
    is_off = total_error + hidden_integral > INTERPOLATION_TOLERANCE * size
    hides_detail = hidden_integral > INTERPOLATION_TOLERANCE * detail.variation
    if not (is_off or hides_detail):
        return ProjectedFormula(nodal, smooth=True, size=size, open=detail.open)
    largest = cells.comm.allreduce(float(magnitude.max(initial=0.0)), MPI.MAX)
    projected_cells = np.flatnonzero(
        (interpolation_error @ weights > SMOOTH_CELL_TOLERANCE * largest * weights.sum())
        | (hidden_by_cell > PART_TOLERANCE * size)
    )
    first_parts = detail.parts_of(projected_cells, _uniform_parts(cells))
    space = basix.create_element(
        basix.ElementFamily.P, element.cell_type, degree, basix.LagrangeVariant.gll_warped
    )
    moments, sizes[projected_cells], reference_squares, missed = _moments(
        values,
        cells,
        projected_cells,
        scale,
        first_parts,
        PART_TOLERANCE * size,
        space,
        nodal.shape[-1],
    )
    Y, v = basix.make_quadrature(element.cell_type, 2 * degree)
    phi = space.tabulate(0, Y)[0, :, :, 0]
    # p with these moments: mass matrix of the reference cell (rule Y, v) times p = moments
    coefficients = np.linalg.solve(phi.T @ (v[:, None] * phi), moments)
    residual_squares = np.zeros(len(scale))
    # integral of |f|² less that of |p|²: p is an orthogonal projection of f
    lost_squares = reference_squares - np.einsum("q,cqi->c", v, np.matmul(phi, coefficients) ** 2)
    residual_squares[projected_cells] = scale[projected_cells] * np.maximum(lost_squares, 0.0)
    size = float(cells.sum_over_ranks(sizes))
    total_residual = float(cells.sum_over_ranks(residual_squares))
    side = np.sqrt(2.0) * scale ** (1 / min(cells.dimension, 2))
    visible_sides = side[residual_squares > VISIBLE_SHARE * total_residual]
    widest = cells.comm.allreduce(float(visible_sides.max(initial=0.0)), MPI.MAX)
    at_nodes = np.matmul(space.tabulate(0, element.points)[0, :, :, 0], coefficients)
    if bounded:
        mean = np.einsum("q,cqi->ci", v, np.matmul(phi, coefficients))[:, None] / v.sum()
        at_samples = np.matmul(space.tabulate(0, X)[0, :, :, 0], coefficients)
        at_nodes = _bounded(at_nodes, mean, at_samples, f[projected_cells])
    new_nodal = nodal.copy()
    new_nodal[projected_cells] = at_nodes
    squares[projected_cells] = scale[projected_cells] * reference_squares
    smallest_positive = np.finfo(float).tiny  # for a formula that is zero but on a line
    largest_square = max(total_square, float(cells.sum_over_ranks(squares)), smallest_positive)
    return ProjectedFormula(
        new_nodal,
        smooth=False,
        size=size,
        missed=missed / max(size, smallest_positive),
        rest=float(np.sqrt(total_residual / largest_square)),
        widest=widest,
        open=detail.open,
    )


def _uniform_parts(cells: CellGeometry) -> SubCells:
    """Return the parts of one cell, number 0, in which every cell is sampled at first."""
    d = cells.dimension
    parts = SubCells(np.zeros(1, np.int64), np.zeros((1, d)), np.ones((1, d)))
    for _ in range(FIRST_DIVISIONS[d]):
        parts = parts.divided()
    return parts


def sampling_points(cells: CellGeometry) -> tuple[Array, Array]:
    """Return points (parts, q, d) in the reference cell for samples, and weights (parts, q)."""
    return _uniform_parts(cells).rule(
        *basix.make_quadrature(cells.element.cell_type, RULE_DEGREE[cells.dimension])
    )


@dataclass(frozen=True)
class _HiddenDetail:
    """Detail of formulas that the samples of whole cells do not show.

    Attributes
    ----------
    hidden
        (cells,) difference of integrals over the reference cell from those of the samples.
    variation
        The integral of |f - its mean|.
    parts, is_divided
        Parts of divided cells, and flags (cells,) of the cells that are divided.
    open
        See `ProjectedFormula`.
    """

    hidden: Array
    variation: float
    parts: SubCells
    is_divided: NDArray[np.bool_]
    open: float

    @classmethod
    def without_detail(
        cls, cells: int, variation: float = 0.0, open_: float = 0.0
    ) -> "_HiddenDetail":
        """Return an object for a number of cells that hide nothing."""
        no_parts = SubCells(np.empty(0, np.int64), np.empty((0, 0)), np.empty((0, 0)))
        return cls(np.zeros(cells), variation, no_parts, np.zeros(cells, bool), open_)

    def parts_of(self, cells: Numbers, uniform_parts: SubCells) -> SubCells:
        """Return the parts of some cells with which the integration of moments begins.

        Cells that the search has divided have its parts, divided further until no part is larger
        than a uniform one. Other cells have the uniform parts, given for one cell.
        """
        is_divided = self.is_divided[cells]
        if not is_divided.any():
            return uniform_parts.in_each_cell(cells)
        parts = self.parts[np.isin(self.parts.cell, cells)]
        largest = 1.001 * np.abs(uniform_parts.sides[0, 0])  # with a margin for rounding
        # in each pass small parts are set aside, and the others are divided
        small_parts, too_wide = list[SubCells](), np.abs(parts.sides[:, 0]) > largest
        while too_wide.any():
            small_parts.append(parts[~too_wide])
            parts = parts[too_wide].divided()
            too_wide = np.abs(parts.sides[:, 0]) > largest
        parts_of_others = uniform_parts.in_each_cell(cells[~is_divided])
        return SubCells.concatenate([parts_of_others, *small_parts, parts])


def _find_hidden_detail(
    values: Values, formulas: FormulaGroup, cells: CellGeometry, sampled_integrals: Array
) -> _HiddenDetail:
    """Return what samples of whole cells miss, by an adaptive search for hidden detail; collective.

    `refine_where_hidden` divides cells into parts until samples in these miss nothing. Integrals of
    f over the parts are compared with `sampled_integrals` (cells, components) over the reference
    cell.
    """
    d, kind = cells.dimension, cells.element.cell_type
    lattice = Lattice.make(kind, LATTICE_DIVISIONS[d])
    points, weights = basix.make_quadrature(kind, RULE_DEGREE[d])

    def places_of(parts: SubCells) -> tuple[Array, Array]:
        """Return the lattice's places (parts, n, 3) in each part, and the areas (parts,)."""
        # the lattice has no weights of its own: equal ones give a part's area
        place_count = len(lattice.places)
        X, w = parts.rule(lattice.places, np.full(place_count, weights.sum() / place_count))
        x, _, area = cells.evaluate(X, parts.cell)
        return x, (area * w).sum(axis=1)

    reference_cell = SubCells(np.zeros(1, np.int64), np.zeros((1, d)), np.ones((1, d)))
    whole_cells = reference_cell.in_each_cell(np.arange(len(cells.nodal)))
    refined = refine_where_hidden(
        formulas, whole_cells, places_of, lattice, cells.owned, cells.comm
    )
    # a divided cell has parts that are smaller than the whole cell
    is_smaller = np.abs(refined.parts.sides[:, 0]) < 1
    parts = refined.parts[is_smaller]
    is_divided = np.zeros(len(cells.nodal), bool)
    is_divided[parts.cell] = True
    # integrals over divided cells are sums over their parts, others are those of the samples
    integrals = np.where(is_divided[:, None], 0.0, sampled_integrals)
    for batch in parts.batches():
        X, w = batch.rule(points, weights)
        x, normals, _ = cells.evaluate(X, batch.cell)
        np.add.at(integrals, batch.cell, np.einsum("pq,pqi->pi", w, values(x, normals)))
    differences = np.linalg.norm(integrals - sampled_integrals, axis=1)
    if not cells.sum_over_ranks(differences) > 0:
        return _HiddenDetail.without_detail(len(differences), refined.variation, refined.open)
    return _HiddenDetail(differences, refined.variation, parts, is_divided, refined.open)


def _moments(
    values: Values,
    cells: CellGeometry,
    projected_cells: Numbers,
    scale: Array,
    first_parts: SubCells,
    threshold: float,
    space: Element,
    components: int,
) -> tuple[Array, Array, Array, float]:
    """Integrate f times polynomials over cells, by parts that are divided as far as needed.

    A part is divided until its integral agrees with the sum over its own parts, whose integrals are
    then added up. Collective.

    Parameters
    ----------
    values, cells
        See `project_formula`.
    projected_cells
        Numbers of the cells.
    scale
        (all cells,) size of each cell over that of the reference cell.
    first_parts
        Parts with which the division begins.
    threshold
        Largest difference of a part's integral, over the surface, from that of its own parts.
    space
        Element of the functions in the moments.
    components
        Number of components of f.

    Returns
    -------
    moments
        (projected cells, functions, components): integrals of f times each function of the space,
        over the reference cell.
    sizes, squares
        (projected cells,): integral of |f| over the surface, and of |f|^2 over the reference cell.
    error
        Estimated error of the integrals over the surface, of all ranks.
    """
    points, weights = basix.make_quadrature(space.cell_type, RULE_DEGREE[cells.dimension])
    # row of each projected cell in the results
    number = np.zeros(len(cells.nodal), np.int64)
    number[projected_cells] = np.arange(len(projected_cells))

    def evaluated(batch: SubCells) -> tuple[Array, Array, Array, Array]:
        """Return points X, weights w, weights times area ratios, and values f in each part.

        Sums with w are integrals over the reference cell, sums with the third over the surface.
        """
        X, w = batch.rule(points, weights)
        x, normals, area = cells.evaluate(X, batch.cell)
        return X, w, area * w, values(x, normals)

    def integrals(w: Array, f: Array) -> Array:
        """Return the integrals (parts, components) of f over the parts, in the reference cell."""
        return np.asarray(np.einsum("pq,pqi->pi", w, f))

    moments = np.zeros((len(projected_cells), space.dim, components))
    sizes = np.zeros(len(projected_cells))
    squares = np.zeros(len(projected_cells))
    errors = 0.0
    children = len(CHILDREN[cells.dimension])
    coarse_integrals = [integrals(w, f) for _, w, _, f in map(evaluated, first_parts.batches())]
    for depth in range(MAX_DIVISIONS + 1):
        is_last = depth == MAX_DIVISIONS or cells.comm.allreduce(len(first_parts.cell)) > MAX_PARTS
        divided_parts, divided_integrals = list[SubCells](), list[Array]()
        for batch, batch_integrals in zip(first_parts.batches(), coarse_integrals, strict=True):
            smaller = batch.divided()
            X, w, area, f = evaluated(smaller)
            child_integrals = integrals(w, f)
            # difference of a part's integral from the sum over its own parts
            error = scale[batch.cell] * np.linalg.norm(
                child_integrals.reshape(len(batch_integrals), children, -1).sum(axis=1)
                - batch_integrals,
                axis=1,
            )
            converged = (error <= threshold) | is_last
            errors += float((error[converged & (batch.cell < cells.owned)] ** 2).sum())
            is_added = np.repeat(converged, children)
            cell_numbers = number[smaller.cell[is_added]]
            size = np.linalg.norm(f[is_added], axis=-1)
            if len(cell_numbers):  # Basix tabulates no empty set of points
                phi = space.tabulate(0, X[is_added].reshape(-1, X.shape[-1]))[0, :, :, 0].reshape(
                    *size.shape, space.dim
                )
                np.add.at(
                    moments,
                    cell_numbers,
                    np.matmul(np.swapaxes(w[is_added][..., None] * phi, 1, 2), f[is_added]),
                )
                np.add.at(sizes, cell_numbers, (area[is_added] * size).sum(axis=1))
                np.add.at(squares, cell_numbers, (w[is_added] * size**2).sum(axis=1))
            divided_parts.append(smaller[~is_added])
            divided_integrals.append(child_integrals[~is_added])
        first_parts = SubCells.concatenate(divided_parts) if divided_parts else first_parts
        if not cells.comm.allreduce(len(first_parts.cell)):
            break
        all_integrals = np.concatenate([np.empty((0, components)), *divided_integrals])
        coarse_integrals = [
            all_integrals[i : i + BATCH_SIZE] for i in range(0, len(all_integrals), BATCH_SIZE)
        ]
    return moments, sizes, squares, float(np.sqrt(cells.comm.allreduce(errors)))


def _bounded(at_nodes: Array, mean: Array, inner_values: Array, f: Array) -> Array:
    """Contract polynomials towards their means until all values are within the range of f.

    A factor of the deviation from the mean is found for each cell and component. It keeps the mean,
    which is the first moment.

    Parameters
    ----------
    at_nodes
        (cells, nodes, components) the polynomials.
    mean
        (cells, 1, components) their means.
    inner_values
        (cells, n, components) the polynomials at samples.
    f
        (cells, n, components) the formula at samples.
    """
    low, high = f.min(axis=1, keepdims=True), f.max(axis=1, keepdims=True)
    all_values = np.concatenate([at_nodes, inner_values], axis=1)
    smallest = all_values.min(axis=1, keepdims=True)
    largest = all_values.max(axis=1, keepdims=True)
    contraction = np.ones_like(mean)
    for limit, extreme in ((low, smallest), (high, largest)):
        # the factor that takes the extreme value to its limit; 1 for a constant polynomial
        deviation = extreme - mean
        divisor = np.where(deviation == 0, 1.0, deviation)
        factor = np.where(np.abs(deviation) > 0, (limit - mean) / divisor, 1.0)
        contraction = np.minimum(contraction, factor)
    return np.asarray(mean + np.clip(contraction, 0.0, 1.0) * (at_nodes - mean))

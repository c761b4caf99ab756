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
from dataclasses import dataclass, replace
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

    Only cells in which the interpolant is off, or which hide detail, get polynomials.

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
        Whether polynomials stay in the range of f in each cell; only the first moment is then kept.
    formulas
        Formulas that vary, whose ranges show what happens between the places; None without.
    """
    samples = _sample_cells(values, cells, nodal, element)
    size, total_error, total_square = samples.totals(cells)
    # what the integrals from these samples miss in each cell
    scale, detail = samples.scale, _HiddenDetail.without_detail(len(cells.nodal))
    if formulas:
        detail = _find_hidden_detail(values, formulas, cells, samples.reference_integrals)
    hidden_by_cell = scale * detail.hidden
    hidden_integral = float(cells.sum_over_ranks(hidden_by_cell))
    size += hidden_integral
    is_off = total_error + hidden_integral > INTERPOLATION_TOLERANCE * size
    hides_detail = hidden_integral > INTERPOLATION_TOLERANCE * detail.variation
    if not (is_off or hides_detail):
        return ProjectedFormula(nodal, smooth=True, size=size, open=detail.open)
    # the cells that get polynomials, and the parts with which their integration begins
    threshold = PART_TOLERANCE * size
    projected_cells = np.flatnonzero(samples.is_off(cells.comm) | (hidden_by_cell > threshold))
    first_parts = detail.parts_of(projected_cells, _uniform_parts(cells))
    space, rule = _polynomial_space(element, degree), _PartRule.of_cells(values, cells)
    integrals = _moments(
        rule, projected_cells, scale, first_parts, threshold, space, nodal.shape[-1]
    )
    polynomials = _ProjectedPolynomials.with_moments(space, degree, integrals.moments)
    at_nodes = polynomials.at(element.points)
    if bounded:
        at_nodes = polynomials.bounded(at_nodes, samples.X, samples.f[projected_cells])
    new_nodal = nodal.copy()
    new_nodal[projected_cells] = at_nodes
    formula = ProjectedFormula(new_nodal, smooth=False, size=size, open=detail.open)
    return _with_errors(
        formula, cells, samples, projected_cells, integrals, polynomials, total_square
    )


def _polynomial_space(element: Element, degree: int) -> Element:
    """Return the Lagrange element of a degree on the cells of another element."""
    return basix.create_element(
        basix.ElementFamily.P, element.cell_type, degree, basix.LagrangeVariant.gll_warped
    )


def _with_errors(
    formula: ProjectedFormula,
    cells: CellGeometry,
    samples: "_CellSamples",
    projected_cells: Numbers,
    integrals: "_Moments",
    polynomials: "_ProjectedPolynomials",
    total_square: float,
) -> ProjectedFormula:
    """Return a projected formula with its size and with the errors that are left; collective.

    Parameters
    ----------
    samples
        The formula at samples of all cells.
    projected_cells, integrals, polynomials
        Numbers of the cells with polynomials p, the integrals of f over these, and p.
    total_square
        Integral of |f|^2 from samples.
    """
    sizes, squares, scale = samples.sizes, samples.squares, samples.scale
    sizes[projected_cells] = integrals.sizes
    # integral of |f|^2 less that of |p|^2: as p is an orthogonal projection of f, this is that of
    # |f - p|^2, but for rounding
    lost_squares = integrals.squares - polynomials.squares
    residual_squares = np.zeros(len(scale))
    residual_squares[projected_cells] = scale[projected_cells] * np.maximum(lost_squares, 0.0)
    size = float(cells.sum_over_ranks(sizes))
    total_residual = float(cells.sum_over_ranks(residual_squares))
    # the largest side of a cell that leaves a visible part of the residual
    side = np.sqrt(2.0) * scale ** (1 / min(cells.dimension, 2))
    visible_sides = side[residual_squares > VISIBLE_SHARE * total_residual]
    widest = cells.comm.allreduce(float(visible_sides.max(initial=0.0)), MPI.MAX)
    squares[projected_cells] = scale[projected_cells] * integrals.squares
    smallest_positive = np.finfo(float).tiny  # for a formula that is zero but on a line
    largest_square = max(total_square, float(cells.sum_over_ranks(squares)), smallest_positive)
    return replace(
        formula,
        size=size,
        missed=integrals.error / max(size, smallest_positive),
        rest=float(np.sqrt(total_residual / largest_square)),
        widest=widest,
    )


@dataclass(frozen=True)
class _CellSamples:
    """A formula f at quadrature points of all cells, and how far its interpolant is off there.

    Attributes
    ----------
    X, weights
        (q, d) and (q,): the rule on the reference cell.
    f, magnitude
        (cells, q, components) values, and (cells, q) their norms.
    error
        (cells, q) norm of the interpolant less f.
    area
        (cells, q) weights times the sizes of the cells over that of the reference cell.
    """

    X: Array
    weights: Array
    f: Array
    magnitude: Array
    error: Array
    area: Array

    @property
    def sizes(self) -> Array:
        """(cells,) integral of |f|."""
        return np.asarray((self.area * self.magnitude).sum(axis=1))

    @property
    def errors(self) -> Array:
        """(cells,) integral of |interpolant - f|."""
        return np.asarray((self.area * self.error).sum(axis=1))

    @property
    def squares(self) -> Array:
        """(cells,) integral of |f|^2."""
        return np.asarray((self.area * self.magnitude**2).sum(axis=1))

    def totals(self, cells: CellGeometry) -> tuple[float, float, float]:
        """Return the sums of `sizes`, `errors` and `squares` over the cells of all ranks."""
        sums = cells.sum_over_ranks(np.stack([self.sizes, self.errors, self.squares], axis=-1))
        size, error, square = map(float, sums)
        return size, error, square

    @property
    def reference_integrals(self) -> Array:
        """(cells, components) integral of f over the reference cell, from these samples."""
        return np.asarray(np.einsum("q,cqi->ci", self.weights, self.f))

    @property
    def scale(self) -> Array:
        """(cells,) size of each cell over that of the reference cell."""
        return np.asarray(self.area.sum(axis=1) / self.weights.sum())

    def is_off(self, comm: MPI.Comm) -> NDArray[np.bool_]:
        """Return whether the interpolant is off in each cell (cells,), by the mean of its error.

        It is compared with the largest |f| on all ranks; collective.
        """
        largest = comm.allreduce(float(self.magnitude.max(initial=0.0)), MPI.MAX)
        allowed = SMOOTH_CELL_TOLERANCE * largest * self.weights.sum()
        return np.asarray(self.error @ self.weights > allowed)


def _sample_cells(
    values: Values, cells: CellGeometry, nodal: Array, element: Element
) -> _CellSamples:
    """Return samples of a formula in all cells, with the error of its interpolant `nodal`."""
    X, weights = (v.reshape(-1, *v.shape[2:]) for v in sampling_points(cells))
    x, normals, area_ratio = cells.evaluate(X)
    f = values(x, normals)
    interpolated = np.matmul(element.tabulate(0, X)[0, :, :, 0], nodal)
    error = np.linalg.norm(interpolated - f, axis=-1)
    magnitude, area = np.linalg.norm(f, axis=-1), area_ratio * weights
    return _CellSamples(X, weights, f, magnitude, error, area)


@dataclass(frozen=True)
class _ProjectedPolynomials:
    """Polynomials p on some cells.

    Attributes
    ----------
    space
        Element of the functions on the reference cell.
    coefficients
        (cells, functions, components) of p.
    weights, at_points
        (q,) and (cells, q, components): weights of a rule, and p at its points.
    """

    space: Element
    coefficients: Array
    weights: Array
    at_points: Array

    @classmethod
    def with_moments(cls, space: Element, degree: int, moments: Array) -> "_ProjectedPolynomials":
        """Return the polynomials of a degree with moments (cells, functions, components)."""
        Y, v = basix.make_quadrature(space.cell_type, 2 * degree)
        phi = space.tabulate(0, Y)[0, :, :, 0]
        # mass matrix of the reference cell (rule Y, v) times p = moments
        coefficients = np.linalg.solve(phi.T @ (v[:, None] * phi), moments)
        return cls(space, coefficients, v, np.matmul(phi, coefficients))

    def at(self, X: Array) -> Array:
        """Return p at reference points X (n, d), (cells, n, components)."""
        return np.asarray(np.matmul(self.space.tabulate(0, X)[0, :, :, 0], self.coefficients))

    @property
    def squares(self) -> Array:
        """(cells,) integral of |p|^2 over the reference cell."""
        return np.asarray(np.einsum("q,cqi->c", self.weights, self.at_points**2))

    def bounded(self, at_nodes: Array, X: Array, f: Array) -> Array:
        """Return the values of p at nodes, contracted to the range of f in each cell.

        Parameters
        ----------
        at_nodes
            (cells, nodes, components) values of p.
        X, f
            Reference points (n, d) of samples, and the formula there, (cells, n, components).
        """
        v = self.weights
        mean = np.einsum("q,cqi->ci", v, self.at_points)[:, None] / v.sum()
        return _bounded(at_nodes, mean, self.at(X), f)


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
        Part of the integral of |f| that samples may have missed, if it is more than allowed.
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


@dataclass(frozen=True)
class _PartSamples:
    """A formula at the quadrature points of some parts of cells.

    Attributes
    ----------
    X, f
        (parts, q, d) points in the reference cell, and (parts, q, components) values there.
    weights, area
        (parts, q) weights for integrals over the reference cell, and over the surface.
    """

    X: Array
    weights: Array
    area: Array
    f: Array

    @property
    def integrals(self) -> Array:
        """(parts, components) integral of f over each part, in the reference cell."""
        return np.asarray(np.einsum("pq,pqi->pi", self.weights, self.f))

    def select(self, flags: NDArray[np.bool_]) -> "_PartSamples":
        """Return the samples of selected parts, by flags (parts,)."""
        return _PartSamples(self.X[flags], self.weights[flags], self.area[flags], self.f[flags])


@dataclass(frozen=True)
class _PartRule:
    """A quadrature rule on parts of cells, for a formula.

    Attributes
    ----------
    values, cells
        The formula as a function of places and normals, and the cells.
    points, weights
        The rule on the reference cell.
    """

    values: Values
    cells: CellGeometry
    points: Array
    weights: Array

    @classmethod
    def of_cells(cls, values: Values, cells: CellGeometry) -> "_PartRule":
        """Return the rule for parts of cells of their dimension."""
        degree = RULE_DEGREE[cells.dimension]
        return cls(values, cells, *basix.make_quadrature(cells.element.cell_type, degree))

    def samples(self, parts: SubCells) -> _PartSamples:
        """Return the formula at the points of the rule on each part."""
        X, w = parts.rule(self.points, self.weights)
        x, normals, area_ratio = self.cells.evaluate(X, parts.cell)
        return _PartSamples(X, w, area_ratio * w, self.values(x, normals))


@dataclass(frozen=True)
class _Moments:
    """Integrals of a formula f over some cells.

    Attributes
    ----------
    moments
        (cells, functions, components) of f times each function, over the reference cell.
    sizes, squares
        (cells,) of |f| over the surface, and of |f|^2 over the reference cell.
    error
        Estimated error of the integrals over the surface, of all ranks.
    """

    moments: Array
    sizes: Array
    squares: Array
    error: float = 0.0

    def add(self, rows: Numbers, samples: _PartSamples, space: Element) -> None:
        """Add integrals over parts to those of their cells, which stand in the `rows` (parts,)."""
        if not len(rows):  # Basix tabulates no empty set of points
            return
        X, w, f = samples.X, samples.weights, samples.f
        size = np.linalg.norm(f, axis=-1)
        phi = space.tabulate(0, X.reshape(-1, X.shape[-1]))[0, :, :, 0].reshape(
            *size.shape, space.dim
        )
        part_moments = np.matmul(np.swapaxes(w[..., None] * phi, 1, 2), f)
        np.add.at(self.moments, rows, part_moments)
        np.add.at(self.sizes, rows, (samples.area * size).sum(axis=1))
        np.add.at(self.squares, rows, (w * size**2).sum(axis=1))


def _moments(
    rule: _PartRule,
    projected_cells: Numbers,
    scale: Array,
    first_parts: SubCells,
    threshold: float,
    space: Element,
    components: int,
) -> _Moments:
    """Integrate f times the functions of a space over cells, by parts; collective.

    A part is divided until its integral agrees with the sum over its own parts, the children. Then
    the integrals over these are added to those of the cell.

    Parameters
    ----------
    scale
        (all cells,) size of each cell over that of the reference cell.
    threshold
        Largest difference of a part's integral, over the surface, from that of its children.
    components
        Number of components of f.
    """
    cells, count = rule.cells, len(projected_cells)
    row_of_cell = np.zeros(len(cells.nodal), np.int64)
    row_of_cell[projected_cells] = np.arange(count)
    result = _Moments(np.zeros((count, space.dim, components)), np.zeros(count), np.zeros(count))
    parts, children, errors = first_parts, len(CHILDREN[cells.dimension]), 0.0
    # integrals over the parts themselves, by batches
    integrals = [rule.samples(batch).integrals for batch in parts.batches()]
    for depth in range(MAX_DIVISIONS + 1):
        is_last = depth == MAX_DIVISIONS or cells.comm.allreduce(len(parts.cell)) > MAX_PARTS
        divided_parts, divided_integrals = list[SubCells](), list[Array]()
        for batch, batch_integrals in zip(parts.batches(), integrals, strict=True):
            smaller = batch.divided()
            samples = rule.samples(smaller)
            child_integrals = samples.integrals
            sums = child_integrals.reshape(len(batch_integrals), children, -1).sum(axis=1)
            error = scale[batch.cell] * np.linalg.norm(sums - batch_integrals, axis=1)
            converged = (error <= threshold) | is_last
            errors += float((error[converged & (batch.cell < cells.owned)] ** 2).sum())
            is_added = np.repeat(converged, children)
            result.add(row_of_cell[smaller.cell[is_added]], samples.select(is_added), space)
            divided_parts.append(smaller[~is_added])
            divided_integrals.append(child_integrals[~is_added])
        parts = SubCells.concatenate(divided_parts) if divided_parts else parts
        if not cells.comm.allreduce(len(parts.cell)):
            break
        all_integrals = np.concatenate([np.empty((0, components)), *divided_integrals])
        starts = range(0, len(all_integrals), BATCH_SIZE)
        integrals = [all_integrals[i : i + BATCH_SIZE] for i in starts]
    return replace(result, error=float(np.sqrt(cells.comm.allreduce(errors))))


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

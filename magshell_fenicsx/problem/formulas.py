"""Formulas of a case at undeformed places: their bounds, and the element sizes that resolve them.

A formula may vary within narrow parts of the surface. Squares of the chart are divided until
polynomials resolve the formula in each, which gives the element sizes there. An adaptive division
of the surface finds places that samples may miss. After meshing, `unresolved_formulas` reports what
the cells miss. Lengths are over R.

The chart is the pair of coordinates of the surface; squares are parts of it. A division is the
surface cut into adaptive cells (`RefinedParts`), which are small where a formula varies; its parts
that are divided no further are leaves. The variance is the integral of (f - mean)² of all formulas
f. An outline is the perfect surface with its chart. R is the reference length, h the thickness. A
formula group is the list of the formulas of one key. Q turns the frame of the model, which may be
turned about e3, into the one of the case.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import ceil, inf, sqrt

import basix
import numpy as np
import scipy
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.input.expressions import FormulaGroup, formula
from magshell_fenicsx.input.messages import shown_value
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.grading import PER_AREA, SquaresFeature
from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.mesh.msh import MeshFile, read_msh, space_embedding
from magshell_fenicsx.mesh.patch import PatchMesh
from magshell_fenicsx.mesh.shapes import DiscShape, PlaneShape, StripShape
from magshell_fenicsx.models.shell.adaptive_sampling import (
    Lattice,
    RefinedParts,
    SubCells,
    refine_where_hidden,
)
from magshell_fenicsx.models.shell.formula_projection import (
    CellGeometry,
    project_formula,
    sampling_points,
)
from magshell_fenicsx.models.shell.thickness import MAX_THICKNESS_FACTOR, MIN_THICKNESS_FACTOR
from magshell_fenicsx.parts.ability import Context, Formulas
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionGeometry
from magshell_fenicsx.shape.outline import ANY_GRADING, Outline

Array = NDArray[np.float64]
Masks = NDArray[np.bool_]
# places (squares, n, 3) over R, whether each is on the chart, side of the squares -> element sizes
Sizes = Callable[[Array, Masks, float], Array]
THICKNESS = "shell.thickness_factor"
SAMPLES = 20  # along each side of a square of the chart
LOCAL = (
    np.stack(np.meshgrid(*[np.arange(SAMPLES)] * 2, indexing="ij"), axis=-1).reshape(-1, 2) + 0.5
) / SAMPLES - 0.5  # (n, 2) samples of a square of side one around the origin
DEGREE = 4  # of the polynomials that are compared
_POWERS = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
BASIS = np.linalg.qr(
    np.stack([(2 * LOCAL[:, 0]) ** i * (2 * LOCAL[:, 1]) ** j for i, j in _POWERS], axis=-1)
)[0]
FIRST_SIDE = 0.2  # over R: largest side of the first squares
MAX_FIRST_SQUARES, MAX_SQUARES = 800, 3000  # at the beginning, and of one size later
LOAD_SIZE = 0.25  # over sqrt(Rh): elements of this size resolve loads
MIN_SQUARE = 0.1  # over h: the least square of formulas that are no loads
MIN_IMPERFECTION_SQUARE = 0.25  # over h
INTEGRAL_TOLERANCE = 1e-3  # of the integral of a formula's size, which cells may miss
SQUARE_TOLERANCE = 0.02  # of the integral of its square, which cells may miss
STIFFNESS_TOLERANCE = 1e-3  # which cells may miss by a thickness that varies within them
VARIANCE_TOLERANCE = 0.003  # of a formula: what polynomials on squares may miss of it
GRADED_MESH_GAIN = 0.5  # of as many elements as equal ones: then a graded mesh is worth while
RESOLVED_LOAD = 4.0  # times LOAD_SIZE sqrt(Rh): larger elements smooth a load
MIN_EXTENT = 1e-9  # over R, of a surface along an axis
CELL_SAMPLES = 6  # along each side of an adaptive cell
SAMPLED_SHARE = 0.5  # of the integral of a formula's square, below which samples miss it
NARROW_SIZE = 0.02  # over R: adaptive cells so small may lie between samples
MAX_NARROW_PLACES = 300  # of each formula


@dataclass(frozen=True)
class PlacedFormulas:
    """A key of the case with formulas of the undeformed place.

    Attributes
    ----------
    spec
        Key, numbers and formulas, and their bounds.
    texts
        The formulas.
    formulas
        Functions of places over R in the frame of the case, in the case's unit.
    """

    spec: Formulas
    texts: tuple[str, ...]
    formulas: FormulaGroup

    def values_at(self, x: Array) -> Array:
        """Return each formula's values (n, formulas) at places (n, 3)."""
        return self.formulas.values(x)


def case_formulas(context: Context) -> list[PlacedFormulas]:
    """Return the formulas of the thickness, of abilities such as magnetism, and of steps' loads.

    Keys with numbers alone are left out.
    """
    key_formulas = list[PlacedFormulas]()
    for spec in _specs(context):
        texts = tuple(value for value in spec.values if isinstance(value, str))
        if texts:
            functions = FormulaGroup([formula(text) for text in texts], None, spec.length)
            key_formulas.append(PlacedFormulas(spec, texts, functions))
    return key_formulas


def _specs(context: Context) -> Iterator[Formulas]:
    """Iterate over the keys of a case that take formulas, with their values and allowed bounds.

    These are the thickness factor, the keys of each ability (a section that adds something to the
    problem), and those of the load of each step.
    """
    factor = context.shell.thickness_factor
    if isinstance(factor, str):
        yield Formulas(THICKNESS, [factor], MIN_THICKNESS_FACTOR, MAX_THICKNESS_FACTOR, 1.0)
    for contributor, view in context.contributors():
        yield from contributor.formulas(view)


def refuse_unfit_formulas(formulas: Sequence[PlacedFormulas], x: Array) -> None:
    """Refuse formulas with values out of bounds, or not finite, on the undeformed shell.

    Parameters
    ----------
    x
        Places (n, 3) over R, in the frame of the case.

    Raises
    ------
    CaseError
        With the first such place of the first such formula.
    """
    for key_formulas in formulas:
        spec, values = key_formulas.spec, key_formulas.values_at(x)
        # not within: also values that are no numbers
        out_of_bounds = ~((values >= spec.minimum) & (values <= spec.maximum))
        if out_of_bounds.any():
            row, i = np.argwhere(out_of_bounds)[0]
            place = ", ".join(f"{c:.3g}" for c in x[row])
            bounds = f"{spec.minimum:.4g} to {spec.maximum:.4g}"
            raise CaseError(
                f"{spec.key}: {shown_value(key_formulas.texts[i])}: is {values[row, i]:.4g} "
                f"at (x, y, z)/R = ({place}): allowed {bounds}"
            )


def refined_squares(
    places: Callable[[Array], Array], outline: Outline, sizes: Sizes, min_size: float
) -> SquaresFeature | None:
    """Return squares of the chart in which elements must be small, with the element size in each.

    A square is divided in four until it is no larger than the elements that it needs, or than
    `min_size`. None if no square needs small elements, or if the chart is a mesh file's.

    Parameters
    ----------
    places
        Chart (n, 2) -> places (n, 3) over R in the frame of the case.
    outline
        The surface with its chart, whose extent the squares cover.
    sizes
        Function of samples (squares, n, 3), of whether each is on the chart, and of the side of the
        squares, to the element size (squares,) over R that each square needs.
    min_size
        Least side of a square, over R.
    """
    shape = outline.chart(None, ANY_GRADING)
    if isinstance(shape, MeshFile):
        return None
    low, high = extent(shape)
    # the first squares are not wider than the chart, and not more than MAX_FIRST_SQUARES
    least_side = float(np.sqrt(np.prod(high - low) / MAX_FIRST_SQUARES))
    first_side = side = max(min(FIRST_SIDE, *(high - low)), least_side)
    centres = _covering_squares(low, high, side)
    # results of each round: centres, sides and element sizes of squares
    groups = list[tuple[Array, Array, Array]]()
    # each round treats squares of one side; the next round has the quarters of some of them
    while len(centres) and len(centres) <= MAX_SQUARES:
        # samples (squares, n, 2) of the squares, without squares that lie off the chart
        chart = centres[:, None] + side * LOCAL
        on_chart = within_chart(shape, chart)
        has_samples = on_chart.any(axis=1)
        centres, chart, on_chart = centres[has_samples], chart[has_samples], on_chart[has_samples]
        # the element size that each square needs
        x = places(chart.reshape(-1, 2)).reshape(*chart.shape[:2], 3)
        needed_size = sizes(x, on_chart, side)
        bounded_size = np.maximum(needed_size, min_size)
        # a square is divided, or kept if it needs small elements, or left out
        is_divided = (needed_size < side) & (side > min_size)
        is_kept = ~is_divided & (bounded_size < first_side)
        sides = np.full(int(is_kept.sum()), side)
        groups.append((centres[is_kept], sides, bounded_size[is_kept]))
        side /= 2
        centres = _centres_of_quarters(centres[is_divided], side)
    # squares are left if there are too many to go on: all get elements as large as themselves
    if len(centres):
        sides = np.full(len(centres), side)
        groups.append((centres, sides, np.full(len(centres), max(side, min_size))))
    if not sum(len(sides) for _, sides, _ in groups):
        return None
    all_centres, all_sides, all_sizes = (np.concatenate(v) for v in zip(*groups, strict=True))
    return SquaresFeature(all_centres, all_sides / 2, all_sizes)


def _covering_squares(low: Array, high: Array, side: float) -> Array:
    """Return the centres (n, 2) of equal squares that cover the box between two corners (2,)."""
    counts = [ceil((b - a) / side - 1e-9) for a, b in zip(low, high, strict=True)]
    centres_along_axes = [a + side * (np.arange(n) + 0.5) for a, n in zip(low, counts, strict=True)]
    grid = np.meshgrid(*centres_along_axes, indexing="ij")
    return np.asarray(np.stack(grid, axis=-1).reshape(-1, 2))


def _centres_of_quarters(centres: Array, side: float) -> Array:
    """Return the centres (4 n, 2) of the quarters of n squares; a quarter has the given side."""
    offsets = side / 2 * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    return (centres[:, None] + offsets).reshape(-1, 2)


def extent(shape: PlaneShape | Grid) -> tuple[Array, Array]:
    """Return the lower and the upper corner, (2,) each, of the box around a chart."""
    if isinstance(shape, Grid):
        return np.array(shape.low), np.array(shape.high)
    if isinstance(shape, StripShape):  # its length is R
        return np.array([0.0, -shape.width / 2]), np.array([1.0, shape.width / 2])
    return np.full(2, -shape.reach), np.full(2, shape.reach)


def within_chart(shape: PlaneShape | Grid, chart: Array) -> Masks:
    """Return whether points (..., 2) belong to a chart: a disc, or the box of another shape."""
    if isinstance(shape, DiscShape):
        return np.asarray(np.hypot(chart[..., 0], chart[..., 1]) <= shape.reach)
    low, high = extent(shape)
    return np.asarray(((chart >= low) & (chart <= high)).all(axis=-1))


def adaptive_cells(formulas: FormulaGroup, outline: Outline) -> RefinedParts:
    """Return a division of the perfect surface so fine that samples in each cell show the formulas.

    It divides the triangles of a mesh file, or triangles that cover the chart. Those of a disc
    cover a square that is mapped onto the disc. Places are over R, in the frame of the case.

    Returns
    -------
    RefinedParts
        The undivided cells, each with area, centre, size and the variance of the formulas in it.
    """
    shape = outline.chart(None, ANY_GRADING)
    # corners of the first triangles, and the map of their points to places in space
    if isinstance(shape, MeshFile):
        mesh = read_msh(shape, {})
        triangles, embedding = mesh.nodes[mesh.cells[:, :3]], space_embedding
    else:
        triangles = _chart_triangles(shape)
        radius = shape.reach if isinstance(shape, DiscShape) else None

        def embedding(x: Array) -> Array:
            """Return the places (n, 3) of points (n, 2) of the chart, or of a disc's square.

            The square around a disc is mapped onto the disc, and its sides onto the circle.
            """
            on_disc = x * np.sqrt(1 - (x[:, ::-1] / radius) ** 2 / 2) if radius else x
            return outline.perfect(on_disc)

    lattice = Lattice.make(basix.CellType.triangle, CELL_SAMPLES)

    def places_and_areas(parts: SubCells) -> tuple[Array, Array]:
        """Return places (parts, samples, 3) of parts of triangles, and their areas (parts,).

        The corners of a part come first among its samples; the area is of the flat triangle.
        """
        # samples of each part in the reference triangle, mapped into the part's triangle
        X = parts.rule(lattice.places, np.ones(len(lattice.places)))[0]
        corners = triangles[parts.cell]
        x = corners[:, None, 0] + np.matmul(X, corners[:, 1:] - corners[:, :1])
        x = embedding(x.reshape(-1, x.shape[-1])).reshape(*x.shape[:2], 3)
        area = np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1) / 2
        return x, area

    # one part for each triangle, all of it; parts are then divided until their samples show the
    # formulas
    reference = SubCells(np.zeros(1, np.int64), np.zeros((1, 2)), np.ones((1, 2)))
    undivided = reference.in_each_cell(np.arange(len(triangles)))
    return refine_where_hidden(formulas, undivided, places_and_areas, lattice, len(triangles))


def _chart_triangles(shape: PlaneShape | Grid) -> Array:
    """Return corners (m, 3, 2) of triangles that cover the box around a chart.

    Each rectangle of a grid with sides of at most `FIRST_SIDE` is cut into two triangles.
    """
    low, high = extent(shape)
    t = [np.linspace(a, b, ceil((b - a) / FIRST_SIDE) + 1) for a, b in zip(low, high, strict=True)]
    corners = np.stack(np.meshgrid(*t, indexing="ij"), axis=-1)
    # the four corners of all rectangles, as parts of the grid of corners: a rectangle begins at
    # each corner but the last along an axis, and ends at each but the first
    a, b = corners[:-1, :-1], corners[:-1, 1:]
    c, d = corners[1:, :-1], corners[1:, 1:]
    return np.concatenate(
        [np.stack(three, axis=-2).reshape(-1, 3, 2) for three in ((a, b, c), (d, c, b))]
    )


def narrow_places(leaves: Sequence[RefinedParts]) -> Array:
    """Return places (n, 3) over R at which formulas have values that samples may miss.

    These are the centres of small adaptive cells. Of each division they are those of the
    `MAX_NARROW_PLACES` cells with the largest variance, and of about as many of the others.

    Parameters
    ----------
    leaves
        Divisions of the surface for each key with formulas, whose small cells show where these
        vary.
    """
    places: list[Array] = [np.zeros((0, 3))]
    for cells in leaves:
        narrow_cells = np.flatnonzero(cells.size < NARROW_SIZE)
        negative_variance = -cells.area[narrow_cells] * cells.variance[narrow_cells]
        by_variance = narrow_cells[np.argsort(negative_variance)]  # the largest comes first
        # the first cells, and every so many of the rest
        stride = max(1, len(by_variance) // MAX_NARROW_PLACES)
        places.append(cells.centre[by_variance[:MAX_NARROW_PLACES]])
        places.append(cells.centre[by_variance[MAX_NARROW_PLACES::stride]])
    return np.concatenate(places)


def polynomial_sizes(values: Callable[[Array], Array], leaves: RefinedParts | None = None) -> Sizes:
    """Return a function for the sizes of elements that resolve formulas on squares of the chart.

    A square is resolved where polynomials of degree `DEGREE` fit the samples. The needed size is
    half the side of a square that is not resolved, and the side of one that is. Resolved squares
    together miss at most `VARIANCE_TOLERANCE` of the variance. Variance counts as missed, too, if
    adaptive cells in a square show it and its samples do not.

    Parameters
    ----------
    values
        Places (n, 3) -> values (n, formulas).
    leaves
        Division of the surface whose small cells show where the formulas vary; None where nothing
        is hidden between samples.
    """
    # mean and variance are kept from call to call: smaller squares see more of the variance
    variance: float = 0.0
    variance_of_leaves: float = float(leaves.area @ leaves.variance) if leaves else 0.0
    mean: Array | None = None

    def sizes(x: Array, on_chart: Masks, side: float) -> Array:
        """Return the sizes (squares,) that samples `x` (squares, n, 3) of equal squares need.

        `on_chart` is whether each sample lies on the chart. Mean and variance go on to the next
        call, with smaller squares.
        """
        nonlocal variance, mean
        # values less their mean in the first, largest squares, which cover the surface
        f = values(x.reshape(-1, 3)).reshape(*x.shape[:2], -1)
        is_valid = on_chart & np.isfinite(f).all(axis=-1)
        mean = f[is_valid].mean(axis=0) if mean is None else mean
        f = np.where(is_valid[..., None], f - mean, 0.0)
        missed = _missed_by_polynomials(f, is_valid)
        # variance of all squares, and what the polynomial of each square misses of it
        area = (side / SAMPLES) ** 2  # of the chart, for each sample
        variance = max(variance, area * float((f**2).sum()))
        if variance < SAMPLED_SHARE * variance_of_leaves:  # the samples miss most of it
            variance = variance_of_leaves
        missed_variance = area * (missed**2).sum(axis=(1, 2))
        # what adaptive cells show and samples miss
        if leaves:
            middle = x[:, len(LOCAL) // 2 + SAMPLES // 2]  # the sample nearest to the centre
            sampled = area * (f**2).sum(axis=(1, 2))
            unsampled = _unsampled_variance(leaves, middle, side, sampled)
            missed_variance = np.maximum(missed_variance, unsampled)
        # the squares that miss least are resolved, as long as their sum is within the tolerance
        order = np.argsort(missed_variance)
        is_resolved = np.empty(len(f), dtype=bool)
        is_resolved[order] = np.cumsum(missed_variance[order]) <= VARIANCE_TOLERANCE * variance
        return np.where(is_resolved, side, side / 2)

    return sizes


def _missed_by_polynomials(f: Array, is_valid: Masks) -> Array:
    """Return what polynomials of least squares leave of samples, zero at invalid samples.

    Parameters
    ----------
    f
        (squares, n, formulas) samples, zero where they are invalid.
    is_valid
        (squares, n) whether each sample is on the chart and finite.
    """
    missed = f - BASIS @ (BASIS.T @ f)
    # on the valid samples of a square alone, the basis is not orthonormal: a QR makes one that is
    for square in np.flatnonzero(~is_valid.all(axis=1)):
        valid = is_valid[square]
        Q = np.linalg.qr(BASIS[valid])[0]
        valid_f = f[square][valid]
        missed[square] = 0.0
        missed[square][valid] = valid_f - Q @ (Q.T @ valid_f)
    return np.asarray(missed)


def _unsampled_variance(leaves: RefinedParts, middle: Array, side: float, sampled: Array) -> Array:
    """Return the integrals (squares,) of f^2 that adaptive cells show and samples miss.

    It is zero in squares whose samples show at least the share `SAMPLED_SHARE`.

    Parameters
    ----------
    leaves
        Adaptive cells, of which those smaller than a square count to the square nearest to them.
    middle
        (squares, 3) centres.
    side
        Side of the squares, over R.
    sampled
        (squares,) the integral by the samples.
    """
    # the square of each cell: that of the nearest centre; the distance is infinite without one
    tree = scipy.spatial.cKDTree(middle)
    distance, square = tree.query(leaves.centre, distance_upper_bound=side)
    in_square = np.isfinite(distance) & (leaves.size < side)
    # the sum over the cells of each square
    integral_of_leaves = (leaves.area * leaves.variance)[in_square]
    integral = np.bincount(square[in_square], integral_of_leaves, len(middle))
    return np.where(sampled < SAMPLED_SHARE * integral, integral, 0.0)


def formula_refinements(
    formulas: Sequence[PlacedFormulas],
    leaves_of_formulas: Sequence[RefinedParts | None],
    outline: Outline,
    turn: float,
    h: float,
) -> list[SquaresFeature]:
    """Return the squares of the chart in which the formulas of keys need small elements.

    Parameters
    ----------
    leaves_of_formulas
        For each key the division of the surface whose small cells show where its formulas vary;
        None if the samples of squares suffice.
    outline
        The surface, with imperfections that do not grow.
    turn
        Angle about e3 of the frame of the chart (rad).
    h
        Thickness over R.
    """
    Q = rotation(turn)

    def places(chart: Array) -> Array:
        return outline.embedding(chart) @ Q

    features = list[SquaresFeature]()
    for key_formulas, leaves in zip(formulas, leaves_of_formulas, strict=True):
        sizes = polynomial_sizes(key_formulas.values_at, leaves)
        # shorter details of a load do not bend a shell; strains follow all other formulas
        min_size = LOAD_SIZE * sqrt(h) if key_formulas.spec.load else MIN_SQUARE * h
        if squares := refined_squares(places, outline, sizes, min_size):
            features.append(squares)
    return features


def imperfection_refinements(
    imperfections: Iterable[ImperfectionGeometry], perfect: Outline, turn: float, h: float
) -> tuple[list[SquaresFeature], float]:
    """Return where imperfections without a centre need small elements.

    An imperfection counts as local if a mesh with small elements in its squares has less than half
    the elements of one that is as fine everywhere. Imperfections with a centre bring their own
    element sizes.

    Parameters
    ----------
    perfect
        The surface without imperfections.
    turn
        Angle about e3 of the frame of the chart (rad).
    h
        Thickness over R.

    Returns
    -------
    squares
        Squares with element sizes, of imperfections that are local.
    size
        Element size over R that resolves the others everywhere; infinite without others.
    """
    Q, size_everywhere, local = rotation(turn), inf, list[SquaresFeature]()
    shape = perfect.chart(None, ANY_GRADING)

    def places(chart: Array) -> Array:
        return perfect.perfect(chart) @ Q

    for imperfection in imperfections:
        # None if the imperfection has one size everywhere, or no square needs small elements
        squares = imperfection.sizes and refined_squares(
            places, perfect, _least_sizes(imperfection.sizes), MIN_IMPERFECTION_SQUARE * h
        )
        if squares is None:
            size_everywhere = min(size_everywhere, imperfection.size)
            continue
        assert not isinstance(shape, MeshFile)  # it has no squares
        if _saves_elements(squares, shape):
            local.append(squares)
        else:  # the least size in the squares is needed everywhere
            size_everywhere = min(size_everywhere, squares.size)
    return local, size_everywhere


def _saves_elements(squares: SquaresFeature, shape: PlaneShape | Grid) -> bool:
    """Return whether a mesh that is fine in squares alone has far fewer elements.

    It is compared with a mesh that is everywhere as fine as the finest square, and must have less
    than the part `GRADED_MESH_GAIN` of its elements.
    """
    low, high = extent(shape)
    least_size = squares.size
    cells_of_equal_size = PER_AREA * float(np.prod(high - low)) / least_size**2
    # elements in the squares and around them, up to the distance of half the chart's diagonal
    half_diagonal = float(np.linalg.norm(high - low)) / 2
    graded_cells = squares.cells(half_diagonal)
    return graded_cells < GRADED_MESH_GAIN * cells_of_equal_size


def _least_sizes(size_at: Callable[[Array], Array]) -> Sizes:
    """Return a function for the least of the element sizes that the places in a square need.

    One of four samples of a square is evaluated, every second in both directions.

    Parameters
    ----------
    size_at
        Places (n, 3) -> element sizes (n,), over R.
    """

    def sizes(x: Array, on_chart: Masks, side: float) -> Array:
        # `side`, that of the squares, is not used here
        some_places = x.reshape(-1, SAMPLES, SAMPLES, 3)[:, ::2, ::2]
        some_on_chart = on_chart.reshape(-1, SAMPLES, SAMPLES)[:, ::2, ::2]
        needed_sizes = size_at(some_places.reshape(-1, 3)).reshape(some_places.shape[:-1])
        return np.asarray(np.where(some_on_chart, needed_sizes, inf).min(axis=(1, 2)))

    return sizes


def unresolved_formulas(
    formulas: Sequence[PlacedFormulas], cells: CellGeometry, turn: float, h: float
) -> list[str]:
    """Return messages about what the cells of a mesh miss of formulas; collective.

    Parameters
    ----------
    cells
        The cells of this rank, with their undeformed places over R.
    turn
        Angle about e3 of the frame of the cells (rad).
    h
        Thickness over R.
    """
    Q, messages = rotation(turn), list[str]()
    for key_formulas in formulas:
        messages += _unresolved_formula(key_formulas, cells, Q, h)
    return messages


def _unresolved_formula(
    key_formulas: PlacedFormulas, cells: CellGeometry, Q: Array, h: float
) -> list[str]:
    """Return messages about what the cells miss of the formulas of one key; collective.

    `Q` (3, 3) turns places of the cells' frame into that of the case; `h` is the thickness over R.
    One message may be on details that were not seen, and one on an error: that of the integral, of
    the stiffness or of the integral of the square, whichever is the first that is too large.

    In place of the formula the cells have a polynomial, `fit`. Its relative errors are
    `fit.missed`, of the integral, and `fit.rest`, the root of the mean square. `fit.open` is the
    part of the variation not yet seen, and `fit.widest` the largest cell that misses something.
    """
    spec, element, messages = key_formulas.spec, cells.element, list[str]()

    def values(x: Array, n: Array) -> Array:
        return key_formulas.values_at(x.reshape(-1, 3) @ Q).reshape(*x.shape[:-1], -1)

    # the polynomial of each cell
    x, normals, _ = cells.evaluate(element.points)
    is_thickness = spec.key == THICKNESS
    fit = project_formula(
        values,
        cells,
        values(x, normals),
        element,
        element.degree,
        bounded=is_thickness,
        formulas=replace(key_formulas.formulas, frame=Q),
    )
    missed_square = fit.rest**2
    if fit.open:
        messages.append(
            f"{spec.key}: has so many details that {100 * min(fit.open, 1.0):.2g} % of its "
            "variation may not be seen"
        )
    stiffness_error = _stiffness_error(values, cells, fit.nodal) if is_thickness else 0.0
    # over deformed places the integral is inexact: it has at least a large error of the square
    counts_square = spec.deformed and missed_square > SQUARE_TOLERANCE
    missed_integral = max(fit.missed, missed_square if counts_square else 0.0)
    # a load on elements small enough for it may be smoothed
    is_resolved_load = spec.load and fit.widest < RESOLVED_LOAD * LOAD_SIZE * sqrt(h)
    if missed_integral > INTEGRAL_TOLERANCE:
        messages.append(
            f"{spec.key}: varies so much within elements that its integral may be wrong by "
            f"{100 * missed_integral:.2g} %"
        )
    elif stiffness_error > STIFFNESS_TOLERANCE:
        messages.append(
            f"{spec.key}: varies within elements of up to {fit.widest:.2g} R, which smooth it: its "
            f"integral is right, but the stiffness may be wrong by {100 * stiffness_error:.2g} %; "
            "take a smaller mesh.size or a larger mesh.refinement"
        )
    elif missed_square > SQUARE_TOLERANCE and not is_resolved_load:
        messages.append(
            f"{spec.key}: varies within elements of up to {fit.widest:.2g} R, which smooth it: its "
            f"integral is right, but that of its square lacks {100 * missed_square:.2g} %; "
            "take a smaller mesh.size or a larger mesh.refinement"
        )
    return messages


def _stiffness_error(
    values: Callable[[Array, Array], Array], cells: CellGeometry, nodal: Array
) -> float:
    """Return the relative error of the integrated stiffness t^3 or compliance 1/t^3; collective.

    Parts of a shell that carry side by side add their stiffness, those in a row their compliance.
    The compliance of a cell is what its curvatures show under a constant moment. The curvatures are
    polynomials of the cell's degree less two. The squares of moments may be equal everywhere, or
    fall to zero along an axis as in a cantilever: the largest error of these weights counts.

    Parameters
    ----------
    values
        Places and normals -> exact thickness factors.
    nodal
        (cells, nodes, 1) thickness factors of the cells.

    Returns
    -------
    float
        The error over the exact value, both summed over all cells.
    """
    # quadrature: points (n, 2) in the reference cell and weights (n,) of all parts that it is cut
    # into; places, normals and areas of all cells there
    X, w = (v.reshape(-1, *v.shape[2:]) for v in sampling_points(cells))
    x, normals, area = cells.evaluate(X)
    cell_type, degree = cells.element.cell_type, max(cells.element.degree - 2, 0)
    curvatures = basix.create_element(
        basix.ElementFamily.P, cell_type, degree, basix.LagrangeVariant.legendre, discontinuous=True
    )
    # at these points: basis functions phi of curvatures, the exact thickness factor t, and the
    # cells' polynomial p of it
    phi, weight = curvatures.tabulate(0, X)[0, :, :, 0], (area * w)[..., None]
    t, p = values(x, normals), np.matmul(cells.element.tabulate(0, X)[0, :, :, 0], nodal)
    # compliance and stiffness (cells,) of the cells
    compliance = _compliances(area * w, p[..., 0] ** 3, phi)
    stiffness = (weight * p**3).sum(axis=(1, 2))
    # stiffness and compliance (cells, 2) of the exact thickness, and their errors
    exact_values = np.stack([(weight * t**n).sum(axis=(1, 2)) for n in (3, -3)], axis=1)
    error = np.abs(exact_values - np.stack([stiffness, compliance], axis=1))
    # squares (cells, 7) of moments: constant, and falling to zero along each axis either way
    position = _positions_in_box(x, cells.comm)
    moments = [np.ones((len(x), 1)), (1 + position) ** 2, (1 - position) ** 2]
    squared_moments = np.concatenate(moments, axis=1)
    # the largest relative error (2, 7) of the sums over all cells with these weights
    error_integral, exact_integral = (
        cells.sum_over_ranks(v[..., None] * squared_moments[:, None]) for v in (error, exact_values)
    )
    return float((error_integral / exact_integral).max())


def _compliances(weights: Array, stiffness: Array, phi: Array) -> Array:
    """Return the compliance (cells,) of each cell under a constant moment.

    It is m A^-1 m, with the integrals m of phi_i and A of stiffness phi_i phi_j over the cell.

    Parameters
    ----------
    weights
        (cells, q) weights of the quadrature points of each cell.
    stiffness
        (cells, q) stiffness at these points.
    phi
        (q, n) basis functions of the curvature.
    """
    moment = np.einsum("cq,qi->ci", weights, phi)
    A = np.einsum("cq,cq,qi,qj->cij", weights, stiffness, phi, phi, optimize=True)
    compliance = np.einsum("ci,ci->c", moment, np.linalg.solve(A, moment[..., None])[..., 0])
    return np.asarray(compliance)


def _positions_in_box(x: Array, comm: MPI.Comm) -> Array:
    """Return positions (cells, 3) in the box around the shell, -1 to 1 along axes; collective.

    The position of a cell is the mean of its places; `x` (cells, n, 3) are those of this rank.
    """
    middle = x.mean(axis=1)
    low = np.min(comm.allgather(x.min(axis=(0, 1), initial=inf)), axis=0)
    high = np.max(comm.allgather(x.max(axis=(0, 1), initial=-inf)), axis=0)
    return np.asarray((middle - (low + high) / 2) / np.maximum((high - low) / 2, MIN_EXTENT))


def cells_of_patch(patch: PatchMesh, degree: int) -> CellGeometry:
    """Return the cells of a triangulation, with places as polynomials; on this rank alone.

    The polynomials have the given degree. They equal the patch's embedding at the nodes of each
    cell.
    """
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType.triangle, degree, basix.LagrangeVariant.gll_warped
    )
    corners = patch.nodes[patch.cells[:, :3]]
    X = element.points
    # chart (cells, nodes, 2 or 3): the affine map of each triangle at the element's nodes
    chart = corners[:, :1] + np.einsum("qk,ckd->cqd", X, corners[:, 1:] - corners[:, :1])
    places = patch.embedding(chart.reshape(-1, chart.shape[-1])).reshape(*chart.shape[:2], 3)
    return CellGeometry(element, places, len(places), MPI.COMM_SELF)

"""The formulas of a case in the undeformed place: that they have sensible values, and where
elements must be small.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import ceil, inf, sqrt

import basix
import numpy as np
import scipy
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.input.expressions import Together, formula
from magshell_fenicsx.input.messages import shown
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.grading import PER_AREA, Squares
from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.mesh.msh import MeshFile, in_space, read_msh
from magshell_fenicsx.mesh.patch import PatchMesh
from magshell_fenicsx.mesh.shapes import DiscShape, Shape, StripShape
from magshell_fenicsx.models.shell.fitted import Cells, fitted, sampling
from magshell_fenicsx.models.shell.thickness import LEAST_FACTOR, MOST_FACTOR
from magshell_fenicsx.models.shell.unseen import Lattice, Leaves, Parts
from magshell_fenicsx.models.shell.unseen import leaves as leaves_of
from magshell_fenicsx.parts.imperfections.imperfection import Flaw
from magshell_fenicsx.parts.part import Context, Formulas
from magshell_fenicsx.shape.outline import ANY, Outline

Array = NDArray[np.float64]
THICKNESS = "shell.thickness_factor"
SAMPLES = 20  # along each side of a square of the chart
COARSEST, MOST_FIRST, MOST_SQUARES = (
    0.2,
    800,
    3000,
)  # side of the first squares over R, how many, and how many later
DEGREE = 4  # of the polynomials that are compared
SHOWN, SMALLEST_SQUARE = (
    0.25,
    0.1,
)  # of sqrt(Rh) and of h: elements of this size show loads, and all else
SMALLEST_FLAW = 0.25  # of h
TOTAL, SQUARE = (
    1e-3,
    0.02,
)  # of the integrals of a formula's size and of its square, which cells may miss
CHEAPER = 0.5  # of as many elements as small ones everywhere are: a graded mesh is worth while
SMALLEST_EXTENT = 1e-9  # over R, of a surface along an axis
STIFFNESS = 1e-3  # of it, which cells may miss by a thickness that varies within them
MISSED = 0.003  # of the variance of a formula: what polynomials on squares may miss of it
SEEN, HALF = (
    6,
    0.5,
)  # places along each side of a part of the surface; of a formula's square, which samples miss
NARROW, PLACES = (
    0.02,
    300,
)  # over R, parts that samples may miss, and how many of each formula are looked at
LOCAL = (
    np.stack(np.meshgrid(*[np.arange(SAMPLES)] * 2, indexing="ij"), axis=-1).reshape(-1, 2) + 0.5
) / SAMPLES - 0.5
_POWERS = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
BASIS = np.linalg.qr(
    np.stack([(2 * LOCAL[:, 0]) ** i * (2 * LOCAL[:, 1]) ** j for i, j in _POWERS], axis=-1)
)[0]


@dataclass(frozen=True)
class Written:
    """A key of the case with formulas of the undeformed place.

    Attributes
    ----------
    given
        Its numbers and formulas, and what they may be.
    texts
        The formulas.
    formulas
        Of places over R in the frame of the case, in the case's unit.
    """

    given: Formulas
    texts: tuple[str, ...]
    formulas: Together

    def of_place(self, x: Array) -> Array:
        """Places (n, 3) -> each formula's values (n, formulas)."""
        return self.formulas.values(x)


def written(context: Context) -> list[Written]:
    """Those of thickness, remanence, dead loads and natural shape."""
    return list(_written(context))


def _written(context: Context) -> Iterator[Written]:
    factor = context.shell.thickness_factor
    for each in (
        *(
            [Formulas(THICKNESS, [factor], LEAST_FACTOR, MOST_FACTOR, 1.0)]
            if isinstance(factor, str)
            else []
        ),
        *(formulas for section in context.abilities for formulas in section.formulas(context)),
        *(formulas for step in context.steps for formulas in step.load.formulas(step.key, context)),
    ):
        texts = tuple(value for value in each.values if isinstance(value, str))
        if texts:
            of_place = Together([formula(text) for text in texts], None, each.length)
            yield Written(each, texts, of_place)


def refuse_unfit_formulas(formulas: Sequence[Written], x: Array) -> None:
    """Look at the values at places (n, 3) over R of the undeformed shell.

    Raises
    ------
    CaseError
        With the first place where one is not finite or out of bounds.
    """
    for each in formulas:
        values = each.of_place(x)
        bad = ~((values >= each.given.least) & (values <= each.given.most))
        if bad.any():
            row, i = np.argwhere(bad)[0]
            place = ", ".join(f"{c:.3g}" for c in x[row])
            bounds = f"{each.given.least:.4g} to {each.given.most:.4g}"
            raise CaseError(
                f"{each.given.key}: {shown(each.texts[i])}: is {values[row, i]:.4g} at (x, y, z)/R = ({place}): "
                f"allowed {bounds}"
            )


def squares(
    places: Callable[[Array], Array], outline: Outline, sizes: "Sizes", finest: float
) -> Squares | None:
    """Squares of the chart in which elements must be small; None if there are none, or the chart is
    a mesh file's.

    Squares are divided until the elements that they need are no smaller than they, or as small as
    `finest`.

    Parameters
    ----------
    places
        Chart (n, 2) -> places (n, 3) over R in the frame of the case.
    sizes
        Places (squares, n, 3), which of them are inside, and the side of the squares -> size of
        elements of each.
    """
    shape = outline.chart(None, ANY)
    if isinstance(shape, MeshFile):
        return None
    low, high = extent(shape)
    side = max(min(COARSEST, *(high - low)), float(np.sqrt(np.prod(high - low) / MOST_FIRST)))
    t = [
        a + side * (np.arange(ceil((b - a) / side - 1e-9)) + 0.5)
        for a, b in zip(low, high, strict=True)
    ]
    centres: Array = np.stack(np.meshgrid(*t, indexing="ij"), axis=-1).reshape(-1, 2)
    chosen, largest = list[tuple[Array, float, Array]](), side
    while len(centres) and len(centres) <= MOST_SQUARES:
        chart = centres[:, None] + side * LOCAL
        inside = within(shape, chart)
        kept = inside.any(axis=1)
        centres, chart, inside = centres[kept], chart[kept], inside[kept]
        size = sizes(places(chart.reshape(-1, 2)).reshape(*chart.shape[:2], 3), inside, side)
        small = (size < side) & (side > finest)
        leaves = ~small & (np.maximum(size, finest) < largest)
        chosen.append((centres[leaves], side, np.maximum(size[leaves], finest)))
        side /= 2
        offsets = side / 2 * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
        centres = (centres[small][:, None] + offsets).reshape(-1, 2)
    if len(centres):  # so many that they are all alike: as small as can be paid for
        chosen.append((centres, side, np.full(len(centres), max(side, finest))))
    if not sum(len(each) for each, _, _ in chosen):
        return None
    sides = np.concatenate([np.full(len(each), s) for each, s, _ in chosen])
    return Squares(
        np.concatenate([c for c, _, _ in chosen]),
        sides / 2,
        np.concatenate([s for _, _, s in chosen]),
    )


Sizes = Callable[[Array, NDArray[np.bool_], float], Array]


def extent(shape: Shape | Grid) -> tuple[Array, Array]:
    """Lower and upper corner of a chart."""
    if isinstance(shape, Grid):
        return np.array(shape.low), np.array(shape.high)
    if isinstance(shape, StripShape):
        return np.array([0.0, -shape.width / 2]), np.array([1.0, shape.width / 2])
    return np.full(2, -shape.reach), np.full(2, shape.reach)


def within(shape: Shape | Grid, chart: Array) -> NDArray[np.bool_]:
    """Whether points (..., 2) belong to a chart."""
    if isinstance(shape, DiscShape):
        return np.asarray(np.hypot(chart[..., 0], chart[..., 1]) <= shape.reach)
    low, high = extent(shape)
    return np.asarray(((chart >= low) & (chart <= high)).all(axis=-1))


def looked_at(formulas: Together, outline: Outline) -> Leaves:
    """Parts of the perfect surface in which a formula has no values that their places do not show,
    in the case's frame.

    They divide triangles of the chart, of a disc those of a square that is mapped onto it, or of a
    mesh file.
    """
    shape = outline.chart(None, ANY)
    if isinstance(shape, MeshFile):
        mesh = read_msh(shape, {})
        triangles, embedded = mesh.nodes[mesh.cells[:, :3]], in_space
    else:
        low, high = extent(shape)
        radius = shape.reach if isinstance(shape, DiscShape) else None
        t = [
            np.linspace(a, b, ceil((b - a) / COARSEST) + 1) for a, b in zip(low, high, strict=True)
        ]
        corners = np.stack(np.meshgrid(*t, indexing="ij"), axis=-1)
        a, b, c, d = (corners[i : i - 1 or None, j : j - 1 or None] for i in (0, 1) for j in (0, 1))
        triangles = np.concatenate(
            [np.stack(three, axis=-2).reshape(-1, 3, 2) for three in ((a, b, c), (d, c, b))]
        )

        def embedded(x: Array) -> Array:
            return outline.perfect(x * np.sqrt(1 - (x[:, ::-1] / radius) ** 2 / 2) if radius else x)

    lattice = Lattice.of(basix.CellType.triangle, SEEN)

    def look(parts: Parts) -> tuple[Array, Array]:
        X, three = (
            parts.rule(lattice.places, np.ones(len(lattice.places)))[0],
            triangles[parts.cell],
        )
        x = three[:, None, 0] + np.matmul(X, three[:, 1:] - three[:, :1])
        x = embedded(x.reshape(-1, x.shape[-1])).reshape(*x.shape[:2], 3)
        area = np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1) / 2
        return x, area

    first = Parts(np.zeros(1, np.int64), np.zeros((1, 2)), np.ones((1, 2))).of(
        np.arange(len(triangles))
    )
    return leaves_of(formulas, first, look, lattice, len(triangles))


def narrow_places(leaves: Sequence[Leaves]) -> Array:
    """Places (n, 3) at which formulas have what samples may miss."""
    few: list[Array] = [np.zeros((0, 3))]
    for each in leaves:
        small = np.flatnonzero(each.size < NARROW)
        order = small[np.argsort(-each.area[small] * each.away[small])]
        few += [
            each.centre[order[:PLACES]],
            each.centre[order[PLACES :: max(1, len(order) // PLACES)]],
        ]
    return np.concatenate(few)


def shown_by_polynomials(values: Callable[[Array], Array], leaves: Leaves | None = None) -> Sizes:
    """Elements that show a formula of places (n, 3): smaller than the squares where polynomials
    miss most of it.

    What samples of a square do not have and the leaves in it have is missed too.
    """
    whole: float = 0.0
    of_leaves: float = float(leaves.area @ leaves.away) if leaves else 0.0
    mean: Array | None = None

    def sizes(x: Array, inside: NDArray[np.bool_], side: float) -> Array:
        nonlocal whole, mean
        f = values(x.reshape(-1, 3)).reshape(*x.shape[:2], -1)
        good = inside & np.isfinite(f).all(axis=-1)
        mean = f[good].mean(axis=0) if mean is None else mean
        f = np.where(good[..., None], f - mean, 0.0)
        missed = f - BASIS @ (BASIS.T @ f)
        for i in np.flatnonzero(~good.all(axis=1)):
            Q = np.linalg.qr(BASIS[good[i]])[0]
            missed[i], g = 0.0, f[i][good[i]]
            missed[i][good[i]] = g - Q @ (Q.T @ g)
        area = (side / SAMPLES) ** 2
        whole = max(whole, area * float((f**2).sum()))
        whole = of_leaves if whole < HALF * of_leaves else whole
        squared = area * (missed**2).sum(axis=(1, 2))
        if leaves:
            middle = x[:, len(LOCAL) // 2 + SAMPLES // 2]
            squared = np.maximum(
                squared, _unsampled(leaves, middle, side, area * (f**2).sum(axis=(1, 2)))
            )
        order = np.argsort(squared)
        fine = np.empty(len(f), dtype=bool)
        fine[order] = np.cumsum(squared[order]) <= MISSED * whole
        return np.where(fine, side, side / 2)

    return sizes


def _unsampled(leaves: Leaves, middle: Array, side: float, sampled: Array) -> Array:
    """The squares' integrals of the square of a formula, less those of samples that have not half
    of it.
    """
    away, square = scipy.spatial.cKDTree(middle).query(leaves.centre, distance_upper_bound=side)
    missed = np.isfinite(away) & (leaves.size < side)
    whole = np.bincount(square[missed], (leaves.area * leaves.away)[missed], len(middle))
    return np.where(sampled < HALF * whole, whole, 0.0)


def refinements(
    formulas: Sequence[Written],
    narrow: Sequence[Leaves | None],
    drawn: Outline,
    turn: float,
    h: float,
) -> list[Squares]:
    """Where formulas need small elements, in the chart of a frame that is turned about e3 (rad).

    `narrow` has what was seen between samples; None: there is nothing.
    """
    Q = rotation(turn)

    def places(chart: Array) -> Array:
        return drawn.embedding(chart) @ Q

    finest = {True: SHOWN * sqrt(h), False: SMALLEST_SQUARE * h}
    areas = (
        squares(places, drawn, shown_by_polynomials(each.of_place, leaves), finest[each.given.load])
        for each, leaves in zip(formulas, narrow, strict=True)
    )
    return [each for each in areas if each]


def of_imperfections(
    flaws: Iterable[Flaw], perfect: Outline, turn: float, h: float
) -> tuple[list[Squares], float]:
    """Where imperfections without a centre need small elements, and the size that shows the others
    everywhere.
    """
    Q, everywhere, local = rotation(turn), inf, list[Squares]()
    shape = perfect.chart(None, ANY)

    def places(chart: Array) -> Array:
        return perfect.perfect(chart) @ Q

    for flaw in flaws:
        area = flaw.sizes and squares(places, perfect, _smallest(flaw.sizes), SMALLEST_FLAW * h)
        if area is None:
            everywhere = min(everywhere, flaw.size)
            continue
        assert not isinstance(shape, MeshFile)  # it has no squares
        low, high = extent(shape)
        alike = PER_AREA * float(np.prod(high - low)) / area.size**2
        if area.cells(float(np.linalg.norm(high - low)) / 2) < CHEAPER * alike:
            local.append(area)
        else:
            everywhere = min(everywhere, area.size)
    return local, everywhere


def _smallest(of_place: Callable[[Array], Array]) -> Sizes:
    """Elements that are the smallest which places (n, 3) of a square need; a quarter of the places
    is looked at.
    """

    def sizes(x: Array, inside: NDArray[np.bool_], side: float) -> Array:
        fewer = x.reshape(-1, SAMPLES, SAMPLES, 3)[:, ::2, ::2]
        needed = of_place(fewer.reshape(-1, 3)).reshape(fewer.shape[:-1])
        return np.asarray(
            np.where(inside.reshape(-1, SAMPLES, SAMPLES)[:, ::2, ::2], needed, inf).min(
                axis=(1, 2)
            )
        )

    return sizes


def unshown(formulas: Sequence[Written], cells: Cells, turn: float, h: float) -> list[str]:
    """What the cells miss of formulas, in words; collective."""
    Q, element, said = rotation(turn), cells.element, list[str]()
    for each in formulas:

        def values(x: Array, n: Array, each: Written = each) -> Array:
            return each.of_place(x.reshape(-1, 3) @ Q).reshape(*x.shape[:-1], -1)

        x, normals, _ = cells.at(element.points)
        turned = replace(each.formulas, frame=Q)
        bounded = each.given.key == THICKNESS
        fit = fitted(
            values,
            cells,
            values(x, normals),
            element,
            element.degree,
            bounded=bounded,
            formulas=turned,
        )
        missed = fit.rest**2
        if fit.open:
            said.append(
                f"{each.given.key}: has so many details that {100 * min(fit.open, 1.0):.2g} % of its variation may not "
                "be seen"
            )
        wrong = _wrong_stiffness(values, cells, fit.nodal) if each.given.key == THICKNESS else 0.0
        lost = max(fit.missed, missed if each.given.deformed and missed > SQUARE else 0.0)
        if lost > TOTAL:
            off = f"{100 * lost:.2g} %"
            said.append(
                f"{each.given.key}: varies so much within elements that its integral may be wrong by {off}"
            )
        elif wrong > STIFFNESS:
            said.append(
                f"{each.given.key}: varies within elements of up to {fit.widest:.2g} R, which smooth it: its "
                f"integral is right, but the stiffness may be wrong by {100 * wrong:.2g} %; take a smaller mesh.size "
                "or a larger mesh.refinement"
            )
        elif missed > SQUARE and not (each.given.load and fit.widest < 4 * SHOWN * sqrt(h)):
            said.append(
                f"{each.given.key}: varies within elements of up to {fit.widest:.2g} R, which smooth it: its "
                f"integral is right, but that of its square lacks {100 * missed:.2g} %; take a smaller mesh.size or a "
                "larger mesh.refinement"
            )
    return said


def _wrong_stiffness(values: Callable[[Array, Array], Array], cells: Cells, nodal: Array) -> float:
    """By how much the stiffness t^3 or the compliance 1/t^3 of the cells differs, over that of all;
    collective.

    Parts of a shell that carry side by side add their stiffness, those in a row their compliance.
    That of a cell is what polynomial curvatures of its degree less two show under a constant
    moment. The squares of moments may be alike everywhere or fall to zero along an axis, as those
    of a cantilever: the largest difference counts.
    """
    X, w = (v.reshape(-1, *v.shape[2:]) for v in sampling(cells))
    x, normals, area = cells.at(X)
    kind, degree = cells.element.cell_type, max(cells.element.degree - 2, 0)
    curvatures = basix.create_element(
        basix.ElementFamily.P, kind, degree, basix.LagrangeVariant.legendre, discontinuous=True
    )
    phi, weight = curvatures.tabulate(0, X)[0, :, :, 0], (area * w)[..., None]
    t, p = values(x, normals), np.matmul(cells.element.tabulate(0, X)[0, :, :, 0], nodal)
    moment = np.einsum("cq,qi->ci", area * w, phi)
    A = np.einsum("cq,cq,qi,qj->cij", area * w, p[..., 0] ** 3, phi, phi, optimize=True)
    shown = np.einsum("ci,ci->c", moment, np.linalg.solve(A, moment[..., None])[..., 0])
    true = np.stack([(weight * t**n).sum(axis=(1, 2)) for n in (3, -3)], axis=1)
    off = np.abs(true - np.stack([(weight * p**3).sum(axis=(1, 2)), shown], axis=1))
    middle, least, most = (
        x.mean(axis=1),
        x.min(axis=(0, 1), initial=inf),
        x.max(axis=(0, 1), initial=-inf),
    )
    least, most = (
        np.min(cells.comm.allgather(least), axis=0),
        np.max(cells.comm.allgather(most), axis=0),
    )
    along = (middle - (least + most) / 2) / np.maximum((most - least) / 2, SMALLEST_EXTENT)
    loaded = np.concatenate([np.ones((len(x), 1)), (1 + along) ** 2, (1 - along) ** 2], axis=1)
    shares = [cells.sum(each[..., None] * loaded[:, None]) for each in (off, true)]
    return float((shares[0] / shares[1]).max())


def cells_of_patch(patch: PatchMesh, degree: int) -> Cells:
    """The cells of a triangulation, with the places of a model of that degree."""
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType.triangle, degree, basix.LagrangeVariant.gll_warped
    )
    corners = patch.nodes[patch.cells[:, :3]]
    X = element.points
    chart = corners[:, :1] + np.einsum("qk,ckd->cqd", X, corners[:, 1:] - corners[:, :1])
    places = patch.embedding(chart.reshape(-1, chart.shape[-1])).reshape(*chart.shape[:2], 3)
    return Cells(element, places, len(places), MPI.COMM_SELF)

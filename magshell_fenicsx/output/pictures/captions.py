"""Numbers beside marks of curves, and captions under pictures."""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.quantities.quantity import format_number
from magshell_fenicsx.quantities.registry import amplitude, shown_quantity

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
DIGIT_WIDTH, DIGIT_HEIGHT = 0.6, 0.95  # over the size of the font
MARK_DISTANCE = 4.0  # between a mark and its number, in points
# columns of captions, where they are not zero
CAPTION_COLUMNS = ("lambda_m", "field_angle", "p_over_pc", "force", "load_factor", "time")
# directions from a mark to its number, the preferred first
TEXT_DIRECTIONS = [(-1, 1), (1, 1), (-1, -1), (1, -1), (0, 1.3), (0, -1.3), (-1.3, 0), (1.3, 0)]
ROUNDING = 1e-9  # points: of distances that are compared
HALF_MARK = 3.0  # half the size of a mark, in points


def write_numbers(
    axes: "Axes", marks: Sequence[tuple[tuple[float, float], str]], curves: Sequence[Array]
) -> None:
    """Write texts beside marks at places of the data.

    Texts that would cover others, or other marks, are left out.

    Parameters
    ----------
    marks
        Places in the data, and texts.
    curves
        Places (2, n) that a number had better not cover.
    """
    from matplotlib import rcParams

    if not marks:
        return
    box, figure = axes.get_position(), axes.get_figure(root=True)
    assert figure
    figure_width, figure_height = 72 * figure.get_size_inches()
    size, (left, right), (low, high) = rcParams["font.size"], axes.get_xlim(), axes.get_ylim()
    extent = np.array(
        [box.width * figure_width, box.height * figure_height]
    )  # of the axes, in points

    def in_points(places: Array) -> Array:
        return np.asarray((places - [left, low]) / [right - left, high - low] * extent)

    places_of_marks = in_points(np.array([place for place, _ in marks], float))
    points_of_curves = (
        np.concatenate([in_points(curve.T) for curve in curves]) if curves else np.zeros((0, 2))
    )
    occupied = [(place, np.full(2, HALF_MARK)) for place in places_of_marks]
    for i, (_, text) in enumerate(marks):
        place: Array = places_of_marks[i]
        half = np.array([DIGIT_WIDTH * len(text), DIGIT_HEIGHT]) * size / 2
        middles = [
            place + np.array(direction) * (half + MARK_DISTANCE) for direction in TEXT_DIRECTIONS
        ]
        free_middles = [
            middle
            for middle in middles
            if _is_inside(middle, half, extent) and _is_free(middle, half, occupied)
        ]
        if not free_middles:
            continue
        best = min(
            free_middles, key=partial(_fault, place, half, places_of_marks, points_of_curves)
        )
        occupied.append((best, half))
        axes.text(
            best[0] / extent[0],
            best[1] / extent[1],
            text,
            transform=axes.transAxes,
            ha="center",
            va="center",
        )


def _fault(place: Array, half: Array, marks: Array, line: Array, middle: Array) -> tuple[int, int]:
    """Return how many other marks are nearer than its own, and how many curve points it covers."""
    nearer = np.linalg.norm(marks - middle, axis=1) < np.linalg.norm(place - middle) - ROUNDING
    return int(nearer.sum()), int((np.abs(line - middle) < half).all(axis=1).sum())


def _is_inside(middle: Array, half: Array, extent: Array) -> bool:
    """Whether a box with a middle and half its size is within the axes, all (2,) in points."""
    return bool(((middle - half > 0) & (middle + half < extent)).all())


def _is_free(middle: Array, half: Array, occupied: Sequence[tuple[Array, Array]]) -> bool:
    """Whether a box with a middle and half its size meets none of the occupied ones."""
    return not any(
        bool((np.abs(middle - other) < half + half_of_other).all())
        for other, half_of_other in occupied
    )


def shell_caption(h: float, nu: float, row: Row) -> str:
    """Return R/h, Poisson's ratio and the field, from the thickness h over R and nu."""
    text = rf"$R/h$ = {1 / h:.6g}, $\nu$ = {nu:g}"
    return text + (f", {named_value('lambda_m', row)}" if row["lambda_m"] else "")


def caption(h: float, nu: float, row: Row, amplitudes: Iterable[str] = ()) -> str:
    r"""Return the caption of the shell and its loads at a point.

    Parameters
    ----------
    h, nu
        Thickness over R, and Poisson's ratio.
    row
        The point's row of path.csv.
    amplitudes
        Names of the amplitudes that have varied up to there.

    Examples
    --------
    >>> row = {"lambda_m": 0.0, "field_angle": 0.0, "p_over_pc": 0.25, "amplitude": "pressure"}
    >>> caption(0.01, 0.5, row | {"my_springs": 0.02}, amplitudes=["pressure", "my_springs"])
    '$R/h$ = 100, $\\nu$ = 0.5, $p/p_\\mathrm{c}$ = 0.25, my springs = 0.02'
    """
    parts = [shell_caption(h, nu, row)]
    if row["field_angle"]:
        parts.append(rf"turned by ${row['field_angle']:.4g}\degree$")
    if row["p_over_pc"]:
        parts.append(named_value("p_over_pc", row, 5))
    if row.get("force"):
        displacement = f"{named_value('w_over_h', row)} {amplitude('force').place}"
        parts.append(f"{named_value('force', row)}, {displacement}")
    if "load_factor" in row:
        parts.append(f"{named_value('load_factor', row)}, {named_value('w_over_h', row)}")
    if row["amplitude"] == "time":
        parts.append(named_value("time", row))
    others = (amplitude(name).column for name in amplitudes)
    parts += [
        named_value(column, row)
        for column in others
        if column not in CAPTION_COLUMNS and row.get(column)
    ]
    return ", ".join(parts)


def named_value(name: str, row: Row, digits: int = 4) -> str:
    """Return symbol and value of a column of a row, in the case's units if it has any."""
    q = shown_quantity(name, row)
    unit = q.si.replace("%", r"\%") if q.name != name else ""
    return f"{q.latex} = {in_mathematics(float(row[q.name]), digits)}{f' {unit}' if unit else ''}"


def in_mathematics(value: float, digits: int) -> str:
    r"""Return a number with so many digits, with a power of ten where Python has an exponent.

    Examples
    --------
    >>> in_mathematics(0.32623, 4), in_mathematics(-5.5, 4), in_mathematics(-1.5e-06, 4)
    ('0.3262', '−5.5', '$-1.5 \\times 10^{-6}$')
    """
    mantissa, _, exponent = format_number(value, f".{digits}g").partition("e")
    if exponent:
        return rf"${mantissa} \times 10^{{{int(exponent)}}}$"
    return mantissa.replace("-", "−")

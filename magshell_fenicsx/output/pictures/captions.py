"""Numbers beside marks of curves, and captions under pictures.

A row is a line of path.csv, by column. An amplitude is a load parameter, by name; its value is in
the column of the amplitude. Lengths on a picture are in points, 1/72 inch. A text is a box with a
middle and half a size, that is half of its width and height; h, R and nu are thickness, reference
length and Poisson's ratio.
"""

from collections.abc import Iterable, Sequence
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.quantities.quantity import format_number
from magshell_fenicsx.quantities.registry import amplitude, field_columns, shown_quantity

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
DIGIT_WIDTH, DIGIT_HEIGHT = 0.6, 0.95  # over the size of the font
TEXT_DISTANCE = 0.3  # between two texts beside each other, over the size of the font
MARK_DISTANCE = 4.0  # between a mark and its number, in points
# columns of captions beside the fields, where they are not zero
CAPTION_COLUMNS = ("field_angle", "p_over_pc", "force", "load_factor", "time")
# directions from a mark to its number, the preferred first
TEXT_DIRECTIONS = [(-1, 1), (1, 1), (-1, -1), (1, -1), (0, 1.3), (0, -1.3), (-1.3, 0), (1.3, 0)]
ROUNDING = 1e-9  # points: of distances that are compared
HALF_MARK = 3.0  # half the size of a mark, in points


def write_numbers(
    axes: "Axes", marks: Sequence[tuple[tuple[float, float], int]], curves: Sequence[Array]
) -> None:
    """Write numbers beside marks at places of the data, such as the numbers of instabilities.

    Marks that cover each other have one text. Texts that would cover other texts or marks are left
    out.

    Parameters
    ----------
    marks
        Places in the data, and numbers.
    curves
        Places (2, n) that a number had better not cover.
    """
    from matplotlib import rcParams

    if not marks:
        return
    # the axes over the figure, and the figure, which gives its size
    box, figure = axes.get_position(), axes.get_figure(root=True)
    assert figure
    figure_width, figure_height = 72 * figure.get_size_inches()
    font_size, (left, right), (low, high) = rcParams["font.size"], axes.get_xlim(), axes.get_ylim()
    # size of the axes, in points
    extent = np.array([box.width * figure_width, box.height * figure_height])

    def in_points(places: Array) -> Array:
        """Return places (n, 2) of the data in points from the lower left of the axes."""
        return np.asarray((places - [left, low]) / [right - left, high - low] * extent)

    places_of_marks = in_points(np.array([place for place, _ in marks], float))
    points_of_curves = (
        np.concatenate([_dense(in_points(curve.T)) for curve in curves])
        if curves
        else np.zeros((0, 2))
    )
    # boxes (middle, half of the size) that texts must not cover: marks, later texts too
    occupied = [(place, np.full(2, HALF_MARK)) for place in places_of_marks]
    for i, group in groups_of_places(places_of_marks, 2 * HALF_MARK).items():
        text = number_ranges([marks[k][1] for k in group])
        half_size = np.array([DIGIT_WIDTH * len(text), DIGIT_HEIGHT]) * font_size / 2
        middle = _best_middle(
            i, half_size, places_of_marks, points_of_curves, occupied=occupied, extent=extent
        )
        if middle is None:  # no room for this text
            continue
        occupied.append((middle, half_size + np.array([TEXT_DISTANCE * font_size, 0.0])))
        axes.text(
            middle[0] / extent[0],
            middle[1] / extent[1],
            text,
            transform=axes.transAxes,
            ha="center",
            va="center",
        )


def _dense(line: Array) -> Array:
    """Return places at most one point apart along a line (n, 2)."""
    lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    positions = np.linspace(0, lengths[-1], int(lengths[-1]) + 2)
    return np.column_stack([np.interp(positions, lengths, values) for values in line.T])


def groups_of_places(places: Array, distance: float) -> dict[int, list[int]]:
    """Return number of a place -> numbers of all places (n, 2) nearer to it than a distance.

    Each place is in one group, the first one that it is near to.

    Examples
    --------
    >>> groups_of_places(np.array([[0.0, 0], [5, 0], [1, 0]]), 2.0)
    {0: [0, 2], 1: [1]}
    """
    groups = dict[int, list[int]]()
    for i, place in enumerate(places):
        near = (k for k in groups if np.linalg.norm(places[k] - place) < distance)
        groups.setdefault(next(near, i), []).append(i)
    return groups


def number_ranges(numbers: Sequence[int]) -> str:
    """Return different whole numbers as text, three or more successive ones as a range.

    Examples
    --------
    >>> number_ranges([7, 1, 2, 3]), number_ranges([4, 5])
    ('1–3, 7', '4, 5')
    """
    texts = list[str]()
    # successive numbers have one distance from their rank
    for _, group in groupby(enumerate(sorted(set(numbers))), key=lambda item: item[1] - item[0]):
        successive = [number for _, number in group]
        if len(successive) > 2:
            texts.append(f"{successive[0]}–{successive[-1]}")
        else:
            texts += map(str, successive)
    return ", ".join(texts)


def _best_middle(
    number: int,
    half_size: Array,
    marks: Array,
    curves: Array,
    occupied: Sequence[tuple[Array, Array]],
    extent: Array,
) -> Array | None:
    """Return the middle (2,) of a mark's text where it disturbs least; None if it has no room.

    All lengths and places are in points.

    Parameters
    ----------
    number
        Number of the mark.
    half_size
        (2,) half the size of the text.
    marks, curves
        (n, 2) places of all marks, and points of all curves.
    occupied
        Boxes that the text must not cover: middle and half of the size, (2,) each.
    extent
        (2,) size of the axes, within which the text must be.
    """
    mark: Array = marks[number]
    middles = [
        mark + np.array(direction) * (half_size + MARK_DISTANCE) for direction in TEXT_DIRECTIONS
    ]
    free_middles = [
        middle
        for middle in middles
        if _is_inside(middle, half_size, extent) and _is_free(middle, half_size, occupied)
    ]
    if not free_middles:
        return None
    return min(free_middles, key=partial(_faults, mark, half_size, marks, curves))


def _faults(
    mark: Array, half_size: Array, marks: Array, curves: Array, middle: Array
) -> tuple[int, int]:
    """Return how much a text beside a mark disturbs: (nearer marks, covered points of curves).

    A reader would relate the text to a nearer mark. Such marks count first: tuples are compared by
    their first numbers.

    Parameters
    ----------
    mark, half_size
        (2,) the mark of the text, and half the size of the text.
    marks, curves
        (n, 2) all marks, and points of all curves.
    middle
        (2,) middle of the text; all in points.
    """
    distance_from_own_mark = np.linalg.norm(mark - middle)
    is_nearer = np.linalg.norm(marks - middle, axis=1) < distance_from_own_mark - ROUNDING
    is_covered = (np.abs(curves - middle) < half_size).all(axis=1)
    return int(is_nearer.sum()), int(is_covered.sum())


def _is_inside(middle: Array, half: Array, extent: Array) -> bool:
    """Whether a text lies within the axes.

    Its middle, half its size, and the extent of the axes are (2,) in points.
    """
    return bool(((middle - half > 0) & (middle + half < extent)).all())


def _is_free(middle: Array, half: Array, occupied: Sequence[tuple[Array, Array]]) -> bool:
    """Whether a text covers none of the occupied boxes.

    A box is its middle and half its size, (2,) in points.
    """
    return not any(
        bool((np.abs(middle - occupied_middle) < half + occupied_half).all())
        for occupied_middle, occupied_half in occupied
    )


def shell_caption(h: float, nu: float, row: Row) -> str:
    """Return R/h, Poisson's ratio and the fields at a row of path.csv, for a caption.

    `h` is the thickness over R, and `nu` Poisson's ratio.
    """
    texts = [rf"$R/h$ = {1 / h:.6g}", rf"$\nu$ = {nu:g}"]
    texts += [named_value(column, row) for column in field_columns() if row[column]]
    return ", ".join(texts)


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
    >>> row = {"field_angle": 0.0, "p_over_pc": 0.25, "amplitude": "pressure", "my_springs": 0.02}
    >>> row |= dict.fromkeys(field_columns(), 0.0)
    >>> caption(0.01, 0.5, row, amplitudes=["pressure", "my_springs"])
    '$R/h$ = 100, $\\nu$ = 0.5, $p/p_\\mathrm{c}$ = 0.25, my springs = 0.02'
    """
    # loads that are zero are left out
    items = [shell_caption(h, nu, row)]
    if row["field_angle"]:
        items.append(rf"turned by ${row['field_angle']:.4g}\degree$")
    if row["p_over_pc"]:
        items.append(named_value("p_over_pc", row, digits=5))
    if row.get("force"):
        displacement = f"{named_value('w_over_h', row)} {amplitude('force').place}"
        items.append(f"{named_value('force', row)}, {displacement}")
    if "load_factor" in row:
        items.append(f"{named_value('load_factor', row)}, {named_value('w_over_h', row)}")
    if row["amplitude"] == "time":
        items.append(named_value("time", row))
    # other amplitudes, such as those of user-defined energies
    columns_of_amplitudes = (amplitude(name).column for name in amplitudes)
    shown_columns = (*field_columns(), *CAPTION_COLUMNS)
    items += [
        named_value(column, row)
        for column in columns_of_amplitudes
        if column not in shown_columns and row.get(column)
    ]
    return ", ".join(items)


def named_value(name: str, row: Row, digits: int = 4) -> str:
    """Return "symbol = value" of a column of a row, in the case's units if the row has them."""
    q = shown_quantity(name, row)  # of another name if it is in units
    unit = q.si.replace("%", r"\%") if q.name != name else ""
    return f"{q.latex} = {in_mathematics(float(row[q.name]), digits)}{f' {unit}' if unit else ''}"


def in_mathematics(value: float, digits: int) -> str:
    r"""Return a number with `digits` digits, and a power of ten in place of an exponent.

    Examples
    --------
    >>> in_mathematics(0.32623, 4), in_mathematics(-5.5, 4), in_mathematics(-1.5e-06, 4)
    ('0.3262', '−5.5', '$-1.5 \\times 10^{-6}$')
    """
    mantissa, _, exponent = format_number(value, f".{digits}g").partition("e")
    if exponent:
        return rf"${mantissa} \times 10^{{{int(exponent)}}}$"
    return mantissa.replace("-", "−")

"""Numbers and captions under pictures."""

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
WIDE, TALL = 0.6, 0.95  # a digit, over the size of the font
APART = 4.0  # between a mark and its number, in points
NAMED = (
    "lambda_m",
    "field_angle",
    "p_over_pc",
    "force",
    "load_factor",
    "time",
)  # in captions where they are not zero
AWAY = [
    (-1, 1),
    (1, 1),
    (-1, -1),
    (1, -1),
    (0, 1.3),
    (0, -1.3),
    (-1.3, 0),
    (1.3, 0),
]  # the preferred first
MARK = 3.0  # half the size of a mark, in points


def write_numbers(
    axes: "Axes", marks: Sequence[tuple[tuple[float, float], str]], curves: Sequence[Array]
) -> None:
    """Write texts beside marks at places of the data; those that would cover others, or other
    marks, are left out.

    Parameters
    ----------
    curves
        Places (2, n) that a number had better not cover.
    """
    from matplotlib import rcParams

    if not marks:
        return
    box, figure = axes.get_position(), axes.get_figure(root=True)
    assert figure
    wide, tall = 72 * figure.get_size_inches()
    size, (left, right), (low, high) = rcParams["font.size"], axes.get_xlim(), axes.get_ylim()
    reach = np.array([box.width * wide, box.height * tall])  # of the axes, in points

    def in_points(places: Array) -> Array:
        return np.asarray((places - [left, low]) / [right - left, high - low] * reach)

    at = in_points(np.array([place for place, _ in marks], float))
    line = np.concatenate([in_points(curve.T) for curve in curves]) if curves else np.zeros((0, 2))
    taken = [(place, np.full(2, MARK)) for place in at]
    for i, (_, text) in enumerate(marks):
        place: Array = at[i]
        half = np.array([WIDE * len(text), TALL]) * size / 2
        middles = [place + np.array(away) * (half + APART) for away in AWAY]
        free = [
            m
            for m in middles
            if _inside(m, half, reach) and not any(_meet(m, half, *other) for other in taken)
        ]
        if not free:
            continue
        best = min(free, key=partial(_fault, place, half, at, line))
        taken.append((best, half))
        axes.text(
            best[0] / reach[0],
            best[1] / reach[1],
            text,
            transform=axes.transAxes,
            ha="center",
            va="center",
        )


def _fault(place: Array, half: Array, marks: Array, line: Array, middle: Array) -> tuple[int, int]:
    """How many marks a text is nearer to than to its own, and how many points of curves it covers."""
    nearer = np.linalg.norm(marks - middle, axis=1) < np.linalg.norm(place - middle) - 1e-9
    return int(nearer.sum()), int((np.abs(line - middle) < half).all(axis=1).sum())


def _inside(middle: Array, half: Array, reach: Array) -> bool:
    return bool(((middle - half > 0) & (middle + half < reach)).all())


def _meet(middle: Array, half: Array, other: Array, its_half: Array) -> bool:
    return bool((np.abs(middle - other) < half + its_half).all())


def shell_caption(h: float, nu: float, row: Row) -> str:
    """R/h, Poisson's ratio and the field, from the thickness h over R and nu."""
    text = rf"$R/h$ = {1 / h:.6g}, $\nu$ = {nu:g}"
    return text + (f", {named_value('lambda_m', row)}" if row["lambda_m"] else "")


def caption(h: float, nu: float, row: Row, driven: Iterable[str] = ()) -> str:
    """The shell and its loads at a point.

    Parameters
    ----------
    driven
        Amplitudes that have been driven up to there.

    Examples
    --------
    >>> row = {"lambda_m": 0.0, "field_angle": 0.0, "p_over_pc": 0.25, "amplitude": "pressure"}
    >>> caption(0.01, 0.5, row | {"my_springs": 0.02}, driven=["pressure", "my_springs"])
    '$R/h$ = 100, $\\\\nu$ = 0.5, $p/p_\\\\mathrm{c}$ = 0.25, my springs = 0.02'
    """
    parts = [shell_caption(h, nu, row)]
    if row["field_angle"]:
        parts.append(rf"turned by ${row['field_angle']:.4g}\degree$")
    if row["p_over_pc"]:
        parts.append(named_value("p_over_pc", row, 5))
    if row.get("force"):
        parts.append(
            f"{named_value('force', row)}, {named_value('w_over_h', row)} {amplitude('force').place}"
        )
    if "load_factor" in row:
        parts.append(f"{named_value('load_factor', row)}, {named_value('w_over_h', row)}")
    if row["amplitude"] == "time":
        parts.append(named_value("time", row))
    others = (amplitude(name).column for name in driven)
    parts += [
        named_value(column, row) for column in others if column not in NAMED and row.get(column)
    ]
    return ", ".join(parts)


def named_value(name: str, row: Row, digits: int = 4) -> str:
    """A column of a row, in the case's units if it has any."""
    q = shown_quantity(name, row)
    unit = q.si.replace("%", r"\%") if q.name != name else ""
    return f"{q.latex} = {in_mathematics(float(row[q.name]), digits)}{f' {unit}' if unit else ''}"


def in_mathematics(value: float, digits: int) -> str:
    """A number with so many digits, with a power of ten where Python has an exponent.

    Examples
    --------
    >>> in_mathematics(0.32623, 4), in_mathematics(-5.5, 4), in_mathematics(-1.5e-06, 4)
    ('0.3262', '−5.5', '$-1.5 \\\\times 10^{-6}$')
    """
    mantissa, _, exponent = format_number(value, f".{digits}g").partition("e")
    return (
        rf"${mantissa} \times 10^{{{int(exponent)}}}$" if exponent else mantissa.replace("-", "−")
    )

"""The path as a table of the report: the columns of path.csv that vary, with their names."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isclose

from markupsafe import Markup

from magshell_fenicsx.output.store.table import POLE, pole_name
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import amplitude, quantity, shown

ROUNDING = 1e-15, 1e-9  # displacements and forces as small as this, in any unit or over their largest, are zero
LEAST, MOST = 1e-3, 1e6  # magnitudes between them are written without a power of ten
DIGITS = 6


def number(value: float, digits: int = DIGITS) -> Markup:
    """A number with at most `digits` significant digits.

    Examples
    --------
    >>> number(0.32623330500000004), number(90.0), number(1.84e-05), number(1e-4)
    (Markup('0.326233'), Markup('90'), Markup('1.84 · 10<sup>−5</sup>'), Markup('10<sup>−4</sup>'))
    """
    if value == 0 or LEAST <= abs(value) < MOST:
        return _signed(f"{value:.{digits}g}")
    mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    short = mantissa.rstrip("0").rstrip(".")
    return (Markup() if short == "1" else _signed(short) + Markup(" · ")) + power(int(exponent))


def above_rounding(value: float, along: Iterable[float] = ()) -> float:
    """The value, or zero if it is as small as rounding, also beside the values along a path.

    Examples
    --------
    >>> above_rounding(3.5e-14, [76.4]), above_rounding(3.5e-14, [1e-13])
    (0.0, 3.5e-14)
    """
    largest = max((abs(v) for v in along if math.isfinite(v)), default=0.0)
    return value if abs(value) > max(ROUNDING[0], ROUNDING[1] * largest) else 0.0


def column(values: Sequence[float], beside: Sequence[float] = ()) -> tuple[int, list[Markup]]:
    """A column of numbers with a common power of ten and equally many decimals; nan is left empty.

    `beside` are numbers of other columns with the same power of ten and the same decimals.

    Examples
    --------
    >>> column([0.0, -1.5e-06, 2.25e-05])
    (-5, [Markup('0.00'), Markup('−0.15'), Markup('2.25')])
    """
    largest = max((abs(v) for v in (*values, *beside) if math.isfinite(v)), default=0.0)
    order = math.floor(math.log10(largest)) if largest else 0
    exponent = 0 if LEAST <= largest < MOST or not largest else order
    texts = [f"{v / 10.0**exponent:.{max(0, DIGITS - 1 - order + exponent)}f}" for v in values]
    if largest and "." in texts[0]:
        spare = min(len(t) - len(t.rstrip("0")) for t, v in zip(texts, values, strict=True) if math.isfinite(v))
        texts = [t[: len(t) - spare].rstrip(".") for t in texts]
    return exponent, [_signed(t) if math.isfinite(v) else Markup("") for t, v in zip(texts, values, strict=True)]


def power(exponent: int) -> Markup:
    """A power of ten."""
    return Markup("10<sup>{}</sup>").format(_signed(str(exponent)))


def _signed(text: str) -> Markup:
    """Use a typographic minus sign, and none before zero."""
    return Markup(text.removeprefix("-") if not text.strip("-0.") else text.replace("-", "−"))


Line = Mapping[str, str]  # a row of path.csv
ORDER = (
    "text",
    "load",
    "displacement",
    "energy",
    "error",
    "time",
    "place",
    "reaction",
    "moment",
    "count",
)  # order of the columns by kind


@dataclass(frozen=True)
class Column:
    """A column of the table."""

    head: Markup
    unit: Markup
    cells: Sequence[str]
    numeric: bool = True


def symbol(name: str) -> Markup:
    """The heading of a column of numbers; a named point or a user-defined amplitude has its own name."""
    return head(quantity(name))


def head(known: Quantity) -> Markup:
    """The heading of a quantity."""
    return Markup(known.html) if known.symbol else Markup("{}").format(known.words)


def pole_head(line: Line, pole: str = POLE) -> Markup:
    """The heading of w_pole_over_h, with the point that it belongs to."""
    return Markup("{}, {}").format(head(shown("w_pole_over_h", line)), pole_name(line, pole).removeprefix("the "))


def path_table(lines: Sequence[Line], length_unit: str, pole: str = POLE) -> list[Column]:
    """The columns that vary, in the order of interest; a displacement equal to an earlier one is left out.

    What is in the case's units is shown in these alone.

    Parameters
    ----------
    length_unit
        Unit of the displacements of named points.
    pole
        Name of the point of w_pole_over_h.
    """
    there = lines[0] if lines else {}
    in_units = {known.name for name in there if (known := shown(name, there)).name != name}
    names = [name for name in there if name != "point" and name not in in_units]
    order = ["point", *sorted(names, key=lambda name: ORDER.index(quantity(name).kind))]
    found: dict[str, list[str]] = {}
    for name in order:
        values = [line.get(name, "") for line in lines]
        again = name.startswith("w_") and any(_same(values, other) for key, other in found.items() if key[:2] == "w_")
        if name in ("point", "label") or (len(set(values)) > 1 and not again):
            found[name] = values
    energies = _energies(lines, [name for name in found if quantity(name).kind == "energy"])
    table = {}
    for name in found:
        known = shown(name, there)
        of_all = energies if known.kind == "energy" else ()
        table[name] = _column(known, [line.get(known.name, "") for line in lines], length_unit, of_all)
    if at_pole := table.get("w_pole_over_h"):
        table["w_pole_over_h"] = replace(at_pole, head=pole_head(lines[0], pole))
    return list(table.values())


def _energies(lines: Sequence[Line], names: Sequence[str]) -> list[float]:
    """All energies of a path: their columns have one power of ten, so that they can be compared."""
    return [float(line[shown(name, line).name]) for line in lines for name in names]


def _column(known: Quantity, values: Sequence[str], length_unit: str, beside: Sequence[float] = ()) -> Column:
    """A column; `beside` are the numbers of others with the same power of ten."""
    if known.kind == "text":
        varied = [quantity(amplitude(value).column).words for value in values] if known.name == "amplitude" else values
        return Column(head(known), Markup(), varied, numeric=False)
    if known.kind == "count":
        return Column(head(known), Markup(), values)
    exponent, cells = column([float(value) for value in values], beside)
    size = power(exponent) if exponent else Markup()
    title = Markup("{} {}").format(head(known), known.note) if known.note else head(known)
    in_case = {"place": "m", "reaction": "N", "moment": "N m"}  # of a path.csv without columns in units
    unit = known.shown_unit or (in_case.get(known.kind, "") if length_unit else "")
    return Column(title, Markup("{} {}").format(size, unit), cells)


def _same(values: Sequence[str], others: Sequence[str]) -> bool:
    """Whether two columns have equal numbers, up to rounding."""
    return all(isclose(float(a), float(b), rel_tol=1e-9, abs_tol=1e-9) for a, b in zip(values, others, strict=True))

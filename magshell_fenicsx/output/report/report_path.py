"""The path as a table of the report: the columns of path.csv that vary, with their names."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isclose

from markupsafe import Markup

from magshell_fenicsx.output.report.html_numbers import column, power
from magshell_fenicsx.output.store.table import POLE, pole_name
from magshell_fenicsx.quantities.registry import amplitude, quantity

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
    known = quantity(name)
    return Markup(known.html) if known.symbol else Markup("{}").format(known.words)


def pole_head(line: Line, pole: str = POLE) -> Markup:
    """The heading of w_pole_over_h, with the point that it belongs to."""
    return Markup("{}, {}").format(symbol("w_pole_over_h"), pole_name(line, pole).removeprefix("the "))


def path_table(lines: Sequence[Line], length_unit: str, pole: str = POLE) -> list[Column]:
    """The columns that vary, in the order of interest; a displacement equal to an earlier one is left out.

    Parameters
    ----------
    length_unit
        Unit of the displacements of named points.
    pole
        Name of the point of w_pole_over_h.
    """
    names = [name for name in (lines[0] if lines else ()) if name != "point"]
    order = ["point", *sorted(names, key=lambda name: ORDER.index(quantity(name).kind))]
    found: dict[str, list[str]] = {}
    for name in order:
        values = [line.get(name, "") for line in lines]
        again = name.startswith("w_") and any(_same(values, other) for key, other in found.items() if key[:2] == "w_")
        if name in ("point", "label") or (len(set(values)) > 1 and not again):
            found[name] = values
    table = {name: _column(name, values, length_unit) for name, values in found.items()}
    if there := table.get("w_pole_over_h"):
        table["w_pole_over_h"] = replace(there, head=pole_head(lines[0], pole))
    return list(table.values())


def _column(name: str, values: Sequence[str], length_unit: str) -> Column:
    known = quantity(name)
    if known.kind == "text":
        varied = [quantity(amplitude(value).column).words for value in values] if name == "amplitude" else values
        return Column(symbol(name), Markup(), varied, numeric=False)
    if known.kind == "count":
        return Column(symbol(name), Markup(), values)
    exponent, cells = column([float(value) for value in values])
    size = power(exponent) if exponent else Markup()
    head = Markup("{} {}").format(symbol(name), known.note) if known.note else symbol(name)
    in_case = {"place": "m", "reaction": "N", "moment": "N m"}  # columns in the case's units
    unit = (in_case[known.kind] if length_unit else "") if known.kind in in_case else known.shown_unit
    return Column(head, Markup("{} {}").format(size, unit), cells)


def _same(values: Sequence[str], others: Sequence[str]) -> bool:
    """Whether two columns have equal numbers, up to rounding."""
    return all(isclose(float(a), float(b), rel_tol=1e-9, abs_tol=1e-9) for a, b in zip(values, others, strict=True))

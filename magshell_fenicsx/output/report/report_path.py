"""The path as a table of a report: the columns of path.csv that vary, and what they are called."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isclose

from markupsafe import Markup

from magshell_fenicsx.output.report.html_numbers import column, power
from magshell_fenicsx.output.store.table import pole_name

Line = Mapping[str, str]  # of path.csv
WORDS = {"label": "what", "mode": "mode", "amplitude": "varied"}
COUNTS = {
    "point": "point",
    "negative_pivots": "unstable directions",
    "negative_pivots_held": "unstable, w held",
    "excluded_pivots": "unstable, excluded",
    "iterations": "iterations",
    "factorisations": "factor&shy;isations",
    "branch": "branch",
}
ENERGY = "E h R²"
NUMBERS = {
    "p_over_pc": ("p/p<sub>c</sub>", ""),
    "lambda_m": ("λ<sub>m</sub>", ""),
    "field_angle": ("field angle", "degrees"),
    "force": ("F R/(2πD)", ""),
    "load_factor": ("load factor", ""),
    "w_over_h": ("w/h", ""),
    "w_from_field_over_h": ("w/h since the field", ""),
    "w_pole_over_h": ("w/h", ""),
    "w_point_over_h": ("w/h, point", ""),
    "volume_change": ("ΔV/R³", ""),
    "energy": ("energy", ENERGY),
    "stretching": ("stretching", ENERGY),
    "bending": ("bending", ENERGY),
    "magnetic": ("magnetic", ENERGY),
    "U1": ("U<sub>1</sub>", ENERGY),
    "Uq": ("U<sub>q</sub>", ENERGY),
    "Utau": ("U<sub>τ</sub>", ENERGY),
    "error_over_h": ("error of u", "h"),
    "load_error": ("error of the load", ""),
    "wall_s": ("time", "s"),
}
AMPLITUDES = {"pressure": "pressure", "force": "force", "load": "loads", "lambda_m": "field", "angle": "field angle"}


@dataclass(frozen=True)
class Column:
    """A column of the table: what stands above it and in it."""

    head: Markup
    unit: Markup
    cells: Sequence[str]
    numeric: bool = True


def symbol(name: str) -> Markup:
    """What a column of numbers is called; that of a named point or of one's own amplitude by its name."""
    return Markup(NUMBERS[name][0]) if name in NUMBERS else Markup("{}").format(name.replace("_", " "))


def pole_head(line: Line) -> Markup:
    """What stands above w_pole_over_h: whose displacement it is."""
    return Markup("{}, {}").format(symbol("w_pole_over_h"), pole_name(line).removeprefix("the "))


def path_table(lines: Sequence[Line], length_unit: str) -> list[Column]:
    """The columns that vary, in the order of people's interest; a displacement that is another one is left out.

    Parameters
    ----------
    length_unit
        Of the displacements of named points.
    """
    own = [name for name in (lines[0] if lines else ()) if name not in COUNTS]
    order = dict.fromkeys(("point", *WORDS, "branch", *NUMBERS, *own, *COUNTS))
    found: dict[str, list[str]] = {}
    for name in order:
        values = [line.get(name, "") for line in lines]
        again = name.startswith("w_") and any(_same(values, other) for key, other in found.items() if key[:2] == "w_")
        if name in ("point", "label") or (len(set(values)) > 1 and not again):
            found[name] = values
    table = {name: _column(name, values, length_unit) for name, values in found.items()}
    if pole := table.get("w_pole_over_h"):
        table["w_pole_over_h"] = replace(pole, head=pole_head(lines[0]))
    return list(table.values())


def _column(name: str, values: Sequence[str], length_unit: str) -> Column:
    if name in WORDS:
        return Column(Markup(WORDS[name]), Markup(), [AMPLITUDES.get(value, value) for value in values], numeric=False)
    if name in COUNTS:
        return Column(Markup(COUNTS[name]), Markup(), values)
    exponent, cells = column([float(value) for value in values])
    unit = NUMBERS[name][1] if name in NUMBERS else length_unit
    size = power(exponent) if exponent else Markup()
    return Column(symbol(name), Markup("{} {}").format(size, unit), cells)


def _same(values: Sequence[str], others: Sequence[str]) -> bool:
    """Numbers, but for rounding."""
    return all(isclose(float(a), float(b), rel_tol=1e-9, abs_tol=1e-9) for a, b in zip(values, others, strict=True))

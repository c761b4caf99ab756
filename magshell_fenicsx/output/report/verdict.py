"""The result of a run for its report: sentences, and the path as a table of the varying columns.

Input: summary.json and the lines of path.csv. Output: HTML, or text for a terminal.

A line is a row of path.csv as text: one point of the path. Its label is "fold" or "bifurcation" at
an instability, its branch "0" on the main path, its amplitude the load parameter that varied. The
pole is the point whose displacement the column w_pole_over_h has. A quantity knows name, symbol,
words and unit of a column; the shown one (`shown_quantity`) is in the case's units if path.csv has
such a column, and else the column itself. Markup is text that is HTML already. The summary is the
content of summary.json; its key "in_units" has results in units, if the case has units.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import unescape
from math import atan2, degrees, hypot, isclose
from pathlib import Path
from types import MappingProxyType
from typing import Any

from markupsafe import Markup

from magshell_fenicsx.output.store.durable import damage
from magshell_fenicsx.output.store.stored_results import is_flat, pole_of, read_summary, shell_of
from magshell_fenicsx.output.store.table import LOCATED, POLE, pole_name, read_lines
from magshell_fenicsx.quantities.mode_labels import ANTISYMMETRIC
from magshell_fenicsx.quantities.quantity import Quantity, number_with_error, plain_text
from magshell_fenicsx.quantities.registry import (
    OWN_MODES,
    amplitude,
    axes_of,
    quantity,
    shown_quantity,
)

# displacements and forces as small as this are zero: in any unit, and over their largest
ABSOLUTE_ROUNDING, RELATIVE_ROUNDING = 1e-15, 1e-9
MIN_PLAIN, MAX_PLAIN = 1e-3, 1e6  # magnitudes between them are written without a power of ten
DIGITS = 6
MIN_OVERSHOOT = 0.1  # per cent
Summary = Mapping[str, Any]
NO_ERRORS: Mapping[str, float] = MappingProxyType({})
END = "@end"  # what the name of a column at the last point ends with
ON_AXIS = 0.5  # degrees: an azimuth there is that of a node beside the pole
# degrees: a dimple at the pole is deepest on a ring as small as this, at no azimuth
NEAR_POLE = 5.0
SAME_RESULT_TOLERANCE = 1e-5  # relative, of a result of adaptive rounds and that of the run
EQUAL_COLUMNS_TOLERANCE = 1e-9  # relative and absolute


def number(value: float, digits: int = DIGITS, error: float | None = None) -> Markup:
    """Return a number with at most `digits` significant digits.

    An estimated error that changes these digits stands behind them; see `number_with_error`.

    Examples
    --------
    >>> number(0.32623330500000004), number(90.0), number(1.84e-05), number(1e-4)
    (Markup('0.326233'), Markup('90'), Markup('1.84 · 10<sup>−5</sup>'), Markup('10<sup>−4</sup>'))
    >>> number(0.3262333, error=1.2e-4), number(1.84e-05, error=2e-8)
    (Markup('0.3262(2)'), Markup('1.840(2) · 10<sup>−5</sup>'))
    """
    mantissa, _, exponent = number_with_error(value, error, digits).partition("e")
    if mantissa.endswith(")"):
        return _signed(mantissa) + (Markup(" · ") + power(int(exponent)) if exponent else "")
    if value == 0 or MIN_PLAIN <= abs(value) < MAX_PLAIN:
        return _signed(f"{value:.{digits}g}")
    mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    trimmed = mantissa.rstrip("0").rstrip(".")
    return (Markup() if trimmed == "1" else _signed(trimmed) + Markup(" · ")) + power(int(exponent))


def above_rounding(value: float, path: Iterable[float] = ()) -> float:
    """Return the value, or zero if it is as small as rounding over the largest number of a path.

    Examples
    --------
    >>> above_rounding(3.5e-14, [76.4]), above_rounding(3.5e-14, [1e-13])
    (0.0, 3.5e-14)
    """
    largest = max((abs(v) for v in path if math.isfinite(v)), default=0.0)
    return value if abs(value) > max(ABSOLUTE_ROUNDING, RELATIVE_ROUNDING * largest) else 0.0


def column(
    values: Sequence[float], other_columns: Sequence[float] = ()
) -> tuple[int, list[Markup]]:
    """Return numbers as cells with a common power of ten and equally many decimals.

    A nan becomes an empty cell.

    Parameters
    ----------
    values
        Numbers of the column.
    other_columns
        Numbers of other columns with the same power of ten and the same decimals.

    Returns
    -------
    The exponent of the power of ten, and the cells.

    Examples
    --------
    >>> column([0.0, -1.5e-06, 2.25e-05])
    (-5, [Markup('0.00'), Markup('−0.15'), Markup('2.25')])
    """
    largest = max(
        (abs(value) for value in (*values, *other_columns) if math.isfinite(value)), default=0.0
    )
    order = math.floor(math.log10(largest)) if largest else 0  # power of ten of the first digit
    exponent = 0 if MIN_PLAIN <= largest < MAX_PLAIN or not largest else order
    decimals = max(0, DIGITS - 1 - order + exponent)  # the largest number has DIGITS digits
    texts = [f"{value / 10.0**exponent:.{decimals}f}" for value in values]
    # zeros that end all cells are dropped, as in 0.50 and 0.20
    if largest and "." in texts[0]:
        trailing_zeros = min(
            len(text) - len(text.rstrip("0"))
            for text, value in zip(texts, values, strict=True)
            if math.isfinite(value)
        )
        texts = [text[: len(text) - trailing_zeros].rstrip(".") for text in texts]
    cells = [
        _signed(text) if math.isfinite(value) else Markup("")
        for text, value in zip(texts, values, strict=True)
    ]
    return exponent, cells


def power(exponent: int) -> Markup:
    """Return ten to the power of `exponent` in HTML."""
    return Markup("10<sup>{}</sup>").format(_signed(str(exponent)))


def _signed(text: str) -> Markup:
    """Return the text of a number with a typographic minus sign, and with none before zero."""
    return Markup(text.removeprefix("-") if not text.strip("-0.") else text.replace("-", "−"))


Line = Mapping[str, str]  # a row of path.csv
# order of the columns by kind
COLUMN_ORDER = (
    "text",
    "load",
    "displacement",
    "energy",
    "error",
    "time",
    "place",
    "reaction",
    "moment",
    "stress",
    "count",
)
MOST_TOLD = 4  # instabilities of the last step that a sentence names
# kind -> unit, of a path.csv without columns in units
UNIT_OF_KIND = {"place": "m", "reaction": "N", "moment": "N m"}


@dataclass(frozen=True)
class TableColumn:
    """Column of the table that a report shows of a path.

    Attributes
    ----------
    head, unit
        Heading, and the line with power of ten and unit below it.
    cells
        Text of each row.
    numeric
        Whether the cells are numbers.
    """

    head: Markup
    unit: Markup
    cells: Sequence[str]
    numeric: bool = True


def symbol(name: str) -> Markup:
    """Return the heading of a column of numbers.

    A named point or a user-defined amplitude has its own name.
    """
    return head(quantity(name))


def head(of_column: Quantity) -> Markup:
    """Return the heading of a quantity."""
    return Markup(of_column.html) if of_column.symbol else Markup("{}").format(of_column.words)


def pole_head(line: Line, pole: str = POLE) -> Markup:
    """Return the heading of w_pole_over_h with the name of the point, as HTML.

    `pole` names the point in a case without named points.
    """
    return Markup("{}, {}").format(
        head(shown_quantity("w_pole_over_h", line)), pole_name(line, pole).removeprefix("the ")
    )


def path_table(lines: Sequence[Line], length_unit: str, pole: str = POLE) -> list[TableColumn]:
    """Return the varying columns of a path for its table, in the order of interest.

    A displacement equal to an earlier one is left out. A quantity that also has a column in the
    case's units is shown in these alone.

    Parameters
    ----------
    lines
        Rows of path.csv as text.
    length_unit
        Unit of the displacements of named points; empty for a case without units.
    pole
        Name of the point of w_pole_over_h in a case without named points.
    """
    first_line = lines[0] if lines else {}
    names = _varying_columns(lines)
    # all energies have one power of ten, so that they can be compared
    energies = _energies(lines, [name for name in names if quantity(name).kind == "energy"])
    table = {}  # name of a column -> column of the table
    for name in names:
        # the column in units, if the path has it; otherwise the column itself
        column_quantity = shown_quantity(name, first_line)
        table[name] = _table_column(
            column_quantity,
            values=[line.get(column_quantity.name, "") for line in lines],
            length_unit=length_unit,
            other_columns=energies if column_quantity.kind == "energy" else (),
        )
    if at_pole := table.get("w_pole_over_h"):
        table["w_pole_over_h"] = replace(at_pole, head=pole_head(lines[0], pole))
    return list(table.values())


def _varying_columns(lines: Sequence[Line]) -> list[str]:
    """Return the names of the columns whose values vary, and of "point" and "label", in order.

    Columns in units and displacements that equal an earlier one are left out.
    """
    first_line = lines[0] if lines else {}
    # columns that are shown in place of another one, in units
    columns_in_units = {
        column_quantity.name
        for name in first_line
        if (column_quantity := shown_quantity(name, first_line)).name != name
    }
    names = [name for name in first_line if name != "point" and name not in columns_in_units]
    names_by_kind = sorted(names, key=lambda name: COLUMN_ORDER.index(quantity(name).kind))
    varying_columns: dict[str, list[str]] = {}  # name -> values, as text
    for name in ("point", *names_by_kind):
        values = [line.get(name, "") for line in lines]
        # names of displacements begin with w_; one that equals an earlier one is left out
        displacements = [
            earlier_values
            for key, earlier_values in varying_columns.items()
            if key.startswith("w_")
        ]
        is_repeated = name.startswith("w_") and any(
            _are_equal(values, earlier_values) for earlier_values in displacements
        )
        has_new_values = len(set(values)) > 1 and not is_repeated
        if name in ("point", "label") or has_new_values:
            varying_columns[name] = values
    return list(varying_columns)


def _energies(lines: Sequence[Line], names: Sequence[str]) -> list[float]:
    """Return all energies of a path, in the units in which they are shown.

    `names` are the energy columns. They share one power of ten, so that they can be compared.
    """
    return [float(line[shown_quantity(name, line).name]) for line in lines for name in names]


def _table_column(
    of_column: Quantity,
    values: Sequence[str],
    length_unit: str,
    other_columns: Sequence[float] = (),
) -> TableColumn:
    """Return a column of a path's table with heading, unit and cells.

    Parameters
    ----------
    of_column
        Quantity that the column shows.
    values
        Text of its cells in path.csv.
    length_unit
        Unit of the displacements of named points; empty for a case without units.
    other_columns
        Numbers of other columns that share the power of ten.
    """
    if of_column.kind == "text":
        texts = values
        if of_column.name == "amplitude":
            texts = [quantity(amplitude(value).column).words for value in values]
        return TableColumn(head(of_column), Markup(), texts, numeric=False)
    if of_column.kind == "count":
        return TableColumn(head(of_column), Markup(), values)
    exponent, cells = column([float(value) for value in values], other_columns)
    power_of_ten = power(exponent) if exponent else Markup()
    title = head(of_column)
    if of_column.note:
        title = Markup("{} {}").format(title, of_column.note)
    unit = of_column.shown_unit
    if not unit and length_unit:  # a quantity without a unit of its own has that of its kind
        unit = UNIT_OF_KIND.get(of_column.kind, "")
    return TableColumn(title, Markup("{} {}").format(power_of_ten, unit), cells)


def _are_equal(values: Sequence[str], others: Sequence[str]) -> bool:
    """Whether two columns have equal numbers, up to rounding."""
    return all(
        isclose(
            float(a), float(b), rel_tol=EQUAL_COLUMNS_TOLERANCE, abs_tol=EQUAL_COLUMNS_TOLERANCE
        )
        for a, b in zip(values, others, strict=True)
    )


def located(lines: Sequence[Line]) -> list[Line]:
    """Return the rows of a path that are folds or bifurcations."""
    return [line for line in lines if line["label"] in LOCATED]


def verdict(summary: Summary, lines: Sequence[Line]) -> Markup:
    """Return the result of a run in sentences, as HTML, and the reason if it stopped early.

    Parameters
    ----------
    summary
        Content of summary.json.
    lines
        Rows of path.csv as text.
    """
    loading = summary["case"].get("loading") or {}
    last_step = (loading[-1] or {}) if isinstance(loading, list) else loading
    until = last_step.get("until", "target")  # the event at which the run was to end
    first_instability = next((line for line in located(lines) if line["branch"] == "0"), None)
    # the end is of interest unless the run was to find the instability
    tells_end = not first_instability or until in ("target", "points")
    sentences = [_end(summary, lines)] if tells_end else []
    if first_instability:
        # an entry for each instability, in their order; in place of missing ones an empty entry
        entries = summary.get("limit_points") or [{}]
        entry = entries[min(located(lines).index(first_instability), len(entries) - 1)]
        mode_at = entry.get("mode_at")  # the place at which the mode is largest
        sentences.append(_instability(first_instability, summary, lines, mode_at))
        sentences += _instabilities_of_last_step(first_instability, summary, lines)
    if solutions := summary.get("solutions"):
        stable = sum(solution["stable"] for solution in solutions)
        noun = "further solution" + "s" * (len(solutions) != 1)
        sentences.append(
            Markup("A search has found {} {}, {} of them stable.").format(
                len(solutions), noun, stable or "none"
            )
        )
    if summary.get("barrier") is not None:
        sentences.append(_barrier(summary))
    sentences += _snaps(summary, lines)
    sentences += _error(summary, lines)
    sentences += [
        Markup("{}.").format(remark[0].upper() + remark[1:])
        for remark in summary.get("remarks", [])
    ]
    if summary["stopped"]:
        points = f"{len(lines)} point{'s' * (len(lines) != 1)}"
        sentences.insert(
            0, Markup("The run stopped early, after {}: {}.").format(points, summary["stopped"])
        )
    return Markup(" ").join(sentences)


def _snaps(summary: Summary, lines: Sequence[Line] = ()) -> list[Markup]:
    """Return a list with one sentence on the first snap; empty without a snap.

    The sentence says how long the snap takes from a tenth to nine tenths of its way, with which
    damping that the run has added, after its departure from the instability, and how far it goes
    beyond its end. A second one says what touches where it comes to rest.
    """
    snaps = summary.get("snaps")
    if not snaps or "jump" not in snaps[0]:  # of an earlier version
        return []
    in_ms = "snap_jump_ms" in summary  # times in ms are there if the case has units
    # the time from 10 to 90 % of the way, and that of the departure
    times = list[Markup]()
    for key in ("jump", "departure"):
        if in_ms:
            times.append(Markup("{} ms").format(number(summary[f"snap_{key}_ms"], digits=4)))
        else:
            times.append(number(snaps[0][key], digits=4))
    unit = Markup()
    if not in_ms:
        unit = Markup(" (times in R √(ρ/E); with a density of the shell they are in ms)")
    percent = 100 * float(snaps[0]["overshoot"])
    overshoot = Markup()
    if percent > MIN_OVERSHOOT:
        overshoot = Markup(", and overshoots by {} % of its way").format(number(percent, digits=2))
    words = (
        "The snap takes {} from 10 to 90 % of its way{}, after a departure from the {} of {}{}{}."
    )
    jump, departure = times
    start = _line_at(snaps[0].get("point"), lines)
    instability = "fold" if start.get("label", "fold") == "fold" else "bifurcation"
    damping = _damping_of_snap(summary, lines)
    sentences = [Markup(words).format(jump, damping, instability, departure, unit, overshoot)]
    if things_touched := _touched_at_rest(summary, lines):
        sentences.append(Markup("It comes to rest on {}.").format(" and ".join(things_touched)))
    return sentences


def _touched_at_rest(summary: Summary, lines: Sequence[Line]) -> list[str]:
    """Return what touches where the first snap comes to rest, in words: bodies, and shells."""
    rest = _line_at(summary["snaps"][0].get("rest"), lines)
    case = summary.get("case", {})
    columns = {f"{name}_normal_force": name for name in case.get("bodies") or {}}
    columns["contact_force"] = "another shell" if case.get("shells") else "itself"
    return [
        name
        for column, name in columns.items()
        if above_rounding(float(rest.get(column) or 0.0)) > 0
    ]


def _line_at(point: int | None, lines: Sequence[Line]) -> Line:
    """Return the line of the point with a number; empty if there is none."""
    return next((line for line in lines if int(line["point"]) == point), {})


def _damping_of_snap(summary: Summary, lines: Sequence[Line]) -> Markup:
    """Return words for the damping of the first snap, which slows it; empty if it is unknown."""
    fold = _line_at(summary["snaps"][0].get("point"), lines)
    loading = summary.get("case", {}).get("loading")
    steps = loading if isinstance(loading, list) else [loading]
    number_of_step = int(fold.get("step") or 0)
    if not 1 <= number_of_step <= len(steps):
        return Markup()
    section = (steps[number_of_step - 1] or {}).get("snap") or {}
    if "damping" not in section:  # of an earlier version
        return Markup()
    return Markup(" with the damping {} of snap").format(number(section["damping"]))


def _error(summary: Summary, lines: Sequence[Line]) -> list[Markup]:
    """Return a list with one sentence on the estimated error; empty for a run without a tolerance.

    If another mesh of the adaptive rounds had a smaller estimate, the sentence names that too.
    """
    tolerance = summary.get("tolerance") or {}
    if (estimate := tolerance.get("error_estimate")) is None:
        return []
    best = tolerance.get("best")  # the round of meshes with the smallest estimate
    sentence = Markup("The estimated relative error of {} is {}").format(
        _result_of_rounds(summary, lines), number(estimate, digits=2)
    )
    # `best` is the round with the smallest estimate
    if best and best["error_estimate"] < estimate:
        sentence += Markup("; another mesh gives {} with {}").format(
            number(best["result"], digits=9), number(best["error_estimate"], digits=2)
        )
    on_branch = (tolerance.get("branch") or {}).get("error_estimate")
    if on_branch is not None:
        sentence += Markup(", that of the bifurcation; at the end of the branch it is {}").format(
            number(on_branch, digits=2)
        )
    return [sentence + "."]


def _result_of_rounds(summary: Summary, lines: Sequence[Line]) -> str:
    """Return words for the result that the adaptive rounds compare.

    At an instability it is the load there. At a target it is the load, or the displacement that is
    conjugate to it, on which it does work.
    """
    loading = summary["case"].get("loading") or {}
    last_step = (loading[-1] or {}) if isinstance(loading, list) else loading
    on_path = [line for line in lines if line["branch"] == "0" and line["amplitude"]]
    ends = [line for line in on_path if line["label"] not in LOCATED]
    to_target = last_step.get("until", "target") in ("target", "points", "zero")
    if not ends or not to_target or summary["stopped"]:
        return "the result"
    results = [mesh_round["result"] for mesh_round in summary["tolerance"]["rounds"]]

    def is_result(line: Line) -> bool:
        """Whether a round of meshes has the load of a line as its result."""
        load = float(line.get(amplitude(line["amplitude"]).column) or math.nan)
        return any(isclose(load, result, rel_tol=SAME_RESULT_TOLERANCE) for result in results)

    load_at_end = amplitude(ends[-1]["amplitude"])
    words = quantity(load_at_end.column).words
    if is_result(ends[-1]):
        return f"the {words} at the end"
    if any(is_result(line) for line in located(on_path)):  # where the run goes over to a branch
        return "the load at the instability"
    return f"the displacement conjugate to the {words} at the end"


def _barrier(summary: Summary) -> Markup:
    """Return a sentence on the energy barrier, in E h R², and in mJ in a case with units."""
    measured = summary.get("in_units", {}).get("barrier_mJ")
    size = Markup(" ({} mJ)").format(number(measured)) if measured is not None else ""
    error = summary.get("errors", {}).get("barrier")
    barrier = number(summary["barrier"], error=error)
    return Markup("The energy barrier is {} E h R²{}.").format(barrier, size)


def value(line: Line, summary: Summary, errors: Mapping[str, float] = NO_ERRORS) -> Markup:
    """Return the amplitude that varied at a point, such as "p/p_c = 0.326233 (53.7 Pa)".

    It is in units alone, "t = 2 s", where the dimensionless number is the same. So is the pressure
    on a flat shell, for which p_c means nothing.

    Parameters
    ----------
    errors
        Column -> its estimated error at the point.
    """
    name = amplitude(line["amplitude"]).column
    degree_sign = "°" if line["amplitude"] == "angle" else ""
    shown_column = shown_quantity(name, line)  # in units, or the column itself
    has_unit = shown_column.name != name
    # whether the column in units has the same symbol and the same number
    is_same_number = float(line[shown_column.name]) == float(line[name])
    is_same_in_units = shown_column.symbol == quantity(name).symbol and is_same_number
    is_flat_pressure = name == "p_over_pc" and is_flat(summary["case"])
    is_clear_in_units = is_same_in_units or is_flat_pressure
    if has_unit and is_clear_in_units:
        return Markup("{} = {} {}").format(
            head(shown_column),
            number(float(line[shown_column.name]), error=errors.get(shown_column.name)),
            shown_column.si,
        )
    measured = Markup()
    if has_unit:
        measured = Markup(" ({} {})").format(
            number(float(line[shown_column.name])), shown_column.si
        )
    return Markup("{} = {}{}{}").format(
        symbol(name), number(float(line[name]), error=errors.get(name)), degree_sign, measured
    )


def terminal_text(sentence: Markup) -> str:
    """Return an HTML sentence as plain text for a terminal.

    Examples
    --------
    >>> terminal_text(Markup("ω<sub>1</sub> = −1.84 · 10<sup>−5</sup> (10<sup>2</sup> Pa) &lt; 1"))
    'omega_1 = -1.84e-5 (1e2 Pa) < 1'
    """
    text = str(sentence).replace(" · 10<sup>", "e").replace("10<sup>", "1e").replace("−", "-")
    return plain_text(unescape(re.sub(r"</?su[bp]>", "", text.replace("<sub>", "_"))))


def sentence_of(folder: Path) -> str:
    """Return the result of the run in a folder as plain text for a terminal."""
    summary, lines = read_run(folder)
    return terminal_text(verdict(summary, lines))


def read_run(folder: Path) -> tuple[Summary, Sequence[Line]]:
    """Return the content of summary.json and the rows of path.csv, as text, from a run's folder.

    Raises
    ------
    Damaged
        If one of the files cannot be read, or they do not belong together.
    """
    summary, lines = read_summary(folder), read_lines(folder / "path.csv")
    if len(lines) != summary["points"]:
        raise damage(
            folder / "path.csv",
            f"it has {len(lines)} points, and summary.json says {summary['points']}",
        )
    return summary, lines


def _instability(
    line: Line, summary: Summary, lines: Sequence[Line], mode_at: Sequence[float] | None
) -> Markup:
    """Return a sentence on the first instability of a path.

    Parameters
    ----------
    line
        Row of path.csv of the instability.
    lines
        All rows; they show which displacements are as small as rounding.
    mode_at
        Place (3,) over R at which the mode is largest; None if unknown.
    """
    kind = _kind(line)
    load = value(line, summary, _errors_of_load(line, summary))
    displacement = _displacement(line, pole_name(line, pole_of(summary["case"])), lines)
    if line["amplitude"] == "pressure" and summary["knockdown"] is not None:
        sentence = "The shell buckles at the knockdown factor k<sub>d</sub> = {}: a {}, {}."
    elif "critical_field" in amplitude(line["amplitude"]).critical_names:
        sentence = "The field makes the shell unstable at the critical {}: a {}, {}."
    else:
        sentence = "The first instability on the path is at {}: a {}, {}."
    return Markup(sentence).format(load, kind, displacement + _place_of_mode(mode_at, summary))


def _kind(line: Line) -> str:
    """Return the kind of an instability in words: fold or bifurcation, with its mode in brackets.

    The mode is a number of waves, or a symmetry in words.
    """
    if not line["mode"]:
        return line["label"]
    is_wave = line["mode"] not in (*OWN_MODES, ANTISYMMETRIC)
    return f"{line['label']} ({line['mode']}{' waves' if is_wave else ''})"


def _instabilities_of_last_step(
    first: Line, summary: Summary, lines: Sequence[Line]
) -> list[Markup]:
    """Return a list with one sentence on the instabilities of the last step of a programme.

    It is empty if the first instability of the path, which is told already, is in this step. Of
    many the first ones are named and the last one.
    """
    last_step = lines[-1].get("step", "")
    told = [
        line for line in located(lines) if line["branch"] == "0" and line.get("step") == last_step
    ]
    if not told or first in told:
        return []
    count = len(told)
    if count > MOST_TOLD:
        told = [*told[: MOST_TOLD - 1], told[-1]]
    texts = [Markup("a {} at {}").format(_kind(line), value(line, summary)) for line in told]
    if count > MOST_TOLD:
        texts[-1] = Markup("..., {}").format(texts[-1])
    noun = "instability" if count == 1 else f"{count} instabilities"
    return [
        Markup("Step {}, the last, has {}: {}.").format(
            last_step, f"an {noun}" if count == 1 else noun, Markup(", ").join(texts)
        )
    ]


def _errors_of_load(line: Line, summary: Summary) -> dict[str, float]:
    """Return column -> estimated error of the load at the first instability, also in units.

    It is empty without an estimate. `line` is the row of the instability.
    """
    name = amplitude(line["amplitude"]).column
    error, shown_column = (
        summary.get("errors", {}).get("limit_load"),
        shown_quantity(name, line).name,
    )
    if error is None:
        return {}
    ratio = float(line[shown_column]) / float(line[name]) if float(line[name]) else 0.0
    return {shown_column: abs(ratio) * error, name: error}


def _place_of_mode(place: Sequence[float] | None, summary: Summary) -> Markup:
    """Return words for the place (3,) at which a mode is largest, as the case file gives places.

    That is a direction on a sphere, and coordinates on other shapes. Empty for a place of None.
    """
    if place is None:
        return Markup("")
    dimensions = summary["dimensions"]
    in_metres = bool(dimensions["radius"]) and dimensions["units"] == "SI"
    geometry = shell_of(summary["case"])["geometry"]
    # one pair of unit and numbers: angles on a sphere, else coordinates
    ((unit, numbers),) = place_in_units(place, geometry, in_metres=in_metres).items()
    if unit == "degrees":
        polar, azimuth = numbers
        if polar < NEAR_POLE:
            return Markup("; its mode is largest near the pole")
        position = f"polar {polar:.0f}°, azimuth {round(azimuth)}°"
    else:
        coordinates = ", ".join(f"{x:.3g}" for x in numbers)
        position = f"({coordinates}) {unit}" if unit else f"({coordinates})"
    return Markup("; its mode is largest at {}").format(position)


def place_in_units(
    place: Sequence[float], geometry: str, *, in_metres: bool
) -> dict[str, list[float]]:
    """Return {unit: numbers} of a place over R, in the unit in which the report shows it.

    On a sphere the numbers are polar angle and azimuth (degrees), elsewhere coordinates.

    Examples
    --------
    >>> place_in_units([0.0, 0.03, 0.0], "strip", in_metres=True)
    {'mm': [0.0, 30.0, 0.0]}
    >>> place_in_units([0.0, 2.0, 0.0], "cap", in_metres=True)
    {'degrees': [90.0, 90.0]}
    """
    if geometry in ("hemisphere", "cap"):
        polar = degrees(atan2(hypot(*place[:2]), place[2]))
        return {"degrees": [polar, degrees(atan2(place[1], place[0])) if polar > ON_AXIS else 0.0]}
    unit, factor = ("mm", 1e3) if in_metres else ("", 1.0)
    return {unit: [factor * x + 0.0 for x in place]}


def _end(summary: Summary, lines: Sequence[Line]) -> Markup:
    """Return a sentence on the last point of the path; empty if the run stopped before any."""
    path = [line for line in lines if line["branch"] == "0" and line["label"] not in LOCATED]
    last_line = path[-1] if path else None
    if last_line is None or not last_line["amplitude"]:
        if summary["stopped"]:
            return Markup("")
        return Markup("Nothing loads the shell: this is its undeformed state.")
    # labels of the point at which a step ends, and of the end of a field without a load
    arrived = last_line["label"] in ("target", "field") and not summary["stopped"]
    subject = "The run reached its target" if arrived else "The last point"
    pole = pole_name(last_line, pole_of(summary["case"]))
    errors = dict[str, float]()
    if last_line is [line for line in lines if line["branch"] == "0"][-1]:
        errors = {
            name.removesuffix(END): error
            for name, error in summary.get("errors", {}).items()
            if name.endswith(END)
        }
    sentence = Markup("{}: {}, {}.").format(
        subject, value(last_line, summary, errors), _displacement(last_line, pole, lines, errors)
    )
    return sentence + _untouched(last_line)


def _untouched(line: Line) -> Markup:
    """Return a sentence that a moving body has not touched the shell; empty if it has.

    It is also empty if the amplitude that varied is no approach of a body.
    """
    if not line["amplitude"].startswith("approach"):
        return Markup("")
    name = f"penetration_over_h{line['amplitude'].removeprefix('approach')}"
    gap = -float(line[name])  # the column has penetrations, negative where there is a gap
    if above_rounding(gap) <= 0:
        return Markup("")
    gap_quantity = shown_quantity(name, line)
    unit = f" {gap_quantity.shown_unit}" if gap_quantity.shown_unit else " h"
    return Markup(" The body has not touched the shell: there is a gap of {}{}.").format(
        number(-float(line[gap_quantity.name])), unit
    )


def _displacement(
    line: Line, pole: str, lines: Sequence[Line], errors: Mapping[str, float] = NO_ERRORS
) -> Markup:
    """Return in words the displacement at a point of a path, and the force on what moves.

    Parameters
    ----------
    line
        Row of the point.
    pole
        Name of the point of w_pole_over_h.
    lines
        All rows; they show which numbers are as small as rounding.
    errors
        Column -> its estimated error at the point.
    """
    varied_amplitude = amplitude(line["amplitude"])
    at_pole = Markup("{} at {}").format(
        _named_amount(shown_quantity("w_pole_over_h", line), line, lines, errors), pole
    )
    # those axes of the curve that show a force
    force_axes = [
        axis
        for axis in axes_of(line["amplitude"], line)
        if axis.kind == "reaction" or axis.name.startswith("force")
    ]
    # the load has been said already; if a displacement is prescribed, the force is of interest
    if force_axes and varied_amplitude.column != "force":
        return Markup("{}, {}").format(_named_amount(force_axes[0], line, lines, errors), at_pole)
    # the displacement at the load is of interest, if the load is not at the pole
    is_at_load = varied_amplitude.conjugate == "w_over_h"
    if is_at_load and line["w_over_h"] != line["w_pole_over_h"]:
        return Markup("{} {}").format(
            _named_amount(shown_quantity("w_over_h", line), line, lines, errors),
            varied_amplitude.place,
        )
    return at_pole


def amount(
    name: str, line: Line, lines: Sequence[Line], errors: Mapping[str, float] = NO_ERRORS
) -> Markup:
    """Return the number in column `name` of a row, zero where it is as small as rounding.

    The largest number of the column in all `lines` sets what is small. `errors` are estimated
    errors by column.
    """
    value = above_rounding(float(line[name]), (float(other_line[name]) for other_line in lines))
    return number(value, error=errors.get(name) if value else None)


def _named_amount(
    of_column: Quantity, line: Line, lines: Sequence[Line], errors: Mapping[str, float] = NO_ERRORS
) -> Markup:
    """Return symbol, value and unit of a column at a point, such as "w/h = 0.5".

    The value is zero where it is as small as rounding over the largest one in all `lines`. `errors`
    are estimated errors by column.
    """
    cell = amount(of_column.name, line, lines, errors)
    unit = f" {of_column.shown_unit}" if of_column.shown_unit else ""
    return Markup("{} = {}{}").format(head(of_column), cell, unit)

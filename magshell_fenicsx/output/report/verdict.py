"""The result of a run for its report: one sentence, and the path as a table of the columns that
vary.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import unescape
from math import atan2, degrees, hypot, isclose
from pathlib import Path
from typing import Any

from markupsafe import Markup

from magshell_fenicsx.output.store.durable import Damaged
from magshell_fenicsx.output.store.known import is_flat, pole_of, read_summary, shell_of
from magshell_fenicsx.output.store.table import LOCATED, POLE, pole_name, read_lines
from magshell_fenicsx.quantities.quantity import Quantity, plain_text
from magshell_fenicsx.quantities.registry import (
    OWN_MODES,
    amplitude,
    axes_of,
    quantity,
    shown_quantity,
)

ROUNDING = (
    1e-15,
    1e-9,
)  # displacements and forces as small as this, in any unit or over their largest, are zero
LEAST, MOST = 1e-3, 1e6  # magnitudes between them are written without a power of ten
DIGITS = 6
LEAST_BEYOND = 0.1  # per cent of an overshoot
Summary = Mapping[str, Any]
ON_AXIS = 0.5  # degrees: an azimuth there is that of a node beside the pole
NEAR_POLE = (
    5.0  # degrees: a dimple at the pole is deepest on a ring as small as this, at no azimuth
)


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
        spare = min(
            len(t) - len(t.rstrip("0"))
            for t, v in zip(texts, values, strict=True)
            if math.isfinite(v)
        )
        texts = [t[: len(t) - spare].rstrip(".") for t in texts]
    return exponent, [
        _signed(t) if math.isfinite(v) else Markup("") for t, v in zip(texts, values, strict=True)
    ]


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
    """The heading of a column of numbers; a named point or a user-defined amplitude has its own
    name.
    """
    return head(quantity(name))


def head(of_column: Quantity) -> Markup:
    """The heading of a quantity."""
    return Markup(of_column.html) if of_column.symbol else Markup("{}").format(of_column.words)


def pole_head(line: Line, pole: str = POLE) -> Markup:
    """The heading of w_pole_over_h, with the point that it belongs to."""
    return Markup("{}, {}").format(
        head(shown_quantity("w_pole_over_h", line)), pole_name(line, pole).removeprefix("the ")
    )


def path_table(lines: Sequence[Line], length_unit: str, pole: str = POLE) -> list[Column]:
    """The columns that vary, in the order of interest; a displacement equal to an earlier one is
    left out.

    What is in the case's units is shown in these alone.

    Parameters
    ----------
    length_unit
        Unit of the displacements of named points.
    pole
        Name of the point of w_pole_over_h.
    """
    first_line = lines[0] if lines else {}
    in_units = {
        of_column.name for name in first_line if (of_column := shown_quantity(name, first_line)).name != name
    }
    names = [name for name in first_line if name != "point" and name not in in_units]
    order = ["point", *sorted(names, key=lambda name: ORDER.index(quantity(name).kind))]
    varying: dict[str, list[str]] = {}
    for name in order:
        values = [line.get(name, "") for line in lines]
        again = name.startswith("w_") and any(
            _same(values, other) for key, other in varying.items() if key[:2] == "w_"
        )
        if name in ("point", "label") or (len(set(values)) > 1 and not again):
            varying[name] = values
    energies = _energies(lines, [name for name in varying if quantity(name).kind == "energy"])
    table = {}
    for name in varying:
        of_column = shown_quantity(name, first_line)
        of_all = energies if of_column.kind == "energy" else ()
        table[name] = _column(
            of_column, [line.get(of_column.name, "") for line in lines], length_unit, of_all
        )
    if at_pole := table.get("w_pole_over_h"):
        table["w_pole_over_h"] = replace(at_pole, head=pole_head(lines[0], pole))
    return list(table.values())


def _energies(lines: Sequence[Line], names: Sequence[str]) -> list[float]:
    """All energies of a path: their columns have one power of ten, so that they can be compared."""
    return [float(line[shown_quantity(name, line).name]) for line in lines for name in names]


def _column(
    of_column: Quantity, values: Sequence[str], length_unit: str, beside: Sequence[float] = ()
) -> Column:
    """A column; `beside` are the numbers of others with the same power of ten."""
    if of_column.kind == "text":
        varied = (
            [quantity(amplitude(value).column).words for value in values]
            if of_column.name == "amplitude"
            else values
        )
        return Column(head(of_column), Markup(), varied, numeric=False)
    if of_column.kind == "count":
        return Column(head(of_column), Markup(), values)
    exponent, cells = column([float(value) for value in values], beside)
    size = power(exponent) if exponent else Markup()
    title = (
        Markup("{} {}").format(head(of_column), of_column.note)
        if of_column.note
        else head(of_column)
    )
    in_case = {
        "place": "m",
        "reaction": "N",
        "moment": "N m",
    }  # of a path.csv without columns in units
    unit = of_column.shown_unit or (in_case.get(of_column.kind, "") if length_unit else "")
    return Column(title, Markup("{} {}").format(size, unit), cells)


def _same(values: Sequence[str], others: Sequence[str]) -> bool:
    """Whether two columns have equal numbers, up to rounding."""
    return all(
        isclose(float(a), float(b), rel_tol=1e-9, abs_tol=1e-9)
        for a, b in zip(values, others, strict=True)
    )


def located(lines: Sequence[Line]) -> list[Line]:
    """The folds and bifurcations among the rows of a path."""
    return [line for line in lines if line["label"] in LOCATED]


def verdict(summary: Summary, lines: Sequence[Line]) -> Markup:
    """The result, and the reason if the run stopped early."""
    loading = summary["case"].get("loading") or {}
    until = ((loading[-1] or {}) if isinstance(loading, list) else loading).get("until", "target")
    first = next((line for line in located(lines) if line["branch"] == "0"), None)
    sentences = [_end(summary, lines)] if not first or until in ("target", "points") else []
    if first:
        points = summary.get("limit_points") or [{}]
        point = points[min(located(lines).index(first), len(points) - 1)]
        sentences.append(_instability(first, summary, lines, point.get("mode_at")))
    if solutions := summary.get("solutions"):
        stable = sum(it["stable"] for it in solutions)
        more = "further solution" + "s" * (len(solutions) != 1)
        sentences.append(
            Markup("A search has found {} {}, {} of them stable.").format(
                len(solutions), more, stable or "none"
            )
        )
    if summary.get("barrier") is not None:
        sentences.append(_barrier(summary))
    sentences += _snaps(summary)
    sentences += _error(summary)
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


def _snaps(summary: Summary) -> list[Markup]:
    """How long the first snap takes from a tenth to nine tenths of its way, after its departure
    from the fold, and how far beyond its end it goes."""
    snaps = summary.get("snaps")
    if not snaps or "jump" not in snaps[0]:  # of an earlier version
        return []
    in_ms = "snap_jump_ms" in summary
    jump, departure = (
        Markup("{} ms").format(number(summary[f"snap_{key}_ms"], 4))
        if in_ms
        else number(snaps[0][key], 4)
        for key in ("jump", "departure")
    )
    bare = (
        "" if in_ms else Markup(" (times in R √(ρ/E); with a density of the shell they are in ms)")
    )
    beyond = 100 * float(snaps[0]["overshoot"])
    more = (
        Markup(", and overshoots by {} % of its way").format(number(beyond, 2))
        if beyond > LEAST_BEYOND
        else ""
    )
    words = (
        "The snap takes {} from 10 to 90 % of its way, after a departure from the fold of {}{}{}."
    )
    return [Markup(words).format(jump, departure, bare, more)]


def _error(summary: Summary) -> list[Markup]:
    """The estimated error of a run with a tolerance, and the best estimate of its rounds if that is
    another.
    """
    tolerance = summary.get("tolerance") or {}
    if (estimate := tolerance.get("error_estimate")) is None:
        return []
    said, best = (
        Markup("The estimated relative error of the result is {}").format(number(estimate, 2)),
        tolerance.get("best"),
    )
    if best and best["error_estimate"] < estimate:
        least = number(best["error_estimate"], 2)
        said += Markup("; another mesh gives {} with {}").format(number(best["result"], 9), least)
    on_branch = (tolerance.get("branch") or {}).get("error_estimate")
    if on_branch is not None:
        said += Markup(", that of the bifurcation; at the end of the branch it is {}").format(
            number(on_branch, 2)
        )
    return [said + "."]


def _barrier(summary: Summary) -> Markup:
    measured = summary.get("in_units", {}).get("barrier_mJ")
    size = Markup(" ({} mJ)").format(number(measured)) if measured is not None else ""
    return Markup("The energy barrier is {} E h R²{}.").format(number(summary["barrier"]), size)


def value(line: Line, summary: Summary) -> Markup:
    """The amplitude that varied at a point, as "p/p_c = 0.326233 (53.7 Pa)", or in units alone.

    That is what is in these units already, "t = 2 s", and the pressure on a flat shell, which p_c
    says nothing of.
    """
    name = amplitude(line["amplitude"]).column
    degrees = "°" if line["amplitude"] == "angle" else ""
    size = shown_quantity(name, line)
    in_that_unit = size.symbol == quantity(name).symbol and float(line[size.name]) == float(
        line[name]
    )
    if size.name != name and (in_that_unit or (name == "p_over_pc" and is_flat(summary["case"]))):
        return Markup("{} = {} {}").format(head(size), number(float(line[size.name])), size.si)
    measured = (
        Markup(" ({} {})").format(number(float(line[size.name])), size.si)
        if size.name != name
        else ""
    )
    return Markup("{} = {}{}{}").format(symbol(name), number(float(line[name])), degrees, measured)


def plain(sentence: Markup) -> str:
    """A sentence for a terminal.

    Examples
    --------
    >>> plain(Markup("λ<sub>m</sub> = −1.84 · 10<sup>−5</sup> (10<sup>2</sup> Pa) &lt; 1"))
    'lambda_m = -1.84e-5 (1e2 Pa) < 1'
    """
    text = str(sentence).replace(" · 10<sup>", "e").replace("10<sup>", "1e").replace("−", "-")
    return plain_text(unescape(re.sub(r"</?su[bp]>", "", text.replace("<sub>", "_"))))


def sentence_of(folder: Path) -> str:
    """The result of the run in a folder, for a terminal."""
    return plain(verdict(*read_run(folder)))


def read_run(folder: Path) -> tuple[Summary, Sequence[Line]]:
    """summary.json and the rows of path.csv, as text.

    Raises
    ------
    Damaged
        If one of them cannot be read, or they do not belong together.
    """
    summary, lines = read_summary(folder), read_lines(folder / "path.csv")
    if len(lines) != summary["points"]:
        raise Damaged(
            f"{folder / 'path.csv'}: is damaged: it has {len(lines)} points, and summary.json says {summary['points']}"
        )
    return summary, lines


def _instability(
    line: Line, summary: Summary, lines: Sequence[Line], mode_at: Sequence[float] | None
) -> Markup:
    kind = line["label"]
    if line["mode"]:
        kind += f" ({line['mode']}{' waves' if line['mode'] not in (*OWN_MODES, 'antisymmetric') else ''})"
    at, place = (
        value(line, summary),
        _displacement(line, pole_name(line, pole_of(summary["case"])), lines),
    )
    if line["amplitude"] == "pressure" and summary["knockdown"] is not None:
        sentence = "The shell buckles at the knockdown factor k<sub>d</sub> = {}: a {}, {}."
    elif line["amplitude"] == "lambda_m":
        sentence = "The field makes the shell unstable at the critical {}: a {}, {}."
    else:
        sentence = "The first instability on the path is at {}: a {}, {}."
    return Markup(sentence).format(at, kind, place + _where(mode_at, summary))


def _where(place: Sequence[float] | None, summary: Summary) -> Markup:
    """Where a mode is largest, in words; as a direction on a sphere, as imperfections give their
    places.
    """
    if place is None:
        return Markup("")
    dimensions = summary["dimensions"]
    in_metres = bool(dimensions["radius"]) and dimensions["units"] == "SI"
    key, numbers = next(
        iter(
            place_in_units(
                place, shell_of(summary["case"])["geometry"], in_metres=in_metres
            ).items()
        )
    )
    if key == "degrees" and numbers[0] < NEAR_POLE:
        return Markup("; its mode is largest near the pole")
    if key == "degrees":
        angles = f"polar {numbers[0]:.0f}°, azimuth {round(numbers[1])}°"
    else:
        angles = f"({', '.join(f'{x:.3g}' for x in numbers)}){f' {key}' if key else ''}"
    return Markup("; its mode is largest at {}").format(angles)


def place_in_units(
    place: Sequence[float], geometry: str, *, in_metres: bool
) -> dict[str, list[float]]:
    """A place in the unit of the report: polar and azimuth on a sphere, elsewhere coordinates.

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
    return {"mm" if in_metres else "": [(1e3 if in_metres else 1.0) * x + 0.0 for x in place]}


def _end(summary: Summary, lines: Sequence[Line]) -> Markup:
    path = [line for line in lines if line["branch"] == "0" and line["label"] not in LOCATED]
    last = path[-1] if path else None
    if last is None or not last["amplitude"]:
        return Markup(
            "Nothing loads the shell: this is its undeformed state."
            if not summary["stopped"]
            else ""
        )
    arrived = last["label"] in ("target", "field") and not summary["stopped"]
    reached = "The run reached its target" if arrived else "The last point"
    place = pole_name(last, pole_of(summary["case"]))
    sentence = Markup("{}: {}, {}.").format(
        reached, value(last, summary), _displacement(last, place, lines)
    )
    return sentence + _untouched(last)


def _untouched(line: Line) -> Markup:
    """That a body which moved has not met the shell."""
    if not line["amplitude"].startswith("approach"):
        return Markup("")
    name = f"penetration_over_h{line['amplitude'].removeprefix('approach')}"
    gap = -float(line[name])
    if above_rounding(gap, ()) <= 0:
        return Markup("")
    of_gap = shown_quantity(name, line)
    unit = f" {of_gap.shown_unit}" if of_gap.shown_unit else " h"
    return Markup(" The body has not touched the shell: there is a gap of {}{}.").format(
        number(-float(line[of_gap.name])), unit
    )


def _displacement(line: Line, pole: str, lines: Sequence[Line]) -> Markup:
    """The displacement, and the force on what moves."""
    varied = amplitude(line["amplitude"])
    at_pole = Markup("{} at {}").format(_amount(shown_quantity("w_pole_over_h", line), line, lines), pole)
    force = [
        q
        for q in axes_of(line["amplitude"], line)
        if q.kind == "reaction" or q.name.startswith("force")
    ]
    if force and varied.column != "force":
        return Markup("{}, {}").format(_amount(force[0], line, lines), at_pole)
    if varied.conjugate == "w_over_h" and line["w_over_h"] != line["w_pole_over_h"]:
        return Markup("{} {}").format(_amount(shown_quantity("w_over_h", line), line, lines), varied.place)
    return at_pole


def amount(name: str, line: Line, lines: Sequence[Line]) -> Markup:
    """A column at a point, without rounding."""
    return number(above_rounding(float(line[name]), (float(each[name]) for each in lines)))


def _amount(of_column: Quantity, line: Line, lines: Sequence[Line]) -> Markup:
    told = amount(of_column.name, line, lines)
    return Markup("{} = {}{}").format(
        head(of_column), told, f" {of_column.shown_unit}" if of_column.shown_unit else ""
    )

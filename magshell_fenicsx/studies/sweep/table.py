"""sweep.csv with one row per point, and curves.csv with one row per accepted point of every run."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from magshell_fenicsx.quantities.registry import endings
from magshell_fenicsx.studies.sweep.axes import Axis
from magshell_fenicsx.studies.sweep.outcome import CURVE, Outcome
from magshell_fenicsx.studies.sweep.points import SweepPoint

COLUMNS = (
    "k_d",
    "p_over_pc",
    "w_pole_over_h",
    "kind",
    "mode",
    "amplitude",
    "value",
    "stopped",
    "found",
    "factorisations",
    "dofs",
    "wall_s",
    "point",
    "barrier",
)


def write_sweep(axes: Sequence[Axis], points: Sequence[SweepPoint], outcomes: Sequence[Outcome], file: Path) -> None:
    """Write sweep.csv; values with units are columns of numbers too, and so are the results of a case with units."""
    rows = [
        {**point.values, **sweep_row(outcome), "point": point.key, **_numbers(axes, point), **_in_units(outcome)}
        for point, outcome in zip(points, outcomes, strict=True)
    ]
    more = dict.fromkeys(key for row in rows for key in row)
    write_csv(rows, tuple(dict.fromkeys((*points[0].values, *COLUMNS, *more))), file)


def _numbers(axes: Sequence[Axis], point: SweepPoint) -> dict[str, float]:
    """Key_unit -> number, of the values with units."""
    swept = [(axis, key) for axis in axes if axis.unit and axis.numbers for key in axis.keys]
    return {f"{key}_{axis.unit}": axis.number(point.values[key]) for axis, key in swept}


def _in_units(outcome: Outcome) -> dict[str, Any]:
    """The columns in units of its limit point, and the numbers of the case."""
    limit = outcome.limit or {}
    return {
        key: v for key, v in limit.items() if key.endswith(tuple(f"_{each}" for each in endings()))
    } | outcome.in_units


def sweep_row(outcome: Outcome) -> dict[str, Any]:
    """The row of sweep.csv for an outcome; missing values are None."""
    limit = outcome.limit or {}
    return {
        "k_d": outcome.knockdown,
        **{key: limit.get(key) for key in ("p_over_pc", "w_pole_over_h", "kind", "mode", "amplitude", "value")},
        "stopped": outcome.stopped,
        "found": outcome.found,
        "factorisations": outcome.factorisations,
        "dofs": outcome.dofs,
        "wall_s": outcome.wall_s,
        "barrier": outcome.barrier,
    }


def write_curves(points: Sequence[SweepPoint], outcomes: Sequence[Outcome], file: Path) -> None:
    """Write curves.csv."""
    rows = [{**point.values, **row} for point, outcome in zip(points, outcomes, strict=True) for row in outcome.curve]
    there = [key for key in CURVE if any(key in row for row in rows)]
    own = dict.fromkeys(key for row in rows for key in row if key not in points[0].values)
    write_csv(rows, (*points[0].values, *dict.fromkeys((*there, *own))), file)


def write_csv(rows: Iterable[Mapping[str, Any]], columns: Sequence[str], file: Path) -> None:
    """Write rows with numbers in full precision."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows({k: repr(v) if isinstance(v, float) else v for k, v in row.items()} for row in rows)

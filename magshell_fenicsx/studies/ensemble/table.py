"""samples.csv: one row per sample."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from magshell_fenicsx.input.section import number_and_unit
from magshell_fenicsx.studies.ensemble.samples import Sample
from magshell_fenicsx.studies.ensemble.solve import FAILED
from magshell_fenicsx.studies.study.scalar import Scalar
from magshell_fenicsx.studies.sweep.outcome import Outcome
from magshell_fenicsx.studies.sweep.table import write_csv

Row = dict[str, Any]
RESULT, WITHOUT = "result", "result_without_weakest"
SEVEREST = "severest."
FIRST = ("sample", "status", RESULT)
LAST = ("found", "factorisations", "dofs", "cpu_s", "wall_s", "why", "point")
STATUS = {
    "found": "with a result",
    "stopped": "stopped early",
    "none": "without an instability",
    "failed": "failed",
    "missing": "not computed",
}


def make_row(sample: Sample, outcome: Outcome | None, scalar: Scalar) -> Row:
    """The row of a sample; None as outcome: it has not been computed."""
    result = value(outcome, scalar)
    known = outcome or Outcome(None, None, None, None, 0.0, [], "path", 0)
    why = "not computed" if outcome is None else known.stopped
    if result is not None:
        status = "found"
    elif outcome is None:
        status = "missing"
    else:
        status = "none" if why is None else "failed" if why.startswith(FAILED) else "stopped"
    computed = {"found": known.found, "factorisations": known.factorisations, "dofs": known.dofs}
    return {
        "sample": sample.number,
        "status": status,
        RESULT: result,
        **_columns(sample.values),
        **_columns({f"{SEVEREST}{key}": number for key, number in sample.severest.items()}),
        **(
            computed | {"cpu_s": known.cpu_s, "wall_s": known.wall_s}
            if outcome
            else dict.fromkeys((*computed, "cpu_s", "wall_s"))
        ),
        "why": f"no {scalar.name}" if status == "none" else why,
        "point": sample.key,
    }


def value(outcome: Outcome | None, scalar: Scalar) -> float | None:
    """The requested result of an outcome; None without."""
    if outcome is None or not outcome.curve:
        return None
    summary = {
        "knockdown": outcome.knockdown,
        "barrier": outcome.barrier,
        "limit_points": [outcome.limit] if outcome.limit else [],
    }
    return scalar.of(summary, [{key: str(v) for key, v in row.items()} for row in outcome.curve])


def _columns(values: Mapping[str, Any]) -> Row:
    """Values by the names of their columns; one with a unit is a number, and its name has the unit.

    Examples
    --------
    >>> _columns({"shell.thickness": "0.25 mm", "shell.poisson_ratio": 0.5})
    {'shell.thickness_mm': 0.25, 'shell.poisson_ratio': 0.5}
    """
    found = {}
    for key, value in values.items():
        number, unit = number_and_unit(value) if isinstance(value, str) else ("", "")
        found[f"{key}_{unit}" if unit else key] = float(number) if unit else value
    return found


def severest_keys(rows: Sequence[Row]) -> list[str]:
    """The columns of the most severe defect."""
    return list(dict.fromkeys(key for row in rows for key in row if key.startswith(SEVEREST)))


def drawn_keys(rows: Sequence[Row]) -> list[str]:
    """The columns of drawn values, in the order of the rows."""
    others = {*FIRST, *LAST, *severest_keys(rows), WITHOUT}
    return list(dict.fromkeys(key for row in rows for key in row if key not in others))


def write_samples(rows: Sequence[Row], file: Path) -> None:
    """Write samples.csv."""
    more = [WITHOUT] if any(WITHOUT in row for row in rows) else []
    write_csv(rows, (*FIRST, *more, *severest_keys(rows), *drawn_keys(rows), *LAST), file)

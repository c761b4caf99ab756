"""The rows of study.csv from the measurements: errors and the Pareto front."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from magshell_fenicsx.studies.study.reference import Reference, extrapolated
from magshell_fenicsx.studies.study.sample import TIMES, Measured
from magshell_fenicsx.studies.study.scalar import Scalar
from magshell_fenicsx.studies.sweep.points import SweepPoint

REFINEMENT = "mesh.refinement"
COLUMNS = (
    *("ranks", "cells", "dofs", "degree", "result", "error"),
    *("wall_s", "cpu_s", "jit_first_s", "jit_s", "setup_s", "assembly_s", "factor_s", "solve_s", "output_s", "total_s"),
    *("peak_mb", "factorisations", "iterations", "stopped", "pareto"),
)
Row = dict[str, Any]


@dataclass(frozen=True)
class Run:
    """The measurements of a point on a number of ranks."""

    point: SweepPoint
    ranks: int
    measured: Measured

    @property
    def label(self) -> str:
        return f"{self.point.label}, {self.ranks} rank{'s' if self.ranks > 1 else ''}"


def make_rows(runs: Sequence[Run], scalar: Scalar, given: float | None) -> tuple[list[Row], Reference | None]:
    """All rows, in the order of the runs, and the reference of their errors.

    Parameters
    ----------
    given
        The reference; None takes the finest run, with an estimate of its error.
    """
    rows = [_row(run, scalar) for run in runs]
    reference, finest = None, None
    if given is not None:
        reference = Reference(given, None, None, "given")
    elif any(row["result"] is not None for row in rows):
        finest = max((row for row in rows if row["result"] is not None), key=lambda r: (r["degree"], r["dofs"]))
        reference = _estimated(finest, runs, rows)
    for row in rows:
        if reference and row["result"] is not None:
            row["error"] = reference.error if row is finest else reference.error_of(row["result"])
    spent = clock(rows)
    comparable = [row for row in rows if row["error"] is not None and row[spent] is not None]
    for row in rows:
        row["pareto"] = row in comparable and not any(_beats(other, row, spent) for other in comparable)
    return rows, reference


def _row(run: Run, scalar: Scalar) -> Row:
    measured, summary = run.measured, run.measured.summary
    row: Row = {**run.point.values, **dict.fromkeys(COLUMNS), "ranks": run.ranks, "stopped": measured.failure}
    if summary is None:
        return row
    return row | {
        **summary["mesh"],
        "result": scalar.of(summary, measured.rows),
        **{key: measured.typical(key) for key in TIMES},
        "jit_first_s": measured.first["jit_s"] if measured.first else None,
        "factorisations": summary["factorisations"],
        "iterations": summary["iterations"],
        "stopped": summary["stopped"],
    }


def _estimated(finest: Row, runs: Sequence[Run], rows: Sequence[Row]) -> Reference:
    """The finest run as reference; its error comes from runs that differ only in the refinement."""
    same = [key for key in runs[0].point.values if key != REFINEMENT] + ["ranks"]
    series = {
        run.point.case.mesh.refinement: row["result"]
        for run, row in zip(runs, rows, strict=True)
        if row["result"] is not None and row["dofs"] <= finest["dofs"] and all(row[k] == finest[k] for k in same)
    }
    refinements = sorted(series)
    error, order = extrapolated([1 / r for r in refinements], [series[r] for r in refinements])
    value = finest["result"]
    relative = None if error is None else error / (abs(value) or 1.0)
    return Reference(value, relative, order, f"finest run: degree {finest['degree']}, {finest['dofs']} dofs")


def clock(rows: Sequence[Row]) -> str:
    """The time that compares runs: CPU time for one rank, because other processes affect it less; else wall time."""
    alone = all(row["ranks"] == 1 for row in rows) and any(row["cpu_s"] is not None for row in rows)
    return "cpu_s" if alone else "wall_s"


def _beats(a: Row, b: Row, spent: str) -> bool:
    """Whether a is at least as good as b in both time and error, and better in one."""
    here, there = (a[spent], a["error"]), (b[spent], b["error"])
    return here != there and here[0] <= there[0] and here[1] <= there[1]

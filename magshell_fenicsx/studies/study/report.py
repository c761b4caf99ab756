"""The rows of a study with their errors, its table and its picture.

A study runs a case over meshes, degrees, models and ranks. Errors are relative to a reference, a
given value or the finest run. The cost column is the time that compares runs. A run is on the
Pareto front if no other one is both faster and more accurate. A phase is a part of a run, such as
assembly. A scalar is the number of a run whose error is studied.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

from scipy.optimize import brentq

from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.table import varying_columns
from magshell_fenicsx.platform.environment import describe_machine
from magshell_fenicsx.studies.figures import saved_figure
from magshell_fenicsx.studies.points import SweepPoint, short_key
from magshell_fenicsx.studies.results import Scalar
from magshell_fenicsx.studies.study.timings import TIMES, Timings

ORDERS = 0.05, 30.0  # range of credible observed orders


@dataclass(frozen=True)
class Reference:
    """A value that errors are relative to, with its own error.

    Attributes
    ----------
    error
        Relative error; None if unknown.
    order
        Observed order of convergence for that error; None if there is none.
    source
        Description of the reference.
    """

    value: float
    error: float | None
    order: float | None
    source: str

    def error_of(self, value: float) -> float:
        """Relative error of another value; absolute if the reference is zero."""
        return abs(value - self.value) / (abs(self.value) or 1.0)


def estimated_error(
    h: Sequence[float], values: Sequence[float]
) -> tuple[float | None, float | None]:
    """Estimate the error of the last of several values by Richardson extrapolation.

    With v(h) = v + C h^p the values give the error and the order p.

    Parameters
    ----------
    h
        Mesh sizes, decreasing.
    values
        At least three values give the order. With two, or without monotonic convergence, the error
        is the last difference and there is no order.

    Returns
    -------
    error
        Absolute error; None for a single value.
    order
        The order p; None if there is none.

    Examples
    --------
    >>> error, order = estimated_error([4, 2, 1], [1 + 16e-3, 1 + 4e-3, 1 + 1e-3])
    >>> round(error, 9), round(order, 9)
    (0.001, 2.0)
    """
    if len(values) < 2:
        return None, None
    last_difference = abs(values[-1] - values[-2])
    p = observed_order(h[-3:], values[-3:]) if len(values) > 2 else None
    if p is None:
        return last_difference, None
    # C h^p of the last value, as last_difference = |C| (h[-2]^p - h[-1]^p)
    return last_difference * h[-1] ** p / (h[-2] ** p - h[-1] ** p), p


def observed_order(h: Sequence[float], values: Sequence[float]) -> float | None:
    """Return the order p of convergence of three values v(h) = v + C h^p.

    It solves (v1 - v2)/(v2 - v3) = (h1^p - h2^p)/(h2^p - h3^p). None if the values are not
    monotonic, or there is no root between `ORDERS`.
    """
    (a, b, c), (v1, v2, v3) = h, values
    if (v1 - v2) * (v2 - v3) <= 0:
        return None

    def mismatch(p: float) -> float:
        """Return the difference of the equation's sides, multiplied by the denominators."""
        return float((v1 - v2) * (b**p - c**p) - (v2 - v3) * (a**p - b**p))

    low, high = ORDERS
    return float(brentq(mismatch, low, high)) if mismatch(low) * mismatch(high) < 0 else None


REFINEMENT = "mesh.refinement"
COLUMNS = (
    *("ranks", "cells", "dofs", "degree", "result", "result_error", "error"),
    *(
        "wall_s",
        "cpu_s",
        "jit_first_s",
        "jit_s",
        "setup_s",
        "assembly_s",
        "factor_s",
        "solve_s",
        "output_s",
        "total_s",
    ),
    *("peak_mb", "factorisations", "iterations", "stopped", "pareto"),
)
Row = dict[str, Any]


@dataclass(frozen=True)
class Run:
    """The measurements of a point of a study on a number of ranks.

    Attributes
    ----------
    point
        Values of the swept keys with their case.
    measured
        Times and results of the repeated runs.
    """

    point: SweepPoint
    ranks: int
    measured: Timings

    @property
    def label(self) -> str:
        """Values of the point and number of ranks, in words."""
        return f"{self.point.label}, {self.ranks} rank{'s' if self.ranks > 1 else ''}"


def make_rows(
    runs: Sequence[Run], scalar: Scalar, reference_value: float | None
) -> tuple[list[Row], Reference | None]:
    """Return the rows of study.csv, in the order of the runs, and the reference of their errors.

    The reference is None if no run has the result.

    Parameters
    ----------
    scalar
        The number whose error is studied.
    reference_value
        The reference; None takes the finest run, with an estimate of its error.
    """
    rows = [_row(run, scalar) for run in runs]
    # the reference; and the row of the finest run if this run is the reference
    reference, finest = None, None
    if reference_value is not None:
        reference = Reference(reference_value, None, None, "given")
    elif any(row["result"] is not None for row in rows):
        finest = max(
            (row for row in rows if row["result"] is not None),
            key=lambda r: (r["degree"], r["dofs"]),
        )
        reference = _estimated(finest, runs, rows)
    for row in rows:
        if reference and row["result"] is not None:
            # the finest run has the estimated error, not zero
            row["error"] = reference.error if row is finest else reference.error_of(row["result"])
    # the Pareto front: runs with an error and a time that no other run beats
    cost_column = clock(rows)
    comparable = [row for row in rows if row["error"] is not None and row[cost_column] is not None]
    for row in rows:
        row["pareto"] = row in comparable and not any(
            _beats(other, row, cost_column) for other in comparable
        )
    return rows, reference


def _row(run: Run, scalar: Scalar) -> Row:
    """Return the row of study.csv for a run; `error` and `pareto` are None, to be filled in later.

    Without results the row has only keys, ranks and the reason of the failure.
    """
    measured, summary = run.measured, run.measured.summary
    row: Row = {
        **run.point.values,
        **dict.fromkeys(COLUMNS),
        "ranks": run.ranks,
        "stopped": measured.failure,
    }
    if summary is None:
        return row
    return row | {
        **summary["mesh"],
        "result": scalar.value_in(summary, measured.rows),
        "result_error": scalar.error_in(summary.get("errors", {}), measured.rows),
        **{key: measured.typical(key) for key in TIMES},
        # of the first run, which may have compiled kernels
        "jit_first_s": measured.first["jit_s"] if measured.first else None,
        "factorisations": summary["factorisations"],
        "iterations": summary["iterations"],
        "stopped": summary["stopped"],
    }


def _estimated(finest: Row, runs: Sequence[Run], rows: Sequence[Row]) -> Reference:
    """Return the finest run as reference, with an estimate of its error.

    The error is extrapolated (Richardson) from runs that differ from it in the refinement alone.
    """
    # keys in which the runs must agree with the finest one
    fixed_keys = [key for key in runs[0].point.values if key != REFINEMENT] + ["ranks"]

    def is_comparable(row: Row) -> bool:
        """Return whether a row has a result on the finest or a coarser mesh, and else agrees."""
        if row["result"] is None or not row["dofs"] <= finest["dofs"]:
            return False
        return all(row[key] == finest[key] for key in fixed_keys)

    results_by_refinement = {
        run.point.case.mesh.refinement: row["result"]
        for run, row in zip(runs, rows, strict=True)
        if is_comparable(row)
    }
    refinements = sorted(results_by_refinement)
    error, order = estimated_error(
        # mesh sizes are proportional to 1/refinement
        [1 / r for r in refinements],
        [results_by_refinement[r] for r in refinements],
    )
    value = finest["result"]
    relative_error = None if error is None else error / (abs(value) or 1.0)
    return Reference(
        value,
        relative_error,
        order,
        f"finest run: degree {finest['degree']}, {finest['dofs']} dofs",
    )


def clock(rows: Sequence[Row]) -> str:
    """Return the column of the time that compares runs.

    It is CPU time if all runs have one rank, because other processes affect it less; else wall
    time.
    """
    on_one_rank = all(row["ranks"] == 1 for row in rows) and any(
        row["cpu_s"] is not None for row in rows
    )
    return "cpu_s" if on_one_rank else "wall_s"


def _beats(a: Row, b: Row, cost_column: str) -> bool:
    """Return whether row a is at least as good as b in time and in error, and better in one."""
    time_of_a, error_of_a = a[cost_column], a["error"]
    time_of_b, error_of_b = b[cost_column], b["error"]
    if (time_of_a, error_of_a) == (time_of_b, error_of_b):
        return False
    return bool(time_of_a <= time_of_b and error_of_a <= error_of_b)


FORMS = {
    "result": ".9g",
    "error": ".1e",
    "peak_mb": ".0f",
    **dict.fromkeys(
        ("wall_s", "cpu_s", "jit_s", "setup_s", "assembly_s", "factor_s", "solve_s", "output_s"),
        ".3g",
    ),
}
SHOWN_COLUMNS = (
    *(
        "cells",
        "dofs",
        "result",
        "error",
        "wall_s",
        "cpu_s",
        "jit_s",
        "setup_s",
        "assembly_s",
        "factor_s",
        "solve_s",
    ),
    *("output_s", "peak_mb", "factorisations", "iterations", "stopped"),
)
LEGEND = """\
Wall and CPU seconds are for the whole process with its files, kernels compiled; the phases are as
in summary.json; the peak is the resident memory of all ranks. **Bold**: no other run is both
faster and more accurate.
"""


def write_report(
    rows: Sequence[Row], keys: Sequence[str], content: dict[str, Any], file: Path
) -> None:
    """Write study.md, a table with the main columns of all rows.

    Parameters
    ----------
    rows
        Rows of study.csv.
    keys
        The swept keys.
    content
        The content of study.json.
    file
        Path of study.md.
    """
    head = [
        *map(short_key, keys),
        "ranks",
        *(name.replace("_s", " (s)").replace("_mb", " (MB)") for name in SHOWN_COLUMNS),
    ]
    lines = [head, ["---"] * len(head)]
    for row in rows:
        cells = [_cell(row, key) for key in (*keys, "ranks", *SHOWN_COLUMNS)]
        lines.append([f"**{cell}**" if row["pareto"] and cell else cell for cell in cells])
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    text = (
        f"# {content['result']} of {content['case']}: error against run time\n\n"
        f"{content['reference_said']} {repeated(content['repeat'])} on "
        f"{describe_machine(content['machine'])}.\n"
        f"{LEGEND}\n![](study.png)\n\n{table}\n"
    )
    write_whole(file, text.encode())


def repeated(repeat: int) -> str:
    """Return a phrase that says how often each point was run.

    Examples
    --------
    >>> repeated(1), repeated(3)
    ('One run each', 'Medians of 3 runs')
    """
    return f"Medians of {repeat} runs" if repeat > 1 else "One run each"


def reference_sentence(reference: Reference | None) -> str:
    """Return a sentence about the reference of the errors; None: no run gave the result."""
    if reference is None:
        return "No run gave the result."
    value = f"Errors are relative to {reference.value:.10g} ({reference.source}"
    if reference.source == "given":
        return f"{value})."
    if reference.error is None:
        return f"{value}; its own error is not known: it has no coarser mesh to compare with)."
    estimate = (
        f"observed order {reference.order:.2g}"
        if reference.order
        else "the last difference: no order was observed"
    )
    return (
        f"{value}; its own error is estimated at {reference.error:.1e}, {estimate}): "
        "smaller errors mean nothing."
    )


def _cell(row: Row, key: str) -> str:
    """Return the text of a column of a row for the table; empty for None."""
    value = row[key]
    if value is None:
        return ""
    return (
        format(value, FORMS[key])
        if key in FORMS
        else str(value).replace("|", "/").replace("\n", " ")
    )


CLOCKS = {"wall_s": "wall time of the process (s)", "cpu_s": "CPU time of the process (s)"}
AXIS_LABELS = {"dofs": "unknowns", "peak_mb": "peak memory, all ranks (MB)"}
PHASES = {
    "jit_s": "kernels (warm)",
    "setup_s": "set-up",
    "assembly_s": "assembly",
    "factor_s": "factorisation",
    "solve_s": "back-solve",
    "output_s": "output",
}
MARKERS = "osD^vP*X"
LEAST_SPREAD = (
    3.0  # least factor between the middle and the ends of an axis, so that noise shows no trend
)


def draw_study(
    rows: Sequence[Row], keys: Sequence[str], title: str, own_error: float | None, file: Path
) -> None:
    """Draw study.png: errors over time, unknowns and memory, and the shares of the phases.

    Runs without an error are left out.

    Parameters
    ----------
    rows
        Rows of study.csv.
    keys
        The swept keys; the runs of a series differ only in the refinement.
    own_error
        Error of the reference, drawn as a line; smaller errors are meaningless. None without.
    file
        Path of study.png.
    """
    cost_column = clock(rows)
    # logarithms need positive errors
    series = _series([row for row in rows if row["error"] and row[cost_column]], keys)
    with saved_figure(file, 9.6, 7.2, dpi=160) as figure:
        panels = figure.subplots(2, 2)
        # three panels of errors; the fourth has the shares of the phases
        for axes, (quantity, label) in zip(
            panels.flat, {cost_column: CLOCKS[cost_column], **AXIS_LABELS}.items(), strict=False
        ):
            _draw_errors(axes, series, quantity, own_error)
            axes.set(xlabel=label, ylabel="relative error")
        _draw_phase_shares(panels[1, 1], series)
        figure.suptitle(title, fontsize=10)
        for axes, place in ((panels[0, 0], "upper"), (panels[1, 1], "lower")):
            handles, labels = axes.get_legend_handles_labels()
            if handles:
                figure.legend(
                    handles, labels, loc=f"outside right {place}", fontsize=8, frameon=False
                )


def _series(rows: Sequence[Row], keys: Sequence[str]) -> dict[str, list[Row]]:
    """Return series of rows that differ in the mesh refinement alone, each by growing unknowns.

    The key of a series is a label of the values that other series do not share.
    """
    names = [*(key for key in keys if key != REFINEMENT), "ranks"]
    varying_names = varying_columns(rows, names)
    series: dict[str, list[Row]] = {}
    for row in sorted(rows, key=lambda r: r["dofs"]):
        label = ", ".join(f"{short_key(name)} {row[name]}" for name in varying_names) or "runs"
        series.setdefault(label, []).append(row)
    return series


def _draw_errors(
    axes: Any, series: dict[str, list[Row]], quantity: str, own_error: float | None
) -> None:
    """Draw error over a quantity for each series, with double logarithmic axes.

    Parameters
    ----------
    quantity
        Column of the horizontal axis; over a time the Pareto front is drawn too.
    own_error
        Error of the reference, drawn as a line; None without.
    """
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    # a line for each series
    for (label, rows), marker in zip(series.items(), cycle(MARKERS), strict=False):
        x, error = [row[quantity] for row in rows], [row["error"] for row in rows]
        axes.plot(x, error, marker=marker, markersize=4, linewidth=1, label=label)
    # the Pareto front as steps, with circles around its runs
    pareto_points = sorted(
        (row[quantity], row["error"]) for rows in series.values() for row in rows if row["pareto"]
    )
    if quantity in CLOCKS and pareto_points:
        x, error = map(list, zip(*pareto_points, strict=True))
        axes.step(
            x,
            error,
            where="post",
            color="0.6",
            linewidth=5,
            alpha=0.5,
            zorder=0,
            label="Pareto front",
        )
        axes.plot(x, error, "o", markersize=9, fillstyle="none", color="0.3")
    if own_error:
        axes.axhline(
            own_error,
            color="C3",
            linewidth=0.8,
            linestyle=":",
            label="error of the reference itself",
        )
    axes.set(xscale="log", yscale="log")
    # an axis around the geometric mean of least and largest value, not too short
    if values := [row[quantity] for rows in series.values() for row in rows]:
        middle = (min(values) * max(values)) ** 0.5
        half_range = max(LEAST_SPREAD, 1.1 * (max(values) / min(values)) ** 0.5)
        axes.set_xlim(middle / half_range, middle * half_range)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(which="both", color="0.92", linewidth=0.6)


def _draw_phase_shares(axes: Any, series: dict[str, list[Row]]) -> None:
    """Draw the shares of the phases in the wall time, for the runs on the Pareto front."""
    rows = sorted(
        (r for rows in series.values() for r in rows if r["pareto"]), key=lambda r: -r["error"]
    )
    bottom = [0.0] * len(rows)  # sum of the shares that are drawn already, for each run
    places = range(len(rows))
    for i, (key, label) in enumerate(PHASES.items()):
        if all(row[key] is None for row in rows):
            continue
        heights = [(row[key] or 0.0) / row["wall_s"] for row in rows]
        axes.bar(places, heights, bottom=bottom, color=f"C{i}", label=label)
        bottom = [b + h for b, h in zip(bottom, heights, strict=True)]
    # two more parts on top: up to the end of the run, and of the process
    for end, colour, label in (
        ("total_s", "0.6", "the rest of the run"),
        ("wall_s", "0.85", "start and end of the process"),
    ):
        # from the sum of the phases up to this time
        remainder = [
            max((row[end] or 0.0) / row["wall_s"] - b, 0.0)
            for row, b in zip(rows, bottom, strict=True)
        ]
        axes.bar(places, remainder, bottom=bottom, color=colour, label=label)
        bottom = [b + h for b, h in zip(bottom, remainder, strict=True)]
    axes.set_xticks(places, [f"{row['error']:.0e}\n{row['dofs']}" for row in rows], fontsize=7)
    axes.set(
        xlabel="error and unknowns of the Pareto front's runs",
        ylabel="share of the wall time",
        ylim=(0, 1),
    )

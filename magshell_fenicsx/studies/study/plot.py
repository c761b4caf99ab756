"""The picture of a study: error against time, unknowns and memory, and the shares of the run time."""

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from magshell_fenicsx.studies.study.rows import REFINEMENT, Row, clock
from magshell_fenicsx.studies.sweep.points import short

CLOCKS = {"wall_s": "wall time of the process (s)", "cpu_s": "CPU time of the process (s)"}
AGAINST = {"dofs": "unknowns", "peak_mb": "peak memory, all ranks (MB)"}
PARTS = {
    "jit_s": "kernels (warm)",
    "setup_s": "set-up",
    "assembly_s": "assembly",
    "factor_s": "factorisation",
    "solve_s": "back-solve",
    "output_s": "output",
}
MARKERS = "osD^vP*X"
LEAST_SPREAD = 3.0  # least factor between the middle and the ends of an axis, so that noise shows no trend


def draw_study(rows: Sequence[Row], keys: Sequence[str], title: str, own_error: float | None, file: Path) -> None:
    """Write study.png; runs without an error are left out.

    Parameters
    ----------
    keys
        The swept keys; the runs of a series differ only in the refinement.
    own_error
        Error of the reference, drawn as a line; smaller errors are meaningless.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    spent = clock(rows)
    series = _series([row for row in rows if row["error"] and row[spent]], keys)
    figure, panels = plt.subplots(2, 2, figsize=(9.6, 7.2), layout="constrained")
    for axes, (quantity, label) in zip(panels.flat, {spent: CLOCKS[spent], **AGAINST}.items(), strict=False):
        _errors(axes, series, quantity, own_error)
        axes.set(xlabel=label, ylabel="relative error")
    _parts(panels[1, 1], series)
    figure.suptitle(title, fontsize=10)
    for axes, place in ((panels[0, 0], "upper"), (panels[1, 1], "lower")):
        handles, labels = axes.get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc=f"outside right {place}", fontsize=8, frameon=False)
    figure.savefig(file, dpi=160)
    plt.close(figure)


def _series(rows: Sequence[Row], keys: Sequence[str]) -> dict[str, list[Row]]:
    """Series of rows that differ only in the mesh size, by a label of their common values."""
    names = [*(key for key in keys if key != REFINEMENT), "ranks"]
    shown = [name for name in names if len({row[name] for row in rows}) > 1]
    found: dict[str, list[Row]] = {}
    for row in sorted(rows, key=lambda r: r["dofs"]):
        found.setdefault(", ".join(f"{short(name)} {row[name]}" for name in shown) or "runs", []).append(row)
    return found


def _errors(axes: Any, series: dict[str, list[Row]], quantity: str, own_error: float | None) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    for (label, rows), marker in zip(series.items(), cycle(MARKERS), strict=False):
        x, error = ([row[key] for row in rows] for key in (quantity, "error"))
        axes.plot(x, error, marker=marker, markersize=4, linewidth=1, label=label)
    best = sorted((row[quantity], row["error"]) for rows in series.values() for row in rows if row["pareto"])
    if quantity in CLOCKS and best:
        x, error = map(list, zip(*best, strict=True))
        axes.step(x, error, where="post", color="0.6", linewidth=5, alpha=0.5, zorder=0, label="Pareto front")
        axes.plot(x, error, "o", markersize=9, fillstyle="none", color="0.3")
    if own_error:
        axes.axhline(own_error, color="C3", linewidth=0.8, linestyle=":", label="error of the reference itself")
    axes.set(xscale="log", yscale="log")
    if values := [row[quantity] for rows in series.values() for row in rows]:
        middle = (min(values) * max(values)) ** 0.5
        spread = max(LEAST_SPREAD, 1.1 * (max(values) / min(values)) ** 0.5)
        axes.set_xlim(middle / spread, middle * spread)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(which="both", color="0.92", linewidth=0.6)


def _parts(axes: Any, series: dict[str, list[Row]]) -> None:
    """Draw the shares of the phases in the wall time, for the runs on the Pareto front."""
    rows = sorted((r for rows in series.values() for r in rows if r["pareto"]), key=lambda r: -r["error"])
    bottom = [0.0] * len(rows)
    places = range(len(rows))
    for i, (key, label) in enumerate(PARTS.items()):
        if all(row[key] is None for row in rows):
            continue
        heights = [(row[key] or 0.0) / row["wall_s"] for row in rows]
        axes.bar(places, heights, bottom=bottom, color=f"C{i}", label=label)
        bottom = [b + h for b, h in zip(bottom, heights, strict=True)]
    for end, colour, label in (
        ("total_s", "0.6", "the rest of the run"),
        ("wall_s", "0.85", "start and end of the process"),
    ):
        rest = [max((row[end] or 0.0) / row["wall_s"] - b, 0.0) for row, b in zip(rows, bottom, strict=True)]
        axes.bar(places, rest, bottom=bottom, color=colour, label=label)
        bottom = [b + h for b, h in zip(bottom, rest, strict=True)]
    axes.set_xticks(places, [f"{row['error']:.0e}\n{row['dofs']}" for row in rows], fontsize=7)
    axes.set(xlabel="error and unknowns of the Pareto front's runs", ylabel="share of the wall time", ylim=(0, 1))

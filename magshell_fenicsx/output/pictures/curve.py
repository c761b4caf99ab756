"""The load-displacement or pressure-volume curve as a picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, zip_longest
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.output.store.table import LOCATED, OWN_MODES, SOLUTION, Row, pole_name
from magshell_fenicsx.quantities.registry import amplitude as registered
from magshell_fenicsx.quantities.registry import axes_of, quantity, shown

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NAMED = 5  # most instabilities in the legend
FINE = 16  # drawn segments between two points


def smooth(x: Sequence[float], y: Sequence[float]) -> NDArray[np.float64]:
    """A smooth curve (2, FINE (n - 1) + 1) through n points without overshoot; the parameter is the scaled chord."""
    xy = np.array([x, y])
    scale = np.ptp(xy, axis=1)
    steps = np.hypot(*(np.diff(xy, axis=1) / np.where(scale > 0, scale, 1)[:, None]))
    chord = np.concatenate([[0], np.cumsum(np.maximum(steps, 1e-12))])
    fine = np.interp(np.arange(FINE * (len(chord) - 1) + 1) / FINE, np.arange(len(chord)), chord)
    return np.asarray(scipy.interpolate.PchipInterpolator(chord, xy, axis=1)(fine))


def curve_figure(rows: Sequence[Row], amplitude: str, title: str) -> "Figure":
    """Draw the part of the path in which `amplitude` varied, and its branches; instabilities are marked.

    Of a programme each step is drawn. Stable parts are solid, unstable parts dashed. A user-defined amplitude is drawn
    over the pole's displacement.
    """
    from matplotlib.figure import Figure

    parts = drawn_parts(rows, amplitude)
    wide = min(len(parts), 3)
    high = -(-len(parts) // wide)
    figure = Figure(figsize=(4.6 * wide, 3.4 * high), dpi=200, layout="constrained")
    for axes, part in zip_longest(figure.subplots(high, wide, squeeze=False).flat, parts):
        if part is None:
            axes.set_axis_off()
            continue
        plot_curve(axes, part)
        axes.set_title(part.title or title, fontsize=9)
    if len(parts) > 1:
        figure.suptitle(title, fontsize=10)
    return figure


@dataclass(frozen=True)
class Part:
    """The rows in which an amplitude varied, with the one before them."""

    amplitude: str
    rows: Sequence[Row]
    title: str = ""


def drawn_parts(rows: Sequence[Row], amplitude: str) -> list[Part]:
    """The steps of a programme, or the last part in which the amplitude varied."""
    steps = sorted({int(row.get("step", 0)) for row in rows if row["label"] != "field"} - {0})
    if len(steps) < 2:
        return [Part(amplitude, varied(rows, amplitude))]
    parts = []
    for step in steps:
        first = next(i for i, row in enumerate(rows) if row["step"] == step)
        before = max((i for i in range(first) if rows[i]["branch"] == 0), default=0)
        within = [row for row in rows[first:] if row["step"] == step]
        name = str(within[0]["amplitude"])
        varying = quantity(registered(name).column).words
        parts.append(Part(name, [rows[before], *within], f"step {step}: {varying}"))
    return parts


def varied(rows: Sequence[Row], amplitude: str) -> Sequence[Row]:
    """The last part of a path in which an amplitude varied."""
    first = max(i for i, row in enumerate(rows) if row["amplitude"] != amplitude or row is rows[0])
    return rows[0 if amplitude == "lambda_m" else first :]


def place(row: Row, amplitude: str) -> tuple[float, float]:
    """The coordinates of a point in the curve's axes."""
    x, y = axes_of(amplitude, row)
    return x.on_axis(row), y.on_axis(row)


def _unstable(row: Row) -> bool:
    """Whether the model, or a mode that it excludes, is unstable; an earlier path.csv has no excluded_pivots."""
    return int(row["negative_pivots"]) + int(row.get("excluded_pivots", 0)) > 0


def plot_curve(axes: "Axes", of: Part) -> None:
    """Draw a part of a path in given axes."""
    part, amplitude = of.rows, of.amplitude
    x, y = axes_of(amplitude, part[0])
    if amplitude == "load" and all(row["w_over_h"] == row["w_pole_over_h"] for row in part):
        x = shown("w_pole_over_h", part[0])  # moments have no conjugate displacement
    pole = pole_name(part[0]).replace("$", r"\$")  # plain text, no mathematics
    x_label, y_label = (each.label.replace("the pole", pole) for each in (x, y))
    path = [row for row in part if row["label"] != SOLUTION]
    for branch in sorted({int(row["branch"]) for row in path}):
        line = [row for row in path if row["branch"] == branch and row["mode"] in OWN_MODES]
        smooth_x, smooth_y = smooth(*zip(*(place(row, amplitude) for row in line), strict=True))
        unstable = [_unstable(row) and row["label"] not in LOCATED for row in line]
        for dashed, pieces in groupby(range(1, len(line)), key=unstable.__getitem__):
            i, *others = pieces
            piece = slice((i - 1) * FINE, (i + len(others)) * FINE + 1)
            axes.plot(smooth_x[piece], smooth_y[piece], color="C0", linestyle=(0, (2, 1.2)) if dashed else "-")
        dots = [place(row, amplitude) for row in line if row["label"] in ("target", "step", "field")]
        axes.plot([x for x, _ in dots], [y for _, y in dots], ".", color="C0", markersize=4)
    marked = [row for row in part if row["label"] in LOCATED]
    for number, row in enumerate(marked, 1):
        mode = f" ({row['mode']})" if row["mode"] else ""
        name = f"{row['label']}{mode} at {row[y.name]:.5g}{f' {y.shown_unit}' if y.shown_unit else ''}"
        if number > NAMED:
            name = f"and {len(marked) - NAMED} more" if number == NAMED + 1 else "_"  # matplotlib omits "_"
        axes.plot(*place(row, amplitude), "o", color="C3", markersize=6, label=name)
    for row in (row for row in part if row["label"] == SOLUTION):
        name, inside = ("unstable", "none") if _unstable(row) else ("stable", "C2")
        known = axes.get_legend_handles_labels()[1]
        label = f"{name} solution" if f"{name} solution" not in known else "_"
        axes.plot(*place(row, amplitude), "s", color="C2", markerfacecolor=inside, markersize=6, label=label)
        axes.annotate(str(row["branch"]), place(row, amplitude), (0, 6), textcoords="offset points", fontsize=8)
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.locator_params(axis="x", nbins=6)
    axes.axhline(0, color="0.8", linewidth=0.8, zorder=0)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False)

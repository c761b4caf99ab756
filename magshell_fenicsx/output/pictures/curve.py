"""The load-displacement or pressure-volume curve as a picture."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby, zip_longest
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.output.pictures.captions import write_numbers
from magshell_fenicsx.output.pictures.layout import INCH, ONE, SEVERAL, drawing, number_format
from magshell_fenicsx.output.store.table import LOCATED, POLE, SOLUTION, Row, pole_name
from magshell_fenicsx.problem.wanted import OutputSection
from magshell_fenicsx.quantities.registry import OWN_MODES, axes_of, quantity, shown
from magshell_fenicsx.quantities.registry import amplitude as registered

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
from collections import defaultdict

from magshell_fenicsx.output.fields.modes import Frequency

if TYPE_CHECKING:  # takes long to import
    from matplotlib.figure import Figure

FINE = 16  # drawn segments between two points
DASHED = (0, (2, 1.2))
NARROW = 0.3  # of the figure: few numbers fit below


def smooth(x: Sequence[float], y: Sequence[float]) -> NDArray[np.float64]:
    """A smooth curve (2, FINE (n - 1) + 1) through n points without overshoot; the parameter is the scaled chord."""
    xy = np.array([x, y])
    scale = np.ptp(xy, axis=1)
    steps = np.hypot(*(np.diff(xy, axis=1) / np.where(scale > 0, scale, 1)[:, None]))
    chord = np.concatenate([[0], np.cumsum(np.maximum(steps, 1e-12))])
    fine = np.interp(np.arange(FINE * (len(chord) - 1) + 1) / FINE, np.arange(len(chord)), chord)
    return np.asarray(scipy.interpolate.PchipInterpolator(chord, xy, axis=1)(fine))


def curve_figure(rows: Sequence[Row], amplitude: str, style: OutputSection, place: str = POLE) -> "Figure":
    """Draw the part of the path in which `amplitude` varied, and its branches; instabilities are marked and numbered.

    Of a programme each step is drawn. Stable parts are solid, unstable parts dashed. A user-defined amplitude is drawn
    over the displacement of the pole, or what is called so.

    Parameters
    ----------
    place
        Name of the point of w_pole_over_h without named points.
    """
    from matplotlib.figure import Figure

    parts = drawn_parts(rows, amplitude)
    wide = min(len(parts), 2)
    high = -(-len(parts) // wide)
    width = (style.width or (ONE if len(parts) == 1 else SEVERAL)) / INCH
    with drawing(style):
        figure = Figure(figsize=(width, 0.75 * width / wide * high), dpi=style.dpi, layout="constrained")
        for axes, part in zip_longest(figure.subplots(high, wide, squeeze=False).flat, parts):
            if part is None:
                axes.set_axis_off()
                continue
            plot_curve(axes, part, place)
            axes.set_title(part.title)
        named = {
            name: line for axes in figure.axes for line, name in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        if named:  # above the axes, where it covers no curve
            number = min(len(named), 4 * wide)
            figure.legend(
                named.values(),
                named.keys(),
                loc="outside upper center",
                ncols=number,
                frameon=False,
                handlelength=1.5,
                columnspacing=1,
            )
    return figure


@dataclass(frozen=True)
class Part:
    """The rows in which an amplitude varied, with the one before them, and the numbers of its instabilities."""

    amplitude: str
    rows: Sequence[Row]
    title: str = ""
    numbers: Mapping[int, int] = field(default_factory=dict)


def numbered(rows: Sequence[Row]) -> dict[int, int]:
    """Point -> number of its instability, from 1 along path.csv; so they are numbered in all pictures and tables."""
    return {int(row["point"]): n for n, row in enumerate((row for row in rows if row["label"] in LOCATED), 1)}


def drawn_parts(rows: Sequence[Row], amplitude: str) -> list[Part]:
    """The steps of a programme, or the last part in which the amplitude varied."""
    steps = sorted({int(row.get("step", 0)) for row in rows if row["label"] != "field"} - {0})
    if len(steps) < 2:
        return [Part(amplitude, varied(rows, amplitude), "", numbered(rows))]
    parts = []
    for step in steps:
        first = next(i for i, row in enumerate(rows) if row["step"] == step)
        before = max((i for i in range(first) if rows[i]["branch"] == 0), default=0)
        within = [row for row in rows[first:] if row["step"] == step]
        name = str(within[0]["amplitude"])
        varying = quantity(registered(name).column).words
        parts.append(Part(name, [rows[before], *within], f"step {step}: {varying}", numbered(rows)))
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


def plot_curve(axes: "Axes", of: Part, pole: str = POLE) -> None:
    """Draw a part of a path in given axes."""
    part, amplitude = of.rows, of.amplitude
    x, y = axes_of(amplitude, part[0])
    if amplitude == "load" and all(row["w_over_h"] == row["w_pole_over_h"] for row in part):
        x = shown("w_pole_over_h", part[0])  # moments have no conjugate displacement
    name = pole_name(part[0], pole).replace("$", r"\$")  # plain text, no mathematics
    x_label, y_label = (each.label.replace(POLE, name) for each in (x, y))
    path, drawn = [row for row in part if row["label"] != SOLUTION], list[NDArray[np.float64]]()
    for branch in sorted({int(row["branch"]) for row in path}):
        line = _line([row for row in path if row["branch"] == branch], amplitude)
        smooth_x, smooth_y = smooth(*zip(*(place(row, amplitude) for row in line), strict=True))
        drawn.append(np.array([smooth_x, smooth_y]))
        unstable = [_unstable(row) and row["label"] not in LOCATED for row in line]
        for dashed, pieces in groupby(range(1, len(line)), key=unstable.__getitem__):
            i, *others = pieces
            piece = slice((i - 1) * FINE, (i + len(others)) * FINE + 1)
            axes.plot(smooth_x[piece], smooth_y[piece], color="C0", lw=1.2, linestyle=DASHED if dashed else "-")
        dots = [place(row, amplitude) for row in line if row["label"] in ("target", "step", "field")]
        axes.plot([x for x, _ in dots], [y for _, y in dots], ".", color="C0", markersize=3)
    marked = [row for row in part if row["label"] in LOCATED]
    for row in marked:
        at, kind = place(row, amplitude), str(row["label"])
        inside = "white" if kind == "bifurcation" else "C3"
        axes.plot(*at, "o", color="C3", markersize=4.5, label=_once(axes, kind), zorder=4, markerfacecolor=inside)
    solutions = [row for row in part if row["label"] == SOLUTION]
    for row in solutions:
        name, inside = ("unstable", "none") if _unstable(row) else ("stable", "C2")
        label = _once(axes, f"{name} solution")
        axes.plot(*place(row, amplitude), "s", color="C2", markerfacecolor=inside, markersize=4.5, label=label)
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.margins(0.06, 0.09)  # room for the numbers
    texts = [str(of.numbers[int(row["point"])]) for row in marked] + [str(row["branch"]) for row in solutions]
    places = [place(row, amplitude) for row in (*marked, *solutions)]
    write_numbers(axes, list(zip(places, texts, strict=True)), drawn)
    axes.locator_params(axis="x", nbins=6 if axes.get_position().width > NARROW else 3)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(number_format())
    axes.axhline(0, color="0.8", linewidth=0.8, zorder=0)
    if any(_unstable(row) for row in path) and marked:
        axes.plot([], [], color="C0", lw=1.2, label=_once(axes, "stable"))
        axes.plot([], [], color="C0", lw=1.2, linestyle=DASHED, label=_once(axes, "unstable"))


def _line(rows: Sequence[Row], amplitude: str) -> list[Row]:
    """The rows of a branch along its curve: those of the model, and what the model excludes at its end."""
    own = [row for row in rows if row["mode"] in OWN_MODES]
    last, before = (place(row, amplitude) for row in (own[-1], own[max(len(own) - 2, 0)]))
    beyond = [row for row in rows[-1:] if row not in own and row["label"] in LOCATED]
    ahead = np.subtract(last, before)
    return own + [row for row in beyond if np.dot(np.subtract(place(row, amplitude), last), ahead) > 0]


def _once(axes: "Axes", name: str) -> str:
    """A label of the legend; matplotlib leaves out "_"."""
    return "_" if name in axes.get_legend_handles_labels()[1] else name


NAMED = 12  # most waves in the legend


def frequencies_figure(found: Sequence[Frequency], rows: Sequence[Row], style: OutputSection) -> "Figure":
    """ω² ρ R²/E over the amplitude that varied last; the n-th lowest of each wave is one line."""
    from matplotlib.figure import Figure

    varied = next((str(row["amplitude"]) for row in reversed(rows) if row["amplitude"]), "")
    column = shown(registered(varied).column, rows[0]) if varied else None
    places = {int(row["point"]): float(row[column.name]) if column else 0.0 for row in rows}
    lines = defaultdict[tuple[str, int], list[tuple[float, float]]](list)
    count = defaultdict[tuple[int, str], int](int)
    for it in (it for it in found if it.point in places):
        lines[it.wave, count[it.point, it.wave]].append((places[it.point], it.omega2))
        count[it.point, it.wave] += 1
    width = (style.width or ONE) / INCH
    figure = Figure(figsize=(width, 0.75 * width), dpi=style.dpi, layout="constrained")
    axes, waves = figure.subplots(), list(dict.fromkeys(wave for wave, _ in lines))
    for (wave, number), points in sorted(lines.items()):
        named = wave if number == 0 and waves.index(wave) < NAMED else None
        axes.plot(*zip(*points, strict=True), ".-", color=f"C{waves.index(wave) % 10}", label=named, lw=1, ms=4)
    axes.axhline(0, color="0.6", lw=0.6)
    axes.set(xlabel=column.label if column else "", ylabel=r"$\omega^2 \rho R^2/E$")
    if waves != [""]:
        axes.legend(title="wave", frameon=False)
    return figure

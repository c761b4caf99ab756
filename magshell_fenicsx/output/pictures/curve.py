"""The load-displacement or pressure-volume curve as a picture, and natural frequencies along a
path.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.modes import Frequency
from magshell_fenicsx.output.pictures.captions import write_numbers
from magshell_fenicsx.output.pictures.layout import INCH, ONE, SEVERAL, drawing
from magshell_fenicsx.output.pictures.lines import (
    FINE,
    Line,
    Part,
    axes_for,
    drawn_parts,
    is_unstable,
    line_coordinates,
    named,
    of_load,
    place,
)
from magshell_fenicsx.output.pictures.scales import number_format
from magshell_fenicsx.output.store.table import LOCATED, POLE, SOLUTION, Row
from magshell_fenicsx.problem.requests import OutputSection
from magshell_fenicsx.quantities.registry import amplitude as registered
from magshell_fenicsx.quantities.registry import shown_quantity
from magshell_fenicsx.shells.modes import TORSION

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
PlaceOf = Callable[[Row], tuple[float, float]]
DASHED = (0, (2, 1.2))
NARROW = 0.3  # of the figure: few numbers fit below
MARKS = {"fold": "o", "bifurcation": "D"}
MARK = 3.5  # points
HIDDEN = 12.0  # points: an unstable part as small as this is hidden by the marks at its ends
AROUND = 0.8  # around such a part in its inset, over its size
ROUNDING = 1e-9  # of the widest curve of the same kind: a curve that is as narrow as this is noise
STRAIGHT = 0.005  # of its extent: a curve as near as this to its chord is a straight line
INSET = 0.4  # of the axes
CROWDED = 0.02  # of the points of all curves: an inset that covers more has no place


def curve_figure(
    rows: Sequence[Row], amplitude: str, style: OutputSection, place: str = POLE
) -> "Figure":
    """Draw the part of the path in which `amplitude` varied, and its branches; instabilities are
    marked and numbered.

    Of a programme each step is drawn, the last one largest, but for steps of a single straight
    line. Stable parts are solid, unstable parts dashed; an unstable part that its marks would hide
    is drawn again in an inset. A user-defined amplitude is drawn over the displacement of the pole,
    or what is called so.

    Parameters
    ----------
    place
        Name of the point of w_pole_over_h without named points.
    """
    from matplotlib.figure import Figure

    parts = worth_drawing(drawn_parts(rows, amplitude))
    first, wide = len(parts) - 1, parts[-1].amplitude == "time" or len(parts) > 2
    across = min(first, 3) if wide and first else len(parts)
    high = -(-first // across) if wide and first else 0
    width = (style.width or (ONE if len(parts) == 1 else SEVERAL)) / INCH
    last, each = width * (0.45 if wide and first else 0.75 / across), 0.75 * width / max(across, 2)
    with drawing(style):
        figure = Figure(figsize=(width, last + high * each), dpi=style.dpi, layout="constrained")
        grid = figure.add_gridspec(high + 1, across, height_ratios=[each] * high + [last])
        for i, part in enumerate(parts):
            alone = wide and i == first
            axes = figure.add_subplot(grid[high, :] if alone else grid[i // across, i % across])
            plot_curve(axes, part, place)
            axes.set_title(part.title)
        legend(figure, 4 * min(len(parts), 2))
        figure.draw_without_rendering()  # insets need the places of the axes
        for axes, part in zip(list(figure.axes), parts, strict=True):
            draw_hidden(axes, part)
    return figure


def worth_drawing(parts: Sequence[Part]) -> list[Part]:
    """The steps without those of a single straight line; the last one always."""
    widths: dict[str, float] = defaultdict(float)  # of what is drawn to the right
    names = [axes_for(part)[0].name for part in parts]
    for name, part in zip(names, parts, strict=True):
        widths[name] = max(widths[name], float(np.ptp(_points(part)[0])))
    bent = (
        part
        for name, part in zip(names[:-1], parts[:-1], strict=True)
        if _bends(part, ROUNDING * widths[name])
    )
    return [*bent, parts[-1]]


def _points(part: Part) -> Array:
    """The points of a curve (2, rows)."""
    return np.array([place(row, part.amplitude) for row in part.rows]).T


def _bends(part: Part, least: float) -> bool:
    """Whether the points of a curve are on no line; what is narrower than the least is upright."""
    x, y = _points(part)
    if np.ptp(x) <= least:
        return False
    wide, high = (float(np.ptp(values)) or 1.0 for values in (x, y))
    (a, b), x, y = (
        np.subtract((x[-1], y[-1]), (x[0], y[0])) / [wide, high],
        (x - x[0]) / wide,
        (y - y[0]) / high,
    )
    return bool(
        len(x) > 2 and np.abs(x * b - y * a).max() > STRAIGHT * (float(np.hypot(a, b)) or 1.0)
    )


def legend(figure: "Figure", most: int) -> None:
    """One legend above all axes, where it covers no curve."""
    entries = {
        name: line
        for axes in figure.axes
        for line, name in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if entries:
        figure.legend(
            entries.values(),
            entries.keys(),
            loc="outside upper center",
            ncols=min(len(entries), most),
            frameon=False,
            handlelength=1.5,
            columnspacing=1,
        )


def plot_curve(axes: "Axes", of: Part, pole: str = POLE) -> None:
    """Draw a part of a path in given axes."""
    x_label, y_label = (
        named(each, of.rows[0], pole, r"\$").label for each in axes_for(of)
    )  # a name is plain text
    drawn = draw_lines(axes, of)
    marked = [row for row in of.rows if row["label"] in LOCATED]
    solutions = [row for row in of.rows if row["label"] == SOLUTION]
    for row in solutions:
        name, inside = ("unstable", "none") if is_unstable(row) else ("stable", "C2")
        label = _once(axes, f"{name} solution")
        axes.plot(
            *place(row, of.amplitude),
            "s",
            color="C2",
            markerfacecolor=inside,
            markersize=4.5,
            label=label,
        )
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.margins(0.06, 0.09)  # room for the numbers
    texts = [str(of.numbers[int(row["point"])]) for row in marked] + [
        str(row["branch"]) for row in solutions
    ]
    places = [place(row, of.amplitude) for row in (*marked, *solutions)]
    write_numbers(axes, list(zip(places, texts, strict=True)), drawn)
    axes.locator_params(axis="x", nbins=6 if axes.get_position().width > NARROW else 3)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(number_format())
    axes.axhline(0, color="0.8", linewidth=0.8, zorder=0)
    if marked and any(is_unstable(row) for row in of.rows if row["label"] != SOLUTION):
        axes.plot([], [], color="C0", lw=1.2, label=_once(axes, "stable"))
        axes.plot([], [], color="C0", lw=1.2, linestyle=DASHED, label=_once(axes, "unstable"))


def draw_lines(
    axes: "Axes", of: Part, colour: str = "C0", place_of: PlaceOf | None = None
) -> list[Array]:
    """Draw the lines, points and marks of a part; its smooth curves (2, n).

    Parameters
    ----------
    place_of
        The coordinates of a row; by default those of the curve of the amplitude.
    """
    drawn, at = list[Array](), place_of or (lambda row: place(row, of.amplitude))
    load = None if place_of else of_load(of.amplitude)
    for line in line_coordinates(of):
        curve = line.joined(*zip(*map(at, line.rows), strict=True), of_load=load)
        drawn.append(curve)
        crossings = [row for row in of.rows if row["label"] in LOCATED and row not in line.rows]
        for unstable, pieces in groupby(
            _pieces(line, curve, crossings, at), key=lambda piece: piece[2]
        ):
            ends = [(first, last) for first, last, _ in pieces]
            piece = curve[:, ends[0][0] : ends[-1][1] + 1]
            axes.plot(*piece, color=colour, lw=1.2, linestyle=DASHED if unstable else "-")
        dots = [at(row) for row in line.rows if row["label"] in ("target", "step", "field")]
        axes.plot([x for x, _ in dots], [y for _, y in dots], ".", color=colour, markersize=3.5)
    for row in (row for row in of.rows if row["label"] in LOCATED):
        kind = str(row["label"])
        axes.plot(
            *at(row),
            MARKS[kind],
            color="C3",
            markerfacecolor="white",
            markersize=MARK,
            markeredgewidth=0.9,
            label=_once(axes, kind),
            zorder=4,
        )
    return drawn


def _pieces(
    line: Line, curve: Array, crossings: Sequence[Row], place_of: PlaceOf
) -> Iterator[tuple[int, int, bool]]:
    """The first and last point of each piece of a smooth curve, and whether it is unstable.

    Between two rows a mode that the model excludes crosses zero at the first or the last of the
    `crossings` there.
    """
    extent = np.ptp(curve, axis=1)[:, None]
    for i, unstable in enumerate(line.unstable):
        (row, after), low, high = line.rows[i : i + 2], i * FINE, (i + 1) * FINE
        within = [
            it for it in crossings if int(row["point"]) < int(it["point"]) < int(after["point"])
        ]
        if within and row["label"] not in LOCATED and is_unstable(row) != unstable:
            at = np.array(place_of(within[0 if unstable else -1]))[:, None]
            middle = low + int(
                np.argmin(np.linalg.norm((curve[:, low : high + 1] - at) / extent, axis=0))
            )
            yield low, middle, not unstable
            yield middle, high, unstable
        else:
            yield low, high, unstable


def hidden(axes: "Axes", of: Part) -> Array | None:
    """The corners (2, 2) of the first unstable part of a curve that its marks hide; None if all can
    be seen.
    """
    for line in line_coordinates(of):
        places = [place(row, of.amplitude) for row in line.rows]
        curve = line.joined(*zip(*places, strict=True), of_load=of_load(of.amplitude))
        for first, last, unstable in line.pieces:
            piece = curve[:, first * FINE : last * FINE + 1]
            size = np.ptp(axes.transData.transform(piece.T), axis=0) * 72 / axes.figure.dpi
            if unstable and line.rows[last]["label"] in LOCATED and max(size) < HIDDEN:
                low, high = piece.min(axis=1), piece.max(axis=1)
                return np.array([low - AROUND * (high - low), high + AROUND * (high - low)])
    return None


def draw_hidden(axes: "Axes", of: Part) -> None:
    """Draw an unstable part that its marks hide once more in an inset, in the corner with the least
    of the curves.
    """
    if (box := hidden(axes, of)) is None:
        return
    points = drawn_points(axes)
    inside = axes.transAxes.inverted().transform(axes.transData.transform(points))
    gap = 0.14  # room for the numbers of the inset
    corners = [(x, y) for y in (gap, 0.97 - INSET) for x in (0.97 - INSET, gap)]
    low = np.array(corners) - gap
    covered = [((inside > at) & (inside < at + INSET + gap)).all(axis=1).mean() for at in low]
    best = int(np.argmin(covered))
    if covered[best] > CROWDED:
        return
    small = axes.inset_axes((*corners[best], INSET, INSET))
    draw_lines(small, of)
    small.set(xlim=box[:, 0], ylim=box[:, 1])
    small.tick_params(labelsize="x-small", length=2)
    small.locator_params(nbins=3)
    axes.indicate_inset_zoom(small, edgecolor="0.4", linewidth=0.6)


def drawn_points(axes: "Axes") -> Array:
    """The places (n, 2) of all lines in axes."""
    return np.concatenate(
        [np.asarray(line.get_xydata(), float).reshape(-1, 2) for line in axes.lines]
    )


def _once(axes: "Axes", name: str) -> str:
    """A label of the legend; matplotlib leaves out "_"."""
    return "_" if name in axes.get_legend_handles_labels()[1] else name


NAMED = 12  # most waves in the legend


def frequencies_figure(
    frequencies: Sequence[Frequency], rows: Sequence[Row], style: OutputSection
) -> "Figure":
    """Frequencies over the amplitude that varied last; the n-th lowest of each wave is one line.

    Of one point alone over the number of waves, where all have one, else over the number of the
    mode. In Hz with a density, those of unstable modes below zero; else ω² ρ R²/E.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    varied = next((str(row["amplitude"]) for row in reversed(rows) if row["amplitude"]), "")
    column = shown_quantity(registered(varied).column, rows[0]) if varied else None
    places = {int(row["point"]): float(row[column.name]) if column else 0.0 for row in rows}
    vibrating = (it for it in frequencies if it.omega2 > 0 and not np.isnan(it.hertz))
    of_root = max(
        (it.hertz / np.sqrt(it.omega2) for it in vibrating), default=0.0
    )  # Hz; 0 without a density
    lines = defaultdict[tuple[str, int], list[tuple[float, float]]](list)
    count = defaultdict[tuple[int, str], int](int)
    drawn = [it for it in frequencies if it.point in places]
    alone, of_waves = (
        len({it.point for it in drawn}) == 1,
        all(it.wave.isdigit() for it in drawn if it.wave != TORSION),
    )
    for n, it in enumerate(drawn, 1):
        signed = np.sign(it.omega2) * of_root * np.sqrt(abs(it.omega2)) if of_root else it.omega2
        place = (int(it.wave) if it.wave.isdigit() else 0) if of_waves else n
        lines[it.wave, count[it.point, it.wave]].append(
            (place if alone else places[it.point], float(signed))
        )
        count[it.point, it.wave] += 1
    width = (style.width or ONE) / INCH
    figure = Figure(figsize=(width, 0.75 * width), dpi=style.dpi, layout="constrained")
    axes, waves = figure.subplots(), list(dict.fromkeys(wave for wave, _ in lines))
    if spectrum := alone and of_waves:
        waves = ["waves", *({TORSION} & set(waves))]
    for (wave, number), points in lines.items():
        wave = "waves" if spectrum and wave != TORSION else wave
        named = wave if number == 0 and waves.index(wave) < NAMED else None
        axes.plot(
            *zip(*points, strict=True),
            ".-",
            color=f"C{waves.index(wave) % 10}",
            label=named,
            lw=1,
            ms=4,
        )
    axes.axhline(0, color="0.6", lw=0.6)
    grows = "; below zero it grows" if any(it.omega2 < 0 for it in frequencies) else ""
    said = f"frequency  (Hz){grows}"
    of_one = "waves around the axis" if of_waves else "number of the mode"
    of_path = column.label if column else ""
    axes.set(
        xlabel=of_one if alone else of_path, ylabel=said if of_root else r"$\omega^2 \rho R^2/E$"
    )
    if alone:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if waves not in ([""], ["waves"]):
        figure.legend(title="wave", frameon=False, loc="outside right upper", fontsize="small")
    return figure

"""Curves of a run as pictures: load over displacement, and natural frequencies along a path.

A row is a line of path.csv: one point of the path. A step (`CurveStep`) has the rows of one load
step; a line (`Line`) those of one branch, drawn as a smooth curve with SEGMENTS_PER_INTERVAL
segments between two rows. A located row is a fold or a bifurcation, with the label of that name
(`LOCATED`); a crossing is one at which a mode that the model excludes becomes neutral. A solution
is what a search found, with the label `SOLUTION`. An amplitude is a load parameter, by name; it is
one coordinate of a curve, a displacement the other. The pole is the point of the column
w_pole_over_h. A frequency has omega2 = ω² ρ R²/E, with the angular frequency ω.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.mode_fields import Frequency
from magshell_fenicsx.output.pictures.captions import write_numbers
from magshell_fenicsx.output.pictures.error_band import draw_error_band, errors_at_points
from magshell_fenicsx.output.pictures.layout import (
    INCH,
    ONE_COLUMN,
    TWO_COLUMNS,
    drawing,
    place_axes,
)
from magshell_fenicsx.output.pictures.lines import (
    SEGMENTS_PER_INTERVAL,
    CurveStep,
    Line,
    axes_for,
    curve_coordinates,
    curve_panels,
    curve_steps,
    curve_title,
    is_unstable,
    line_coordinates,
    load_axis,
    with_point_name,
)
from magshell_fenicsx.output.pictures.scales import number_format
from magshell_fenicsx.output.store.table import LOCATED, POLE, SOLUTION, Row
from magshell_fenicsx.problem.requests import OutputSection
from magshell_fenicsx.quantities.mode_labels import TORSION
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import LOAD_FACTOR, shown_quantity
from magshell_fenicsx.quantities.registry import amplitude as registered

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
PlaceOf = Callable[[Row], tuple[float, float]]
DASHED = (0, (2, 1.2))
NARROW_AXES = 0.3  # of the figure's width: few numbers fit below
MARKS = {"fold": "o", "bifurcation": "D"}
MARK_SIZE = 3.5  # points
HIDDEN_SIZE = 12.0  # points: a smaller unstable part is hidden by the marks at its ends
INSET_MARGIN = 0.8  # around such a part in its inset, over its size
WIDTH_TOLERANCE = 1e-9  # over the widest curve of the same kind: a narrower curve is noise
STRAIGHTNESS_TOLERANCE = 0.005  # distance from the chord over the extent, of a straight line
ARROW_LENGTH, MIN_LENGTH_OF_WAY = 8.0, 24.0  # pixels: of an arrow, and of a step with an arrow
INSET_SIZE = 0.4  # of the axes
INSET_GAP = 0.14  # of the axes: room for the numbers of the inset
MAX_COVERED = 0.03  # of the points of all curves, that an inset may cover


def curve_figure(
    rows: Sequence[Row],
    amplitude: str,
    style: OutputSection,
    pole: str = POLE,
    errors: Mapping[str, float] | None = None,
    load: str = "",
) -> "Figure":
    """Return the figure of the part of a path in which `amplitude` varied, with its branches.

    Instabilities are marked and numbered. Of a programme each step is drawn; steps over the same
    quantities are in one panel, with arrows along their way. The last panel is largest; earlier
    ones with a single straight line are left out. Stable parts are solid, unstable
    parts dashed. An unstable part that its marks would hide is drawn again in an inset. A
    user-defined amplitude is drawn over the displacement of the pole.

    Parameters
    ----------
    rows
        Rows of path.csv.
    pole
        Name of the point of w_pole_over_h without named points.
    errors
        Estimated errors by the name of the result, as in summary.json; a band shows them where it
        is wider than the line.
    load
        The dead load at a load factor of 1, as text; empty if it is no single number.
    """
    panels = drawn_panels(rows, amplitude)
    with drawing(style):
        figure, cells = _figure_with_cells(panels, style)
        for cell, steps in zip(cells, panels, strict=True):
            axes = figure.add_subplot(cell)
            plot_curve(axes, steps, pole, load)
            axes.set_title(curve_title(steps))
        legend(figure, max_columns=4 * min(len(panels), 2))
        place_axes(figure)  # for insets
        errors_of_points = errors_at_points(rows, errors or {})
        for axes, steps in zip(list(figure.axes), panels, strict=True):
            draw_hidden(axes, steps)
            for step in steps:
                draw_error_band(axes, step, errors_of_points)
    return figure


def drawn_panels(rows: Sequence[Row], amplitude: str) -> list[list[CurveStep]]:
    """Return the steps in each panel of the picture of a path in which `amplitude` varied last."""
    steps = curve_steps(rows, amplitude)
    bent_steps = worth_drawing(steps)
    return [
        panel
        for panel in curve_panels(steps)
        if any(step is bent for step in panel for bent in bent_steps)
    ]


def _figure_with_cells(
    panels: Sequence[Sequence[CurveStep]], style: OutputSection
) -> tuple["Figure", list[Any]]:
    """Return an empty figure, and matplotlib's cell of its grid for the axes of each panel.

    The last panel spans a whole row below the others if it is a motion, or if there are three
    panels or more. Otherwise all are in one row. Lengths in the code are in inches.
    """
    from matplotlib.figure import Figure

    last_number = len(panels) - 1
    last_is_wide = panels[-1][0].amplitude == "time" or len(panels) > 2
    width = (style.width or (ONE_COLUMN if len(panels) == 1 else TWO_COLUMNS)) / INCH
    # rows of small axes, and the last row, which is all if the last panel is not wide
    if last_is_wide and last_number:
        columns = min(last_number, 3)
        small_row_count = -(-last_number // columns)  # rounded up
        last_height = 0.45 * width  # wider than the others, so lower over its width
    else:
        columns, small_row_count = len(panels), 0
        last_height = width * (0.75 / columns)
    small_height = 0.75 * width / max(columns, 2)
    figure = Figure(
        figsize=(width, last_height + small_row_count * small_height),
        dpi=style.dpi,
        layout="constrained",
    )
    grid = figure.add_gridspec(
        small_row_count + 1,
        columns,
        height_ratios=[small_height] * small_row_count + [last_height],
    )
    cells = [grid[i // columns, i % columns] for i in range(last_number)]
    if last_is_wide:
        return figure, [*cells, grid[small_row_count, :]]
    return figure, [*cells, grid[last_number // columns, last_number % columns]]


def worth_drawing(parts: Sequence[CurveStep]) -> list[CurveStep]:
    """Return the steps whose curve is not a single straight line, and always the last step."""
    # name of the quantity on the x axis of each step
    names = list[str]()
    for step in parts:
        x_quantity, _ = axes_for(step)
        names.append(x_quantity.name)
    # the width of the widest curve over each quantity; far narrower curves are noise
    widths: dict[str, float] = defaultdict(float)
    for name, step in zip(names, parts, strict=True):
        x, _ = _points(step)
        widths[name] = max(widths[name], float(np.ptp(x)))
    bent_steps = (
        step
        for name, step in zip(names[:-1], parts[:-1], strict=True)
        if _bends(step, WIDTH_TOLERANCE * widths[name])
    )
    return [*bent_steps, parts[-1]]


def _points(step: CurveStep) -> Array:
    """Return the coordinates (2, rows) of a step's rows in the axes of its curve."""
    return np.array([curve_coordinates(row, step.amplitude) for row in step.rows]).T


def _bends(step: CurveStep, min_width: float) -> bool:
    """Whether the curve of a step is no straight line.

    A curve narrower than `min_width`, in the unit of its x axis, counts as an upright line.
    """
    x, y = _points(step)
    if np.ptp(x) <= min_width:
        return False
    width, height = (float(np.ptp(values)) or 1.0 for values in (x, y))
    x, y = (x - x[0]) / width, (y - y[0]) / height
    chord_x, chord_y = x[-1], y[-1]
    chord_length = float(np.hypot(chord_x, chord_y)) or 1.0
    # distance from the chord times its length, in axes scaled to one
    distance = np.abs(x * chord_y - y * chord_x).max()
    return bool(len(x) > 2 and distance > STRAIGHTNESS_TOLERANCE * chord_length)


def legend(figure: "Figure", max_columns: int) -> None:
    """Draw one legend above all axes of a figure, where it covers no curve.

    Equal names are one entry; `max_columns` is the largest number of entries in a row. The figure
    must have a layout that leaves room above the axes.
    """
    entries = dict[str, Any]()
    for axes in figure.axes:
        handles, names = axes.get_legend_handles_labels()
        entries |= dict(zip(names, handles, strict=True))
    if entries:
        figure.legend(
            entries.values(),
            entries.keys(),
            loc="outside upper center",
            ncols=min(len(entries), max_columns),
            frameon=False,
            handlelength=1.5,
            columnspacing=1,
        )


def plot_curve(axes: "Axes", steps: Sequence[CurveStep], pole: str = POLE, load: str = "") -> None:
    """Draw steps of a path in given axes: curves, instabilities, solutions, numbers and labels.

    Several steps have arrows along their way. `pole` names the point of w_pole_over_h in a case
    without named points, `load` is the dead load at a load factor of 1.
    """
    amplitude, first_row = steps[0].amplitude, steps[0].rows[0]
    x_label, y_label = (
        axis_label(axis_quantity, first_row, pole, load) for axis_quantity in axes_for(steps[0])
    )
    curves = [curve for step in steps for curve in draw_lines(axes, step)]
    rows = [row for step in steps for row in step.rows]
    solutions = [row for row in rows if row["label"] == SOLUTION]
    # squares at solutions, filled if they are stable
    for row in solutions:
        name, fill = ("unstable", "none") if is_unstable(row) else ("stable", "C2")
        label = _once(axes, f"{name} solution")
        axes.plot(
            *curve_coordinates(row, amplitude),
            "s",
            color="C2",
            markerfacecolor=fill,
            markersize=4.5,
            label=label,
        )
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.margins(0.06, 0.09)  # room for the numbers
    axes.axhline(0, color="0.8", linewidth=0.8, zorder=0)  # it may move the limits
    # numbers of instabilities along the path, and of the solutions of searches
    numbers = {  # of a point: a step begins at a row of the step before
        int(row["point"]): (row, step.numbers[int(row["point"])])
        for step in steps
        for row in step.rows
        if row["label"] in LOCATED
    }
    marks = [(curve_coordinates(row, amplitude), number) for row, number in numbers.values()]
    marks += [(curve_coordinates(row, amplitude), int(row["branch"])) for row in solutions]
    write_numbers(axes, marks, curves)
    is_narrow = axes.get_position().width <= NARROW_AXES
    axes.locator_params(axis="x", nbins=3 if is_narrow else 6)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(number_format())
    if len(steps) > 1:
        for step in steps:
            _draw_direction(axes, step)
    has_unstable = any(line.is_dashed() for line in axes.lines)
    if numbers and has_unstable:  # empty lines, for the legend
        axes.plot([], [], color="C0", lw=1.2, label=_once(axes, "stable"))
        axes.plot([], [], color="C0", lw=1.2, linestyle=DASHED, label=_once(axes, "unstable"))


def axis_label(axis_quantity: Quantity, row: Row, pole: str = POLE, load: str = "") -> str:
    """Return the label of an axis, with the unit of a time that has no seconds.

    That of the load factor has the load at a factor of 1.

    Parameters
    ----------
    axis_quantity
        The quantity of the axis.
    row
        A row of path.csv, which names the case's points.
    pole
        Name of the point of w_pole_over_h in a case without named points.
    load
        The dead load at a load factor of 1, as text; empty if it is no single number.
    """
    if axis_quantity.name == LOAD_FACTOR and load:
        return rf"{axis_quantity.label}  ($\times$ {load})"
    label = with_point_name(axis_quantity, row, pole, r"\$").label
    return rf"{label}  ($R\sqrt{{\rho/E}}$)" if axis_quantity.name == "time" else label


def _draw_direction(axes: "Axes", step: CurveStep) -> None:
    """Draw an arrowhead in the middle of the main line of a step, along its way."""
    main_line = line_coordinates(step)[0]
    places = [curve_coordinates(row, step.amplitude) for row in main_line.rows]
    curve = main_line.smooth_curve(*zip(*places, strict=True), load_axis=load_axis(step.amplitude))
    pixels = axes.transData.transform(curve.T)
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(pixels, axis=0), axis=1)))
    # from a little before the middle of the way to a little behind it
    places = length[-1] / 2 + ARROW_LENGTH * np.array([-0.5, 0.5])
    (x, next_x), (y, next_y) = (np.interp(places, length, values) for values in curve)
    if length[-1] > MIN_LENGTH_OF_WAY:
        axes.annotate(
            "",
            (next_x, next_y),
            (x, y),
            arrowprops={
                "arrowstyle": "-|>,head_length=0.7,head_width=0.25",
                "color": "C0",
                "shrinkA": 0,
                "shrinkB": 0,
            },
        )


def draw_lines(
    axes: "Axes", step: CurveStep, colour: str = "C0", place_of: PlaceOf | None = None
) -> list[Array]:
    """Draw the lines, points and marks of a step, and return its smooth curves.

    Parameters
    ----------
    colour
        Colour of lines and points.
    place_of
        Function from a row to its coordinates; by default those of the curve of the amplitude.

    Returns
    -------
    Coordinates (2, n) of each line.
    """
    curves = list[Array]()
    coordinates = place_of or (lambda row: curve_coordinates(row, step.amplitude))
    # which coordinate is the amplitude and has its extreme at a fold; of other curves unknown
    load_coordinate = None if place_of else load_axis(step.amplitude)
    for line in line_coordinates(step):
        x, y = zip(*map(coordinates, line.rows), strict=True)
        curve = line.smooth_curve(x, y, load_axis=load_coordinate)
        curves.append(curve)
        # instabilities by modes that the model excludes: they are between the rows of the line
        crossings = [row for row in step.rows if row["label"] in LOCATED and row not in line.rows]
        segments = _segments(line, curve, crossings, coordinates)
        # consecutive segments that are all stable or all unstable are one drawn line
        for unstable, group in groupby(segments, key=lambda segment: segment[2]):
            segments_alike = list(group)
            first_point, _, _ = segments_alike[0]
            _, last_point, _ = segments_alike[-1]
            part_of_curve = curve[:, first_point : last_point + 1]
            axes.plot(*part_of_curve, color=colour, lw=1.2, linestyle=DASHED if unstable else "-")
        # dots at ordinary points
        dots = [
            coordinates(row) for row in line.rows if row["label"] in ("target", "step", "field")
        ]
        axes.plot([x for x, _ in dots], [y for _, y in dots], ".", color=colour, markersize=3.5)
    # marks at instabilities
    for row in (row for row in step.rows if row["label"] in LOCATED):
        kind = str(row["label"])
        axes.plot(
            *coordinates(row),
            MARKS[kind],
            color="C3",
            markerfacecolor="white",
            markersize=MARK_SIZE,
            markeredgewidth=0.9,
            label=_once(axes, kind),
            zorder=4,
        )
    return curves


def _segments(
    line: Line, curve: Array, crossings: Sequence[Row], place_of: PlaceOf
) -> Iterator[tuple[int, int, bool]]:
    """Yield (first point, last point, is unstable) of each segment of a smooth curve.

    If a symmetry-breaking mode becomes neutral between two rows, the segment is divided there.

    Parameters
    ----------
    line
        Rows along the curve.
    curve
        (2, n) points of the smooth curve, SEGMENTS_PER_INTERVAL for each interval between rows.
    crossings
        Rows at which such a mode is neutral; the first or the last of those between two rows
        divides.
    place_of
        Coordinates of a row.
    """
    extent = np.ptp(curve, axis=1)[:, None]
    for i, unstable in enumerate(line.unstable):  # one entry for each interval between two rows
        row, next_row = line.rows[i : i + 2]
        # points of the curve at both rows, and the rows' numbers on the path
        low, high = i * SEGMENTS_PER_INTERVAL, (i + 1) * SEGMENTS_PER_INTERVAL
        number, next_number = int(row["point"]), int(next_row["point"])
        crossings_between = [
            crossing for crossing in crossings if number < int(crossing["point"]) < next_number
        ]
        # whether the stability changes between the two rows: the first row, if it is no instability
        # itself, has another stability than the interval, which is as stable as the next row
        changes = row["label"] not in LOCATED and is_unstable(row) != unstable
        if crossings_between and changes:
            # a path that becomes unstable does so at the first crossing between the rows; one that
            # becomes stable does so at the last one
            crossing_place = np.array(place_of(crossings_between[0 if unstable else -1]))[:, None]
            offsets = (curve[:, low : high + 1] - crossing_place) / extent
            middle = low + int(np.argmin(np.linalg.norm(offsets, axis=0)))
            yield low, middle, not unstable
            yield middle, high, unstable
        else:
            yield low, high, unstable


def hidden_box(axes: "Axes", step: CurveStep) -> Array | None:
    """Return the box around the first unstable part of a curve that its marks hide.

    Returns
    -------
    Lower left and upper right corner (2, 2) in data coordinates; None if no unstable part is
    hidden.
    """
    for line in line_coordinates(step):
        places = [curve_coordinates(row, step.amplitude) for row in line.rows]
        load_coordinate = load_axis(step.amplitude)
        curve = line.smooth_curve(*zip(*places, strict=True), load_axis=load_coordinate)
        for first_row, last_row, unstable in line.segments:
            begin, end = first_row * SEGMENTS_PER_INTERVAL, last_row * SEGMENTS_PER_INTERVAL
            part_of_curve = curve[:, begin : end + 1]
            # points are 1/72 inch
            size_in_points = (
                np.ptp(axes.transData.transform(part_of_curve.T), axis=0) * 72 / axes.figure.dpi
            )
            ends_at_mark = line.rows[last_row]["label"] in LOCATED
            is_hidden = ends_at_mark and max(size_in_points) < HIDDEN_SIZE
            if unstable and is_hidden:
                low, high = part_of_curve.min(axis=1), part_of_curve.max(axis=1)
                margin = INSET_MARGIN * (high - low)
                return np.array([low - margin, high + margin])
    return None


def draw_hidden(axes: "Axes", steps: Sequence[CurveStep]) -> None:
    """Draw in an inset the first unstable part that its marks hide; do nothing if none is hidden.

    The inset is in the corner with the fewest points of the curves. It is left out where all
    corners are covered.
    """
    boxes = (hidden_box(axes, step) for step in steps)
    if (box := next((box for box in boxes if box is not None), None)) is None:
        return
    if (corner := _corner_of_inset(axes)) is None:
        return
    inset = axes.inset_axes((*corner, INSET_SIZE, INSET_SIZE))
    for step in steps:
        draw_lines(inset, step)
    inset.set(xlim=box[:, 0], ylim=box[:, 1])
    inset.tick_params(length=2)
    inset.locator_params(nbins=3)
    axes.indicate_inset_zoom(inset, edgecolor="0.4", linewidth=0.6)


def _corner_of_inset(axes: "Axes") -> tuple[float, float] | None:
    """Return the lower left corner of an inset that covers few points; None if all cover many.

    It is in units of the axes, from 0 to 1.
    """
    points = drawn_points(axes)
    places = axes.transAxes.inverted().transform(axes.transData.transform(points))
    far_side = 0.97 - INSET_SIZE  # a margin of 0.03
    corners = [(x, y) for y in (INSET_GAP, far_side) for x in (far_side, INSET_GAP)]
    covered = list[float]()  # fraction of the points that an inset at each corner covers
    for corner in np.array(corners) - INSET_GAP:  # with room for numbers, left and below
        is_covered = (places > corner) & (places < corner + INSET_SIZE + INSET_GAP)
        covered.append(float(is_covered.all(axis=1).mean()))
    best = int(np.argmin(covered))
    return None if covered[best] > MAX_COVERED else corners[best]


def drawn_points(axes: "Axes") -> Array:
    """Return the places (n, 2) of all lines in axes, in data coordinates."""
    return np.concatenate(
        [np.asarray(line.get_xydata(), float).reshape(-1, 2) for line in axes.lines]
    )


def _once(axes: "Axes", name: str) -> str:
    """Return `name` as a label of the legend, or "_" if the axes have that label already.

    Matplotlib leaves out labels that begin with "_".
    """
    _, names = axes.get_legend_handles_labels()
    return "_" if name in names else name


MAX_NAMED_WAVES = 12  # waves in the legend


def frequencies_figure(
    frequencies: Sequence[Frequency], rows: Sequence[Row], style: OutputSection
) -> "Figure":
    """Return the figure of natural frequencies over the amplitude that varied last.

    The n-th lowest frequency of each wave is one line. Frequencies of one point alone are drawn
    over their number of waves if all have one, else over the number of the mode. With a density
    they are in Hz, those of unstable modes below zero; without one the figure shows ω² ρ R²/E.

    Parameters
    ----------
    frequencies
        Frequencies of all points, ascending at each.
    rows
        Rows of path.csv with fields; frequencies of other points are left out.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    varied_amplitudes = (str(row["amplitude"]) for row in reversed(rows) if row["amplitude"])
    name = next(varied_amplitudes, "")
    column = shown_quantity(registered(name).column, rows[0]) if name else None
    # number of a point -> value of the amplitude that varied last
    load_by_point = {int(row["point"]): float(row[column.name]) if column else 0.0 for row in rows}
    shown = [frequency for frequency in frequencies if frequency.point in load_by_point]
    is_one_point = len({frequency.point for frequency in shown}) == 1
    over_waves = all(f.wave.isdigit() for f in shown if f.wave != TORSION)
    hertz_per_root = _hertz_per_root(frequencies)

    abscissae: Sequence[float]
    if not is_one_point:
        abscissae = [load_by_point[f.point] for f in shown]
    elif over_waves:  # torsion has no waves
        abscissae = [int(f.wave) if f.wave.isdigit() else 0 for f in shown]
    else:
        abscissae = range(1, len(shown) + 1)
    # (wave, rank) -> places (x, y) of a line; the lowest frequency of a wave has the rank 0
    lines = _lines_of_frequencies(shown, abscissae, hertz_per_root)

    width = (style.width or ONE_COLUMN) / INCH
    figure = Figure(figsize=(width, 0.75 * width), dpi=style.dpi, layout="constrained")
    axes = figure.subplots()
    waves = _draw_frequencies(axes, lines, in_one_colour=is_one_point and over_waves)
    has_unstable = any(frequency.omega2 < 0 for frequency in frequencies)
    if hertz_per_root:
        axes.set(ylabel="frequency  (Hz)" + ("; below zero it grows" if has_unstable else ""))
    else:
        axes.set(ylabel=r"$\omega^2 \rho R^2/E$")
    if is_one_point:
        axes.set(xlabel="waves around the axis" if over_waves else "number of the mode")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    else:
        axes.set(xlabel=column.label if column else "")
    if waves not in ([""], ["waves"]):  # one wave alone needs no legend
        figure.legend(title="wave", frameon=False, loc="outside right upper")
    return figure


def _draw_frequencies(
    axes: "Axes",
    lines: Mapping[tuple[str, int], Sequence[tuple[float, float]]],
    *,
    in_one_colour: bool,
) -> list[str]:
    """Draw lines of frequencies in axes, and return the names of their colours in the legend.

    Parameters
    ----------
    lines
        (wave, rank) -> places (x, y) of a line. Each wave has a colour, for lines of all ranks.
    in_one_colour
        Whether all waves have one colour, named "waves", and torsion another.
    """
    waves = list(dict.fromkeys(wave for wave, _ in lines))
    if in_one_colour:
        waves = ["waves", *({TORSION} & set(waves))]
    for (wave, rank), points in lines.items():
        wave = "waves" if in_one_colour and wave != TORSION else wave
        number = waves.index(wave)
        label = wave if rank == 0 and number < MAX_NAMED_WAVES else None
        axes.plot(
            *zip(*points, strict=True), ".-", color=f"C{number % 10}", label=label, lw=1, ms=4
        )
    axes.axhline(0, color="0.6", lw=0.6)
    return waves


def _lines_of_frequencies(
    frequencies: Sequence[Frequency], abscissae: Sequence[float], hertz_per_root: float
) -> dict[tuple[str, int], list[tuple[float, float]]]:
    """Return (wave, rank) -> the places (x, y) of one line of the figure of frequencies.

    The rank is 0 for the lowest frequency of a wave at a point, 1 for the next one. A line connects
    frequencies of one wave and one rank at all points.

    Parameters
    ----------
    frequencies, abscissae
        Frequencies, ascending at each point, and the abscissa of each.
    hertz_per_root
        Frequency in Hz of omega2 = 1. If it is 0, ordinates are omega2 itself.
    """
    lines = defaultdict[tuple[str, int], list[tuple[float, float]]](list)
    count = defaultdict[tuple[int, str], int](int)  # by point and wave: frequencies so far
    for frequency, abscissa in zip(frequencies, abscissae, strict=True):
        value = omega2 = frequency.omega2
        if hertz_per_root:
            value = float(np.sign(omega2) * hertz_per_root * np.sqrt(abs(omega2)))
        rank = count[frequency.point, frequency.wave]
        lines[frequency.wave, rank].append((abscissa, float(value)))
        count[frequency.point, frequency.wave] += 1
    return lines


def _hertz_per_root(frequencies: Sequence[Frequency]) -> float:
    """Return the frequency in Hz of omega2 = 1; 0 without a density.

    A frequency in Hz is this factor times the root of its omega2 = ω² ρ R²/E.
    """
    # every stable frequency gives the same factor; unstable ones have no frequency in Hz
    return max(
        (
            frequency.hertz / np.sqrt(frequency.omega2)
            for frequency in frequencies
            if frequency.omega2 > 0 and not np.isnan(frequency.hertz)
        ),
        default=0.0,
    )

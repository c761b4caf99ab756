"""The picture of a sweep: a result over one swept number or as a map over two, or all curves.

An axis of a sweep is one key of the case, or several tied ones, with its values; axes of a picture
are `plot`. A point is a case with a value for each axis; its outcome has the curve of its run, rows
of path.csv. An amplitude is a load parameter, by name, that varies along a part of the curve. A
knockdown factor is the first buckling pressure over the classical one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magshell_fenicsx.input.section import case_sizes
from magshell_fenicsx.quantities.registry import OWN_MODES, axes_of
from magshell_fenicsx.studies.naming import key_label, key_symbol, key_words
from magshell_fenicsx.studies.points import Axis, SweepPoint, last_numeric_axis
from magshell_fenicsx.studies.runner import Outcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from magshell_fenicsx.output.store.table import Row

LEGEND_ROWS = 16
STYLES = ("-", "--", ":", "-.")
MAPPED = 3  # least different values of both axes of a map
SMOOTH = 8  # least for contours; fewer are cells with their values
# most columns and digits of written values; colours from here on are bright
WRITTEN, LONGEST, BRIGHT = 9, 5, 0.6
KNOCKDOWN, BARRIER = r"knockdown factor  $k_\mathrm{d}$", r"energy barrier  ($E h R^2$)"


@dataclass(frozen=True)
class Results:
    """A number of each point of a sweep, for the picture.

    Attributes
    ----------
    values
        The number at each point; None where a point lacks it.
    label
        Label of the axis.
    size, measured
        Factor and label of a second scale in the case's units; the factor is 0 if the points do not
        share one.
    """

    values: Sequence[float | None]
    label: str
    size: float = 0.0
    measured: str = ""


def _distinct_values(axis: Axis, points: Sequence[SweepPoint]) -> tuple[str, ...]:
    """Return the values of points on an axis, each once, in the order of the points."""
    return tuple(dict.fromkeys(point.values[axis.keys[0]] for point in points))


def draw_sweep(
    axes: Sequence[Axis],
    points: Sequence[SweepPoint],
    outcomes: Sequence[Outcome],
    file: Path,
    requested: tuple[str, Sequence[float | None]] | None = None,
) -> None:
    """Draw the results of a sweep: a map over two keys, or lines over the last key with numbers.

    Without results it draws the curves of all points. There is one line for each combination of the
    values that are not on the horizontal axis.

    Parameters
    ----------
    requested
        The name of a result and its value at each point; None draws energy barriers, knockdown
        factors or curves.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    # values of all points, also of earlier sweeps
    axes = [Axis(axis.keys, _distinct_values(axis, points)) for axis in axes]
    figure, plot = plt.subplots(figsize=(7.2, 4.2), layout="constrained")
    results, is_map = _results(outcomes, requested), _is_map(axes)
    if is_map:
        _map(plot, axes, points, results or _ends(outcomes))
    elif results:
        _values(plot, axes, points, results)
    else:
        _curves(plot, points, outcomes)
    plot.set_title(_common_numbers(points), fontsize=9)
    labels = plot.get_legend_handles_labels()[1]
    if labels and any(labels):
        columns = -(-len(labels) // LEGEND_ROWS)  # rounded up
        figure.legend(loc="outside right upper", fontsize=8, frameon=False, ncols=columns)
    figure.savefig(file, dpi=200)
    plt.close(figure)


def _common_numbers(points: Sequence[SweepPoint]) -> str:
    """Return R/h and Poisson's ratio as text, if all points have the same."""
    texts = []
    for symbol, values in (
        ("$R/h$", {round(case_sizes(point.case.shell).R_over_h, 9) for point in points}),
        (r"$\nu$", {point.case.shell.poisson_ratio for point in points}),
    ):
        if len(values) == 1:
            texts.append(f"{symbol} = {next(iter(values)):.6g}")
    return ", ".join(texts)


def _is_map(axes: Sequence[Axis]) -> bool:
    """Return whether two keys with numbers are swept, both over enough values for a map."""
    return len(axes) == 2 and all(len(set(axis.numbers or ())) >= MAPPED for axis in axes)


def _results(
    outcomes: Sequence[Outcome], requested: tuple[str, Sequence[float | None]] | None
) -> Results | None:
    """Return the requested result; else energy barriers or knockdown factors; None without any.

    Barriers and knockdowns have a second scale if all points share its units.
    """
    if requested:
        name, values = requested
        if name not in ("knockdown", "barrier"):
            return Results(values, label=name)
    barriers, knockdowns = [o.barrier for o in outcomes], [o.knockdown for o in outcomes]
    # second scales: the units of energy and pressure in millijoule and pascal
    if any(value is not None for value in barriers):
        energy_unit = _common(outcomes, "unit_energy_mJ")
        return Results(barriers, BARRIER, size=energy_unit, measured="energy barrier  (mJ)")
    if any(value is not None for value in knockdowns):
        pressure_unit = _common(outcomes, "classical_pressure_Pa")
        return Results(
            knockdowns, KNOCKDOWN, size=pressure_unit, measured="buckling pressure  (Pa)"
        )
    return None


def _common(outcomes: Sequence[Outcome], name: str) -> float:
    """Return a number of the case in units, which all points share; 0 if they do not."""
    sizes = [outcome.in_units.get(name, 0.0) for outcome in outcomes]
    return sizes[0] if np.allclose(sizes, sizes[0], rtol=1e-9, atol=0) else 0.0


def _ends(outcomes: Sequence[Outcome]) -> Results:
    """Return the last load of each curve; the last displacement if all loads are the same."""
    last_rows = [outcome.curve[-1] if outcome.curve else {} for outcome in outcomes]
    last_row = next((row for row in last_rows if row), {})  # of the first point with a curve
    # quantities on the axes of a curve: displacement x and load y of the last amplitude
    x, y = axes_of(str(last_row.get("amplitude", "")) or "force", last_row)
    loads_differ = np.ptp([y.on_axis(row) for row in last_rows if y.name in row]) > 0
    drawn_quantity = y if loads_differ else x
    return Results(
        [drawn_quantity.on_axis(row) if drawn_quantity.name in row else None for row in last_rows],
        f"{drawn_quantity.label} at the end",
    )


def _map(plot: Any, axes: Sequence[Axis], points: Sequence[SweepPoint], results: Results) -> None:
    """Draw colours and contours over both swept numbers, with crosses where there is no result.

    A map with few values has cells with their numbers instead of contours.
    """
    from matplotlib.ticker import MaxNLocator

    # the first axis goes up: it numbers the rows of the grid
    row_axis, column_axis = axes
    x, y = (sorted(set(axis.numbers or ())) for axis in (column_axis, row_axis))
    grid = np.full((len(y), len(x)), np.nan)
    for point, value in zip(points, results.values, strict=True):
        # tied keys have the same value: the first one stands for the axis
        i = y.index(row_axis.number(point.values[row_axis.keys[0]]))
        j = x.index(column_axis.number(point.values[column_axis.keys[0]]))
        grid[i, j] = np.nan if value is None else value
    is_missing = np.isnan(grid)
    if min(grid.shape) < SMOOTH:
        filled = plot.pcolormesh(x, y, grid, cmap="viridis", shading="nearest")
        _write_values(plot, x, y, grid)
    else:
        levels = MaxNLocator(24, steps=[1, 2, 5, 10]).tick_values(np.nanmin(grid), np.nanmax(grid))
        filled = plot.contourf(x, y, grid, levels, cmap="viridis")
        # contours at every second step of the colours
        lines = plot.contour(x, y, grid, levels[::2], colors="white", linewidths=0.8)
        plot.clabel(lines, fontsize=8)
    places = np.stack(np.meshgrid(x, y), axis=-1)
    # dots where there is a result, crosses where it is missing
    for with_result, style in (
        (True, {"marker": ".", "color": "0.15"}),
        (False, {"marker": "x", "color": "0.5"}),
    ):
        plot.plot(
            *places[is_missing != with_result].T,
            linestyle="",
            markersize=4,
            clip_on=False,
            zorder=5,
            **style,
        )
    colorbar = plot.figure.colorbar(filled, ax=plot, label=results.label)
    if results.size:
        second = colorbar.ax.secondary_yaxis("left", functions=_scales(results.size))
        second.set_ylabel(results.measured)
    plot.set(xlabel=_axis_label(column_axis), ylabel=_axis_label(row_axis))
    plot.locator_params(axis="x", nbins=6)  # long numbers would touch


def _write_values(plot: Any, x: Sequence[float], y: Sequence[float], grid: Any) -> None:
    """Write the value into each cell of a coarse map, light on dark; nothing if there is no room.

    Parameters
    ----------
    x, y
        Centres of the cells along both axes.
    grid
        (y, x) values; nan where there is none.
    """
    low, high = np.nanmin(grid), np.nanmax(grid)
    # three significant digits of the largest value
    digits = max(0, 2 - int(np.floor(np.log10(max(abs(low), abs(high)) or 1.0))))
    if len(x) > WRITTEN or digits > LONGEST:
        return
    for (i, j), value in np.ndenumerate(grid):
        if np.isfinite(value):
            light = value - low > BRIGHT * (high - low)
            text = f"{value:.{digits}f}".replace("-", "−")
            plot.annotate(
                text,
                (x[j], y[i]),
                (0, 7),
                textcoords="offset points",
                ha="center",
                fontsize=7,
                color="0.1" if light else "white",
            )


def _values(
    plot: Any, axes: Sequence[Axis], points: Sequence[SweepPoint], results: Results
) -> None:
    """Draw a number of each point over the last axis with numbers; missing ones are left out."""
    axis = last_numeric_axis(axes) or axes[-1]
    # label of a line, the values on all other axes -> its places (x, value)
    lines: dict[str, list[tuple[float | str, float]]] = {}
    for point, value in zip(points, results.values, strict=True):
        line = lines.setdefault(_label(point, axis), [])
        if value is not None:
            x = point.values[axis.keys[0]]
            line.append((axis.number(x) if axis.numbers else x, value))
    for (name, line), style in zip(lines.items(), cycle(STYLES), strict=False):
        sorted_line = sorted(line) if axis.numbers else line
        if sorted_line:
            plot.plot(*zip(*sorted_line, strict=True), style, marker=".", label=name)
    if axis.numbers:
        plot.locator_params(axis="x", nbins=5)  # long numbers would overlap
    plot.set_xlabel(_axis_label(axis))
    plot.set_ylabel(results.label)
    if results.size:
        plot.secondary_yaxis("right", functions=_scales(results.size)).set_ylabel(results.measured)


def _scales(size: float) -> tuple[Any, Any]:
    """Return the functions from values to the second scale, and back."""
    return lambda v: v * size, lambda v: v / size


def _axis_label(axis: Axis) -> str:
    """Return the label of an axis, with all its tied keys."""
    *tied_keys, last_key = axis.keys
    return " = ".join(
        [*(key_words(key, axis.unit) for key in tied_keys), key_label(last_key, axis.unit)]
    )


def _curves(plot: "Axes", points: Sequence[SweepPoint], outcomes: Sequence[Outcome]) -> None:
    """Draw the last varied load over its displacement, a curve for every point of the sweep."""
    amplitude = next((str(o.curve[-1]["amplitude"]) for o in outcomes if len(o.curve) > 1), "force")
    # quantities on the axes: displacement and load, in units if the rows have them
    x, y = axes_of(amplitude, next((o.curve[-1] for o in outcomes if o.curve), ()))
    for point, outcome, style in zip(points, outcomes, cycle(STYLES), strict=False):
        rows = loaded(outcome.curve, amplitude)
        x_values, y_values = [x.on_axis(row) for row in rows], [y.on_axis(row) for row in rows]
        plot.plot(x_values, y_values, style, marker=".", label=_label(point, without=None))
    plot.axhline(0, color="0.8", linewidth=0.8, zorder=0)
    plot.set(xlabel=x.label, ylabel=y.label)


def loaded(curve: Sequence["Row"], amplitude: str) -> list["Row"]:
    """Return the part of a curve in which an amplitude varied, and the point before the part.

    Branches are left out, and so are instabilities of excluded modes, whose rows are not in the
    order of the path.
    """
    first = next((i for i, row in enumerate(curve) if row["amplitude"] == amplitude), len(curve))
    rows = curve[max(first - 1, 0) :] if first < len(curve) else []
    return [row for row in rows if row["mode"] in OWN_MODES and not row["branch"]]


def _label(point: SweepPoint, without: Axis | None) -> str:
    """Return the values of a point as text, without those of an axis."""
    hidden_keys = without.keys if without else ()
    return ", ".join(
        f"{key_symbol(key)}{value}" for key, value in point.values.items() if key not in hidden_keys
    )

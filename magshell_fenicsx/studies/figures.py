"""Figures of studies: a file with panels, legends, and a number of each point over the swept keys.

An axis of a sweep is one key of the case, or several tied ones, with its values; axes of a panel
are `plot`. A point is a case with a value for each axis.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.section import case_sizes
from magshell_fenicsx.studies.naming import axis_label, key_symbol
from magshell_fenicsx.studies.points import Axis, SweepPoint, last_numeric_axis

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
PANEL_WIDTH, PANEL_HEIGHT = 3.3, 2.9  # inches: three in a row keep text of 8 points on a page
STYLES = ("-", "--", ":", "-.")
LEGEND_ROWS = 16
LEAST_MAPPED = 3  # different values of both axes of a map
LEAST_CONTOURED = 8  # values of both axes of a map; with fewer it has cells with their values
# most columns and digits of written values; colours from here on are bright
MOST_WRITTEN, MOST_DIGITS, BRIGHT = 9, 5, 0.6


@contextmanager
def saved_figure(file: Path, width: float, height: float, dpi: int = 200) -> "Iterator[Figure]":
    """Context with an empty figure, which is saved at its end.

    Parameters
    ----------
    width, height
        Size in inches.
    dpi
        Pixels per inch.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
    yield figure
    figure.savefig(file)


def add_legend(plot: Any) -> None:
    """Draw the legend of a panel, if something in it has a label."""
    if plot.get_legend_handles_labels()[1]:
        plot.legend(frameon=False, fontsize=8)


def lengths_along_line(places: Array) -> Array | None:
    """Return the lengths (n,) along the chords between points of a meridian or along x.

    None for points on a surface.

    Parameters
    ----------
    places
        (n, 2) places (rho, z) of a meridian, or (n, 3) places.
    """
    if places.shape[1] == 3 and places[:, 1:].any():
        return None
    chords = np.linalg.norm(np.diff(places, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(chords)])


@dataclass(frozen=True)
class PointNumbers:
    """A number of each point, for a figure.

    Attributes
    ----------
    values
        The number at each point; None where a point lacks it.
    label
        Label of the axis.
    unit_size, unit_label
        Factor and label of a second scale in the case's units; the factor is 0 if the points do not
        share one.
    """

    values: Sequence[float | None]
    label: str
    unit_size: float = 0.0
    unit_label: str = ""


@contextmanager
def point_figure(points: Sequence[SweepPoint], file: Path) -> Iterator[Any]:
    """Context with the axes of a figure about points, which is saved at its end.

    Its title has R/h and Poisson's ratio, if all points share them; its legend stands beside it.
    """
    with saved_figure(file, 7.2, 4.2) as figure:
        plot = figure.subplots()
        yield plot
        plot.set_title(_common_numbers(points), fontsize=9)
        labels = plot.get_legend_handles_labels()[1]
        if any(labels):
            columns = -(-len(labels) // LEGEND_ROWS)  # rounded up
            figure.legend(loc="outside right upper", fontsize=8, frameon=False, ncols=columns)


def draw_points(
    axes: Sequence[Axis], points: Sequence[SweepPoint], numbers: PointNumbers, file: Path
) -> None:
    """Draw a number of each point: a map over two keys, or lines over the last key with numbers.

    There is one line for each combination of the values that are not on the horizontal axis.

    Parameters
    ----------
    axes
        Axes of the sweep.
    file
        Name of the picture file.
    """
    axes = axes_of_points(axes, points)
    draw = _draw_map if is_map(axes) else _draw_lines
    with point_figure(points, file) as plot:
        draw(plot, axes, points, numbers)


def is_map(axes: Sequence[Axis]) -> bool:
    """Return whether two keys with numbers are swept, both over enough values for a map."""
    return len(axes) == 2 and all(len(set(axis.numbers or ())) >= LEAST_MAPPED for axis in axes)


def axes_of_points(axes: Sequence[Axis], points: Sequence[SweepPoint]) -> list[Axis]:
    """Return the axes with the values of all points, each once, in the order of the points."""
    return [
        Axis(axis.keys, tuple(dict.fromkeys(point.values[axis.keys[0]] for point in points)))
        for axis in axes
    ]


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


def _draw_map(
    plot: Any, axes: Sequence[Axis], points: Sequence[SweepPoint], numbers: PointNumbers
) -> None:
    """Draw colours and contours over both swept numbers, with crosses where there is no result.

    A map with few values has cells with their numbers instead of contours.
    """
    from matplotlib.ticker import MaxNLocator

    # the first axis goes up: it numbers the rows of the grid
    row_axis, column_axis = axes
    x, y = (sorted(set(axis.numbers or ())) for axis in (column_axis, row_axis))
    grid = np.full((len(y), len(x)), np.nan)
    for point, value in zip(points, numbers.values, strict=True):
        # tied keys have the same value: the first one stands for the axis
        i = y.index(row_axis.number(point.values[row_axis.keys[0]]))
        j = x.index(column_axis.number(point.values[column_axis.keys[0]]))
        grid[i, j] = np.nan if value is None else value
    is_missing = np.isnan(grid)
    if min(grid.shape) < LEAST_CONTOURED:
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
    colorbar = plot.figure.colorbar(filled, ax=plot, label=numbers.label)
    if numbers.unit_size:
        second = colorbar.ax.secondary_yaxis("left", functions=_scales(numbers.unit_size))
        second.set_ylabel(numbers.unit_label)
    plot.set(xlabel=axis_label(column_axis), ylabel=axis_label(row_axis))
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
    if len(x) > MOST_WRITTEN or digits > MOST_DIGITS:
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


def _draw_lines(
    plot: Any, axes: Sequence[Axis], points: Sequence[SweepPoint], numbers: PointNumbers
) -> None:
    """Draw a number of each point over the last axis with numbers; missing ones are left out."""
    axis = last_numeric_axis(axes) or axes[-1]
    # label of a line, the values on all other axes -> its places (x, value)
    lines: dict[str, list[tuple[float | str, float]]] = {}
    for point, value in zip(points, numbers.values, strict=True):
        line = lines.setdefault(point_label(point, axis), [])
        if value is not None:
            x = point.values[axis.keys[0]]
            line.append((axis.number(x) if axis.numbers else x, value))
    for (name, line), style in zip(lines.items(), cycle(STYLES), strict=False):
        sorted_line = sorted(line) if axis.numbers else line
        if sorted_line:
            plot.plot(*zip(*sorted_line, strict=True), style, marker=".", label=name)
    if axis.numbers:
        plot.locator_params(axis="x", nbins=5)  # long numbers would overlap
    plot.set_xlabel(axis_label(axis))
    plot.set_ylabel(numbers.label)
    if numbers.unit_size:
        second = plot.secondary_yaxis("right", functions=_scales(numbers.unit_size))
        second.set_ylabel(numbers.unit_label)


def _scales(size: float) -> tuple[Any, Any]:
    """Return the functions from values to the second scale, and back."""
    return lambda v: v * size, lambda v: v / size


def point_label(point: SweepPoint, hidden: Axis | None = None) -> str:
    """Return the values of a point with their symbols, without those of a hidden axis."""
    hidden_keys = hidden.keys if hidden else ()
    return ", ".join(
        f"{key_symbol(key)}{value}" for key, value in point.values.items() if key not in hidden_keys
    )

"""The picture of a sweep: a result over one swept number or as a map over two, or all curves.

An axis of a sweep is one key of the case, or several tied ones, with its values; axes of a picture
are `plot`. A point is a case with a value for each axis; its outcome has the curve of its run, rows
of path.csv. An amplitude is a load parameter, by name, that varies along a part of the curve. A
knockdown factor is the first buckling pressure over the classical one.
"""

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magshell_fenicsx.quantities.registry import OWN_MODES, axes_of
from magshell_fenicsx.studies.figures import (
    STYLES,
    PointNumbers,
    axes_of_points,
    draw_points,
    is_map,
    point_figure,
    point_label,
)
from magshell_fenicsx.studies.naming import result_label
from magshell_fenicsx.studies.outcome import Outcome
from magshell_fenicsx.studies.points import Axis, SweepPoint

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from magshell_fenicsx.output.store.table import Row

BARRIER = r"energy barrier  ($E h R^2$)"


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
    numbers = _numbers(outcomes, requested)
    if is_map(axes_of_points(axes, points)):
        numbers = numbers or _ends(outcomes)
    if numbers:
        draw_points(axes, points, numbers, file)
        return
    with point_figure(points, file) as plot:
        _draw_curves(plot, points, outcomes)


def _numbers(
    outcomes: Sequence[Outcome], requested: tuple[str, Sequence[float | None]] | None
) -> PointNumbers | None:
    """Return the requested result; else energy barriers or knockdown factors; None without any.

    Barriers and knockdowns have a second scale if all points share its units.
    """
    if requested:
        name, values = requested
        if name not in ("knockdown", "barrier"):
            return PointNumbers(values, label=name)
    barriers, knockdowns = [o.barrier for o in outcomes], [o.knockdown for o in outcomes]
    # second scales: the units of energy and pressure in millijoule and pascal
    if any(value is not None for value in barriers):
        energy_unit = _common(outcomes, "unit_energy_mJ")
        return PointNumbers(barriers, BARRIER, energy_unit, "energy barrier  (mJ)")
    if any(value is not None for value in knockdowns):
        pressure_unit = _common(outcomes, "classical_pressure_Pa")
        label = result_label("knockdown")
        return PointNumbers(knockdowns, label, pressure_unit, "buckling pressure  (Pa)")
    return None


def _common(outcomes: Sequence[Outcome], name: str) -> float:
    """Return a number of the case in units, which all points share; 0 if they do not."""
    sizes = [outcome.in_units.get(name, 0.0) for outcome in outcomes]
    return sizes[0] if np.allclose(sizes, sizes[0], rtol=1e-9, atol=0) else 0.0


def _ends(outcomes: Sequence[Outcome]) -> PointNumbers:
    """Return the last load of each curve; the last displacement if all loads are the same."""
    last_rows = [outcome.curve[-1] if outcome.curve else {} for outcome in outcomes]
    last_row = next((row for row in last_rows if row), {})  # of the first point with a curve
    # quantities on the axes of a curve: displacement x and load y of the last amplitude
    x, y = axes_of(str(last_row.get("amplitude", "")) or "force", last_row)
    loads_differ = np.ptp([y.on_axis(row) for row in last_rows if y.name in row]) > 0
    drawn_quantity = y if loads_differ else x
    return PointNumbers(
        [drawn_quantity.on_axis(row) if drawn_quantity.name in row else None for row in last_rows],
        f"{drawn_quantity.label} at the end",
    )


def _draw_curves(plot: "Axes", points: Sequence[SweepPoint], outcomes: Sequence[Outcome]) -> None:
    """Draw the last varied load over its displacement, a curve for every point of the sweep."""
    amplitude = next((str(o.curve[-1]["amplitude"]) for o in outcomes if len(o.curve) > 1), "force")
    # quantities on the axes: displacement and load, in units if the rows have them
    x, y = axes_of(amplitude, next((o.curve[-1] for o in outcomes if o.curve), ()))
    for point, outcome, style in zip(points, outcomes, cycle(STYLES), strict=False):
        rows = loaded(outcome.curve, amplitude)
        x_values, y_values = [x.on_axis(row) for row in rows], [y.on_axis(row) for row in rows]
        plot.plot(x_values, y_values, style, marker=".", label=point_label(point))
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

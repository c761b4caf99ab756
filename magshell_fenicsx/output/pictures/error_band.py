"""A band along a curve: how far the discretisation's error may move it.

Errors are those of summary.json, at instabilities and at the end of the path (docs/accuracy.md).
Between these points they are interpolated, from zero where the shell is undeformed. The band is as
wide as they move the curve across itself, and is drawn where it is wider than the line.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.pictures.lines import (
    SEGMENTS_PER_INTERVAL,
    CurveStep,
    Line,
    curve_coordinates,
    line_coordinates,
    load_axis,
)
from magshell_fenicsx.output.store.table import LOCATED, SOLUTION, Row
from magshell_fenicsx.quantities.registry import amplitude as registered
from magshell_fenicsx.quantities.registry import axes_of, shown_quantity

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
# number of a point -> column of path.csv -> estimated absolute error
PointErrors = Mapping[int, Mapping[str, float]]
LINE_WIDTH = 1.2  # points, of the curve
OPACITY = 0.25


def errors_at_points(rows: Sequence[Row], errors: Mapping[str, float]) -> PointErrors:
    """Return the estimated errors at the points of a path that have some.

    Parameters
    ----------
    rows
        Rows of path.csv.
    errors
        The entry of summary.json: name of a result -> its error.
    """
    path = [row for row in rows if not int(row["branch"]) and row["label"] != SOLUTION]
    at_points = dict[int, dict[str, float]]()
    located = [row for row in path if row["label"] in LOCATED]
    for number, row in enumerate(located, 1):
        error = errors.get("limit_load" if number == 1 else f"limit_load_{number}")
        if error is None:
            continue
        column = registered(str(row["amplitude"])).column
        if not (value := float(row[column])):
            continue
        # the axis may have the load in a unit
        shown = shown_quantity(column, row).name
        at_points[int(row["point"])] = {shown: error * abs(float(row[shown]) / value)}
    at_end = {
        name.removesuffix("@end"): error for name, error in errors.items() if name.endswith("@end")
    }
    if path and at_end:
        at_points[int(path[-1]["point"])] = at_end
    return at_points


def draw_error_band(axes: "Axes", step: CurveStep, errors: PointErrors) -> None:
    """Draw the band along the path of a step, where it is wider than the curve.

    The limits of the axes must be final.
    """
    for line in line_coordinates(step):
        if int(line.rows[0]["branch"]):
            continue
        places = [curve_coordinates(row, step.amplitude) for row in line.rows]
        curve = line.smooth_curve(*zip(*places, strict=True), load_axis=load_axis(step.amplitude))
        errors_of_line = _errors_along(line, step.amplitude, errors, curve.shape[1])
        if errors_of_line is not None:
            _draw(axes, curve, errors_of_line)


def _errors_along(line: Line, amplitude: str, errors: PointErrors, count: int) -> Array | None:
    """Return the errors (2, count) of both coordinates along a line; None without two known ones.

    They are nan beyond the last point whose errors are known.
    """
    x, y = axes_of(amplitude, line.rows[0])
    known = dict[int, tuple[float, float]]()  # number of a point of the curve -> errors
    for i, row in enumerate(line.rows):
        place = min(i * SEGMENTS_PER_INTERVAL, count - 1)
        if (at_point := errors.get(int(row["point"]))) is not None:
            known[place] = at_point.get(x.name, 0.0), at_point.get(y.name, 0.0)
        elif row["label"] == "start":
            known[place] = 0.0, 0.0
    if len(known) < 2:
        return None
    numbers, values = np.arange(count), np.array(list(known.values()))
    along = [np.interp(numbers, list(known), column, right=np.nan) for column in values.T]
    return np.array(along)


def _draw(axes: "Axes", curve: Array, errors: Array) -> None:
    """Draw the band of a curve (2, n) with errors (2, n) of its coordinates, if it is visible."""
    from matplotlib.patches import Polygon

    # in pixels: the curve, its normals, and the errors
    to_pixels = axes.transData
    origin = to_pixels.transform((0.0, 0.0))
    pixels = to_pixels.transform(curve.T)
    errors_in_pixels = np.abs(to_pixels.transform(errors.T) - origin)
    tangents = np.gradient(pixels, axis=0)
    lengths = np.linalg.norm(tangents, axis=1)
    normals = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    normals /= np.where(lengths > 0.0, lengths, 1.0)[:, None]
    half_widths = np.sum(np.abs(normals) * errors_in_pixels, axis=1)
    line_width = LINE_WIDTH * axes.figure.dpi / 72  # points are 1/72 inch
    is_visible = 2 * half_widths > line_width  # nan is not
    if not is_visible.any():
        return
    # one polygon over the whole known part: it is as narrow as the line elsewhere
    known = ~np.isnan(half_widths)
    offsets = normals[known] * half_widths[known, None]
    outline = np.concatenate([pixels[known] + offsets, (pixels[known] - offsets)[::-1]])
    places = to_pixels.inverted().transform(outline)
    band = Polygon(places, color="C0", alpha=OPACITY, linewidth=0, zorder=1)
    axes.add_patch(band)

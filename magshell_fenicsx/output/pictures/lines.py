"""Curves of a run as data, for pictures and the report alike: steps, lines of points, smooth
curves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.output.store.table import LOCATED, POLE, SOLUTION, Row, pole_name
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import OWN_MODES, axes_of, quantity, shown_quantity
from magshell_fenicsx.quantities.registry import amplitude as registered

Array = NDArray[np.float64]
SEGMENTS_PER_INTERVAL = 16  # drawn between two points
MAX_SLOPE_RATIO = 3.0  # slope of a curve at a point over the lesser one of the chords there
MIN_CHORD = 1e-12  # scaled; a shorter one counts as this


@dataclass(frozen=True)
class CurveStep:
    """Step of a path that is drawn as one curve.

    Attributes
    ----------
    amplitude
        The amplitude that varied.
    rows
        Its rows of path.csv, after the row before the step.
    title
        Title of the curve.
    numbers
        Number of a point -> number of its instability.
    """

    amplitude: str
    rows: Sequence[Row]
    title: str = ""
    numbers: Mapping[int, int] = field(default_factory=dict)


def instability_numbers(rows: Sequence[Row]) -> dict[int, int]:
    """Return point -> number of its instability, from 1 along path.csv.

    So instabilities are numbered in all pictures and tables.
    """
    located = [row for row in rows if row["label"] in LOCATED]
    return {int(row["point"]): number for number, row in enumerate(located, 1)}


def curve_steps(rows: Sequence[Row], amplitude: str) -> list[CurveStep]:
    """Return the steps of a programme, or the last part in which the amplitude varied."""
    steps = sorted({int(row.get("step", 0)) for row in rows if row["label"] != "field"} - {0})
    numbers = instability_numbers(rows)
    if len(steps) < 2:
        return [CurveStep(amplitude, last_varied_rows(rows, amplitude), "", numbers)]
    curves = []
    for step in steps:
        first = next(i for i, row in enumerate(rows) if row["step"] == step)
        previous = max((i for i in range(first) if rows[i]["branch"] == 0), default=0)
        rows_of_step = [row for row in rows[first:] if row["step"] == step]
        name = str(rows_of_step[0]["amplitude"])
        words = quantity(registered(name).column).words
        title = f"step {step}: {words}"
        curves.append(CurveStep(name, [rows[previous], *rows_of_step], title, numbers))
    return curves


def last_varied_rows(rows: Sequence[Row], amplitude: str) -> Sequence[Row]:
    """Return the last part of a path in which an amplitude varied."""
    if amplitude == "lambda_m":
        return rows
    first = max(i for i, row in enumerate(rows) if row["amplitude"] != amplitude or row is rows[0])
    return rows[first:]


def axes_for(step: CurveStep) -> tuple[Quantity, Quantity]:
    """Return the quantities on the x and the y axis of a step's curve."""
    x, y = axes_of(step.amplitude, step.rows[0])
    if step.amplitude != "load":
        return x, y
    # moments have no conjugate displacement
    if all(row["w_over_h"] == row["w_pole_over_h"] for row in step.rows):
        x = shown_quantity("w_pole_over_h", step.rows[0])
    return x, y


def curve_coordinates(row: Row, amplitude: str) -> tuple[float, float]:
    """Return the coordinates of a point in the axes of its curve."""
    x, y = axes_of(amplitude, row)
    return x.on_axis(row), y.on_axis(row)


def with_point_name(of_point: Quantity, row: Row, pole: str = POLE, dollar: str = "$") -> Quantity:
    """Return a quantity whose words name the point of `w_pole_over_h`.

    `dollar` replaces that sign in the name.
    """
    name = pole_name(row, pole).replace("$", dollar)
    return replace(
        of_point, words=of_point.words.replace(POLE, name), note=of_point.note.replace(POLE, name)
    )


def is_unstable(row: Row) -> bool:
    """Whether the model, or a mode that it excludes, is unstable.

    A path.csv of an earlier version has no excluded_pivots.
    """
    return _unstable_count(row) > 0


def _unstable_count(row: Row) -> int:
    """Return the number of unstable directions, also of modes that the model excludes."""
    return int(row["negative_pivots"]) + int(row.get("excluded_pivots", 0))


@dataclass(frozen=True)
class Line:
    """Rows along one line of a curve, at least one.

    Attributes
    ----------
    in_time
        Whether the points are those of a motion, joined by a spline over the time.
    amplitude
        The amplitude of the curve.
    """

    rows: Sequence[Row]
    in_time: bool = False
    amplitude: str = ""

    @property
    def unstable(self) -> list[bool]:
        """Whether each segment between two rows is unstable.

        A segment is as its end, or if that is located as its beginning. Between two located rows
        the number of unstable directions is that of a row, or one more, at both.
        """
        are_unstable: list[bool] = []
        for first, last in pairwise(self.rows):
            not_located = [row for row in (last, first) if row["label"] not in LOCATED]
            if not_located:
                are_unstable.append(is_unstable(not_located[0]))
                continue
            first_count, last_count = _unstable_count(first), _unstable_count(last)
            possible_counts = {first_count, first_count + 1} & {last_count, last_count + 1}
            alternates = not (are_unstable and are_unstable[-1])
            are_unstable.append(min(possible_counts, default=0) > 0 or alternates)
        return are_unstable

    @property
    def segments(self) -> list[tuple[int, int, bool]]:
        """First and last row of each stable or unstable part, and whether it is unstable."""
        parts = []
        for unstable, group in groupby(enumerate(self.unstable), key=lambda item: item[1]):
            numbers = [i for i, _ in group]
            parts.append((numbers[0], numbers[-1] + 1, unstable))
        return parts

    @property
    def level(self) -> list[int]:
        """Ends of the line, 0 and -1, at which its amplitude has an extreme: a fold in it."""
        fold = "fold", self.amplitude
        return [
            end for end in (0, -1) if (self.rows[end]["label"], self.rows[end]["amplitude"]) == fold
        ]

    def smooth_curve(
        self, x: Sequence[float], y: Sequence[float], *, load_axis: int | None = None
    ) -> Array:
        """Return a smooth curve (2, SEGMENTS_PER_INTERVAL (n - 1) + 1) through coordinates of its n
        rows.

        Parameters
        ----------
        x, y
            (n,) coordinates of the rows.
        load_axis
            Which of the coordinates is the amplitude, 0 or 1; None if none is.
        """
        if self.in_time:
            return spline_curve(x, y, [float(row["time"]) for row in self.rows])
        level = [] if load_axis is None else [(load_axis, end) for end in self.level]
        return smooth(x, y, [row["label"] in LOCATED for row in self.rows], level)


def line_coordinates(step: CurveStep) -> list[Line]:
    """Return the lines of a step: its branches, in their order."""
    path = [row for row in step.rows if row["label"] != SOLUTION]
    in_time = step.amplitude == "time"
    branches = sorted({int(row["branch"]) for row in path})
    lines = []
    for branch in branches:
        rows = _line([row for row in path if row["branch"] == branch], step.amplitude)
        lines.append(Line(rows, in_time, step.amplitude))
    return lines


def _line(rows: Sequence[Row], amplitude: str) -> list[Row]:
    """Return the rows of a branch along its curve.

    They are those of the model, and a symmetry-breaking instability at its end.
    """
    rows_of_model = [row for row in rows if row["mode"] in OWN_MODES]
    last = curve_coordinates(rows_of_model[-1], amplitude)
    previous = curve_coordinates(rows_of_model[max(len(rows_of_model) - 2, 0)], amplitude)
    at_end = [row for row in rows[-1:] if row not in rows_of_model and row["label"] in LOCATED]
    direction = np.subtract(last, previous)
    line = list(rows_of_model)
    for row in at_end:
        step = np.subtract(curve_coordinates(row, amplitude), last)
        if np.dot(step, direction) > 0:
            line.append(row)
    return line


def load_axis(amplitude: str) -> int:
    """Return which coordinate of its curve an amplitude is: 0 or 1."""
    return 0 if registered(amplitude).sideways else 1


def smooth(
    x: Sequence[float],
    y: Sequence[float],
    located: Sequence[bool] = (),
    level: Sequence[tuple[int, int]] = (),
) -> Array:
    """Return a smooth curve (2, SEGMENTS_PER_INTERVAL (n - 1) + 1) through n points.

    The parameter is the root of the scaled chord. The curve consists of cubics with the slopes of
    parabolas through three points, limited so that what rises from point to point rises (Fritsch
    and Carlson, SIAM J. Numer. Anal. 17, 1980). What turns between two points turns smoothly there,
    what turns at a located point turns at it.

    Parameters
    ----------
    x, y
        (n,) coordinates of the points.
    located
        Whether each point is a fold or a bifurcation, where a coordinate that turns has its
        extreme.
    level
        Which coordinate has its extreme at which end, 0 or -1.
    """
    xy = np.array([x, y], float)
    scale = np.ptp(xy, axis=1)
    if xy.shape[1] == 1:
        return xy
    steps = np.hypot(*(np.diff(xy, axis=1) / np.where(scale > 0, scale, 1)[:, None]))
    chord = np.concatenate([[0], np.cumsum(np.sqrt(np.maximum(steps, MIN_CHORD)))])
    is_located = np.array(located, bool) if len(located) else np.zeros(len(chord), bool)
    slopes = np.array([_slopes(chord, values, is_located) for values in xy])
    for coordinate, end in level:
        slopes[coordinate, end] = 0.0
    t = np.arange(SEGMENTS_PER_INTERVAL) / SEGMENTS_PER_INTERVAL
    h, rise = np.diff(chord)[:, None], np.diff(xy, axis=1)[..., None]
    first, last = h * slopes[:, :-1, None], h * slopes[:, 1:, None]
    quadratic, cubic = 3 * rise - 2 * first - last, first + last - 2 * rise
    curve = xy[:, :-1, None] + t * (first + t * (quadratic + t * cubic))
    return np.concatenate([curve.reshape(2, -1), xy[:, -1:]], axis=1)


def _slopes(t: Array, values: Array, located: NDArray[np.bool_]) -> Array:
    """Return the derivatives (n,) of values over a parameter at n points."""
    h, chords = np.diff(t), np.diff(values) / np.diff(t)
    if len(chords) == 1:
        return np.full(2, chords[0])
    chords_before, chords_after, h1, h2 = chords[:-1], chords[1:], h[:-1], h[1:]
    limits = MAX_SLOPE_RATIO * np.abs(chords)
    limits[1:-1][chords[:-2] * chords[2:] < 0] = np.inf  # it turns between these two points
    max_slopes = np.minimum(limits[:-1], limits[1:])
    inner = np.clip((h2 * chords_before + h1 * chords_after) / (h1 + h2), -max_slopes, max_slopes)
    inner[located[1:-1] & (chords_before * chords_after < 0)] = 0.0
    ends = [
        _end_slope(h[0], h[1], chords[0], chords[1]),
        _end_slope(h[-1], h[-2], chords[-1], chords[-2]),
    ]
    return np.concatenate([ends[:1], inner, ends[1:]])


def _end_slope(h1: float, h2: float, first: float, second: float) -> float:
    """Return the slope at an end: that of a parabola through three points, limited.

    It is zero if its sign is not that of the first chord, and at most MAX_SLOPE_RATIO times its
    slope.

    Parameters
    ----------
    h1, h2
        Lengths of the first two intervals.
    first, second
        Slopes of their chords.
    """
    slope = ((2 * h1 + h2) * first - h1 * second) / (h1 + h2)
    if slope * first <= 0:
        return 0.0
    return float(np.clip(slope, -MAX_SLOPE_RATIO * abs(first), MAX_SLOPE_RATIO * abs(first)))


def spline_curve(x: Sequence[float], y: Sequence[float], point_times: Sequence[float]) -> Array:
    """Return a smooth curve by cubic splines over the time, see `smooth`.

    With four points a period a vibration keeps its form. Equal times, such as those of the point
    before a motion and of its first, are joined straight.
    """
    xy, times = np.array([x, y], float), np.array(point_times, float)
    is_later = np.concatenate([[True], np.diff(times) > 0])
    if is_later.sum() < 4 or not is_later[2:].all():
        return smooth(x, y)
    refined_times = _refined(times)
    spline = scipy.interpolate.CubicSpline(times[is_later], xy[:, is_later], axis=1)
    curve = np.asarray(spline(refined_times))
    if not is_later[1]:
        count = SEGMENTS_PER_INTERVAL + 1
        curve[:, :count] = np.linspace(xy[:, 0], xy[:, 1], count).T
    return curve


def _refined(values: Array) -> Array:
    """Return values with SEGMENTS_PER_INTERVAL equal steps between every two of them."""
    count = SEGMENTS_PER_INTERVAL * (len(values) - 1) + 1
    positions = np.arange(count) / SEGMENTS_PER_INTERVAL
    return np.interp(positions, np.arange(len(values)), values)

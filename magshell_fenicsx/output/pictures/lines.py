"""Curves of a run as data, for pictures and the report: steps, lines, smooth curves.

A row is a line of path.csv: one point of the path, by column. Its label is "fold" or "bifurcation"
at an instability (a located row, `LOCATED`), "solution" for what a search found, "field" in the
step that applies the magnetic field; its branch is 0 on the main path. The column `mode` names the
mode of an instability; `OWN_MODES` are those with the symmetry of the model, others are modes that
the model excludes. An amplitude is a load parameter, by name; it is one coordinate of a curve, a
displacement the other. A pivot count is the number of unstable directions. A motion is a step in
time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
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
# power of a chord by which the parameter of a smooth curve grows. With 0.7 to 0.9 the curves of 41
# cases through every second or third of their points are nearest to the points left out; with 0.5
# the two ways along a loop part between its points
CHORD_EXPONENT = 0.8


@dataclass(frozen=True)
class CurveStep:
    """Step of a path that is drawn as one curve.

    Attributes
    ----------
    amplitude
        Name of the amplitude that varied.
    rows
        Rows of path.csv of the step, after the last row before it.
    number
        Number of the step in its programme; 0 without a programme.
    numbers
        Number of a point -> number of the instability there.
    """

    amplitude: str
    rows: Sequence[Row]
    number: int = 0
    numbers: Mapping[int, int] = field(default_factory=dict)


def curve_title(steps: Sequence[CurveStep]) -> str:
    """Return the title of the curves of steps over one amplitude; empty without a programme.

    Examples
    --------
    >>> curve_title([CurveStep("pressure", [], 1), CurveStep("pressure", [], 3)])
    'steps 1, 3: pressure'
    """
    numbers = [str(step.number) for step in steps if step.number]
    if not numbers:
        return ""
    words = quantity(registered(steps[0].amplitude).column).words
    return f"step{'s' * (len(numbers) > 1)} {', '.join(numbers)}: {words}"


def instability_numbers(rows: Sequence[Row]) -> dict[int, int]:
    """Return number of a point -> number of its instability, from 1 along path.csv.

    All pictures and tables number instabilities in this way.
    """
    located = [row for row in rows if row["label"] in LOCATED]
    return {int(row["point"]): number for number, row in enumerate(located, 1)}


def curve_steps(rows: Sequence[Row], amplitude: str) -> list[CurveStep]:
    """Return the steps of a programme as curves, or the part in which `amplitude` varied.

    Parameters
    ----------
    rows
        Rows of path.csv.
    amplitude
        The amplitude that varied last.
    """
    # numbers of the steps; a case without a programme has no such column
    steps = sorted({int(row.get("step", 0)) for row in rows if row["label"] != "field"} - {0})
    numbers = instability_numbers(rows)
    if len(steps) < 2:
        return [CurveStep(amplitude, last_varied_rows(rows, amplitude), numbers=numbers)]
    curves = []
    for step in steps:
        first_row = next(i for i, row in enumerate(rows) if row["step"] == step)
        # a step begins at the last point of the main path, from which its curve starts
        row_before = max((i for i in range(first_row) if rows[i]["branch"] == 0), default=0)
        rows_of_step = [row for row in rows[first_row:] if row["step"] == step]
        name = str(rows_of_step[0]["amplitude"])
        curves.append(CurveStep(name, [rows[row_before], *rows_of_step], step, numbers))
    return curves


def curve_panels(steps: Sequence[CurveStep]) -> list[list[CurveStep]]:
    """Return the steps of a programme in groups with the same quantities on both axes.

    A group is drawn in one panel, so that a load there and back is one loop. Motions, and steps
    after a motion, have panels of their own. The last group has the last step.
    """
    groups = dict[tuple[str, ...], list[CurveStep]]()
    motion_count = 0
    for step in steps:
        motion_count += step.amplitude == "time"
        key = (str(motion_count), *(q.name for q in axes_for(step)), step.amplitude)
        earlier_steps = groups.pop(key, [])
        groups[key] = [*earlier_steps, step]
    return list(groups.values())


def last_varied_rows(rows: Sequence[Row], amplitude: str) -> Sequence[Row]:
    """Return the last rows of a path, in which an amplitude varied, after the row before them.

    For the strength of a field they are all rows.
    """
    if registered(amplitude).components:
        return rows
    # the last row at which another amplitude varied, or else the first row
    first_row = max(
        i for i, row in enumerate(rows) if row["amplitude"] != amplitude or row is rows[0]
    )
    return rows[first_row:]


def axes_for(step: CurveStep) -> tuple[Quantity, Quantity]:
    """Return the quantities on the x and the y axis of a step's curve."""
    x, y = axes_of(step.amplitude, step.rows[0])
    if step.amplitude != "load":
        return x, y
    # loads that are moments have no conjugate displacement. The column w_over_h then has that of
    # the pole, and the axis is named accordingly
    if all(row["w_over_h"] == row["w_pole_over_h"] for row in step.rows):
        x = shown_quantity("w_pole_over_h", step.rows[0])
    return x, y


def curve_coordinates(row: Row, amplitude: str) -> tuple[float, float]:
    """Return x and y of a row of path.csv in the axes of the curve of `amplitude`."""
    x, y = axes_of(amplitude, row)
    return x.on_axis(row), y.on_axis(row)


def with_point_name(of_point: Quantity, row: Row, pole: str = POLE, dollar: str = "$") -> Quantity:
    """Return a quantity whose words name the point of `w_pole_over_h`.

    Parameters
    ----------
    of_point
        The quantity, whose words may contain `POLE`.
    row
        A row of path.csv, which names the case's points.
    pole
        Name of the point in a case without named points.
    dollar
        Text for a dollar sign in a name, which would begin mathematics in matplotlib.
    """
    name = pole_name(row, pole).replace("$", dollar)
    return replace(
        of_point, words=of_point.words.replace(POLE, name), note=of_point.note.replace(POLE, name)
    )


def is_unstable(row: Row) -> bool:
    """Whether the model at a row of path.csv, or a mode that it excludes, is unstable.

    A path.csv of an earlier version has no column `excluded_pivots`.
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
    rows
        Rows of path.csv in their order along the line.
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
        """Whether each segment between two rows is unstable, (rows - 1).

        A segment is as stable as its last row. If that is a fold or bifurcation, it is as stable as
        its first row. If both are, the numbers of their unstable directions are compared; where
        they leave it open, stable and unstable segments alternate.
        """
        are_unstable: list[bool] = []
        for first_row, last_row in pairwise(self.rows):
            # at an instability one direction is neutral, so that the row says nothing by itself
            not_located = [row for row in (last_row, first_row) if row["label"] not in LOCATED]
            if not_located:
                are_unstable.append(is_unstable(not_located[0]))
                continue
            first_count, last_count = _unstable_count(first_row), _unstable_count(last_row)
            # at each of both rows the neutral direction is not counted: the segment has as many
            # unstable directions as a row, or one more
            possible_counts = {first_count, first_count + 1} & {last_count, last_count + 1}
            # if zero is possible, the segment is stable after an unstable one, and else unstable
            follows_unstable = bool(are_unstable) and are_unstable[-1]
            are_unstable.append(min(possible_counts, default=0) > 0 or not follows_unstable)
        return are_unstable

    @property
    def segments(self) -> list[tuple[int, int, bool]]:
        """(first row, last row, is unstable) of each stable or unstable part of the line."""
        segments_of_line = []
        # intervals between rows, with their numbers, in groups that are all stable or all unstable
        for unstable, group in groupby(enumerate(self.unstable), key=lambda item: item[1]):
            numbers = [i for i, _ in group]
            segments_of_line.append((numbers[0], numbers[-1] + 1, unstable))
        return segments_of_line

    @property
    def level(self) -> list[int]:
        """Ends of the line, 0 or -1, at which its amplitude has an extreme, a fold."""
        ends = {end: self.rows[end] for end in (0, -1)}
        return [
            end
            for end, row in ends.items()
            if row["label"] == "fold" and row["amplitude"] == self.amplitude
        ]

    def parameter(self, x: Sequence[float], y: Sequence[float]) -> Array:
        """Return the parameter (n,) of the smooth curve at the line's n rows, which ascends.

        It is the time of a motion, and else that of `chord_parameter` in the axes x and y.

        Parameters
        ----------
        x, y
            (n,) coordinates of the rows.
        """
        return self._spline_times if self._has_spline else chord_parameter(x, y)

    def slopes(
        self, parameter: Array, values: Sequence[float], *, of_amplitude: bool = False
    ) -> Array:
        """Return the derivatives (n,) of a coordinate by the parameter, at the line's n rows.

        Parameters
        ----------
        parameter
            (n,) that of `parameter`.
        values
            (n,) the coordinate at the rows.
        of_amplitude
            Whether the coordinate is the amplitude, which has its extreme at a fold.
        """
        if self._has_spline:
            return spline_slopes(parameter, values)
        slopes = limited_slopes(parameter, values, [row["label"] in LOCATED for row in self.rows])
        slopes[self.level if of_amplitude else []] = 0.0
        return slopes

    def smooth_curve(
        self, x: Sequence[float], y: Sequence[float], *, load_axis: int | None = None
    ) -> Array:
        """Return a smooth curve (2, SEGMENTS_PER_INTERVAL (n - 1) + 1) through the line's n rows.

        Parameters
        ----------
        x, y
            (n,) coordinates of the rows.
        load_axis
            Which of the coordinates is the amplitude, 0 or 1; None if none is.
        """
        parameter = self.parameter(x, y)
        slopes = [
            self.slopes(parameter, values, of_amplitude=axis == load_axis)
            for axis, values in enumerate((x, y))
        ]
        return cubics(parameter, np.array([x, y], float), np.array(slopes))

    @cached_property
    def _spline_times(self) -> Array:
        """Times (n,) of the rows of a motion; empty otherwise."""
        return np.array([float(row["time"]) for row in self.rows] if self.in_time else [])

    @property
    def _has_spline(self) -> bool:
        """Whether a spline over the time can join the rows.

        It needs four points. Only the first two may have one time: those of the point before a
        motion and of its first point.
        """
        is_later = np.diff(self._spline_times) > 0
        return bool(is_later.sum() >= 3 and is_later[1:].all())


def line_coordinates(step: CurveStep) -> list[Line]:
    """Return the lines of a step's curve, one for each branch, in the order of the branches."""
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

    They are the points of the model itself, and after the last one perhaps an instability by a mode
    that the model excludes, if the path ends there.
    """
    # the other rows are instabilities by modes that the model excludes, found between its points
    rows_of_model = [row for row in rows if row["mode"] in OWN_MODES]
    last_place = curve_coordinates(rows_of_model[-1], amplitude)
    previous_place = curve_coordinates(rows_of_model[max(len(rows_of_model) - 2, 0)], amplitude)
    # the last row of the branch, if it is such an instability; else no row
    at_end = [row for row in rows[-1:] if row not in rows_of_model and row["label"] in LOCATED]
    direction = np.subtract(last_place, previous_place)
    rows_on_line = list(rows_of_model)
    for row in at_end:
        direction_to_row = np.subtract(curve_coordinates(row, amplitude), last_place)
        # it counts if it lies ahead of the last point, not behind it
        if np.dot(direction_to_row, direction) > 0:
            rows_on_line.append(row)
    return rows_on_line


def load_axis(amplitude: str) -> int:
    """Return which coordinate of its curve an amplitude is: 0 or 1."""
    return 0 if registered(amplitude).sideways else 1


def smooth(x: Sequence[float], y: Sequence[float], located: Sequence[bool] = ()) -> Array:
    """Return a smooth curve (2, SEGMENTS_PER_INTERVAL (n - 1) + 1) through n points.

    Its parameter is that of `chord_parameter`, its slopes those of `limited_slopes`.

    Parameters
    ----------
    x, y
        (n,) coordinates of the points.
    located
        Whether each point is a fold or a bifurcation; empty if none is.
    """
    parameter = chord_parameter(x, y)
    slopes = [limited_slopes(parameter, values, located) for values in (x, y)]
    return cubics(parameter, np.array([x, y], float), np.array(slopes))


def chord_parameter(x: Sequence[float], y: Sequence[float]) -> Array:
    """Return the parameter (n,) of a smooth curve through n points, a power of the chords added up.

    It grows between two points by the power `CHORD_EXPONENT` of their distance in a picture, in
    which both axes count equally.

    Parameters
    ----------
    x, y
        (n,) coordinates of the points.
    """
    xy = np.array([x, y], float)
    scale = np.ptp(xy, axis=1)
    steps = np.hypot(*(np.diff(xy, axis=1) / np.where(scale > 0, scale, 1)[:, None]))
    return np.concatenate([[0], np.cumsum(np.maximum(steps, MIN_CHORD) ** CHORD_EXPONENT)])


def limited_slopes(
    parameter: Array, values: Sequence[float], located: Sequence[bool] = ()
) -> Array:
    """Return the derivatives (n,) of values at n points by a parameter, for a smooth curve.

    They are those of the cubic spline, and at both ends of parabolas through three points. They are
    limited so that the curve rises wherever the points rise (Fritsch and Carlson, SIAM J. Numer.
    Anal. 17, 1980). A coordinate that turns between two points turns smoothly there. One that turns
    at a located point turns exactly at it.

    Parameters
    ----------
    parameter
        (n,) the parameter at the points, which ascends.
    values
        (n,) a coordinate of the points.
    located
        Whether each point is a fold or a bifurcation; empty if none is.
    """
    h = np.diff(parameter)  # intervals
    chords = np.diff(np.array(values, float)) / h  # slopes of the chords
    if len(chords) < 2:
        return np.full(len(parameter), chords.sum())
    # at each inner point: the chords and the intervals before and after it
    chords_before, chords_after, h1, h2 = chords[:-1], chords[1:], h[:-1], h[1:]
    # the largest slope in each interval, and so at each inner point. There is no limit in an
    # interval within which the coordinate turns
    limits = MAX_SLOPE_RATIO * np.abs(chords)
    limits[1:-1][chords[:-2] * chords[2:] < 0] = np.inf
    max_slopes = np.minimum(limits[:-1], limits[1:])
    ends = [
        _end_slope(h[0], h[1], chords[0], chords[1]),
        _end_slope(h[-1], h[-2], chords[-1], chords[-2]),
    ]
    # the spline's curvature is the same on both sides of each inner point:
    # h2 slope before + 2 (h1 + h2) slope + h1 slope after = 3 (h2 chord before + h1 chord after)
    right_side = 3 * (h2 * chords_before + h1 * chords_after)
    right_side[0] -= h2[0] * ends[0]
    right_side[-1] -= h1[-1] * ends[1]
    bands = np.zeros((3, len(h1)))
    bands[0, 1:], bands[1], bands[2, :-1] = h1[:-1], 2 * (h1 + h2), h2[1:]
    inner_slopes = np.clip(
        scipy.linalg.solve_banded((1, 1), bands, right_side), -max_slopes, max_slopes
    )
    # the coordinate turns exactly at a fold or bifurcation
    is_located = np.array(located, bool) if len(located) else np.zeros(len(parameter), bool)
    inner_slopes[is_located[1:-1] & (chords_before * chords_after < 0)] = 0.0
    return np.concatenate([ends[:1], inner_slopes, ends[1:]])


def _end_slope(h1: float, h2: float, first: float, second: float) -> float:
    """Return the slope at an end of a curve: that of a parabola through three points, limited.

    It is zero if its sign is not that of the first chord. It is at most MAX_SLOPE_RATIO times the
    slope of that chord.

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


def spline_slopes(times: Array, values: Sequence[float]) -> Array:
    """Return the derivatives (n,) by the time of a cubic spline through n points of a motion.

    With four points a period, a vibration keeps its form. The point before a motion and its first
    point may have the same time. The spline begins at the second of them then, and the slope at the
    first is zero.

    Parameters
    ----------
    times
        (n,) times of the points.
    values
        (n,) a coordinate of the points.
    """
    begin = 0 if times[1] > times[0] else 1
    spline = scipy.interpolate.CubicSpline(times[begin:], values[begin:])
    return np.concatenate([np.zeros(begin), spline(times[begin:], 1)])


def cubics(parameter: Array, values: Array, slopes: Array) -> Array:
    """Return points (k, SEGMENTS_PER_INTERVAL (n - 1) + 1) of cubics between n points.

    An interval of length zero becomes a straight line. The page of a report does the same with
    parameter, values and slopes (`cubics` in output/report/interactive.js).

    Parameters
    ----------
    parameter
        (n,) the parameter at the points.
    values, slopes
        (k, n) coordinates of the points, and their derivatives by the parameter there.
    """
    # in each interval, with t from 0 to 1: value + first t + quadratic t² + cubic t³ (Horner)
    t = np.arange(SEGMENTS_PER_INTERVAL) / SEGMENTS_PER_INTERVAL
    h, rise = np.diff(parameter)[:, None], np.diff(values, axis=1)[..., None]
    first_term, last_term = h * slopes[:, :-1, None], h * slopes[:, 1:, None]
    quadratic, cubic = 3 * rise - 2 * first_term - last_term, first_term + last_term - 2 * rise
    curve = values[:, :-1, None] + t * (first_term + t * (quadratic + t * cubic))
    return np.concatenate([curve.reshape(len(values), -1), values[:, -1:]], axis=1)

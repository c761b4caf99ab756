"""What a curve consists of, for pictures and the report alike: steps, lines of points, and how
points are joined.
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
FINE = 16  # drawn segments between two points
STEEPEST = 3.0  # slope of a curve at a point over the lesser one of the chords there


@dataclass(frozen=True)
class Part:
    """The rows in which an amplitude varied, with the one before them, and the numbers of its
    instabilities.
    """

    amplitude: str
    rows: Sequence[Row]
    title: str = ""
    numbers: Mapping[int, int] = field(default_factory=dict)


def numbered(rows: Sequence[Row]) -> dict[int, int]:
    """Point -> number of its instability, from 1 along path.csv; so they are numbered in all
    pictures and tables.
    """
    return {
        int(row["point"]): n
        for n, row in enumerate((row for row in rows if row["label"] in LOCATED), 1)
    }


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


def axes_for(part: Part) -> tuple[Quantity, Quantity]:
    """The quantities on the x and the y axis of a part's curve."""
    x, y = axes_of(part.amplitude, part.rows[0])
    if part.amplitude == "load" and all(
        row["w_over_h"] == row["w_pole_over_h"] for row in part.rows
    ):
        x = shown_quantity("w_pole_over_h", part.rows[0])  # moments have no conjugate displacement
    return x, y


def place(row: Row, amplitude: str) -> tuple[float, float]:
    """The coordinates of a point in the curve's axes."""
    x, y = axes_of(amplitude, row)
    return x.on_axis(row), y.on_axis(row)


def named(of_point: Quantity, row: Row, pole: str = POLE, dollar: str = "$") -> Quantity:
    """A quantity whose words name the point of `w_pole_over_h`; `dollar` stands for that sign in
    the name.
    """
    name = pole_name(row, pole).replace("$", dollar)
    return replace(
        of_point, words=of_point.words.replace(POLE, name), note=of_point.note.replace(POLE, name)
    )


def is_unstable(row: Row) -> bool:
    """Whether the model, or a mode that it excludes, is unstable; an earlier path.csv has no
    excluded_pivots.
    """
    return int(row["negative_pivots"]) + int(row.get("excluded_pivots", 0)) > 0


@dataclass(frozen=True)
class Line:
    """Rows along one line of a curve, at least one.

    Attributes
    ----------
    in_time
        Whether the points are those of a motion, joined by a spline over the time.
    amplitude
        That of its curve.
    """

    rows: Sequence[Row]
    in_time: bool = False
    amplitude: str = ""

    @property
    def unstable(self) -> list[bool]:
        """Whether each of the segments between the rows is: as its end, or if that is located as
        its beginning.

        Between two located rows the number of unstable directions is that of a row, or one more, at
        both.
        """
        of_segments: list[bool] = []
        for first, last in pairwise(self.rows):
            rows = [row for row in (last, first) if row["label"] not in LOCATED]
            a, b = (
                int(row["negative_pivots"]) + int(row.get("excluded_pivots", 0))
                for row in (first, last)
            )
            between = {a, a + 1} & {b, b + 1}
            alternates = not (of_segments and of_segments[-1])
            of_segments.append(
                is_unstable(rows[0]) if rows else min(between, default=0) > 0 or alternates
            )
        return of_segments

    @property
    def pieces(self) -> list[tuple[int, int, bool]]:
        """The first and the last row of each part that is stable or unstable, and whether it is
        unstable.
        """
        parts = []
        for unstable, group in groupby(enumerate(self.unstable), key=lambda each: each[1]):
            numbers = [i for i, _ in group]
            parts.append((numbers[0], numbers[-1] + 1, unstable))
        return parts

    @property
    def level(self) -> list[int]:
        """Its ends, 0 and -1, at which its amplitude has an extreme: a fold in that."""
        return [
            i
            for i in (0, -1)
            if (self.rows[i]["label"], self.rows[i]["amplitude"]) == ("fold", self.amplitude)
        ]

    def joined(
        self, x: Sequence[float], y: Sequence[float], *, of_load: int | None = None
    ) -> Array:
        """A smooth curve (2, FINE (n - 1) + 1) through coordinates of its rows.

        Parameters
        ----------
        of_load
            Which of the coordinates is its amplitude, 0 or 1; None if none is.
        """
        if self.in_time:
            return splined(x, y, [float(row["time"]) for row in self.rows])
        level = [] if of_load is None else [(of_load, end) for end in self.level]
        return smooth(x, y, [row["label"] in LOCATED for row in self.rows], level)


def line_coordinates(part: Part) -> list[Line]:
    """The branches of a part of a path, in their order."""
    path = [row for row in part.rows if row["label"] != SOLUTION]
    in_time = part.amplitude == "time"
    branches = sorted({int(row["branch"]) for row in path})
    of_branches = [
        _line([row for row in path if row["branch"] == b], part.amplitude) for b in branches
    ]
    return [Line(rows, in_time, part.amplitude) for rows in of_branches]


def _line(rows: Sequence[Row], amplitude: str) -> list[Row]:
    """The rows of a branch along its curve: those of the model, and what the model excludes at its
    end.
    """
    own = [row for row in rows if row["mode"] in OWN_MODES]
    last, before = (place(row, amplitude) for row in (own[-1], own[max(len(own) - 2, 0)]))
    beyond = [row for row in rows[-1:] if row not in own and row["label"] in LOCATED]
    ahead = np.subtract(last, before)
    return own + [
        row for row in beyond if np.dot(np.subtract(place(row, amplitude), last), ahead) > 0
    ]


def of_load(amplitude: str) -> int:
    """Which coordinate of its curve an amplitude is."""
    return 0 if registered(amplitude).sideways else 1


def smooth(
    x: Sequence[float],
    y: Sequence[float],
    located: Sequence[bool] = (),
    level: Sequence[tuple[int, int]] = (),
) -> Array:
    """A smooth curve (2, FINE (n - 1) + 1) through n points; the parameter is the root of the
    scaled chord.

    Cubics with the slopes of parabolas through three points, limited so that what rises from point
    to point rises (Fritsch and Carlson, SIAM J. Numer. Anal. 17, 1980). What turns between two
    points turns smoothly there, what turns at a located point turns at it.

    Parameters
    ----------
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
    chord = np.concatenate([[0], np.cumsum(np.sqrt(np.maximum(steps, 1e-12)))])
    ends = np.array(located, bool) if len(located) else np.zeros(len(chord), bool)
    slopes = np.array([_slopes(chord, values, ends) for values in xy])
    for coordinate, end in level:
        slopes[coordinate, end] = 0.0
    t, h, rise = np.arange(FINE) / FINE, np.diff(chord)[:, None], np.diff(xy, axis=1)[..., None]
    first, last = h * slopes[:, :-1, None], h * slopes[:, 1:, None]
    curve = xy[:, :-1, None] + t * (
        first + t * (3 * rise - 2 * first - last + t * (first + last - 2 * rise))
    )
    return np.concatenate([curve.reshape(2, -1), xy[:, -1:]], axis=1)


def _slopes(t: Array, values: Array, located: NDArray[np.bool_]) -> Array:
    """The derivatives (n,) of values over a parameter at n points."""
    h, chords = np.diff(t), np.diff(values) / np.diff(t)
    if len(chords) == 1:
        return np.full(2, chords[0])
    before, after, h1, h2 = chords[:-1], chords[1:], h[:-1], h[1:]
    most = STEEPEST * np.abs(chords)
    most[1:-1][chords[:-2] * chords[2:] < 0] = np.inf  # it turns between these two points
    steepest = np.minimum(most[:-1], most[1:])
    inner = np.clip((h2 * before + h1 * after) / (h1 + h2), -steepest, steepest)
    inner[located[1:-1] & (before * after < 0)] = 0.0
    ends = [_end(h[0], h[1], chords[0], chords[1]), _end(h[-1], h[-2], chords[-1], chords[-2])]
    return np.concatenate([ends[:1], inner, ends[1:]])


def _end(h1: float, h2: float, first: float, second: float) -> float:
    """The slope at an end: that of a parabola through three points, or none, or STEEPEST times the
    chord's.
    """
    slope = ((2 * h1 + h2) * first - h1 * second) / (h1 + h2)
    if slope * first <= 0:
        return 0.0
    return float(np.clip(slope, -STEEPEST * abs(first), STEEPEST * abs(first)))


def splined(x: Sequence[float], y: Sequence[float], t: Sequence[float]) -> Array:
    """The same by cubic splines over the time: with four points a period a vibration keeps its
    form.

    Equal times, such as those of the point before a motion and of its first, are joined straight.
    """
    xy, times = np.array([x, y], float), np.array(t, float)
    later = np.concatenate([[True], np.diff(times) > 0])
    if later.sum() < 4 or not later[2:].all():
        return smooth(x, y)
    fine = _fine(times)
    curve = np.asarray(scipy.interpolate.CubicSpline(times[later], xy[:, later], axis=1)(fine))
    if not later[1]:
        curve[:, : FINE + 1] = np.linspace(xy[:, 0], xy[:, 1], FINE + 1).T
    return curve


def _fine(at: Array) -> Array:
    """FINE equal steps between every two values."""
    return np.interp(np.arange(FINE * (len(at) - 1) + 1) / FINE, np.arange(len(at)), at)

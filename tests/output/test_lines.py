"""Smooth curves through the points of a path: what turns, what ends level, motions."""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, PchipInterpolator

from magshell_fenicsx.output.pictures.lines import (
    SEGMENTS_PER_INTERVAL,
    Line,
    cubics,
    smooth,
    spline_slopes,
)

Array = np.ndarray


def rows_of(labels: Sequence[str], times: Sequence[float] | None = None) -> list[dict[str, object]]:
    """Rows of path.csv as far as a line reads them."""
    return [
        {"label": label, "amplitude": "force", "time": time}
        for label, time in zip(labels, times or [0.0] * len(labels), strict=True)
    ]


def test_a_turn_between_points_is_smooth() -> None:
    """A parabola through six points, its top between two: within 0.03, where a monotone curve is
    cut off.
    """
    x = np.linspace(-1.0, 1.0, 6)
    drawn = smooth(x.tolist(), (1 - x**2).tolist())
    assert np.abs(drawn[1] - (1 - drawn[0] ** 2)).max() < 0.03
    assert drawn[1].max() == pytest.approx(1.0, abs=0.02)
    assert PchipInterpolator(x, 1 - x**2)(np.linspace(-1, 1, 99)).max() == pytest.approx(0.96)


def test_a_loop_through_near_and_far_points() -> None:
    """A circle through points 15 and 45 degrees apart in turn: within 0.03 of its radius; with the
    root of the chord as parameter and slopes of parabolas it was 0.042.
    """
    angle = np.radians(np.cumsum([0, *[15, 45] * 6]))
    drawn = smooth(np.cos(angle).tolist(), np.sin(angle).tolist())
    assert np.abs(np.hypot(*drawn) - 1).max() < 0.03


def test_a_curve_ends_level_at_a_fold() -> None:
    """Five points of a sine up to its top, the last step the longest: within 0.008, 3 times better
    than without.
    """
    x = np.array([0.0, 0.2, 0.4, 0.6, 1.0]) * np.pi / 2
    line = Line(rows_of(4 * ["step"] + ["fold"]), amplitude="force")
    wrong, without = (
        np.abs(curve[1] - np.sin(curve[0])).max()
        for curve in (line.smooth_curve(x, np.sin(x), load_axis=axis) for axis in (1, None))
    )
    assert wrong < 0.008
    assert without > 3 * wrong


def test_a_curve_turns_at_a_fold() -> None:
    """Exactly, in the coordinate that turns there; elsewhere it may turn between two points."""
    x, y = [0.0, 0.5, 1.1, 0.8, 0.9], [0.0, 2.0, 2.5, 1.0, 1.5]
    drawn = smooth(x, y, [False, False, True, False, False])
    assert drawn[0].max() == 1.1
    assert drawn[1].max() == 2.5
    assert smooth(x, y)[0].max() > 1.1


def test_a_vibration_keeps_its_form() -> None:
    """Four points a period, where straight lines would lose three tenths: within a twentieth."""
    t = np.arange(17) * 0.25 + 0.125
    wave = np.sin(2 * np.pi * t)
    line = Line(rows_of(17 * ["step"], t.tolist()), in_time=True, amplitude="time")
    drawn = line.smooth_curve(t.tolist(), wave.tolist())
    inner = drawn[:, 2 * SEGMENTS_PER_INTERVAL : -2 * SEGMENTS_PER_INTERVAL]
    assert np.abs(inner[1] - np.sin(2 * np.pi * inner[0])).max() < 0.05
    assert np.abs(np.interp(inner[0], t, wave) - np.sin(2 * np.pi * inner[0])).max() > 0.29
    assert drawn[1] == pytest.approx(CubicSpline(t, wave)(drawn[0]), abs=1e-12)


def test_a_motion_begins_at_its_first_point() -> None:
    """The point before the motion has the same time, and another place after a push: a straight
    line joins both, and the spline begins at the second.
    """
    t, w = np.array([0.0, 0.0, 1.0, 2.0, 3.0]), np.array([0.0, 0.5, 0.3, -0.2, -0.4])
    line = Line(rows_of(5 * ["step"], t.tolist()), in_time=True, amplitude="time")
    drawn = line.smooth_curve(w.tolist(), (2 * w).tolist())
    first, rest = drawn[:, : SEGMENTS_PER_INTERVAL + 1], drawn[:, SEGMENTS_PER_INTERVAL:]
    assert first[1] == pytest.approx(2 * first[0], abs=1e-15)
    assert (np.diff(first[0]) > 0).all()
    times = np.linspace(0.0, 3.0, 3 * SEGMENTS_PER_INTERVAL + 1)
    assert rest[0] == pytest.approx(CubicSpline(t[1:], w[1:])(times), abs=1e-12)


@pytest.mark.parametrize("times", [[0.0, 1.0, 2.0], [0.0, 1.0, 1.0, 2.0, 3.0]])
def test_a_motion_without_a_spline(times: list[float]) -> None:
    """Of too few points, or with one time twice: it is joined as other curves are."""
    w = np.cos(np.arange(len(times))).tolist()
    line = Line(rows_of(len(times) * ["step"], times), in_time=True, amplitude="time")
    assert (line.smooth_curve(times, w) == smooth(times, w)).all()


def test_one_point_and_two() -> None:
    """A point stays a point; two are joined by a straight line."""
    assert smooth([1.0], [2.0]).tolist() == [[1.0], [2.0]]
    x, y = smooth([0.0, 1.0], [1.0, 3.0])
    assert y == pytest.approx(1 + 2 * x)


def test_cubics_and_slopes_of_a_spline() -> None:
    """A cubic polynomial is drawn exactly."""
    t = np.array([0.0, 0.3, 1.0, 1.2, 2.0])
    v = t**3 - 2 * t
    curve = cubics(t, v[None], spline_slopes(t, v.tolist())[None])[0]
    refined = np.interp(np.arange(len(curve)) / SEGMENTS_PER_INTERVAL, np.arange(5), t)
    assert curve == pytest.approx(refined**3 - 2 * refined, abs=1e-12)

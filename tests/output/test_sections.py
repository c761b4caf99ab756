"""Sections below pictures, loops of several steps, and drawn modes: numbers of what is drawn."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

import magshell_fenicsx.parts.registered  # noqa: F401
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.curve import curve_figure
from magshell_fenicsx.output.pictures.curve_additions import _section_image, _sections_of_strips
from magshell_fenicsx.output.pictures.lines import CurveStep, curve_panels
from magshell_fenicsx.output.pictures.mode_pictures import MODE_SIZE, mode_size, solutions_figure
from magshell_fenicsx.output.pictures.picture import figures
from magshell_fenicsx.output.pictures.rendering import has_snapped, run_camera
from magshell_fenicsx.output.pictures.scales import numbers
from magshell_fenicsx.output.pictures.sections import upright_section
from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.problem.requests import OutputSection
from magshell_fenicsx.shape.drawn_bodies import globe

RISE = 0.4


def height(r: np.ndarray) -> np.ndarray:
    """Return the height of a dome over places (n, 3)."""
    return np.asarray(RISE * (1 - r[:, 0] ** 2) * (1 - r[:, 1] ** 2))


def dome(u_z: float, place: tuple[float, float] = (0.0, 0.0), n: int = 31) -> Surface:
    """Return a square dome whose height changes by u_z, times a bell around a place."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-1, 1, n)] * 2))
    r = np.column_stack([x, y, 0 * x])
    r[:, 2] = height(r)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    cells = np.concatenate([np.stack([i, i + 1, i + n], 1), np.stack([i + 1, i + n + 1, i + n], 1)])
    bell = np.exp(-4 * ((x - place[0]) ** 2 + (y - place[1]) ** 2))
    u = np.column_stack([0 * x, 0 * x, u_z * bell * height(r) / RISE])
    return Surface(r, u, np.array([0, 0, -1.0]) + 0 * r, cells, {})


def test_a_section_has_the_undeformed_and_the_deformed_shape() -> None:
    """Through a dent beside the axis, along the line from the axis to it."""
    section = upright_section(dome(-0.2, (0.5, 0.5)))
    assert section
    assert "largest displacement" in section.words
    x, z = section.undeformed.reshape(-1, 2).T
    # along the diagonal x = y, of which the lines have the length
    assert z == pytest.approx(RISE * (1 - x**2 / 2) ** 2 - RISE / 2, abs=2e-3)
    deformed_x, deformed_z = section.deformed.reshape(-1, 2).T
    depth = np.interp(deformed_x, np.sort(x), z[np.argsort(x)]) - deformed_z
    s = deformed_x / np.sqrt(2)
    assert depth == pytest.approx(0.2 * np.exp(-8 * (s - 0.5) ** 2) * (1 - s**2) ** 2, abs=5e-3)


def test_a_shell_that_a_plane_hardly_cuts_has_no_section() -> None:
    """A low ring around e3: its picture would be four dots."""
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    r = np.concatenate([np.column_stack([circle, z + 0 * angle]) for z in (0.0, 0.05)])
    i = np.arange(60)
    j = (i + 1) % 60
    cells = np.concatenate([np.stack([i, j, i + 60], 1), np.stack([j, j + 60, i + 60], 1)])
    assert upright_section(Surface(r, 0.1 * r, r, cells, {})) is None


def test_a_dome_that_has_snapped_is_seen_from_lower() -> None:
    """A dent, or a plate that is pushed down, is not."""
    dent, snapped = dome(-0.3), dome(-1.0)
    plate = replace(snapped, r0=snapped.r0 * [1, 1, 0])
    assert [has_snapped(surface) for surface in (dent, snapped, plate)] == [False, True, False]
    high, low = (run_camera(surface, OutputSection()).direction for surface in (dent, snapped))
    assert low[2] / np.hypot(*low[:2]) < 0.6 * high[2] / np.hypot(*high[:2])


def test_a_section_is_below_its_image_and_covers_no_text() -> None:
    """Its words, the bar and the letters of directions are apart; no text is below 8 points."""
    surface, style = dome(-0.3), OutputSection()
    figure = figures(surface, 0.01, style, run_camera(surface, style), ["shell"])["shell"]
    renderer = FigureCanvasAgg(figure).get_renderer()
    image, bar, section = figure.axes[0], figure.axes[1], figure.axes[2]
    places = [axes.get_position() for axes in (image, section, bar)]
    assert places[0].y0 >= places[1].y1 > places[1].y0 > places[2].y1
    (words,) = figure.texts
    box = words.get_window_extent(renderer)
    assert not box.overlaps(section.get_window_extent(renderer))
    assert box.y0 >= bar.title.get_window_extent(renderer).y1
    texts = [words, bar.title, *bar.get_xticklabels()]
    assert min(text.get_fontsize() for text in texts) >= 8
    x, y = section.transData.transform([[0, 0], [1, 1]]).T
    assert np.ptp(x) == pytest.approx(np.ptp(y), rel=1e-6)


def test_a_section_shows_what_the_shell_touches() -> None:
    """A ball above the dent is a circle; one far above is not in its box."""
    for height_of_ball, is_shown in ((0.5, True), (2.0, False)):
        ball = replace(globe(0.3), points=globe(0.3).points + np.array([0, 0, height_of_ball]))
        section = upright_section(replace(dome(-0.2), solids=(ball,)))
        assert section
        radii = np.linalg.norm(section.bodies - [0, height_of_ball - RISE / 2], axis=2)
        assert radii == pytest.approx(0.3, abs=2e-3)
        assert section.box[3] == pytest.approx(
            height_of_ball + 0.3 - RISE / 2 if is_shown else RISE / 2, abs=0.02
        )


def test_shapes_of_strips_are_sections_by_one_plane() -> None:
    """Those of a strip along a diagonal, also where it has not moved; a dome is drawn whole."""
    turn = np.array([[1, -1, 0], [1, 1, 0], [0, 0, np.sqrt(2)]]) / np.sqrt(2)
    moved = dome(-0.2, (0.5, 0.0))
    strip = replace(moved, r0=moved.r0 * [1, 0.1, 1] @ turn.T)
    at_rest = replace(strip, u=0 * strip.u)
    first, last = _sections_of_strips([at_rest, strip])
    assert first.direction == last.direction
    assert first.deformed == pytest.approx(first.undeformed)
    assert np.ptp(last.deformed[..., 1]) < np.ptp(first.deformed[..., 1])
    image = _section_image(last, [first, last], (600.0, 400.0))
    assert image[..., 3].max() == 255
    assert image[0, 0, 3] == 0  # transparent beside the lines
    assert _sections_of_strips([replace(moved, u=0 * moved.u), moved]) == []


def test_a_displacement_that_is_not_seen_has_no_section() -> None:
    """Two lines would be one."""
    surface, style = dome(-1e-4), OutputSection()
    figure = figures(surface, 0.01, style, run_camera(surface, style), ["shell"])["shell"]
    assert not figure.texts


def rows_of_loop() -> list[Row]:
    """Return the rows of a field that goes to 1 and back to 0, on another way."""
    row: dict[str, Any] = {"amplitude": "lambda_m", "mode": "", "branch": 0, "label": "step"}
    row |= {"negative_pivots": 0, "p_over_pc": 0.0}
    there = [(1, 0.1 * i, (0.1 * i) ** 2) for i in range(11)]
    back = [(2, 1 - 0.1 * i, 1 - 0.02 * i) for i in range(1, 11)]
    return [
        row | {"point": i, "step": step, "lambda_m": field, "w_over_h": w, "w_pole_over_h": w}
        for i, (step, field, w) in enumerate(there + back)
    ]


def test_a_load_there_and_back_is_one_loop() -> None:
    """One panel, with an arrow along each way, also where one way is straight."""
    figure = curve_figure(rows_of_loop(), "lambda_m", OutputSection())
    (axes,) = figure.axes
    assert axes.get_title() == "steps 1, 2: field"
    there, back = (text for text in axes.texts if text.get_text() == "")
    assert there.xy[1] > there.xyann[1]
    assert back.xy[1] < back.xyann[1]


def test_steps_over_other_quantities_have_other_panels() -> None:
    """The last panel has the last step; a motion is beside no earlier one."""
    row = rows_of_loop()[0] | {"force": 0.0, "time": 0.0, "volume_change": 0.0}
    names = ["lambda_m", "pressure", "lambda_m", "time", "time"]
    steps = [CurveStep(name, [row], i) for i, name in enumerate(names, 1)]
    numbers_of_panels = [[step.number for step in panel] for panel in curve_panels(steps)]
    assert numbers_of_panels == [[2], [1, 3], [4], [5]]


def two_plates(gap: float, shells: tuple[str, ...]) -> Surface:
    """Return two plates above each other, the upper with a mode downwards."""
    lower = replace(dome(0.0), r0=dome(0.0).r0 * [1, 1, 0])
    count = len(lower.r0)
    r0 = np.concatenate([lower.r0, lower.r0 + np.array([0, 0, gap])])
    cells = np.concatenate([lower.cells, lower.cells + count])
    mode = np.concatenate([np.zeros((count, 3)), np.tile([0, 0, -1.0], (count, 1))])
    return Surface(r0, 0 * r0, 0 * r0, cells, {"mode": mode}, shells=shells)


def test_a_mode_closes_no_more_than_half_of_a_gap() -> None:
    """Of two shells; one shell, or a wide gap, has the usual size."""
    names = ("lower", "upper")
    assert mode_size(two_plates(0.02, names)) == pytest.approx(0.01)
    assert mode_size(two_plates(0.5, names)) == MODE_SIZE
    assert mode_size(two_plates(0.02, ())) == MODE_SIZE
    opening = two_plates(0.02, names)
    opening.fields["mode"] *= -1
    assert mode_size(opening) == MODE_SIZE


def test_ticks_of_a_narrow_range_are_even() -> None:
    """Rounded to three digits they would be 1, 1.01, 1.01, 1.02."""
    texts, _ = numbers([1.0, 1.005, 1.01, 1.015])
    assert np.diff([float(text) for text in texts]) == pytest.approx(0.005)


def test_solutions_that_look_alike_say_how_near_they_are() -> None:
    """The second of three is 0.01 R or one thickness from the first, the third far from both."""
    row = rows_of_loop()[0] | {"label": "solution", "excluded_pivots": 0}
    rows = [row | {"branch": number} for number in (1, 2, 3)]
    surfaces = [dome(-0.4), dome(-0.41), dome(-0.1)]
    style = OutputSection()
    figure = solutions_figure(surfaces, rows, 0.01, style, run_camera(surfaces[0], style))
    texts = [text.get_text() for text in figure.texts]
    assert [text for text in texts if "at most" in text] == [texts[2]]
    assert "at most 1 $h$ from solution 1" in texts[2]

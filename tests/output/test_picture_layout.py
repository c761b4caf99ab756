"""What is drawn keeps clear of what is drawn beside it, and is large enough to be seen."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import CASES
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.output.fields.outlines import outlines
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.animation import _palette
from magshell_fenicsx.output.pictures.bodies_and_magnets import far_bodies_note
from magshell_fenicsx.output.pictures.captions import write_numbers
from magshell_fenicsx.output.pictures.colours import ColouredField, contact_region, moments
from magshell_fenicsx.output.pictures.layout import Arrow, Panel, panels_figure
from magshell_fenicsx.output.pictures.picture import Background, figures
from magshell_fenicsx.output.pictures.rendering import (
    Camera,
    Window,
    deflected_place,
    near_outlines,
    run_camera,
    viewing_direction,
)
from magshell_fenicsx.problem.requests import OutputSection

Array = NDArray[np.float64]
ABOVE = Camera(np.array([0.0, -1e-6, 1.0]))


def grid(n: int = 41) -> Surface:
    """A flat square of side 2 in triangles, not displaced."""
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
    r = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    cells = np.concatenate(
        [np.column_stack([a, a + 1, a + n + 1]), np.column_stack([a, a + n + 1, a + n])]
    )
    return Surface(r, 0 * r, np.tile([0.0, 0, 1], (len(r), 1)), cells, {})


def test_numbers_cover_no_other_numbers_and_no_marks() -> None:
    """Of forty marks, half of them crowded; those without room are left out, all others are inside
    the axes.
    """
    figure = Figure(figsize=(3.5, 2.6), dpi=100)
    axes = figure.subplots()
    x = np.concatenate([np.linspace(0, 0.1, 20), np.linspace(0.15, 1, 20)])
    axes.plot(x, 1 / (1 + 20 * x), "o", markersize=4.5)
    marks = [((float(v), float(1 / (1 + 20 * v))), i) for i, v in enumerate(x, 1)]
    write_numbers(axes, marks, [np.array([x, 1 / (1 + 20 * x)])])
    renderer = FigureCanvasAgg(figure).get_renderer()
    boxes = [
        text.get_window_extent(renderer).expanded(1.0, 0.7) for text in axes.texts
    ]  # digits have no tails
    assert 20 < len(boxes) < 40
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
    at = axes.transData.transform(np.array([place for place, _ in marks]))
    assert not any(box.contains(*place) for box in boxes for place in at)
    frame = axes.get_window_extent(renderer)
    assert all(frame.contains(*corner) for box in boxes for corner in box.corners())


def test_a_source_is_drawn_whole_or_not_at_all() -> None:
    """A cylinder of two circles, one beyond the picture, and a line that joins them; a ring that is
    near.
    """
    t = np.linspace(0, 2 * np.pi, 49)
    circle = np.column_stack([np.cos(t), np.sin(t), 0 * t])
    up = np.array([0.0, 0, 1])
    near, far, ring = circle + 3 * up, circle + 6 * up, 0.5 * circle + 0.5 * up
    joining = np.linspace(near[12], far[12], 2)
    surface = grid(3)
    drawn = near_outlines(
        Surface(
            *(vars(surface)[k] for k in ("r0", "u", "n0", "cells", "fields")),
            (near, far, joining, ring),
        )
    )
    assert [line is ring for line in drawn] == [True]


@pytest.mark.parametrize(("farther", "drawn"), [(0.0, True), (1.5, False)])
def test_a_magnet_beside_a_strip(farther: float, drawn: bool) -> None:
    """That of the case: drawn, with a camera for which the shell fills more of the picture than for
    the usual one.
    """
    flat = grid(9)
    r0 = np.column_stack([(flat.r0[:, 0] + 1) / 2, flat.r0[:, 1] / 12, flat.r0[:, 2]])
    lift = 0.18 * r0[:, :1] ** 2 * [0, 0, 1]
    lines = outlines(
        make_problem(Case.load(CASES / "magnet_past_strip.yaml")).loads, {"source": 0.0}, 0.0
    )
    lines = tuple(line + np.array([farther, 0, 0]) for line in lines)
    surface = Surface(r0, lift, flat.n0, flat.cells, {}, lines)
    assert len(near_outlines(surface)) == (len(lines) if drawn else 0)
    assert bool(far_bodies_note(surface)) != drawn
    usual = viewing_direction(deflected_place(surface))
    camera = run_camera(surface, OutputSection())
    assert np.allclose(camera.direction, usual) != drawn


@pytest.mark.parametrize(("radius", "alone"), [(0.1, True), (0.6, False)])
def test_a_small_contact_is_drawn_large(radius: float, alone: bool) -> None:
    surface = grid()
    distance = np.linalg.norm(surface.r0, axis=1)
    surface.fields.update(
        gap_over_h=np.where(distance < radius, 0.5, 9.0), contact_pressure=1.0 * (distance < radius)
    )
    assert (contact_region(surface) is not None) == alone
    figure = figures(surface, 0.01, OutputSection(), ABOVE, ["contact"])["contact"]
    assert any("around the contact" in text.get_text() for text in figure.texts) == alone
    left, right = figure.axes[0].get_xlim()
    if alone:
        assert right - left < 8 * radius


def test_arrows_stay_in_their_panel() -> None:
    """One that leaves the image at the top: the panel is higher, and as wide in pixels."""
    window = Window((-1.0, 1.0, -1.0, 1.0), 50)
    arrow = Arrow(np.array([[0.0, 0.9, 0]]), np.array([[0.0, 0.6, 0]]), "C0", "up")
    panel = Panel(np.zeros((100, 100, 4), np.uint8), window, ABOVE, arrows=(arrow,))
    left, right, low, high = panel.frame
    assert (left, right, low) == (-1, 1, -1)
    assert 1.5 < high < 1.6
    assert panel.size == pytest.approx((100 * (high + 1) / 2, 100))


def test_panels_are_in_the_middle_of_equal_columns() -> None:
    """Two panels, one half as wide as the other."""
    panels = [
        Panel(np.zeros((100, width, 4), np.uint8), Window((-1.0, 1.0, -1.0, 1.0), 50), ABOVE)
        for width in (100, 50)
    ]
    figure = panels_figure(panels, OutputSection())
    boxes = [axes.get_position() for axes in figure.axes[:2]]
    assert [(box.x0 + box.x1) / 2 for box in boxes] == pytest.approx([0.25, 0.75], abs=1e-3)


def test_moments_that_are_noise_are_pale() -> None:
    """Smooth ones have colours up to their largest value; those that differ by 90 % from the cells'
    do not.
    """
    surface = grid()
    wave = 1e-5 * np.sin(3 * surface.r0[:, 0])
    surface.fields.update(M_1=wave, M_2=0 * wave)
    smooth, noise = (
        moments(replace(surface, jump=jump), 0.01)[0][0].limits[1] for jump in (1e-3, 0.9)
    )
    assert smooth == pytest.approx(np.abs(wave).max())
    assert noise > 10 * np.sqrt(np.mean(wave**2))


def test_names_of_shells_cover_no_other_names() -> None:
    """Two shells at one place, as a plate and its stiffener seen from above: the second name is a
    line beside the first.
    """
    flat = grid(9)
    numbers = np.repeat([0.0, 1.0], len(flat.r0))
    r0 = np.concatenate([flat.r0, flat.r0])
    cells = np.concatenate([flat.cells, flat.cells + len(flat.r0)])
    n0 = np.tile([0.0, 0, 1], (len(r0), 1))
    surface = Surface(r0, 0 * r0, n0, cells, {"shell": numbers}, shells=("plate", "stiffener"))
    style = OutputSection()
    figure = figures(surface, 0.01, style, ABOVE, ["shell"])["shell"]
    texts = [text for axes in figure.axes for text in axes.texts]
    first, second = (
        next(text for text in texts if text.get_text() == name) for name in surface.shells
    )
    renderer = FigureCanvasAgg(figure).get_renderer()
    assert not first.get_window_extent(renderer).overlaps(second.get_window_extent(renderer))


def test_contours_of_the_displacement() -> None:
    """Circles at the round values between the limits, not at zero; a plateau at a round value has
    no lines within.
    """
    surface = grid()
    distance = np.linalg.norm(surface.r0, axis=1)
    w = np.clip(5 * (1 - distance), 0, 4)
    view = Background(surface, ABOVE, 300)
    contours = view.contours(ColouredField("w_over_h", w, (0.0, 4.0), "signed", ""))
    radii = [np.linalg.norm(line[~np.isnan(line[:, 0])], axis=1) for line, _ in contours]
    assert [radius.mean() for radius in radii] == pytest.approx([0.8, 0.6, 0.4], abs=0.01)
    # noise of rounding on the plateau
    noise = 1e-9 * np.sin(1e3 * distance)
    limits = (0.0, 5.0)
    *_, (line, _) = view.contours(ColouredField("w_over_h", w + noise, limits, "signed", ""))
    assert np.nanmin(np.linalg.norm(line, axis=1)) > 0.13  # a cell within its rim


def test_an_animation_has_no_bands() -> None:
    """Shades of red in shade, reduced to the palette of a GIF file: means over 8 by 8 pixels are
    within 2.5 of 255 levels, and the colours of curves stay.
    """
    y, x = np.mgrid[0:1:240j, 0:1:320j][..., None]
    shades = 255 * (1 - 0.5 * y) * (1 - x * [0.2, 0.8, 0.75])
    frame = np.full((240, 400, 3), 255, np.uint8)
    frame[:, :320] = np.rint(shades)
    blue = (31, 119, 180)
    frame[10:12, 340:380] = blue
    palette = _palette([frame])
    reduced = np.asarray(Image.fromarray(frame).quantize(palette=palette).convert("RGB"), float)
    blocks = (reduced - frame).reshape(30, 8, 50, 8, 3).mean(axis=(1, 3))
    assert np.abs(blocks[1:-1, 1:38]).max() < 2.5
    assert np.abs(reduced[10:12, 340:380] - blue).max() <= 3

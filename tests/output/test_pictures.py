"""Views of a shell: where its axes and its colours are."""

import io
import re
from dataclasses import replace
from math import nan
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import basix
import matplotlib.image
import numpy as np
import pytest
import pyvista
from dolfinx.cpp.io import perm_vtk
from dolfinx.mesh import CellType
from matplotlib.figure import Figure
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface, completed
from magshell_fenicsx.output.fields.tessellation import tessellate
from magshell_fenicsx.output.fields.vtu import (
    FieldSeries,
    ShellData,
    point_file,
    read_vtu,
    write_whole_shells,
)
from magshell_fenicsx.output.pictures.captions import caption
from magshell_fenicsx.output.pictures.colours import (
    ColouredField,
    field_at,
    field_caption,
    loads,
    moments,
    sizes_at,
    strains,
)
from magshell_fenicsx.output.pictures.curve import axis_label, curve_figure
from magshell_fenicsx.output.pictures.layout import figure_files, png
from magshell_fenicsx.output.pictures.picture import (
    PICTURES,
    Background,
    edge_lines,
    field_arrows,
    figures,
    lines_away_from,
    spread_points,
)
from magshell_fenicsx.output.pictures.rendering import (
    LAMP,
    RELIEF,
    RIM,
    Camera,
    RenderedSurface,
    Window,
    axes_on_screen,
    viewing_direction,
)
from magshell_fenicsx.output.pictures.scales import SIGNED, Scale, colour_bar, colour_map
from magshell_fenicsx.output.report.interactive import label
from magshell_fenicsx.output.store.stored_results import load_at_factor_one, pole_of
from magshell_fenicsx.output.store.table import COLUMNS, TEXTS, PathTable, Row
from magshell_fenicsx.problem.requests import OutputSection
from magshell_fenicsx.quantities.quantity import NO_UNITS, CaseSizes
from magshell_fenicsx.quantities.registry import quantity

Array = NDArray[np.float64]
STYLE = OutputSection()
SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
ABOVE = np.array([0.0, -1e-6, 1.0])


def plate(w: float) -> Surface:
    """A flat square in two triangles, displaced by w along -e3."""
    down = np.array([0.0, 0.0, -1.0])
    return Surface(
        SQUARE,
        np.tile(w * down, (4, 1)),
        np.tile(-down, (4, 1)),
        np.array([[0, 1, 2], [0, 2, 3]]),
        {},
    )


def test_axes_on_the_screen() -> None:
    """Seen along -e1 (the eye on e1): e1 points to the eye, e2 to the right, e3 up; from e2, e1 to
    the left.
    """
    assert axes_on_screen(np.array([2.0, 0, 0])) == pytest.approx(
        np.array([[0, 0], [1, 0], [0, 1]])
    )
    assert axes_on_screen(np.array([0, 3.0, 0])) == pytest.approx(
        np.array([[-1, 0], [0, 0], [0, 1]])
    )


def test_a_place_is_seen_from_its_side() -> None:
    for azimuth in (0.0, 2.0, -1.0):
        place = np.array([np.cos(azimuth), np.sin(azimuth), 0.5])
        assert viewing_direction(place) @ place > 3 * np.linalg.norm(place)


def seen(surface: Surface, width: int = 300) -> RenderedSurface:
    camera = Camera(ABOVE)
    return RenderedSurface.from_surface(surface, camera, Window.around(camera(surface.r0), width))


def test_colours_are_those_of_the_bar_and_zero_is_white() -> None:
    """Of a plate that faces the eye, pixel by pixel; what is not the plate is transparent."""
    colours = colour_map(SIGNED)
    for value, expected in (
        (0.0, (255, 255, 255)),
        (1.0, np.rint(255 * np.array(colours(256)[:3]))),
    ):
        image = seen(plate(0.0)).coloured(np.full(4, value), (-1.0, 1.0), colours)
        assert image[150, 150, :3] == pytest.approx(expected, abs=1)
        assert image[150, 150, 3] == 255
        assert (image[0, :, 3] == 0).all()
    assert colours(128)[:3] == (1.0, 1.0, 1.0)


def slopes(rise: float) -> Surface:
    """Two rectangles beside each other, the left one rising, the right one falling: a roof, or a
    valley.
    """
    left = np.array([[-1.0, -1, 0], [0, -1, rise], [0, 1, rise], [-1, 1, 0]])
    right = left * [-1.0, 1, 1]
    r = np.concatenate([left, right])
    cells = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    return Surface(r, 0 * r, np.tile([0.0, 0, 1], (8, 1)), cells, {})


def test_light_comes_from_the_upper_left() -> None:
    """A roof is light on its left, a valley on its right, so that a dent is no bump; by hand, and
    without a hue.
    """
    shown = {
        rise: seen(slopes(rise)).coloured(np.zeros(8), (-1.0, 1.0), colour_map(SIGNED))
        for rise in (0.5, -0.5)
    }
    normal, lamp = (
        np.array([0.5, 0, 1]) / np.hypot(0.5, 1),
        np.array(LAMP) / np.linalg.norm(LAMP),
    )  # of the right one
    away = lamp[2] - normal @ lamp
    dark = 255 * (1 - RELIEF * away / (1 + away / 2) - RIM * (1 - normal[2]) ** 2)
    for image, right in ((shown[0.5], 225), (shown[-0.5], 75)):
        assert image[150, right, :3] == pytest.approx(np.full(3, dark), abs=1.5)
        assert (image[150, 300 - right, :3] == 255).all()


def test_a_plate_has_the_colours_of_its_bar() -> None:
    """One that is turned away from the lamp too: there was a quarter of its light missing."""
    only = slopes(0.5)
    right = Surface(only.r0[4:], 0 * only.r0[4:], only.n0[4:], only.cells[:2], {})
    image = seen(right).coloured(np.zeros(4), (-1.0, 1.0), colour_map(SIGNED))
    inside = image[..., 3] == 255
    assert inside.any()
    assert image[inside][:, :3].min() >= 253  # but for what is lost where it is seen aslant


def test_no_light_makes_one_colour_of_another() -> None:
    """A tenth of a red limit on the slope that is lit best: the colour of the bar, where it once
    was white.
    """
    colours = colour_map(SIGNED, (0.0, 1.0))
    image = seen(slopes(0.5)).coloured(np.full(8, 0.1), (0.0, 1.0), colours)
    assert image[150, 75, :3] == pytest.approx(255 * np.array(colours(0.1)[:3]), abs=2.5)
    bright = seen(slopes(0.5)).coloured(np.full(8, 0.9), (0.0, 1.0), colours)[150, 75, :3]
    assert bright / bright.max() == pytest.approx(
        np.array(colours(0.9)[:3]) / max(colours(0.9)[:3]), abs=0.02
    )


def two_squares() -> Surface:
    """One above the other, the upper one half as wide."""
    low, high = plate(0.0), plate(-0.5)  # -w is up
    half = replace(high, r0=high.r0 * [0.5, 0.5, 1.0])
    joined = (
        np.concatenate([getattr(low, name), getattr(half, name)]) for name in ("r0", "u", "n0")
    )
    return Surface(*joined, np.concatenate([low.cells, low.cells + 4]), {})


def test_edges_are_drawn_in_front_of_the_shell_itself() -> None:
    """Those of one triangle alone: no diagonal, no ridge with double nodes; the rim of the upper of
    two squares.
    """
    edges = edge_lines(plate(0.0)).reshape(4, -1, 3)[:, :-1]
    assert (np.abs(edges[..., :2]).max(axis=-1) == 1).all()
    on_ridge = np.abs(edge_lines(slopes(0.5))[:, 0]) < 1e-9
    assert on_ridge.sum() == 4  # the ends of the other edges
    panel = Background(two_squares(), Camera(ABOVE), 300).panel(plain(), STYLE)
    x, y = np.concatenate([line for line, _ in panel.lines]).T
    assert (np.abs(y[np.abs(x - 0.5) < 1e-6]) <= 0.6).sum() > 10


def plain() -> ColouredField:
    """No colours."""
    return ColouredField("", np.zeros(8), (0.0, 1.0), "", "")


def test_the_deformed_shell_hides_the_outline_of_the_undeformed_one() -> None:
    """Two squares that move up and to the right: the outline is dashed only where they are not;
    crumbs are left out.
    """
    before = two_squares()
    after = replace(before, u=np.add(before.u, (0.7, 0.0, 0.5)))
    panel = Background(after, Camera(ABOVE), 300).panel(plain(), STYLE)
    x, _ = np.concatenate([line for line, (_, dashes) in panel.lines if dashes == "--"]).T
    assert np.nanmin(x) == pytest.approx(-1, abs=0.02)
    assert np.nanmax(x) < -0.25
    line = np.column_stack([np.linspace(0, 1, 101), np.zeros(101)])
    (left,) = lines_away_from([line], [np.array([[0.2, 0.0], [0.25, 0.0]])], 0.04, 0.1)
    assert np.nanmin(left[:, 0]) < 0.01
    assert lines_away_from([line[:5]], [np.array([[9.0, 0.0]])], 0.04, 0.1) == []


def test_what_is_in_front_hides_what_is_behind() -> None:
    """Two squares, one above the other, and linear values between nodes, as an independent formula
    has them.
    """
    both = two_squares()
    view = seen(both)
    image = view.coloured(np.array([0.0, 1, 1, 0, 1, 1, 1, 1]), (0.0, 1.0), colour_map("gray"))
    assert (image[150, 150, :3] == 255).all()  # the upper one
    left = view.window.box[0]
    for x in (20, 60, 250):
        place = left + (x + 0.5) / view.window.scale
        assert image[150, x, 0] == pytest.approx(255 * (place + 1) / 2, abs=2)
    assert view.shows(np.array([[0, 0, 0.5], [0, 0, 0.0], [0.9, 0, 0]]), 0.01).tolist() == [
        True,
        False,
        True,
    ]


def test_curved_cells_are_smooth() -> None:
    """A quarter of a circular arc in one cubic hexahedral face, and a quadratic triangle: normals
    of the true shape.
    """
    nodes = np.array(
        [[0, 0, 0], [2, 0, 0], [0, 2, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float
    )  # VTK: corners, edges
    bent = nodes + np.column_stack([0 * nodes[:, 0], 0 * nodes[:, 0], nodes[:, 0] ** 2 / 4])
    surface = Surface(bent, 0 * bent, np.tile([0.0, 0, 1], (6, 1)), np.arange(6)[None], {})
    pieces = tessellate(surface)
    r, n = pieces.at_points(bent), pieces.normals(bent)
    assert r[:, 2] == pytest.approx(r[:, 0] ** 2 / 4)
    slope = np.column_stack([-r[:, 0] / 2, 0 * r[:, 0], 1 + 0 * r[:, 0]])
    assert np.abs(np.einsum("ij,ij->i", n, slope)) == pytest.approx(np.linalg.norm(slope, axis=1))


def test_a_body_has_its_outer_faces_only() -> None:
    """Two cubes beside each other: ten faces."""
    at = (
        np.array(np.meshgrid([0, 0.5, 1], [0, 0.5, 1], [0, 0.5, 1], indexing="ij")).reshape(3, -1).T
    )
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType.hexahedron, 2, basix.LagrangeVariant.equispaced
    )
    first = element.points[np.argsort(perm_vtk(CellType.hexahedron, 27))]
    r = np.unique(np.concatenate([at, at + np.array([1, 0, 0])]), axis=0)
    ours = [first + np.array([k, 0, 0]) for k in (0, 1)]
    cells = [[int(np.flatnonzero((r == p).all(axis=1))[0]) for p in cube] for cube in ours]
    body = Surface(r, 0 * r, np.tile([0.0, 0, 1], (len(r), 1)), np.array(cells), {})
    pieces = tessellate(body, 20)
    a, b, c = np.moveaxis(pieces.at_points(r)[pieces.triangles], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    assert len(pieces.nodes) == 10
    assert area.sum() / 2 == pytest.approx(10)


def drawn(surface: Surface, *names: str, **style: Any) -> dict[str, Figure]:
    return figures(surface, 0.01, OutputSection(**style), Camera(ABOVE), names)


def test_what_there_is_is_drawn() -> None:
    surface = plate(0.1)
    assert list(drawn(surface)) == ["shell"]
    surface.fields["p_mag"] = np.arange(4.0)
    surface.fields.update(dict.fromkeys(("E_1", "E_2", "M_1", "M_2"), np.arange(4.0)))
    surface.fields.update({"Br": np.eye(4)[:, :3], "Ba": np.zeros((4, 3))})
    found = drawn(surface)
    assert list(found) == [
        name for name in PICTURES if name not in ("contact", "magnetic_loads", "stretches")
    ]
    assert list(drawn(surface, "strains")) == ["strains"]
    said = [text.get_text() for text in found["fields"].texts]
    assert any("remanence" in text for text in said)
    assert not any("applied" in text for text in said)  # a field of length zero


def test_sizes_and_formats() -> None:
    """Millimetres at so many pixels per inch; svg and pdf are valid, with text as text."""
    style = OutputSection(width=60, dpi=150, font_size=7, formats=["svg", "pdf"])
    figure = figures(plate(0.1), 0.01, style, Camera(ABOVE), ["shell"])["shell"]
    files = dict(figure_files(figure, style, "shell"))
    assert list(files) == ["shell.png", "shell.svg", "shell.pdf"]
    assert matplotlib.image.imread(io.BytesIO(files["shell.png"])).shape[1] == pytest.approx(
        60 / 25.4 * 150, abs=2
    )
    svg = ElementTree.fromstring(files["shell.svg"])
    texts = [
        "".join(each.itertext()).strip() for each in svg.iter("{http://www.w3.org/2000/svg}text")
    ]
    assert {"0", "10"} <= set(texts)  # the ends of the bar
    letters = {
        "".join(sorted(re.sub(r"\s", "", text))) for text in texts
    }  # mathematics has its own order
    assert "".join(sorted("inwardnormaldisplacementw/h")) in letters
    assert len(list(svg.iter("{http://www.w3.org/2000/svg}image"))) >= 1
    assert files["shell.pdf"].startswith(b"%PDF-")
    assert files["shell.pdf"].rstrip().endswith(b"%%EOF")
    assert (
        b"/Type42" in files["shell.pdf"] or b"/CIDFontType2" in files["shell.pdf"]
    )  # fonts, no outlines


def test_ranges_of_colours() -> None:
    """Those of the values and zero, or those asked for."""
    bars = [
        drawn(plate(0.1), "shell", ranges=ranges)["shell"].axes[1]
        for ranges in ({}, {"w_over_h": [0.0, 2.0]})
    ]
    assert [tuple(bar.get_xlim()) for bar in bars] == [(0.0, 10.0), (0.0, 2.0)]


def test_opposite_fields_are_opposite_arrows() -> None:
    """Side by side: their feet are beside the same place, their vectors opposite."""
    surface = plate(0.0)
    surface.fields.update({"Br": np.tile([1.0, 0, 0], (4, 1)), "Ba": np.tile([-2.0, 0, 0], (4, 1))})
    first, second = field_arrows(surface, Camera(ABOVE), lambda r: np.ones(len(r), bool))
    assert first.vectors == pytest.approx(-second.vectors)
    middle = (first.feet + second.feet) / 2
    places = Camera(ABOVE)(SQUARE)
    assert sorted(map(tuple, np.round(middle[:, :2], 6))) == sorted(
        map(tuple, np.round(places[:, :2], 6))
    )
    across = first.feet - second.feet
    assert np.abs(across[:, 0]).max() < 1e-9
    assert (np.abs(across[:, 1]) > 0.01).all()


def test_magnetic_loads_tell_what_is_zero() -> None:
    """In-plane remanence in a normal field: a couple of size one, all else is rounding and is said
    to be zero.
    """
    surface = plate(0.0)
    surface.fields.update(
        {"Br": np.tile([1.0, 0, 0], (4, 1)), "Ba": np.tile([0, 0, -3e-4], (4, 1))}
    )
    surface.fields.update(
        {"p_mag": 1e-17 * np.arange(4), "k": 1e-16 * np.arange(4), "tau": 1e-18 * np.ones((4, 3))}
    )
    (layer,), note = loads(surface, 0.01)
    assert layer.name == "couple"
    assert layer.values == pytest.approx(np.ones(4))
    assert layer.limits == pytest.approx((0, 1))
    assert note == (
        "Zero everywhere: magnetic pressure, rotational springs, torque of gradients. "
        "Not defined for this remanence or field: in-plane force."
    )
    surface.fields["k"] = np.array([0.0, -0.5, 0.2, 0])
    assert loads(surface, 0.01)[0][1].limits == (-0.5, 0.2)


def limits(E_1: Array, E_2: Array) -> list[tuple[float, float]]:
    surface = plate(0.0)
    surface.fields.update({"E_1": E_1, "E_2": E_2})
    return [layer.limits for layer in strains(surface, 0.01)[0]]


def test_rounding_is_no_pattern() -> None:
    """Strains that are zero are white, those of one value one colour, one that is zero beside the
    other is left out.
    """
    noise = np.array([1.0, -1, 0.5, 0])
    assert limits(1e-15 * noise, 1e-15 * noise) == [(-1, 1), (-1, 1)]
    ((low, high),) = limits(0.02 + 1e-12 * noise, 1e-15 * noise)
    assert high == pytest.approx(0.02)
    assert low == 0
    assert colour_map(SIGNED, (low, high))(0)[:3] == (1.0, 1.0, 1.0)


def test_strains_of_the_mesh_are_no_picture() -> None:
    """In pure bending: those of 1e-6 that differ by 14 % between cells are named; resolved or
    larger ones are drawn.
    """
    wave = np.array([1.0, 0.5, 0.2, 0.1])
    surface = plate(0.0)
    surface.fields.update({"E_1": 1e-6 * wave, "E_2": -1e-6 * wave, "M_1": wave, "M_2": 0 * wave})
    assert len(strains(replace(surface, strain_jump=0.01), 0.01)[0]) == 2
    noisy = replace(surface, strain_jump=0.14)
    assert strains(noisy, 0.01) == ([], "")
    shown, said = moments(noisy, 0.01)
    assert [layer.name for layer in shown] == ["M_1"]
    assert "The smaller principal moment is zero everywhere." in said
    assert "those of bending are 5000 times larger" in said
    surface.fields["E_1"] = 1e-3 * wave
    assert len(strains(replace(surface, strain_jump=0.14), 0.01)[0]) == 1


def test_what_the_mesh_leaves_is_no_second_moment() -> None:
    """Three per cent at one corner, where moments differ by ten per cent between cells, are named;
    more are drawn.
    """
    for second, drawn in ((0.03, 1), (0.5, 2)):
        fields = {"M_1": np.ones(4), "M_2": np.array([second, 0.0, 0.0, 0.0])}
        shown, said = moments(replace(plate(0.0), fields=fields, jump=0.1), 0.01)
        assert len(shown) == drawn
        assert ("The smaller principal moment is zero but for the mesh." in said) == (drawn == 1)


def test_numbers_of_a_short_bar_do_not_touch() -> None:
    """Beside -16.7 and 16.7 there is room for a zero, not for ten."""
    figure = Figure(figsize=(2.2, 2.0))
    box = figure.add_axes((0.2, 0.5, 0.5, 0.1))
    colour_bar(figure, box, Scale((-16.7, 16.7), SIGNED, "true stress"))
    assert [label.get_text() for label in box.get_xticklabels()] == ["−16.7", "0", "16.7"]


def test_a_bar_with_two_signs_shows_its_zero() -> None:
    """Unless the number of an end is there; at both kinds of bars."""
    for orientation in ("horizontal", "vertical"):
        shown = []
        for low in (-1.4, -0.1):
            figure = Figure(figsize=(4.0, 4.0))
            box = figure.add_axes((0.2, 0.2, 0.6, 0.6))
            colour_bar(figure, box, Scale((low, 20.0), SIGNED, "w"), orientation)
            axis = box.xaxis if orientation == "horizontal" else box.yaxis
            shown.append([label.get_text() for label in axis.get_ticklabels()])
        assert ["0" in numbers for numbers in shown] == [True, False]
        assert [numbers[0] for numbers in shown] == ["−1.4", "−0.1"]


def bars(surface: Surface, sizes: CaseSizes, *names: str, **style: Any) -> dict[str, list[str]]:
    """Caption of each colour bar -> its numbers."""
    shown = figures(surface, 0.01, OutputSection(**style), Camera(ABOVE), names, sizes)
    return {
        axes.get_title(): [label.get_text() for label in axes.get_xticklabels()]
        for figure in shown.values()
        for axes in figure.axes
        if axes.get_title()
    }


def test_bars_have_the_units_of_a_case() -> None:
    """By hand, of R = 20 mm, h = 0.2 mm, E = 1.2 MPa, nu = 0.5, in a field of lambda_m = -0.01."""
    sizes, values = CaseSizes(0.5, 100.0, 0.02, 1.2e6), np.array([0.0, 1.0, 2.0, 3.0])
    fields = {
        **dict.fromkeys(("M_1", "sigma_1", "contact_pressure", "p_mag"), values),
        "M_2": -values,
        "gap_over_h": np.zeros(4),
        "Br": np.tile([1.0, 0, 0], (4, 1)),
        "Ba": np.tile([0, 0.01, 0], (4, 1)),
    }
    surface = replace(plate(0.1), fields=fields)
    row: Row = {"lambda_m": -0.01, "field_angle": 0.0}
    found = bars(surface, sizes_at(sizes, surface, field_at(row)))
    stiffness = 1.2e6 * 0.2e-3**3 / (12 * 0.75)
    moment = f"{1e6 * 2.5 * stiffness / 0.02:.3g}"  # of the colours' limit, without a peak
    assert {caption: (texts[0], texts[-1]) for caption, texts in found.items()} == {
        "inward normal displacement  $w$  (mm)": ("0", "2"),
        "larger principal moment  $M_\\mathrm{1}$  (µN)": ("0", moment),
        "smaller principal moment  $M_\\mathrm{2}$  (µN)": (f"−{moment}", "0"),
        "true stress  $\\sigma_\\mathrm{1}$  (MPa)": ("0", "3.6"),
        "gap  (mm)": ("0", "0.2"),
        "contact pressure  $p$  (kPa)": ("0", "36"),
        "couple  (N/m)": ("0", "2.4"),
        "magnetic pressure  $p_\\mathrm{mag}$  (kPa)": ("−36", "0"),
    }
    # what has no unit in a field that has turned, in an uneven shell, or without a modulus, is over
    # its own
    turned = sizes_at(sizes, surface, field_at(row | {"field_angle": 30.0}))
    captions = bars(surface, turned, "magnetic_loads")
    assert list(captions) == ["couple  (N/m)", field_caption("p_mag")]
    uneven = sizes_at(replace(sizes, has_one_thickness=False), surface, field_at(row))
    assert list(bars(surface, uneven, "magnetic_loads")) == [
        field_caption("couple"),
        "magnetic pressure  $p_\\mathrm{mag}$  (kPa)",
    ]
    without_modulus = bars(surface, replace(sizes, E=nan), "shell", "moments")
    assert list(without_modulus)[1:] == [field_caption("M_1"), field_caption("M_2")]
    assert "inward normal displacement  $w$  (mm)" in without_modulus
    # ranges are over units
    wide = bars(surface, sizes, "shell", ranges={"w_over_h": [0.0, 20.0]})
    assert next(iter(wide.values()))[-1] == "4"


def test_arrows_are_apart() -> None:
    r = np.random.default_rng(0).random((500, 3))
    chosen = r[spread_points(r, 0.3)]
    distance = np.linalg.norm(chosen[:, None] - chosen, axis=2)
    assert distance[~np.eye(len(chosen), dtype=bool)].min() >= 0.3
    assert np.linalg.norm(r[:, None] - chosen, axis=2).min(axis=1).max() < 0.3


def test_the_load_factor_tells_the_load() -> None:
    """Forces in one direction are added; of forces in several, and without units, nothing is."""
    sizes, row = CaseSizes(0.5, 100.0, 0.01, 1e6), dict[str, float | int | str]()

    def load(*forces: list[float], units: CaseSizes = sizes) -> str:
        loads = [{"at": "A", "force": force} for force in forces]
        return load_at_factor_one({"loading": [{"kind": "dead", "loads": loads}]}, units)

    assert load([0, 0, -0.02], [0, 0, -0.03]) == "50 mN"
    assert load([0, 0, -0.02], [0, 0, 0.03]) == load([0, 0, -1], units=NO_UNITS) == ""
    factor = quantity("load_factor")
    assert axis_label(factor, row, load="50 mN") == "load factor  ($\\times$ 50 mN)"
    assert label(factor, row, "the pole", "50 mN") == "load factor (× 50 mN)"
    assert axis_label(factor, row) == label(factor, row, "the pole") == "load factor"


def test_captions_tell_the_load() -> None:
    row: Row = {
        "lambda_m": 0.0,
        "field_angle": 0.0,
        "p_over_pc": 0.0,
        "amplitude": "load",
        "load_factor": 0.5,
    }
    assert "load factor = 0.5, $w/h$ = 3" in caption(0.01, 0.3, row | {"w_over_h": 3.0})
    row |= {"field_angle": 45.0, "amplitude": "force", "force": 2.5, "w_over_h": 7.0}
    assert caption(0.01, 0.3, row).count("45") == 1
    assert "$F R/(2\\pi D)$ = 2.5, $w/h$ = 7 at the load" in caption(0.01, 0.3, row)
    row |= {"gravity": 1e-4, "gravity_m_per_s2": 9.81}
    assert caption(0.01, 0.3, row, ["force", "gravity"]).endswith("$w/h$ = 7, $g$ = 9.81 m/s²")


def test_names_are_no_mathematics() -> None:
    """A point's name is drawn as it is written; as mathematics this one would end a run with a
    traceback.
    """
    row: Row = {
        "point": 0,
        "label": "field",
        "amplitude": "lambda_m",
        "mode": "",
        "branch": 0,
        "negative_pivots": 0,
        "A$x_y^$_ux": 0.0,
    }
    figure = curve_figure(
        [row | {"lambda_m": x, "w_pole_over_h": x} for x in (0.0, 1.0)], "lambda_m", STYLE
    )
    png(figure)
    assert figure.axes[0].get_xlabel() == r"displacement of A\$x_y^\$  $w/h$"


def test_moments_have_no_displacement_of_their_own() -> None:
    """Their w_over_h is that of the first named point, and so says the curve."""
    row: Row = {
        "point": 0,
        "label": "step",
        "amplitude": "load",
        "mode": "",
        "branch": 0,
        "negative_pivots": 0,
        "A_ux": 0.0,
    }
    for pole, said in (
        (1.0, "displacement of A  $w/h$"),
        (0.5, "displacement along the loads  $w/h$"),
    ):
        path = [
            row | {"load_factor": x, "w_over_h": x, "w_pole_over_h": pole * x} for x in (0.0, 1.0)
        ]
        assert curve_figure(path, "load", STYLE).axes[0].get_xlabel() == said


def test_unstable_from_the_first_bifurcation_on() -> None:
    """A mode that the model excludes crosses between two points: the curve is dashed from there,
    and solid before.
    """
    row: Row = {
        "amplitude": "pressure",
        "label": "step",
        "mode": "",
        "branch": 0,
        "negative_pivots": 0,
    }
    places = [("", 0, 0.0), ("", 0, 0.1), ("m = 3", 0, 0.15), ("m = 4", 1, 0.16), ("", 2, 0.2)]
    path = [
        row | {"point": i, "mode": mode, "excluded_pivots": count, "p_over_pc": x,
               "volume_change": -x}
        | ({"label": "bifurcation"} if mode else {})
        for i, (mode, count, x) in enumerate(places)
    ]  # fmt: skip
    lines = [
        line
        for line in curve_figure(path, "pressure", STYLE).axes[0].lines
        if len(line.get_xdata()) > 2
    ]
    ends = {line.get_linestyle(): (line.get_xdata()[0], line.get_xdata()[-1]) for line in lines[:2]}
    assert ends["-"] == pytest.approx((0.0, 0.15), abs=0.005)
    assert ends["--"] == pytest.approx((0.15, 0.2), abs=0.005)


def test_instabilities_are_numbered_along_the_whole_path() -> None:
    """On the curve of the last step too; the legend is above the axes, and nothing is cut off."""
    row: Row = {
        "amplitude": "pressure",
        "mode": "",
        "branch": 0,
        "negative_pivots": 0,
        "p_over_pc": 0.0,
    }
    labels = ["start", "fold", "field", "step", "bifurcation", "target"]
    path = [
        row | {"point": i, "label": label, "volume_change": -0.1 * i}
        for i, label in enumerate(labels)
    ]
    figure = curve_figure(
        [each | {"amplitude": "lambda_m"} for each in path[:3]] + path[3:], "pressure", STYLE
    )
    axes = figure.axes[0]
    assert [text.get_text() for text in axes.texts] == ["2"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["bifurcation"]
    figure.draw_without_rendering()
    assert figure.legends[0].get_window_extent().y0 >= axes.get_window_extent().y1
    whole = figure.get_tightbbox()
    assert whole.x0 >= 0
    assert whole.y0 >= 0
    assert whole.x1 <= figure.get_figwidth()
    assert whole.y1 <= figure.get_figheight()


HOLE = {"geometry": "cap", "hole": 5}


@pytest.mark.parametrize(
    ("shape", "said"), [({"geometry": "strip"}, "the tip"), (HOLE, "the watched point")]
)
def test_there_is_a_pole_only_where_there_is_one(shape: dict[str, Any], said: str) -> None:
    row: Row = {
        "point": 0,
        "label": "field",
        "amplitude": "lambda_m",
        "mode": "",
        "branch": 0,
        "negative_pivots": 0,
    }
    path = [row | {"lambda_m": x, "w_pole_over_h": x} for x in (0.0, 1.0)]
    label = curve_figure(path, "lambda_m", STYLE, pole_of({"shell": shape})).axes[0].get_xlabel()
    assert label == f"displacement of {said}  $w/h$"


def test_fields_are_read_as_they_were_written(tmp_path: Path) -> None:
    surface = plate(0.1)
    T = np.random.default_rng(0).random((4, 3, 3))
    surface.fields.update(
        {"E": T + np.swapaxes(T, 1, 2), "k": np.arange(4.0), "Br": T[0, [0, 1, 2, 0]]}
    )
    mirror = np.array([0.6, 0.8, 0.0])
    series = FieldSeries(tmp_path, ShellData(0.01, 0.3, mirror))
    series.write(0, surface)
    same, about = read_vtu(tmp_path / point_file(0))
    assert (about.h, about.nu, about.mirror.tolist()) == (0.01, 0.3, mirror.tolist())  # type: ignore[union-attr]
    for one, other in ((same.r0, surface.r0), (same.u, surface.u), (same.cells, surface.cells)):
        assert one == pytest.approx(other, abs=1e-15)
    assert same.fields.keys() == surface.fields.keys()
    for name, values in surface.fields.items():
        assert (same.fields[name] == values).all()
    grid = pyvista.read(tmp_path / point_file(0))
    assert np.asarray(grid.points) == pytest.approx(surface.r0)
    warped = grid.warp_by_vector("u")
    assert np.asarray(warped.points) == pytest.approx(surface.r0 + surface.u)
    assert {"u: R", "u_over_h: h", "E: 1", "k: h E lambda_m"} <= set(grid.field_data["units"])
    whole = completed(same, mirror)
    assert whole.fields["E"][4:] == pytest.approx(_mirrored(surface.fields["E"], mirror))


def _mirrored(T: Array, m: Array) -> Array:
    Q = np.eye(3) - 2 * np.outer(m, m)
    return np.einsum("ai,nij,bj->nab", Q, T, Q)


def test_paraviews_time_is_the_load_and_the_whole_shell_is_there(tmp_path: Path) -> None:
    """The pressure where it rises, the points where it turns back; a half and its image in one
    file.
    """
    mirror, surface = np.array([0.0, 1.0, 0.0]), plate(0.1)
    surface = replace(surface, r0=surface.r0 + np.array([0.0, 1.0, 0.0]))
    (tmp_path / "fields").mkdir()
    rows: list[Row] = [
        dict.fromkeys(COLUMNS, 0) | dict.fromkeys(TEXTS, "") | {"point": i} for i in range(3)
    ]
    rows = [
        row | {"amplitude": "pressure" if i else "", "p_over_pc": 0.2 * i}
        for i, row in enumerate(rows)
    ]
    series = FieldSeries(tmp_path / "fields", ShellData(0.01, 0.3, mirror, 0.03))
    table = PathTable(tmp_path / "path.csv")
    for i, row in enumerate(rows):
        series.write(i, surface, row)
        table.write(row)
    table.close()
    reader = pyvista.get_reader(tmp_path / "fields/path.pvd")
    assert reader.time_values == [0.0, 0.2, 0.4]
    again = FieldSeries(tmp_path / "fields", ShellData(0.01, 0.3, mirror, 0.03), rows=rows[:2])
    assert again.complete_points == 2
    again.write(2, surface, {**rows[2], "p_over_pc": 0.1})
    assert pyvista.get_reader(tmp_path / "fields/path.pvd").time_values == [0.0, 1.0, 2.0]
    assert write_whole_shells(tmp_path) == [
        "whole_0000.vtu",
        "whole_0001.vtu",
        "whole_0002.vtu",
        "whole.pvd",
    ]
    whole = pyvista.read(tmp_path / "fields/whole_0001.vtu")
    assert whole.n_cells == 2 * len(surface.cells)
    assert whole.bounds[2:4] == pytest.approx((-2.0, 2.0))
    assert whole.field_data["R_in_m"] == pytest.approx([0.03])

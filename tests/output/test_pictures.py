"""Views of a shell: where its axes and its colours are."""

import io
import os
import shutil
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface, completed
from magshell_fenicsx.output.fields.vtu import About, FieldSeries, point_file, read_vtu
from magshell_fenicsx.output.pictures.captions import caption
from magshell_fenicsx.output.pictures.curve import curve_figure
from magshell_fenicsx.output.pictures.layout import png
from magshell_fenicsx.output.pictures.picture import PICTURES, _spread, figures, towards
from magshell_fenicsx.output.pictures.render import MARGIN, View, axes_on_screen, rendered, screen, smooth_surface
from magshell_fenicsx.output.store.table import Row

Array = NDArray[np.float64]
on_a_screen = pytest.mark.skipif(shutil.which("Xvfb") is None, reason="no screen to draw on")
SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
ABOVE = np.array([0.0, -1e-3, 1.0])


def plate(w: float) -> Surface:
    """A flat square in two triangles, displaced by w along -e3."""
    down = np.array([0.0, 0.0, -1.0])
    return Surface(SQUARE, np.tile(w * down, (4, 1)), np.tile(-down, (4, 1)), np.array([[0, 1, 2], [0, 2, 3]]), {})


def test_axes_on_the_screen() -> None:
    """Seen along -e1 (the eye on e1): e1 points to the eye, e2 to the right, e3 up; from e2, e1 to the left."""
    assert axes_on_screen(np.array([2.0, 0, 0])) == pytest.approx(np.array([[0, 0], [1, 0], [0, 1]]))
    assert axes_on_screen(np.array([0, 3.0, 0])) == pytest.approx(np.array([[-1, 0], [0, 0], [0, 1]]))


def test_a_place_is_seen_from_its_side() -> None:
    for azimuth in (0.0, 2.0, -1.0):
        place = np.array([np.cos(azimuth), np.sin(azimuth), 0.5])
        assert towards(place) @ place > 3 * np.linalg.norm(place)


@on_a_screen
def test_views_have_their_colours_and_no_white_around() -> None:
    """The last colour of the map is a red, the first a blue; sizes are those of each view."""
    smooth = smooth_surface(plate(0.0), 1.0)
    views = [
        View(smooth, np.full(4, value), (-1.0, 1.0), "RdBu_r", ABOVE, size) for value, size in ((1, 300), (-1, 500))
    ]
    red, blue = rendered(views)
    for image in (red, blue):
        assert (image[0] == 255).all()
        assert (image[:, 0] == 255).all()
        assert (image[MARGIN + 5, MARGIN + 5] < 200).any()
    centre = [image[image.shape[0] // 2, image.shape[1] // 2].astype(int) for image in (red, blue)]
    assert centre[0][0] > centre[0][2] + 50
    assert centre[1][2] > centre[1][0] + 50
    assert len(blue) / len(red) == pytest.approx(500 / 300, rel=0.1)


@on_a_screen
def test_a_display_that_is_gone_is_not_drawn_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one that a closed ssh -X has left; VTK would end the process."""
    monkeypatch.setenv("DISPLAY", ":7654")
    with screen():
        assert os.environ["DISPLAY"] != ":7654"
    assert os.environ["DISPLAY"] == ":7654"


@on_a_screen
def test_what_there_is_is_drawn() -> None:
    surface = plate(0.1)
    assert list(figures(surface, 0.01, "title")) == ["shell"]
    surface.fields["p_mag"] = np.arange(4.0)
    surface.fields.update(dict.fromkeys(("E_1", "E_2", "M_1", "M_2"), np.arange(4.0)))
    surface.fields.update({"Br": np.eye(4)[:, :3], "Ba": np.zeros((4, 3))})
    drawn = figures(surface, 0.01, "title")
    assert list(drawn) == [name for name in PICTURES if name != "contact"]
    height, width = matplotlib.image.imread(io.BytesIO(png(drawn["moments"]))).shape[:2]
    assert width > 600
    assert height > 300
    assert list(figures(surface, 0.01, "title", ["strains"])) == ["strains"]
    said = [text.get_text() for text in drawn["fields"].texts]
    assert any("remanence" in text for text in said)
    assert not any("applied" in text for text in said)  # a field of length zero


def limits(E_1: Array, E_2: Array) -> tuple[float, float]:
    surface = plate(0.0)
    surface.fields.update({"E_1": E_1, "E_2": E_2})
    first, second = PICTURES["strains"].views(surface, smooth_surface(surface, 1.0), 1.0)
    assert first.limits == second.limits
    return first.limits


def test_rounding_is_no_pattern() -> None:
    """Strains that are zero are white, and those of one value one colour; colours are white at zero."""
    noise = np.array([1.0, -1, 0.5, 0])
    assert limits(1e-15 * noise, 1e-15 * noise) == (-1, 1)
    low, high = limits(0.02 + 1e-12 * noise, 1e-15 * noise)
    assert high == pytest.approx(0.02)
    assert low == -high


def test_arrows_are_apart() -> None:
    r = np.random.default_rng(0).random((500, 3))
    chosen = r[_spread(r, 0.3)]
    distance = np.linalg.norm(chosen[:, None] - chosen, axis=2)
    assert distance[~np.eye(len(chosen), dtype=bool)].min() >= 0.3
    assert np.linalg.norm(r[:, None] - chosen, axis=2).min(axis=1).max() < 0.3


def test_captions_tell_the_load() -> None:
    row: Row = {"lambda_m": 0.0, "field_angle": 0.0, "p_over_pc": 0.0, "amplitude": "load", "load_factor": 0.5}
    assert "load factor = 0.5, $w/h$ = 3" in caption(0.01, 0.3, row | {"w_over_h": 3.0})
    row |= {"field_angle": 45.0, "amplitude": "force", "force": 2.5, "w_over_h": 7.0}
    assert caption(0.01, 0.3, row).count("45") == 1
    assert "$F R/(2\\pi D)$ = 2.5, $w/h$ = 7 at the load" in caption(0.01, 0.3, row)


def test_names_are_no_mathematics() -> None:
    """A point's name is drawn as it is written; as mathematics this one would end a run with a traceback."""
    row: Row = {
        "label": "field",
        "amplitude": "lambda_m",
        "mode": "",
        "branch": 0,
        "negative_pivots": 0,
        "A$x_y^$_ux": 0.0,
    }
    figure = curve_figure([row | {"lambda_m": x, "w_pole_over_h": x} for x in (0.0, 1.0)], "lambda_m", "")
    png(figure)
    assert figure.axes[0].get_xlabel() == r"displacement of A\$x_y^\$  $w/h$"


def test_moments_have_no_displacement_of_their_own() -> None:
    """Their w_over_h is that of the first named point, and so says the curve."""
    row: Row = {"label": "step", "amplitude": "load", "mode": "", "branch": 0, "negative_pivots": 0, "A_ux": 0.0}
    for pole, said in ((1.0, "displacement of A  $w/h$"), (0.5, "displacement along the loads  $w/h$")):
        path = [row | {"load_factor": x, "w_over_h": x, "w_pole_over_h": pole * x} for x in (0.0, 1.0)]
        assert curve_figure(path, "load", "").axes[0].get_xlabel() == said


def test_fields_are_read_as_they_were_written(tmp_path: Path) -> None:
    surface = plate(0.1)
    T = np.random.default_rng(0).random((4, 3, 3))
    surface.fields.update({"E": T + np.swapaxes(T, 1, 2), "k": np.arange(4.0), "Br": T[0, [0, 1, 2, 0]]})
    mirror = np.array([0.6, 0.8, 0.0])
    series = FieldSeries(tmp_path, About(0.01, 0.3, mirror))
    series.write(0, surface)
    same, about = read_vtu(tmp_path / point_file(0))
    assert (about.h, about.nu, about.mirror.tolist()) == (0.01, 0.3, mirror.tolist())  # type: ignore[union-attr]
    for one, other in ((same.r0, surface.r0), (same.u, surface.u), (same.cells, surface.cells)):
        assert one == pytest.approx(other, abs=1e-15)
    assert same.fields.keys() == surface.fields.keys()
    for name, values in surface.fields.items():
        assert (same.fields[name] == values).all()
    whole = completed(same, mirror)
    assert whole.fields["E"][4:] == pytest.approx(_mirrored(surface.fields["E"], mirror))


def _mirrored(T: Array, m: Array) -> Array:
    Q = np.eye(3) - 2 * np.outer(m, m)
    return np.einsum("ai,nij,bj->nab", Q, T, Q)

"""Views of a shell: where its axes and its colours are."""

import io
import shutil

import matplotlib.image
import numpy as np
import pytest

from magshell_fenicsx.results.picture import draw_deformed, towards
from magshell_fenicsx.results.render import MARGIN, View, axes_on_screen, rendered, smooth_surface
from magshell_fenicsx.results.surface import Surface

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


@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="no screen to draw on")
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


@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="no screen to draw on")
def test_loads_are_drawn_where_there_are_any() -> None:
    shell, loads = draw_deformed(plate(0.1), 0.01, "title")
    assert loads is None
    surface = plate(0.1)
    surface.fields["p_mag"] = np.arange(4.0)
    same, loads = draw_deformed(surface, 0.01, "title")
    assert same == shell
    assert loads is not None
    height, width = matplotlib.image.imread(io.BytesIO(loads)).shape[:2]
    assert width > 600
    assert height > 300

"""Fields that are their own mirror images, or axisymmetric, are told from those that are not."""

import numpy as np
import pytest
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.shape.field_symmetry import formula_field, is_axisymmetric, is_mirror_image
from magshell_fenicsx.shape.meridian_chart import MeridianChart

Array = NDArray[np.float64]
PLACES = np.random.default_rng(5).uniform(-1, 1, (60, 3))


def hemisphere(narrow_places: Array | None = None) -> MeridianChart:
    """Return the meridian of the unit hemisphere, by its polar angle."""

    def place(chart: Array) -> Array:
        s = chart[:, 0]
        return np.stack([np.sin(s), 0 * s, np.cos(s)], axis=-1)

    return MeridianChart(
        np.pi / 2,
        (),
        (None, "equator"),
        place,
        place,
        lambda x: (float(np.hypot(x[0], x[1])), float(np.arctan2(x[1], x[0]))),
        narrow_places=np.zeros((0, 3)) if narrow_places is None else narrow_places,
    )


@pytest.mark.parametrize(
    ("components", "sign", "is_image"),
    [
        ("x**2 + y", 1.0, True),
        ("x**2 + y", -1.0, False),
        ("x*z", 1.0, False),
        ("x*z", -1.0, True),
        (0.25, 1.0, True),
        ("y + 1e-12*x", 1.0, True),
        ("y + 1e-6*x", 1.0, False),
        (["x", "y", "z"], 1.0, True),
        (["x", "y", "z"], -1.0, False),
        (["1", "0", "0"], -1.0, True),
        ([1, "x", 0], 1.0, False),
        ("1/(x - x)", 1.0, False),
    ],
)
def test_mirror_images(components: list[str] | str | float, sign: float, is_image: bool) -> None:
    """In the plane x = 0; a vector is reflected, and what has no value is no image."""
    plane = Mirror(np.array([1.0, 0.0, 0.0]), 0.0, {})
    assert is_mirror_image(formula_field(components), plane, PLACES, sign=sign) is is_image


def test_plane_off_the_origin_and_another_unit() -> None:
    """Images are in the plane itself, and formulas take places in their own unit of length."""
    plane = Mirror(np.array([1.0, 0.0, 0.0]), 0.5, {})
    assert is_mirror_image(formula_field("(x - 10)**2", 20.0), plane, PLACES)
    assert not is_mirror_image(formula_field("(x - 10)**2"), plane, PLACES)
    left, right = formula_field("exp(x)"), formula_field("exp(1 - x)")
    assert is_mirror_image(left, plane, PLACES, image=right)


@pytest.mark.parametrize(
    ("components", "is_same"),
    [
        ("x**2 + y**2 + z", True),
        ("x", False),
        ("(x**2 + y**2)**3*cos(60*z) + 1e-13*x", True),
        ("z + 1e-6*(x**3 - 3*x*y**2)", False),
        (["x", "y", "0"], True),
        (["0", "0", "1"], True),
        (["-y", "x", "0"], False),
        (["1", "0", "0"], False),
    ],
)
def test_axisymmetry(components: list[str] | str, is_same: bool) -> None:
    """A vector field around e3 is the same at all azimuths, but no meridian has it."""
    assert is_axisymmetric(formula_field(components), hemisphere()) is is_same
    assert is_axisymmetric(formula_field(components), hemisphere(), is_smooth=True) is is_same
    assert not is_axisymmetric(formula_field(components), None)


def test_places_off_the_surface() -> None:
    """On the unit sphere the first field is zero: it is seen beside the surface alone."""
    field = formula_field(["(x**2 + y**2 + z**2 - 1)", "0", "0"])
    assert not is_axisymmetric(field, hemisphere(), in_space=True)


def test_narrow_places_are_looked_at() -> None:
    """A bump between all samples is found where its place is known."""
    place = np.array([[0.5996, 0.0113, 0.8002]])
    width = "1e8*((x - 0.5996)**2 + (y - 0.0113)**2)"
    bump = formula_field(f"1 + exp(-{width})")
    assert is_axisymmetric(bump, hemisphere())
    assert not is_axisymmetric(bump, hemisphere(place))

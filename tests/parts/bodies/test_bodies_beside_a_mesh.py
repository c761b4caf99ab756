"""A body beside a mesh file stands on the nearest node's normal, half a thickness from there."""

import numpy as np
import pytest
from conftest import CASES

from magshell_fenicsx import Case

BRACKET = {
    "geometry": "mesh", "file": str(CASES.parent / "meshes" / "bracket.msh"), "radius": 1,
    "thickness": 0.02, "youngs_modulus": 1, "poisson_ratio": 0.3,
}  # fmt: skip


@pytest.mark.parametrize(
    ("point", "normal"), [([0, 0.2, 0.5], [1, 0, 0]), ([0.5, 0.2, 1], [0, 0, 1])]
)
@pytest.mark.parametrize("side", ["outside", "inside"])
def test_on_each_sheet(point: list[float], normal: list[float], side: str) -> None:
    """The flange of the bracket has the plane x = 0, its shelf z = 1; the sides of both are
    opposite.
    """
    ball = {"kind": "sphere", "radius": 0.1, "at": {"point": point}, "side": side}
    case = {
        "shell": BRACKET,
        "boundary": {"root": "clamped"},
        "bodies": {"ball": ball},
        "loading": {"kind": "contact", "approach": 1},
    }
    (contact,) = Case.from_source(case).problem().loads.contacts
    out = contact.front - np.array(point)
    assert np.linalg.norm(out) == pytest.approx(0.01)
    assert abs(out @ np.array(normal)) == pytest.approx(0.01, rel=1e-9)
    assert contact.direction == pytest.approx(-out / 0.01, abs=1e-9)
    assert contact.distance(np.array([point]))[0][0] == pytest.approx(0.01)

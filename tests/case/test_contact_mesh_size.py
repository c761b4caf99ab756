"""Shells that may touch have small elements where they are nearest to each other."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from magshell_fenicsx import Case
from magshell_fenicsx.case.contact_mesh_size import CONTACT_CELL_SIZE, ChartedShell, contact_places
from magshell_fenicsx.case.member_meshes import MemberMeshes
from magshell_fenicsx.parts.shell_outline import outline

Array = NDArray[np.float64]
h = 0.02
RIM = {"boundary": {"rim": "clamped"}}
CAP = {"geometry": "cap", "polar": 60, "radius": 1, "thickness": h, "poisson_ratio": 0.3}
PRESSED = {"kind": "pressure", "pressure": 0.1, "until": "target", "points": 1}


def cells_near_poles(**others: Any) -> Array:
    """Mean length of the sides of the cells around the poles of two caps, over sqrt(R h) of the
    lower and the upper.
    """
    cap = {
        "geometry": "cap",
        "polar": 20,
        "thickness": h,
        "youngs_modulus": 1,
        "poisson_ratio": 0.3,
    }
    over = {"position": [0, 0, 2.4 + 1.2 * h], "axis": {"polar": 180}}
    shells = {
        "lower": {"shell": cap | {"radius": 1}, **RIM},
        "upper": {"shell": cap | {"radius": 1.4}, **RIM, "place": over},
    }
    case = Case.from_source({"shells": shells, "symmetry": "half", "loading": PRESSED, **others})
    mesh = case.problem().triangulated()
    corners = mesh.nodes[mesh.cells[:, :3]][:, :, :3]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(axis=1)
    middle, lower = corners.mean(axis=1), corners[:, :, 2].max(axis=1) <= 1
    near = np.hypot(*middle[:, :2].T) < np.sqrt(h)
    return np.array(
        [sides[near & lower].mean() / np.sqrt(h), sides[near & ~lower].mean() / np.sqrt(1.4 * h)]
    )


def test_cells_are_small_where_caps_meet() -> None:
    """0.5 sqrt(R h) at both poles; those of caps that do not touch are larger."""
    met, alone = cells_near_poles(contact=[["upper", "lower"]]), cells_near_poles()
    assert met == pytest.approx(CONTACT_CELL_SIZE, rel=0.2)
    assert alone.min() > 1.5 * CONTACT_CELL_SIZE


def test_faces_that_are_parallel_have_no_place_where_they_meet() -> None:
    """A line of places across a flat one is nearest at its one end, if it is inclined; all are if
    not.
    """
    x = np.linspace(0, 1, 41)
    flat, inclined = np.column_stack([x, 0 * x, 0 * x]), np.column_stack([x, 0 * x, 0.1 + x])
    thickness, apart = {"a": 0.1, "b": 0.1}, {"a": 0.2, "b": 0.2}
    found = contact_places([["a", "b"]], {"a": flat, "b": inclined}, thickness, apart, {})
    assert [each.tolist() for each in found["b"]] == [[0, 0, 0.1]]
    far = contact_places(
        [["a", "b"]], {"a": flat, "b": inclined + np.array([0, 0, 3])}, thickness, apart, {}
    )
    assert far == {"a": [], "b": []}
    assert contact_places(
        [["shell", "shell"]], {"a": flat, "b": flat + 0.1}, thickness, apart, {}
    ) == {
        "a": [],
        "b": [],
    }


@pytest.mark.parametrize("off", [0.0, 0.17])
def test_the_place_is_that_of_spheres(off: float) -> None:
    """Of two caps, one beside the axis of the other, on the line between their centres; 1e-3."""
    cap = outline(Case.from_source({"shell": CAP, "loading": PRESSED, **RIM}).shell)
    centre = np.array([off, 0.0, np.sqrt(2.03**2 - off**2)])

    def above(x: Array) -> Array:
        return x * [1, -1, -1] + centre

    def under(x: Array) -> Array:
        return (x - centre) * [1, -1, -1]

    places = {"a": cap.sample(), "b": above(cap.sample())}
    charted = {
        "a": ChartedShell(cap, lambda x: x, lambda x: x),
        "b": ChartedShell(cap, above, under),
    }
    found = contact_places(
        [["a", "b"]], places, dict.fromkeys("ab", 0.02), dict.fromkeys("ab", 0.3), charted
    )
    assert found["a"][0] == pytest.approx(centre / 2.03, abs=1e-3)
    assert found["b"][0] == pytest.approx(centre - centre / 2.03, abs=1e-3)


def test_the_place_of_thick_faces() -> None:
    """A flat sheet above one that is thickest beside the middle: there; 1e-4."""
    plate = {
        "geometry": "plate",
        "length": 1,
        "width": 1,
        "thickness": h,
        "poisson_ratio": 0.3,
        "youngs_modulus": 1,
    }
    held = {"boundary": {"left": "clamped"}}
    thick = {
        "shell": plate | {"thickness_factor": "1 + 3*exp(-20*((x - 0.3)**2 + (y - 0.6)**2))"},
        **held,
    }
    flat = {"shell": plate, "place": {"position": [0, 0, 3 * h]}, **held}
    data = {
        "shells": {"thick": thick, "flat": flat},
        "contact": [["thick", "flat"]],
        "loading": PRESSED,
    }
    several = Case.from_source(data).several
    assert several
    met = MemberMeshes(several)._contact_places_of_shells
    assert met["thick"][0] == pytest.approx([0.3, 0.6, 0], abs=1e-4)
    assert met["flat"][0] == pytest.approx([0.3, 0.6, 0], abs=1e-4)


@pytest.mark.parametrize("direction", [{}, {"direction": [1, 0, 0]}])
def test_cells_are_small_where_a_body_is_near(direction: dict[str, Any]) -> None:
    """A strip of several shells beside a bar: about a third of the bar's radius there, as a strip
    alone has; and larger without the bar.
    """
    plate = {"geometry": "plate", "length": 1, "width": 0.25, "thickness": 0.025}
    material = {"youngs_modulus": 1, "poisson_ratio": 0}
    data = {
        "shells": {"a": {"shell": plate | material, "boundary": {"left": "clamped"}}},
        "loading": {"kind": "edge", "moves": [{"supports": ["a.left"], "translation": [0, 0, 1]}]},
    }
    bar = {"kind": "cylinder", "radius": 0.15, "axis": [0, 1, 0], "position": [0.8, 0.1, 0.17]}

    def size(**others: Any) -> float:
        """Mean length of the sides of the cells below the bar."""
        mesh = Case.from_source({**data, **others}).problem().triangulated()
        corners = mesh.nodes[mesh.cells[:, :3]][:, :, :3]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(axis=1)
        return float(sides[abs(corners.mean(axis=1)[:, 0] - 0.8) < 0.1].mean())

    assert size(bodies={"bar": bar | direction}) == pytest.approx(0.05, rel=0.3)
    assert size() > 0.08

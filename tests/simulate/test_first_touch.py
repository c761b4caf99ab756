"""Shells that meet a body: loads go on where they are held, and no path creeps."""

from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case, Scene, Stopped
from magshell_fenicsx.simulate.follow import follow

h, LOAD = 0.02, 4e-5
CAP: dict[str, Any] = {
    "shell": {
        "geometry": "cap", "radius": 1, "polar": 30, "thickness": h, "youngs_modulus": 1,
        "poisson_ratio": 0.3,
    },
    "boundary": {"rim": "clamped"},
    "bodies": {
        "ball": {"kind": "sphere", "radius": 0.2, "position": [0, 0, 0.72], "direction": [0, 0, 1],
                 "side": "inside"}
    },
    "loading": {"kind": "dead", "loads": [{"force": [0, 0, -1]}], "factor": LOAD, "points": 1},
}  # fmt: skip


@pytest.mark.parametrize("hole", [0, 4])
def test_a_load_goes_on_at_a_ball(hole: float) -> None:
    """The pole's face is 3.5 h above the ball; what the load grows by from there on, the ball
    bears.

    A hole's edge meets the ball farther down, by the sphere's sag, less the shell's turn.
    """
    data = CAP | {
        "mesh": {"degree": 3, "refinement": 0.5} if hole else {"degree": 2, "refinement": 0.3}
    }
    at = {"edge": "hole"} if hole else {"at": "top"}
    (load,) = CAP["loading"]["loads"]
    data["loading"] = CAP["loading"] | {"loads": [load | at]}
    data |= {"shell": CAP["shell"] | {"hole": hole}} if hole else {"points": {"top": [0, 0, 1]}}
    scene = Scene(Case.from_source(data))
    passed = [
        (record.point.state.mu["load"], scene.observe(record.point.state))
        for record in follow(scene)
    ]
    *_, (load_at_end, end) = passed
    before = max(load for load, seen in passed if seen["force"] == 0)
    assert load_at_end == pytest.approx(LOAD, rel=1e-12)
    assert end["w_over_h"] == pytest.approx(3.5 if not hole else 4.01, abs=0.01)
    unit = 2 * np.pi * h**3 / 12 / (1 - 0.3**2)
    assert unit * end["force"] == pytest.approx(LOAD - before, rel=0.02)
    assert len(passed) < 60, "it does not creep"


STRIP: dict[str, Any] = {
    "shell": {
        "geometry": "strip", "radius": "20 mm", "width": "4 mm", "thickness": "0.4 mm",
        "youngs_modulus": "1 MPa", "poisson_ratio": 0,
    },
    "boundary": {"root": "clamped"},
    "bodies": {
        "bar": {
            "kind": "cylinder", "radius": "4 mm", "axis": [0, 1, 0],
            "position": ["12 mm", "0 mm", "-7 mm"], "direction": [0, 0, 1],
        }
    },
    "magnetic": {
        "remanent": {"polar": 90, "flux_density": "100 mT"},
        "applied": {"polar": 180, "flux_density": "2 mT"},
    },
    "mesh": {"degree": 3, "refinement": 0.6},
    "loading": {"kind": "field", "until": "target", "points": 2},
}  # fmt: skip


def test_a_field_bends_a_strip_onto_a_bar() -> None:
    """Its line of contact moves over the points of the mesh: they meet the bar and leave it again,
    and the path is no longer than the field needs.
    """
    scene = Scene(Case.from_source(STRIP))
    passed = [(record.label, scene.observe(record.point.state)) for record in follow(scene)]
    *_, (label, end) = passed
    assert label == "target"
    assert end["force"] > 0
    assert 0 < end["penetration_over_h"] < 1e-3
    assert len(passed) < 10, "it does not creep"


ARCH: dict[str, Any] = {
    "shell": {
        "geometry": "cylinder", "radius": 1, "length": 0.12, "thickness": h, "youngs_modulus": 1,
        "poisson_ratio": 0, "azimuth": [0, 180],
    },
    "boundary": {"left": "clamped", "right": "clamped", "bottom": "symmetry", "top": "symmetry"},
    "bodies": {"plate": {"kind": "plane", "at": {"point": [0, 1, 0.06]}}},
    "mesh": {"degree": 4, "size": 0.24},
    "loading": {"kind": "contact", "approach": 8, "points": 4},
}  # fmt: skip


def test_a_plate_flattens_half_a_ring() -> None:
    """Two lines of contact move apart over the points of the mesh."""
    scene = Scene(Case.from_source(ARCH))
    passed = [(record.label, scene.observe(record.point.state)) for record in follow(scene)]
    forces = [seen["force"] for label, seen in passed if label == "target"]
    assert len(forces) == 4
    assert np.all(np.diff(forces) > 0)
    assert len(passed) < 15, "it does not creep"


HOLE: dict[str, Any] = {
    "shell": CAP["shell"] | {"hole": 10},
    "boundary": {"hole": "clamped", "rim": "clamped"},
    "bodies": {
        "ball": {"kind": "sphere", "radius": 0.5, "position": [0, 0, 1.5], "direction": [0, 0, -1]}
    },
}
RIM: dict[str, Any] = {
    "shell": {"geometry": "disc", "radius_to_thickness": 20, "poisson_ratio": 0.3},
    "boundary": {"rim": "clamped"},
    "bodies": {
        "ball": {"kind": "sphere", "radius": 0.3, "position": [1, 0, 0.4], "direction": [0, 0, -1]}
    },
}


@pytest.mark.parametrize(
    ("case", "place"), [(HOLE, r"\(0.1736, 0, 0.9848\)"), (RIM, r"\(1, 0, 0\)")]
)
def test_a_ball_on_a_clamped_edge(case: dict[str, Any], place: str) -> None:
    """On a meridian and on a half: nothing gives way at the edge, whose place is named."""
    loading = {"kind": "contact", "approach": 5, "points": 1}
    data = case | {"mesh": {"degree": 3, "refinement": 0.3}, "loading": loading}
    with pytest.raises(Stopped, match=f"the body ball presses on a held place, {place}, over R"):
        list(follow(Scene(Case.from_source(data))))

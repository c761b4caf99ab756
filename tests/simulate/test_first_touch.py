"""A dead load presses a cap onto a ball by arc length: the load goes on where the shell is held."""

from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case, Scene
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

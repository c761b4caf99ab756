"""How motions begin and end: velocities by formula, columns at a value, instabilities, resumed
viscous motions.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_in_time import BEAM, PLATE, STRIP, case_of, columns_of

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.public import Scene, run
from magshell_fenicsx.simulate.transient import refuse_unknown_events

QUARTIC = ["0", "0", "(1 - x**2 - y**2)**2"]


@pytest.mark.parametrize("symmetry", ["axisymmetric", "half"])
def test_velocity_by_formula(symmetry: str) -> None:
    """The kinetic energy of (1 - r^2)^2 is pi/10, over rho h R^4. It has the disc's symmetry."""
    step = {"kind": "time", "duration": 1e-6, "points": 1, "velocity": QUARTIC}
    found = columns_of(
        case_of(PLATE, step, symmetry=symmetry, mesh={"degree": 4, "refinement": 0.3})
    )
    assert found["kinetic"][-1] == pytest.approx(np.pi / 10, rel=1e-4)


def test_velocity_without_symmetry() -> None:
    step = {"kind": "time", "duration": 1.0, "velocity": ["0", "0", "y"]}
    with pytest.raises(CaseError, match="differs around e3"):
        columns_of(case_of(PLATE, step, symmetry="axisymmetric"))


def test_event() -> None:
    """A cantilever that swings as cos omega t has half of its deflection after a sixth of the
    period.
    """
    period, push = 2 * np.pi / BEAM, {"mode": 1, "displacement": 0.01}
    event = {"column": "w_over_h", "value": -0.005}
    swing = {
        "kind": "time",
        "duration": period,
        "points": 8,
        "step": period / 200,
        "rho_inf": 1.0,
        "push": push,
    }
    found = columns_of(case_of(STRIP, swing | {"until": "event", "event": event}, symmetry="half"))
    assert found["label"][-1] == "target"
    assert found["w_over_h"][-1] == pytest.approx(event["value"], rel=1e-6)
    exact = period * (np.arccos(0.5) if found["w_over_h"][1] < 0 else np.arccos(-0.5)) / (2 * np.pi)
    assert found["time"][-1] == pytest.approx(exact, rel=2e-3)


def test_instability() -> None:
    """A pressure that rises past the fold of a cap: the first row whose state has an unstable
    direction is the last.
    """
    shell = {"geometry": "cap", "polar": 20, "radius": 1.0, "thickness": 0.02, "poisson_ratio": 0.3}
    base = {"shell": shell, "boundary": {"rim": "clamped"}, "mesh": {"refinement": 0.4}}
    ramp = {"pressure": {"kind": "ramp", "to": 1.0, "over": 2000.0}}
    step = {
        "kind": "time",
        "duration": 2000.0,
        "points": 100,
        "history": ramp,
        "until": "instability",
    }
    found = columns_of(case_of(base, step, symmetry="axisymmetric"))
    unstable = found["negative_pivots"] + found["excluded_pivots"]
    assert unstable[-1] > 0
    assert not unstable[:-1].any()
    assert found["label"][-1] == "target"


@pytest.mark.slow
def test_delay_of_a_cap() -> None:
    """Under a heavy drag the fold is passed late by the rate to the power of 2/3."""
    shell = {"geometry": "cap", "polar": 20, "radius": 1.0, "thickness": 0.02, "poisson_ratio": 0.3}
    base = {
        "shell": shell,
        "boundary": {"rim": "clamped"},
        "mesh": {"degree": 3, "refinement": 0.3},
    }
    late, times = [], (3000.0, 12000.0)
    for over in times:
        event = {"column": "w_pole_over_h", "value": 2.0}
        ramp = {"pressure": {"kind": "ramp", "to": 0.86, "over": over}}
        ending = {"until": "event", "event": event}
        step = {
            "kind": "time",
            "duration": over,
            "points": 20,
            "history": ramp,
            "drag": 2.0,
            **ending,
        }
        static = {
            "kind": "pressure",
            "control": "load",
            "until": "target",
            "pressure": 0.52,
            "points": 2,
        }
        late.append(
            columns_of(case_of(base, static, step, symmetry="axisymmetric"))["p_over_pc"][-1]
        )
    fold = columns_of(case_of(base, {"kind": "pressure"}, symmetry="axisymmetric"))["p_over_pc"][-1]
    exponent = np.log((late[0] - fold) / (late[1] - fold)) / np.log(times[1] / times[0])
    assert exponent == pytest.approx(2 / 3, abs=0.01)


MISTAKES: list[tuple[dict[str, Any], str]] = [
    ({"until": "event"}, "event: goes with until: event, which needs one"),
    (
        {"until": "event", "event": {"column": "weight", "value": 1.0}},
        "loading.0.event.column: weight: no such column",
    ),
    ({"velocity": ["t", "0", "0"]}, "velocity"),
]


def test_event_in_units() -> None:
    """A column in the case's units may end a step, and an unknown one is refused before any."""
    shell = {
        "geometry": "disc",
        "radius": "10 mm",
        "thickness": "0.2 mm",
        "youngs_modulus": "1 MPa",
        "poisson_ratio": 0.3,
        "density": "1000 kg/m^3",
    }
    step = {"kind": "time", "duration": "1 ms", "velocity": ["0", "0", "1"], "until": "event"}
    scene = Scene(
        case_of({**PLATE, "shell": shell}, step | {"event": {"column": "w_mm", "value": 1}})
    )
    refuse_unknown_events(scene, scene.unloaded())


@pytest.mark.parametrize(("given", "message"), MISTAKES)
def test_mistakes(given: dict[str, Any], message: str) -> None:
    with pytest.raises(CaseError) as error:
        columns_of(
            case_of(PLATE, {"kind": "time", "duration": 1.0, **given}, symmetry="axisymmetric")
        )
    assert message in str(error.value)


@pytest.mark.slow
def test_viscous_motion_resumed(tmp_path: Path, no_pictures: None) -> None:
    """Stopped by its time limit, with strains of a branch to remember: the same rows."""
    shell = STRIP["shell"] | {"relaxation": [{"modulus": 0.3, "time": 1 / BEAM}]}
    push = {"mode": 1, "displacement": 0.01}
    swing = {"kind": "time", "duration": 0.5 / BEAM, "points": 3, "push": push, "step": 0.1 / BEAM}
    case = case_of(
        STRIP | {"shell": shell, "mesh": {"degree": 2, "size": 0.5}}, swing, symmetry="half"
    )
    whole = run(case, tmp_path / "whole")
    first = run(case, tmp_path / "parts", time_limit=1e-9)
    assert first.stopped
    assert len(first.rows) < len(whole.rows)
    second = run(case, tmp_path / "parts", resume=True)
    for key in ("time", "w_over_h", "kinetic", "dissipated"):
        assert [row[key] for row in second.rows] == pytest.approx(
            [row[key] for row in whole.rows], rel=1e-9
        )

"""A source that turns as a whole: B(r) = Q b + Q G Q^T r."""

from math import cos, pi, sin
from typing import Any

import numpy as np
import pytest

import magshell_fenicsx as ms
from magshell_fenicsx.case.source import Source
from magshell_fenicsx.plan.turned import at_angle, harmonics
from magshell_fenicsx.simulate.direction import field_at

G = [[0.3, 0.2, 0.0], [0.2, 0.5, -0.4], [0.0, -0.4, -0.8]]
DISC = {"geometry": "disc", "radius_to_thickness": 20, "poisson_ratio": 0.3}
X, Y, Z = {"polar": 90}, {"polar": 90, "azimuth": 90}, {"polar": 0}


def rotation(axis: np.ndarray, t: float) -> np.ndarray:
    A = np.cross(np.eye(3), axis)
    return np.eye(3) + sin(t) * A + (1 - cos(t)) * A @ A


def test_harmonics() -> None:
    """Against Rodrigues' formula, which takes `before` to `after`."""
    before, after = np.array([0.6, 0.0, 0.8]), np.array([0.0, 1.0, 0.0])
    for t in (0.0, 0.4, 2.0):
        Q = rotation(np.cross(before, after), t)
        assert at_angle(harmonics(np.array(G), before, after), t) == pytest.approx(Q @ G @ Q.T, abs=1e-14)
    assert rotation(np.cross(before, after), pi / 2) @ before == pytest.approx(after)


def ended(applied: dict[str, Any], loading: Any, model: str = "shell") -> tuple[ms.Scene, Any]:
    magnetic = {"lambda_m": 1e-3, "remanent": {"polar": 30}, "applied": applied}
    mesh = {"degree": 3, "size": 0.6} if model == "shell" else {"size": 0.8}
    data = {"shell": DISC, "boundary": {"rim": "clamped"}, "magnetic": magnetic, "loading": loading, "mesh": mesh}
    scene = ms.Scene(ms.Case.from_source(Source("test", {**data, "symmetry": "none", "model": model})))
    *_, last = ms.follow(scene)
    return scene, last.point.state


@pytest.mark.parametrize("model", ["shell", "solid"])
def test_a_turned_source_is_a_source_that_stands_there(model: str) -> None:
    """From e1 to e2 and on to e3, against a case with that direction and that gradient from the start."""
    steps = [{"kind": "field"}, {"kind": "rotation", "to": Y, "points": 2}, {"kind": "rotation", "to": Z, "points": 2}]
    turned, state = ended({**X, "gradient": G}, steps, model)
    Q = rotation(np.eye(3)[0], pi / 2) @ rotation(np.eye(3)[2], pi / 2)
    assert Q[:, 0] == pytest.approx([0, 0, 1])
    standing, other = ended({**Z, "gradient": (Q @ G @ Q.T).tolist()}, [{"kind": "field"}], model)
    assert state.u == pytest.approx(other.u, abs=1e-9 * np.abs(other.u).max())
    here, there = turned.observe(state), standing.observe(other)
    for column in ("lambda_m", "magnetic", "energy"):
        assert here[column] == pytest.approx(there[column], rel=1e-9), column
    assert here["field_angle"] == pytest.approx(90)


def test_a_turned_source_switched_off_and_on() -> None:
    """Its gradient keeps its direction while its strength falls to zero and grows again."""
    steps: list[dict[str, Any]] = [{"kind": "field"}, {"kind": "rotation", "to": Z, "points": 2}]
    _, state = ended({**X, "gradient": G}, steps)
    _, again = ended({**X, "gradient": G}, [*steps, {"kind": "field", "factor": 0}, {"kind": "field", "factor": 1}])
    assert field_at(again) == pytest.approx(field_at(state))
    assert again.u == pytest.approx(state.u, abs=1e-9 * np.abs(state.u).max())

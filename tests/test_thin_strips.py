"""Thin strips rolled up by an end moment: as many steps whatever the thickness, the same path under
noise.
"""

from functools import cache

import numpy as np
import pytest

from magshell_fenicsx import Case, Record, Scene
from magshell_fenicsx.assembly.evaluation import NOISE_VARIABLE
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.simulate.follow import follow

E, LENGTH = 1e6, 1.0


def rolled(slenderness: float) -> tuple[Scene, list[Record]]:
    """A strip of that length over thickness, to a full circle: M = 2 pi E h^3/(12 L) with no
    contraction.
    """
    h = LENGTH / slenderness
    case = {
        "shell": {
            "geometry": "plate",
            "length": LENGTH,
            "width": 0.1,
            "thickness": h,
            "youngs_modulus": E,
            "poisson_ratio": 0,
        },
        "boundary": {"left": "clamped"},
        "points": {"A": [LENGTH, 0.05, 0]},
        "loading": {
            "kind": "dead",
            "loads": [{"edge": "right", "moment": -2 * np.pi * E * h**3 / 12 / LENGTH}],
            "factor": 1,
            "points": 20,
        },
        "mesh": {"size": 0.1},
    }
    scene = Scene(Case.from_source(Source("strip", case)))
    return scene, list(follow(scene))


@cache
def quiet() -> tuple[Scene, list[Record]]:
    return rolled(100)


@pytest.mark.slow
def test_steps_do_not_grow_with_slenderness() -> None:
    """A thousandfold slenderness: at most three steps for each of the twenty points that are asked
    for.
    """
    points = []
    for slenderness in (100, 10_000, 100_000):
        scene, records = quiet() if slenderness == 100 else rolled(slenderness)
        end = records[-1]
        assert end.point.state.mu["load"] == 1.0
        tip = scene.problem.length * scene.model.displacement(end.point.state.u, "A")
        assert tip == pytest.approx([-LENGTH, 0, 0], abs=2e-3)  # the exact circle
        points.append(len(records))
    assert max(points) < 3 * 20, points


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["1e-14 2", "1e-13 3"])
def test_the_same_instability_under_noise(noise: str, monkeypatch: pytest.MonkeyPatch) -> None:
    _, clean = quiet()
    monkeypatch.setenv(NOISE_VARIABLE, noise)
    _, noisy = rolled(100)
    found = [
        [r for r in records if r.label in ("fold", "bifurcation")] for records in (clean, noisy)
    ]
    assert [r.label for r in found[0]] == [r.label for r in found[1]] == ["bifurcation"]
    (a,), (b,) = found
    assert a.point.load_error < 1e-8
    apart = abs(a.point.state.mu["load"] - b.point.state.mu["load"])
    assert apart <= a.point.load_error + b.point.load_error
    assert noisy[-1].point.state.mu["load"] == 1.0

"""A field that is not uniform turns as a whole, B(r) = Q B(Q^T r): against one that stands there
from the start.
"""

from math import pi
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import magshell_fenicsx as ms
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.parts.magnetism.direction import field_at

G = [[0.3, 0.2, 0.0], [0.2, 0.5, -0.4], [0.0, -0.4, -0.8]]
DISC = {"geometry": "disc", "radius_to_thickness": 20, "poisson_ratio": 0.3}
SI = {
    "geometry": "disc",
    "radius": "20 mm",
    "thickness": "1 mm",
    "youngs_modulus": "1 MPa",
    "poisson_ratio": 0.3,
}
X, Y, Z = {"polar": 90}, {"polar": 90, "azimuth": 90}, {"polar": 0}
MAGNET = {"kind": "cylinder", "diameter": "20 mm", "height": "10 mm", "polarization": "1.3 T"}
FIELD: dict[str, Any] = {"kind": "field"}


def ended(applied: dict[str, Any], loading: Any, model: str = "shell") -> tuple[ms.Scene, Any]:
    strength = {"flux_density": "30 mT"} if "sources" in applied else {}
    magnetic = {
        "remanent": {"polar": 30, **strength},
        "applied": applied,
        **({} if strength else {"lambda_m": 0.02}),
    }
    mesh = {"degree": 3, "size": 0.6} if model == "shell" else {"size": 0.8}
    shell = SI if strength else DISC
    if strength:
        mesh["size"] *= 0.02
    data = {
        "shell": shell,
        "boundary": {"rim": "clamped"},
        "magnetic": magnetic,
        "loading": loading,
        "mesh": mesh,
    }
    scene = ms.Scene(ms.Case.from_source({**data, "symmetry": "none", "model": model}))
    *_, last = ms.follow(scene)
    return scene, last.point.state


@pytest.mark.parametrize("model", ["shell", pytest.param("solid", marks=pytest.mark.slow)])
def test_a_gradient(model: str) -> None:
    """From e1 to e2 and on to e3."""
    steps = [
        FIELD,
        {"kind": "rotation", "to": Y, "points": 2},
        {"kind": "rotation", "to": Z, "points": 2},
    ]
    turned, state = ended({**X, "gradient": G}, steps, model)
    Q = (Rotation.from_rotvec([pi / 2, 0, 0]) * Rotation.from_rotvec([0, 0, pi / 2])).as_matrix()
    assert Q[:, 0] == pytest.approx([0, 0, 1])
    agrees((turned, state), ended({**Z, "gradient": (Q @ G @ Q.T).tolist()}, [FIELD], model))


def test_formulas() -> None:
    """From e3 to e1: old z is x, old x is -z."""
    before = {"components": ["-x*z", "-y*z", "1 + z**2 - (x**2 + y**2)/2"]}
    after = {"components": ["1 + x**2 - (z**2 + y**2)/2", "-x*y", "-x*z"]}
    agrees(
        ended(before, [FIELD, {"kind": "rotation", "to": X, "points": 2}]), ended(after, [FIELD])
    )


@pytest.mark.slow
def test_sources_that_move() -> None:
    """Beside a uniform field: one magnet moves, both turn with the field from e3 to e1, then the
    other one moves.
    """
    beside = {"flux_density": "5 mT", **Z}
    below = {
        "sources": [{**MAGNET, "position": [0, 0, -0.06]}, {**MAGNET, "position": [0, 0.05, 0.01]}],
        **beside,
    }
    steps = [
        FIELD,
        {"kind": "source", "move": [0.01, 0, 0]},
        {"kind": "rotation", "to": X, "points": 2},
        {"kind": "source", "source": 1, "name": "other", "to": [0.03, 0.06, 0]},
    ]
    places = [[-0.06, 0, -0.01], [0.03, 0.06, 0]]
    there = {
        "sources": [{**MAGNET, "position": place, "axis": X} for place in places],
        **beside,
        **X,
    }
    agrees(ended(below, steps), ended(there, [FIELD]))


def agrees(turned: tuple[ms.Scene, Any], standing: tuple[ms.Scene, Any]) -> None:
    (one, state), (other, wanted) = turned, standing
    near = max(
        1e-7 * np.abs(wanted.u).max(), 1e-12
    )  # a point's tolerance is 1e-9 h, and one of these moves by 1e-6 h
    assert state.u == pytest.approx(wanted.u, abs=near)
    flat = one.observe(
        State(one.model.zero(), state.mu)
    )  # the undeformed shell in the field as it is now
    here, there = one.observe(state), other.observe(wanted)
    assert here["lambda_m"] == pytest.approx(there["lambda_m"], rel=1e-12)
    assert here["energy"] - flat["energy"] == pytest.approx(there["energy"], rel=1e-7)
    assert here["field_angle"] == pytest.approx(90)


@pytest.mark.slow
def test_one_that_is_switched_off_and_on() -> None:
    """It keeps its direction while its strength falls to zero and grows again."""
    steps: list[dict[str, Any]] = [FIELD, {"kind": "rotation", "to": Z, "points": 2}]
    _, state = ended({**X, "gradient": G}, steps)
    _, again = ended({**X, "gradient": G}, [*steps, {**FIELD, "factor": 0}, {**FIELD, "factor": 1}])
    assert field_at(again.mu) == pytest.approx(field_at(state.mu))
    assert again.u == pytest.approx(state.u, abs=1e-9 * np.abs(state.u).max())

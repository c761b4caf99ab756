"""Two cantilever strips, one pushed against the other, against the elastica."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_bvp

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.simulate.follow import follow

Array = NDArray[np.float64]
h, WIDTH, GAP, CLAMP, DOWN = 0.01, 0.02, 0.5, 1.6, 0.2


def elastica() -> dict[str, float]:
    """Tips over the length of two inextensible strips.

    One is the other turned by half a turn about the middle between the clamps. So each end presses on the other strip,
    at the same arc length a with the same force N, and both forces on the lower strip are along its normal n there.
    EI theta'' = F_x sin(theta) - F_y cos(theta) with the force F beyond: -2 N n up to a, -N n from there to the end.
    """

    def slopes(s: Array, z: Array, p: Array) -> Array:
        N, a, at = p
        rows = []
        for (_, _, angle, curvature), length, F in ((z[:4], a, 2 * N), (z[4:], 1 - a, N)):
            bend = F * (np.sin(at) * np.sin(angle) + np.cos(at) * np.cos(angle))
            rows += [length * each for each in (np.cos(angle), np.sin(angle), curvature, bend)]
        return np.stack(rows)

    def ends(z0: Array, z1: Array, p: Array, down: float) -> Array:
        n, centre = np.array([-np.sin(p[2]), np.cos(p[2])]), np.array([CLAMP, (1 + GAP) * h - down])
        apart = centre - z1[4:6] - z1[:2] - h * n
        return np.array([*z0[:3], *(z0[4:] - z1[:4]), z1[7], z1[2] - p[2], *apart])

    s = np.linspace(0, 1, 41)
    z = np.stack([0.6 * s, 0 * s, 0 * s, 0 * s, 0.6 + 0.4 * s, 0 * s, 0 * s, 0 * s])
    p = np.array([0.01, 0.6, 0.0])
    for down in np.linspace(0.02, DOWN, 10):
        found = solve_bvp(slopes, lambda z0, z1, p, d=down: ends(z0, z1, p, d), s, z, p, tol=1e-8, max_nodes=5000)
        assert found.success
        s, z, p = found.x, found.y, found.p
    x, y = z[4:6, -1]
    lower = {"lower_x": x, "lower_z": y}
    return {**lower, "upper_x": CLAMP - x, "upper_z": (1 + GAP) * h - DOWN - y}


@pytest.mark.slow
def test_two_cantilevers() -> None:
    """Tips: 2e-3 of the way of the clamp."""
    strip = {"geometry": "plate", "length": 1, "width": WIDTH, "thickness": h, "youngs_modulus": 1, "poisson_ratio": 0}
    one: dict[str, Any] = {"shell": strip, "boundary": {"left": "clamped"}, "points": {"tip": [1, 0, 0]}}
    case = {
        "shells": {
            "lower": one,
            "upper": {**one, "place": {"position": [CLAMP, WIDTH, (1 + GAP) * h], "turn": 180}},
        },
        "contact": [["upper", "lower"]],
        "mesh": {"degree": 3, "size": 0.05},
        "loading": {
            "kind": "edge", "control": "load", "points": 1, "factor": 1,
            "moves": [{"supports": ["upper.left"], "translation": [0, 0, -DOWN]}],
        },
    }  # fmt: skip
    scene = Scene(Case.from_source(case))
    *_, last = follow(scene)
    seen, expected = scene.observe(last.point.state), elastica()
    tips = {
        "lower_x": 1 + seen["lower_tip_ux"], "lower_z": seen["lower_tip_uz"],
        "upper_x": CLAMP - 1 + seen["upper_tip_ux"], "upper_z": (1 + GAP) * h + seen["upper_tip_uz"],
    }  # fmt: skip
    assert tips == pytest.approx({name: expected[name] for name in tips}, abs=2e-3 * DOWN)

"""Two cantilever strips, one pushed against the other, against the elastica."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_bvp
from scipy.spatial import cKDTree

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Stopped

Array = NDArray[np.float64]
h, WIDTH, GAP, CLAMP, DOWN = 0.01, 0.02, 0.5, 1.6, 0.2
CLAMPED = {"clamp_x": "lower_left_fx", "clamp_z": "lower_left_fz", "moment": "lower_left_my"}


def elastica() -> dict[str, float]:
    """Two inextensible strips: tips over the length; force between them, and force and moment at a
    clamp, over EI.

    One is the other turned by half a turn about the middle between the clamps. Each bulges towards
    the other, so that they touch along one line in that middle, at the same arc length a with the
    same force F along the common normal n. Beyond it both are straight, and lift off. EI theta'' =
    F cos(theta - theta(a)) up to a.
    """

    def slopes(s: Array, z: Array, p: Array) -> Array:
        F, a, at = p
        return np.asarray(a * np.stack([np.cos(z[2]), np.sin(z[2]), z[3], F * np.cos(z[2] - at)]))

    def ends(z0: Array, z1: Array, p: Array, down: float) -> Array:
        n, middle = (
            np.array([-np.sin(p[2]), np.cos(p[2])]),
            np.array([CLAMP, (1 + GAP) * h - down]) / 2,
        )
        return np.array([*z0[:3], z1[3], z1[2] - p[2], *(z1[:2] + h / 2 * n - middle)])

    s = np.linspace(0, 1, 41)
    z = np.stack([0.8 * s, 0 * s, 0 * s, 0 * s])
    p = np.array([0.01, 0.8, 0.0])
    for down in np.linspace(0.02, DOWN, 10):
        found = solve_bvp(
            slopes, lambda z0, z1, p, d=down: ends(z0, z1, p, d), s, z, p, tol=1e-8, max_nodes=5000
        )
        assert found.success
        s, z, p = found.x, found.y, found.p
    F, a, at = p
    beyond = z[:2, -1:] + np.linspace(0, 1 - a, 41) * np.array([[np.cos(at)], [np.sin(at)]])
    lower = np.column_stack([found.sol(np.linspace(0, 1, 400))[:2], beyond])
    upper = np.array([[CLAMP], [(1 + GAP) * h - DOWN]]) - lower
    assert cKDTree(lower.T).query(upper.T)[0].min() > (1 - 1e-6) * h  # they touch nowhere else
    x, z_tip = lower[:, -1]
    return {
        "lower_x": x, "lower_z": z_tip, "upper_x": CLAMP - x,
        "upper_z": (1 + GAP) * h - DOWN - z_tip,
        "force": F, "clamp_x": -F * np.sin(at), "clamp_z": F * np.cos(at), "moment": z[3, 0],
    }  # fmt: skip


@pytest.mark.slow
def test_two_cantilevers() -> None:
    """The force between them, the force and moment at a clamp, and the tips over the way of the
    clamp: 2e-4.
    """
    strip = {
        "geometry": "plate",
        "length": 1,
        "width": WIDTH,
        "thickness": h,
        "youngs_modulus": 1,
        "poisson_ratio": 0,
    }
    one: dict[str, Any] = {
        "shell": strip,
        "boundary": {"left": "clamped"},
        "points": {"tip": [1, 0, 0]},
    }
    case = {
        "shells": {
            "lower": one,
            "upper": {**one, "place": {"position": [CLAMP, WIDTH, (1 + GAP) * h], "turn": 180}},
        },
        "contact": [["upper", "lower"]],
        "mesh": {"degree": 3, "size": 0.1},
        "loading": {
            "kind": "edge", "control": "load", "points": 1, "factor": 1,
            "moves": [{"supports": ["upper.left"], "translation": [0, 0, -DOWN]}],
        },
    }  # fmt: skip
    scene = Scene(Case.from_source(case))
    *_, last = follow(scene)
    seen, expected = scene.observe(last.point.state), elastica()
    D = h**3 / 12
    tips = {
        "lower_x": 1 + seen["lower_tip_ux"], "lower_z": seen["lower_tip_uz"],
        "upper_x": CLAMP - 1 + seen["upper_tip_ux"],
        "upper_z": (1 + GAP) * h + seen["upper_tip_uz"],
    }  # fmt: skip
    forces = {
        "force": 2 * np.pi * seen["contact_force"] / WIDTH,
        **{name: seen[column] / (D * WIDTH) for name, column in CLAMPED.items()},
    }
    assert tips == pytest.approx({name: expected[name] for name in tips}, abs=2e-4 * DOWN)
    assert forces == pytest.approx({name: expected[name] for name in forces}, rel=2e-4)


def test_strips_that_meet_flat() -> None:
    """All of two opposite cantilevers meets at once; behind that they touch along the middle line,
    F = 12 EI d/L^3 for a way d of one clamp: each half has F (L/2)^3/(3 EI) = d/2.
    """
    gap, way, width = 0.1, 0.4, 0.2
    strip = {
        "geometry": "plate",
        "length": 1,
        "width": width,
        "thickness": h,
        "youngs_modulus": 1,
        "poisson_ratio": 0,
    }
    upper = {"boundary": {"right": "clamped"}, "place": {"position": [0, 0, (1 + gap) * h]}}
    case = {
        "shells": {"lower": {"shell": strip, "boundary": {"left": "clamped"}},
                   "upper": {"shell": strip, **upper}},
        "contact": [["upper", "lower"]],
        "mesh": {"degree": 3, "size": 0.2},
        "loading": {
            "kind": "edge", "control": "load", "points": 2, "factor": 1,
            "moves": [{"supports": ["upper.right"], "translation": [0, 0, -way * h]}],
        },
    }  # fmt: skip
    scene = Scene(Case.from_source(case))
    points = [
        (record.label, scene.observe(record.point.state)["contact_force"])
        for record in follow(scene)
    ]
    forces = [2 * np.pi * force for label, force in points if label == "target"]  # over D
    assert forces == pytest.approx(
        [12 * width * (part * way - gap) * h for part in (0.5, 1)], rel=2e-3
    )
    assert len(points) <= 6


def test_clamps_that_meet_end_the_path_at_once() -> None:
    """Two strips, 3 h apart: the clamp of the upper one goes down 4 h, and its face is at the other
    one after 2 h.
    """
    strip = {
        "geometry": "plate",
        "length": 1,
        "width": 0.2,
        "thickness": 0.02,
        "youngs_modulus": 1,
        "poisson_ratio": 0,
    }
    one: dict[str, Any] = {
        "shell": strip,
        "boundary": {"left": "clamped"},
        "points": {"tip": [1, 0, 0]},
    }
    case = {
        "shells": {"lower": one, "upper": {**one, "place": {"position": [0, 0, 0.06]}}},
        "contact": [["lower", "upper"]],
        "loading": {
            "kind": "edge",
            "moves": [{"supports": ["upper.left"], "translation": [0, 0, -0.08]}],
            "points": 5,
        },
        "mesh": {"size": 0.2},
    }
    found = []
    with pytest.raises(
        Stopped, match=r"supports hold lower and upper in each other from motion = 0\.500"
    ):
        found.extend(follow(Scene(Case.from_source(case))))
    assert [
        record.point.state.mu["motion"] for record in found if record.label == "target"
    ] == pytest.approx([0.2, 0.4])

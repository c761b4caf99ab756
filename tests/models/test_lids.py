"""The volume that a shell and rigid lids on its moving edges enclose, and what a pressure does to
its supports.
"""

from typing import Any

import numpy as np
import pytest
from models.moving_scenes import move, moving_scene

import magshell_fenicsx as ms
from magshell_fenicsx import Scene
from magshell_fenicsx.parts.supports.reactions import reactions

CAP = {"geometry": "cap", "radius": 1.0, "thickness": 0.05, "polar": 60, "youngs_modulus": 1.0}
TUBE = {
    "geometry": "cylinder",
    "radius": 1.0,
    "length": 1.0,
    "thickness": 0.05,
    "youngs_modulus": 1.0,
}
PRESSED = [{"kind": "pressure", "control": "load", "until": "target", "pressure": 0.1, "points": 1}]
AREA = np.pi * np.sin(np.pi / 3) ** 2  # of the disc that the rim of the cap spans
LIFT = {"shift": [0.0, 0.0, 0.3]}
ANYWHERE = {"shift": [0.1, 0.0, 0.3], "turn": [0.0, 0.7, 0.0], "centre": [0.0, 0.0, 0.2]}
CARRIERS = [
    ("axisymmetric", "shell", LIFT),
    ("half", "shell", ANYWHERE),
    ("none", "shell", ANYWHERE),
    pytest.param("half", "solid", ANYWHERE, marks=pytest.mark.slow),
]


def capped(symmetry: str, model: str, motion: dict[str, Any], rim: str = "clamped") -> Scene:
    mesh = {"size": 0.4} if model == "solid" else {"degree": 3, "refinement": 0.4}
    moves = (move("way", "rim", **motion),)
    return moving_scene(
        moves, CAP, {"rim": rim}, symmetry=symmetry, model=model, mesh=mesh, loading=PRESSED
    )


@pytest.mark.parametrize(("symmetry", "model", "motion"), CARRIERS)
def test_a_rigid_motion(symmetry: str, model: str, motion: dict[str, Any]) -> None:
    """It changes neither the volume nor the energy; the force of the rim balances p times the area
    it spans, turned.
    """
    scene = capped(symmetry, model, motion)
    *_, pressed = ms.follow(scene)
    before = scene.observe(pressed.point.state)
    *_, moved = ms.trace(scene, "way", pressed, control="load", targets=[1.0])
    after = scene.observe(moved.point.state)
    assert before["volume_change"] < -1e-3
    for column in ("volume_change", "energy"):
        assert after[column] == pytest.approx(
            before[column], rel=1e-6
        )  # as exact as a point of the path
    problem = scene.problem
    force = 0.1 * problem.material.classical_pressure / problem.material.h * AREA  # over E h R
    if model == "solid":
        force *= (1 + problem.material.h / 2) ** 2  # its outer face is pressed
    there = reactions(scene.model, moved.point.state, problem.mirror)["rim"]
    turn = np.linalg.norm(motion.get("turn", 0.0))
    np.testing.assert_allclose(there.force / force, [np.sin(turn), 0, np.cos(turn)], atol=2e-3)
    assert (
        np.abs(there.moment).max() < (2e-3 if model == "solid" else 1e-9) * force
    )  # as its force is right


@pytest.mark.parametrize("symmetry", ["axisymmetric", "half"])
def test_a_tube_pulled_apart(symmetry: str) -> None:
    """Without a lateral contraction, the volume grows by the area of an end times its way."""
    scene = moving_scene(
        (move("way", "top", shift=[0.0, 0.0, 0.1]),),
        TUBE,
        {"bottom": "clamped", "top": "clamped"},
        symmetry=symmetry,
        mesh={"degree": 3, "refinement": 0.4},
        loading=PRESSED,
    )
    *_, pulled = ms.trace(scene, "way", control="load", targets=[1.0])
    assert scene.observe(pulled.point.state)["volume_change"] == pytest.approx(
        0.1 * np.pi, rel=1e-9 if symmetry == "axisymmetric" else 5e-4
    )


def test_one_edge_of_four_has_no_lid() -> None:
    """Where a part of an edge moves there is nothing that could close it: the volume is what the
    surface sweeps.
    """
    plate = {
        "geometry": "plate",
        "length": 1.0,
        "width": 1.0,
        "thickness": 0.02,
        "youngs_modulus": 1.0,
    }
    sides = {
        "left": "clamped",
        "right": "clamped",
        "bottom": {"held": ["z"]},
        "top": {"held": ["z"]},
    }
    lifted = {}
    for names in (("right",), tuple(sides)):
        moves = (move("way", *names, shift=[0.0, 0.0, 0.01]),)
        scene = moving_scene(moves, plate, sides, mesh={"degree": 3, "size": 0.5}, loading=PRESSED)
        *_, last = ms.trace(scene, "way", control="load", targets=[1.0])
        lifted[len(names)] = scene.observe(last.point.state)["volume_change"]
    assert abs(lifted[4]) < 1e-12
    assert lifted[1] > 1e-3

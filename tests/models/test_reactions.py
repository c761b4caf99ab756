"""Reactions of supports: beams, an annular plate, and global equilibrium."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from models.moving_scenes import CLAMPED, NONE, PLATE, RING, move, moving_scene

import magshell_fenicsx as ms
from magshell_fenicsx import Scene
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.shell.parameters import Move
from magshell_fenicsx.parts.supports.reactions import Reaction, reactions

SMALL = 1e-5  # displacement over the length: the nonlinear part is of its square over h^2
# of strains, 2e-16, over those of such displacements, h^2 SMALL = 1e-9: 2e-7 at a point, less in a
# sum
ROUNDING = 5e-8
LIFT = move("lift", "right", shift=[0, 0, SMALL])
TURN = move("turn", "right", turn=[0, -SMALL, 0], centre=[1, 0, 0])
EI = PLATE["width"] * 1e-6 / 12  # type: ignore[operator]  # over E


def at_end(scene: Scene, name: str, target: float = 1.0) -> State:
    """The state with this amplitude."""
    *_, last = ms.trace(scene, name, control="load", targets=[target])
    return last.point.state


def found(scene: Scene, state: State) -> dict[str, Reaction]:
    """Forces over E R^2 in place of E h R."""
    h = scene.problem.material.h
    whole = reactions(scene.model, state, scene.problem.mirror)
    return {name: Reaction(h * r.force, h * r.moment, r.point) for name, r in whole.items()}


def unbalanced(named: dict[str, Reaction]) -> float:
    """The sum of all forces and moments over the largest."""
    force = sum((r.force for r in named.values()), np.zeros(3))
    moment = sum((r.moment + np.cross(r.point, r.force) for r in named.values()), np.zeros(3))
    largest = max(np.abs([r.force, r.moment]).max() for r in named.values())
    return float(np.abs([force, moment]).max() / largest)


def test_beam() -> None:
    """Clamped at both ends: F = 12 EI/L^3 and M = 6 EI/L^2 of a deflection, M = 4 and 2 EI/L of a
    rotation.
    """
    strip = {"geometry": "strip", "radius_to_thickness": 100, "width": 0.1}
    ends = {"root": "clamped", "tip": "clamped"}
    moves = tuple(Move(("tip",), m.motion) for m in (LIFT, TURN))
    scene = moving_scene(moves, strip, ends, symmetry="half")
    lifted = found(scene, at_end(scene, "lift"))
    assert lifted["tip"].force[2] == pytest.approx(12 * EI * SMALL, rel=1e-5)
    assert lifted["tip"].moment[1] == pytest.approx(6 * EI * SMALL, rel=1e-5)
    turned = found(scene, at_end(scene, "turn"))
    assert turned["tip"].moment[1] == pytest.approx(-4 * EI * SMALL, rel=1e-5)
    assert turned["root"].moment[1] == pytest.approx(-2 * EI * SMALL, rel=1e-5)
    assert turned["root"].force[2] == pytest.approx(6 * EI * SMALL, rel=1e-5)
    assert unbalanced(lifted) < ROUNDING
    assert unbalanced(turned) < ROUNDING


def test_solid_beam() -> None:
    """Timoshenko's beam, F = 12 EI/(L^3 (1 + phi)) with phi = 12 EI/(5/6 G A L^2); the ends' faces
    are held.
    """
    thick = {**PLATE, "thickness": 0.05}
    scene = moving_scene((LIFT,), thick, CLAMPED, model="solid", mesh={"size": 0.1})
    lifted = found(scene, at_end(scene, "lift"))
    h = 0.05
    phi = 2.4 * h**2
    assert lifted["right"].force[2] == pytest.approx(0.1 * h**3 * SMALL / (1 + phi), rel=3e-3)
    assert unbalanced(lifted) < ROUNDING


def test_ring() -> None:
    """An annular plate, clamped at both edges, one lifted: w = a + b ln r + c r^2 + d r^2 ln r, F =
    8 pi d D.
    """
    scene = moving_scene(
        (move("lift", "inner", shift=[0, 0, SMALL]),),
        {**RING, "poisson_ratio": 0.3},
        {"inner": "clamped", "outer": "clamped"},
        symmetry="axisymmetric",
    )
    lifted = found(scene, at_end(scene, "lift"))
    rows = []
    for r in (0.4, 1.0):
        rows += [[1, np.log(r), r**2, r**2 * np.log(r)], [0, 1 / r, 2 * r, r * (2 * np.log(r) + 1)]]
    d = np.linalg.solve(np.array(rows), [SMALL, 0, 0, 0])[3]
    D = 1e-6 / 12 / (1 - 0.3**2)
    assert lifted["inner"].force[2] == pytest.approx(abs(8 * np.pi * d * D), rel=1e-5)
    assert unbalanced(lifted) < ROUNDING


def test_large_motion() -> None:
    """An end pushed, lifted and turned by 60 degrees: forces and moments balance, and their power
    is the conjugate.
    """
    push = move("push", "right", shift=[0.02, 0, 0.2])
    turn = move("turn", "right", shift=[0, 0, 0.1], turn=[0.2, -1.0, 0.1], centre=[0.9, 0, 0.1])
    scene = moving_scene((push, turn), boundary=CLAMPED, mesh={"degree": 3})
    state = at_end(scene, "push")
    *_, last = ms.trace(scene, "turn", State(state.u, state.mu), control="load", targets=[0.5, 1.0])
    state = last.point.state
    here = found(scene, state)
    assert unbalanced(here) < 1e-9
    end, m = here["right"], turn.motion
    arm = end.point - (m.centre + m.shift)
    power = end.force @ m.shift + (end.moment + np.cross(arm, end.force)) @ m.turn
    conjugate = scene.model.system.potential(state.u, state.mu, "turn") * scene.problem.material.h
    assert power == pytest.approx(conjugate, rel=1e-9)


@pytest.mark.slow
def test_half_and_whole() -> None:
    """The same grid, cut along its middle and whole: the reactions agree, those of the edge that is
    lost too.
    """
    moves = move("push", "left", shift=[0.01, 0, 0]), move("push", "right", shift=[-0.01, 0, 0])
    dead = {"kind": "dead", "loads": [{"over": "all", "per_area": [0, 0, 100.0]}], "factor": 1.0}
    each = []
    for symmetry in ("half", "none"):
        scene = moving_scene(
            moves, symmetry=symmetry, loading=dead, mesh={"degree": 3, "size": 0.1}
        )
        *_, last = ms.trace(scene, "load", control="load", targets=[1.0])
        *_, last = ms.trace(scene, "push", last, control="load", targets=[1.0])
        each.append(found(scene, last.point.state))
    for name in ("left", "right"):
        a, b = (np.array([side[name].force, side[name].moment, side[name].point]) for side in each)
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9 * np.abs(b).max())
    total = sum((r.force for r in each[0].values()), NONE)
    np.testing.assert_allclose(total, [0, 0, -100.0 * 0.1 / PLATE["youngs_modulus"]], atol=1e-15)  # type: ignore[operator]


def hinged_plate(names: Sequence[str], **sections: Any) -> dict[str, Reaction]:
    """The reactions of a square plate on hinges all around, under a pressure."""
    plate = {
        "geometry": "plate",
        "length": 1,
        "width": 1,
        "thickness": 0.01,
        "youngs_modulus": 1.0,
        "poisson_ratio": 0.3,
    }
    pressure = {"kind": "dead", "loads": [{"over": "all", "pressure": 1e-9}], "factor": 0.001}
    case = {
        "shell": plate,
        "boundary": dict.fromkeys(names, "hinged"),
        "loading": pressure | {"control": "load", "points": 1},
        "reactions": True,
        "symmetry": "none",
    }
    boundary = case["boundary"] | sections.pop("boundary", {})  # type: ignore[operator]
    scene = Scene(ms.Case.from_source(case | {"boundary": boundary} | sections))
    *_, last = ms.follow(scene)
    return found(scene, last.point.state)


@pytest.mark.parametrize(
    "order", [("bottom", "top", "left", "right"), ("left", "right", "bottom", "top")]
)
def test_edges_that_meet_share_a_corner(order: tuple[str, ...]) -> None:
    """By symmetry a quarter on each edge, in any order."""
    of_edge = hinged_plate(order, mesh={"size": 0.5, "degree": 3})
    forces = np.array([of_edge[name].force[2] for name in order])
    assert forces / forces.sum() == pytest.approx([0.25] * 4, rel=1e-6)


def test_corner_force_of_a_hinged_plate() -> None:
    """Timoshenko and Woinowsky-Krieger, table 8: 0.065 q a^2 holds each corner down, where a point
    takes it.
    """
    corner = {"points": {"corner": [1, 1, 0]}, "boundary": {"corner": {"held": ["x", "y", "z"]}}}
    named = hinged_plate(
        ("bottom", "top", "left", "right"), mesh={"size": 0.125, "degree": 4}, **corner
    )
    force = {name: reaction.force[2] for name, reaction in named.items()}
    assert force["corner"] / sum(force.values()) == pytest.approx(-0.065, rel=1e-2)
    assert force["left"] / sum(force.values()) == pytest.approx(0.25, rel=1e-6), (
        "it has its corner forces still"
    )
    assert force["top"] == pytest.approx(force["right"], rel=1e-6)

"""Branches, further solutions and sensitivities of shells that touch, each reached in another way
too.
"""

from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.continuation_run import ContinuationGoal
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.simulate.contact_control import before_passing, passes
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.path_records import checked_run
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene_cache import problem_on_mesh_of
from magshell_fenicsx.simulate.search import dented_states
from magshell_fenicsx.simulate.sensitivity import sensitivities
from magshell_fenicsx.simulate.stage import load_stage
from magshell_fenicsx.simulate.steps import fold_at
from magshell_fenicsx.simulate.symmetry_switch import _mirrored

h = 0.036
CAP = {"geometry": "cap", "radius": 1, "polar": 20, "thickness": h, "poisson_ratio": 0.3}
PUSH = {"kind": "dead", "loads": [{"at": "upper_top", "force": [0, 0, -1]}]}


def domes(load: dict[str, Any], gap: float, modulus: float = 6, **lower: Any) -> dict[str, Any]:
    """One dome above another one, on their meridians."""
    of = {"boundary": {"rim": "hinged"}, "points": {"top": [0, 0, 1]}}
    shells = {
        "lower": of | {"shell": CAP | {"youngs_modulus": modulus} | lower},
        "upper": of | {"shell": CAP | {"youngs_modulus": 1}, "place": {"position": [0, 0, gap]}},
    }
    return {
        "shells": shells,
        "contact": [["upper", "lower"]],
        "mesh": {"size": 0.03},
        "loading": PUSH | load,
    }


@pytest.mark.slow
def test_search() -> None:
    """At one load the snapped dome in the air and the one that lies on the other: as on the path by
    arc length.
    """
    search = {"solutions": 2, "guesses": 14}
    scene = Scene(
        Case.from_source(
            domes({"control": "load", "factor": 8e-5, "points": 1, "search": search}, 0.115)
        )
    )
    _, start, *found = (record.point.state for record in follow(scene))
    stage = load_stage(scene)
    path, here = stage.begin("load", "arc", start, 1e-5, 1e-4)
    way = checked_run(
        stage, path, here, ContinuationGoal("points", [start.mu["load"]], "load", steps=50)
    )
    reached = [
        point.state
        for _, (_, point) in zip(found, (it for it in way if it[0] == "target"), strict=False)
    ]
    assert len(found) == len(reached) == 2
    for one, other in zip(found, reached, strict=True):
        assert np.abs(one.u - other.u).max() < 1e-8 * h
    assert scene.observe(found[1])["contact_force"] > 0.01
    for guess in dented_states(
        scene, start
    ):  # those of the upper dome end before it is in the lower one
        assert not passes(stage, start, before_passing(stage, start, guess))
    below = State(np.array(start.u), start.mu)
    below.u.reshape(-1, 2)[
        np.unique(scene.model.V.dofmap.list[scene.model.meridian.patches["upper"]]), 1
    ] -= 0.3
    assert passes(stage, start, scene.model.system.with_moved_supports(below))


def fold_of(data: dict[str, Any], base: Scene | None = None) -> tuple[Scene, Record]:
    problem = Case.from_source(data).problem()
    scene = Scene(problem_on_mesh_of(base, problem) if base else problem)
    *_, last = follow(scene)
    return scene, last


@pytest.mark.slow
def test_sensitivities() -> None:
    """By the size of an imperfection and the field: folds of whole runs, 1e-4; the remanences add
    up to the field.
    """

    def data(amplitude: float = 0.1, field: float = 1e-5) -> dict[str, Any]:
        flaw = {"kind": "gaussian", "amplitude": amplitude, "width": 6}
        case = domes({"until": "limit"}, 1.2 * h, 1.5, imperfections=[flaw])
        for shell in case["shells"].values():
            shell["remanent"] = {"polar": 0}
        return case | {"magnetic": {"lambda_m": field, "applied": {"polar": 0}}}

    scene, record = fold_of(data())
    assert record.label == "fold"
    assert scene.observe(record.point.state)["contact_force"] > 1
    found = sensitivities(scene, fold_at(scene, record), record)
    for key, name, value in (
        ("shells.lower.shell.imperfections.0.amplitude", "amplitude", 0.1),
        ("lambda_m", "field", 1e-5),
    ):
        ends = (fold_of(data(**{name: value * (1 + way)}), scene) for way in (0.01, -0.01))
        a, b = (fold_at(*end).value for end in ends)
        assert found[key] == pytest.approx((a - b) / (0.02 * value), rel=1e-4), key
    assert found["remanence lower"] + found["remanence upper"] == pytest.approx(
        1e-5 * found["lambda_m"], rel=1e-9
    )


def column(load: dict[str, Any], w0: str = "") -> Scene:
    """One between two others, clamped at one end and pressed at the other."""
    strip = {
        "geometry": "strip",
        "radius": "1 m",
        "thickness": "0.02 m",
        "width": "0.1 m",
        "poisson_ratio": 0,
    }
    own = {
        "youngs_modulus": "1 MPa",
        **({"imperfections": [{"kind": "formula", "w0": w0}]} if w0 else {}),
    }
    root = {"boundary": {"root": "clamped"}}
    shells = {"column": root | {"shell": strip | own, "points": {"tip": ["1 m", 0, 0]}}}
    for name, z in (("above", "0.05 m"), ("below", "-0.05 m")):
        shells[name] = root | {
            "shell": strip | {"youngs_modulus": "0.3 MPa"},
            "place": {"position": [0, 0, z]},
        }
    dead = {
        "kind": "dead",
        "control": "arc",
        "loads": [{"edge": "column.tip", "force": ["-1 N", 0, 0]}],
    }
    data = {
        "shells": shells,
        "contact": [["column", "above"], ["column", "below"]],
        "loading": dead | load,
    }
    return Scene(Case.from_source(data | {"mesh": {"size": "0.25 m", "degree": 3}}))


@pytest.mark.slow
def test_a_column_leans_on_another_one() -> None:
    """It buckles at Euler's load; on the branch it touches: as a column that is a little bent from
    the start, 1e-3.
    """
    perfect = column({"until": "bifurcation", "then": "follow", "factor": 0.2})
    ways = list(follow(perfect))
    euler = np.pi**2 / 4 * 1e6 * 0.1 * 0.02**3 / 12
    at = next(record.point.state.mu["load"] for record in ways if record.label == "bifurcation")
    assert perfect.observe(State(ways[-1].point.state.u, ways[-1].point.state.mu))[
        "load_factor"
    ] == pytest.approx(0.2)
    assert at / ways[-1].point.state.mu["load"] == pytest.approx(euler / 0.2, rel=1e-3)
    bent = column({"until": "target", "factor": 0.2, "points": 2}, "2e-4*x**2")
    *_, last = follow(bent)
    one, other = (scene.observe(r.point.state) for scene, r in ((perfect, ways[-1]), (bent, last)))
    forces = [
        seen["contact_force_column_above"] + seen["contact_force_column_below"]
        for seen in (one, other)
    ]
    assert forces[0] > 0
    assert forces[0] == pytest.approx(forces[1], rel=1e-3)
    assert abs(one["column_tip_uz"]) == pytest.approx(abs(other["column_tip_uz"]), rel=1e-3)


def test_what_a_larger_model_is_given() -> None:
    """Each of two arches that nearly touch has its own displacement in the whole, and not the other
    one's.
    """
    arch = {
        "geometry": "cylinder",
        "radius": 1,
        "length": 0.12,
        "azimuth": [60, 120],
        "thickness": 0.02,
    }
    one = {
        "shell": arch | {"youngs_modulus": 1, "poisson_ratio": 0.3},
        "boundary": {"left": "hinged", "right": "hinged"},
    }
    load = {
        "kind": "edge",
        "name": "w",
        "moves": [{"supports": ["upper.left", "upper.right"], "translation": [0, -1, 0]}],
    }
    data = {
        "shells": {"lower": one,
                   "upper": one | {"place": {"position": [0, 2.021, 0], "turn": 180}}},
        "contact": [["upper", "lower"]], "mesh": {"size": 0.12, "degree": 2}, "loading": load,
    }  # fmt: skip
    half, whole = (Scene(Case.from_source(data | {"symmetry": how})) for how in ("auto", "none"))
    assert half.problem.is_half

    def smooth(scene: Scene) -> Any:
        x = scene.model.r0.x.array[: scene.model.system.size].reshape(-1, 3)
        far = np.where(x[:, 1] > 1.0105, -1.0, 1.0)  # the upper one
        return np.stack([0 * far, far * np.cos(x[:, 0]), 0 * far], axis=1)

    given = smooth(half).ravel()
    u, _ = _mirrored(half, whole, given, 0 * given)
    assert np.abs(np.linalg.norm(u, axis=1) - np.linalg.norm(smooth(whole), axis=1)).max() < 1e-5

"""Half of several shells that share a mirror plane, against all of them on the mirrored mesh."""

from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.simulate.follow import follow

h = 0.02
MATERIAL = {"thickness": h, "youngs_modulus": 1, "poisson_ratio": 0.3}


def plate(position: list[float], polar: float = 0.0, **keys: Any) -> dict[str, Any]:
    shell = {"geometry": "plate", "length": 1, "width": 0.5, **MATERIAL}
    return {"shell": shell, "place": {"position": position, "axis": {"polar": polar}}, **keys}


def tube(z: float, **keys: Any) -> dict[str, Any]:
    shell = {"geometry": "cylinder", "radius": 1, "length": 0.5, **MATERIAL} | keys
    return {"shell": shell, "boundary": {"bottom": "clamped"}, "place": {"position": [0, 0, z]}}


def dead(*loads: dict[str, Any]) -> dict[str, Any]:
    return {"kind": "dead", "control": "load", "loads": list(loads), "factor": 1, "points": 1}


TIP = {"tip": [1, 0.25, 0]}
WEIGHT = {"over": "left", "per_area": [0, 0, -1e-7]}
CREASE = {
    "left": plate([0, 0, 0], boundary={"left": "clamped"}, points=TIP),
    "right": plate([1, 0, 0], 20, boundary={"right": {"held": ["y", "z"]}}),
}
ACROSS = {"y": [0, 1, 0], "oblique": [-np.sqrt(0.5), np.sqrt(0.5), 0]}
HALVES: dict[str, tuple[str, dict[str, Any]]] = {
    "plates with a crease": (
        "y",
        {
            "shells": CREASE,
            "joints": [{"edges": ["left.right", "right.left"], "kind": "spring", "stiffness": 1e-7}],
            "loading": dead(WEIGHT),
        },
    ),
    "tubes with one axis": (
        "oblique",
        {
            "shells": {
                "low": tube(0),
                "high": tube(1, thickness_factor="1 + x*y/4") | {"points": {"end": [0, -1, 0.5]}},
            },
            "loading": dead({"over": "high", "per_area": [1e-7, 1e-7, 0]}),
            "mesh": {"degree": 3, "size": 0.27},  # 24 elements around the axis, a line of them at 45 degrees
        },
    ),
    "tubes beside each other": (
        "y",
        {
            "shells": {"low": tube(0), "high": tube(1) | {"place": {"position": [3, 0, 0], "axis": {"polar": 40}}}},
            "loading": {"kind": "pressure", "control": "load", "until": "target", "pressure": 1e-5, "points": 1},
        },
    ),
}


def asked(name: str, symmetry: str) -> Case:
    return Case.from_source({"mesh": {"degree": 3, "size": 0.25}, "symmetry": symmetry, **HALVES[name][1]})


@pytest.mark.parametrize("name", HALVES)
def test_half_and_whole_agree(name: str) -> None:
    """The size gives the whole a line in its plane: its mesh is the half's and the mirror image of that; 1e-8."""
    seen = []
    for symmetry in ("auto", "none"):
        scene = Scene(asked(name, symmetry))
        plane = scene.problem.mirror
        assert (plane is None) == (symmetry == "none")
        assert plane is None or abs(plane.normal @ ACROSS[HALVES[name][0]]) == pytest.approx(1)
        *_, last = follow(scene)
        seen.append(scene.observe(last.point.state))
    half, whole = seen
    for column in half.keys() & {"left_tip_uz", "high_end_uz", "volume_change", "energy", "contact_force"}:
        assert half[column] == pytest.approx(whole[column], rel=1e-8, abs=1e-13), column
    assert half.get("contact_force", 1.0) > 0


def test_modes_of_both_sides() -> None:
    """Of the half and antisymmetric to its plane they are those of all shells."""
    half, whole = (Scene(asked("plates with a crease", s)) for s in ("half", "none"))
    found = [ShellModes(scene.model).lowest(scene.unloaded(), 4) for scene in (half, whole)]
    assert {mode.label for mode in found[0][:4]} == {"", "antisymmetric"}
    values = [[mode.eigenvalue for mode in modes[:4]] for modes in found]
    assert values[0] == pytest.approx(values[1], rel=1e-7)


PLIES = {"along": [0, 0, 1], "plies": [{"angle": 30, "E1": 2, "E2": 1, "nu12": 0.3, "G12": 0.4, "fraction": 1}]}
NOT_HALVED: dict[str, dict[str, Any]] = {
    "planes of their own": {"shells": {"low": tube(0), "high": plate([3, 1, 0], boundary={"left": "clamped"})}},
    "one that is held by nothing": {"shells": {"low": tube(0), "high": plate([3, -0.25, 0])}},
    "one that may touch itself": {"shells": {"low": tube(0), "high": tube(1)}, "contact": [["low", "low"]]},
    "plies across the plane": {"shells": {"low": tube(0), "high": tube(1, laminate=PLIES)}},
    "a joint in the plane": {
        "shells": {"left": plate([-1, 0, 0], boundary={"left": "clamped", "bottom": "clamped"}),
                   "right": plate([0, 0, 0], boundary={"right": "clamped", "bottom": "clamped"})},
        "joints": [{"edges": ["left.right", "right.left"]}],
    },
}  # fmt: skip


@pytest.mark.parametrize("name", NOT_HALVED)
def test_no_plane(name: str) -> None:
    data = {"mesh": {"size": 0.25}} | NOT_HALVED[name]
    assert make_problem(Case.from_source(data)).mirror is None
    with pytest.raises(CaseError, match=r"symmetry: half: "):
        make_problem(Case.from_source(data | {"symmetry": "half"}))

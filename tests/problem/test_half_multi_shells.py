"""Half of several shells that share a mirror plane, against all of them on the mirrored mesh."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from petsc4py import PETSc
from scipy.spatial import cKDTree

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.system import State
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
ACROSS = {"x": [1, 0, 0], "y": [0, 1, 0], "oblique": [-np.sqrt(0.5), np.sqrt(0.5), 0]}
HALVES: dict[str, tuple[str, dict[str, Any]]] = {
    "plates with a crease": (
        "y",
        {
            "shells": CREASE,
            "joints": [
                {"edges": ["left.right", "right.left"], "kind": "spring", "stiffness": 1e-7}
            ],
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
            "mesh": {
                "degree": 3,
                "size": 0.27,
            },  # 24 elements around the axis, a line of them at 45 degrees
        },
    ),
    "tubes beside each other": (
        "y",
        {
            "shells": {
                "low": tube(0),
                "high": tube(1) | {"place": {"position": [3, 0, 0], "axis": {"polar": 40}}},
            },
            "loading": {
                "kind": "pressure",
                "control": "load",
                "until": "target",
                "pressure": 1e-5,
                "points": 1,
            },
        },
    ),
}


def asked(name: str, symmetry: str) -> Case:
    return Case.from_source(
        {"mesh": {"degree": 3, "size": 0.25}, "symmetry": symmetry, **HALVES[name][1]}
    )


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(each, marks=[pytest.mark.slow] * (each == "tubes with one axis"))
        for each in HALVES
    ],
)
def test_half_and_whole_agree(name: str) -> None:
    """The size gives the whole a line in its plane: its mesh is the half's and the mirror image of
    that; 1e-8.
    """
    seen = []
    for symmetry in ("auto", "none"):
        scene = Scene(asked(name, symmetry))
        plane = scene.problem.mirror
        assert (plane is None) == (symmetry == "none")
        assert plane is None or abs(plane.normal @ ACROSS[HALVES[name][0]]) == pytest.approx(1)
        *_, last = follow(scene)
        seen.append(scene.observe(last.point.state))
    half, whole = seen
    for column in half.keys() & {"left_tip_uz", "high_end_uz", "volume_change", "energy"}:
        assert half[column] == pytest.approx(whole[column], rel=1e-8, abs=1e-13), column


def pressed(
    shell: dict[str, Any], place: dict[str, Any], boundary: dict[str, str], **move: Any
) -> dict[str, Any]:
    """Two of a shell, the upper one at a place, and pushed on the lower one."""
    lower = {"shell": {**shell, **MATERIAL}, "boundary": boundary}
    moved = [
        {
            **move,
            "supports": [f"upper.{name}" for name, held in boundary.items() if held == "clamped"],
        }
    ]
    return {
        "shells": {"lower": lower, "upper": {**lower, "place": place}},
        "contact": [["upper", "lower"]],
        "loading": {
            "kind": "edge",
            "name": "w",
            "control": "load",
            "factor": 1,
            "points": 1,
            "moves": moved,
        },
    }


PRESSED: dict[str, tuple[str, float, dict[str, Any]]] = {
    "arches that touch each other along the plane": (
        "x",
        0.2,
        pressed(
            {"geometry": "cylinder", "radius": 1, "length": 0.12, "azimuth": [60, 120]},
            {"position": [0, 2 + 1.0001 * h, 0], "turn": 180},
            {"left": "clamped", "right": "clamped", "bottom": "symmetry", "top": "symmetry"},
            translation=[0, -h / 2, 0],
        ),
    ),
    "caps with rims that touch across the plane": (
        "y",
        0.12,
        pressed(
            {"geometry": "cap", "radius": 1, "polar": 20, "hole": 5},
            {"position": [0, 0, 2 * np.cos(np.radians(5)) + 1.0001 * h], "axis": {"polar": 180}},
            {"rim": "clamped"},
            translation=[0, 0, -h / 5],
        ),
    ),
}


@pytest.fixture
def exactly() -> Iterator[None]:
    """Newton's method goes on to rounding: a stiff contact multiplies the error of u."""
    PETSc.Options().setValue("snes_stol", 1e-12)
    yield
    PETSc.Options().delValue("snes_stol")


@pytest.mark.usefixtures("exactly")
@pytest.mark.parametrize(
    "name",
    [pytest.param(each, marks=[pytest.mark.slow] * each.startswith("caps")) for each in PRESSED],
)
def test_pressed_halves_are_the_whole(name: str) -> None:
    """The half's equilibrium and its image are one of all shells on the mirrored mesh, with its
    forces: 1e-7.
    """
    across, size, data = PRESSED[name]
    data = data | {"mesh": {"degree": 3, "size": size}}
    half, whole = (
        Scene(Case.from_source(data | {"symmetry": symmetry})) for symmetry in ("half", "none")
    )
    plane = half.problem.mirror
    assert plane is not None
    assert abs(plane.normal @ ACROSS[across]) == pytest.approx(1)
    places, all_places = (scene.model.r0.x.array.reshape(-1, 3) for scene in (half, whole))
    beyond = plane.signed_distance(all_places) < -1e-9
    far, node = cKDTree(places).query(
        np.where(beyond[:, None], plane.image(all_places), all_places)
    )
    assert far.max() < 1e-12
    *_, last = follow(half)
    u = half.model.system.with_ghosts(last.point.state.u, last.point.state.mu).reshape(-1, 3)[node]
    u = np.where(beyond[:, None], u @ plane.reflection, u).ravel()
    state = State(whole.model.system.zero_at_supports(u), last.point.state.mu)
    outcome = whole.newton.solve(state, "w", PrescribedLoad("w", 1.0))
    assert outcome.converged, outcome.reason
    assert np.abs(outcome.state.u - state.u).max() < 1e-7 * np.abs(u).max()
    seen, seen_of_whole = half.observe(last.point.state), whole.observe(outcome.state)
    assert seen["contact_force"] > 0
    for column in ("contact_force", "contact_gap_over_h", "reaction", "energy", "volume_change"):
        assert seen[column] == pytest.approx(seen_of_whole[column], rel=1e-7), column


def test_modes_of_both_sides() -> None:
    """Of the half and antisymmetric to its plane they are those of all shells."""
    half, whole = (Scene(asked("plates with a crease", s)) for s in ("half", "none"))
    found = [ShellModes(scene.model).lowest(scene.unloaded(), 4) for scene in (half, whole)]
    assert {mode.label for mode in found[0][:4]} == {"", "antisymmetric"}
    values = [[mode.eigenvalue for mode in modes[:4]] for modes in found]
    assert values[0] == pytest.approx(values[1], rel=1e-7)


PLIES = {
    "along": [0, 0, 1],
    "plies": [{"angle": 30, "E1": 2, "E2": 1, "nu12": 0.3, "G12": 0.4, "fraction": 1}],
}
NOT_HALVED: dict[str, dict[str, Any]] = {
    "planes of their own": {"shells": {"low": tube(0),
                                       "high": plate([3, 1, 0], boundary={"left": "clamped"})}},
    "one that is held by nothing": {"shells": {"low": tube(0), "high": plate([3, -0.25, 0])}},
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

"""Joints of plates: a hinge and a rigid joint against beams, a crease with a spring against two
bars.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import CASES

import magshell_fenicsx as ms
from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.simulate.follow import follow

h = 0.02
D = h**3 / 12


def plate(position: list[float], polar: float = 0.0, **keys: Any) -> dict[str, Any]:
    shell = {
        "geometry": "plate",
        "length": 1,
        "width": 0.25,
        "thickness": h,
        "youngs_modulus": 1,
        "poisson_ratio": 0,
    }
    return {"shell": shell, "place": {"position": position, "axis": {"polar": polar}}, **keys}


def deflected(joint: dict[str, Any], gap: float = 0.0) -> float:
    """Of the joint of two plates, a weight of 1e-8 on the first. Their triangles do not meet."""
    left = plate([0, 0, 0], boundary={"left": "clamped"}, points={"tip": [1, 0.125, 0]})
    right = plate([1 + gap, 0, 0], boundary={"right": {"held": ["y", "z"]}}, mesh={"size": 0.1})
    loads = [{"over": "left", "per_area": [0, 0, -1e-8]}]
    data = {
        "shells": {"left": left, "right": right},
        "joints": [{"edges": ["left.right", "right.left"], **joint}],
        "mesh": {"degree": 3, "size": 0.25},
        "loading": {"kind": "dead", "control": "load", "loads": loads, "factor": 1, "points": 1},
    }
    scene = Scene(Case.from_source(data))
    *_, last = follow(scene)
    return -scene.observe(last.point.state)["left_tip_uz"]


def test_hinge() -> None:
    """A cantilever, on which the other plate hangs: q L^4/(8 D), 1e-4."""
    assert deflected({"kind": "hinge"}) == pytest.approx(1e-8 / (8 * D), rel=1e-4)


def test_rigid_and_stiff() -> None:
    """One beam of twice the length, clamped and supported, loaded on half of it: Macaulay, 1e-4."""
    R = (1 / 8 + 1 / 6) / (
        8 / 3
    )  # of the support, over q L: the free end would sink by q L^4 (1/8 + 1/6)/D
    at_joint = 1 / 8 - R * 5 / 6  # a force at the end lifts the middle by R L^3 (3 2 - 1)/(6 D)
    rigid = deflected({"kind": "rigid"})
    assert rigid == pytest.approx(1e-8 * at_joint / D, rel=1e-4)
    assert deflected({"kind": "spring", "stiffness": 1e6 * D}) == pytest.approx(rigid, rel=1e-4)


def test_unlike_materials() -> None:
    """A cantilever of two materials under a force at its end: the beam's curvature, 1e-4."""
    left = plate([0, 0, 0], boundary={"left": "clamped"})
    right = plate([1, 0, 0], points={"tip": [1, 0.125, 0]})
    right["shell"] = right["shell"] | {"youngs_modulus": 5}
    data = {
        "shells": {"left": left, "right": right},
        "joints": [{"edges": ["left.right", "right.left"]}],
        "mesh": {"degree": 3, "size": 0.25},
        "loading": {"kind": "dead", "control": "load",
                    "loads": [{"edge": "right.right", "force": [0, 0, -1e-9]}],
                    "factor": 1, "points": 1},
    }  # fmt: skip
    scene = Scene(Case.from_source(data))
    *_, last = follow(scene)
    exact = (
        1e-9 / 0.25 * (7 / 3 / D + 1 / 3 / (5 * D))
    )  # the curvature F (2 - x)/D, times 2 - x, over both parts
    assert -scene.observe(last.point.state)["right_tip_uz"] == pytest.approx(exact, rel=1e-4)


def test_angle_of_a_crease() -> None:
    """A weak spring between stiff plates: with the ends held apart it rests where two bars have its
    angle: 1e-4.
    """
    angle = 60.0
    at = np.radians(angle / 2)
    left = plate([0, 0, 0], -29.0, boundary={"left": {"held": ["x", "y", "z"]}})
    x, z = np.cos(np.radians(29.0)), np.sin(np.radians(29.0))
    right = plate(
        [x, 0, z], 29.0, boundary={"right": {"held": ["y", "z"]}}, points={"end": [1, 0.125, 0]}
    )
    data = {
        "shells": {"left": left, "right": right},
        "joints": [{"edges": ["left.right", "right.left"], "kind": "spring", "stiffness": 0.01 * D,
                    "angle": -angle}],
        "mesh": {"degree": 3, "size": 0.5},
        "loading": {"kind": "dead", "control": "load", "factor": 1, "points": 1,
                    "loads": [{"edge": "right.right", "force": [-1e-12, 0, 0]}]},
    }  # fmt: skip
    scene = Scene(Case.from_source(data))
    *_, last = follow(scene)
    along = 2 * x + scene.observe(last.point.state)["right_end_ux"]
    assert along == pytest.approx(2 * np.cos(at), rel=1e-4)


def test_a_crease_grows_by_both_words() -> None:
    """`kind: fold` of older case files gives the case of `kind: crease`; so does `ms.Step`."""
    joint = {"edges": ["left.right", "right.left"], "kind": "spring", "stiffness": D, "angle": -20}
    data = {
        "shells": {"left": plate([0, 0, 0]), "right": plate([1, 0, 0])},
        "joints": [joint],
        "mesh": {"degree": 2, "size": 0.5},
    }
    steps = {kind: [{"kind": kind, "factor": 0.5}] for kind in ("crease", "fold")}
    cases = [Case.from_source(data | {"loading": loading}) for loading in steps.values()]
    assert cases[0].model_dump() == cases[1].model_dump()
    assert cases[0].model_dump()["loading"][0]["kind"] == "crease"
    programmes = [[(s.name, s.kind, s.key) for s in case.programme] for case in cases]
    assert programmes[0] == programmes[1] == [("fold", "crease", "loading.0")]
    assert [ms.Step(kind, factor=0.5).key for kind in steps] == ["loading", "loading"]
    with pytest.raises(CaseError, match="kind: 'folds'"):
        Case.from_source(data | {"loading": [{"kind": "folds"}]})


def test_messages() -> None:
    caps = {
        name: {
            "shell": {
                "geometry": "cap",
                "radius": 1,
                "polar": 40,
                "thickness": 0.02,
                "poisson_ratio": 0.3,
            }
        }
        for name in "ab"
    }
    caps["b"] |= {"place": {"position": [0, 0, 2 * np.cos(np.radians(40))], "axis": {"polar": 180}}}
    caps["a"] |= {"boundary": {"rim": {"held": ["z"]}}}
    lens = {
        "shells": caps,
        "joints": [{"edges": ["a.rim", "b.rim"], "kind": "hinge"}],
        "loading": {"kind": "pressure"},
    }
    with pytest.raises(
        CaseError,
        match=r"symmetry: axisymmetric: a_rim: is a joined edge that is held or loaded",
    ):
        Case.from_source({**lens, "symmetry": "axisymmetric"}).problem()
    with pytest.raises(
        MeshError,
        match=r"joints.0.edges: left.right and right.left do not meet, by 0.1 R at \(1.1, ",
    ):
        deflected({"kind": "hinge"}, gap=0.1)
    with pytest.raises(
        CaseError,
        match=r"stiffness belongs to kind: spring, and must be given there; the kind is hinge",
    ):
        deflected({"kind": "hinge", "stiffness": 1})


def test_an_edge_joins_another_shell() -> None:
    """An edge lies on its own shell always: that joint would join nothing."""
    with pytest.raises(CaseError, match="stiffener: is the shell of the edge itself"):
        Case.load(
            CASES / "stiffened_plate.yaml", ["joints=[{edges: [stiffener.bottom, stiffener]}]"]
        )


BEAM = {
    "geometry": "plate",
    "length": 1,
    "width": 0.2,
    "thickness": 0.01,
    "youngs_modulus": 1,
    "poisson_ratio": 0.3,
}
LINE = {
    "shells": {
        "beam": {"shell": BEAM, "boundary": {"left": "clamped"}},
        "arm": {"shell": BEAM, "place": {"position": [1, 0, 0]}, "points": {"end": [1, 0, 0]}},
    },
    "joints": [{"edges": ["beam.right", "arm.left"]}],
    "loading": {
        "kind": "dead",
        "loads": [{"edge": "beam.right", "per_length": [0, 0, 1e-9]}],
        "factor": 1,
    },
}


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("loading.loads=[{edge: beam.right, moment: 1}]",
         "loading.loads: edge: beam.right: is a line within the surface"),
        ("loading.loads.0.edge=beam.nowhere",
         "loading.loads: edge: beam.nowhere: the surface has only arm."),
        ("loading.loads=[{at: arm.tap, force: [0, 0, 1]}]",
         "arm.tap: name it in points, with its place; there are"),
        ("shells.beam.boundary.right=clamped",
         "shells.beam.boundary.right: is a line within the surface"),
    ],
)  # fmt: skip
def test_names_in_messages_are_those_of_the_case(
    tmp_path: Path, setting: str, message: str
) -> None:
    (tmp_path / "line.yaml").write_text(yaml.safe_dump(LINE), encoding="utf-8")
    with pytest.raises(CaseError, match=re.escape(message)):
        describe(Case.load(tmp_path / "line.yaml", [setting]))


@pytest.mark.parametrize("stiffness", [2e6 * D / h, 1e9])
def test_a_joint_too_stiff_is_refused(stiffness: float) -> None:
    """A spring may be 1e6 times as stiff as the shell over its thickness, E h^2/(12 (1 - nu^2))."""
    said = (
        r"joints.0.stiffness: .* = 3.333e-05; allowed up to 1e\+06 times, 33.33: .* use kind: rigid"
    )
    with pytest.raises(CaseError, match=said):
        deflected({"kind": "spring", "stiffness": stiffness})

"""Surfaces of revolution on their meridian and as triangles: the same numbers from two discretisations."""

from typing import Any

import pytest

import magshell_fenicsx as ms
from magshell_fenicsx.case.source import Source

MATERIAL = {"thickness": 0.02, "youngs_modulus": 1.0, "poisson_ratio": 0.3}
ANNULUS = {"geometry": "annulus", "radius": 1.0, "inner_radius": 0.5, **MATERIAL}
CYLINDER = {"geometry": "cylinder", "radius": 1.0, "length": 0.8, **MATERIAL}
BULGE = {"geometry": "torus", "radius": 1.0, "tube_radius": 0.4, "tube": [-60, 60], **MATERIAL}
HOLED = {"geometry": "cap", "radius": 1.0, "polar": 60, "hole": 20, **MATERIAL}
VASE = {"geometry": "revolution", "profile": {"points": [[1.0, 0.0], [0.8, 0.4], [0.9, 0.8]]}, **MATERIAL}
DISC = {"geometry": "cap", "radius": 1.0, "polar": 40, **MATERIAL}
EVERYWHERE = {"over": "all", "pressure": 2e-6}


def dead(*loads: dict[str, Any]) -> dict[str, Any]:
    return {"kind": "dead", "loads": list(loads), "factor": 1, "points": 1, "control": "load"}


PROBLEMS: dict[str, dict[str, Any]] = {
    "ring pushed at its inner edge": {
        "shell": ANNULUS,
        "boundary": {"outer": "clamped"},
        "points": {"A": [0, 0.7, 0], "B": [-0.5, 0, 0]},
        "loading": dead({"edge": "inner", "force": [0, 0, 1e-5]}, EVERYWHERE),
    },
    "ring turned at its inner edge": {
        "shell": ANNULUS,
        "boundary": {"outer": "hinged"},
        "points": {"A": [0, 0.5, 0]},
        "loading": dead({"edge": "inner", "moment": 1e-7}),
    },
    "tube that may shorten": {
        "shell": CYLINDER,
        "boundary": {"bottom": {"held": ["x", "y", "z"]}, "top": {"held": ["x", "y"]}},
        "points": {"A": [0, 1, 0.4]},
        "loading": dead({"edge": "top", "per_length": [0, 0, -1e-6]}, EVERYWHERE),
    },
    "tube with a mirror at its middle": {
        "shell": CYLINDER,
        "boundary": {"bottom": "symmetry", "top": "clamped"},
        "points": {"A": [0, 1, 0]},
        "loading": {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.01, "points": 1},
    },
    "part of a torus": {
        "shell": BULGE,
        "boundary": {"bottom": "clamped", "top": "clamped"},
        "points": {"A": [0, 1.4, 0]},
        "loading": {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.02, "points": 1},
    },
    "cap with a hole in a field": {
        "shell": HOLED,
        "boundary": {"rim": "clamped"},
        "points": {"A": [0, 0.3420201433256687, 0.9396926207859084]},
        "magnetic": {"lambda_m": 1e-4, "remanent": {"kind": "expression", "components": ["x*z", "y*z", "1 - z"]}},
    },
    "vase of varying thickness": {
        "shell": {**VASE, "thickness_factor": "1 + 0.5*z - 0.2*sqrt(x**2 + y**2)"},
        "boundary": {"bottom": "clamped"},
        "points": {"A": [0, 0.9, 0.8]},
        "loading": dead(EVERYWHERE),
    },
    "cap on a pin": {
        "shell": DISC,
        "boundary": {"rim": {"held": ["x", "y"]}, "A": {"held": ["x", "y", "z"]}},
        "points": {"B": [0, 0.3420201433256687, 0.9396926207859084], "A": [0, 0, 1]},
        "loading": dead(EVERYWHERE),
    },
}


def ended(problem: dict[str, Any], symmetry: str, mesh: dict[str, Any]) -> tuple[ms.Scene, dict[str, float]]:
    scene = ms.Scene(ms.Case.from_source(Source("test", {**problem, "symmetry": symmetry, "mesh": mesh})))
    *_, last = ms.follow(scene)
    return scene, scene.observe(last.point.state)


@pytest.mark.parametrize("name", PROBLEMS)
def test_meridian_and_triangles(name: str) -> None:
    """To 1 %, the error of the triangles; named points lie where the meridian turns to."""
    scene, line = ended(PROBLEMS[name], "auto", {"degree": 3})
    assert scene.plan.axisymmetric
    _, surface = ended(PROBLEMS[name], "none", {"degree": 3, "size": 0.3})
    for column in ("energy", "volume_change", "w_over_h", "w_pole_over_h", "A_ux", "A_uy", "A_uz"):
        assert line[column] == pytest.approx(surface[column], rel=1e-2, abs=1e-9), column

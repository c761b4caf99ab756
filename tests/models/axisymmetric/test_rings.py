"""Surfaces of revolution on their meridian and as triangles: the same numbers from two
discretisations.
"""

from math import pi, sqrt
from typing import Any

import pytest

import magshell_fenicsx as ms
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import StepOptions
from magshell_fenicsx.mesh.patch import MeshError

MATERIAL = {"thickness": 0.02, "youngs_modulus": 1.0, "poisson_ratio": 0.3}
ANNULUS = {"geometry": "annulus", "radius": 1.0, "inner_radius": 0.5, **MATERIAL}
CYLINDER = {"geometry": "cylinder", "radius": 1.0, "length": 0.8, **MATERIAL}
BULGE = {"geometry": "torus", "radius": 1.0, "tube_radius": 0.4, "tube": [-60, 60], **MATERIAL}
HOLED = {"geometry": "cap", "radius": 1.0, "polar": 40, "hole": 20, **MATERIAL}
VASE = {
    "geometry": "revolution",
    "profile": {"points": [[1.0, 0.0], [0.8, 0.4], [0.9, 0.8]]},
    **MATERIAL,
}
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
        "loading": {
            "kind": "pressure",
            "control": "load",
            "until": "target",
            "pressure": 0.01,
            "points": 1,
        },
    },
    "part of a torus": {
        "shell": BULGE,
        "boundary": {"bottom": "clamped", "top": "clamped"},
        "points": {"A": [0, 1.4, 0]},
        "loading": {
            "kind": "pressure",
            "control": "load",
            "until": "target",
            "pressure": 0.02,
            "points": 1,
        },
    },
    "cap with a hole in a field": {
        "shell": HOLED,
        "boundary": {"rim": "clamped"},
        "points": {"A": [0, 0.3420201433256687, 0.9396926207859084]},
        "magnetic": {
            "lambda_m": 1e-4,
            "remanent": {"kind": "expression", "components": ["x*z", "y*z", "1 - z"]},
        },
    },
    "vase of varying thickness": {
        "shell": {**VASE, "thickness_factor": "1 + 0.5*z - 0.2*sqrt(x**2 + y**2)"},
        "boundary": {"bottom": "clamped"},
        "points": {"A": [0, 0.9, 0.8]},
        "loading": dead(EVERYWHERE),
    },
}

PRESSED = {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.02, "points": 1}
PROBLEMS["tube under pressure, top in a plane"] = {
    "shell": CYLINDER,
    "boundary": {"bottom": "clamped", "top": "symmetry"},
    "points": {"A": [0, 1, 0.4]},
    "loading": PRESSED,
}

FINER = {
    "part of a torus": 0.18,
    "cap with a hole in a field": 0.1,
    "vase of varying thickness": 0.09,
    "tube under pressure, top in a plane": 0.12,
}


def ended(
    problem: dict[str, Any], symmetry: str, mesh: dict[str, Any]
) -> tuple[ms.Scene, dict[str, float]]:
    scene = ms.Scene(ms.Case.from_source({**problem, "symmetry": symmetry, "mesh": mesh}))
    *_, last = ms.follow(scene)
    return scene, scene.observe(last.point.state)


def first_wave(problem: dict[str, Any], **mesh: float) -> tuple[str, float]:
    """The first mode that the meridian excludes and its load."""
    case = ms.Case.from_source({**problem, "mesh": mesh})
    found = next(record for record in ms.follow(ms.Scene(case)) if record.mode)
    return found.mode, next(iter(found.point.state.mu.values()))


SLOW = {"vase of varying thickness", "tube under pressure, top in a plane"}


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=pytest.mark.slow) if x in SLOW else x for x in PROBLEMS]
)
def test_meridian_and_triangles(name: str) -> None:
    """To the error of the triangles, which falls with the fourth power of their size: see FINER."""
    scene, line = ended(PROBLEMS[name], "auto", {"degree": 3})
    assert scene.problem.axisymmetric
    _, half = ended(PROBLEMS[name], "half", {"degree": 3, "size": FINER.get(name, 0.25)})
    for column in ("energy", "volume_change", "w_over_h", "w_pole_over_h", "A_uy", "A_uz"):
        assert line[column] == pytest.approx(half[column], rel=5e-3, abs=1e-15), column


def test_named_points_turn_with_the_meridian() -> None:
    """The same circle at the azimuths 90, 180 and 225 degrees."""
    places = {"A": [0, 0.7, 0], "B": [-0.7, 0, 0], "C": [-0.7 / sqrt(2), -0.7 / sqrt(2), 0]}
    _, found = ended(
        {**PROBLEMS["ring pushed at its inner edge"], "points": places}, "auto", {"degree": 3}
    )
    radial = found["A_uy"], -found["B_ux"], -sqrt(2) * found["C_ux"], -sqrt(2) * found["C_uy"]
    assert radial[1:] == pytest.approx([radial[0]] * 3, rel=1e-12)
    assert [found["B_uz"], found["C_uz"]] == pytest.approx([found["A_uz"]] * 2, rel=1e-12)
    assert found["A_ux"] == pytest.approx(0.0, abs=1e-15)


def test_loads_on_one_edge_and_on_another() -> None:
    """Two forces and one per length on an end are one force, beside a moment on the other end."""
    tube = {"shell": CYLINDER, "boundary": {"bottom": {"held": ["x", "y", "z"]}}}
    down, up = {"edge": "bottom", "force": [0, 0, -7e-6]}, {"edge": "top", "force": [0, 0, 4e-6]}
    turned, along = (
        {"edge": "bottom", "moment": 1e-7},
        {"edge": "top", "per_length": [0, 0, 2e-6 / (2 * pi)]},
    )
    several = [up, along, {"edge": "top", "force": [0, 0, 1e-6]}, down, turned]
    one = [{"edge": "top", "force": [0, 0, 7e-6]}, down, turned]
    a, b = (
        ended(tube | {"loading": dead(*loads)}, "auto", {"degree": 3})[1]
        for loads in (several, one)
    )
    assert a["energy"] == pytest.approx(b["energy"], rel=1e-9)


def test_plate_on_a_pin() -> None:
    """A clamped plate under q, held at its centre: mean deflection q R^4/(768 D), of Timoshenko's
    two solutions.
    """
    h, nu, q = 1 / 50, 0.3, 1e-9
    shell = {"geometry": "disc", "radius_to_thickness": 50, "poisson_ratio": nu}
    problem = {
        "shell": shell,
        "boundary": {"rim": "clamped", "A": {"held": ["z"]}},
        "points": {"A": [0, 0, 0]},
    }
    _, found = ended(
        {**problem, "loading": dead({"over": "all", "pressure": q})}, "auto", {"degree": 4}
    )
    assert found["w_over_h"] * h == pytest.approx(q * 12 * (1 - nu**2) / h**3 / 768, rel=1e-4)
    assert found["A_uz"] == pytest.approx(0, abs=1e-15)


def test_dead_force_at_a_pole_is_an_indentation() -> None:
    """F R/(2 pi D) = 0.5 as the one and as the other, on the same meridian."""
    shell, h, nu = {"geometry": "cap", "radius": 1.0, "polar": 60, **MATERIAL}, 0.02, 0.3
    force = -0.5 * 2 * pi * h**3 / (12 * (1 - nu**2))
    loads = dead({"at": "A", "force": [0, 0, force]})
    indented = {
        "kind": "indentation",
        "at": {"polar": 0},
        "control": "load",
        "force": 0.5,
        "points": 1,
    }
    common = {"shell": shell, "boundary": {"rim": "clamped"}, "points": {"A": [0, 0, 1]}}
    a, b = (
        ended({**common, "loading": loading}, "auto", {"degree": 4})[1]
        for loading in (loads, indented)
    )
    assert a["w_over_h"] == pytest.approx(b["w_over_h"], rel=1e-9)
    assert a["A_uz"] == pytest.approx(-b["w_over_h"] * h, rel=1e-9)


def test_waves_of_a_hinged_cylinder() -> None:
    """Donnell's formula for lateral pressure, ends free to warp (Brush and Almroth 1975); here half
    of its length.

    It leaves out the bending of the ends before buckling, and of the order of 1/m^2 elsewhere: 2 %.
    """
    h, nu, length = 0.01, 0.3, 1.0
    D, axial = h**3 / (12 * (1 - nu**2)), pi / length

    def pressure(m: int) -> float:
        square = (m**2 + axial**2) ** 2
        return h * axial**4 / (m**2 * square) + D * square / m**2

    critical = min(range(2, 20), key=pressure)
    shell = {**CYLINDER, "thickness": h, "length": length / 2}
    loading = {"kind": "dead", "loads": [{"over": "all", "pressure": 1e-5}], "until": "bifurcation"}
    boundary = {"bottom": "symmetry", "top": {"held": ["x", "y"]}}
    mode, factor = first_wave({"shell": shell, "boundary": boundary, "loading": loading}, degree=4)
    assert mode == f"m = {critical}"
    assert factor * 1e-5 == pytest.approx(pressure(critical), rel=2e-2)


WAVY: list[Any] = [
    ({"bottom": "clamped", "top": "clamped"}, {"kind": "pressure"}),
    pytest.param(
        {"bottom": "clamped", "top": "free"}, {"kind": "pressure"}, marks=pytest.mark.slow
    ),
    ({"bottom": "clamped"}, {"kind": "dead", "loads": [{"edge": "top", "moment": 1e-5}]}),
]


@pytest.mark.parametrize(("boundary", "loading"), WAVY)
def test_waves_are_those_of_the_half_shell(
    boundary: dict[str, Any], loading: dict[str, Any]
) -> None:
    """Its tangent has the first negative pivot within 0.5 % of the load of the first wave."""
    shell = {**CYLINDER, "thickness": 0.03}
    problem = {"shell": shell, "boundary": boundary, "loading": {**loading, "until": "bifurcation"}}
    _, load = first_wave(problem, degree=4)
    half = ms.Scene(ms.Case.from_source({**problem, "symmetry": "half", "mesh": {"size": 0.3}}))
    name = "load" if half.problem.loads.dead else "pressure"
    below, above = 0.995 * load, 1.005 * load
    path = Path(half.newton, name, "load", StepOptions(below, below, 1e-3 * below))
    pivots = [
        point.negative_pivots
        for point, at in path.continue_to(path.start(half.unloaded()), [below, above])
        if at
    ]
    assert pivots == [0, 1]


LOOSE: list[tuple[dict[str, Any], str]] = [
    ({"bottom": {"held": ["x", "y"]}}, "move along .0, 0, 1."),
    ({"bottom": {"held": ["z"]}, "top": "symmetry"}, "move along .1, 0, 0."),
    ({"bottom": "free"}, "move along .0, 0, 1."),
]


@pytest.mark.parametrize(("boundary", "motion"), LOOSE)
def test_a_loose_shell_is_refused(boundary: dict[str, Any], motion: str) -> None:
    """Rigid motions that are waves m = 1 too."""
    problem = {"shell": CYLINDER, "boundary": boundary, "loading": dead(EVERYWHERE)}
    with pytest.raises(MeshError, match=f"free to {motion}"):
        ended(problem, "auto", {"degree": 3})

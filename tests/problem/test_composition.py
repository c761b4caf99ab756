"""Shapes, loads and symmetries combine freely: the same shell described otherwise has the same
numbers.
"""

from math import cos, pi, sin
from typing import Any

import numpy as np
import pytest

import magshell_fenicsx as ms
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError

H, NU = 0.02, 0.3
DIMPLE = {"kind": "dimple", "amplitude": 1.64, "width": 3.2}
QUARTER = [[cos(a), sin(a)] for a in np.linspace(0, pi / 2, 801)[:-1]] + [[0.0, 1.0]]
SHAPES: dict[str, tuple[dict[str, Any], str]] = {
    "hemisphere": ({"geometry": "hemisphere", "radius_to_thickness": 1 / H}, "equator"),
    "cap": ({"geometry": "cap", "radius": 1.0, "thickness": H}, "rim"),
    "revolution": (
        {"geometry": "revolution", "profile": {"points": QUARTER}, "thickness": H},
        "bottom",
    ),
    "cylinder": ({"geometry": "cylinder", "radius": 1.0, "length": 1.0, "thickness": H}, "bottom"),
    "plate": ({"geometry": "plate", "length": 1.0, "width": 1.0, "thickness": H}, "left"),
    "strip": ({"geometry": "strip", "radius_to_thickness": 1 / H, "width": 0.1}, "root"),
}
COARSE = {"degree": 3, "refinement": 0.4}


def case(shape: str, shell: dict[str, Any] | None = None, **sections: Any) -> ms.Case:
    given, edge = SHAPES[shape]
    data = {
        "shell": {**given, "poisson_ratio": NU, **(shell or {})},
        "boundary": {edge: "clamped"},
        "mesh": COARSE,
    }
    return ms.Case.from_source(data | sections)


def end(asked: ms.Case) -> dict[str, float]:
    """What is observed at the end of a path."""
    scene = ms.Scene(asked)
    *_, last = ms.follow(scene)
    return scene.observe(last.point.state)


@pytest.mark.parametrize(
    "loading", [{"kind": "pressure"}, {"kind": "indentation", "at": {"polar": 0}, "depth": 2}]
)
def test_three_descriptions_of_a_dimpled_hemisphere(loading: dict[str, Any]) -> None:
    """On the same meridian; the spline through 801 points is a circle to 1e-11."""
    ends = [
        end(case(shape, {"defect": DIMPLE}, loading={**loading, "points": 2}))
        for shape in list(SHAPES)[:3]
    ]
    for other in ends[1:]:
        assert [other["p_over_pc"], other["force"]] == pytest.approx(
            [ends[0]["p_over_pc"], ends[0]["force"]], rel=1e-9
        )


def test_a_cap_is_a_hemisphere() -> None:
    """With a force that is not at the pole, on the same triangles."""
    loading = {"kind": "indentation", "at": {"polar": 40, "azimuth": 30}, "depth": 1, "points": 1}
    mesh = {"degree": 2, "refinement": 0.4}
    a, b = (
        end(case(s, loading=loading, symmetry="none", mesh=mesh))["force"]
        for s in ("hemisphere", "cap")
    )
    assert a == pytest.approx(b, rel=1e-9)


PLACES = {
    "hemisphere": [sin(0.7) * cos(0.5), sin(0.7) * sin(0.5), cos(0.7)],
    "cylinder": [cos(0.5), sin(0.5), 1.0],
}
INWARDS = {
    "hemisphere": -np.array(PLACES["hemisphere"]),
    "cylinder": -np.array([cos(0.5), sin(0.5), 0]),
}


@pytest.mark.parametrize("shape", PLACES)
def test_a_dead_force_along_the_normal_is_an_indentation(shape: str) -> None:
    """F R/(2 pi D) = 0.05 as the one and as the other, at a named point; of the hemisphere's half
    by symmetry.
    """
    points, mesh = {"A": PLACES[shape]}, {"degree": 3, "size": 0.3}
    force = 0.05 * 2 * pi * H**3 / (12 * (1 - NU**2))
    loads = [{"at": "A", "force": (force * INWARDS[shape]).tolist()}]
    modulus = {} if shape == "hemisphere" else {"youngs_modulus": 1.0}
    dead = case(
        shape,
        modulus,
        points=points,
        mesh=mesh,
        loading={"kind": "dead", "loads": loads, "factor": 1, "points": 1},
    )
    loading = {
        "kind": "indentation",
        "at": {"point": "A"},
        "control": "load",
        "force": 0.05,
        "points": 1,
    }
    indented = case(shape, points=points, mesh=mesh, loading=loading)
    a, b = end(dead), end(indented)
    assert make_problem(dead).is_half
    assert make_problem(indented).is_half
    for column in ("w_over_h", "A_ux", "A_uy", "A_uz"):
        # the vertex's normal is that of flat triangles: to the square of their angle
        assert a[column] == pytest.approx(b[column], rel=2e-3, abs=1e-9)


def test_named_points_are_told_in_the_frame_of_the_case() -> None:
    """The frame of a half model is turned into its mirror plane: the motion stays in that plane."""
    points = {"A": PLACES["hemisphere"]}
    loading = {"kind": "indentation", "at": {"point": "A"}, "depth": 1, "points": 1}
    found = end(
        case("hemisphere", points=points, loading=loading, mesh={"degree": 2, "refinement": 0.4})
    )
    assert found["A_uy"] / found["A_ux"] == pytest.approx(np.tan(0.5), rel=1e-9)


@pytest.mark.parametrize("symmetry", ["half", "none"])
@pytest.mark.parametrize("load", [{"edge": "tip"}, {"at": "A"}])
def test_a_strip_bent_by_its_tip(symmetry: str, load: dict[str, Any]) -> None:
    """F L^3/(3 E I), with a plate's stiffness lowered by its free sides: within 1 %."""
    force = 1e-4 * H**3 * 0.1 / 12 * 3
    loads = [{**load, "force": [0, 0, force]}]
    loading = {"kind": "dead", "loads": loads, "factor": 1, "points": 1, "control": "load"}
    points, mesh = {"A": [1.0, 0.0, 0.0]}, {"degree": 3, "size": 0.1}
    asked = case(
        "strip", {"poisson_ratio": 0}, points=points, loading=loading, symmetry=symmetry, mesh=mesh
    )
    assert make_problem(asked).is_half == (symmetry == "half")
    assert end(asked)["A_uz"] == pytest.approx(1e-4, rel=1e-2)


def test_a_tip_is_moved_by_its_force_as_far_as_asked() -> None:
    loads = [{"at": "A", "force": [0, 0, 1.0]}]
    asked = case(
        "strip",
        points={"A": [1.0, 0.0, 0.0]},
        loading={"kind": "dead", "loads": loads, "displacement": 1e-3, "points": 1},
        mesh={"degree": 3, "size": 0.1},
    )
    row = end(asked)
    assert row["A_uz"] == pytest.approx(1e-3, rel=1e-9)
    assert row["w_over_h"] * H == pytest.approx(1e-3, rel=1e-9)


def test_a_field_to_the_left_bends_a_strip_as_it_does_the_whole_strip() -> None:
    """The mirror plane y = 0 has the azimuths 0 and 180; a strip lies along e1 with either."""
    field = {"lambda_m": 1e-5, "applied": {"polar": 60, "azimuth": 180}}
    half, whole = (
        end(case("strip", magnetic=field, symmetry=s, mesh={"degree": 3, "size": 0.1}))["w_over_h"]
        for s in ("half", "none")
    )
    assert abs(half) > 1e-2
    assert half == pytest.approx(whole, rel=1e-3)


PUSHED = {"loading": {"kind": "dead", "loads": [{"at": "A", "force": [0, 0, 1]}], "factor": 1}}
MIRRORED: list[tuple[dict[str, Any], bool, bool]] = [
    ({}, True, True),
    ({"boundary": {"equator": {"held": ["x", "y", "z"]}}}, True, True),
    ({"boundary": {"equator": {"held": ["x", "z"]}}}, False, False),
    ({"points": {"A": [0, 0, 1.0]}}, True, True),
    ({"points": {"A": [0.6, 0, 0.8]}}, True, True),
    ({"points": {"A": [0, -0.6, 0.8]}}, True, True),
    (
        {"points": {f"{x}{y}": [x * 0.48, y * 0.36, 0.8] for x in (-1, 1) for y in (-1, 1)}},
        True,
        False,
    ),
    (
        {"points": {"A": [0.6, 0, 0.8]}, "boundary": {"equator": "clamped", "A": {"held": ["z"]}}},
        False,
        True,
    ),
    (
        {
            "loading": {
                "kind": "dead",
                "loads": [{"over": "all", "per_area": [0, 0, 1]}],
                "factor": 1,
            }
        },
        True,
        True,
    ),
    (
        {
            "loading": {
                "kind": "dead",
                "loads": [{"over": "all", "per_area": [1, 2, 0]}],
                "factor": 1,
            }
        },
        False,
        True,
    ),
    ({**PUSHED, "points": {"A": [0.6, 0, 0.8]}}, False, True),
    ({**PUSHED, "points": {"A": [0, 0, 1.0]}}, True, True),
    (
        {
            "loading": {
                "kind": "dead",
                "loads": [{"over": "all", "per_area": [1, 2, 0]}],
                "factor": 1,
            },
            "magnetic": {"lambda_m": 1e-3, "applied": {"polar": 20}},
        },
        False,
        False,
    ),
]


@pytest.mark.parametrize(("sections", "turns", "mirrors"), MIRRORED)
def test_each_part_leaves_its_symmetry(
    sections: dict[str, Any], turns: bool, mirrors: bool
) -> None:
    asked = case("hemisphere", **sections)
    problem = make_problem(asked)
    assert (problem.axisymmetric, problem.is_half) == (turns, mirrors and not turns)
    without_rotation = asked.model_copy(update={"symmetry": "half"})
    if mirrors:
        assert make_problem(without_rotation).is_half
    else:
        with pytest.raises(CaseError, match="no common mirror plane"):
            make_problem(without_rotation)


FORMULAS: list[tuple[dict[str, Any], bool]] = [
    ({"thickness_factor": "1 + 0.1*z + x**2 + y**2"}, True),
    ({"thickness_factor": "1 + 0.1*x"}, False),
    ({"thickness_factor": "1 + exp(-300*((x - cos(1.5))**2 + (y - sin(1.5))**2))"}, False),
    ({"components": ["x*z", "y*z", "1"]}, True),
    ({"components": ["-y", "x", "1"]}, False),
    ({"components": ["1", "0", "0"]}, False),
]


@pytest.mark.parametrize(("formulas", "turns"), FORMULAS)
def test_formulas_are_tried_around_the_axis(formulas: dict[str, Any], turns: bool) -> None:
    """A bump anywhere is seen, and a remanence across the meridians, which would twist the shell,
    is none of theirs.
    """
    shell = formulas if "thickness_factor" in formulas else {}
    magnetic = (
        {}
        if shell
        else {"magnetic": {"lambda_m": 1e-3, "remanent": {"kind": "expression", **formulas}}}
    )
    assert make_problem(case("cylinder", shell, **magnetic)).axisymmetric == turns


def test_a_patch_that_the_mesh_does_not_see() -> None:
    """Its radius is a fiftieth of the elements': without a word the force would be none."""
    loading = {"kind": "indentation", "at": {"point": "A"}, "depth": 1, "patch": 0.3}
    with pytest.raises(MeshError, match=r"loading.patch: its radius is 0.006 R"):
        ms.Scene(case("plate", points={"A": [1.0, 0.5, 0.0]}, mesh={"size": 0.3}, loading=loading))


ANNULUS = {
    "geometry": "annulus",
    "radius": 1.0,
    "inner_radius": 0.5,
    "thickness": H,
    "youngs_modulus": 1.0,
}


def test_half_of_a_ring_with_an_oblique_edge_load() -> None:
    """The mirror plane holds e3 and the force; the half bears half of it."""
    loading = {
        "kind": "dead",
        "loads": [{"edge": "inner", "per_length": [1e-7, 1e-6, 1e-6]}],
        "factor": 1,
        "points": 1,
    }
    data = {
        "boundary": {"outer": "clamped"},
        "mesh": {"degree": 3, "size": 0.3},
        "loading": loading,
    }
    shell = {"poisson_ratio": NU, **ANNULUS}
    half, whole = (
        end(ms.Case.from_source({"shell": shell, "symmetry": s, **data})) for s in ("half", "none")
    )
    for column in ("w_over_h", "energy"):
        assert half[column] == pytest.approx(whole[column], rel=1e-4)


def test_half_of_a_cylinder_dented_at_one_side() -> None:
    """On meshes that differ, 1 % apart."""
    points, mesh = {"A": PLACES["cylinder"]}, {"degree": 3, "size": 0.3}
    loading = {"kind": "indentation", "at": {"point": "A"}, "depth": 1, "points": 1}
    asked = [
        case("cylinder", points=points, mesh=mesh, loading=loading, symmetry=s)
        for s in ("half", "none")
    ]
    assert [make_problem(each).is_half for each in asked] == [True, False]
    half, whole = map(end, asked)
    assert half["force"] == pytest.approx(whole["force"], rel=1e-2)
    assert half["A_uy"] / half["A_ux"] == pytest.approx(np.tan(0.5), rel=1e-9)


def test_half_of_a_solid_strip_under_a_moment() -> None:
    """As the whole: 1 % apart, on meshes that differ."""
    load = {"edge": "tip", "moment": 1e-8}
    loading = {"kind": "dead", "loads": [load], "factor": 1, "points": 1, "control": "load"}
    sections = {
        "points": {"A": [1.0, 0.0, 0.0]},
        "loading": loading,
        "mesh": {"size": 0.2},
        "model": "solid",
    }
    half, whole = (end(case("strip", symmetry=s, **sections)) for s in ("half", "none"))
    assert half["A_uz"] == pytest.approx(whole["A_uz"], rel=1e-2)


@pytest.mark.slow
def test_a_solid_hemisphere_dented_at_a_named_point() -> None:
    """A direction and the point that it meets are one place; the motion is reported in the frame of
    the case.
    """
    place, patch = (
        {"points": {"A": PLACES["hemisphere"]}},
        {"kind": "indentation", "depth": 0.5, "points": 1, "patch": 3},
    )
    mesh = {"refinement": 0.25}
    polar = {"polar": float(np.degrees(0.7)), "azimuth": float(np.degrees(0.5))}
    shell = {"radius_to_thickness": 10}
    by_point, by_angle = (
        end(
            case(
                "hemisphere", shell, model="solid", mesh=mesh, loading={**patch, "at": at}, **given
            )
        )
        for at, given in (({"point": "A"}, place), (polar, {}))
    )
    # with points named, the pole is no vertex
    assert by_point["force"] == pytest.approx(by_angle["force"], rel=1e-3)
    assert by_point["A_uy"] / by_point["A_ux"] == pytest.approx(np.tan(0.5), rel=1e-9)

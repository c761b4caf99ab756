"""Imperfections on every shape: places, rims in the mesh, symmetry, and what is refused."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import CASES
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.mesh.patch import DeviatedEmbedding, check_orientation
from magshell_fenicsx.parts.imperfections.gaussian import Gaussian
from magshell_fenicsx.parts.imperfections.imperfection import (
    ImperfectionGeometry,
    imperfection_geometries,
)
from magshell_fenicsx.parts.imperfections.symmetry import imperfection_constraints
from magshell_fenicsx.parts.shell_outline import outline, reference_shell_of
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.shape.reference_shell import AngularDistance

Array = NDArray[np.float64]
H = 1 / 90
PHI_O = 3.2 / np.sqrt(3 * 90)  # nu = 0.5: 12 (1 - nu^2) = 9
SHAPES: dict[str, tuple[dict[str, Any], str]] = {
    "hemisphere": ({"geometry": "hemisphere"}, "equator"),
    "disc": ({"geometry": "disc"}, "rim"),
    "strip": ({"geometry": "strip", "width": 0.5}, "root"),
    "cap": ({"geometry": "cap", "polar": 60.0}, "rim"),
    "holed cap": ({"geometry": "cap", "polar": 60.0, "hole": 10.0}, "rim"),
    "plate": ({"geometry": "plate", "length": 1.0, "width": 0.7}, "left"),
    "cylinder": ({"geometry": "cylinder", "length": 2.0}, "bottom"),
    "annulus": ({"geometry": "annulus", "inner_radius": 0.3}, "outer"),
    "torus": ({"geometry": "torus", "tube_radius": 0.3}, ""),
    "revolution": (
        {"geometry": "revolution", "profile": {"radius": "sqrt(1-z**2)", "heights": [0.0, 1.0]}},
        "bottom",
    ),
}


def shaped(name: str, *imperfections: dict[str, Any], **others: Any) -> Case:
    shape, edge = SHAPES[name]
    shell = {"poisson_ratio": 0.5, **shape, "imperfections": list(imperfections)}
    if shape["geometry"] in ("hemisphere", "disc", "strip"):
        shell["radius_to_thickness"] = 90.0
    else:
        shell |= {"thickness": H} | (
            {"radius": 1.0} if shape["geometry"] not in ("plate", "revolution") else {}
        )
    data = {
        "shell": shell,
        "boundary": {edge: "clamped"} if edge else {},
        "mesh": {"refinement": 0.5},
        **others,
    }
    return Case.from_source({"loading": {"kind": "pressure"}, **data})


def dimple(*point: float, **others: Any) -> dict[str, Any]:
    at = {"at": {"point": [float(x) for x in point]}} if point else {}
    return {"kind": "dimple", "amplitude": 1.0, "width": 3.2, **at, **others}


def towards(polar: float, azimuth: float = 0.0, **others: Any) -> dict[str, Any]:
    return dimple(at={"polar": polar, "azimuth": azimuth}, **others)


def on_torus(theta: float, tube: float) -> tuple[float, float, float]:
    r = 1 + 0.3 * np.cos(tube)
    return r * np.cos(theta), r * np.sin(theta), 0.3 * np.sin(tube)


def beside_rim(
    problem: Problem, centre: np.ndarray, *, angle: bool, near: float = 1e-5
) -> tuple[int, int]:
    """The number of cells with nodes of their sides on both sides of a rim, and of nodes inside."""
    assert isinstance(problem.embedding, DeviatedEmbedding)
    patch = problem.triangulated()
    check_orientation(patch)
    x = problem.embedding.perfect(patch.nodes)
    chord = np.linalg.norm(x - centre, axis=1)
    away = (2 * np.arcsin(np.minimum(chord / 2, 1)) if angle else chord)[patch.cells[:, :9]] - PHI_O
    return int(((away < -near).any(axis=1) & (away > near).any(axis=1)).sum()), int(
        (away < -near).sum()
    )


@pytest.mark.parametrize(
    ("name", "centre"),
    [
        ("hemisphere", (np.sin(0.7), 0, np.cos(0.7))),
        ("hemisphere", (np.sin(1.45), 0, np.cos(1.45))),  # over the clamped edge
        ("disc", (0.4, 0.3, 0)),
        ("strip", (0.05, 0.2, 0)),  # across two edges
        ("cap", (np.sin(0.5), 0, np.cos(0.5))),
        ("holed cap", (-np.sin(0.5), 0, np.cos(0.5))),  # on the seam
        ("plate", (0, 0, 0)),
        ("cylinder", (np.cos(0.1), np.sin(0.1), 1)),
        ("cylinder", (1, 0, 0.05)),
        ("annulus", (-0.6, 0, 0)),
        ("torus", on_torus(0.1, 0.1)),  # across both seams
        ("torus", on_torus(2.0, 3.0)),
        ("revolution", (np.sin(0.7), 0, np.cos(0.7))),
    ],
)
@pytest.mark.parametrize("symmetry", ["auto", "none"])
def test_rims_are_followed(name: str, centre: tuple[float, float, float], symmetry: str) -> None:
    """By curved edges, to 1e-5: where the distance to the centre is computed here."""
    case = shaped(name, dimple(*centre), symmetry=symmetry)
    place, spherical = np.array(centre), case.shell.geometry in ("hemisphere", "cap")
    if case.symmetry == "auto" and name not in ("plate", "torus", "strip", "disc"):
        problem = make_problem(case)
        assert problem.is_half
        place = np.array(
            [np.hypot(*place[:2]), 0.0, place[2]]
        )  # the frame is turned into the plane
    else:
        problem = make_problem(shaped(name, dimple(*centre), symmetry="none"))
    across, inside = beside_rim(problem, place, angle=spherical)
    assert across == 0
    assert inside > 30


@pytest.mark.parametrize(
    ("polar", "near"),
    [(15.0, 1e-5), pytest.param(2 * np.degrees(PHI_O), 1e-3, marks=pytest.mark.slow), (22.3, 1e-5)],
)
def test_rims_that_overlap_touch_or_nearly_do(polar: float, near: float) -> None:
    """Where they touch, the mesh has them a little wider."""
    problem = make_problem(shaped("hemisphere", dimple(), towards(polar)))
    assert problem.is_half
    for angle in (0.0, np.radians(polar)):
        assert (
            beside_rim(problem, np.array([np.sin(angle), 0, np.cos(angle)]), angle=True, near=near)[
                0
            ]
            == 0
        )


@pytest.mark.parametrize(
    ("imperfections", "model"),
    [
        ([dimple(), {"kind": "gaussian", "amplitude": 1.0, "width": 2.0}], "meridian"),
        ([{"kind": "formula", "w0": "x**2 + y**2"}], "meridian"),
        ([{"kind": "formula", "w0": "0.1*sin(5*x)*cos(3*y)"}], "half"),
        ([{"kind": "formula", "w0": "x*y*(x+0.3)*(y+0.2)"}], "full"),
        ([towards(40.0, 30.0), towards(20.0, 210.0)], "half"),
        ([towards(40.0, 30.0), towards(20.0, 200.0)], "full"),
        ([towards(40.0, 30.0), towards(40.0, 100.0)], "half"),  # the plane between them
        ([towards(40.0, 30.0), towards(41.0, 100.0)], "full"),
        ([towards(40.0, 30.0), {"kind": "formula", "w0": "x"}], "full"),
    ],
)
def test_symmetry_that_is_left(imperfections: list[dict[str, Any]], model: str) -> None:
    problem = make_problem(shaped("hemisphere", *imperfections))
    assert model == ("meridian" if problem.axisymmetric else "half" if problem.is_half else "full")


@pytest.mark.parametrize("kind", ["gaussian", "dimple"])
def test_symmetry_by_numbers_is_that_by_values(kind: str) -> None:
    """Pairs across a plane, a depth in two parts, depths that cancel, a width or a depth that
    differs a little.
    """
    ground = reference_shell_of(shaped("hemisphere").shell)
    drawn = ground.perfect

    def answers(*places: tuple[float, float, float, float], formula: bool = False) -> list[bool]:
        every = [
            {
                "kind": kind,
                "amplitude": depth,
                "width": width,
                "at": {"polar": polar, "azimuth": azimuth},
            }
            for polar, azimuth, depth, width in places
        ]
        every += [{"kind": "formula", "w0": "0*x"}] * formula
        (left,) = imperfection_constraints(
            imperfection_geometries(shaped("hemisphere", *every).imperfections, ground),
            drawn,
            one_by_one=False,
        )
        return [left.mirrors(Mirror.through_axis(np.radians(azimuth))) for azimuth in (30.0, 70.0)]

    one, image = (40.0, 10.0, 0.1, 2.0), (40.0, 50.0, 0.1, 2.0)
    half, other = (*image[:2], 0.05, 2.0), (60.0, 0.0, 0.1, 2.0)
    for places, expected in (
        ([one, image], True),
        ([one, half, half], True),
        ([one, image, other, (60.0, 0.0, -0.1, 2.0)], True),
        ([one, half], False),
        ([one, (*image[:3], 2.00001)], False),
        ([one, (40.0, 50.0, 0.1000001, 2.0)], False),
        ([one, image, other], False),
    ):
        found = answers(*places)
        assert found == [expected, False]
        assert found == answers(
            *places, formula=True
        )  # a formula has no numbers: all are compared at places


class Unasked(AngularDistance):
    """An angle that is not to be computed."""

    def __call__(self, places: Array) -> Array:
        raise AssertionError(f"computed at {len(places)} places")


def test_symmetry_of_many_imperfections_is_found_by_their_numbers() -> None:
    """400 on a parallel at random, as many planes through pairs of them: none is tried by values
    all over the shell.
    """
    ats = [
        {"polar": 50.0, "azimuth": float(a)}
        for a in np.random.default_rng(1).uniform(-180, 180, 400)
    ]
    case = shaped(
        "hemisphere",
        *({"kind": "gaussian", "amplitude": 0.1, "width": 2.0, "at": at} for at in ats),
    )
    drawn, found = outline(case.shell), dict[str, ImperfectionGeometry]()
    for key, flaw in imperfection_geometries(
        case.imperfections, reference_shell_of(case.shell)
    ).items():
        deviation = flaw.deviation
        assert isinstance(deviation, Gaussian)
        assert isinstance(deviation.distance, AngularDistance)
        found[key] = replace(
            flaw, deviation=replace(deviation, distance=Unasked(deviation.distance.axis))
        )
    (left,) = imperfection_constraints(found, drawn, one_by_one=False)
    assert len(left.azimuths) == 400
    assert not any(left.mirrors(Mirror.through_axis(a)) for a in left.azimuths)


def test_deviations_add_up_along_the_normal() -> None:
    """On a cylinder: w0/h = -1 at the centre of a dimple plus 0.5 z there; 1/e at the width of a
    Gaussian dimple.
    """
    gauss = {"kind": "gaussian", "amplitude": -2.0, "width": 3.2, "at": {"point": [1.0, 0.0, 1.0]}}
    problem = make_problem(
        shaped("cylinder", dimple(1, 0, 1), {"kind": "formula", "w0": "z", "amplitude": 0.5}, gauss)
    )
    far = 2 * np.arcsin(PHI_O / 2)
    found = problem.embedding(np.array([[0.0, 1.0], [far, 1.0]]))
    expected = 1 + H * np.array([2 - 1 + 0.5, 2 / np.e + 0.5])
    assert np.hypot(found[:, 0], found[:, 1]) == pytest.approx(expected, abs=1e-12)
    assert found[:, 2] == pytest.approx([1.0, 1.0], abs=1e-12)


def test_defect_is_one_of_them() -> None:
    """A setting takes the place of the file's defect, bit by bit the same."""
    file = CASES / "dimple_buckling.yaml"
    listed = Case.load(file, ["shell.imperfections=[{kind: dimple, amplitude: 1.64, width: 3.2}]"])
    chart = np.random.default_rng(1).uniform(-0.3, 0.3, (50, 2))
    here, there = (make_problem(case).embedding(chart) for case in (Case.load(file), listed))
    assert (here == there).all()
    phi = np.hypot(*chart.T)
    w0 = np.where(phi < PHI_O, -1.64 * H * (1 - (phi / PHI_O) ** 2) ** 2, 0.0)
    assert np.linalg.norm(here, axis=1) == pytest.approx(1 + w0, abs=1e-14)


@pytest.mark.parametrize(
    ("name", "imperfections", "said"),
    [
        ("cylinder", [dimple()], "on a cylinder give its place"),
        (
            "cylinder",
            [dimple(0.5, 0, 1)],
            r"at\.point: is not on the surface; a place near it that is: \[1, 0, 1\]",
        ),
        (
            "hemisphere",
            [towards(95.0)],
            r"imperfections\.0\.at\.polar: 95: is not on the shell: allowed 0 to 90",
        ),
        ("hemisphere", [dimple(amplitude=30.0, width=0.5)], "steepest slope"),
        ("hemisphere", [{"kind": "formula", "w0": "1/z"}], "has no finite value"),
        ("holed cap", [towards(12.0)], "it would reach around the shell or its axis"),
        (
            "hemisphere",
            [dimple(at={"polar": 3.0, "point": [0.0, 0.0, 1.0]})],
            "give a point, or polar and azimuth",
        ),
        (
            "hemisphere",
            [dimple(at={"point": ["0 mm", "0 mm", "1 mm"]})],
            r"0\.at\.point\.0: has a unit",
        ),
        (
            "hemisphere",
            [{"kind": "bump"}],
            r"imperfections\.0\.kind: 'bump'; allowed: dimple, gaussian, formula",
        ),
        ("hemisphere", [dimple(widht=1.0)], "did you mean width"),
    ],
)
def test_refusals(name: str, imperfections: list[dict[str, Any]], said: str) -> None:
    with pytest.raises(CaseError, match=said):
        make_problem(shaped(name, *imperfections))


def test_defect_and_a_list_are_refused_together() -> None:
    one = "{kind: dimple, amplitude: 1, width: 3}"
    with pytest.raises(CaseError, match="give these or defect"):
        Case.load(
            CASES / "dimple_buckling.yaml", [f"shell.imperfections=[{one}]", f"shell.defect={one}"]
        )


def test_check_lists_them() -> None:
    said = describe(Case.load(CASES / "two_dimples.yaml", ["mesh.refinement=0.4"]))
    assert (
        "imperfections: dimple of 1.64 h at the pole, dimple of 1 h at polar 40, azimuth 0" in said
    )
    many = shaped(
        "hemisphere", *({"kind": "gaussian", "amplitude": 0.1, "width": 3.0} for _ in range(500))
    )
    assert "imperfections: 500 of kind gaussian" in describe(many)


def test_patches_within_each_rim() -> None:
    """Of a remanence: the first of two dimples, the second, and the rest; in a frame that is
    turned.
    """
    remanent = {
        "kind": "patches",
        "patches": {"dimple": {"polar": 90.0}, "dimple_2": {"polar": 180.0}, "rest": {}},
    }
    magnetic = {"lambda_m": 1e-3, "remanent": remanent}
    problem = make_problem(shaped("hemisphere", towards(60.0), towards(20.0), magnetic=magnetic))
    assert problem.is_half
    assert problem.loads.magnetic
    angle = np.radians([60.0, 20.0, 40.0])
    places = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])[:, None]
    found = problem.loads.magnetic.remanent(places, places)  # type: ignore[operator]
    assert found[:, 0] == pytest.approx(np.array([[1, 0, 0], [0, 0, -1], [0, 0, 1]]), abs=1e-12)


def test_a_mesh_file_moves_along_its_normals() -> None:
    """On the flat faces of the bracket by w0 = 0.01 sin(3 y), and at its fold along the mean of
    their normals.
    """
    case = Case.load(
        CASES / "bracket.yaml", ["shell.imperfections=[{kind: formula, w0: sin(3*y)}]"]
    )
    problem = make_problem(case)
    patch = problem.triangulated()
    x, moved = patch.nodes[:, :3], patch.embedding(patch.nodes)
    w0, fold = 0.01 * np.sin(3 * x[:, 1]), np.linalg.norm(x[:, [0, 2]] - [0.0, 1.0], axis=1) < 1e-9
    assert fold.sum() > 2
    assert np.linalg.norm(moved - x, axis=1) == pytest.approx(np.abs(w0), abs=1e-12)
    straight = np.abs(moved - x).max(axis=1)
    assert straight[~fold] == pytest.approx(np.abs(w0[~fold]), abs=1e-12)
    assert straight[fold] == pytest.approx(np.abs(w0[fold]) / np.sqrt(2), abs=1e-12)

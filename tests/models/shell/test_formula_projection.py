"""Formulas narrower than elements.

Source: integrals over the sphere in polar coordinates around the place.
"""

import re
from itertools import pairwise
from math import pi

import numpy as np
import pytest

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.expressions import FormulaGroup, formula
from magshell_fenicsx.models.shell.formula_projection import project_formula
from magshell_fenicsx.models.shell.spatial_fields import cell_geometry
from magshell_fenicsx.parts.shell_outline import outline
from magshell_fenicsx.problem.formulas import adaptive_cells
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.follow import follow

SPHERE = {
    "geometry": "cap",
    "radius": 1,
    "thickness": 0.01,
    "youngs_modulus": 1,
    "poisson_ratio": 0.3,
}
AWAY = "(x-0.31)**2+(y-0.23)**2"


def over_sphere(of, radius):
    """The integral of a function of the distance in the plane from (0.31, 0.23), up to a radius."""
    t, w = np.polynomial.legendre.leggauss(100)
    r, angle = np.meshgrid(radius * (t + 1) / 2, np.pi * (t + 1))
    x, y = 0.31 + r * np.cos(angle), 0.23 + r * np.sin(angle)
    return float((np.outer(w, w) * np.pi * radius / 2 * of(r) * r / np.sqrt(1 - x**2 - y**2)).sum())


def disc(radius):
    return f"(1+sign({radius}**2-({AWAY})))/2"


def dead(load, **mesh):
    return Case.model_validate(
        {
            "shell": SPHERE,
            "boundary": {"rim": "clamped"},
            "reactions": True,
            "loading": {
                "kind": "dead",
                "control": "load",
                "loads": [{"over": "all", "per_area": ["0", "0", f"-1e-7*({load})"]}],
                "factor": 1,
                "points": 1,
            },
            "mesh": {"degree": 3, "refinement": 0.7} | mesh,
        }
    )


@pytest.mark.parametrize(
    ("load", "of", "radius", "mesh"),
    [
        (f"exp(-3000*({AWAY}))", lambda r: np.exp(-3000 * r**2), 0.12, {}),
        (disc(0.001), np.ones_like, 0.001, {"size": 0.4}),
        (f"exp(-({AWAY})/0.002**2)", lambda r: np.exp(-(r**2) / 0.002**2), 0.012, {"size": 0.4}),
    ],
)
def test_all_of_a_narrow_load_is_there(load, of, radius, mesh):
    """Its resultant, on elements that are as small as it and on large ones."""
    scene = Scene(dead(load, **mesh))
    column = scene.model.system.load(scene.model.zero(), scene.unloaded().mu, "load").reshape(-1, 3)
    assert -0.01 * column[:, 2].sum() == pytest.approx(
        -1e-7 * over_sphere(of, radius), rel=1e-3
    )  # times E h R


@pytest.mark.slow
def test_all_of_a_narrow_load_is_carried():
    """By the rim."""
    scene = Scene(dead(disc(0.02)))
    end = list(follow(scene))[-1]
    force = scene.observe(end.point.state)["rim_fz"]
    assert force == pytest.approx(1e-7 * over_sphere(np.ones_like, 0.02), rel=1e-3)


def test_all_of_a_narrow_potential_is_there() -> None:
    """Of a rigid lift its energy is that of the force on a disc: pi width².

    Its place is found by no symmetry.
    """
    width = 0.002
    case = {
        "shell": {"geometry": "disc", "radius_to_thickness": 50, "poisson_ratio": 0.3},
        "boundary": {"rim": "clamped"},
        "loading": {
            "kind": "dead",
            "control": "load",
            "loads": [
                {
                    "over": "all",
                    "potential": f"1e-7*exp(-((x-0.31)**2+(y-0.17)**2)/{width}**2)*(1+z)",
                }
            ],
            "factor": 1,
            "points": 1,
        },
    }
    system = Scene(Case.model_validate(case)).model.system
    lift = np.tile([0.0, 0.0, 1e-6], system.size // 3)
    assert system.potential(lift, {}, "load") == pytest.approx(50 * 1e-13 * pi * width**2, rel=1e-4)
    coarse = describe(Case.model_validate(case | {"mesh": {"size": 0.2}}))
    assert "potential: varies so much within elements that its integral may be wrong by" in coarse


def test_moments_of_a_step_on_coarse_cells_and_a_polynomial_that_stays():
    model = Scene(dead("1 + x*y + x", degree=3, size=0.35)).model
    cells, element = cell_geometry(model.r0), model.V.element.basix_element

    def step(x, n):
        return np.sign(0.05**2 - (x[..., :1] - 0.31) ** 2 - (x[..., 1:2] - 0.23) ** 2) / 2 + 0.5

    x, normals, _ = cells.evaluate(element.points)
    fit = project_formula(step, cells, step(x, normals), element, 3)
    assert not fit.smooth
    assert fit.size == pytest.approx(over_sphere(np.ones_like, 0.05), rel=1e-3)
    flat = project_formula(lambda x, n: x, cells, x, element, 3)
    assert flat.smooth
    assert flat.nodal is x


def test_cells_are_small_where_a_formula_varies_and_no_others():
    few, many = (make_problem(dead(load)).size for load in ("1 + x", disc(0.05)))
    there, elsewhere = np.array([0.33, 0.25]), np.array([-0.5, -0.2])
    assert many(there) < 0.5 * few(there)
    assert many(elsewhere) == few(elsewhere)


def test_a_narrow_imperfection_has_few_cells():
    """As many as its width needs: 22 215 small ones everywhere before."""
    shell = {"geometry": "hemisphere", "radius_to_thickness": 100, "poisson_ratio": 0.3}
    shell |= {"imperfections": [{"kind": "formula", "w0": f"-2*exp(-3000*({AWAY}))"}]}
    case = {"shell": shell, "boundary": {"equator": "clamped"}, "loading": {"kind": "pressure"}}
    case |= {"mesh": {"degree": 3, "refinement": 0.7}}
    problem = make_problem(Case.model_validate(case))
    assert len(problem.triangulated().cells) < 1500
    assert problem.size(np.array([0.34, 0.25])) < 0.04


@pytest.mark.slow
def test_a_mesh_that_does_not_show_a_formula_says_so():
    assert "warning: loading.loads.0.per_area: varies within elements" in describe(
        dead(disc(0.05), size=0.4)
    )
    assert "warning" not in describe(dead(disc(0.05)))


@pytest.mark.parametrize("polar", ["((x-0.31)**2+(y-0.23)**2)", "((x-0.001)**2+y**2)"])
def test_a_tiny_disc_of_remanence_is_neither_missed_nor_axisymmetric(polar):
    """Off the axis, and almost on it: no model of the meridian, and elements as small as it there
    alone.
    """
    shell = {"geometry": "hemisphere", "radius_to_thickness": 100, "poisson_ratio": 0.3}
    field = {
        "lambda_m": 0.001,
        "remanent": {"kind": "expression", "components": [0, 0, f"(1+sign(0.004**2-{polar}))/2"]},
    }
    case = {
        "shell": shell,
        "boundary": {"equator": "clamped"},
        "magnetic": field,
        "mesh": {"degree": 3, "refinement": 0.7},
    }
    problem = make_problem(Case.model_validate(case | {"loading": {"kind": "field", "points": 1}}))
    assert problem.meridian is None
    assert problem.size(problem.shape.reach * np.ones(2) / 9) > 10 * min(
        f.size for f in problem.size.features
    )
    assert min(f.size for f in problem.size.features) < 0.002


def test_the_cost_of_finding_grows_slowly_and_smooth_formulas_have_none():
    """Parts that are looked at, as the disc becomes a thousand times smaller."""
    there = outline(dead("1").shell)
    parts = {
        text: len(adaptive_cells(FormulaGroup([formula(text)]), there).area)
        for text in ("2", "1 + x*y", disc(1e-2), disc(1e-5))
    }
    assert parts["1 + x*y"] == parts["2"]
    assert parts[disc(1e-5)] < 1.5 * parts[disc(1e-2)] < 15_000


def test_a_thickness_that_jumps_in_elements_says_what_that_costs():
    shell = {
        "geometry": "plate",
        "length": 1,
        "width": 1,
        "thickness": 0.01,
        "youngs_modulus": 1,
        "poisson_ratio": 0.3,
    }
    case = dead("1", size=0.1).model_dump(mode="json", exclude_unset=True) | {
        "shell": shell | {"thickness_factor": "1.5-0.5*sign(x-0.47)"},
        "boundary": {"left": "clamped"},
        "mesh": {"degree": 3, "size": 0.1},
    }
    assert "the stiffness may be wrong by" in describe(Case.model_validate(case))


@pytest.mark.parametrize(
    ("factor", "break_at"),
    [("1.5-0.5*sign(x-0.53)", 0.53), ("1-0.5*exp(-((x-0.05)/0.01)**2)", 0.05)],
)
def test_the_stiffness_that_is_lost_is_said_within_a_factor_of_two(
    factor: str, break_at: float
) -> None:
    """A cantilever under a force at its tip, against the integral of (1 - x)^2/t^3."""
    x, weights = (
        np.concatenate(each)
        for each in zip(*(_gauss(a, b) for a, b in _around(break_at)), strict=True)
    )
    t = eval(factor, {"x": x, "sign": np.sign, "exp": np.exp})
    exact = 3 * float(weights @ ((1 - x) ** 2 / t**3))
    tips = []
    for thickness in (factor, "1 + 0*x"):
        case = Case.model_validate(
            {
                "shell": {
                    "geometry": "strip",
                    "radius_to_thickness": 50,
                    "width": 0.1,
                    "poisson_ratio": 0.0,
                }
                | {"thickness_factor": thickness},
                "boundary": {"root": "clamped"},
                "points": {"tip": [1, 0, 0]},
                "loading": {
                    "kind": "dead",
                    "loads": [{"at": "tip", "force": [0, 0, 1e-12]}],
                    "factor": 1,
                    "points": 1,
                },
                "mesh": {"size": 0.3},
            }
        )
        scene = Scene(case)
        *_, record = follow(scene)
        tips.append(scene.observe(record.point.state)["tip_uz"])
        (said, *_) = [*re.findall(r"the stiffness may be wrong by ([\d.]+) %", describe(case)), "0"]
        if thickness == factor:
            lost = float(said) / 100
    error = 1 - tips[0] / tips[1] / exact
    assert error / 2 < lost < 2 * error


def _around(place: float) -> list[tuple[float, float]]:
    ends = sorted({0.0, 1.0, place, *(place + d for d in (-0.04, -0.02, 0.02, 0.04))})
    return list(pairwise(ends))


def _gauss(a: float, b: float) -> tuple[np.ndarray, np.ndarray]:
    x, w = np.polynomial.legendre.leggauss(30)
    return (a + b + (b - a) * x) / 2, (b - a) / 2 * w

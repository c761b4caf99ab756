"""Formulas narrower than elements. Source: integrals over the sphere in polar coordinates around the place."""

import numpy as np
import pytest

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.models.shell.fitted import fitted
from magshell_fenicsx.models.shell.patterns import cells_of
from magshell_fenicsx.problem.check import describe
from magshell_fenicsx.problem.planner import make_plan
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.scene import Scene

SPHERE = {"geometry": "cap", "radius": 1, "thickness": 0.01, "youngs_modulus": 1, "poisson_ratio": 0.3}
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
    ("load", "of", "radius"),
    [
        (disc(0.02), np.ones_like, 0.02),
        (disc(0.05), np.ones_like, 0.05),
        (f"exp(-3000*({AWAY}))", lambda r: np.exp(-3000 * r**2), 0.12),
    ],
)
def test_all_of_a_narrow_load_is_carried(load, of, radius):
    scene = Scene(dead(load))
    end = list(follow(scene))[-1]
    force = scene.observe(end.point.state)["rim_fz"]
    assert force == pytest.approx(1e-7 * over_sphere(of, radius), rel=1e-3)


def test_moments_of_a_step_on_coarse_cells_and_a_polynomial_that_stays():
    model = Scene(dead("1 + x*y + x", degree=3, size=0.35)).model
    cells, element = cells_of(model.r0), model.V.element.basix_element

    def step(x, n):
        return np.sign(0.05**2 - (x[..., :1] - 0.31) ** 2 - (x[..., 1:2] - 0.23) ** 2) / 2 + 0.5

    x, normals, _ = cells.at(element.points)
    fit = fitted(step, cells, step(x, normals), element, 3)
    assert not fit.smooth
    assert fit.size == pytest.approx(over_sphere(np.ones_like, 0.05), rel=1e-3)
    flat = fitted(lambda x, n: x, cells, x, element, 3)
    assert flat.smooth
    assert flat.nodal is x


def test_cells_are_small_where_a_formula_varies_and_no_others():
    few, many = (make_plan(dead(load)).size for load in ("1 + x", disc(0.05)))
    there, elsewhere = np.array([0.33, 0.25]), np.array([-0.5, -0.2])
    assert many(there) < 0.5 * few(there)
    assert many(elsewhere) == few(elsewhere)


def test_a_narrow_imperfection_has_few_cells():
    """As many as its width needs: 22 215 small ones everywhere before."""
    shell = {"geometry": "hemisphere", "radius_to_thickness": 100, "poisson_ratio": 0.3}
    shell |= {"imperfections": [{"kind": "formula", "w0": f"-2*exp(-3000*({AWAY}))"}]}
    case = {"shell": shell, "boundary": {"equator": "clamped"}, "loading": {"kind": "pressure"}}
    case |= {"mesh": {"degree": 3, "refinement": 0.7}}
    plan = make_plan(Case.model_validate(case))
    assert len(plan.triangulated().cells) < 1500
    assert plan.size(np.array([0.34, 0.25])) < 0.04


def test_a_mesh_that_does_not_show_a_formula_says_so():
    assert "warning: loading.loads.0.per_area: varies within elements" in describe(dead(disc(0.05), size=0.4))
    assert "warning" not in describe(dead(disc(0.05)))

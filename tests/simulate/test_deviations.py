"""Gradients by the drawn shape at a shape that deviates, against new cases on the same
triangulation of the chart.

What formulas say by the place, loads per area and along normals, widths of cells: all are those of
the new shape.
"""

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.assembly.field_gradient import FieldGradient
from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.gradients.gradient import gradient
from magshell_fenicsx.simulate.results import functional
from magshell_fenicsx.simulate.scene_cache import problem_on_mesh_of

Array = NDArray[np.float64]
STEP = 1e-2  # of h
STRIP: dict[str, Any] = {
    "shell": {
        "geometry": "strip", "radius": "1 m", "thickness": "10 mm", "width": 0.1,
        "poisson_ratio": 0.2,
        "youngs_modulus": "1 Pa", "imperfections": [{"kind": "formula", "w0": "3*x**2*(1 - x)"}],
        "thickness_factor": "1 + 0.3*x + 5*z",
    },
    "boundary": {"root": "clamped"}, "points": {"tip": ["1 m", 0, 0]},
    "mesh": {"degree": 2, "refinement": 0.4},
    "magnetic": {
        "lambda_m": 3.3e-5, "applied": {"polar": 0},
        "remanent": {"kind": "expression", "components": ["cos(3*x) + 10*z", "0", "1 + x*z"]},
    },
    "natural": {"curvature": ["0.2*x + 10*z", 0.1, 0]},
    "loading": {
        "kind": "dead", "control": "load", "factor": 0.5, "points": 1,
        "loads": [
            {"over": "all", "per_area": [0, 0, "1e-8*(1 + 30*z)"]},
            {"edge": "tip", "force": ["1e-10 N", 0, "2e-10 N"]},
            {"over": "all", "pressure": "1e-9 Pa"},
        ],
    },
}  # fmt: skip
CAP: dict[str, Any] = {
    "shell": {
        "geometry": "cap", "radius": "1 m", "polar": 30, "thickness": "20 mm",
        "youngs_modulus": "1 Pa", "poisson_ratio": 0.3,
        "imperfections": [{"kind": "formula", "w0": "-2*exp(-(x**2 + y**2)/0.05)"}],
        "thickness_factor": "0.8 + z",
    },
    "boundary": {"rim": "clamped"}, "points": {"top": [0, 0, "1 m"]},
}  # fmt: skip
DEAD = {"kind": "dead", "loads": [{"over": "all", "per_area": [0, 0, "-1e-6 Pa"]}], "factor": 0.5}
PUSHED = {"kind": "indentation", "force": 0.3}
ALONG, AROUND = "1 + x + 0.5*sin(3*x)", "cos(6*sqrt(x**2 + y**2))"


def along(x: Array) -> Array:
    return np.asarray(1 + x[..., 0] + 0.5 * np.sin(3 * x[..., 0]))


def around(x: Array) -> Array:
    return np.asarray(np.cos(6 * np.hypot(x[..., 0], x[..., 1])))


def further(data: dict[str, Any], w0: str, c: float) -> Case:
    """With one more deviation."""
    data = deepcopy(data)
    data["shell"]["imperfections"].append({"kind": "formula", "w0": f"{c!r}*({w0})"})
    return Case.from_source(data)


@pytest.mark.parametrize(
    ("data", "way", "load", "results"),
    [
        pytest.param(STRIP, ALONG, "load", ["tip_uz", "w_over_h"], id="strip",
                     marks=pytest.mark.slow),
        pytest.param(CAP | {"loading": DEAD}, AROUND, "load", ["top_uz", "w_over_h"],
                     id="meridian"),
        pytest.param(
            CAP | {"loading": PUSHED, "symmetry": "half", "mesh": {"degree": 3, "size": "0.2 m"}},
            AROUND, "force", ["w_over_h"], id="half", marks=pytest.mark.slow,
        ),
    ],
)  # fmt: skip
def test_new_cases(data: dict[str, Any], way: str, load: str, results: list[str]) -> None:
    """Displacements, also along loads: differences of fourth order."""
    data = data | {"loading": {"control": "load", "points": 1} | data["loading"]}
    scene = Scene(further(data, way, 0.0))
    *_, last = follow(scene)
    state, values = last.point.state, list[list[float]]()
    for c in (-2, -1, 1, 2):
        other = Scene(problem_on_mesh_of(scene, further(data, way, c * STEP).problem()))
        solution = other.newton.solve(state, load, PrescribedLoad(load, state.mu[load]))
        assert solution.converged
        values.append([functional(other, solution.state, of).value for of in results])
    for of, (a, b, c, d) in zip(results, np.transpose(values), strict=True):
        found = gradient(scene, last, of=of, by="deviation")["deviation"]
        assert isinstance(found, FieldGradient)
        w0 = scene.problem.material.h * (along if way == ALONG else around)(found.places)
        assert found.along(w0[..., None]) == pytest.approx(
            (8 * (c - b) - (d - a)) / (12 * STEP), rel=1e-6
        ), of

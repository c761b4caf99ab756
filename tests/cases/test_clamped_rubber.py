"""Rubber at a clamped edge: the layer in which it bends sharply makes no false instability.

Sources: an axisymmetric solid of three dimensions has p R/(mu h) = 1.891(1) at the fold of a
clamped disc with R/h = 50. That of a clamped cap of 40 degrees with R/h = 50 has its fold at
35.97(1) p_c and no bifurcation up to a volume of 3 R^3.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.models.axisymmetric.meridian import with_cell_at_edge
from magshell_fenicsx.public import run
from magshell_fenicsx.runs.running import _way_to_estimate

RUBBER = {"poisson_ratio": 0.5, "law": "neo-hookean"}
MODELS: list[Mapping[str, Any]] = [
    {"mesh": {"refinement": 0.5}},
    {"mesh": {"refinement": 4}},
    {"symmetry": "half"},
]


@pytest.mark.parametrize(
    ("model", "tolerance"),
    [
        ({}, 1e-3),
        *(pytest.param(model, 1e-3, marks=pytest.mark.slow) for model in MODELS),
        ({"mesh": {"degree": 3}}, 5e-3),
        pytest.param({"mesh": {"degree": 3}, "symmetry": "half"}, 8e-3, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_the_fold_of_a_clamped_disc(model: Mapping[str, Any], tolerance: float) -> None:
    """The fold is that of the solid; with soft penalties it was a fourth lower."""
    shell = {"geometry": "disc", "radius_to_thickness": 50} | RUBBER
    loading = {"kind": "pressure", "control": "arc", "until": "limit"}
    rows = run({"shell": shell, "boundary": {"rim": "clamped"}, "loading": loading, **model}).rows
    assert rows[-1]["label"] == "fold"
    # p over mu h/R: the classical pressure p_c is 4 mu (h/R)^2 for a Poisson's ratio of 0.5
    assert 4 * float(rows[-1]["p_over_pc"]) / 50 == pytest.approx(1.891, rel=tolerance)


@pytest.mark.parametrize(
    "model", [{}, *(pytest.param(each, marks=pytest.mark.slow) for each in MODELS)], ids=str
)
def test_a_clamped_cap_blown_up(model: Mapping[str, Any]) -> None:
    """Its fold is the solid's, and the only instability; before, modes at the rim were unstable."""
    shell = {"geometry": "cap", "polar": 40, "radius": 1, "thickness": 0.02, "youngs_modulus": 1}
    loading = {
        "kind": "pressure",
        "control": "volume",
        "until": "target",
        "volume_change": 3.0,
        "points": 3,
    }
    case = {"shell": shell | RUBBER, "boundary": {"rim": "clamped"}, "loading": loading}
    result = run(case | dict(model))
    rows = result.rows
    (event,) = [row for row in rows if row["label"] in ("fold", "bifurcation")]
    assert event["label"] == "fold"
    assert float(event["p_over_pc"]) == pytest.approx(-35.97, rel=1e-3)
    assert float(rows[-1]["volume_change"]) == pytest.approx(3.0)
    if not model:  # no estimate, where one degree more is out of reach of Newton's method
        assert result.errors.get("knockdown", 0.0) < 5e-3 * 35.97


def test_one_cell_at_an_edge() -> None:
    vertices = np.linspace(0.0, 1.0, 101)
    at_end = with_cell_at_edge(vertices, 1.0, 0.05)
    assert at_end[-3:] == pytest.approx([0.92, 0.95, 1.0])
    at_begin = with_cell_at_edge(vertices, 0.0, 0.05)
    assert at_begin[:3] == pytest.approx([0.0, 0.05, 0.08])
    assert with_cell_at_edge(vertices, 1.0, 0.4) is vertices


@pytest.mark.parametrize(
    ("rim", "law", "warned"),
    [("clamped", RUBBER, True), ("hinged", RUBBER, False), ("clamped", {}, False)],
)
def test_warning_of_the_layer(rim: str, law: Mapping[str, Any], warned: bool) -> None:
    shell = {"geometry": "disc", "radius_to_thickness": 100, "poisson_ratio": 0.5, **law}
    loading = {"kind": "pressure", "control": "arc", "until": "target", "pressure": 0.1}
    case = {"shell": shell, "boundary": {"rim": rim}, "loading": loading}
    warnings = make_problem(Case.from_source(case)).warnings
    layer = "boundary.rim: clamped: blown-up rubber bends there in a layer"
    assert any(warning.startswith(layer) for warning in warnings) == warned


@pytest.mark.parametrize(
    ("rim", "mesh", "way_on"),
    [
        ("clamped", {}, "give mesh.degree: 5"),
        ("clamped", {"tolerance": 1e-3}, "give mesh.degree: 5 in place of mesh.tolerance"),
        ("clamped", {"degree": 5}, "mesh.tolerance, such as 1e-3, finds a mesh and gives one; or "),
        ("hinged", {}, "mesh.tolerance, such as 1e-3, finds a mesh and gives one; or "),
    ],
)
def test_way_to_an_estimated_error(rim: str, mesh: Mapping[str, Any], way_on: str) -> None:
    """Where the refinement leaves the cells at the rim as they are, a higher degree is named."""
    shell = {"geometry": "disc", "radius_to_thickness": 50} | RUBBER
    loading = {"kind": "pressure", "control": "arc", "until": "limit"}
    case = {"shell": shell, "boundary": {"rim": rim}, "loading": loading, "mesh": mesh}
    assert _way_to_estimate(make_problem(Case.from_source(case))).startswith(way_on)


def test_warning_of_the_layer_of_several_shells() -> None:
    """Each shell of rubber that a pressure blows up at a clamped rim has one; others have none."""
    sizes = {"radius": "50 mm", "thickness": "0.5 mm", "youngs_modulus": "1 MPa"}
    shell = {"geometry": "disc", **sizes}
    rubber = {"shell": shell | {"poisson_ratio": 0.5} | RUBBER, "boundary": {"rim": "clamped"}}
    stiff = {"shell": shell | {"poisson_ratio": 0.3}, "boundary": {"rim": "clamped"}}
    shells = {
        name: member | {"place": {"position": ["0 mm", "0 mm", f"{100 * z} mm"]}}
        for z, (name, member) in enumerate(
            {"pressed": rubber, "aside": rubber, "stiff": stiff}.items()
        )
    }
    on = {"pressed": "inside", "stiff": "inside"}
    loading = {"kind": "pressure", "control": "arc", "until": "target", "pressure": 0.1, "on": on}
    problem = make_problem(Case.from_source({"shells": shells, "loading": loading}))
    warned = [warning for warning in problem.warnings if "blown-up rubber" in warning]
    assert [warning.split(":")[0] for warning in warned] == ["shells.pressed.boundary.rim"]

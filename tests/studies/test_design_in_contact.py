"""Designs of several shells: a field that changes the gap between those that touch, and fields of
all of them.
"""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from command import magshell
from sheets import Sheet, write

from magshell_fenicsx import Case
from magshell_fenicsx.input.source import read_source
from magshell_fenicsx.simulate.scene_cache import SceneCache
from magshell_fenicsx.studies.design.evaluation import DesignEvaluation, evaluate
from magshell_fenicsx.studies.design.variables import variables

h = 0.02


@pytest.mark.slow
def test_thickness_of_two_strips(tmp_path: Path) -> None:
    """The upper of two cantilevers presses on the lower one, whose tip sinks less if roots are
    thick.
    """
    strips = [
        Sheet(n, (0, 0, z), (1, 0, 0), (0, 0.2, 0), (5, 1))
        for n, z in (("lower", 0), ("upper", 1.4 * h))
    ]
    write(tmp_path / "strips.msh", strips)
    shell = {
        "geometry": "mesh",
        "file": "strips.msh",
        "radius": 1,
        "thickness": h,
        "youngs_modulus": 1,
    }
    case = {
        "shell": shell | {"poisson_ratio": 0},
        "boundary": {"lower_4": "clamped", "upper_4": "clamped"},
        "points": {"tip": [1, 0, 0]},
        "contact": [["upper", "lower"]],
        "mesh": {"degree": 2},
        "loading": {
            "kind": "dead", "control": "load", "factor": 1, "points": 1,
            "loads": [{"over": "upper", "per_area": [0, 0, -0.1 * h**3]}],
        },
        "design": {
            "objective": {"maximise": "tip_uz"}, "iterations": 2,
            "thickness": {"points": 4, "values": [0.8, 1.3]},
            "constraints": [{"of": "mass", "most": 1}],
        },
    }  # fmt: skip
    (tmp_path / "strips.yaml").write_text(yaml.safe_dump(case))
    done = magshell("design", tmp_path / "strips.yaml", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert content["best"]["tip_uz"] > 0.98 * content["start"]["tip_uz"]
    assert content["best"]["mass"] == pytest.approx(1, abs=1e-6)
    assert content["verified"]["tip_uz"] == pytest.approx(content["best"]["tip_uz"], rel=1e-6)


@pytest.mark.parametrize(
    ("field", "values", "change"),
    [
        pytest.param("thickness", [0.5, 2], [0, 0.05, 0.1, 0.15], marks=pytest.mark.slow),
        ("deviation", [-1, 1], [0.1, -0.2, 0.05, 0.3]),
    ],
)
def test_fields_of_unlike_shells(
    field: str, values: list[float], change: list[float], tmp_path: Path
) -> None:
    """A strip, and a thicker and shorter one that is turned: results by a random change of a field,
    by differences.
    """
    strip = {"geometry": "strip", "width": 0.2, "poisson_ratio": 0, "youngs_modulus": "1 MPa"}

    def of(length: float, thickness: float, **place: object) -> dict[str, object]:
        shell = {**strip, "radius": f"{length} mm", "thickness": f"{thickness} mm"}
        return {
            "shell": shell,
            "boundary": {"root": "clamped"},
            "points": {"tip": [f"{length} mm", 0, 0]},
            **place,
        }

    turned = {"place": {"position": ["3 mm", "5 mm", "8 mm"], "axis": {"polar": 40, "azimuth": 70}}}
    loads = [{"at": f"{name}_tip", "force": [0, 0, "-1e-5 N"]} for name in ("long", "short")]
    case = {
        "shells": {"long": of(50, 1), "short": of(35, 1.4, **turned)},
        "mesh": {"degree": 3, "size": "20 mm"},
        "loading": {"kind": "dead", "control": "load", "factor": 1, "points": 1, "loads": loads},
        "design": {
            "objective": {"maximise": "short_tip_uz"}, field: {"points": 4, "values": values},
            "constraints": [{"of": "long_tip_uz", "least": -9}],
        },
    }  # fmt: skip
    (tmp_path / "strips.yaml").write_text(yaml.safe_dump(case))
    source = read_source(tmp_path / "strips.yaml")
    made = Case.from_source(source)
    assert made.design
    vary, standing = (
        variables(source, made, made.design, Case.from_source),
        SceneCache(overwrites=True),
    )
    start = vary.start_values + change
    way, results = (
        np.random.default_rng(0).standard_normal(len(start)),
        ["long_tip_uz", "short_tip_uz", "mass"],
    )

    def at(c: float) -> DesignEvaluation:
        there = vary.case_of(start + c * way, tmp_path / "B.csv")
        return evaluate(there, start, vary, results, {}, standing)

    here, (further, back) = at(0.0), (at(1e-3), at(-1e-3))
    for result in results:
        expected = (further.values[result] - back.values[result]) / 2e-3
        assert np.array(here.gradients[result]) @ way == pytest.approx(expected, rel=1e-5)

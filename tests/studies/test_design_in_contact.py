"""A design whose field changes the gap between shells that touch."""

import json
from pathlib import Path

import pytest
import yaml
from command import magshell
from sheets import Sheet, write

h = 0.02


@pytest.mark.slow
def test_thickness_of_two_strips(tmp_path: Path) -> None:
    """The upper of two cantilevers presses on the lower one, whose tip sinks less if roots are thick."""
    strips = [Sheet(n, (0, 0, z), (1, 0, 0), (0, 0.2, 0), (5, 1)) for n, z in (("lower", 0), ("upper", 1.4 * h))]
    write(tmp_path / "strips.msh", strips)
    shell = {"geometry": "mesh", "file": "strips.msh", "radius": 1, "thickness": h, "youngs_modulus": 1}
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
            "thickness": {"points": 4, "values": [0.8, 1.3]}, "constraints": [{"of": "mass", "most": 1}],
        },
    }  # fmt: skip
    (tmp_path / "strips.yaml").write_text(yaml.safe_dump(case))
    done = magshell("design", tmp_path / "strips.yaml", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert content["best"]["tip_uz"] > 0.98 * content["start"]["tip_uz"]
    assert content["best"]["mass"] == pytest.approx(1, abs=1e-6)
    assert content["verified"]["tip_uz"] == pytest.approx(content["best"]["tip_uz"], rel=1e-6)

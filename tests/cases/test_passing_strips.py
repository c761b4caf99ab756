"""A step on which shells would pass through each other is shortened: the same on two ranks, and
after a resume.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from command import mpirun, read_path

h = 0.005
STRIP = {
    "geometry": "plate",
    "length": 1,
    "width": 0.1,
    "thickness": h,
    "youngs_modulus": 1,
    "poisson_ratio": 0,
}
HELD = {"left": "clamped", "right": "clamped"}
CASE: dict[str, Any] = {
    "shells": {
        "lower": {"shell": STRIP, "boundary": {"right": "clamped"}},
        "upper": {
            "shell": STRIP | {"length": 0.6, "youngs_modulus": 100}, "boundary": HELD,
            "place": {"position": [0.2, 0, 1.6 * h], "axis": {"polar": -1, "azimuth": 0}},
        },
    },
    "contact": [["upper", "lower"]],
    "mesh": {"degree": 2, "size": 0.1},
    "loading": {
        "kind": "edge", "control": "load", "points": 1, "factor": 1,
        "moves": [{"supports": ["upper.left", "upper.right"], "translation": [0, 0, -2 * h]}],
    },
}  # fmt: skip
# a step longer than 0.5 counts as one that passes through; the process dies at the second look at a
# step, if it shall
RUN = """
import os, sys
from magshell_fenicsx.cli import main
from magshell_fenicsx.parts.contact.surface_contact import SurfaceContact
from magshell_fenicsx.simulate import path_records

sees, refuse, looks = SurfaceContact.passes_through, path_records.refuse_passing, []
long = [False]
SurfaceContact.passes_through = lambda self, u, v: sees(self, u, v) or long[0]

def refuse_passing(stage, low, high):
    looks.append(high.s)
    if len(looks) == int(os.environ.get("DIES", "0")):
        os._exit(9)
    long[0] = high.s - low.s > 0.5
    refuse(stage, low, high)

path_records.refuse_passing = refuse_passing
sys.argv = ["magshell", *sys.argv[1:]]
main()
"""


def run(folder: Path, *words: str, ranks: int = 1, dies: int = 0) -> int:
    """The exit code of a run that takes long steps for ones that pass through."""
    (folder.parent / "case.json").write_text(json.dumps(CASE), encoding="utf-8")
    command = [*mpirun(ranks), sys.executable, "-c", RUN, "run"]
    command += [str(folder.parent / "case.json"), "--no-pictures", "--out", str(folder), *words]
    told = {**os.environ, "DIES": str(dies)} if dies else None
    return subprocess.run(command, capture_output=True, check=False, env=told).returncode


@pytest.mark.slow
def test_shortened_steps(tmp_path: Path) -> None:
    """Steps, motion and contact force to 1e-9: on one rank; on two, killed behind the shortened
    step, then resumed.
    """
    one, resumed = tmp_path / "one", tmp_path / "resumed"
    assert run(one) == 0
    assert run(resumed, ranks=2, dies=4) != 0
    assert run(resumed, "--resume") == 0
    wanted = read_path(one)
    assert [row["label"] for row in wanted].count(
        "step"
    ) >= 2  # that to the first touch, and the shortened one
    rows = read_path(resumed)
    assert [row["label"] for row in rows] == [row["label"] for row in wanted]
    for key in ("motion", "contact_force"):
        values = [float(row[key]) for row in rows]
        assert values == pytest.approx([float(row[key]) for row in wanted], rel=0, abs=1e-9), key

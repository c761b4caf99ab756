"""Runs of several shells that are joined: on several ranks, and interrupted."""

from pathlib import Path

import numpy as np
import pytest
from command import all_started, magshell, read_path
from conftest import CASES
from interrupted import kill, start, wait_for_rows

import magshell_fenicsx as ms

SHORT = ["--set=loading.displacement=0.02", "--set=loading.points=2", "--no-pictures"]
EXACT = ("w_over_h", "left_crease_uz", "load_factor", "energy")


def command(out: Path) -> list[str]:
    return ["run", str(CASES / "crease.yaml"), *SHORT, "--out", str(out)]


@pytest.mark.slow
def test_ranks(tmp_path: Path) -> None:
    """1 and 2: every target to 1e-9 of the largest value."""
    assert magshell(*command(tmp_path / "1")).returncode == 0
    done = all_started([command(tmp_path / "2")], 2)
    assert done.returncode == 0, done.stderr
    one, two = (read_path(tmp_path / ranks) for ranks in "12")
    assert [row["label"] for row in two] == [row["label"] for row in one]
    for column in EXACT:
        a, b = (
            np.array([float(row[column]) for row in rows if row["label"] == "target"])
            for rows in (one, two)
        )
        assert a == pytest.approx(b, rel=0, abs=1e-9 * np.abs(a).max()), column


@pytest.mark.slow
def test_ranks_of_a_junction(tmp_path: Path) -> None:
    """1 and 3, of which one has no part of the edge: 1e-9."""
    short = ["--set=mesh.size=25 mm", "--set=loading.points=1", "--no-pictures"]
    case = ["run", str(CASES / "stiffened_plate.yaml"), *short, "--out"]
    assert magshell(*case, str(tmp_path / "1")).returncode == 0
    done = all_started([[*case, str(tmp_path / "3")]], 3)
    assert done.returncode == 0, done.stderr
    one, three = (read_path(tmp_path / ranks)[-1] for ranks in "13")
    for column in ("w_over_h", "plate_tip_uz", "energy"):
        assert float(three[column]) == pytest.approx(float(one[column]), rel=1e-9), column


@pytest.mark.slow
def test_resume(tmp_path: Path) -> None:
    """Killed on the way and resumed: the same rows to the last digit."""
    assert magshell(*command(tmp_path / "whole")).returncode == 0
    run = start(*command(tmp_path / "killed"))
    wait_for_rows(run, tmp_path / "killed", 2)
    kill(run, 0)
    assert len(read_path(tmp_path / "killed")) < len(read_path(tmp_path / "whole"))
    assert magshell(*command(tmp_path / "killed"), "--resume").returncode == 0
    whole, again = (read_path(tmp_path / name) for name in ("whole", "killed"))
    for column in ("label", *EXACT):
        assert [row[column] for row in again] == [row[column] for row in whole]


def test_two_shells_from_python() -> None:
    """Caps apart, one upside down and thicker, under one pressure: each moves as if alone."""
    keys = {"radius": "25 mm", "polar": 25, "youngs_modulus": "1.8 MPa", "poisson_ratio": 0.3}
    mesh = ms.Section("mesh", degree=2, size="8 mm")
    load = {"control": "load", "until": "target", "pressure": "20 Pa", "points": 1}
    thick = {"lower": "0.5 mm", "upper": "0.8 mm"}
    lower = ms.Shell("cap", name="lower", thickness=thick["lower"], **keys)
    place = {"position": [0, 0, "60 mm"], "axis": {"polar": 180}}
    finer = {"size": "5 mm"}
    upper = ms.Shell("cap", name="upper", thickness=thick["upper"], place=place, mesh=finer, **keys)
    points = {"lower.tip": [0, 0, "25 mm"], "upper.tip": [0, 0, "25 mm"]}
    clamped = ms.Clamped("lower.rim", "upper.rim")
    problem = ms.Problem(
        [lower, upper], clamped, ms.Pressure(**load), mesh, points=points, symmetry="none"
    )
    both = ms.run(problem).rows[-1]
    for name, sign in (("lower", 1), ("upper", -1)):
        alone = ms.Shell("cap", thickness=thick[name], **keys)
        elements = ms.Section("mesh", degree=2, **(finer if name == "upper" else {"size": "8 mm"}))
        parts = (ms.Clamped("rim"), ms.Pressure(**load), elements)
        row = ms.run(
            ms.Problem(alone, *parts, points={"tip": [0, 0, "25 mm"]}, symmetry="none")
        ).rows[-1]
        assert both[f"{name}_tip_uz"] == pytest.approx(sign * row["tip_uz"], rel=1e-6)

"""Branches that a program follows from the record of a bifurcation."""

import pickle

import numpy as np
import pytest
from conftest import CASES
from simulate.test_symmetry_switch import CAP

import magshell_fenicsx as ms


def test_both_branches_of_a_standing_strip() -> None:
    """It bends over to either side: mirrored shapes, with less energy than the straight strip."""
    model = ms.Model(ms.Case.load(CASES / "standing_strip.yaml", ["mesh.refinement=0.5"]))
    *_, bifurcation = ms.trace(model, "gravity", first="1 m/s^2", until="bifurcation")
    branches = bifurcation.branches()
    assert [record.branch for record in branches] == [1, 2]
    ends = [
        list(ms.trace(record, "gravity", targets=["9.81 m/s^2"], until="target"))[-1]
        for record in branches
    ]
    assert all(end.reached for end in ends)
    one, other = (model.observe(end.point.state) for end in ends)
    assert abs(one["tip_uz"]) > 0.02  # m of 0.05
    assert one["tip_uz"] == pytest.approx(-other["tip_uz"], rel=1e-6)
    assert one["tip_ux"] == pytest.approx(other["tip_ux"], rel=1e-6)
    *_, straight = ms.trace(model, "gravity", targets=["9.81 m/s^2"], until="target")
    assert one["energy"] < model.observe(straight.point.state)["energy"]


def test_a_branch_in_a_larger_model() -> None:
    """Waves around a meridian are followed in a sector, from the load of the bifurcation on."""
    model = ms.Model({**CAP, "mesh": {"refinement": 0.7}})
    *before, bifurcation = ms.trace(model, "pressure", first=0.05, until="bifurcation")
    with pytest.warns(UserWarning, match="the branch of the mode .* is followed in the sector"):
        (branch,) = bifurcation.branches()
    assert branch.scene is not model
    start, *_, end = ms.trace(branch, "pressure", first=-0.005, until="points", steps=2)
    assert start.excluded_pivots == branch.excluded_pivots == end.excluded_pivots
    assert end.scene is branch.scene
    assert end.point.state.mu["pressure"] < branch.point.state.mu["pressure"]
    assert np.linalg.norm(end.point.state.u) > np.linalg.norm(branch.point.state.u)
    with pytest.raises(ValueError, match="branches: this record is no bifurcation, but a step"):
        before[-1].branches()
    pickled = pickle.loads(pickle.dumps(bifurcation))
    with pytest.raises(ValueError, match=r"another process: record\.with_scene\(model\)\.branches"):
        pickled.branches()

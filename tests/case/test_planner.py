"""What a case is turned into: the mirror plane, the loads, what is left out."""

import numpy as np
import pytest

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.section import Direction
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.shape.symmetry_constraint import common_azimuth


def case(**sections: object) -> Case:
    shell = {"geometry": "hemisphere", "radius_to_thickness": 90, "poisson_ratio": 0.5}
    return Case.from_source({"shell": shell, "boundary": {"equator": "clamped"}, **sections})


def test_common_azimuth() -> None:
    up, tilted, across = (
        Direction(polar=p, azimuth=a).vector() for p, a in ((0, 70), (30, 20), (30, 110))
    )
    assert common_azimuth([up]) == 0.0
    assert common_azimuth([up, tilted]) == pytest.approx(np.radians(20))
    assert common_azimuth([tilted, Direction(polar=45, azimuth=200).vector()]) == pytest.approx(
        np.radians(20)
    )
    assert common_azimuth([tilted, across]) is None


def test_coplanar_fields_give_a_half_shell_turned_into_its_mirror_plane() -> None:
    field = {
        "lambda_m": 1e-3,
        "remanent": {"polar": 30, "azimuth": 20},
        "applied": {"polar": -60, "azimuth": 20},
    }
    problem = make_problem(case(magnetic=field, loading={"kind": "pressure"}))
    assert problem.is_half
    assert problem.loads.magnetic
    assert problem.loads.magnetic.remanent == pytest.approx([0.5, 0, np.cos(np.pi / 6)])
    assert problem.loads.magnetic.applied == pytest.approx([-np.sin(np.pi / 3), 0, 0.5])


def test_non_coplanar_fields_need_the_full_shell() -> None:
    field = {"lambda_m": 1e-3, "remanent": {"polar": 45}, "applied": {"polar": 45, "azimuth": 90}}
    assert not make_problem(case(magnetic=field)).is_half
    with pytest.raises(CaseError, match="no common mirror plane"):
        make_problem(case(magnetic=field, symmetry="half"))


def test_what_is_not_needed_is_left_out() -> None:
    problem = make_problem(case(magnetic={"lambda_m": 0}, loading={"kind": "pressure"}))
    assert problem.loads.magnetic is None
    assert not problem.loads.forces
    assert problem.loads.pressure
    assert any("lambda_m is zero" in line for line in problem.left_out)


def test_a_turning_field_keeps_its_magnitude() -> None:
    """With `uniform: 2` both directions that it turns between are twice as long, and normal to each
    other.
    """
    field = {"lambda_m": 1e-3, "applied": {"polar": 30, "uniform": 2}}
    magnetic = make_problem(
        case(magnetic=field, loading={"kind": "rotation", "to": {"polar": 80}})
    ).loads.magnetic
    assert magnetic
    (across,) = magnetic.across
    assert [np.linalg.norm(magnetic.applied), np.linalg.norm(across)] == pytest.approx([2, 2])
    assert magnetic.applied @ across == pytest.approx(0, abs=1e-12)


def test_a_strip_is_loaded_at_its_tip() -> None:
    """The point that is named the pole, where its displacement is reported too."""
    shell = {"geometry": "strip", "radius_to_thickness": 100, "width": 0.1, "poisson_ratio": 0}
    load = {"kind": "indentation", "at": {}, "depth": 1}
    problem = make_problem(case(shell=shell, boundary={"root": "clamped"}, loading=load))
    force = problem.loads.forces["force"]
    assert problem.points[force.point] == pytest.approx([1, 0])

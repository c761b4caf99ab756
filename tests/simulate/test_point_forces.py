"""Modes within a thickness of a point force are none of the shell.

Their loads fall with the size of the cells there, as its curvature grows without limit; modes of
the shell extend over sqrt(R h).
"""

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from magshell_fenicsx import Case, run
from magshell_fenicsx.shells.near_points import squared_gradient
from magshell_fenicsx.simulate.scene import Scene

CAP = {"geometry": "cap", "radius": 1, "polar": 30, "thickness": 1 / 30, "poisson_ratio": 0.3}


def indented(rim: str, mesh: dict[str, Any] | None = None, **loading: Any) -> Case:
    """A cap under a point force at its pole."""
    return Case.model_validate(
        {
            "shell": CAP,
            "boundary": {"rim": rim},
            "mesh": mesh or {},
            "loading": {"kind": "indentation", "at": {"polar": 0}, "control": "arc", **loading},
        }
    )


@pytest.mark.parametrize(("mesh", "force"), [({}, 24.3), ({"degree": 3, "refinement": 1.6}, 25.5)])
def test_modes_at_a_point_force_are_left_out(mesh: dict[str, Any], force: float) -> None:
    """A clamped cap has waves m = 18, 17, ... from 23.7 on the default mesh, from 25.1 on another
    one, with all of their gradient within a thickness of the force."""
    result = run(indented("clamped", mesh, force=force, points=2))
    assert result.stopped is None
    assert {row["label"] for row in result.rows} == {"start", "step", "target"}
    assert int(result.rows[-1]["excluded_pivots"]) > 5
    (said,) = result.remarks
    assert "within a thickness of the point force at pole (m = 18 first)" in said


def test_modes_of_the_shell_are_reported() -> None:
    """A hinged cap snaps through under the same force, with 1e-3 of its mode's gradient there."""
    result = run(indented("hinged", until="limit"))
    assert result.rows[-1]["label"] == "fold"
    assert not result.remarks


@pytest.mark.parametrize("symmetry", ["axisymmetric", "half"])
def test_squared_gradient(symmetry: str) -> None:
    """Of a dilation in the plane of a disc it is 2, and the integral that times the area."""
    given = {
        "shell": {"geometry": "disc", "radius_to_thickness": 50, "poisson_ratio": 0.3},
        "boundary": {"rim": "hinged"},
        "mesh": {"size": 0.5},
        "symmetry": symmetry,
    }
    model = Scene(Case.model_validate(given).problem(), MPI.COMM_SELF).model
    dilated = np.array(model.r0.x.array)
    squares = squared_gradient(model, dilated, None)[1]
    around = 1 / (2 * np.pi) if model.axisymmetric else 1 / 2
    assert squares.sum() == pytest.approx(2 * np.pi * around, rel=1e-3)
    if model.axisymmetric:
        shift = np.zeros((len(dilated) // 2, 3))
        shift[:, 1] = -1.0  # U = 1, V = -1: a translation across the axis
        assert squared_gradient(model, shift.ravel(), 1)[1].sum() == pytest.approx(0.0, abs=1e-20)
        tilt = np.zeros_like(shift)
        tilt[:, 2] = dilated.reshape(-1, 2)[:, 0]  # W = rho cos: |grad|^2 = cos^2 + sin^2
        assert squared_gradient(model, tilt.ravel(), 1)[1].sum() == pytest.approx(1.0)

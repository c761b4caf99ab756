"""The fold ahead of a point, estimated on toys with folds in closed form."""

import numpy as np
import pytest
from continuation.toys import snap_through

from magshell_fenicsx.continuation.fold import fold_ahead
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path, StepOptions
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import State

FOLD = 1 - 1 / np.sqrt(3)  # of load = x^3 - 3 x^2 + 2 x


def at(x: float) -> tuple[BorderedNewton, Point]:
    newton = BorderedNewton(snap_through(0.0))
    path = Path(newton, "load", "load", StepOptions(1.0, 1.0, 1.0))
    return newton, path.start(State(np.array([x]), {"load": x**3 - 3 * x**2 + 2 * x}))


@pytest.mark.parametrize("before", [0.05, 0.1, 0.2])
def test_estimate_is_the_fold_of_the_parabola(before: float) -> None:
    """Of the load's second order expansion: its error is of third order in the distance."""
    x = FOLD - before
    guess = fold_ahead(*at(x), "load")
    assert guess
    slope, bend = 3 * x**2 - 6 * x + 2, 6 * (x - 1)
    assert guess.state.u[0] == pytest.approx(x - slope / bend, rel=1e-6)
    load = x**3 - 3 * x**2 + 2 * x
    assert guess.state.mu["load"] == pytest.approx(load - slope**2 / (2 * bend), rel=1e-6)
    assert guess.state.mu["load"] == pytest.approx(2 / np.sqrt(27), abs=2 * before**3)
    assert guess.phi is not None
    assert guess.phi[0] > 0


def test_no_fold_is_near_or_ahead() -> None:
    assert fold_ahead(*at(0.05), "load") is None  # further away than the load itself
    assert fold_ahead(*at(FOLD + 0.1), "load") is None  # unstable: it is behind

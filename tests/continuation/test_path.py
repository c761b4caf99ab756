"""Paths of toys whose folds and bifurcations are known in closed form."""

import gc
import weakref
from typing import ClassVar

import numpy as np
import pytest
from continuation.toys import Toy, pitchfork, snap_through
from scipy.interpolate import KroghInterpolator

from magshell_fenicsx.continuation.continuation_run import instabilities
from magshell_fenicsx.continuation.control import PrescribedConjugate, PrescribedLoad
from magshell_fenicsx.continuation.interpolation import hermite
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Control, Path
from magshell_fenicsx.continuation.point import NoProgress, PathStopped, Point, StepOptions
from magshell_fenicsx.continuation.system import State


def path_of(toy: Toy, control: Control, options: StepOptions) -> tuple[Path, Point]:
    path = Path(BorderedNewton(toy), "load", control, options)
    return path, path.start(State(np.zeros(toy.size), {"load": 0.0}))


def test_load_control_finds_the_equilibrium() -> None:
    toy = snap_through()
    outcome = BorderedNewton(toy).solve(
        State(np.zeros(1), {"load": 0.0}), "load", PrescribedLoad("load", 0.2)
    )
    assert outcome.converged
    u = outcome.state.u[0]
    assert u**3 - 3 * u**2 + 2 * u == pytest.approx(0.2, abs=1e-9)


def test_displacement_control_gives_the_load() -> None:
    toy = snap_through()
    row = PrescribedConjugate(toy, "load", 1.5)
    outcome = BorderedNewton(toy).solve(State(np.zeros(1), {"load": 0.0}), "load", row)
    assert outcome.state.mu["load"] == pytest.approx(1.5**3 - 3 * 1.5**2 + 2 * 1.5, abs=1e-9)


def test_load_control_stops_at_the_fold() -> None:
    path, start = path_of(snap_through(), "load", StepOptions(0.1, 0.1, 1e-6))
    with pytest.raises(PathStopped) as stop:
        list(path.continue_to(start, [0.5]))
    assert 0 < 2 / (3 * np.sqrt(3)) - stop.value.point.s < 1e-3


def test_displacement_control_passes_the_folds_and_counts_pivots() -> None:
    path, start = path_of(snap_through(), "conjugate", StepOptions(0.05, 0.1, 1e-6))
    for point, _ in path.continue_to(start, [2.0]):
        u = point.state.u[0]
        assert point.state.mu["load"] == pytest.approx(u**3 - 3 * u**2 + 2 * u, abs=1e-10)
        assert point.dmu == pytest.approx(3 * u**2 - 6 * u + 2, abs=1e-8)
        assert point.negative_pivots == (abs(u - 1) < 1 / np.sqrt(3))


@pytest.mark.parametrize("step", [0.02, 0.3, 0.9])
def test_fold_is_located(step: float) -> None:
    """To 1e-8 of the load, as README says: refined tangents near a fold are no better.

    Its place follows from that.
    """
    path, low = path_of(snap_through(), "conjugate", StepOptions(step, step, 1e-6))
    for high, _ in path.continue_to(low, [2.0]):
        if high.negative_pivots:
            break
        low = high
    (found,) = instabilities(path, low, high, tolerance=1e-12)
    assert found.kind == "fold"
    assert found.point.state.mu["load"] == pytest.approx(2 / (3 * np.sqrt(3)), rel=1e-8)
    assert found.point.s == pytest.approx(1 - 1 / np.sqrt(3), abs=5e-5)
    # a neutral mode is not unstable
    assert (found.point.negative_pivots, found.point.negative_pivots_held) == (
        0,
        0,
    )


@pytest.mark.parametrize("control", ["load", "conjugate"])
def test_bifurcation_is_located(control: Control) -> None:
    path, low = path_of(pitchfork(), control, StepOptions(0.3, 0.4, 1e-6))
    for high, _ in path.continue_to(low, [3.0]):
        if high.negative_pivots:
            break
        low = high
    (found,) = instabilities(path, low, high)
    assert found.kind == "bifurcation"
    assert found.point.state.mu["load"] == pytest.approx(1.0, rel=1e-8)
    assert found.point.state.u[1] == pytest.approx(0.0, abs=1e-12)


def test_imperfection_turns_the_pitchfork_into_a_stable_path() -> None:
    """The path bends away from the bifurcation: no instability, v^2 -> u - 1."""
    path, straight = path_of(pitchfork(imperfection=0.01), "conjugate", StepOptions(0.1, 0.2, 1e-6))
    bent = path.newton.solve(straight.state, "load", PrescribedLoad("load", 0.0))
    point = start = path.start(bent.state)
    for point, _ in path.continue_to(start, [3.0]):
        assert point.negative_pivots == 0
    u, v = point.state.u
    assert (1 - u) * v + v**3 == pytest.approx(0.01, abs=1e-10)


def test_a_point_that_was_too_far_away_is_a_step_later() -> None:
    """Where the path bends steps are too long, but none is in vain; every point is on the branch v
    > 0.
    """

    class Tried(NoProgress):
        places: ClassVar[list[float]] = []

        def trying(self, here: Point, length: float) -> None:
            self.places.append(here.s + length)

    toy, options = pitchfork(imperfection=0.01), StepOptions(0.5, 0.5, 1e-6)
    path = Path(BorderedNewton(toy), "load", "conjugate", options, progress=Tried())
    bent = path.newton.solve(State(np.zeros(2), {"load": 0.0}), "load", PrescribedLoad("load", 0.0))
    points = [point for point, _ in path.continue_to(path.start(bent.state), [5.0])]
    assert Tried.places != sorted(Tried.places)
    assert sorted(Tried.places) == [point.s for point in points]
    for point in points:
        u, v = point.state.u
        assert v > 0
        assert (1 - u) * v + v**3 == pytest.approx(0.01, abs=1e-10)


def test_targets_are_met_exactly() -> None:
    path, start = path_of(snap_through(), "conjugate", StepOptions(0.07, 0.3, 1e-6))
    reached = [point.s for point, flag in path.continue_to(start, [0.25, 0.5, 1.75]) if flag]
    assert reached == [0.25, 0.5, 1.75]


def test_steps_that_targets_cut_grow() -> None:
    """A step just shorter than the distance of two targets does not stay a half of it."""
    path, start = path_of(snap_through(), "conjugate", StepOptions(0.015, 0.1, 1e-6))
    targets = [0.02 * i for i in range(1, 11)]
    flags = [flag for _, flag in path.continue_to(start, targets)]
    assert flags == [False, *(True for _ in targets)]


def test_targets_may_turn_back() -> None:
    """The next point is foreseen from three, of which no two are at one place."""
    path, start = path_of(snap_through(), "conjugate", StepOptions(0.25, 0.25, 1e-6))
    loads = [
        p.state.mu["load"]
        for p, flag in path.continue_to(start, [0.25, 0.5, 0.25, 0.0, 0.25])
        if flag
    ]
    assert loads[0] == pytest.approx(loads[2], abs=1e-12)
    assert loads[0] == pytest.approx(loads[4], abs=1e-12)


def test_foreseen_as_by_scipy() -> None:
    """The polynomial with given values and slopes at three places (Krogh 1970)."""
    nodes, f, slope = [0.3, 1.0, 1.2], np.exp, np.exp
    twice = np.repeat(nodes, 2)
    given = KroghInterpolator(
        twice, [f(x) if i % 2 == 0 else slope(x) for i, x in enumerate(twice)]
    )
    ours = sum(
        a * f(x) + b * slope(x) for (a, b), x in zip(hermite(1.7, nodes), nodes, strict=True)
    )
    assert ours == pytest.approx(float(given(1.7)), rel=1e-13)


def test_a_solver_is_released_with_its_factors() -> None:
    """PETSc calls back into the solver but must not keep it: sweeps make hundreds."""
    newton = BorderedNewton(snap_through())
    newton.solve(State(np.zeros(1), {"load": 0.0}), "load", PrescribedLoad("load", 0.1))
    gone = weakref.ref(newton)
    del newton
    gc.collect()
    assert gone() is None

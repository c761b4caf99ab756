"""A body on a spring that snaps against a stop: by arc length, its load falls to the touch and
rises at once behind it.

A softening spring, f = x^3 - 3 x^2 + 2 x, carries a body with x <= X but for the penalty; the load
pulls at its other end by a linear spring, q = x + load/K. All of it is known in closed form.
"""

import numpy as np
import pytest
from continuation.toys import Toy

from magshell_fenicsx.continuation.continuation_run import ContinuationGoal, ContinuationRun, Label
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import Point, StepOptions
from magshell_fenicsx.continuation.snes import NewtonOptions
from magshell_fenicsx.continuation.step_control import StepEvent
from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.parts.gap import Penalty

K, X, STIFF, SOFT, DEEP = 2.0, 0.8, 1e5, 1e-5, 1e-4


def f(x: float) -> float:
    return x**3 - 3 * x**2 + 2 * x


def stop() -> Toy:
    def gradient(u: Vector) -> Vector:
        q, x = u
        pressed = Penalty(STIFF, SOFT).derivatives(np.array([x - X]))[1][0]
        return np.array([K * (q - x), f(x) - K * (q - x) + pressed])

    def hessian(u: Vector) -> Vector:
        stiff = Penalty(STIFF, SOFT).derivatives(np.array([u[1] - X]))[2][0]
        return np.array([[K, -K], [-K, 3 * u[1] ** 2 - 6 * u[1] + 2 + K + stiff]])

    return Toy(gradient, hessian, 2)


def rows_of_stops(places: list[float]) -> Toy:
    """Two places in a row on springs of the stiffness 1; the second one, x, meets stops of the
    stiffness 3.

    x - q + 3 (sum of x - X over the stops that it has met) = 0 and 2 q - x = load.
    """

    def forces(x: float) -> tuple[float, float]:
        _, pressed, stiff = Penalty(3.0, 1e-9).derivatives(x - np.array(places))
        return float(np.sum(pressed)), float(np.sum(stiff))

    def gradient(u: Vector) -> Vector:
        q, x = u
        return np.array([q + (q - x), x - q + forces(x)[0]])

    def hessian(u: Vector) -> Vector:
        return np.array([[2.0, -1.0], [-1.0, 1.0 + forces(u[1])[1]]])

    return Toy(gradient, hessian, 2)


def first_contact(here: State, guess: State) -> StepEvent:
    """As shells have it in `simulate.contact_onset`."""
    gap, way = X - here.u[1], guess.u[1] - here.u[1]
    behind = gap < 4 * DEEP
    part = (gap + (DEEP if behind else -DEEP)) / way if way and gap > 0 else 1.0
    meets = 0 < part < 1
    return StepEvent(part if meets else 1.0, behind and meets, is_deep=True)


def walked(load: float, first: float) -> list[tuple[Label, Point]]:
    newton = BorderedNewton(
        stop(),
        NewtonOptions(reuse_distance=0.0, patience=7, stiffnesses={"stop": 1.0}),
    )
    path = Path(
        newton, "load", "arc", StepOptions(first, 4 * first, 1e-5 * first), step_event=first_contact
    )
    return list(
        ContinuationRun(
            path, path.start(State(np.zeros(2), {"load": 0.0})), ContinuationGoal("target", [load])
        )
    )


@pytest.mark.parametrize("first", [0.02, 0.1])
def test_a_path_goes_on_where_its_load_turns_at_a_stop(first: float) -> None:
    """Folds at f' = 0 and at the touch, between them one unstable direction; then the stop bears
    what f does not.
    """
    passed = walked(0.6, first)
    folds = [point for label, point in passed if label == "fold"]
    assert [point.negative_pivots for point in folds] == [0, 1]
    assert folds[0].state.mu["load"] == pytest.approx(f(1 - 1 / np.sqrt(3)), rel=1e-8)
    # the penalty sets in over SOFT
    assert folds[1].state.mu["load"] == pytest.approx(f(X), rel=1e-4)
    assert len(passed) < 60, "it does not creep"
    q, x = passed[-1][1].state.u
    assert passed[-1][0] == "target"
    assert passed[-1][1].negative_pivots == 0
    assert q == pytest.approx(X + 0.6 / K, abs=1e-4)
    pressed = Penalty(STIFF, SOFT).derivatives(np.array([x - X]))[1][0]
    assert pressed == pytest.approx(0.6 - f(X), rel=1e-4), "the stop bears what the spring does not"


@pytest.mark.parametrize("places", [[0.4], [0.4, 0.3], [0.4, 0.3, 0.1]])
def test_a_path_passes_corners_just_ahead(places: list[float]) -> None:
    """Stops at parts of the shortest step ahead. Behind all n of them x = (load + 6 sum of X)/(1 +
    6 n)."""
    first, begin = 0.1, 0.5
    shortest = 1e-3 * first
    at = [begin + part * shortest for part in places]
    newton = BorderedNewton(
        rows_of_stops(at),
        NewtonOptions(reuse_distance=0.0, patience=7, stiffnesses={"stops": 3.0}),
    )
    path = Path(newton, "load", "arc", StepOptions(first, 4 * first, shortest))
    start = path.start(State(np.array([begin, begin]), {"load": begin}))
    *_, (label, point) = ContinuationRun(path, start, ContinuationGoal("target", [3.0]))
    x = (3.0 + 6 * sum(at)) / (1 + 6 * len(at))
    assert label == "target"
    assert point.state.u == pytest.approx([(3.0 + x) / 2, x], rel=1e-6)

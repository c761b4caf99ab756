"""Folds of toys, known in closed form, found and followed through a parameter."""

from dataclasses import replace

import numpy as np
import pytest
from continuation.toys import Toy, pitchfork, snap_back, snap_through

from magshell_fenicsx.continuation.fold import (
    Fold,
    FoldGuess,
    FoldLost,
    find_fold,
    fold_ahead,
    fold_by_one_step,
    predict_fold,
    residual_multiplier,
)
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import Point, StepOptions
from magshell_fenicsx.continuation.system import State

FOLD = 1 - 1 / np.sqrt(3)  # of load = x^3 - 3 x^2 + 2 x


def fold_near(toy: Toy, u: list[float], load: float) -> Fold:
    return find_fold(BorderedNewton(toy), FoldGuess(State(np.array(u), {"load": load})), "load")


@pytest.mark.parametrize("p", [-2.0, 0.0, 0.5, 0.99])
@pytest.mark.parametrize("sign", [-1, 1])
def test_both_folds_of_the_arch(p: float, sign: int) -> None:
    """load' = 0 and load'' = 6 (x - 1): a maximum before x = 1, a minimum after it."""
    x = 1 + sign * np.sqrt((1 - p) / 3)
    fold = fold_near(snap_through(p), [x + 0.1 * sign], 0.0)
    assert fold.state.u[0] == pytest.approx(x, abs=1e-10)
    assert fold.value == pytest.approx(x**3 - 3 * x**2 + (2 + p) * x, abs=1e-10)
    assert fold.curvature == pytest.approx(6 * (x - 1), rel=1e-6)
    assert fold.unstable == 0
    assert fold.phi == pytest.approx([1.0])


def test_work_does_not_depend_on_the_unit_of_length() -> None:
    one, small = (fold_near(snap_through(0.0, L), [0.3 * L], 0.2) for L in (1.0, 1e-5))
    assert small.value == pytest.approx(one.value, rel=1e-12)
    assert small.curvature == pytest.approx(one.curvature, rel=1e-9)
    assert small.factorisations == one.factorisations


@pytest.mark.parametrize("toy", [snap_through(), pitchfork(0.02, -0.5)])
def test_a_found_fold_is_found_again(toy: Toy) -> None:
    """The tangent is singular at the guess itself."""
    first = fold_near(toy, [0.4, 0.2][: toy.size], 0.3)
    again = find_fold(BorderedNewton(toy), FoldGuess(first.state, first.phi), "load")
    assert again.value == pytest.approx(first.value, rel=1e-14)
    assert again.state.u == pytest.approx(first.state.u, abs=1e-10)
    assert again.iterations == 1


def test_one_step_from_a_good_guess() -> None:
    """load'' = 6 (x - 1) = -3.46: from 0.02 beside the fold a step of Newton's method leaves 3.5e-4
    of x, and the load there is off by 1.73 times the square of that.
    """
    newton, guess = BorderedNewton(snap_through()), State(np.array([FOLD + 0.02]), {"load": 0.38})
    state, _, unstable = fold_by_one_step(newton, guess, np.array([0.5]), "load")
    assert state.u[0] == pytest.approx(FOLD, abs=5e-4)
    assert state.mu["load"] == pytest.approx(FOLD**3 - 3 * FOLD**2 + 2 * FOLD, abs=4e-7)
    assert (unstable, newton.factorisation.count) == (0, 1)


def test_other_unstable_directions_are_counted() -> None:
    """Behind a spring the arch folds in the load at x = 1 -+ 1/sqrt(3); the column is unstable
    beyond x = c.
    """
    x = 1 - 1 / np.sqrt(3)
    f = x**3 - 3 * x**2 + 2 * x
    for c, unstable in ((0.6, 0), (0.2, 1)):
        fold = fold_near(snap_back(0.5, c), [x + 2 * f, x + 0.05, 0.0], 0.9 * f)
        assert fold.value == pytest.approx(f, rel=1e-10)
        assert fold.state.u == pytest.approx([x + 2 * f, x, 0.0], abs=1e-10)
        assert fold.unstable == unstable


def test_no_fold() -> None:
    """For p = 2 the arch stiffens everywhere: load' = 3 (x - 1)^2 + 1."""
    with pytest.raises(FoldLost, match=r"found no fold|diverged"):
        fold_near(snap_through(2.0), [0.4], 0.3)


def koiter(imperfection: float) -> float:
    return 1 - 3 * (imperfection / 2) ** (2 / 3)


def column_fold(imperfection: float) -> Fold:
    v = (imperfection / 2) ** (1 / 3)
    load = koiter(imperfection)
    return fold_near(pitchfork(imperfection, -0.5), [load + v**2 / 2, 1.1 * v], load)


@pytest.mark.parametrize("imperfection", [1e-4, 1e-2, 0.1])
def test_imperfection_sensitivity_is_koiters(imperfection: float) -> None:
    """The load at the fold, 1 - 3 (imperfection/2)^(2/3), and its derivative from the null vector;
    R_p = (0, -1).
    """
    fold = column_fold(imperfection)
    assert fold.value == pytest.approx(koiter(imperfection), rel=1e-10)
    found = residual_multiplier(pitchfork(imperfection, -0.5), fold) @ np.array([0.0, -1.0])
    assert found == pytest.approx(-((imperfection / 2) ** (-1 / 3)), rel=1e-7)


def test_fold_is_followed_through_a_parameter() -> None:
    known = [(0.02, column_fold(0.02))]
    for imperfection in np.linspace(0.025, 0.06, 8):
        newton = BorderedNewton(pitchfork(imperfection, -0.5))
        fold = find_fold(newton, predict_fold(newton.system, known, imperfection, {}), "load")
        assert fold.value == pytest.approx(koiter(imperfection), rel=1e-10)
        assert fold.factorisations <= 4
        known.append((imperfection, fold))


@pytest.mark.parametrize(("earlier", "expected"), [((0.0, 1.0), 16.0), ((0.0, 50.0), 9.0)])
def test_prediction_has_the_least_residual(earlier: tuple[float, float], expected: float) -> None:
    """Equilibrium is u = p^2: a quadratic meets it; if the fold before was off, the last one alone
    is best.
    """
    fold = fold_near(snap_through(), [0.4], 0.3)
    at_4 = Toy(lambda u: u - 16.0, lambda u: np.eye(1), 1)
    known = [
        (p, replace(fold, state=State(np.array([u]), {"load": 0.0, "field": p})))
        for p, u in zip((0.0, 1.0, 3.0), (*earlier, 9.0), strict=True)
    ]
    guess = predict_fold(at_4, known, 4.0, {"field": 4.0})
    assert guess.state.u == pytest.approx([expected])
    assert guess.state.mu == pytest.approx({"load": 0.0, "field": 4.0})


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

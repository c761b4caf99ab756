"""Steps of the size that a tolerance needs, and how late a snap comes under a load that rises past
a fold.
"""

import numpy as np
import pytest
from test_transient import START, column, reference
from toys import matrix, snap_through

from magshell_fenicsx.continuation.advance import TimeSteps, advance
from magshell_fenicsx.continuation.motion import Motion
from magshell_fenicsx.continuation.transient import Integrator

FOLD = 2 / (3 * np.sqrt(3))
AT = 1 - 1 / np.sqrt(3)  # of the fold; a snap has passed AT + 0.5


def delay(rate: float, mass: float, drag: float) -> float:
    """The load at which a shallow arch has snapped, less that of the fold."""
    begin = 0.985 * FOLD
    x = float(min(np.roots([1, -3, 2, -begin]).real))
    soft = 30.0  # the load begins to rise smoothly, so that the arch does not swing

    def load(t: float, before: bool) -> dict[str, float]:
        return {"load": begin + rate * (t - soft * (1 - np.exp(-t / soft)))}

    integrator = Integrator(snap_through(), matrix(np.array([[mass]])), load, 0.9, drag / mass)
    steps = TimeSteps(None, 1e-6, 0.1)
    now, dt = integrator.begin(0.0, np.array([x]), np.zeros(1)), 0.1
    while now.u[0] < AT + 0.5:
        before = now
        now, dt = advance(integrator, now, now.t + 1.0, steps, dt)
    part = (AT + 0.5 - before.u[0]) / (now.u[0] - before.u[0])
    return load(before.t + part * (now.t - before.t), True)["load"] - FOLD


@pytest.mark.parametrize(("mass", "drag", "exponent"), [(1.0, 0.0, 4 / 5), (1e-4, 1.0, 2 / 3)])
def test_exponent(mass: float, drag: float, exponent: float) -> None:
    """M x'' + c x' = a + x^2 with a = rate t: times are like rate^(-1/5) with inertia, rate^(-1/3)
    with drag.
    """
    rates = np.array([2e-5, 5e-6])
    late = [delay(rate, mass, drag) for rate in rates]
    found = np.log(late[0] / late[1]) / np.log(rates[0] / rates[1])
    assert found == pytest.approx(exponent, abs=0.03)


def test_adaptive_steps_and_the_balance_of_energy() -> None:
    """A smaller tolerance has a smaller error; and so is the defect of the energies."""
    errors, balance = [], []
    for tolerance in (1e-3, 1e-5):
        toy, integrator = column(0.9, 0.1)
        now = integrator.begin(0.0, START, np.zeros(2))
        now, _ = advance(integrator, now, 10.0, TimeSteps(None, tolerance, 0.01), 0.01)
        errors.append(np.abs(now.u - reference(toy, 10.0, 0.1)[:2]).max())
        stored = [u**2 / 2 + (1 - u) * v**2 / 2 + v**4 / 4 for u, v in (now.u, START)]
        balance.append(integrator.kinetic(now) + stored[0] + now.dissipated - now.work - stored[1])
    assert errors[0] < 0.1
    assert errors[1] < errors[0] / 10
    assert abs(balance[1]) < abs(balance[0]) / 10
    assert integrator.iterations < 6 * integrator.steps


def test_a_fixed_step_grows_again() -> None:
    """A step that fails at the begin alone is short there alone."""
    integrator = column(1.0)[1]
    solve, taken = integrator.step, list[float]()

    def failing(now: Motion, dt: float) -> Motion | str:
        taken.append(dt)
        return "no" if now.t < 0.1 and dt > 0.02 else solve(now, dt)

    integrator.step = failing  # type: ignore[method-assign]
    advance(
        integrator, integrator.begin(0.0, START, np.zeros(2)), 2.0, TimeSteps(0.1, 1.0, 0.1), 0.1
    )
    assert taken[-1] > 0.09
    assert len(taken) < 45

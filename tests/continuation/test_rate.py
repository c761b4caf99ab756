"""A load that rises past a fold at a finite rate: the delay of the snap grows like a power of the rate."""

import numpy as np
import pytest
from test_transient import matrix
from toys import snap_through

from magshell_fenicsx.continuation.advance import TimeSteps, advance
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
    """M x'' + c x' = a + x^2 with a = rate t: times are like rate^(-1/5) with inertia, rate^(-1/3) with drag."""
    rates = np.array([2e-5, 5e-6])
    late = [delay(rate, mass, drag) for rate in rates]
    found = np.log(late[0] / late[1]) / np.log(rates[0] / rates[1])
    assert found == pytest.approx(exponent, abs=0.03)

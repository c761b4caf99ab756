"""A small shell in motion against SciPy's integration of the same M u'' + c M u' + R(u, t) = 0, and
its cost.
"""

import time
from statistics import median

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.advance import TimeSteps, advance
from magshell_fenicsx.continuation.transient import Integrator
from magshell_fenicsx.shells.mass import mass

DRAG, END = 0.02, 6.0


def scene_of(symmetry: str, **mesh: float) -> Scene:
    shell = {"geometry": "cap", "polar": 30, "radius": 1.0, "thickness": 0.03, "poisson_ratio": 0.3}
    data = {"shell": shell, "boundary": {"rim": "clamped"}, "symmetry": symmetry, "mesh": mesh}
    return Scene(Case.from_source(data | {"loading": {"kind": "pressure"}}))


def pressure(t: float, before: bool = True) -> dict[str, float]:
    """Up to half of p_c, and back."""
    return {"pressure": 0.5 * float(np.sin(np.pi * t / END) ** 2)}


def slow(t: float, before: bool = True) -> dict[str, float]:
    return pressure(t / 5)


@pytest.mark.slow
def test_second_order_towards_scipy() -> None:
    """Displacement and velocity of every node to 1e-6 of the largest; a half of the step leaves a
    quarter.
    """
    scene = scene_of("axisymmetric", degree=2, refinement=0.2)
    system = scene.model.system
    u, M = scene.unloaded().u, mass(scene.model)
    whole = M.copy().convert("dense")
    dense = np.array(whole.getDenseArray())
    free = np.flatnonzero(dense.diagonal())
    inverse = np.linalg.inv(dense[np.ix_(free, free)])

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        u[free], v = np.split(y, 2)
        return np.concatenate([v, -inverse @ system.residual(u, pressure(t))[free] - DRAG * v])

    y = solve_ivp(rate, (0, END), np.zeros(2 * free.size), "DOP853", rtol=1e-9, atol=1e-14).y[:, -1]
    exact = np.split(y, 2)
    found = []
    for steps in (1500, 3000):  # which resolve the stiffest mode
        integrator = Integrator(system, M, pressure, 0.8, DRAG)
        now = integrator.begin(0.0, scene.unloaded().u, scene.unloaded().u)
        now, _ = advance(integrator, now, END, TimeSteps(END / steps, 1.0, 1.0), END / steps)
        found.append([now.u[free], now.v[free]])
    for coarse, fine, end in zip(*found, exact, strict=True):
        size = np.abs(end).max()
        errors = [np.abs(each - end).max() / size for each in (coarse, fine)]
        assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
        assert (4 * fine - coarse) / 3 == pytest.approx(end, abs=1e-6 * size)


@pytest.mark.slow
def test_cost_of_a_step() -> None:
    """At most twice an iteration of Newton's method: a tangent, its factors and solution, and a
    residual.
    """
    scene = scene_of("half", degree=3, refinement=1.0)
    system = scene.model.system
    state = scene.unloaded()

    def iteration() -> None:
        system.residual(state.u, state.mu)
        scene.newton.factorisation.factor(system.tangent(state.u, state.mu))
        scene.newton.factorisation.solve(state.u)

    integrator = Integrator(system, mass(scene.model), slow, 0.8, DRAG)
    begun = integrator.begin(0.0, state.u, state.u)
    steps = TimeSteps(0.3, 1.0, 0.3)
    now, _ = advance(integrator, begun, 3.0, steps, 0.3)
    iteration()
    static, moving = [], []
    for i in range(5):
        start = time.process_time()
        iteration()
        static.append(time.process_time() - start)
        start = time.process_time()
        now, _ = advance(integrator, now, 3.0 + 3.0 * (i + 1), steps, 0.3)
        moving.append((time.process_time() - start) / 10)
    assert median(moving) < 2 * median(static)

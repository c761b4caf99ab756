"""Motions under a loading device: a pendulum, whose rod is a constraint, and a body on a spring that is pressed on."""

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from scipy.integrate import solve_ivp
from test_transient import Array, matrix

from magshell_fenicsx.continuation.advance import TimeSteps, advance
from magshell_fenicsx.continuation.device import Device
from magshell_fenicsx.continuation.motion import Motion
from magshell_fenicsx.continuation.system import Amplitudes, Vector
from magshell_fenicsx.continuation.transient import Integrator

MASS = np.diag([2.0, 2.0])
WEIGHT = 3.0
ANGLE, SPIN = 0.8, 0.5


class Pendulum:
    """Pi = WEIGHT y + tension (x^2 + y^2 - 1)/2: a bob whose distance from the origin is conjugate to the tension.

    "body" is the height d of a body that presses through a spring, (d - y)^2/2.
    """

    size, length, comm = 2, 1.0, MPI.COMM_SELF
    coordinates = frozenset({"body"})

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        pressed = (u[1] - mu["body"]) if "body" in mu else 0.0
        return np.array([0.0, WEIGHT + pressed]) + mu["tension"] * u

    def load(self, u: Vector, mu: Amplitudes, name: str) -> Vector:
        return np.array(u) if name == "tension" else np.array([0.0, -1.0])

    def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
        return float(u @ u - 1) / 2 if name == "tension" else float(mu["body"] - u[1])

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        return float(name == other == "body")

    def tangent(self, u: Vector, mu: Amplitudes, stress: object = ()) -> PETSc.Mat:
        return matrix(np.diag([mu["tension"], mu["tension"] + ("body" in mu)]))


def of(angle: float) -> Array:
    return np.array([np.sin(angle), -np.cos(angle)])


def swung(rho: float, steps: int, end: float) -> Motion:
    """From an angle, with a tension that is not yet the right one and a velocity that stretches the rod."""
    system = Pendulum()
    device = Device(system, {"tension": 0.0}, {"tension": 1.0})
    integrator = Integrator(system, matrix(MASS), lambda t, before: {"tension": 0.0}, rho, device=device)
    along = np.array([np.cos(ANGLE), np.sin(ANGLE)])
    now = integrator.begin(0.0, 1.01 * of(ANGLE), SPIN * along + 0.3 * of(ANGLE))
    assert now.u == pytest.approx(of(ANGLE), abs=1e-12)
    assert now.v == pytest.approx(SPIN * along, abs=1e-12)
    assert now.mu["tension"] == pytest.approx(WEIGHT * np.cos(ANGLE) + MASS[0, 0] * SPIN**2, rel=1e-9)
    return advance(integrator, now, end, TimeSteps(end / steps, 1.0, end / steps), end / steps)[0]


@pytest.mark.parametrize("rho", [0.8, 0.3])
def test_a_pendulum(rho: float) -> None:
    """Angle and tension of SciPy's solution for the angle: second order; the rod keeps its length."""
    end, g = 4.0, WEIGHT / MASS[0, 0]
    solved = solve_ivp(
        lambda t, y: [y[1], -g * np.sin(y[0])], (0, end), [ANGLE, SPIN], "DOP853", rtol=1e-12, atol=1e-12
    )
    angle, spin = solved.y[:, -1]
    exact = np.array([*of(angle), WEIGHT * np.cos(angle) + MASS[0, 0] * spin**2])
    errors = []
    for steps in (200, 400):
        now = swung(rho, steps, end)
        assert now.u @ now.u == pytest.approx(1.0, abs=1e-10)
        errors.append(np.abs([*now.u, now.mu["tension"]] - exact).max())
    assert errors[1] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_a_body_pressed_on_with_a_force() -> None:
    """The body follows the bob at the distance that its force compresses the spring by: a heavier bob."""
    system, force = Pendulum(), 0.7
    device = Device(system, {"body": -force}, {"body": 1.0})  # dPi/dd = d - y
    integrator = Integrator(system, matrix(MASS), lambda t, before: {"tension": 0.0, "body": 0.0}, 1.0, device=device)
    now = integrator.begin(0.0, np.zeros(2), np.zeros(2))
    assert now.mu["body"] == pytest.approx(force)
    now, _ = advance(integrator, now, 2.0, TimeSteps(0.1, 1.0, 0.1), 0.1)
    fallen = -(WEIGHT - force) / 2.0 * 2.0**2 / 2
    assert now.u[1] == pytest.approx(fallen)
    assert now.mu["body"] == pytest.approx(fallen + force)
    assert now.work == pytest.approx(force * fallen)

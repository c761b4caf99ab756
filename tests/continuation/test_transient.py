"""Steps in time against SciPy and PETSc's TSALPHA2, the conservation of energy, and motions under a
loading device.

The device holds a pendulum's rod, which is a constraint, or a body on a spring that is pressed on.
"""

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from scipy.integrate import solve_ivp
from toys import Toy, matrix, pitchfork

from magshell_fenicsx.continuation.advance import TimeSteps, advance
from magshell_fenicsx.continuation.device import Device
from magshell_fenicsx.continuation.motion import Motion
from magshell_fenicsx.continuation.system import Amplitudes, Vector
from magshell_fenicsx.continuation.transient import Integrator, Surroundings

Array = NDArray[np.float64]
MASS = np.diag([1.0, 2.0])
START = np.array([0.3, 0.4])
BOB, WEIGHT = np.diag([2.0, 2.0]), 3.0  # of a pendulum
ANGLE, SPIN = 0.8, 0.5


def load(t: float) -> float:
    return 0.2 * np.sin(t)


def column(rho: float, drag: float = 0.0, *, loaded: bool = True) -> tuple[Toy, Integrator]:
    """A column that bends, Pi = u^2/2 + (1 - u) v^2/2 + v^4/4 - load u, from rest."""
    toy = pitchfork()
    return toy, Integrator(
        toy, matrix(MASS), lambda t, before: {"load": load(t) if loaded else 0.0}, rho, drag
    )


def moved(integrator: Integrator, end: float, steps: int) -> Motion:
    now = integrator.begin(0.0, START, np.zeros(2))
    return advance(integrator, now, end, TimeSteps(end / steps, 1.0, end / steps), end / steps)[0]


def reference(toy: Toy, end: float, drag: float) -> Array:
    def rate(t: float, y: Array) -> Array:
        force = toy.residual(y[:2], {"load": load(t)})
        return np.concatenate([y[2:], -np.linalg.solve(MASS, force) - drag * y[2:]])

    return np.asarray(
        solve_ivp(rate, (0, end), [*START, 0, 0], "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    )


@pytest.mark.parametrize(("rho", "drag"), [(1.0, 0.0), (0.0, 0.1)])
def test_second_order_towards_scipy(rho: float, drag: float) -> None:
    """Twice as many steps leave a quarter of the error; their extrapolation is SciPy's to 1e-6."""
    end, found = 10.0, []
    for steps in (800, 1600):
        toy, integrator = column(rho, drag)
        now = moved(integrator, end, steps)
        found.append(np.concatenate([now.u, now.v]))
    exact = reference(toy, end, drag)
    errors = [np.abs(each - exact).max() for each in found]
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
    assert (4 * found[1] - found[0]) / 3 == pytest.approx(exact, abs=1e-6)


def test_a_motion_begins_with_the_acceleration_of_all_forces() -> None:
    """The acceleration of a motion that begins at a speed is that of Newton's second law, with the
    forces of the energy and of the drag.
    """
    drag, speed = 0.5, np.array([0.2, -0.3])
    toy, integrator = column(1.0, drag)
    motion = integrator.begin(0.7, START, speed)
    forces = -toy.residual(START, {"load": load(0.7)}) - drag * MASS @ speed
    assert motion.a == pytest.approx(np.linalg.solve(MASS, forces), rel=1e-12)


def test_same_motion_as_petsc() -> None:
    """TSALPHA2 with the same steps and parameters; its first acceleration is of first order."""
    toy, integrator = column(0.5)
    ts = PETSc.TS().create(PETSc.COMM_SELF)
    ts.setType(PETSc.TS.Type.ALPHA2)
    J = matrix(np.ones((2, 2)))

    def function(
        ts: PETSc.TS, t: float, u: PETSc.Vec, v: PETSc.Vec, a: PETSc.Vec, f: PETSc.Vec
    ) -> None:
        f.setArray(MASS @ a.array_r + toy.residual(u.array_r.copy(), {"load": load(t)}))

    def jacobian(ts: PETSc.TS, *arguments: Any) -> None:
        _, u, _, _, _, sa, _, P = arguments  # t, u, v, a, shifts by v and a, J, P
        P.setValues(range(2), range(2), toy.hessian(u.array_r.copy()) + sa * MASS)
        P.assemble()

    F, u, v = J.createVecRight(), J.createVecRight(), J.createVecRight()
    ts.setI2Function(function, F)
    ts.setI2Jacobian(jacobian, J)
    u.setArray(START)
    ts.setSolution2(u, v)
    ts.setTimeStep(0.005)
    ts.setMaxTime(5.0)
    ts.setExactFinalTime(PETSc.TS.ExactFinalTime.MATCHSTEP)
    PETSc.Options()["ts_alpha_radius"] = 0.5
    PETSc.Options()["ts_adapt_type"] = "none"
    ts.setTolerances(1e-12, 1e-12)
    ts.getSNES().setTolerances(rtol=1e-13, atol=1e-14)
    ts.setFromOptions()
    ts.solve(u)
    for key in ("ts_alpha_radius", "ts_adapt_type"):
        PETSc.Options().delValue(key)
    assert moved(integrator, 5.0, 1000).u == pytest.approx(u.array_r, abs=2e-6)


def test_energy_is_conserved() -> None:
    """1000 steps, 20 a period: the potential is of degree 4, as a membrane's."""
    _, integrator = column(1.0, loaded=False)

    def energy(now: Motion) -> float:
        u, v = now.u
        return integrator.kinetic(now) + u**2 / 2 + (1 - u) * v**2 / 2 + v**4 / 4

    now = integrator.begin(0.0, START, np.zeros(2))
    first = energy(now)
    for _ in range(1000):
        now = integrator.step(now, 0.3)
        assert isinstance(now, Motion)
        assert energy(now) == pytest.approx(first, rel=1e-9)


class Pendulum:
    """Pi = WEIGHT y + tension (x^2 + y^2 - 1)/2: a bob whose distance from the origin is conjugate
    to the tension.

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
    """From an angle, with a tension that is not yet the right one and a velocity that stretches the
    rod.
    """
    system = Pendulum()
    device = Device(system, {"tension": 0.0}, {"tension": 1.0})
    integrator = Integrator(
        system,
        matrix(BOB),
        lambda t, before: {"tension": 0.0},
        rho,
        surroundings=Surroundings(device=device),
    )
    along = np.array([np.cos(ANGLE), np.sin(ANGLE)])
    now = integrator.begin(0.0, 1.01 * of(ANGLE), SPIN * along + 0.3 * of(ANGLE))
    assert now.u == pytest.approx(of(ANGLE), abs=1e-12)
    assert now.v == pytest.approx(SPIN * along, abs=1e-12)
    assert now.mu["tension"] == pytest.approx(
        WEIGHT * np.cos(ANGLE) + BOB[0, 0] * SPIN**2, rel=1e-9
    )
    return advance(integrator, now, end, TimeSteps(end / steps, 1.0, end / steps), end / steps)[0]


def test_a_pendulum() -> None:
    """Angle and tension as SciPy's for the angle: second order; the rod keeps its length."""
    end, g = 4.0, WEIGHT / BOB[0, 0]
    solved = solve_ivp(
        lambda t, y: [y[1], -g * np.sin(y[0])],
        (0, end),
        [ANGLE, SPIN],
        "DOP853",
        rtol=1e-12,
        atol=1e-12,
    )
    angle, spin = solved.y[:, -1]
    exact = np.array([*of(angle), WEIGHT * np.cos(angle) + BOB[0, 0] * spin**2])
    errors = []
    for steps in (200, 400):
        now = swung(0.8, steps, end)
        assert now.u @ now.u == pytest.approx(1.0, abs=1e-10)
        errors.append(np.abs([*now.u, now.mu["tension"]] - exact).max())
    assert errors[1] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_a_body_pressed_on_with_a_force() -> None:
    """The body follows the bob at the distance that its force compresses the spring by: a heavier
    bob.
    """
    system, force = Pendulum(), 0.7
    device = Device(system, {"body": -force}, {"body": 1.0})  # dPi/dd = d - y
    integrator = Integrator(
        system,
        matrix(BOB),
        lambda t, before: {"tension": 0.0, "body": 0.0},
        1.0,
        surroundings=Surroundings(device=device),
    )
    now = integrator.begin(0.0, np.zeros(2), np.zeros(2))
    assert now.mu["body"] == pytest.approx(force)
    now, _ = advance(integrator, now, 2.0, TimeSteps(0.1, 1.0, 0.1), 0.1)
    fallen = -(WEIGHT - force) / 2.0 * 2.0**2 / 2
    assert now.u[1] == pytest.approx(fallen)
    assert now.mu["body"] == pytest.approx(fallen + force)
    assert now.work == pytest.approx(force * fallen)

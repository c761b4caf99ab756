"""Steps in time against SciPy, PETSc's TSALPHA2, exact vibrations, and the conservation of energy."""

import numpy as np
import pytest
from numpy.typing import NDArray
from petsc4py import PETSc
from scipy.integrate import solve_ivp
from toys import Toy, pitchfork

from magshell_fenicsx.continuation.advance import TimeSteps, advance
from magshell_fenicsx.continuation.motion import Motion
from magshell_fenicsx.continuation.transient import Integrator

Array = NDArray[np.float64]
MASS = np.diag([1.0, 2.0])
START = np.array([0.3, 0.4])


def matrix(M: Array) -> PETSc.Mat:
    found = PETSc.Mat().createAIJ(M.shape, comm=PETSc.COMM_SELF)
    found.setUp()
    found.setValues(range(len(M)), range(len(M)), M)
    found.assemble()
    return found


def load(t: float) -> float:
    return 0.2 * np.sin(t)


def column(rho: float, drag: float = 0.0, *, loaded: bool = True) -> tuple[Toy, Integrator]:
    """A column that bends, Pi = u^2/2 + (1 - u) v^2/2 + v^4/4 - load u, from rest."""
    toy = pitchfork()
    return toy, Integrator(toy, matrix(MASS), lambda t, before: {"load": load(t) if loaded else 0.0}, rho, drag)


def moved(integrator: Integrator, end: float, steps: int) -> Motion:
    now = integrator.begin(0.0, START, np.zeros(2))
    return advance(integrator, now, end, TimeSteps(end / steps, 1.0, end / steps), end / steps)[0]


def reference(toy: Toy, end: float, drag: float) -> Array:
    def rate(t: float, y: Array) -> Array:
        force = toy.residual(y[:2], {"load": load(t)})
        return np.concatenate([y[2:], -np.linalg.solve(MASS, force) - drag * y[2:]])

    return np.asarray(solve_ivp(rate, (0, end), [*START, 0, 0], "DOP853", rtol=1e-12, atol=1e-12).y[:, -1])


@pytest.mark.parametrize(("rho", "drag"), [(1.0, 0.0), (0.8, 0.1), (0.0, 0.1)])
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


def test_same_motion_as_petsc() -> None:
    """TSALPHA2 with the same steps and parameters; its first acceleration is of first order."""
    toy, integrator = column(0.5)
    ts = PETSc.TS().create(PETSc.COMM_SELF)
    ts.setType(PETSc.TS.Type.ALPHA2)
    J = matrix(np.ones((2, 2)))

    def function(ts: PETSc.TS, t: float, u: PETSc.Vec, v: PETSc.Vec, a: PETSc.Vec, f: PETSc.Vec) -> None:
        f.setArray(MASS @ a.array_r + toy.residual(u.array_r.copy(), {"load": load(t)}))

    def jacobian(
        ts: PETSc.TS,
        t: float,
        u: PETSc.Vec,
        v: PETSc.Vec,
        a: PETSc.Vec,
        sv: float,
        sa: float,
        J: PETSc.Mat,
        P: PETSc.Mat,
    ) -> None:
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
    advance(integrator, integrator.begin(0.0, START, np.zeros(2)), 2.0, TimeSteps(0.1, 1.0, 0.1), 0.1)
    assert taken[-1] > 0.09
    assert len(taken) < 45

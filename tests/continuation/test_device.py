"""Loading devices: amplitudes that are unknown since their conjugates are held, against sums made
by hand.

An arch x with V = x^4/4 - x^3 + x^2 under a force f, held by springs to y (k) and z (n), which a
spring m joins; a pressure p pushes y, and a body at d presses on z through a spring c:

    Pi = V(x) + k (x - y)^2/2 + n (x - z)^2/2 + m (y - z)^2/2 + c (z - d)^2/2 - f x - p y

What y and z leave of their springs is a stiffness s on x, so that the arch folds where V'' = 3x^2 -
6x + 2 = -s.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.continuation.continuation_run import ContinuationGoal, ContinuationRun
from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.device import Device, natural_scale
from magshell_fenicsx.continuation.fold import FoldGuess, find_fold
from magshell_fenicsx.continuation.modes import critical_mode
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import StepOptions
from magshell_fenicsx.continuation.system import (
    Amplitudes,
    State,
    System,
    Vector,
    WeightedDisplacement,
)

PLACE = {"f": 0, "p": 1}  # what the forces push
FORCE, HEIGHT = 0.05, 0.02  # held: -dPi/dd = c (z - d) and y


@dataclass
class Machine:
    """The energy above."""

    k: float = 0.3
    m: float = 0.2
    n: float = 0.1
    c: float = 0.4
    size: int = 3
    length: float = 1.0
    comm = MPI.COMM_SELF
    coordinates = frozenset({"d"})

    def __post_init__(self) -> None:
        self.K = PETSc.Mat().createAIJ([3, 3], comm=self.comm)
        self.K.setUp()
        self.K.setOption(PETSc.Mat.Option.SYMMETRIC, True)

    def springs(self) -> Vector:
        k, m, n, c = self.k, self.m, self.n, self.c
        return np.array([[k + n, -k, -n], [-k, k + m, -m], [-n, -m, n + m + c]])

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        arch = np.array([u[0] ** 3 - 3 * u[0] ** 2 + 2 * u[0], 0, 0])
        return (
            arch
            + self.springs() @ u
            + mu["d"] * self.load(u, mu, "d")
            - np.array([mu["f"], mu["p"], 0])
        )

    def load(self, u: Vector, mu: Amplitudes, name: str) -> Vector:
        return np.array([0, 0, -self.c]) if name == "d" else -np.eye(3)[PLACE[name]]

    def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
        return float(self.c * (mu["d"] - u[2]) if name == "d" else -u[PLACE[name]])

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        return self.c if name == other == "d" else 0.0

    def tangent(
        self, u: Vector, mu: Amplitudes, stress: list[WeightedDisplacement] | tuple[()] = ()
    ) -> PETSc.Mat:
        self.K.setValues(
            range(3), range(3), self.springs() + np.diag([3 * u[0] ** 2 - 6 * u[0] + 2, 0, 0])
        )
        self.K.assemble()
        return self.K


REST = State(np.zeros(3), {"f": 0.0, "p": 0.0, "d": 0.0})
HELD: dict[str, dict[str, float]] = {
    "loads": {},
    "y": {"p": HEIGHT},
    "y and force": {"p": HEIGHT, "d": FORCE},
}
# s for k, m, n, c = 0.3, 0.2, 0.1, 0.4, from eliminating y and z, only z, or z without the spring c
STIFFNESS = {"loads": 0.4 - 8 / 31, "y": 0.4 - 0.01 / 0.7, "y and force": 0.4 - 0.01 / 0.3}
PUSH = {"loads": 0.0, "y": -0.3 * HEIGHT - 0.1 * 0.2 * HEIGHT / 0.7}  # f at x = 0
PUSH["y and force"] = -0.3 * HEIGHT - 0.1 * (0.2 * HEIGHT - FORCE) / 0.3


def under(device: str, machine: Machine | None = None) -> tuple[BorderedNewton, State]:
    """A solver under a device, and its state of rest."""
    system: System = machine or Machine()
    newton, held = BorderedNewton(system), HELD[device]
    if not held:
        return newton, REST
    scale = {name: natural_scale(system, newton.factor_at(REST), REST, name) for name in held}
    whole = Device(system, held, scale)
    found = (newton := newton.for_system(whole)).solve(
        whole.enter(REST), "f", PrescribedLoad("f", PUSH[device])
    )
    assert found.converged
    return newton, found.state


@pytest.mark.parametrize("device", HELD)
def test_fold_under_each_device(device: str) -> None:
    """x = 1 - sqrt((1 - s)/3) and f = V'(x) + s x + what pushes at x = 0."""
    newton, rest = under(device)
    assert rest.u[0] == pytest.approx(0, abs=1e-10)
    path = Path(newton, "f", "arc", StepOptions(0.1, 0.2, 1e-6))
    *_, (label, located) = ContinuationRun(path, path.start(rest), ContinuationGoal("limit"))
    s = STIFFNESS[device]
    x = 1 - np.sqrt((1 - s) / 3)
    f = x**3 - 3 * x**2 + (2 + s) * x + PUSH[device]
    assert label == "fold"
    assert located.state.mu["f"] == pytest.approx(f, rel=1e-8)
    fold = find_fold(newton, FoldGuess(located.state), "f")
    assert fold.value == pytest.approx(f, rel=1e-10)
    assert fold.state.u[0] == pytest.approx(x, abs=1e-8)
    assert fold.unstable == 0


@pytest.mark.parametrize("device", HELD)
def test_inertia_under_each_device(device: str) -> None:
    """Unstable between the two folds of this very device, at x = 1 -+ sqrt((1 - s)/3)."""
    newton, rest = under(device)
    path = Path(newton, "f", "conjugate", StepOptions(0.03, 0.05, 1e-6))
    half = np.sqrt((1 - STIFFNESS[device]) / 3)
    for point, _ in path.continue_to(path.start(rest), [2.0]):
        assert point.negative_pivots == (abs(point.s - 1) < half)
        assert point.negative_pivots_held == 0  # x itself is held


def test_what_is_held_stays() -> None:
    newton, rest = under("y and force")
    device = newton.system
    assert isinstance(device, Device)
    path = Path(newton, "f", "conjugate", StepOptions(0.1, 0.1, 1e-6))
    for point, _ in path.continue_to(path.start(rest), [1.0]):
        state = device.leave(point.state)
        assert state.u[1] == pytest.approx(HEIGHT, abs=1e-9)
        assert 0.4 * (state.u[2] - state.mu["d"]) == pytest.approx(FORCE, abs=1e-9)
        assert Machine().residual(state.u, state.mu) == pytest.approx(0, abs=1e-9)


def test_a_coordinate_is_unstable_where_a_force_is_not() -> None:
    """z alone has the stiffness n + m = -0.1: the body at d holds it, a dead force on the body does
    not.
    """
    for device, unstable in (("y", 0), ("y and force", 1)):
        newton, rest = under(device, Machine(m=-0.2))
        assert newton.factor_at(rest).negative_pivots == unstable


def test_eigenpair_of_the_edged_tangent() -> None:
    """Against NumPy's of the same matrix of five unknowns."""
    newton, rest = under("y and force")
    factors = newton.factor_at(rest)
    whole = np.array([factors.times(e) for e in np.eye(5)])
    values, vectors = np.linalg.eigh(whole)
    nearest = int(np.argmin(abs(values)))
    found = critical_mode(newton, rest)
    assert whole == pytest.approx(whole.T, abs=1e-14)
    assert found.eigenvalue == pytest.approx(values[nearest], rel=1e-8)
    assert abs(found.vector @ vectors[:, nearest]) == pytest.approx(1, abs=1e-8)
    assert factors.solve(whole @ np.arange(5.0)) == pytest.approx(np.arange(5.0), abs=1e-12)


def test_solving_where_the_inner_tangent_is_singular_but_for_rounding() -> None:
    """At the fold under loads the tangent with y held is regular; elimination by the singular K is
    refined.
    """
    newton, rest = under("y")
    x = 1 - np.sqrt((1 - STIFFNESS["loads"]) / 3) + 1e-9
    state = State(np.array([x, *rest.u[1:]]), rest.mu)
    factors = newton.factor_at(state)
    whole = np.array([factors.times(e) for e in np.eye(4)])
    assert factors.solve(whole @ np.ones(4)) == pytest.approx(np.ones(4), abs=1e-9)
    assert factors.negative_pivots == 0

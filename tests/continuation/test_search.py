"""Deflation against dense linear algebra, and searches on systems all of whose equilibria are
known.
"""

import numpy as np
import pytest

from magshell_fenicsx.continuation.control import Metric, PrescribedLoad
from magshell_fenicsx.continuation.deflation import POWER, SHIFT, Deflation, find_deflated
from magshell_fenicsx.continuation.device import Device
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import StepOptions
from magshell_fenicsx.continuation.search import (
    TIME_IS_OVER,
    SearchLimits,
    Settling,
    further_solutions,
)
from magshell_fenicsx.continuation.system import Amplitudes, State, System, Vector
from tests.continuation.toys import Toy, pitchfork, snap_back, snap_through


def _path(system: System, name: str = "load") -> Path:
    return Path(BorderedNewton(system), name, "load", StepOptions(1.0, 1.0, 1.0))


def _found(system: System, start: State, **limits: int) -> list[Vector]:
    path = _path(system)
    points = further_solutions(
        path, start, [], SearchLimits(**{"solutions": 20, "guesses": 40, **limits})
    )
    return [point.state.u for point in points]


def test_step_is_newtons_for_the_deflated_residual() -> None:
    system, known = snap_back(0.5, 0.3), [np.zeros(3), np.array([1.0, 1.0, 0.0])]
    u, mu = np.array([0.4, 0.7, 0.2]), {"load": 0.1}
    metric = Metric(system, 1.0)

    def M(u: Vector) -> float:
        return float(np.prod([metric.norm(u - v, 0.0) ** -POWER + SHIFT for v in known]))

    R, K = system.residual(u, mu), system.hessian(u)
    slope = np.array([(M(u + 1e-6 * e) - M(u - 1e-6 * e)) / 2e-6 for e in np.eye(3)])
    expected = np.linalg.solve(M(u) * K + np.outer(R, slope), -M(u) * R)
    d = np.linalg.solve(K, -R)
    assert Deflation(metric, known).factor(u, d) * d == pytest.approx(expected, rel=1e-7)


def test_shallow_arch_without_load() -> None:
    # x^3 - 3 x^2 + 2 x = 0
    found = _found(snap_through(length=0.01), State(np.zeros(1), {"load": 0.0}))
    assert sorted(x[0] / 0.01 for x in found) == pytest.approx([1.0, 2.0], abs=1e-9)


def test_all_equilibria_of_a_buckled_column() -> None:
    # beyond the bifurcation u = load + v^2/2 and v^2 (1/2) = load - 1, or v = 0
    found = _found(pitchfork(), State(np.array([1.5, 0.0]), {"load": 1.5}), guesses=6)
    assert sorted(v for _, v in found) == pytest.approx([-1.0, 1.0], abs=1e-9)
    assert [u for u, _ in found] == pytest.approx([2.0, 2.0], abs=1e-9)


def test_all_equilibria_of_an_arch_on_a_spring_and_a_column() -> None:
    # q = x + f/k, f = load + v^2/2: roots of f(x) = 0 with v = 0, and of f(x) = (x - c)/2 with v^2
    # = x - c
    c = 0.3
    straight = [(x, 0.0) for x in (1.0, 2.0)]
    bent = [
        (x, side * np.sqrt(x - c))
        for x in np.roots([1, -3, 1.5, c / 2]).real
        if x > c
        for side in (-1, 1)
    ]
    found = _found(snap_back(0.5, c), State(np.zeros(3), {"load": 0.0}), solutions=6)
    assert sorted((x, v) for _, x, v in np.round(found, 8)) == pytest.approx(
        np.round(sorted(straight + bent), 8)
    )


def test_a_search_ends_at_its_limits() -> None:
    system, start = snap_back(0.5, 0.3), State(np.zeros(3), {"load": 0.0})
    assert len(_found(system, start, solutions=2)) == 2
    assert 0 < len(_found(system, start, guesses=1)) < 6


def test_a_search_ends_when_its_time_is_over_and_its_journal_repeats_it() -> None:
    class Kept:
        def __init__(self) -> None:
            self.results, self.read = [], 0

        def replay(self):
            self.read += 1
            return self.results[self.read - 1] if self.read <= len(self.results) else None

        def record(self, found) -> None:
            self.results.append(found)

    journal, asked = Kept(), []

    def over() -> bool:
        asked.append(1)
        return len(asked) > 3

    def run() -> list[Vector]:
        path = _path(snap_back(0.5, 0.3))
        path = Path(path.newton, "load", "load", path.options, journal=journal)
        points = further_solutions(
            path, State(np.zeros(3), {"load": 0.0}), [], SearchLimits(20, 40, over)
        )
        return [p.state.u for p in points]

    first = run()
    assert first
    assert journal.results[-1] == TIME_IS_OVER
    journal.read = 0
    assert all(np.array_equal(a, b) for a, b in zip(run(), first, strict=True))
    assert len(asked) == 4


def test_newton_leaves_known_solutions_alone() -> None:
    system = snap_through()
    newton, at = BorderedNewton(system), PrescribedLoad("load", 0.0)
    near = State(np.array([0.1]), {"load": 0.0})
    assert newton.solve(near, "load", at).state.u == pytest.approx([0.0], abs=1e-9)
    found = find_deflated(newton, near, "load", at, [np.zeros(1)])
    assert found is not None
    assert min(abs(found.u[0] - x) for x in (1.0, 2.0)) < 1e-3


def test_settling_goes_down_to_the_stable_equilibrium_on_its_side() -> None:
    system = snap_through()
    settling = Settling(system, State(np.zeros(1), {"load": 0.0}))
    for begin, end in ((0.9, 0.0), (1.1, 2.0), (5.0, 2.0)):
        assert settling.settled(State(np.array([begin]), {"load": 0.0})).u == pytest.approx(
            [end], abs=0.01
        )


def test_solutions_with_a_conjugate_held() -> None:
    # the spring's end q is held at 1 instead of its force: k (q - x) = f(x), so x^3 - 3 x^2 + (2 +
    # k) x = k
    class Idle(Toy):
        """With a second amplitude, which does nothing."""

        def load(self, u: Vector, mu: Amplitudes, name: str) -> Vector:
            return super().load(u, mu, name) * (name == "load")

        def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
            return super().potential(u, mu, name) * (name == "load")

    k = 0.1
    arch = snap_back(k, 9.0)
    device = Device(Idle(arch.gradient, arch.hessian, 3), {"load": 1.0}, {"load": 1.0})
    x = np.sort(np.roots([1, -3, 2 + k, -k]).real)
    load = [t**3 - 3 * t**2 + 2 * t for t in x]
    start = device.enter(State(np.array([1.0, x[0], 0.0]), {"load": load[0], "idle": 0.0}))
    path = Path(BorderedNewton(device), "idle", "load", StepOptions(1.0, 1.0, 1.0))
    guess = device.enter(State(np.array([1.0, 1.7, 0.0]), {"load": 0.0, "idle": 0.0}))
    points = list(
        further_solutions(
            path,
            start,
            [lambda: guess],
            SearchLimits(9, 1),
            lambda v: device.padded(device.displacement(v)),
        )
    )
    found = sorted((device.leave(p.state).u[1], p.negative_pivots) for p in points)
    assert [v for v, _ in found] == pytest.approx(x[1:], abs=1e-8)
    assert [n for _, n in found] == [1, 0]

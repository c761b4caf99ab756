"""Bifurcations of toys, found by a regular system, with and without noise."""

from collections.abc import Sequence

import numpy as np
import pytest
from continuation.toys import Toy, pitchfork, snap_back
from petsc4py import PETSc

from magshell_fenicsx.assembly.evaluation import Noise
from magshell_fenicsx.continuation.bifurcation import BifurcationLost, find_bifurcation
from magshell_fenicsx.continuation.continuation_run import instabilities
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import StepOptions
from magshell_fenicsx.continuation.system import Amplitudes, State, Vector, WeightedDisplacement


class Noisy(Toy):
    """A toy whose residual and tangent carry noise."""

    noise: Noise

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        return self.noise.on_vector(self.gradient(u), 0) + mu["load"] * self.load(u, mu, "load")

    def tangent(
        self, u: Vector, mu: Amplitudes, stress: Sequence[WeightedDisplacement] = ()
    ) -> PETSc.Mat:
        K = super().tangent(u, mu)
        self.noise.on_matrix(K)
        return K


def noisy(toy: Toy, level: float, seed: int) -> Noisy:
    found = Noisy(toy.gradient, toy.hessian, toy.size, toy.length)
    found.noise = Noise(level, seed)
    return found


def at(u: list[float], load: float) -> State:
    return State(np.array(u), {"load": load})


@pytest.mark.parametrize("load", [0.5, 0.9, 1.0, 1.3])
@pytest.mark.parametrize("stiffening", [1.0, -0.5])
def test_pitchfork_at_load_one(load: float, stiffening: float) -> None:
    newton = BorderedNewton(pitchfork(stiffening=stiffening))
    found = find_bifurcation(newton, at([load, 0.02], load), np.array([0.1, 1.0]), "load")
    assert found.state.mu["load"] == pytest.approx(1.0, abs=1e-9)
    assert found.state.u == pytest.approx([1.0, 0.0], abs=1e-8)
    assert abs(found.phi) == pytest.approx([0.0, 1.0], abs=1e-8)
    assert found.unstable == 0
    assert found.error <= 1e-9


def test_a_split_pitchfork_is_found_where_it_would_be_whole() -> None:
    found = find_bifurcation(
        BorderedNewton(pitchfork(imperfection=1e-6)),
        at([0.9, 0.01], 0.9),
        np.array([0.0, 1.0]),
        "load",
    )
    assert found.state.mu["load"] == pytest.approx(1.0, abs=1e-9)


def test_a_pitchfork_behind_an_arch() -> None:
    """x = c = 0.3: load = f(c), see `toys.snap_back`."""
    toy, c = snap_back(0.5, 0.3), 0.3
    f = c**3 - 3 * c**2 + 2 * c
    found = find_bifurcation(
        BorderedNewton(toy), at([0.9, 0.28, 0.0], 0.3), np.array([0.0, 0.0, 1.0]), "load"
    )
    assert found.state.mu["load"] == pytest.approx(f, abs=1e-9)
    assert found.state.u == pytest.approx([c + f / 0.5, c, 0.0], abs=1e-8)


def test_no_bifurcation_is_none() -> None:
    toy = Toy(lambda x: x + x**3, lambda x: np.diag(1 + 3 * x**2), 2)
    with pytest.raises(BifurcationLost):
        find_bifurcation(BorderedNewton(toy), at([0.1, 0.0], 0.1), np.array([0.0, 1.0]), "load")


def path_through(toy: Toy) -> list[tuple[float, float]]:
    """The loads of the bifurcations that a path passes, and their estimated errors."""
    path = Path(BorderedNewton(toy), "load", "load", StepOptions(0.3, 0.3, 1e-6))
    low = path.start(at([0.0] * toy.size, 0.0))
    found = []
    for high, _ in path.continue_to(low, [1.9]):
        found += [
            (event.point.state.mu["load"], event.point.load_error)
            for event in instabilities(path, low, high)
        ]
        low = high
    return found


@pytest.mark.parametrize("level", [1e-15, 1e-13, 1e-10])
@pytest.mark.parametrize("seed", range(5))
def test_noise_moves_a_bifurcation_by_its_estimated_error(level: float, seed: int) -> None:
    ((load, error),) = path_through(noisy(pitchfork(), level, seed))
    assert abs(load - 1) <= error + 1e-9
    assert error < 1e3 * level + 1e-8


def test_what_cannot_be_located_is_reported_with_its_bracket_and_the_path_goes_on() -> None:
    """Two modes of the same load are no simple bifurcation: Pi_0 = u^2/2 + (1 - u)(v^2 + w^2)/2 +
    (v^4 + w^4)/4.
    """

    def gradient(x: Vector) -> Vector:
        u, v, w = x
        return np.array([u - (v**2 + w**2) / 2, (1 - u) * v + v**3, (1 - u) * w + w**3])

    def hessian(x: Vector) -> Vector:
        u, v, w = x
        return np.array([[1.0, -v, -w], [-v, 1 - u + 3 * v**2, 0.0], [-w, 0.0, 1 - u + 3 * w**2]])

    found = path_through(Toy(gradient, hessian, 3))
    assert found
    assert all(abs(load - 1) <= error + 1e-8 for load, error in found)


def test_noise_is_symmetric_and_new_each_time() -> None:
    K = PETSc.Mat().createDense([4, 4])
    K.setUp()
    K.setValues(range(4), range(4), np.ones((4, 4)))
    K.assemble()
    K.convert("aij")
    noise = Noise(1e-3, seed=1)
    seen = []
    for _ in range(2):
        noise.on_matrix(K)
        seen.append(K.getValues(range(4), range(4)))
    assert (seen[0] == seen[0].T).all()
    assert 1e-4 < abs(seen[0] - 1).max() <= 1e-3
    assert (seen[0] != seen[1]).any()

"""The second variation along waves: rigid motions, a half's tangent, known instabilities."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import hemisphere as triangulated
from meridian_scenes import E3, Buckling, buckle, buckled, hemisphere

from magshell_fenicsx.continuation.modes import nearest_to_zero
from magshell_fenicsx.continuation.stability_monitor import Crossing, StabilityMonitor
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.shell.parameters import Condition, Material
from magshell_fenicsx.models.shell.spatial_fields import radial
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation, RemanenceLaw
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.shells.shell import ShellModel
from magshell_fenicsx.shells.waves import BandedMatrices

Array = np.ndarray
FIELD = Magnetisation(radial, E3, gradient=np.diag([0.5, 0.5, -1.0]))


def displacement(phi: Array) -> tuple[Array, Array]:
    """A smooth (U, W), zero on the equator and with a slope there."""
    return 0.1 * np.sin(phi) * np.cos(phi), -0.2 * np.cos(phi) ** 2 + 0.1 * np.cos(phi)


def wave(phi: Array, m: int) -> tuple[Array, Array, Array]:
    """Smooth coefficients (U, V, W): U + V like rho^(m+1), U - V like rho^(m-1), W like rho^m."""
    rho, z = np.sin(phi), np.cos(phi)
    return (
        z * (rho ** (m - 1) + rho ** (m + 1)),
        z * (-(rho ** (m - 1)) + 2 * rho ** (m + 1)),
        z * rho**m,
    )


def second_variation(K: Any, v: Array) -> float:
    x, y = K.createVecs()
    x.setArray(v)
    K.mult(x, y)
    return float(x.dot(y))


def on_the_meridian(model: MeridianModel, m: int, mu: dict[str, float]) -> float:
    waves = model.waves
    phi = waves.V.tabulate_dof_coordinates()[:, 0]
    U, V, W = wave(phi, m)
    u = np.column_stack(displacement(model.V.tabulate_dof_coordinates()[:, 0])).ravel()
    return second_variation(waves.tangent(State(u, mu), m), np.column_stack([U + V, V, W]).ravel())


def on_the_shell(model: ShellModel, waves: tuple[int, ...], mu: dict[str, float]) -> list[float]:
    x, y, z = model.r0.x.array.reshape(-1, 3).T
    phi, theta = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)

    def cartesian(U: Array, V: Array, W: Array) -> Array:
        c, s = np.cos(theta), np.sin(theta)
        return np.column_stack([U * c - V * s, U * s + V * c, W]).ravel()

    U0, W0 = displacement(phi)
    K = model.system.tangent(cartesian(U0, 0 * U0, W0), mu)
    found = []
    for m in waves:
        U, V, W = wave(phi, m)
        v = cartesian(U * np.cos(m * theta), V * np.sin(m * theta), W * np.cos(m * theta))
        found.append(second_variation(K, v))
    return found


def crossings(model: MeridianModel, found: Buckling) -> list[Crossing]:
    watch = StabilityMonitor(model.symmetry_breaking_modes)
    watch.begin(found.path, found.points[0])
    return [crossing for point in found.points[1:] for crossing in watch.pass_to(point)]


@pytest.mark.slow
@pytest.mark.parametrize("law", ["deformation", "rotation"])
def test_agrees_with_the_half_shell(law: RemanenceLaw) -> None:
    """All terms but the penalty; thick enough that bending matters, the loads' parts compared by
    themselves.

    The fields turn the clamped edge, where the penalty would depend on the mesh: it is left out.
    """
    waves, unloaded = (1, 2, 5), {"pressure": 0.0, "lambda_m": 0.0}
    loads = Loads(pressure=True, magnetic=replace(FIELD, law=law))
    meridian = hemisphere(4, 0.3, loads, refinement=4, sigma=0.0)
    halved: dict[str, Condition] = {"rim": "clamped", "symmetry": "symmetry"}
    shells = [
        ShellModel(triangulated(size, half=True), Material(0.3, 1 / 4), 4, halved, loads, sigma=0.0)
        for size in (0.5, 0.125)
    ]

    def both(mu: dict[str, float]) -> list[Array]:
        """Of each wave: the meridian's, the coarse shell's, the fine one's."""
        return [
            np.array([on_the_meridian(meridian, m, mu) for m in waves]),
            *(2 * np.array(on_the_shell(shell, waves, mu)) for shell in shells),
        ]

    still = both(unloaded)
    pressed, magnetised = (
        [a - b for a, b in zip(both({**unloaded, name: value}), still, strict=True)]
        for name, value in (("pressure", 0.5), ("lambda_m", 0.05))
    )
    for expected, coarse, fine in (still, pressed, magnetised):
        errors = [abs(found / expected - 1) for found in (coarse, fine)]
        assert (errors[1] < 1e-4).all(), errors
        assert (errors[1] < errors[0] / 4).all(), errors


def test_rigid_motions_are_neutral() -> None:
    """Of the undeformed shell translation and rotation; of a deformed one translation, exactly."""
    model = hemisphere(20, 0.3, Loads(), condition="free")
    waves = model.waves
    rho, z = model.r0.x.array.reshape(-1, 2).T
    zero = 0 * rho
    translation, rotation = (
        np.column_stack(c).ravel() for c in ([zero, zero - 1, zero], [zero, -z, -rho])
    )
    still = State(model.zero(), {})
    u = np.column_stack(displacement(model.V.tabulate_dof_coordinates()[:, 0])).ravel()
    for state, v in ((still, translation), (still, rotation), (State(u, {}), translation)):
        K = waves.tangent(state, 1)
        x, y = K.createVecs()
        x.setArray(v)
        K.mult(x, y)
        assert y.norm() < 1e-12 * K.norm() * x.norm()


def test_known_waves() -> None:
    """An independent axisymmetric solver with its own circumferential modes; before the
    axisymmetric fold.
    """
    model, found = buckled(300, 0.00184)
    waves = model.waves
    first = crossings(model, found)[0]
    m, point = int(first.label.removeprefix("m = ")), first.point
    assert m == 28
    assert point.state.mu["pressure"] == pytest.approx(1.0145, rel=1e-4)
    assert point.state.mu["pressure"] < found.instability.point.state.mu["pressure"]
    there, before = (
        nearest_to_zero(waves.factor_at(state, m))[0]
        for state in (point.state, found.points[0].state)
    )
    assert abs(there) < 1e-5 * before


def test_no_wave_before_the_fold() -> None:
    """R/h = 90: the paper's knockdown is the axisymmetric fold."""
    model, found = buckled(90, 0.00184)
    assert crossings(model, found) == []


@pytest.mark.slow
def test_perfect_hemisphere_buckles_in_waves_at_its_edge() -> None:
    """The full shell's tangent (44 589 unknowns) has its first two negative pivots between 0.8405
    and 0.8418.
    """
    model = hemisphere(90, 0.5, Loads(pressure=True))
    found = buckle(model, 0.0)
    first = crossings(model, found)[0]
    assert first.label == "m = 14"
    assert first.point.state.mu["pressure"] == pytest.approx(0.84111, rel=1e-4)


@pytest.mark.parametrize(("R_over_h", "lambda_m"), [(90, 0.00184), (300, 0.00184)])
def test_counts_of_all_waves_are_those_of_each(R_over_h: float, lambda_m: float) -> None:
    """Interpolated between five m, as a polynomial of degree 4; 13 are unstable at one fold."""
    model, found = buckled(R_over_h, lambda_m)
    waves, state = model.waves, found.instability.point.state
    counts = waves.counts(state)
    assert {m: count for m, count in enumerate(counts, 1) if count} == waves.unstable(state)
    assert sum(counts) == (13 if R_over_h == 300 else 0)


@pytest.mark.telling
@pytest.mark.parametrize("triangle", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_definite_or_not(seed: int, triangle: bool) -> None:
    """Two matrices of one sparsity, or their triangles, interpolated so that the least eigenvalue
    crosses zero.
    """
    random, n = np.random.default_rng(seed), 30
    order = random.permutation(n)  # of a band that the numbering hides
    near = np.abs(order[:, None] - order) <= 3
    A, B = (np.where(near, x + x.T, 0.0) for x in random.standard_normal((2, n, n)))
    A += 100 * np.eye(n)  # definite, and so is A + t (B - A) for small t alone
    rows, columns = np.nonzero(np.triu(near) if triangle else near)
    held = np.array([0, 7], dtype=np.int32)
    banded = BandedMatrices(rows, columns, held)
    bands = banded.bands([A[rows, columns], B[rows, columns]])
    free = np.setdiff1d(np.arange(n), held)

    def least(t: float) -> float:
        return float(np.linalg.eigvalsh((A + t * (B - A))[np.ix_(free, free)])[0])

    seen = {
        banded.is_positive_definite(bands, np.array([1.0 - t, t])): least(t) > 0
        for t in np.linspace(0, 0.99, 40)
    }
    assert seen == {True: True, False: False}

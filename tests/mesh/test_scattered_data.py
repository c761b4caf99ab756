"""A smooth function through scattered values, against the function that they are of."""

import pickle

import numpy as np
import pytest
from numpy.typing import NDArray

from magshell_fenicsx.mesh.scattered_data import fit_scattered

Array = NDArray[np.float64]
RNG = np.random.default_rng(16)
WIDTH = 0.2


def on_sphere(n: int) -> Array:
    """Uniform in area on the upper half."""
    z, theta = RNG.random(n), 2 * np.pi * RNG.random(n)
    r = np.sqrt(1 - z * z)
    return np.column_stack([r * np.cos(theta), r * np.sin(theta), z])


def bump(x: Array) -> Array:
    return np.exp(-(np.arccos(np.clip(x[:, 2], -1, 1)) ** 2) / WIDTH**2) + 0.2 * np.sin(5 * x[:, 0])


PLACES, ELSEWHERE = on_sphere(1500), on_sphere(3000)


def test_interpolates_and_converges() -> None:
    """Exact at the places, and between them of third order at least (Wendland 2005, theorem 11.36,
    less its edge).
    """
    inner = ELSEWHERE[ELSEWHERE[:, 2] > 0.3]
    errors = []
    for n in (375, 1500):
        found = fit_scattered(PLACES[:n], bump(PLACES[:n]), PLACES[:n:5], noise=0)
        assert found(PLACES[:n]) == pytest.approx(bump(PLACES[:n]), abs=1e-8)
        errors.append(float(np.sqrt(np.mean((found(inner) - bump(inner)) ** 2))))
    assert errors[1] < errors[0] / 2**3
    assert errors[1] < 2e-4


def test_noise_is_estimated_and_smoothed() -> None:
    noisy = bump(PLACES) + 0.03 * RNG.standard_normal(len(PLACES))
    found = fit_scattered(PLACES, noisy, PLACES[::5])
    assert found.noise == pytest.approx(0.03, rel=0.06)
    assert found.residual == pytest.approx(0.03, rel=0.15)
    left = np.sqrt(np.mean((found(ELSEWHERE) - bump(ELSEWHERE)) ** 2))
    assert left < 0.03 / 2
    given = fit_scattered(PLACES, noisy, PLACES[::5], noise=0.03)
    assert np.sqrt(np.mean((given(ELSEWHERE) - bump(ELSEWHERE)) ** 2)) < 0.03 / 2


def test_second_derivatives_are_continuous() -> None:
    """Halving the step halves the change of second differences: no jumps at borders of patches."""
    found = fit_scattered(PLACES[:500], bump(PLACES[:500]), PLACES[:500:3], noise=0)

    def change(d: float) -> float:
        s = np.arange(-0.5, 0.5, d)
        x = np.column_stack([np.sin(s), 0 * s, np.cos(s)])
        bend = np.diff(found(x), 2) / d**2
        return float(np.abs(np.diff(bend)).max())

    assert change(5e-4) < 0.65 * change(1e-3)


def test_a_hole_in_dense_noisy_values_is_bridged() -> None:
    """The nearest values of a place in it lie on a thin arc, which says little of the slope across
    it.
    """
    many = on_sphere(40000)
    many = many[(many[:, 2] > 0.93) & (np.linalg.norm(many - [0, 0, 1], axis=1) > 0.2)]
    noisy = 0.5 * many[:, 0] + 0.02 * RNG.standard_normal(len(many))
    found, hole = (
        fit_scattered(many, noisy, ELSEWHERE[ELSEWHERE[:, 2] > 0.94]),
        ELSEWHERE[ELSEWHERE[:, 2] > 0.98],
    )
    assert np.sqrt(np.mean((found(hole) - 0.5 * hole[:, 0]) ** 2)) < 0.03


def test_a_hole_is_bridged_and_copies_are_the_same() -> None:
    outside = PLACES[np.linalg.norm(PLACES - [0.6, 0, 0.8], axis=1) > 0.15]
    found = fit_scattered(outside, 0.3 * outside[:, 0] ** 2, PLACES[::5], noise=0)
    assert pickle.loads(pickle.dumps(found))(ELSEWHERE) == pytest.approx(
        0.3 * ELSEWHERE[:, 0] ** 2, abs=1e-3
    )
    twice = np.vstack([outside, outside])
    again = fit_scattered(twice, 0.3 * twice[:, 0] ** 2, PLACES[::5], noise=0)
    assert np.array_equal(again(ELSEWHERE[:50]), found(ELSEWHERE[:50]))

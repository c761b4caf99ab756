"""Langevin's law in a sheet: SciPy's solution at points, and derivatives by differences of those
below them.
"""

from math import factorial

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from magshell_fenicsx.parts.magnetism.saturation import ORDERS, expand_energy, polarisation, ratio

POINTS = [
    (chi, n, t)
    for chi in (0.3, 5.0, 400.0)
    for n in (1e-3, 0.4, 3.0, 60.0)
    for t in (0.0, 0.02, 0.7, 20.0)
]


def langevin(x: float) -> float:
    return 1 / np.tanh(x) - 1 / x if x > 0.03 else x / 3 - x**3 / 45 + 2 * x**5 / 945 - x**7 / 4725


def across(chi: float, normal: float, along: float) -> float:
    """b_n with B_n = b_n + mu0 M_n, J = 1."""

    def left(b: float) -> float:
        size = np.hypot(b, along)
        return float(normal - b - langevin(3 * chi * size) * b / size)

    return float(brentq(left, normal / (1 + chi) * (1 - 1e-12), normal, xtol=1e-16, rtol=1e-15))


@pytest.mark.parametrize(("chi", "normal", "along"), POINTS)
def test_energy_and_polarisation(chi: float, normal: float, along: float) -> None:
    """The coenergy is the integral of mu0 M over b: 1e-10."""
    b = across(chi, normal, along)
    size = np.hypot(b, along)
    w = quad(lambda x: langevin(x), 0, 3 * chi * size, epsabs=0, epsrel=1e-12, limit=200)[0] / (
        3 * chi
    )
    found = expand_energy(*map(np.array, (chi, normal**2, along**2)), 1.0)
    assert found[2] == pytest.approx(-w - (normal - b) ** 2 / 2, rel=1e-10)
    J = langevin(3 * chi * size) / size * np.array([along, 0, b])
    n = np.array([0.0, 0, 1])
    in_sheet = polarisation(np.array([chi]), np.array([along, 0.0, 0]), np.array([normal]), n, 1.0)
    np.testing.assert_allclose(in_sheet, J, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("order", [order for order in ORDERS if sum(order)])
def test_derivatives(order: tuple[int, int]) -> None:
    """Central differences of the derivative of one order less, on both sides of the end of the
    series.
    """
    which = 0 if order[0] else 1
    below = (order[0] - 1, order[1]) if order[0] else (0, order[1] - 1)
    chi, normal, along = np.array([point for point in POINTS if point[2]]).T

    def at(order: tuple[int, int], move: float) -> np.ndarray:
        given = [normal**2, along**2]
        given[which] = given[which] * (1 + move)
        values = expand_energy(chi, *given, 1.0)[..., 2 + ORDERS.index(order)]
        return np.asarray(values * factorial(order[0]) * factorial(order[1]))

    step = 2e-3
    a, b, c, d = (at(below, side * step) for side in (-2, -1, 1, 2))
    expected = (a - 8 * b + 8 * c - d) / (12 * step) / (normal**2, along**2)[which]
    scale = np.abs(at(below, 0.0)) / (normal**2, along**2)[which]
    assert np.all(np.abs(at(order, 0.0) - expected) <= 1e-8 * np.abs(expected) + 1e-11 * scale)


def test_a_strong_field() -> None:
    """k ends at 3/x - 3/x² without loss of digits."""
    x = np.array([1e2, 1e5, 1e8])
    np.testing.assert_allclose(ratio(x**2), 3 / x - 3 / x**2, rtol=1e-15)

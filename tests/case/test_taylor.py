"""Derivatives of formulas against central differences of their values."""

import numpy as np
import pytest

from magshell_fenicsx.input.expressions import FUNCTIONS, formula, formula_with_derivatives

PLACES = np.random.default_rng(0).uniform(0.2, 1.0, (20, 3))
FORMULAS = [
    "3.5",
    "pi*x",
    "-x + 2*y - +z",
    "x*y*z/(1 + z**2)",
    "sin(x)*cos(y) + tan(z/2)",
    "exp(-x*y)/sqrt(x**2 + y**2 + z**2)**3",
    "log(x)*abs(y - 2) + sign(z)*x",
    "arctan2(y*z, x)",
    "x**y + 2**z + (x*y)**-1.5",
]


def slope(f, i: int, step: float = 1e-3):  # type: ignore[no-untyped-def]
    """Of sixth order."""
    e = step * np.eye(3)[i]
    return (
        sum(
            w * (f(PLACES + n * e) - f(PLACES - n * e))
            for n, w in ((1, 0.75), (2, -0.15), (3, 1 / 60))
        )
        / step
    )


@pytest.mark.parametrize("text", FORMULAS)
def test_derivatives(text: str) -> None:
    found = formula_with_derivatives(text)(PLACES)
    assert found.value == pytest.approx(formula(text)(*PLACES.T), rel=1e-14)
    for i in range(3):
        gradient = slope(lambda x: formula(text)(*x.T), i)
        assert found.gradient[i] == pytest.approx(gradient, rel=1e-9, abs=1e-9)
        hessian = slope(lambda x: formula_with_derivatives(text)(x).gradient, i)
        assert found.hessian[i] == pytest.approx(hessian, rel=1e-9, abs=1e-9)


def test_powers_at_zero() -> None:
    """x, x**2 and x**3 have derivatives there, the root has none."""
    zero = np.zeros((1, 3))
    for power, first, second in ((0, 0, 0), (1, 1, 0), (2, 0, 2), (3, 0, 0)):
        found = formula_with_derivatives(f"x**{power}")(zero)
        assert (found.gradient[0, 0], found.hessian[0, 0, 0]) == (first, second)
    assert not np.isfinite(formula_with_derivatives("sqrt(x)")(zero).gradient).all()


def test_every_function_has_derivatives() -> None:
    for name, function in FUNCTIONS.items():
        found = formula_with_derivatives(f"{name}({', '.join(['x'] * function.nin)})")(PLACES)
        assert found.hessian.shape == (3, 3, 20)

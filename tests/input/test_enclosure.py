"""Ranges of formulas in boxes. Source: values at random places of the boxes."""

import numpy as np
import pytest

from magshell_fenicsx.input.expressions import formula


@pytest.mark.parametrize(
    "text",
    [
        "sin(3*x)*cos(7*y)",
        "exp(-3000*((x-0.31)**2+(y-0.23)**2))",
        "(1+sign(0.2**2-x**2+2*0.31*x-0.31**2-(y-0.23)**2))/2",
        "cos(2*arctan2(y, x)) + tan(x)",
        "x**3/(1+y**2) - x**-2 + abs(x)**1.5",
        "2**x + log(x) + sqrt(y) + x**y - 1/z",
        "3",
    ],
)
def test_all_values_are_in_the_range(text):
    random, of = np.random.default_rng(1), formula(text)
    middle, half = (
        random.uniform(-1, 1, (500, 3)),
        random.uniform(0, 1, (500, 3)) * 10 ** random.uniform(-4, 0, (500, 1)),
    )
    least, most, bent = of.bounds(middle - half, middle + half)
    values = of(
        *np.moveaxis(middle[:, None] + half[:, None] * random.uniform(-1, 1, (500, 100, 3)), -1, 0)
    )
    rounding = 1e-9 * (1 + np.abs(values))
    good = np.isfinite(values)
    assert ((values >= least[:, None] - rounding) & (values <= most[:, None] + rounding))[
        good
    ].all()
    assert (bent >= 0).all()


def test_ranges_shrink_with_the_square_of_the_box():
    """x - x**2 at its top: what arithmetic without derivatives loses is linear in the box."""
    for h in (1e-2, 1e-4):
        least, most, _ = formula("x - x**2").bounds(
            np.array([[0.5 - h, 0, 0]]), np.array([[0.5 + h, 0, 0]])
        )
        assert most[0] - least[0] < 5 * h**2


def test_an_infinite_exponent_has_a_range():
    least, most, _ = formula("x**(1e308*10)").bounds(
        np.array([[0.2, 0, 0]]), np.array([[0.5, 0, 0]])
    )
    assert least[0] <= 0 <= most[0]

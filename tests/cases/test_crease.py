"""The pop-up unit of two plates and a crease, against two bars with a spring between."""

import numpy as np
import pytest
from conftest import CASES
from scipy.optimize import brentq, minimize_scalar

from magshell_fenicsx import Case
from magshell_fenicsx.public import run

h, WIDTH, STIFFNESS = 0.05, 0.2, 2e-7
FOLDED = np.radians(2)
D = h**3 / 12


def force(w: float) -> float:
    """On bars of length 1 that the crease has moved down by w; their bending is in series with the
    spring.
    """
    c, y = np.cos(FOLDED), np.sin(FOLDED) - w
    strain, spring = (c**2 + y**2 - 1) / 2, STIFFNESS / (1 + 2 * STIFFNESS / (3 * D))
    angle = 2 * (np.arctan2(y, c) - FOLDED)
    return float(-WIDTH * (2 * h * strain * y + spring * angle * 2 * c / (c**2 + y**2)))


@pytest.mark.slow
def test_two_stable_shapes() -> None:
    """Where it snaps, 1e-4, and where it rests without force in its second shape, 1e-3."""
    rows = run(Case.load(CASES / "crease.yaml")).rows
    w = -np.array([row["left_crease_uz"] for row in rows])
    load = np.array([row["load_factor"] for row in rows])
    first = next(row for row in rows if row["label"] == "fold")
    highest = minimize_scalar(lambda w: -force(w), bounds=(0, 0.03), method="bounded")
    assert first["load_factor"] == pytest.approx(-highest.fun, rel=1e-4)
    near = np.abs(w - 0.07).argsort()[:3]
    rests = np.polynomial.Polynomial.fit(load[near], w[near], 2)(0.0)
    assert rests == pytest.approx(brentq(force, 0.06, 0.075), rel=1e-3)
    assert [int(row["negative_pivots"]) for row in rows if row["label"] == "target"][-1] == 0

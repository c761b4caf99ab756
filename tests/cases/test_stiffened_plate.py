"""A plate with a stiffener, against the beam of its section."""

import pytest
from conftest import CASES

from magshell_fenicsx import Case
from magshell_fenicsx.public import run


def test_stiffened_plate() -> None:
    """F L^3/(3 EI) of the T-shaped section about its own axis, 2e-3; w at the point is that of the
    plate.
    """
    b, t, height, length, E = 25e-3, 2e-3, 10e-3, 0.4, 210e9
    flange, web = b * t, t * height
    axis = web * height / 2 / (flange + web)
    inertia = b * t**3 / 12 + flange * axis**2 + t * height**3 / 12 + web * (height / 2 - axis) ** 2
    row = run(Case.load(CASES / "stiffened_plate.yaml")).rows[-1]
    assert row["plate_tip_uz_mm"] == pytest.approx(
        -1e3 * 20 * length**3 / (3 * E * inertia), rel=2e-3
    )
    assert row["w_pole_over_h"] == pytest.approx(-row["plate_tip_uz_mm"] / 2, rel=1e-9)

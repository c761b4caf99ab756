"""A magnetised disc on soft springs is nearly rigid: its displacements along the path are tiny.

Source: a rigid disc with the foundation stiffness k tilts out of a field against its magnetisation
at the flux density k R^2 mu0/(4 Br h); R radius, h thickness, Br remanent flux density.
"""

from math import pi
from typing import Any

import pytest

from magshell_fenicsx.public import run

BR, RADIUS, THICKNESS, STIFFNESS = 0.1, 0.01, 0.4e-3, 1e3  # T, m, m, N/m^3
CRITICAL = STIFFNESS * RADIUS**2 * 4e-7 * pi / (4 * BR * THICKNESS)  # T


def floating_disc(modulus: str, field: str) -> dict[str, Any]:
    return {
        "shell": {
            "geometry": "disc",
            "radius": "10 mm",
            "thickness": "0.4 mm",
            "youngs_modulus": modulus,
            "poisson_ratio": 0.3,
        },
        "boundary": {"rim": "free"},
        "foundation": {
            "stiffness": f"{STIFFNESS} newton/metre^3",
            "tangential": f"{STIFFNESS} newton/metre^3",
        },
        "magnetic": {
            "remanent": {"polar": 90, "azimuth": 0, "flux_density": "100 mT"},
            "applied": {"polar": 90, "azimuth": 0, "flux_density": field},
        },
        "loading": {"kind": "field", "until": "target", "points": 1},
    }


@pytest.mark.parametrize("field", [-1.2, -0.82])
def test_tilt_in_a_reversed_field(field: float) -> None:
    """The search converges although displacements of 1e-5 h hardly change from step to step."""
    rows = run(floating_disc("100 MPa", f"{field} mT")).rows
    (tilt,) = [row for row in rows if row["label"] == "bifurcation"]
    share_of_field = float(tilt["lambda_m"]) / float(rows[-1]["lambda_m"])
    assert share_of_field * field == pytest.approx(-1e3 * CRITICAL, rel=1e-3)


def test_tilt_after_a_shift() -> None:
    """A dead load shifts the disc by its thickness, which changes the critical field in nothing."""
    case = floating_disc("100 MPa", "-1.2 mT")
    load = {"over": "all", "per_area": [0, 0, "-0.4 Pa"]}
    shift = {"kind": "dead", "loads": [load], "factor": 1, "points": 1}
    rows = run(case | {"loading": [shift, case["loading"]]}).rows
    tilt, *_ = (row for row in rows if row["label"] == "bifurcation")
    share_of_field = float(tilt["lambda_m"]) / float(rows[-1]["lambda_m"])
    assert share_of_field * -1.2 == pytest.approx(-1e3 * CRITICAL, rel=1e-3)


def test_a_first_step_that_ends_at_the_target_but_for_rounding() -> None:
    """The next step ends behind the target; it had the length zero, again and again."""
    rows = run(floating_disc("1 GPa", "10 mT")).rows
    assert rows[-1]["label"] == "target"
    assert len(rows) < 5

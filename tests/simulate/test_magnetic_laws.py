"""Whole runs with both laws of the remanence, and in fields by formulas."""

from collections.abc import Sequence

import pytest
from conftest import CASES

from magshell_fenicsx import Case, run

STRIP, SOLID = CASES / "magnetic_strip.yaml", ["model=solid", "mesh.size=0.1"]


def tip(settings: Sequence[str]) -> float:
    return float(run(Case.load(STRIP, settings), None).rows[-1]["w_over_h"])


def thin(R_over_h: float) -> list[str]:
    """The same elastica: q = 12 lambda_m (L/h)^2 = 4."""
    return [f"shell.radius_to_thickness={R_over_h}", f"magnetic.lambda_m={4 / 12 / R_over_h**2}"]


@pytest.mark.slow
@pytest.mark.parametrize("model", ["shell", "solid"])
def test_laws_agree_where_nothing_stretches(model: str) -> None:
    """A strip bends far and stretches by 3e-7 at L/h = 1000: to 1e-6.

    The shells at 100 are 30 times as far apart.
    """
    coarse = SOLID if model == "solid" else ["mesh.refinement=0.4"]
    apart = []
    for R_over_h in (1000, 100) if model == "shell" else (1000,):
        found = [
            tip([*thin(R_over_h), *coarse, f"magnetic.remanence={law}"])
            for law in ("deformation", "rotation")
        ]
        apart.append(abs(found[1] / found[0] - 1))
    assert apart[0] < 1e-6
    assert all(30 * apart[0] < other < 1e-4 for other in apart[1:])


@pytest.mark.slow
def test_uniform_field_as_formulas() -> None:
    coarse = ["mesh.refinement=0.4"]
    as_formulas = tip([*coarse, "magnetic.applied={components: ['0', '0', '1']}"])
    assert as_formulas == pytest.approx(tip(coarse), rel=1e-10)

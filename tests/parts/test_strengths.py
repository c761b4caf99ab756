"""Strengths of loads: the amplitudes at a factor of one that sections of a case give."""

from pathlib import Path

import pytest

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.registered import section_of_strength, strength_ratios

CASES = Path(__file__).parents[2] / "cases"


def context_of(*settings: str) -> Context:
    return Case.load(CASES / "dimple_buckling.yaml", settings).context


def test_a_load_has_a_strength_with_its_section() -> None:
    """A strength of zero is one too."""
    assert context_of("magnetic.lambda_m=0.002").strengths == {"lambda_m": 0.002}
    assert context_of().strengths == {"lambda_m": 0.0}
    assert context_of("magnetic=null").strengths == {}
    assert section_of_strength("lambda_m") == "magnetic"


def test_components_of_a_load_change_with_its_strength() -> None:
    """Only where it changes, and not from zero, which has no ratio to anything."""
    weak, strong = context_of("magnetic.lambda_m=0.001"), context_of("magnetic.lambda_m=-0.002")
    ratios = dict.fromkeys(("lambda_m", "lambda_across", "lambda_third"), -2.0)
    assert strength_ratios(weak, strong) == pytest.approx(ratios)
    assert strength_ratios(weak, weak) == {}
    assert strength_ratios(context_of(), strong) == {}
    assert strength_ratios(weak, context_of()) == dict.fromkeys(ratios, 0.0)

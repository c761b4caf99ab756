"""Applied fields by formulas that no magnets and currents elsewhere make."""

import pytest

from magshell_fenicsx import Case
from magshell_fenicsx.public import Scene


@pytest.mark.parametrize(
    ("components", "said"),
    [
        (["x", "-y/2", "-z/2"], ""),  # neither a divergence nor a curl
        (["x", "0", "0"], "div B is up to 1 and curl B up to 0 B^a/R"),
        (["-y", "x", "0"], "div B is up to 0 and curl B up to 2 B^a/R"),
    ],
)
def test_warning_of_fields_with_sources_on_the_shell(components: list[str], said: str) -> None:
    """The divergence and the size of the curl are those of the formulas."""
    sections = {
        "shell": {"geometry": "hemisphere", "radius_to_thickness": 20, "poisson_ratio": 0.3},
        "boundary": {"equator": "clamped"},
        "loading": {"kind": "pressure"},
        "mesh": {"refinement": 0.3, "degree": 2},
        "symmetry": "none",
        "magnetic": {"lambda_m": 1e-5, "applied": {"components": components}},
    }
    warnings = [line for line in Scene(Case.from_source(sections)).warnings if "div B" in line]
    assert len(warnings) == bool(said)
    assert all(said in line for line in warnings)

"""Targets with units against the same as numbers. The sizes are of docs/theory.md, by hand."""

from math import pi, sqrt
from typing import Any

import pytest

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import CaseError

R, H, E, NU = 25.2e-3, 0.28e-3, 1.8e6, 0.3
SHELL = {
    "geometry": "cap",
    "radius": "25.2 mm",
    "thickness": "0.28 mm",
    "youngs_modulus": "1.8 MPa",
    "polar": 60,
}
PATCH = {"kind": "indentation", "at": {"polar": 0}, "until": "target"}


def case(loading: Any, **shell: Any) -> Case:
    data = {
        "shell": {**SHELL, "poisson_ratio": NU, **shell},
        "boundary": {"rim": "clamped"},
        "loading": loading,
    }
    return Case.from_source(data)


@pytest.mark.parametrize(
    ("loading", "key", "size"),
    [
        ({**PATCH, "depth": "0.7 mm"}, "depth", 0.7e-3 / H),
        ({**PATCH, "depth": "-3 um"}, "depth", -3e-6 / H),
        ({**PATCH, "depth": 1, "patch": "0.2 mm"}, "patch", 0.2e-3 / H),
        (
            {**PATCH, "control": "load", "force": "2 mN"},
            "force",
            2e-3 * 6 * (1 - NU**2) * R / (pi * E * H**3),
        ),
        (
            {"kind": "pressure", "control": "load", "until": "target", "pressure": "0.1 kPa"},
            "pressure",
            100 * sqrt(3 * (1 - NU**2)) * (R / H) ** 2 / (2 * E),
        ),
        (
            {"kind": "pressure", "until": "target", "volume_change": "-80 mm^3"},
            "volume_change",
            -80e-9 / R**3,
        ),
    ],
)
def test_sizes(loading: dict[str, Any], key: str, size: float) -> None:
    (step,) = case([loading]).programme
    assert getattr(step.load, key) == pytest.approx(size, rel=1e-12)


def test_a_gas() -> None:
    """Its volume in litres over R^3."""
    gas = {"ambient": "100 kPa", "volume": "0.03 l"}
    _, step = case(
        [
            {"kind": "pressure", "control": "load"},
            {**PATCH, "depth": 1, "hold": {"pressure": {"gas": gas}}},
        ]
    ).programme
    assert step.load.hold["pressure"].gas.volume == pytest.approx(3e-5 / R**3, rel=1e-12)


def test_mistakes() -> None:
    """Another dimension; a shell without units; numbers stay numbers, and bounds hold for both."""
    with pytest.raises(CaseError, match=r"loading\.depth: '2 s': is not convertible to millimetre"):
        case({**PATCH, "depth": "2 s"})
    bare = {"radius": 90, "thickness": 1, "youngs_modulus": 1}
    with pytest.raises(CaseError, match="lengths of the shell with units; a number is in h"):
        case({**PATCH, "depth": "2 mm"}, **bare)
    assert case({**PATCH, "depth": 2.5}, **bare).programme[0].load.end.target[1] == 2.5  # type: ignore[index]
    with pytest.raises(CaseError, match=r"loading\.depth: '4 km'"):
        case({**PATCH, "depth": "4 km"})

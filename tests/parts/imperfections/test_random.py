"""Random imperfections: their statistics, and that a seed says all."""

from typing import Any

import numpy as np
import pytest

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.parts.imperfections.random import RandomWaves

DIMPLES = {"count": 4, "amplitude": {"kind": "uniform", "above": 0.2, "below": 1.0}, "width": 2.0}


def case(item: dict[str, Any], **keys: Any) -> Case:
    shell = {
        "geometry": "hemisphere",
        "radius_to_thickness": 50,
        "poisson_ratio": 0.3,
        "imperfections": [item],
    }
    data = {
        "shell": shell,
        "boundary": {"equator": "clamped"},
        "loading": {"kind": "pressure"},
        **keys,
    }
    return Case.from_source(Source("case.yaml", data))


def test_size_and_correlation_of_the_field() -> None:
    """Over 400 seeds the variance is 1 and the correlation exp(-d^2/(2 l^2)), within three standard
    errors.
    """
    x = np.column_stack([np.linspace(0, 0.6, 13), np.zeros(13), np.ones(13)])
    w0 = np.array([RandomWaves(1.0, 0.2, seed)(x) for seed in range(400)])
    correlation = np.mean(w0[:, :1] * w0, axis=0)
    assert np.mean(w0**2) == pytest.approx(1, abs=0.09)
    assert correlation == pytest.approx(np.exp(-((x[:, 0] / 0.2) ** 2) / 2), abs=3 / np.sqrt(400))
    assert np.mean(w0[:, 0] ** 4) == pytest.approx(
        3, abs=3 * np.sqrt(96 / 400)
    )  # of a normal distribution


def test_a_seed_is_one_field_everywhere() -> None:
    """The values are written down here: no machine, version or number of places may change them."""
    x = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, -1.0, 0.0]])
    assert RandomWaves(1.0, 0.3, 7)(x) == pytest.approx(WRITTEN, abs=1e-12)
    many = np.tile(x, (1400, 1))
    assert RandomWaves(1.0, 0.3, 7)(many)[-3:] == pytest.approx(WRITTEN, abs=1e-12)


WRITTEN = [-0.18993069089806358, 0.31557400662418295, 1.7947743670257714]


def test_a_field_is_a_full_shell_with_small_elements() -> None:
    problem = make_problem(case({"kind": "random", "seed": 3, "amplitude": 0.1, "length": 1.0}))
    assert problem.included[0] == "full shell"
    assert problem.size([0.1, 0.1]) <= 1 / np.sqrt(np.sqrt(12 * 0.91) * 50) * (1 + 1e-9)


def test_dimples_are_drawn_from_the_seed() -> None:
    item = {"kind": "random", "seed": 3, "dimples": {**DIMPLES, "polar": [0, 60], "distance": 25}}
    found = case(item).imperfections
    assert list(found) == [f"imperfections.0.dimples.{i}" for i in range(4)]
    assert found == case(item).imperfections
    assert found != case(item | {"seed": 4}).imperfections
    at = np.array([section.at.vector() for section in found.values()])  # type: ignore[attr-defined]
    apart = np.degrees(np.arccos(np.clip(at @ at.T, -1, 1)))[np.triu_indices(4, 1)]
    assert apart.min() >= 25
    assert make_problem(case(item)).included[0] == "full shell"


@pytest.mark.parametrize(
    ("item", "words"),
    [
        ({"seed": 1, "amplitude": 0.1}, "give amplitude and length of a random field, or dimples"),
        ({"seed": 1}, "give amplitude and length of a random field, or dimples"),
        ({"seed": -1, "amplitude": 0.1, "length": 1.0}, "seed: -1"),
        ({"seed": 1, "amplitude": 0.1, "length": 0.01}, "length: 0.01"),
        ({"seed": 1, "dimples": {**DIMPLES, "polar": [0, 10], "distance": 30}}, "do not fit"),
        ({"seed": 1, "amplitude": 0.1, "length": 1.0, "waves": 3}, "waves: unknown key"),
    ],
)
def test_what_is_refused(item: dict[str, Any], words: str) -> None:
    with pytest.raises(CaseError, match=words):
        case({"kind": "random", **item})

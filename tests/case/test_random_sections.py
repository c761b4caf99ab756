"""Distributions against SciPy's, random places against the sphere's area, what is refused."""

import json
from itertools import combinations
from math import cos, radians
from typing import Any

import numpy as np
import pytest
from conftest import CASES
from pydantic import ValidationError
from scipy import stats

from magshell_fenicsx import CaseError
from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.chance import DistributionSection, NoRoom, generator, random_places
from magshell_fenicsx.studies.ensemble.sections import EnsembleSection

SPREAD = np.sqrt(
    np.log(1 + 0.5**2)
)  # of the logarithm of a lognormal number with mean 1 and deviation 0.5
LAWS = [
    ({"kind": "normal", "mean": 2.0, "deviation": 0.3}, stats.norm(2, 0.3)),
    (
        {"kind": "lognormal", "mean": 1.0, "deviation": 0.5},
        stats.lognorm(SPREAD, scale=np.exp(-(SPREAD**2) / 2)),
    ),
    ({"kind": "uniform", "above": -1.0, "below": 3.0}, stats.uniform(-1, 4)),
    (
        {"kind": "normal", "mean": 0.0, "deviation": 1.0, "above": -0.5, "below": 2.0},
        stats.truncnorm(-0.5, 2),
    ),
]


@pytest.mark.parametrize(("section", "law"), LAWS, ids=[section["kind"] for section, _ in LAWS])
def test_quantiles_are_those_of_scipy(section: dict[str, Any], law: Any) -> None:
    made = DistributionSection(**section)
    for part in (1e-6, 0.1, 0.5, 0.99):
        assert made.quantile(part) == pytest.approx(law.ppf(part), rel=1e-9)


def test_lognormal_moments_are_those_of_the_number() -> None:
    drawn = [DistributionSection(**LAWS[1][0]).quantile((i + 0.5) / 2_000) for i in range(2_000)]
    assert np.mean(drawn) == pytest.approx(1, abs=1e-3)
    assert np.std(drawn) == pytest.approx(0.5, abs=1e-2)


def test_choices_have_their_weights_and_units() -> None:
    made = DistributionSection(kind="choice", values=[1.5, "b"], weights=[3, 1])
    assert [made.quantile(part) for part in (0.0, 0.7499, 0.7501, 1 - 1e-12)] == [
        1.5,
        1.5,
        "b",
        "b",
    ]
    assert (
        DistributionSection(kind="uniform", above=1.0, below=1.5, unit="mm").quantile(0.5)
        == "1.25 mm"
    )


def test_places_are_uniform_in_area_and_apart() -> None:
    """The height of a uniform place on a sphere is uniform, and so is its azimuth (Archimedes)."""
    alone = random_places(np.random.default_rng(0), 400, (10.0, 60.0), 0.0)
    heights = np.cos(np.radians(alone[:, 0]))
    assert stats.kstest(heights, stats.uniform(0.5, cos(radians(10)) - 0.5).cdf).pvalue > 0.01
    assert stats.kstest(alone[:, 1], stats.uniform(0, 360).cdf).pvalue > 0.01
    polar, azimuth = np.radians(random_places(np.random.default_rng(1), 8, (0.0, 60.0), 30.0)).T
    places = np.column_stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
    )
    assert all(np.degrees(np.arccos(a @ b)) >= 30 - 1e-9 for a, b in combinations(places, 2))


def test_places_that_do_not_fit() -> None:
    with pytest.raises(NoRoom, match="50 places at least 25 degrees apart do not fit"):
        random_places(np.random.default_rng(0), 50, (0.0, 60.0), 25.0)
    with pytest.raises(
        NoRoom, match="no room was found"
    ):  # a packing that random placing does not find
        random_places(np.random.default_rng(0), 26, (0.0, 60.0), 25.0)


def test_drawn_values_depend_on_seed_number_and_key_alone() -> None:
    """Another key does not change a key's numbers, whose values are those of NumPy's generator for
    (seed, number).
    """
    law = {"kind": "uniform", "above": 0.0, "below": 1.0}
    one = EnsembleSection(keys={"a": law})
    two = EnsembleSection(keys={"b": law, "a": law})
    assert (
        one.settings(3, 5)["a"]
        == two.settings(3, 5)["a"]
        == json.dumps(float(generator(3, 5, "a").random()))
    )
    assert (
        len(
            {
                two.settings(seed, number)[key]
                for seed in (0, 1)
                for number in (0, 1)
                for key in "ab"
            }
        )
        == 8
    )


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"kind": "normal", "mean": 1.0}, "kind: normal needs deviation"),
        ({"kind": "normal", "mean": 1.0, "deviation": 0.0}, "greater than 0"),
        ({"kind": "lognormal", "mean": -1.0, "deviation": 1.0}, "its mean must be too"),
        ({"kind": "uniform", "above": 1.0, "below": 1.0}, "above must be less than below"),
        (
            {"kind": "uniform", "mean": 1.0, "above": 0.0, "below": 1.0},
            "mean does not belong to kind: uniform",
        ),
        (
            {"kind": "normal", "mean": 0.0, "deviation": 1.0, "above": 9.0},
            "almost no number lies between",
        ),
        ({"kind": "choice", "values": [1, 2], "weights": [1.0]}, "one for each of the values"),
        ({"kind": "choice", "values": []}, "at least 1 item"),
        ({"kind": "cauchy"}, "'normal', 'lognormal', 'uniform' or 'choice'"),
    ],
)
def test_wrong_parameters(section: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        DistributionSection(**section)


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ("{}", "needs keys or defects"),
        (
            "{keys: {mesh.degree: {kind: normal, mean: 3}}}",
            "ensemble.keys.mesh.degree: kind: normal needs deviation",
        ),
        (
            "{defects: {count: 30, amplitude: 1, width: 1, polar: [0, 60], distance: 30}}",
            "do not fit between",
        ),
        (
            "{defects: {count: 2.5, amplitude: 1, width: 1, polar: [0, 60]}}",
            "count: must be whole numbers",
        ),
        (
            "{defects: {count: 2, amplitude: 1, width: 1, polar: [60, 60]}}",
            "the first angle must be less",
        ),
    ],
)
def test_wrong_sections_are_refused_at_the_door(section: str, message: str) -> None:
    with pytest.raises(CaseError, match=message):
        Case.load(CASES / "dimple_buckling.yaml", [f"ensemble={section}"])

"""The Weibull fit against SciPy's and against known samples; intervals; numbers of the summary."""

import numpy as np
import pytest
from scipy import stats

from magshell_fenicsx.studies.ensemble.statistics import (
    correlations,
    counts,
    distance,
    fit,
    intervals,
)

SHAPE, LOCATION, SCALE = 4.0, 0.3, 0.4


def sample(count: int, seed: int = 1, shape: float = SHAPE) -> np.ndarray:
    return np.asarray(stats.weibull_min.rvs(shape, LOCATION, SCALE, size=count, random_state=seed))


@pytest.mark.parametrize(("shape", "count"), [(4.0, 200), (1.5, 200), (3.0, 30), (12.0, 500)])
def test_fit_is_the_most_likely_one_of_scipy(shape: float, count: int) -> None:
    """SciPy's simplex search, which begins at the true parameters, finds nothing more likely."""
    x = sample(count, shape=shape)
    found = fit(x)
    assert found
    assert not found.bounded
    theirs = stats.weibull_min.fit(x, shape, loc=LOCATION, scale=SCALE)
    likely = [
        float(np.sum(stats.weibull_min.logpdf(x, *p)))
        for p in ((found.shape, found.location, found.scale), theirs)
    ]
    assert likely[0] >= likely[1] - 1e-6
    assert (found.shape, found.scale) == pytest.approx((theirs[0], theirs[2]), rel=1e-2)


def test_many_samples_give_the_parameters() -> None:
    found = fit(sample(20_000))
    assert found
    assert (found.shape, found.location, found.scale) == pytest.approx(
        (SHAPE, LOCATION, SCALE), rel=0.05
    )
    assert found.quantile(0.01) == pytest.approx(
        stats.weibull_min.ppf(0.01, SHAPE, LOCATION, SCALE), rel=5e-3
    )


def test_fit_scales_and_shifts_with_the_sample() -> None:
    x = sample(100)
    one, two = fit(x), fit(7 - 3 + 1e-3 * x)
    assert one
    assert two
    assert two.shape == pytest.approx(one.shape, rel=1e-4)
    assert two.location == pytest.approx(4 + 1e-3 * one.location, abs=1e-7)


def test_samples_that_determine_no_fit() -> None:
    assert fit([]) is None
    assert fit([0.4] * 100) is None
    assert fit(np.linspace(0, 1, 7)) is None
    steep = fit(sample(200, shape=0.6))  # no maximum of the likelihood: a shape below one
    assert steep
    assert steep.bounded


def test_intervals_hold_the_true_numbers() -> None:
    """Of 95 % intervals of 8 samples, at most 3 miss by chance (probability 4e-4 of more)."""
    names = ("mean", "shape", "location")
    true = {
        "mean": stats.weibull_min.mean(SHAPE, LOCATION, SCALE),
        "shape": SHAPE,
        "location": LOCATION,
    }
    missed = dict.fromkeys(names, 0)
    for seed in range(8):
        found = intervals(sample(60, seed), seed, 40)
        for name in names:
            low, high = found[name]
            missed[name] += not low <= true[name] <= high
    assert max(missed.values()) <= 3
    assert (
        intervals(sample(60), 1, 20) == intervals(sample(60), 1, 20) != intervals(sample(60), 2, 20)
    )


def test_distance_and_correlations_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=50)
    y = -x + 0.5 * rng.normal(size=50)
    rows = [
        {
            "sample": i,
            "status": "found",
            "result": float(b),
            "severest.amplitude": float(a),
            "key": 1.0,
        }
        for i, (a, b) in enumerate(zip(x, y, strict=True))
    ]
    rows.append(
        {"sample": 50, "status": "stopped", "result": None, "severest.amplitude": 9.0, "key": 1.0}
    )
    assert counts(rows) == {"samples": 51, "found": 50, "stopped": 1}
    (found,) = correlations(rows).values()  # none of a key that does not vary
    assert found["pearson"] == pytest.approx(stats.pearsonr(x, y)[0])
    assert found["spearman"] == pytest.approx(stats.spearmanr(x, y)[0])
    law = fit(y)
    assert law
    assert distance(y, law) == pytest.approx(stats.ks_1samp(y, law.probability_below).statistic)

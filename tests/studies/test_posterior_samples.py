"""Bands of few runs with drawn parameters, of a field of many numbers, against many samples of its
posterior.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from magshell_fenicsx.studies.identify.laplace import Measured, Posterior, fit_posterior
from magshell_fenicsx.studies.identify.posterior_samples import band_of, posterior_samples
from magshell_fenicsx.studies.identify.smoothness_prior import Smooth

Array = NDArray[np.float64]
X = np.linspace(0.0, 1.0, 25)
NOISE = 0.01


def posterior() -> Posterior:
    """Of a vector with two components along a line, of which eight moments were measured."""
    J = np.array(
        [
            np.kron((end > X) * (end - X), [1.0, a]) / X.size
            for end in (0.2, 0.5, 0.8, 1.0)
            for a in (0.3, -1)
        ]
    )
    data = J @ np.kron(np.cos(2 * X), [1.0, 0.5]) + NOISE * np.random.default_rng(2).normal(
        size=len(J)
    )
    smooth = Smooth(0, np.abs(X[:, None] - X), 2, 1.0, 0.3)
    start, free = np.zeros(J.shape[1]), np.full(J.shape[1], np.inf)
    measured = Measured(data, np.zeros(len(J), dtype=int), np.array([NOISE]), start, free, smooth)
    return fit_posterior(
        lambda x: (J @ x, J), measured, start, np.ones(J.shape[1]), 20, lambda *_: None
    )


@pytest.mark.parametrize(("count", "error"), [(20, 0.13), (40, 0.1)])
def test_bands_of_a_field(count: int, error: float) -> None:
    """Of 100 smooth results of the field: widths right to 13 % of 20 runs, to 10 % of 40, as root
    mean squares.

    Independent runs miss by 18 and 13 % (20 and 40, mean over 30 seeds).
    """
    fit, rng = posterior(), np.random.default_rng(4)
    waves = np.cos(np.pi * np.outer(np.arange(4), X))
    results = np.einsum("kci,ij->kjc", rng.normal(size=(100, 2, 4)), waves).reshape(100, -1)
    samples = results @ rng.multivariate_normal(fit.x, fit.covariance, 4000, method="eigh").T
    runs = results @ posterior_samples(fit, count).T
    ratios = []
    for of_samples, of_runs in zip(samples, runs, strict=True):
        (low, high), band = np.quantile(of_samples, [0.025, 0.975]), band_of(of_runs, count)
        assert band
        ratios.append((band[1] - band[0]) / (high - low))
    assert np.sqrt(np.mean((np.array(ratios) - 1) ** 2)) < error
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.06)

"""Parameters drawn from a posterior, and the band of what is computed with each of them.

The axes of a posterior are the principal axes of its ellipsoid, in parameters over their standard
deviations. Knows no shell.
"""

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.studies.identify.laplace import BAND_PROBABILITY, Posterior

Array = NDArray[np.float64]
ENOUGH = 0.9  # of the samples: a place that fewer reach has no band
NORMAL = float(scipy.stats.norm.ppf((1 + BAND_PROBABILITY) / 2))


def posterior_samples(posterior: Posterior, count: int) -> Array:
    """Return parameters (count, p) drawn from the posterior, by a Latin hypercube along its axes.

    They scatter as widely as the 95 % bands, whose half widths are quantiles of Student's t.
    """
    size = posterior.deviation
    spread, axes = np.linalg.eigh(posterior.correlation)
    spread = np.maximum(spread, 0.0)
    rng = np.random.default_rng(0)  # the same samples in each run
    # Latin hypercube: along each axis there is one sample in each of `count` equal quantiles
    stratified = [(rng.permutation(count) + 0.5) / count for _ in size]
    # (count, p) independent normal numbers, without correlations by chance
    normal = _decorrelated(
        scipy.stats.norm.ppf(np.transpose(stratified)), longest=np.argsort(-spread)
    )
    # half widths of Student's t over those of a normal distribution, along each axis; a parameter
    # without deviation does not vary
    inverse_size = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
    width_ratio = posterior.quantiles(axes.T * inverse_size) / NORMAL
    # from the axes to the parameters
    return np.asarray(posterior.x + size * ((normal * np.sqrt(spread) * width_ratio) @ axes.T))


def _decorrelated(normal: Array, longest: NDArray[np.int64]) -> Array:
    """Return normal numbers (count, p) without correlations among the longest axes.

    Correlations that samples have by chance are removed. Only as many axes as half the number of
    samples can be treated.

    Parameters
    ----------
    normal
        Samples along each axis, with independent normal distributions.
    longest
        (p,) axes, the longest first.
    """
    axes = longest[: len(normal) // 2]
    deviation = normal[:, axes].std(axis=0)
    # `reshape`: of a single axis NumPy returns a number
    correlation = np.corrcoef(normal[:, axes], rowvar=False).reshape(len(axes), len(axes))
    eigenvalues, eigenvectors = np.linalg.eigh(correlation)
    # numbers over their deviations are multiplied by the inverse root of their correlation matrix
    # V diag(w) V^T, which is V diag(w)^(-1/2) V^T; then they get their deviations again
    uncorrelated = np.array(normal)
    uncorrelated[:, axes] = (
        normal[:, axes]
        / deviation
        @ (eigenvectors / np.sqrt(eigenvalues))
        @ eigenvectors.T
        * deviation
    )
    return uncorrelated


def band_of(values: Array, samples: int) -> tuple[float, float] | None:
    """Return the ends of the range in which 95 % of the runs' values lie.

    None if too few of the runs have a value.

    Parameters
    ----------
    values
        Values of the runs; nan where a run has none.
    samples
        Number of drawn runs.
    """
    values = values[np.isfinite(values)]
    if values.size < ENOUGH * samples:
        return None
    low, high = np.quantile(
        values, [(1 - BAND_PROBABILITY) / 2, (1 + BAND_PROBABILITY) / 2], method="hazen"
    )
    return float(low), float(high)

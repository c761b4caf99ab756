"""The posterior of Gauss-Newton and Laplace: coverage of its bands, against Metropolis, and what it
refuses.
"""

import numpy as np
import pytest
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.studies.identify.laplace import (
    NORMAL,
    Measured,
    NoNoise,
    NotSeen,
    Posterior,
    fit_posterior,
    nonlinearity,
)
from magshell_fenicsx.studies.identify.smoothness_prior import Smooth

Array = NDArray[np.float64]
T = np.linspace(0.2, 3.0, 12)
TRUTH, NOISE = np.array([2.0, 0.8]), 0.02


def relaxing(x: Array) -> tuple[Array, Array] | None:
    """y = a (1 - exp(-b t)), as a spring that yields."""
    a, b = x
    if b <= 0:
        return None
    grown = 1 - np.exp(-b * T)
    return a * grown, np.stack([grown, a * T * np.exp(-b * T)], axis=1)


def measured(seed: int, noise: float = NOISE, deviation: float = np.inf) -> Measured:
    y = relaxing(TRUTH)
    assert y
    data = y[0] + NOISE * np.random.default_rng(seed).normal(size=len(T))
    return Measured(
        data, np.zeros(len(T), dtype=np.int64), np.array([noise]), TRUTH, np.full(2, deviation)
    )


def fit(known: Measured, start: tuple[float, float] = (1.0, 1.0)) -> Posterior:
    return fit_posterior(relaxing, known, np.array(start), np.ones(2), 30, lambda *_: None)


@pytest.mark.parametrize("noise", [NOISE, np.nan])
def test_bands_cover_what_they_say(noise: float) -> None:
    """500 repeats, noise given and estimated: 95 % within two deviations of that share, 2 %; no
    bias.
    """
    fits = [fit(measured(seed, noise), (2.0, 0.8)) for seed in range(500)]
    inside = np.mean([(f.band[0] < TRUTH) & (f.band[1] > TRUTH) for f in fits], axis=0)
    assert inside == pytest.approx(0.95, abs=0.02)
    spread = np.std([f.x for f in fits], axis=0)
    assert np.mean([f.x for f in fits], axis=0) == pytest.approx(
        TRUTH, abs=3 * spread.max() / np.sqrt(500)
    )
    assert np.mean([f.deviation**2 for f in fits], axis=0) ** 0.5 == pytest.approx(spread, rel=0.1)


def sampled(known: Measured, begin: Array, step: Array, count: int) -> Array:
    """Samples of the posterior by Metropolis' algorithm (J.

    Chem. Phys. 21, 1953), of 200 walkers at once.
    """
    rng, x, found = np.random.default_rng(5), np.tile(begin, (200, 1)), []

    def misfit(x: Array) -> Array:
        a, b = x.T[..., None]
        rest = (known.data - a * (1 - np.exp(-b * T))) / NOISE
        far = (x - TRUTH) / known.deviation
        return np.where(x[:, 1] > 0, (rest**2).sum(axis=1) + (far**2).sum(axis=1), np.inf)

    now = misfit(x)
    for _ in range(count):
        tried = x + rng.normal(size=x.shape) @ step.T
        then = misfit(tried)
        taken = np.log(rng.random(len(x))) < (now - then) / 2
        x, now = np.where(taken[:, None], tried, x), np.where(taken, then, now)
        found.append(x)
    return np.array(found)


@pytest.mark.parametrize("deviation", [np.inf, 0.02])
def test_against_metropolis(deviation: float) -> None:
    """Means and standard deviations within 5 % of a deviation, with and without a prior."""
    known = measured(3, deviation=deviation)
    own = fit(known)
    samples = sampled(known, own.x, 1.7 * np.linalg.cholesky(own.covariance), 600)[100:]
    samples = samples.reshape(-1, 2)
    assert samples.mean(axis=0) == pytest.approx(own.x, abs=0.05 * own.deviation.min())
    assert samples.std(axis=0) == pytest.approx(own.deviation, rel=0.05)
    assert np.corrcoef(samples.T)[0, 1] == pytest.approx(own.correlation[0, 1], abs=0.05)


def test_a_posterior_that_is_not_normal() -> None:
    """Two deviations of a spring known to 1 % lie on a parabola. Those known to 20 % do not."""
    sure = measured(3)
    assert nonlinearity(relaxing, fit(sure))[0] < NORMAL
    y = sure.data + 14 * (sure.data - relaxing(TRUTH)[0])  # type: ignore[index]
    vague = Measured(y, sure.group, 15 * sure.noise, sure.mean, sure.deviation)
    assert nonlinearity(relaxing, fit(vague))[0] > NORMAL


def test_one_more_measurement() -> None:
    """As the fit with this measurement among the data."""
    known = measured(4)
    own = fit(known)
    k = len(T) - 1
    again = Measured(
        np.append(known.data, own.y[k]),
        np.zeros(len(T) + 1, dtype=np.int64),
        known.noise,
        known.mean,
        known.deviation,
    )

    def twice(x: Array) -> tuple[Array, Array] | None:
        there = relaxing(x)
        return there and (np.append(there[0], there[0][k]), np.vstack([there[1], there[1][k]]))

    then = fit_posterior(twice, again, own.x, np.ones(2), 30, lambda *_: None)
    assert own.narrowed(own.slopes[k], NOISE) == pytest.approx(then.deviation, rel=1e-3)


def test_what_data_do_not_see_is_named() -> None:
    """Two numbers that enter by their product alone."""

    def product(x: Array) -> tuple[Array, Array]:
        return x[0] * x[1] * T, np.outer(T, x[::-1])

    known = Measured(
        2 * T, np.zeros(len(T), dtype=np.int64), np.array([0.1]), np.ones(2), np.full(2, np.inf)
    )
    with pytest.raises(NotSeen) as refused:
        fit_posterior(product, known, np.array([1.0, 1.5]), np.ones(2), 5, lambda *_: None)
    assert refused.value.numbers == [0, 1]
    one = Measured(known.data, known.group, known.noise, np.ones(2), np.array([0.1, np.inf]))
    assert fit_posterior(
        product, one, np.array([1.0, 1.5]), np.ones(2), 30, lambda *_: None
    ).x == pytest.approx([1.0, 2.0], rel=1e-6)


def mean_of(data: Array, deviation: float, noise: float = np.nan) -> Posterior:
    """A number that is measured itself, with the prior 0 +- deviation."""
    known = Measured(
        data,
        np.zeros(len(data), dtype=np.int64),
        np.array([noise]),
        np.zeros(1),
        np.array([float(deviation)]),
    )
    slopes = np.ones((len(data), 1))
    return fit_posterior(
        lambda x: (x[0] + 0 * data, slopes), known, np.zeros(1), np.ones(1), 50, lambda *_: None
    )


@pytest.mark.parametrize("deviation", [0.1, 0.3, 1.0])
def test_few_data_beside_a_prior(deviation: float) -> None:
    """300 numbers from the prior, each measured three times with unknown noise: 90 to 97 % lie in
    their bands.

    Student's t alone, of about two degrees of freedom, makes bands that are wider than the prior's
    own.
    """
    rng, inside, widest = np.random.default_rng(1), [], 0.0
    for _ in range(300):
        truth = deviation * rng.normal()
        low, high = mean_of(truth + rng.normal(size=3), deviation).band
        inside.append(low[0] < truth < high[0])
        widest = max(widest, high[0] - low[0])
    assert 0.9 < np.mean(inside) < 0.97
    assert widest < 1.1 * 2 * 1.96 * deviation


def test_data_that_do_not_say_their_noise() -> None:
    """One number measured once: the noise would follow the fit to zero, and the band with it."""
    with pytest.raises(NoNoise):
        mean_of(np.array([1.0]), 10.0)
    assert mean_of(np.array([1.0]), 10.0, 0.5).deviation == pytest.approx(
        [1 / np.hypot(1 / 10, 1 / 0.5)]
    )


def test_bands_that_are_wide_as_data_are_few() -> None:
    """E of a spring y = 1/E from two data: linear two deviations away, and not at the ends of its
    band.
    """
    data = np.array([0.95, 1.05])

    def spring(x: Array) -> tuple[Array, Array] | None:
        return None if x[0] <= 0 else (np.full(2, 1 / x[0]), np.full((2, 1), -1 / x[0] ** 2))

    known = Measured(
        data, np.zeros(2, dtype=np.int64), np.array([np.nan]), np.ones(1), np.array([np.inf])
    )
    own = fit_posterior(spring, known, np.ones(1), np.ones(1), 20, lambda *_: None)
    assert own.band[0] < 0.5
    assert nonlinearity(spring, own)[0] > NORMAL


class Blurred:
    """Forty means of a field of 25 numbers on a line, with noise: all is normal, its posterior has
    a closed form.
    """

    S, LENGTH = 0.7, 0.25
    X = np.linspace(0, 1, 25)
    J = np.exp(-((np.linspace(0, 1, 40)[:, None] - X) ** 2) / 0.02) / 5

    @property
    def K(self) -> Array:
        r = np.sqrt(3) * np.abs(self.X[:, None] - self.X) / self.LENGTH
        return self.S**2 * ((1 + r) * np.exp(-r) + 1e-8 * np.eye(25))

    def fit(
        self, truth: Array, seed: int, deviation: float, length: float, noise: float
    ) -> Posterior:
        data = self.J @ truth + NOISE * np.random.default_rng(seed).normal(size=40)
        smooth = Smooth(0, np.abs(self.X[:, None] - self.X), 1, deviation, length)
        group = np.zeros(40, dtype=np.int64)
        known = Measured(data, group, np.array([noise]), np.zeros(25), np.full(25, np.inf), smooth)
        return fit_posterior(
            lambda x: (self.J @ x, self.J), known, np.zeros(25), np.ones(25), 20, lambda *_: None
        )


def test_a_smooth_field_of_given_strength() -> None:
    """Mean and covariance of a normal field given its data (Rasmussen and Williams 2006, eq. 2.25
    and 2.26).
    """
    own, rng = Blurred(), np.random.default_rng(2)
    truth = np.linalg.cholesky(own.K) @ rng.normal(size=25)
    fit = own.fit(truth, 3, own.S, own.LENGTH, NOISE)
    gain = own.K @ own.J.T @ np.linalg.inv(own.J @ own.K @ own.J.T + NOISE**2 * np.eye(40))
    assert fit.x == pytest.approx(gain @ fit.measured.data, abs=1e-5)
    assert fit.covariance == pytest.approx(own.K - gain @ own.J @ own.K, abs=1e-5)


@pytest.mark.slow
def test_the_strength_that_makes_data_most_likely() -> None:
    """No strength or noise nearby has a higher density of the data, which is normal (SciPy); of 40
    fields bands cover what they say, and misfit and noise are those that were put in.
    """
    own, rng = Blurred(), np.random.default_rng(5)
    inside, misfits, noises = list[float](), list[float](), list[float]()
    for seed in range(40):
        truth = np.linalg.cholesky(own.K) @ rng.normal(size=25)
        fit = own.fit(truth, seed, np.nan, np.nan, np.nan)
        prior = fit.measured.field
        assert prior

        def density(
            s: float, length: float, noise: float, data: Array = fit.measured.data
        ) -> float:
            other = Blurred()
            other.S, other.LENGTH = s, length  # type: ignore[misc]
            covariance = own.J @ other.K @ own.J.T + noise**2 * np.eye(40)
            return float(scipy.stats.multivariate_normal.logpdf(data, np.zeros(40), covariance))

        best = np.array([prior.deviation, prior.length, fit.noise[0]])
        if seed < 5 and not prior.at_bounds():
            around = [best * (1 + 0.05 * sign * axis) for axis in np.eye(3) for sign in (-1, 1)]
            assert density(*best) > max(density(*each) for each in around)
        inside.append(float(np.mean((fit.band[0] < truth) & (truth < fit.band[1]))))
        misfits.append(float(np.mean((fit.measured.data - fit.y) ** 2) / NOISE**2))
        noises.append(float(fit.noise[0]))
    assert 0.9 < np.mean(inside) < 0.98
    assert np.mean(noises) == pytest.approx(NOISE, rel=0.05)
    assert 0.6 < np.mean(misfits) < 1  # of 40 data, less what the field takes of them

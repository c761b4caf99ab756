"""The three-parameter Weibull distribution: fit by maximum likelihood, and bootstrap intervals.

P(x) = 1 - exp(-((x - location)/scale)^shape) for x > location. At a given location the shape is the root of one
equation and the scale follows from it, so that the likelihood is maximised over the location alone (profile
likelihood). It has no maximum where the shape is below one: such shapes are left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import weibull_min

Array = NDArray[np.float64]

LEAST = 8  # different values for three parameters
SPANS = 1e-3, 1e2  # distances of the location below the least value, in standard deviations
GRID, ROUNDS = 9, 9  # locations that are tried at once, and how often the grid is refined around the best
SHAPES = 1.0, 1e3
STEPS = 5  # of Newton's method, which begins close
LEVEL = 0.95


@dataclass(frozen=True)
class Weibull:
    """A fitted distribution.

    Attributes
    ----------
    bounded
        Whether the best location is one of the bounds of the search, so that the sample does not determine it.
    """

    shape: float
    location: float
    scale: float
    bounded: bool

    def below(self, x: Array) -> Array:
        """The probability of a smaller value."""
        return np.asarray(weibull_min.cdf(x, self.shape, self.location, self.scale))

    def density(self, x: Array) -> Array:
        return np.asarray(weibull_min.pdf(x, self.shape, self.location, self.scale))

    def quantile(self, part: float) -> float:
        """The value that is larger with the probability 1 - part."""
        return float(weibull_min.ppf(part, self.shape, self.location, self.scale))


def fit(values: Sequence[float] | Array) -> Weibull | None:
    """The most likely distribution; None with fewer than `LEAST` different values.

    Parameters
    ----------
    values
        The sample (n,).
    """
    x = np.sort(np.asarray(values, dtype=float))
    if len(np.unique(x)) < LEAST:
        return None
    spread = float(x.std())
    low, high = np.log(SPANS)
    ends, best = (low, high), 0.0
    for _ in range(ROUNDS):
        tried = np.linspace(low, high, GRID)
        best = float(tried[np.argmax(_likelihoods(x, x[0] - spread * np.exp(tried)))])
        step = tried[1] - tried[0]
        low, high = max(best - step, ends[0]), min(best + step, ends[1])
    location = x[0] - spread * float(np.exp(best))
    shape, scale = (float(v[0]) for v in _at(x, np.array([location])))
    return Weibull(shape, float(location), scale, best in ends or shape <= SHAPES[0])


def _likelihoods(x: Array, locations: Array) -> Array:
    """Mean logarithm of the density, at the best shape and scale of each location."""
    shapes, scales = _at(x, locations)
    logs = np.log((x - locations[:, None]) / scales[:, None])
    powers = np.exp(shapes[:, None] * logs)
    return np.asarray(np.log(shapes / scales) + np.mean((shapes[:, None] - 1) * logs - powers, axis=1))


def _at(x: Array, locations: Array) -> tuple[Array, Array]:
    """The best shape (m,) and scale (m,) for locations (m,).

    The shape k solves 1/k = sum(y^k log y)/sum(y^k) - mean(log y) with y = x - location, by Newton's method for log k.
    """
    y = np.log(x - locations[:, None])
    y, middle = y - y.mean(axis=1, keepdims=True), y.mean(axis=1)  # mean(log y) = 0 then
    k = 1.2 / np.maximum(y.std(axis=1), 1e-12)
    for _ in range(STEPS):
        top = np.max(k[:, None] * y, axis=1, keepdims=True)
        w = np.exp(k[:, None] * y - top)
        s0, s1, s2 = w.sum(axis=1), (w * y).sum(axis=1), (w * y**2).sum(axis=1)
        value, slope = s1 / s0 - 1 / k, s2 / s0 - (s1 / s0) ** 2 + 1 / k**2
        k = k * np.exp(np.clip(-value / (slope * k), -1.0, 1.0))
    k = np.clip(k, *SHAPES)
    top = np.max(k[:, None] * y, axis=1, keepdims=True)
    mean = np.log(np.mean(np.exp(k[:, None] * y - top), axis=1)) + top[:, 0]
    return np.asarray(k), np.asarray(np.exp(middle + mean / k))


def intervals(values: Sequence[float] | Array, seed: int, count: int = 400) -> dict[str, tuple[float, float]]:
    """Percentile intervals of the parameters, of the mean and of the 1 % quantile, from resampled values.

    Parameters
    ----------
    seed, count
        Of the resampling, and its number.
    """
    x, rng = np.asarray(values, dtype=float), np.random.default_rng(seed)
    found: dict[str, list[float]] = {}
    for _ in range(count):
        again = rng.choice(x, len(x))
        numbers = {"mean": float(again.mean()), "deviation": float(again.std(ddof=1))}
        if one := fit(again):
            numbers |= {"shape": one.shape, "location": one.location, "scale": one.scale}
            numbers["quantile_1_percent"] = one.quantile(0.01)
        for name, value in numbers.items():
            found.setdefault(name, []).append(value)
    ends = (0.5 - LEVEL / 2, 0.5 + LEVEL / 2)
    return {name: tuple(map(float, np.quantile(many, ends))) for name, many in found.items()}  # type: ignore[misc]

"""The distribution of a random number."""

from math import inf, log, nextafter, sqrt
from statistics import NormalDist
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from magshell_fenicsx.input.section import Section

NEEDED = {
    "normal": ("mean", "deviation"),
    "lognormal": ("mean", "deviation"),
    "uniform": ("above", "below"),
    "choice": ("values",),
}
OPTIONAL = {"normal": ("above", "below"), "lognormal": ("above", "below"), "choice": ("weights",)}
LEAST_PART = 1e-9  # probability between the bounds of a truncated distribution

Value = float | int | str


class DistributionSection(Section):
    """A random number, or a word chosen at random.

    normal and lognormal: mean and deviation are those of the number itself, before bounds cut the distribution off.
    uniform: between above and below. choice: one of values. In place of the section a number is that number always.
    """

    kind: Literal["normal", "lognormal", "uniform", "choice"]
    """Its law"""
    mean: float | None = None
    """Mean; of a lognormal number positive"""
    deviation: float | None = Field(default=None, gt=0)
    """Standard deviation"""
    above: float | None = None
    """Least value"""
    below: float | None = None
    """Largest value"""
    values: Annotated[list[float | int | str], Field(min_length=1)] | None = None
    """What is chosen from"""
    weights: list[Annotated[float, Field(ge=0)]] | None = None
    """Of each of the values; by default all are equally probable"""
    unit: str | None = Field(default=None, examples=["mm"])
    """Unit of the numbers, of a key with units"""

    @model_validator(mode="after")
    def _keys_belong_to_the_kind(self) -> Self:
        needed, given = NEEDED[self.kind], self.model_fields_set - {"kind", "unit"}
        if missing := [key for key in needed if key not in given]:
            raise ValueError(f"kind: {self.kind} needs {' and '.join(missing)}")
        if strange := sorted(given - {*needed, *OPTIONAL.get(self.kind, ())}):
            raise ValueError(f"{strange[0]} does not belong to kind: {self.kind}")
        low, high = self._bounds
        if low >= high:
            raise ValueError(f"above must be less than below, here {low:g} and {high:g}")
        if self.kind == "lognormal" and not self._mean > 0:
            raise ValueError(f"a lognormal number is positive: its mean must be too, here {self._mean:g}")
        if self.kind in ("normal", "lognormal") and np.diff(self._probabilities)[0] < LEAST_PART:
            raise ValueError(
                f"almost no number lies between above and below, here {low:g} and {high:g}: choose bounds closer to "
                f"the mean, {self._mean:g}"
            )
        if self.weights is not None and (len(self.weights) != len(self.values or []) or not sum(self.weights)):
            raise ValueError("weights: one for each of the values, not all zero")
        return self

    def draw(self, rng: np.random.Generator) -> Value:
        """A value; takes one number of the generator, whatever the kind."""
        return self.at(float(rng.random()))

    def at(self, part: float) -> Value:
        """The quantile of a probability: the inverse of the distribution function."""
        if self.kind == "choice":
            assert self.values
            weights = np.array(self.weights or [1.0] * len(self.values))
            steps = np.cumsum(weights) / weights.sum()
            return self._with_unit(self.values[int(np.searchsorted(steps, part, side="right"))])
        low, high = self._bounds
        if self.kind == "uniform":
            return self._with_unit(low + part * (high - low))
        first, last = self._probabilities
        centre, width = self._normal
        inner = min(max(first + part * (last - first), nextafter(0, 1)), nextafter(1, 0))
        x = NormalDist(centre, width).inv_cdf(inner)
        return self._with_unit(float(np.clip(np.exp(x) if self.kind == "lognormal" else x, low, high)))

    @property
    def _mean(self) -> float:
        assert self.mean is not None
        return self.mean

    @property
    def _bounds(self) -> tuple[float, float]:
        return -inf if self.above is None else self.above, inf if self.below is None else self.below

    @property
    def _normal(self) -> tuple[float, float]:
        """Mean and deviation of the number, or of the logarithm of a lognormal one."""
        assert self.deviation is not None
        if self.kind == "normal":
            return self._mean, self.deviation
        spread = log(1 + (self.deviation / self._mean) ** 2)
        return log(self._mean) - spread / 2, sqrt(spread)

    @property
    def _probabilities(self) -> tuple[float, float]:
        """The probabilities of smaller numbers than above and below."""
        centre, width = self._normal
        ends = np.array(self._bounds)
        with np.errstate(divide="ignore"):
            ends = np.log(np.maximum(ends, 0.0)) if self.kind == "lognormal" else ends
        first, last = (NormalDist(centre, width).cdf(end) for end in ends)
        return first, last

    def _with_unit(self, value: Value) -> Value:
        return value if self.unit is None else f"{value!r} {self.unit}"


def _certain(value: Any) -> Any:
    """A number, as the choice of one."""
    if isinstance(value, float | int) and not isinstance(value, bool):
        return {"kind": "choice", "values": [value]}
    return value


Distribution = Annotated[
    DistributionSection, BeforeValidator(_certain, json_schema_input_type=float | DistributionSection)
]

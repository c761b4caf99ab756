"""Random numbers of a case file: distributions, random places, and imperfections there.

A distribution is a section of the case, with a law (its kind) and perhaps bounds, which cut it off.
The numbers of a lognormal law have logarithms with a normal one. A study runs a case as many
samples with different random numbers; each sample and key has a generator of its own, so that one
does not change another. The polar angle is from the axis of the sphere.
"""

import zlib
from math import cos, degrees, inf, log, nextafter, pi, radians, sqrt
from statistics import NormalDist
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from magshell_fenicsx.input.section import Section

Array = NDArray[np.float64]

REQUIRED_KEYS = {
    "normal": ("mean", "deviation"),
    "lognormal": ("mean", "deviation"),
    "uniform": ("above", "below"),
    "choice": ("values",),
}
OPTIONAL_KEYS = {
    "normal": ("above", "below"),
    "lognormal": ("above", "below"),
    "choice": ("weights",),
}
MIN_PROBABILITY = 1e-9  # between the bounds of a truncated distribution

Value = float | int | str


class DistributionSection(Section):
    """A random number, or a word chosen at random.

    normal and lognormal: mean and deviation are those of the number itself, before bounds cut the
    distribution off. uniform: between above and below. choice: one of values. In place of the
    section a number is that number always.
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
        """Check that the keys are those of the law, and that their numbers go together."""
        required, given_keys = REQUIRED_KEYS[self.kind], self.model_fields_set - {"kind", "unit"}
        if missing_keys := [key for key in required if key not in given_keys]:
            raise ValueError(f"kind: {self.kind} needs {' and '.join(missing_keys)}")
        allowed = {*required, *OPTIONAL_KEYS.get(self.kind, ())}
        if unexpected := sorted(given_keys - allowed):
            raise ValueError(f"{unexpected[0]} does not belong to kind: {self.kind}")
        # the bounds, the mean of a positive number, and what lies between the bounds
        low, high = self._bounds
        if low >= high:
            raise ValueError(f"above must be less than below, here {low:g} and {high:g}")
        if self.kind == "lognormal" and not self._mean > 0:
            raise ValueError(
                f"a lognormal number is positive: its mean must be too, here {self._mean:g}"
            )
        # bounds far from the mean: the inverse of the distribution function would be rounding
        has_mean = self.kind in ("normal", "lognormal")
        if has_mean and np.diff(self._probabilities)[0] < MIN_PROBABILITY:
            raise ValueError(
                f"almost no number lies between above and below, here {low:g} and {high:g}: choose "
                f"bounds closer to the mean, {self._mean:g}"
            )
        weights, values = self.weights, self.values or []
        if weights is None:
            return self
        if len(weights) != len(values) or not sum(weights):
            raise ValueError("weights: one for each of the values, not all zero")
        return self

    def draw(self, rng: np.random.Generator) -> Value:
        """Draw a value; this takes one number of the generator, whatever the kind."""
        return self.quantile(float(rng.random()))

    def quantile(self, probability: float) -> Value:
        """Return the quantile of a probability (0 to 1): the inverse of the distribution function.

        The result is a word, a number, or a number with a unit as text.
        """
        # choice: the value at whose step the distribution function passes the probability
        if self.kind == "choice":
            assert self.values
            weights = np.array(self.weights or [1.0] * len(self.values))
            cumulated = np.cumsum(weights) / weights.sum()
            index = int(np.searchsorted(cumulated, probability, side="right"))
            return self._with_unit(self.values[index])
        # uniform
        low, high = self._bounds
        if self.kind == "uniform":
            return self._with_unit(low + probability * (high - low))
        # normal or lognormal: the probability of the same number without bounds lies between those
        # of both bounds
        below_low, below_high = self._probabilities
        without_bounds = below_low + probability * (below_high - below_low)
        # not 0 or 1, whose quantiles are infinite
        without_bounds = min(max(without_bounds, nextafter(0, 1)), nextafter(1, 0))
        # of the number or, if it is lognormal, of its logarithm
        centre, width = self._normal
        x = NormalDist(centre, width).inv_cdf(without_bounds)
        value = np.exp(x) if self.kind == "lognormal" else x
        return self._with_unit(float(np.clip(value, low, high)))

    @property
    def _mean(self) -> float:
        assert self.mean is not None
        return self.mean

    @property
    def _bounds(self) -> tuple[float, float]:
        """Least and largest number; infinite without a bound."""
        low = -inf if self.above is None else self.above
        return low, inf if self.below is None else self.below

    @property
    def _normal(self) -> tuple[float, float]:
        """Mean and standard deviation of the number, or of the logarithm of a lognormal number."""
        assert self.deviation is not None
        if self.kind == "normal":
            return self._mean, self.deviation
        variance_of_log = log(1 + (self.deviation / self._mean) ** 2)
        return log(self._mean) - variance_of_log / 2, sqrt(variance_of_log)

    @property
    def _probabilities(self) -> tuple[float, float]:
        """Probabilities of numbers below each bound, of the distribution without bounds."""
        centre, width = self._normal
        bounds = np.array(self._bounds)
        with np.errstate(divide="ignore"):
            bounds = np.log(np.maximum(bounds, 0.0)) if self.kind == "lognormal" else bounds
        below_low, below_high = (NormalDist(centre, width).cdf(bound) for bound in bounds)
        return below_low, below_high

    def _with_unit(self, value: Value) -> Value:
        """Return a value, as text with the unit if there is one."""
        return value if self.unit is None else f"{value!r} {self.unit}"


def _number_as_choice(value: Any) -> Any:
    """Return a number as a choice of one value, and anything else unchanged."""
    if isinstance(value, float | int) and not isinstance(value, bool):
        return {"kind": "choice", "values": [value]}
    return value


Distribution = Annotated[
    DistributionSection,
    BeforeValidator(_number_as_choice, json_schema_input_type=float | DistributionSection),
]


MAX_TRIES = 300  # for one place
MAX_STARTS = 30  # with new places from the first on
DENSEST_PACKING = pi / 12**0.5  # part of the plane that equal discs can cover


class NoRoom(ValueError):
    """Error that places do not fit at their least distance; the message has the numbers."""


def random_places(
    rng: np.random.Generator, count: int, polar: tuple[float, float], distance: float
) -> Array:
    """Return random places on a sphere, uniform in area between two polar angles.

    A place at less than `distance` from an earlier one is drawn again (random sequential addition).
    If one of them finds no room in `MAX_TRIES`, all begin again.

    Parameters
    ----------
    count
        Number of places.
    polar
        Least and largest polar angle, in degrees.
    distance
        Least angle between two places, seen from the centre, in degrees.

    Returns
    -------
    Array
        (count, 2): polar angles and azimuths in degrees.

    Raises
    ------
    NoRoom
        If not even a dense packing has room, or none was found.
    """
    refuse_no_room(count, polar, distance)
    # bounds of the height z on the unit sphere; what is uniform in z is uniform in area
    z_bounds = cos(radians(polar[1])), cos(radians(polar[0]))
    max_cosine = cos(radians(distance))
    for _ in range(MAX_STARTS):
        places: Array = np.empty((0, 3))
        for _ in range(count):
            place = _place_with_room(rng, places, z_bounds, max_cosine)
            if place is None:
                break
            places = np.vstack([places, place])
        if len(places) == count:
            angles = np.degrees(
                [np.arccos(places[:, 2]), np.arctan2(places[:, 1], places[:, 0]) % (2 * pi)]
            )
            return np.asarray(angles.T)
    raise NoRoom(
        f"no room was found for {count} places at least {distance:g} degrees apart: fewer, or "
        "closer ones"
    )


def _place_with_room(
    rng: np.random.Generator, places: Array, z_bounds: tuple[float, float], max_cosine: float
) -> Array | None:
    """Return a random place (3,) on the unit sphere, away from earlier ones; None if none is found.

    Parameters
    ----------
    places
        (n, 3) earlier places.
    z_bounds
        Least and largest height z.
    max_cosine
        Cosine of the least angle between two places.
    """
    for _ in range(MAX_TRIES):
        z, azimuth = rng.uniform(*z_bounds), rng.uniform(0.0, 2 * pi)
        rho = np.sqrt(1 - z * z)
        place = np.array([rho * np.cos(azimuth), rho * np.sin(azimuth), z])
        if (places @ place <= max_cosine).all():
            return place
    return None


def refuse_no_room(count: int, polar: tuple[float, float], distance: float) -> None:
    """Refuse places on a sphere if discs around them have more area than their zone.

    Each place has a disc of half the distance as its radius. The zone is what lies between the
    polar angles, and a radius beyond them.

    Parameters
    ----------
    count
        Number of places.
    polar
        Least and largest polar angle of the places, in degrees.
    distance
        Least angle between two places, in degrees.

    Raises
    ------
    NoRoom
        If the discs are too large or too many even for a hexagonal packing.
    """
    disc_radius = radians(distance) / 2
    zone_begin = max(radians(polar[0]) - disc_radius, 0.0)
    zone_end = min(radians(polar[1]) + disc_radius, pi)
    # area of the zone over that of a disc; one place always has room, and any number of points
    max_count = np.inf
    if disc_radius:
        max_count = max(
            DENSEST_PACKING * (cos(zone_begin) - cos(zone_end)) / (1 - cos(disc_radius)), 1.0
        )
    if count > max_count:
        raise NoRoom(
            f"{count} places at least {distance:g} degrees apart do not fit between the polar "
            f"angles {polar[0]:g} and {degrees(radians(polar[1])):g}: there is room for less than "
            f"{int(max_count) + 1}"
        )


Angle = Annotated[float, Field(ge=0, le=180)]


class DefectsSection(Section):
    """Random defects in place of `shell.imperfections`, at random places of a sphere, uniform in
    area.
    """

    kind: Literal["gaussian", "dimple"] = "gaussian"
    """The kind of all of them, as in `shell.imperfections`"""
    count: Distribution
    """Their number; a distribution of whole numbers, or a number"""
    amplitude: Distribution
    """The amplitude of each [h]"""
    width: Distribution
    """The width of each, as in `shell.imperfections`"""
    polar: Annotated[list[Angle], Field(min_length=2, max_length=2)]
    """Least and largest polar angle of their centres [degrees]"""
    distance: Angle = 0.0
    """Least angle between two centres [degrees]"""

    @model_validator(mode="after")
    def _there_is_room(self) -> Self:
        """Check the number of defects, and that their zone has room for the largest number."""
        if self.polar[0] >= self.polar[1]:
            raise ValueError(
                f"polar: the first angle must be less than the second, here {self.polar}"
            )
        # a sample of all numbers that can be drawn
        values = [self.count.quantile(p) for p in np.linspace(0, 1 - 1e-9, 101)]
        numbers = [float(n) for n in values if not isinstance(n, str)]
        if any(not n.is_integer() or not 0 <= n <= 500 for n in numbers):
            raise ValueError("count: must be whole numbers from 0 to 500")
        refuse_no_room(max(int(n) for n in values), (self.polar[0], self.polar[1]), self.distance)
        return self

    def draw(self, rng: np.random.Generator) -> list[dict[str, Any]]:
        """Draw defects, as plain data of items of `shell.imperfections`.

        Raises
        ------
        NoRoom
            If no places were found for them.
        """
        count = int(self.count.draw(rng))
        places = random_places(rng, count, (self.polar[0], self.polar[1]), self.distance)
        return [
            {
                "kind": self.kind,
                "amplitude": self.amplitude.draw(rng),
                "width": self.width.draw(rng),
                "at": {"polar": float(polar), "azimuth": float(azimuth)},
            }
            for polar, azimuth in places
        ]


def generator(seed: int, number: int, name: str) -> np.random.Generator:
    """Return the generator of random numbers for one name (such as a key) in one sample of a study.

    Parameters
    ----------
    seed
        Seed of the study.
    number
        Number of the sample.
    """
    # a hash that is the same in every process
    spawn_key = number, zlib.crc32(name.encode())
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=spawn_key))

"""Interval arithmetic with first derivatives: bounds of all values of a formula in a box.

Values at places show a formula only at these places. Interval arithmetic shows whether the formula
may have other values between them, however narrow a step or a Gaussian is. After each operation the
range is also bounded by the value in the middle of the box plus or minus the change that the
derivatives allow. So the excess of the range shrinks with the square of the box.

An interval has all values of a quantity in a box; operations on intervals return intervals that
contain all results. Slopes are intervals of derivatives. An enclosure is a function in boxes: its
values, slopes, and the value in the middle. Each array has one entry for each of n boxes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Interval:
    """Intervals from `low` to `high` (n,); bounds that are not numbers are infinite."""

    low: Array
    high: Array

    @classmethod
    def between(cls, low: Any, high: Any) -> "Interval":
        """Return the intervals between bounds; a bound that is not a number becomes infinite."""
        unknown = np.isnan(low) | np.isnan(high)
        return cls(np.where(unknown, -np.inf, low), np.where(unknown, np.inf, high))

    @classmethod
    def number(cls, value: Any) -> "Interval":
        """Return intervals that contain one number each."""
        number = np.asarray(value, dtype=np.float64)
        return cls(number, number)

    def contains(self, value: float) -> NDArray[np.bool_]:
        """Return whether each interval contains a number."""
        return np.asarray((self.low <= value) & (value <= self.high))

    @property
    def size(self) -> Array:
        """The largest absolute value in each interval."""
        return np.asarray(np.maximum(np.abs(self.low), np.abs(self.high)))

    def intersection(self, other: "Interval") -> "Interval":
        """Return the intersections with other intervals.

        Where rounding makes an intersection empty, it is the gap between both intervals.
        """
        low, high = np.maximum(self.low, other.low), np.minimum(self.high, other.high)
        return Interval(np.minimum(low, high), np.maximum(low, high))

    def monotone(self, function: Callable[[Array], Array]) -> "Interval":
        """Return the images of the intervals under an increasing function."""
        return Interval.between(function(self.low), function(self.high))

    def hull(self, *values: Any) -> "Interval":
        """Return the smallest intervals that contain some values; this interval is not used."""
        return Interval.between(reduce(np.minimum, values), reduce(np.maximum, values))

    def unless(
        self, which: NDArray[np.bool_], low: float = -np.inf, high: float = np.inf
    ) -> "Interval":
        """Return these intervals, with the bounds `low` and `high` where `which` is true."""
        return Interval(np.where(which, low, self.low), np.where(which, high, self.high))


def _add(a: Interval, b: Interval) -> Interval:
    """Return all sums of two numbers of the intervals."""
    return Interval.between(a.low + b.low, a.high + b.high)


def _negative(a: Interval) -> Interval:
    return Interval(-a.high, -a.low)


def _multiply(a: Interval, b: Interval) -> Interval:
    """Return all products of two numbers of the intervals."""
    # the bounds of each factor; a number is an interval with one array as both bounds
    bounds_of_a, bounds_of_b = ((c.low,) if c.low is c.high else (c.low, c.high) for c in (a, b))
    products = [x * y for x in bounds_of_a for y in bounds_of_b]
    if np.isnan(sum(products)).any():
        products = [np.where(np.isnan(p), 0.0, p) for p in products]  # zero times infinity
    return a.hull(*products)


def _inverse(a: Interval) -> Interval:
    """Return all inverses: everything if 0 is inside, a half line if 0 is an end."""
    # 1/x falls, so that the upper bound gives the lower one
    inverse = Interval(1 / a.high, 1 / a.low).unless(a.contains(0.0))
    inverse = inverse.unless((a.low == 0) & (a.high > 0), high=np.inf, low=0.0)
    return inverse.unless((a.high == 0) & (a.low < 0), low=-np.inf, high=0.0)


def _divide(a: Interval, b: Interval) -> Interval:
    return _multiply(a, _inverse(b))


def _power(a: Interval, p: Interval) -> Interval:
    """Return all powers x**n of numbers x of `a` with exponents n of `p`, as NumPy defines them.

    A negative x has powers with integer n alone.
    """
    # an exponent that varies: x**n = exp(n log x), since NumPy has no power of a negative number
    # with an exponent that is no integer
    if p.low.ndim or p.low != p.high:
        return _exp(_multiply(p, _log(a)))
    # a single number as the exponent: if it is no integer, only numbers >= 0 have a power
    n = float(p.low)
    if not n.is_integer() or abs(n) > 1e9:
        return _power_positive(Interval(np.maximum(a.low, 0.0), a.high), n)
    if n < 0:
        return _inverse(_power(a, Interval.number(-n)))
    if n == 1:
        return a
    if n % 2:  # odd powers increase
        return a.monotone(lambda x: np.power(x, n))
    return _power_positive(_absolute(a), n) if n else Interval.number(np.ones_like(a.low))


def _power_positive(a: Interval, n: float) -> Interval:
    """Return all powers x**n of numbers that are not negative, or all squares."""
    if n == 2:
        return a.hull(np.square(a.low), np.square(a.high))
    if n < 0:
        return _inverse(_power_positive(a, -n))
    return a.hull(np.power(a.low, n), np.power(a.high, n))


def _absolute(a: Interval) -> Interval:
    """Return all absolute values of the numbers of the intervals."""
    smallest = np.minimum(np.abs(a.low), np.abs(a.high))
    return Interval(np.where(a.contains(0.0), 0.0, smallest), a.size)


def _sin(a: Interval) -> Interval:
    """Return all sines of numbers of the intervals.

    They lie between those of the ends, or reach 1 or -1 where an interval passes such a peak.
    """
    turns = 2 * np.pi
    ends = a.hull(np.sin(a.low), np.sin(a.high))

    def passes(peak: float) -> NDArray[np.bool_]:
        """Return whether each interval contains the angle `peak` up to full turns."""
        # the number of peaks below an angle is higher at the upper end
        passed = np.floor((a.high - peak) / turns) > np.floor((a.low - peak) / turns)
        return np.asarray(passed | ~np.isfinite(a.size))

    low = np.where(passes(-np.pi / 2), -1.0, ends.low)
    return Interval(low, np.where(passes(np.pi / 2), 1.0, ends.high))


def _cos(a: Interval) -> Interval:
    return _sin(Interval(a.low + np.pi / 2, a.high + np.pi / 2))


def _tan(a: Interval) -> Interval:
    """Return all tangents: everything if a pole lies in the interval."""
    low_branch, high_branch = (np.floor((x - np.pi / 2) / np.pi) for x in (a.low, a.high))
    pole: NDArray[np.bool_] = high_branch > low_branch
    return a.monotone(np.tan).unless(pole | ~np.isfinite(a.size))


def _exp(a: Interval) -> Interval:
    return a.monotone(np.exp)


def _log(a: Interval) -> Interval:
    return Interval.between(np.log(np.maximum(a.low, 0.0)), np.log(a.high))


def _sqrt(a: Interval) -> Interval:
    return Interval.between(np.sqrt(np.maximum(a.low, 0.0)), np.sqrt(a.high))


def _sign(a: Interval) -> Interval:
    return a.monotone(np.sign)


def _arctan2(y: Interval, x: Interval) -> Interval:
    """Return all angles of points (x, y): all from -pi to pi where the angle jumps."""
    # where the angle does not jump, its bounds are at corners of the box
    angles = y.hull(*(np.arctan2(v, u) for v in (y.low, y.high) for u in (x.low, x.high)))
    return angles.unless(_on_cut(y, x), -np.pi, np.pi)


def _on_cut(y: Interval, x: Interval) -> NDArray[np.bool_]:
    """Return where boxes of points (x, y) meet the negative x axis, on which the angle jumps."""
    return np.asarray((x.low <= 0) & (y.low <= 0) & (y.high >= 0))


def _unit_slope(a: Interval) -> Interval:
    return Interval.number(1.0)


VALUES: dict[np.ufunc, Callable[..., Interval]] = {
    np.add: _add,
    np.subtract: lambda a, b: _add(a, _negative(b)),
    np.multiply: _multiply,
    np.divide: _divide,
    np.power: _power,
    np.positive: lambda a: a,
    np.negative: _negative,
    np.sin: _sin,
    np.cos: _cos,
    np.tan: _tan,
    np.exp: _exp,
    np.log: _log,
    np.sqrt: _sqrt,
    np.abs: _absolute,
    np.sign: _sign,
    np.arctan2: _arctan2,
}


def _power_slopes(a: Interval, p: Interval) -> list[Interval]:
    """Return the derivatives of x**n by the base and by the exponent."""
    by_base = _multiply(p, _power(a, Interval(p.low - 1, p.high - 1)))
    # A single exponent is a number, which does not vary.
    by_exponent = _multiply(_power(a, p), _log(a)) if p.low.ndim else Interval.number(0.0)
    return [by_base, by_exponent]


def _angle_slopes(y: Interval, x: Interval) -> list[Interval]:
    """Return the derivatives of arctan2(y, x) by y and by x."""
    squared = _inverse(_add(_power(x, Interval.number(2.0)), _power(y, Interval.number(2.0))))
    slopes = [_multiply(x, squared), _negative(_multiply(y, squared))]
    return [slope.unless(_on_cut(y, x)) for slope in slopes]


SLOPES: dict[np.ufunc, Callable[..., list[Interval]]] = {  # by each argument
    np.add: lambda a, b: [_unit_slope(a), _unit_slope(b)],
    np.subtract: lambda a, b: [_unit_slope(a), Interval.number(-1.0)],
    np.multiply: lambda a, b: [b, a],
    np.divide: lambda a, b: [_inverse(b), _negative(_divide(a, _power(b, Interval.number(2.0))))],
    np.power: _power_slopes,
    np.positive: lambda a: [_unit_slope(a)],
    np.negative: lambda a: [Interval.number(-1.0)],
    np.sin: lambda a: [_cos(a)],
    np.cos: lambda a: [_negative(_sin(a))],
    np.tan: lambda a: [_add(Interval.number(1.0), _power(_tan(a), Interval.number(2.0)))],
    np.exp: lambda a: [_exp(a)],
    np.log: lambda a: [_inverse(a)],
    np.sqrt: lambda a: [_inverse(_multiply(Interval.number(2.0), _sqrt(a)))],
    np.abs: lambda a: [_sign(a)],
    np.sign: lambda a: [
        Interval(np.zeros_like(a.low), np.zeros_like(a.low)).unless(a.contains(0.0))
    ],
    np.arctan2: _angle_slopes,
}


@dataclass(frozen=True)
class Enclosure(NDArrayOperatorsMixin):
    """Bounds of a function in n boxes; NumPy's functions of an enclosure return enclosures.

    Attributes
    ----------
    values
        Interval of all values in each box.
    slopes
        Intervals of all derivatives by x, y and z.
    middle
        (n,) the value in the middle of each box.
    halves
        (3, n) half the sides of each box.
    """

    values: Interval
    slopes: tuple[Interval, ...]
    middle: Array
    halves: Array

    @classmethod
    def coordinates(cls, low: Array, high: Array) -> "list[Enclosure]":
        """Return the functions x, y and z in boxes between corners `low` and `high` (n, 3)."""
        one, zero = Interval.number(np.ones(len(low))), Interval.number(np.zeros(len(low)))
        # the slopes of x, y and z by x, y and z
        units = [(one, zero, zero), (zero, one, zero), (zero, zero, one)]
        middle, halves = (low + high) / 2, (high - low).T / 2
        return [
            cls(Interval(low[:, i], high[:, i]), units[i], middle[:, i], halves) for i in range(3)
        ]

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *arguments: Any, **options: Any) -> Any:
        """Return the enclosure of a NumPy function of enclosures and numbers, by the chain rule.

        The values are bounded in two ways, whose intersection counts: by interval arithmetic, and
        by the value in the middle with the largest change that the slopes allow.
        """
        is_plain_call = method == "__call__" and not options
        if not is_plain_call or ufunc not in VALUES:
            return NotImplemented
        intervals = [
            a.values if isinstance(a, Enclosure) else Interval.number(a) for a in arguments
        ]
        # slopes by x, y, z: sums over arguments of the derivative by it times its own slopes
        derivatives = SLOPES[ufunc](*intervals)
        slopes = [Interval.number(np.zeros_like(self.middle))] * 3
        for a, derivative in zip(arguments, derivatives, strict=True):
            if isinstance(a, Enclosure):
                pairs = zip(slopes, a.slopes, strict=True)
                slopes = [_add(total, _multiply(derivative, slope)) for total, slope in pairs]
        # the value in the middle, and the largest change from there to the boundary of the box
        middle = ufunc(*(a.middle if isinstance(a, Enclosure) else a for a in arguments))
        max_change = np.zeros_like(self.middle)
        for slope, half in zip(slopes, self.halves, strict=True):
            # a slope of zero makes no change, in an infinite box too (not 0 times infinity)
            max_change = max_change + np.where(slope.size == 0, 0.0, slope.size * half)
        linear_bounds = Interval.between(middle - max_change, middle + max_change)
        values = VALUES[ufunc](*intervals).intersection(linear_bounds)
        return Enclosure(values, tuple(slopes), middle, self.halves)

"""All values that a formula has in a box: interval arithmetic, with first derivatives.

Values at places show a formula only there. The arithmetic of intervals shows that it has no others
between them, or that it may have, however narrow a step or a Gaussian is. After each operation the
range is also the value in the middle of the box and what the derivatives can add to it, so that it
shrinks with the square of the box.
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
class Range:
    """Numbers from `low` to `high` (n,); what is not a number may be any."""

    low: Array
    high: Array

    @classmethod
    def of(cls, low: Any, high: Any) -> "Range":
        unknown = np.isnan(low) | np.isnan(high)
        return cls(np.where(unknown, -np.inf, low), np.where(unknown, np.inf, high))

    @classmethod
    def number(cls, value: Any) -> "Range":
        number = np.asarray(value, dtype=np.float64)
        return cls(number, number)

    def holds(self, value: float) -> NDArray[np.bool_]:
        return np.asarray((self.low <= value) & (value <= self.high))

    @property
    def size(self) -> Array:
        """The largest absolute value."""
        return np.asarray(np.maximum(np.abs(self.low), np.abs(self.high)))

    def within(self, other: "Range") -> "Range":
        """What is in both; rounding may leave nothing between."""
        low, high = np.maximum(self.low, other.low), np.minimum(self.high, other.high)
        return Range(np.minimum(low, high), np.maximum(low, high))

    def monotone(self, of: Callable[[Array], Array]) -> "Range":
        return Range.of(of(self.low), of(self.high))

    def hull(self, *values: Any) -> "Range":
        return Range.of(reduce(np.minimum, values), reduce(np.maximum, values))

    def unless(
        self, which: NDArray[np.bool_], low: float = -np.inf, high: float = np.inf
    ) -> "Range":
        """With others where `which` holds."""
        return Range(np.where(which, low, self.low), np.where(which, high, self.high))


def _add(a: Range, b: Range) -> Range:
    return Range.of(a.low + b.low, a.high + b.high)


def _negative(a: Range) -> Range:
    return Range(-a.high, -a.low)


def _multiply(a: Range, b: Range) -> Range:
    ends = [(c.low,) if c.low is c.high else (c.low, c.high) for c in (a, b)]
    products = [x * y for x in ends[0] for y in ends[1]]
    if np.isnan(sum(products)).any():
        products = [np.where(np.isnan(p), 0.0, p) for p in products]  # zero times infinity
    return a.hull(*products)


def _inverse(a: Range) -> Range:
    inverse = Range(1 / a.high, 1 / a.low).unless(a.holds(0.0))
    inverse = inverse.unless((a.low == 0) & (a.high > 0), high=np.inf, low=0.0)
    return inverse.unless((a.high == 0) & (a.low < 0), low=-np.inf, high=0.0)


def _divide(a: Range, b: Range) -> Range:
    return _multiply(a, _inverse(b))


def _power(a: Range, p: Range) -> Range:
    if p.low.ndim or p.low != p.high:
        return _exp(
            _multiply(p, _log(a))
        )  # NumPy has no real power of a negative number with a broken exponent
    n = float(p.low)
    if n != int(n) or abs(n) > 1e9:
        return _power_positive(Range(np.maximum(a.low, 0.0), a.high), n)
    if n < 0:
        return _inverse(_power(a, Range.number(-n)))
    if n == 1:
        return a
    if n % 2:
        return a.monotone(lambda x: np.power(x, n))
    return _power_positive(_absolute(a), n) if n else Range.number(np.ones_like(a.low))


def _power_positive(a: Range, n: float) -> Range:
    if n == 2:
        return a.hull(np.square(a.low), np.square(a.high))
    return (
        a.hull(np.power(a.low, n), np.power(a.high, n))
        if n >= 0
        else _inverse(_power_positive(a, -n))
    )


def _absolute(a: Range) -> Range:
    least = np.minimum(np.abs(a.low), np.abs(a.high))
    return Range(np.where(a.holds(0.0), 0.0, least), a.size)


def _sin(a: Range) -> Range:
    turns = 2 * np.pi
    ends = a.hull(np.sin(a.low), np.sin(a.high))

    def passes(peak: float) -> NDArray[np.bool_]:
        passed = np.floor((a.high - peak) / turns) > np.floor((a.low - peak) / turns)
        return np.asarray(passed | ~np.isfinite(a.size))

    low, high = (
        np.where(passes(-np.pi / 2), -1.0, ends.low),
        np.where(passes(np.pi / 2), 1.0, ends.high),
    )
    return Range(low, high)


def _cos(a: Range) -> Range:
    return _sin(Range(a.low + np.pi / 2, a.high + np.pi / 2))


def _tan(a: Range) -> Range:
    pole: NDArray[np.bool_] = np.floor((a.high - np.pi / 2) / np.pi) > np.floor(
        (a.low - np.pi / 2) / np.pi
    )
    return a.monotone(np.tan).unless(pole | ~np.isfinite(a.size))


def _exp(a: Range) -> Range:
    return a.monotone(np.exp)


def _log(a: Range) -> Range:
    return Range.of(np.log(np.maximum(a.low, 0.0)), np.log(a.high))


def _sqrt(a: Range) -> Range:
    return Range.of(np.sqrt(np.maximum(a.low, 0.0)), np.sqrt(a.high))


def _sign(a: Range) -> Range:
    return a.monotone(np.sign)


def _arctan2(y: Range, x: Range) -> Range:
    angles = y.hull(*(np.arctan2(v, u) for v in (y.low, y.high) for u in (x.low, x.high)))
    return angles.unless(_on_cut(y, x), -np.pi, np.pi)


def _on_cut(y: Range, x: Range) -> NDArray[np.bool_]:
    """Where the angle jumps, or has no value."""
    return np.asarray((x.low <= 0) & (y.low <= 0) & (y.high >= 0))


def _one(a: Range) -> Range:
    return Range.number(1.0)


VALUES: dict[np.ufunc, Callable[..., Range]] = {
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


def _power_slopes(a: Range, p: Range) -> list[Range]:
    by_base = _multiply(p, _power(a, Range(p.low - 1, p.high - 1)))
    return [
        by_base,
        _multiply(_power(a, p), _log(a)) if p.low.ndim else Range.number(0.0),
    ]  # the power is a number


def _angle_slopes(y: Range, x: Range) -> list[Range]:
    squared = _inverse(_add(_power(x, Range.number(2.0)), _power(y, Range.number(2.0))))
    slopes = [_multiply(x, squared), _negative(_multiply(y, squared))]
    return [slope.unless(_on_cut(y, x)) for slope in slopes]


SLOPES: dict[np.ufunc, Callable[..., list[Range]]] = {  # by each argument
    np.add: lambda a, b: [_one(a), _one(b)],
    np.subtract: lambda a, b: [_one(a), Range.number(-1.0)],
    np.multiply: lambda a, b: [b, a],
    np.divide: lambda a, b: [_inverse(b), _negative(_divide(a, _power(b, Range.number(2.0))))],
    np.power: _power_slopes,
    np.positive: lambda a: [_one(a)],
    np.negative: lambda a: [Range.number(-1.0)],
    np.sin: lambda a: [_cos(a)],
    np.cos: lambda a: [_negative(_sin(a))],
    np.tan: lambda a: [_add(Range.number(1.0), _power(_tan(a), Range.number(2.0)))],
    np.exp: lambda a: [_exp(a)],
    np.log: lambda a: [_inverse(a)],
    np.sqrt: lambda a: [_inverse(_multiply(Range.number(2.0), _sqrt(a)))],
    np.abs: lambda a: [_sign(a)],
    np.sign: lambda a: [Range(np.zeros_like(a.low), np.zeros_like(a.low)).unless(a.holds(0.0))],
    np.arctan2: _angle_slopes,
}


@dataclass(frozen=True)
class Enclosed(NDArrayOperatorsMixin):
    """What NumPy's functions of it return too.

    Attributes
    ----------
    values, slopes
        All values in the box, and all derivatives by x, y and z.
    middle, halves
        The value in the middle (n,), and half the sides of the box (3, n).
    """

    values: Range
    slopes: tuple[Range, ...]
    middle: Array
    halves: Array

    @classmethod
    def coordinates(cls, low: Array, high: Array) -> "list[Enclosed]":
        """x, y and z in boxes between corners (n, 3)."""
        halves, one, none = (high - low).T / 2, np.ones(len(low)), np.zeros(len(low))
        units = [tuple(Range.number(one if i == j else none) for j in range(3)) for i in range(3)]
        middle = (low + high) / 2
        return [cls(Range(low[:, i], high[:, i]), units[i], middle[:, i], halves) for i in range(3)]

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *arguments: Any, **options: Any) -> Any:
        """A function of this and of numbers, by the chain rule."""
        if method != "__call__" or options or ufunc not in VALUES:
            return NotImplemented
        ranges = [a.values if isinstance(a, Enclosed) else Range.number(a) for a in arguments]
        partial = SLOPES[ufunc](*ranges)
        none = Range.number(np.zeros_like(self.middle))
        slopes = [none] * 3
        for a, by in zip(arguments, partial, strict=True):
            if isinstance(a, Enclosed):
                slopes = [
                    _add(one, _multiply(by, own)) for one, own in zip(slopes, a.slopes, strict=True)
                ]
        middle = ufunc(*(a.middle if isinstance(a, Enclosed) else a for a in arguments))
        most = np.zeros_like(self.middle)
        for slope, half in zip(slopes, self.halves, strict=True):
            most = most + np.where(slope.size == 0, 0.0, slope.size * half)
        near = Range.of(middle - most, middle + most)
        return Enclosed(VALUES[ufunc](*ranges).within(near), tuple(slopes), middle, self.halves)

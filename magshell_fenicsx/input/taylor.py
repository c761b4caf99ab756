"""Value, gradient and Hessian of a formula at many places: arithmetic of Taylor polynomials of second order."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray

Array = NDArray[np.float64]
Partials = tuple[
    list[Any], dict[tuple[int, int], Any]
]  # first derivatives by each argument, second ones by pairs i <= j


@dataclass(frozen=True)
class Taylor(NDArrayOperatorsMixin):
    """What NumPy's functions of it return too.

    Attributes
    ----------
    value, gradient, hessian
        (n,), (3, n) and (3, 3, n).
    """

    value: Array
    gradient: Array
    hessian: Array

    @classmethod
    def coordinates(cls, x: Array) -> list[Self]:
        """x, y and z at places (n, 3)."""
        one, none = np.ones(len(x)), np.zeros((3, 3, len(x)))
        return [cls(x[:, i], np.eye(3)[i, :, None] * one, none) for i in range(3)]

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *arguments: Any, **options: Any) -> Any:
        """A function of this and of numbers, by the chain rule."""
        if method != "__call__" or options or ufunc not in PARTIALS:
            return NotImplemented
        values = [a.value if isinstance(a, Taylor) else a for a in arguments]
        varying = [i for i, a in enumerate(arguments) if isinstance(a, Taylor)]
        first, second = PARTIALS[ufunc](*values)
        gradient, hessian = np.zeros_like(self.gradient), np.zeros_like(self.hessian)
        for i in varying:
            gradient = gradient + first[i] * arguments[i].gradient
            hessian = hessian + first[i] * arguments[i].hessian
        for (i, j), partial in second.items():
            if i in varying and j in varying:
                product = arguments[i].gradient[:, None] * arguments[j].gradient
                hessian = hessian + partial * (product if i == j else product + product.swapaxes(0, 1))
        return Taylor(ufunc(*values), gradient, hessian)


def _power(x: Any, p: Any) -> Partials:
    def term(factor: Any, exponent: Any) -> Any:
        return np.where(factor == 0, 0.0, factor * np.power(x, exponent))  # not 0/0, of x**1 at 0 for instance

    value, log = np.power(x, p), np.log(x)
    mixed = np.power(x, p - 1) * (1 + p * log)
    return [term(p, p - 1), value * log], {
        (0, 0): term(p * (p - 1), p - 2),
        (0, 1): mixed,
        (1, 1): value * log**2,
    }


def _arctan2(y: Any, x: Any) -> Partials:
    r2 = x**2 + y**2
    across = 2 * x * y / r2**2
    return [x / r2, -y / r2], {(0, 0): -across, (0, 1): (y**2 - x**2) / r2**2, (1, 1): across}


def _tan(x: Any) -> Partials:
    t = np.tan(x)
    return [1 + t**2], {(0, 0): 2 * t * (1 + t**2)}


PARTIALS: dict[np.ufunc, Callable[..., Partials]] = {
    np.add: lambda x, y: ([1.0, 1.0], {}),
    np.subtract: lambda x, y: ([1.0, -1.0], {}),
    np.multiply: lambda x, y: ([y, x], {(0, 1): 1.0}),
    np.divide: lambda x, y: ([1 / y, -x / y**2], {(0, 1): -1 / y**2, (1, 1): 2 * x / y**3}),
    np.power: _power,
    np.positive: lambda x: ([1.0], {}),
    np.negative: lambda x: ([-1.0], {}),
    np.sin: lambda x: ([np.cos(x)], {(0, 0): -np.sin(x)}),
    np.cos: lambda x: ([-np.sin(x)], {(0, 0): -np.cos(x)}),
    np.tan: _tan,
    np.exp: lambda x: ([np.exp(x)], {(0, 0): np.exp(x)}),
    np.log: lambda x: ([1 / x], {(0, 0): -1 / x**2}),
    np.sqrt: lambda x: ([0.5 / np.sqrt(x)], {(0, 0): -0.25 / (x * np.sqrt(x))}),
    np.abs: lambda x: ([np.sign(x)], {}),
    np.sign: lambda x: ([0.0], {}),
    np.arctan2: _arctan2,
}

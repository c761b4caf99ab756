"""The energy of incompressible rubber as a function of its invariants, with its derivatives.

Energies are per undeformed volume, over Young's modulus E. C is the Cauchy-Green tensor, with det C
= 1, and I1 = tr C and I2 = (I1^2 - tr C^2)/2 are its invariants. Both are 3 without strain; the
arguments of an energy are I1 - 3 and I2 - 3, so that no numbers of order one are subtracted.

A scalar is a number, an array or an expression of UFL. `ln` and `root` take all three.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from magshell_fenicsx.input.expressions import Taylor
from magshell_fenicsx.platform.lazy_import import lazy_import

if TYPE_CHECKING:
    import ufl
else:
    ufl = lazy_import("ufl")

Scalar: TypeAlias = Any  # a number, an expression, or an array (...)


class EnergyDerivatives(NamedTuple):
    """The derivatives of an energy by I1 (named first) and I2 (named second)."""

    first: Scalar
    second: Scalar
    first_first: Scalar
    first_second: Scalar
    second_second: Scalar


@dataclass(frozen=True)
class StrainEnergy:
    """The energy of rubber as a function of I1 - 3 and I2 - 3.

    The sum of its derivatives by I1 and I2 is 1/6 without strain, so that E is one. Neither of them
    is negative, and it is convex in both invariants: then bending costs energy at any stretch.

    Attributes
    ----------
    function
        The energy as a function of (I1 - 3, I2 - 3, *constants), made of arithmetic, `ln` and
        `root`.
    constants
        The material's numbers.
    """

    function: Callable[..., Scalar]
    constants: tuple[Scalar, ...] = ()

    def value(self, first: Scalar, second: Scalar) -> Scalar:
        """Return the energy at I1 - 3 = `first` and I2 - 3 = `second`."""
        return self.function(first, second, *self.constants)

    def derivatives(self, first: Scalar, second: Scalar) -> EnergyDerivatives:
        """Return the derivatives at I1 - 3 = `first` and I2 - 3 = `second`.

        Those of an expression are found by UFL, those of numbers and arrays by Taylor arithmetic.
        """
        if is_expression(first):
            symbols, derivatives = _symbolic_derivatives(self.function, len(self.constants))
            values = dict(zip(symbols, (first, second, *self.constants), strict=True))
            return EnergyDerivatives._make(ufl.replace(formula, values) for formula in derivatives)
        places = np.stack([np.ravel(first), np.ravel(second), np.zeros(np.size(first))], axis=-1)
        x, y, _ = Taylor.coordinates(places)
        energy, shape = self.value(x, y), np.shape(first)
        gradient, hessian = (
            tensor.reshape(*tensor.shape[:-1], *shape)
            for tensor in (energy.gradient, energy.hessian)
        )
        slopes = gradient[0], gradient[1]
        return EnergyDerivatives._make([*slopes, hessian[0, 0], hessian[0, 1], hessian[1, 1]])


@cache
def _symbolic_derivatives(
    function: Callable[..., Scalar], count: int
) -> tuple[list[Scalar], list[Scalar]]:
    """Return symbols, and the derivatives of an energy as expressions of these.

    Parameters
    ----------
    function, count
        The energy, and the number of its constants.

    Returns
    -------
    symbols
        They stand for I1 - 3, I2 - 3 and the constants.
    derivatives
        In the order of `EnergyDerivatives`.
    """
    symbols = [ufl.variable(ufl.as_ufl(1.0)) for _ in range(2 + count)]
    x, y = symbols[:2]
    by_x, by_y = (ufl.diff(function(*symbols), invariant) for invariant in (x, y))
    derivatives = by_x, by_y, ufl.diff(by_x, x), ufl.diff(by_x, y), ufl.diff(by_y, y)
    return symbols, [ufl.algorithms.expand_derivatives(formula) for formula in derivatives]


def is_expression(x: Scalar) -> bool:
    """Return whether a scalar is an expression of UFL, not a number or an array."""
    return isinstance(x, ufl.core.expr.Expr)


def root(x: Scalar) -> Scalar:
    """Return the square root."""
    return ufl.sqrt(x) if is_expression(x) else x**0.5


def ln(x: Scalar) -> Scalar:
    """Return the natural logarithm."""
    return ufl.ln(x) if is_expression(x) else np.log(x)

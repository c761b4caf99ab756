"""Formulas of a case as functions of the undeformed place in the model's frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.expressions import formula

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ByFormula:
    """Vectors of numbers and formulas of the undeformed place, in a frame and a unit of length of their own."""

    by_formula: ClassVar[bool] = True
    of_position: Sequence[Callable[[Array, Array, Array], Array]]
    frame: Array
    length: float
    factor: float = 1.0
    vectors: bool = False

    def __call__(self, r0: Array, n0: Array) -> Array:
        x = np.moveaxis(self.length * r0 @ self.frame, -1, 0)
        found = self.factor * np.stack([f(*x) for f in self.of_position], axis=-1)
        return found @ self.frame.T if self.vectors else found


@dataclass(frozen=True)
class Inwards:
    """A pressure by formula, which is against the normal."""

    by_formula: ClassVar[bool] = True
    pressure: ByFormula

    def __call__(self, r0: Array, n0: Array) -> Array:
        return -self.pressure(r0, n0) * n0


def function(value: float | str) -> Callable[[Array, Array, Array], Array]:
    """A formula of x, y, z, or a number that is the same everywhere."""
    if isinstance(value, str):
        return formula(value)
    return lambda x, y, z: np.full_like(x, value)

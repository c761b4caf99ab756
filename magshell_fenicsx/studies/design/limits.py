"""Constraints of a design as numbers that are not negative where they are kept."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.design import LimitSection

Array = NDArray[np.float64]
EQUAL = 1e-3  # relative difference of results that are to be the same


@dataclass(frozen=True)
class Limit:
    """A result above (sign 1) or below (sign -1) a bound, or another result but for a margin."""

    of: str
    sign: float
    bound: float = 0.0
    other: str = ""
    margin: float = 0.0

    def left(self, values: Mapping[str, float]) -> float:
        """How far it is from being broken."""
        against = values[self.other] if self.other else self.bound
        return self.sign * (values[self.of] - against) + self.margin

    def slope(self, gradients: Mapping[str, Sequence[float]]) -> Array:
        """The gradient of `left`."""
        against = np.array(gradients[self.other]) if self.other else 0.0
        return np.asarray(self.sign * (np.array(gradients[self.of]) - against))

    @property
    def words(self) -> str:
        if self.other:
            return f"{self.of} the same as {self.other}"
        return f"{self.of} {'at least' if self.sign > 0 else 'at most'} {self.bound:g}"


def limits_of(section: LimitSection, scale: Mapping[str, float]) -> list[Limit]:
    """Those of a section of a case; `scale` has the sizes of results at the start."""
    sides = ((section.least, 1.0), (section.most, -1.0))
    found = [Limit(section.of, sign, bound) for bound, sign in sides if bound is not None]
    if section.same_as:
        margin = EQUAL * max(scale.get(of, 0.0) for of in (section.of, section.same_as))
        found += [Limit(section.of, sign, other=section.same_as, margin=margin) for sign in (1.0, -1.0)]
    return found

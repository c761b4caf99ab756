"""A Gaussian dimple, w0 = -delta exp(-(phi/phi_g)^2)."""

from math import exp, sqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.imperfections.imperfection import SHOWN, Flaw, Local, LocalSection, refuse_steep
from magshell_fenicsx.shape.ground import Ground, located

Array = NDArray[np.float64]
REACH = 2.0  # widths, where 2 % of the depth is left
OF_WIDTH = 0.4  # of the width: elements that show a narrow one


class GaussianSection(LocalSection):
    """w0 = -δ exp(-(φ/φg)²) around a place, with the distance φ of a dimple; smooth everywhere."""

    kind: Literal["gaussian"]

    def account(self) -> str:
        return f"Gaussian dimple of {self.amplitude:g} h {self.at.words()}"

    def refuse_unfit(self, R_over_h: float, nu: float, edge: float | None) -> None:
        depth = abs(self.amplitude) / R_over_h
        refuse_steep(depth, sqrt(2) * exp(-0.5) * depth / self.half_width(R_over_h, nu))

    def flaw(self, ground: Ground, key: str) -> Flaw:
        phi_g = self.half_width(ground.R_over_h, ground.nu)
        place, distance = located(self.at, ground, key)
        deviation = Gaussian(self.amplitude / ground.R_over_h, phi_g, distance)
        size = min(SHOWN / sqrt(ground.R_over_h), OF_WIDTH * phi_g)
        return Flaw(deviation, size, place, distance, REACH * phi_g)


class Gaussian(Local):
    """Its deviation."""

    @staticmethod
    def profile(squared: Array) -> Array:
        return np.asarray(np.exp(-squared))

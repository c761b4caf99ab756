"""The dimple of the paper, w0 = -delta (1 - (phi/phi_o)^2)^2; the curvature jumps at its rim."""

from dataclasses import dataclass
from math import pi, sqrt
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.imperfections.imperfection import SHOWN, Flaw, Local, LocalSection, refuse_steep
from magshell_fenicsx.shape.ground import Angle, Distance, Ground, located

Array = NDArray[np.float64]
AT_POLE = Angle(np.array([0.0, 0.0, 1.0]))
WIDEST, OF_EDGE = 0.9 * pi, 0.9  # half-width (rad), and over the polar angle of a sphere's edge


class DimpleSection(LocalSection):
    """w0 = -δ (1 - (φ/φo)²)² around a place, within the distance φo.

    On spheres φ is the angle from the place, at a pole of revolution the distance along the meridian over R,
    elsewhere the straight distance over R.
    """

    patch: ClassVar[bool] = True
    kind: Literal["dimple"]

    def account(self) -> str:
        return f"dimple of {self.amplitude:g} h {self.at.words()}"

    def refuse_unfit(self, R_over_h: float, nu: float, edge: float | None) -> None:
        phi_o, depth = self.half_width(R_over_h, nu), abs(self.amplitude) / R_over_h
        if phi_o >= WIDEST:
            raise ValueError(_too_wide(phi_o, WIDEST))
        refuse_steep(depth, 8 / sqrt(27) * depth / phi_o)  # steepest at phi_o/sqrt(3)
        if edge is not None and phi_o >= OF_EDGE * edge:
            raise ValueError(_too_wide(phi_o, OF_EDGE * edge))

    def flaw(self, ground: Ground, key: str) -> Flaw:
        phi_o = self.half_width(ground.R_over_h, ground.nu)
        place, distance = located(self.at, ground, key)
        deviation = Dimple(self.amplitude / ground.R_over_h, phi_o, distance)
        return Flaw(deviation, SHOWN / sqrt(ground.R_over_h), place, distance, phi_o, rim=True)


@dataclass(frozen=True)
class Dimple(Local):
    """Its deviation."""

    distance: Distance = AT_POLE

    @staticmethod
    def profile(squared: Array) -> Array:
        return np.where(squared < 1, (1 - squared) ** 2, 0.0)


def _too_wide(phi_o: float, most: float) -> str:
    return (
        f"the dimple's half-width phi_o is {phi_o * 180 / pi:.1f} degrees at this R/h "
        f"and poisson_ratio; it must stay below {most * 180 / pi:.3g}"
    )

"""The dimple of the paper, w0 = -delta (1 - (phi/phi_o)^2)^2; the curvature jumps at its rim."""

from dataclasses import dataclass
from math import pi, sqrt
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.imperfections.imperfection import Local, LocalSection
from magshell_fenicsx.shape.reference_shell import AngularDistance, Distance

Array = NDArray[np.float64]
AT_POLE = AngularDistance(np.array([0.0, 0.0, 1.0]))
MAX_HALF_WIDTH = 0.9 * pi  # of a dimple, rad
MAX_HALF_WIDTH_OVER_EDGE = 0.9  # half-width over the polar angle of a sphere's edge


@dataclass(frozen=True)
class Dimple(Local):
    """Radial profile (1 - (phi/phi_o)^2)^2 of the dimple, zero outside its half-width phi_o."""

    steepest: ClassVar[float] = 8 / sqrt(27)  # at phi_o/sqrt(3)
    rim: ClassVar[bool] = True
    distance: Distance = AT_POLE

    @staticmethod
    def profile(squared: Array) -> Array:
        """Return (1 - s)^2 of the squared relative distances s = (phi/phi_o)^2, 0 where s >= 1."""
        return np.where(squared < 1, (1 - squared) ** 2, 0.0)


class DimpleSection(LocalSection):
    """w0 = -δ (1 - (φ/φo)²)² around a place, within the distance φo.

    On spheres φ is the angle from the place, at a pole of revolution the distance along the
    meridian over R, elsewhere the straight distance over R.
    """

    patch: ClassVar[bool] = True
    deviation: ClassVar[type[Local]] = Dimple
    kind: Literal["dimple"]

    def account(self) -> str:
        return f"dimple of {self.amplitude:g} h {self.at.words()}"

    def refuse_unfit(self, R_over_h: float, nu: float, edge: float | None) -> None:
        """Raise ValueError where the half-width exceeds its limits (`MAX_HALF_WIDTH...`)."""
        phi_o = self.half_width(R_over_h, nu)
        if phi_o >= MAX_HALF_WIDTH:
            raise ValueError(_too_wide(phi_o, MAX_HALF_WIDTH))
        super().refuse_unfit(R_over_h, nu, edge)
        if edge is not None and phi_o >= MAX_HALF_WIDTH_OVER_EDGE * edge:
            raise ValueError(_too_wide(phi_o, MAX_HALF_WIDTH_OVER_EDGE * edge))


def _too_wide(phi_o: float, max_phi_o: float) -> str:
    """Return the message that the half-width `phi_o` reaches its limit, both in rad."""
    return (
        f"the dimple's half-width phi_o is {phi_o * 180 / pi:.1f} degrees at this R/h and "
        f"poisson_ratio; it must stay below {max_phi_o * 180 / pi:.3g}"
    )

"""A Gaussian dimple, w0 = -delta exp(-(phi/phi_g)^2)."""

from math import exp, sqrt
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.imperfections.imperfection import Local, LocalSection

Array = NDArray[np.float64]


class Gaussian(Local):
    """Radial profile exp(-(phi/phi_g)^2) of a Gaussian dimple."""

    steepest: ClassVar[float] = sqrt(2) * exp(-0.5)
    # in half-widths phi_g: 2 % of the depth is left there
    reach: ClassVar[float] = 2.0
    element_widths: ClassVar[float] = 0.4

    @staticmethod
    def profile(squared: Array) -> Array:
        """Return exp(-s) of the squared relative distances s = (phi/phi_g)^2, same shape."""
        return np.asarray(np.exp(-squared))


class GaussianSection(LocalSection):
    """w0 = -δ exp(-(φ/φg)²) around a place, with the distance φ of a dimple; smooth everywhere."""

    deviation: ClassVar[type[Local]] = Gaussian
    kind: Literal["gaussian"]

    def account(self) -> str:
        return f"Gaussian dimple of {self.amplitude:g} h {self.at.words()}"

"""The dimple of the paper, w0 = -delta (1 - (phi/phi_o)^2)^2; the curvature jumps at its rim."""

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.imperfections.dimple import DimpleSection
from magshell_fenicsx.parts.imperfections.distance import Angle, located
from magshell_fenicsx.parts.imperfections.flaw import Distance, Flaw
from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
AT_POLE = Angle(np.array([0.0, 0.0, 1.0]))


@dataclass(frozen=True)
class Dimple:
    """A deviation.

    Attributes
    ----------
    delta
        Depth over R.
    phi_o
        Half-width over R (rad).
    distance
        From its centre.
    """

    delta: float
    phi_o: float
    distance: Distance = AT_POLE

    def __call__(self, places: Array) -> Array:
        phi = self.distance(places)
        return np.where(phi < self.phi_o, -self.delta * (1 - (phi / self.phi_o) ** 2) ** 2, 0.0)


def dimple(section: DimpleSection, case: Case, drawn: Outline, key: str) -> Flaw:
    """See `Flaw`."""
    shell = case.shell
    phi_o = section.half_width(shell.R_over_h, shell.poisson_ratio)
    place, distance = located(case, drawn, section.at, key)
    deviation = Dimple(section.amplitude / shell.R_over_h, phi_o, distance)
    return Flaw(deviation, 0.45 / sqrt(shell.R_over_h), place, distance, phi_o, rim=True)

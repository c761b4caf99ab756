"""A Gaussian dimple, w0 = -delta exp(-(phi/phi_g)^2)."""

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.imperfections.gaussian import GaussianSection
from magshell_fenicsx.parts.imperfections.distance import located
from magshell_fenicsx.parts.imperfections.flaw import Distance, Flaw
from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
REACH = 2.0  # widths, where 2 % of the depth is left


@dataclass(frozen=True)
class Gaussian:
    """A deviation; see `Dimple`."""

    delta: float
    phi_g: float
    distance: Distance

    def __call__(self, places: Array) -> Array:
        return np.asarray(-self.delta * np.exp(-((self.distance(places) / self.phi_g) ** 2)))


def gaussian(section: GaussianSection, case: Case, drawn: Outline, key: str) -> Flaw:
    """See `Flaw`."""
    shell = case.shell
    phi_g = section.half_width(shell.R_over_h, shell.poisson_ratio)
    place, distance = located(case, drawn, section.at, key)
    deviation = Gaussian(section.amplitude / shell.R_over_h, phi_g, distance)
    size = min(0.45 / sqrt(shell.R_over_h), 0.4 * phi_g)
    return Flaw(deviation, size, place, distance, REACH * phi_g)

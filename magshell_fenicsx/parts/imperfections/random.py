"""A Gaussian random field: a sum of plane waves in space, evaluated on the surface."""

from dataclasses import dataclass
from functools import cached_property
from math import sqrt

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.imperfections.random import RandomSection
from magshell_fenicsx.parts.imperfections.flaw import Flaw
from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
WAVES = 512
AT_ONCE = 4096  # places


@dataclass(frozen=True)
class Waves:
    """w0(x) = delta sqrt(2/N) sum_j cos(k_j . x/length + phase_j), k_j normal, phase_j uniform.

    The mean over seeds is zero, the covariance is delta^2 exp(-d^2/(2 length^2)) (Shinozuka and Deodatis 1996). The
    bits of PCG64 are the same on every machine and in every version of NumPy.
    """

    delta: float
    length: float
    seed: int

    @cached_property
    def _waves(self) -> Array:
        """(4, N): the components of k and the phase."""
        bits = np.random.PCG64(self.seed).random_raw(4 * WAVES).reshape(4, WAVES)
        uniform = ((bits >> np.uint64(11)) + 0.5) / 2.0**53
        return np.vstack([scipy.special.ndtri(uniform[:3]) / self.length, 2 * np.pi * uniform[3:]])

    def __call__(self, places: Array) -> Array:
        w0 = np.empty(len(places))
        for i in range(0, len(places), AT_ONCE):
            x = places[i : i + AT_ONCE]
            angles = self._waves[3] + sum(x[:, j : j + 1] * self._waves[j] for j in range(3))
            w0[i : i + AT_ONCE] = np.cos(angles).sum(axis=1)
        return self.delta * sqrt(2 / WAVES) * w0


def random_field(section: RandomSection, case: Case, drawn: Outline, key: str) -> Flaw:
    """See `Flaw`."""
    assert section.amplitude is not None
    shell = case.shell
    length = section.correlation_length(shell.R_over_h, shell.poisson_ratio)
    return Flaw(Waves(section.amplitude / shell.R_over_h, length, section.seed), length)

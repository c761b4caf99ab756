"""An imperfect surface: a perfect one moved along its normal."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import Embedding

Array = NDArray[np.float64]
Deviation = Callable[[Array], Array]  # places (n, 3) of the perfect surface -> w0 (n,), both over R


@dataclass(frozen=True)
class Deviated:
    """Chart -> r0 = x + w0(x) n(x), with the sum w0 of all deviations.

    Attributes
    ----------
    perfect, normal
        Chart -> places x (n, 3) and outward unit normals (n, 3) of the perfect surface.
    """

    perfect: Embedding
    normal: Embedding
    deviations: tuple[Deviation, ...]

    def __call__(self, chart: Array) -> Array:
        return np.asarray(self.perfect(chart) + self.w0(chart)[:, None] * self.normal(chart))

    def along_normal(self, chart: Array, deviations: Sequence[Deviation]) -> Array:
        """The displacement (n, 3) that other deviations add."""
        return replace(self, deviations=tuple(deviations)).w0(chart)[:, None] * self.normal(chart)

    def w0(self, chart: Array) -> Array:
        """w0 over R at places of the chart, (n,)."""
        places = self.perfect(chart)
        return np.asarray(sum((deviation(places) for deviation in self.deviations), np.zeros(len(places))))

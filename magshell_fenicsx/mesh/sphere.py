"""The hemisphere, perfect or dimpled, charted by (x, y) = phi (cos theta, sin theta)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Dimple:
    """Axisymmetric defect at the pole, w0 = -delta (1 - (phi/phi_o)^2)^2 for phi < phi_o.

    Attributes
    ----------
    delta
        Depth over R.
    phi_o
        Half-width (rad).
    """

    delta: float
    phi_o: float

    def __call__(self, phi: Array) -> Array:
        return np.where(phi < self.phi_o, -self.delta * (1 - (phi / self.phi_o) ** 2) ** 2, 0.0)


@dataclass(frozen=True)
class SphereEmbedding:
    """Chart (x, y) -> the sphere of radius 1, with its defect: r0 = (1 + w0) e_r."""

    defect: Dimple | None = None

    def __call__(self, chart: Array) -> Array:
        phi = np.hypot(chart[:, 0], chart[:, 1])
        horizontal = np.sinc(phi / np.pi)[:, None] * chart
        e_r = np.column_stack([horizontal, np.cos(phi)])
        return e_r if self.defect is None else e_r * (1 + self.defect(phi))[:, None]


def flat(chart: Array) -> Array:
    """Chart (x, y) -> the plane z = 0."""
    return np.column_stack([chart, np.zeros(len(chart))])

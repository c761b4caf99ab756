"""A frame turned about e3, in which half models have their mirror plane at y = 0."""

import numpy as np
from numpy.typing import NDArray


def rotation(azimuth: float) -> NDArray[np.float64]:
    """(3, 3): Q v has the components of v in a frame turned by an azimuth (rad), and rows v Q those of the way back."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

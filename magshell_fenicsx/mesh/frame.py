"""A frame turned about e3, in which half models have their mirror plane at y = 0."""

import numpy as np
from numpy.typing import NDArray


def rotation(azimuth: float) -> NDArray[np.float64]:
    """Q (3, 3) of a frame turned by an azimuth (rad): Q v are the components of v in it, and w Q turns rows w back."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

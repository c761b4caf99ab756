"""Directions by two angles."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.section import Section


class Direction(Section):
    """Angles in degrees: polar from e3, azimuth from e1 about e3."""

    polar: float = 0.0
    """Angle from e3 [degree]"""
    azimuth: float = 0.0
    """Angle from e1 about e3 [degree]"""

    def vector(self, turn: float = 0.0) -> NDArray[np.float64]:
        """The unit vector (3,) in a frame that is turned by `turn` (rad) about e3."""
        polar, azimuth = np.radians(self.polar), np.radians(self.azimuth) - turn
        return np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])

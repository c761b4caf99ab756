"""Defects of the mid-surface."""

from math import pi, sqrt
from typing import Literal

from pydantic import Field

from magshell_fenicsx.parts.section import Section


class DimpleSection(Section):
    """w0 = -δ (1 - (φ/φo)²)² around the pole, within the colatitude φo."""

    kind: Literal["dimple"]
    amplitude: float = Field(ge=0, le=50)
    """Depth δ [h]"""
    width: float = Field(ge=0.05, le=50)
    """Half-width φ̄o = φo (√(12(1 - ν²)) R/h)^(1/2)"""

    def half_width(self, R_over_h: float, nu: float) -> float:
        """phi_o (rad)."""
        return self.width / sqrt(sqrt(12 * (1 - nu**2)) * R_over_h)

    def refuse_unfit(self, R_over_h: float, nu: float, edge: float) -> None:
        """See that a dimple fits on a sphere up to the polar angle `edge` (rad).

        Raises
        ------
        ValueError
            If it is too wide, too deep or too steep.
        """
        phi_o, depth = self.half_width(R_over_h, nu), self.amplitude / R_over_h
        if phi_o >= 0.9 * edge:
            raise ValueError(
                f"the dimple's half-width phi_o is {phi_o * 180 / pi:.1f} degrees at this R/h "
                f"and poisson_ratio; it must stay below {0.9 * edge * 180 / pi:.3g}"
            )
        if depth > 0.5:
            raise ValueError(f"the dimple is {depth:.2g} radii deep; it must stay below half a radius")
        slope = 8 / sqrt(27) * depth / phi_o  # largest |dw0/dphi| over R, at phi_o/sqrt(3)
        if slope > 2:
            raise ValueError(f"the dimple's steepest slope is {slope:.3g}: too steep for a shell, at most 2")

"""A Gaussian dimple."""

from math import exp, sqrt
from typing import ClassVar, Literal

from pydantic import Field

from magshell_fenicsx.case.imperfections.dimple import refuse_steep
from magshell_fenicsx.case.imperfections.place import At, ImperfectionSection, half_width


class GaussianSection(ImperfectionSection):
    """w0 = -δ exp(-(φ/φg)²) around a place, with the distance φ of a dimple; smooth everywhere."""

    parameters: ClassVar[tuple[str, ...]] = ("amplitude", "width", "at.polar", "at.azimuth")

    kind: Literal["gaussian"]
    amplitude: float = Field(ge=-50, le=50)
    """Depth δ, inwards; a bump is negative [h]"""
    width: float = Field(ge=0.05, le=50)
    """φg (√(12(1 - ν²)) R/h)^(1/2), as the half-width of a dimple"""
    at: At = At()
    """Its centre"""

    def half_width(self, R_over_h: float, nu: float) -> float:
        """phi_g (rad)."""
        return half_width(self.width, R_over_h, nu)

    def account(self) -> str:
        return f"Gaussian dimple of {self.amplitude:g} h {self.at.words()}"

    def refuse_unfit(self, R_over_h: float, nu: float) -> None:
        depth = abs(self.amplitude) / R_over_h
        refuse_steep("the dimple", depth, sqrt(2) * exp(-0.5) * depth / self.half_width(R_over_h, nu))

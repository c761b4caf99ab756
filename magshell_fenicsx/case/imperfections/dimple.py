"""The dimple of the paper."""

from math import pi, sqrt
from typing import Literal

from magshell_fenicsx.parts.imperfections.place import LocalSection


class DimpleSection(LocalSection):
    """w0 = -δ (1 - (φ/φo)²)² around a place, within the distance φo.

    On spheres φ is the angle from the place, at a pole of revolution the distance along the meridian over R,
    elsewhere the straight distance over R.
    """

    kind: Literal["dimple"]

    def account(self) -> str:
        return f"dimple of {self.amplitude:g} h {self.at.words()}"

    def refuse_unfit(self, R_over_h: float, nu: float) -> None:
        phi_o, depth = self.half_width(R_over_h, nu), abs(self.amplitude) / R_over_h
        if phi_o >= 0.9 * pi:
            raise ValueError(_wide(phi_o, 0.9 * pi))
        refuse_steep(depth, 8 / sqrt(27) * depth / phi_o)  # steepest at phi_o/sqrt(3)

    def refuse_wide(self, R_over_h: float, nu: float, edge: float) -> None:
        """See that it fits on a sphere up to the polar angle `edge` (rad).

        Raises
        ------
        ValueError
            If it is too wide.
        """
        if (phi_o := self.half_width(R_over_h, nu)) >= 0.9 * edge:
            raise ValueError(_wide(phi_o, 0.9 * edge))


def refuse_steep(depth: float, slope: float) -> None:
    """Refuse a local imperfection by its depth over R and its steepest slope."""
    if depth > 0.5:
        raise ValueError(f"the dimple is {depth:.2g} radii deep; it must stay below half a radius")
    if slope > 2:
        raise ValueError(f"the dimple's steepest slope is {slope:.3g}: too steep for a shell, at most 2")


def _wide(phi_o: float, most: float) -> str:
    return (
        f"the dimple's half-width phi_o is {phi_o * 180 / pi:.1f} degrees at this R/h "
        f"and poisson_ratio; it must stay below {most * 180 / pi:.3g}"
    )

"""The shell: geometry, thickness, material, defect."""

from math import pi, sqrt
from typing import Literal, Self

from pydantic import Field, model_validator

from magshell_fenicsx.case.base import Length, Pressure, Section
from magshell_fenicsx.case.defects import DimpleSection


class ShellSection(Section):
    """Either radius_to_thickness, or radius and thickness with units; a strip's radius is its length.

    Edges: equator (hemisphere), rim (disc), root (x = 0), tip and sides (strip).
    """

    geometry: Literal["hemisphere", "disc", "strip"]
    """A hemisphere around e3, a flat disc or a flat strip along e1"""
    radius_to_thickness: float | None = Field(default=None, ge=10, le=1e5)
    """R/h, in place of radius and thickness"""
    radius: Length | None = Field(default=None, gt=0)
    """Radius R, between 10 and 1e5 thicknesses"""
    thickness: Length | None = Field(default=None, gt=0)
    """Thickness h"""
    youngs_modulus: Pressure | None = Field(default=None, ge=1, le=1e13)
    """Young's modulus E, 1 Pa to 1e13 Pa; only flux densities need it"""
    poisson_ratio: float = Field(gt=-1, le=0.5)
    """Poisson's ratio ν"""
    defect: DimpleSection | None = None
    """Of a hemisphere"""
    width: float | None = Field(default=None, gt=0, le=10)
    """Of a strip, which must have one [length of the strip]"""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        lengths = [self.radius, self.thickness]
        if self.radius_to_thickness is not None:
            if lengths != [None, None]:
                raise ValueError("give radius_to_thickness, or radius and thickness, not both")
        elif None in lengths:
            raise ValueError("give radius_to_thickness, or both radius and thickness")
        elif not 10 <= self.R_over_h <= 1e5:
            raise ValueError(f"radius/thickness is {self.R_over_h:.4g}; a thin shell needs 10 to 1e5")
        if (self.width is None) == (self.geometry == "strip"):
            raise ValueError("width (over the length) belongs to geometry: strip, and only to it")
        if self.defect and self.geometry != "hemisphere":
            raise ValueError("a dimple needs geometry: hemisphere")
        if self.defect and self.dimple_half_width >= 0.9 * pi / 2:
            raise ValueError(
                f"the dimple's half-width phi_o is {self.dimple_half_width * 180 / pi:.1f} degrees at this R/h "
                f"and poisson_ratio; it must stay below 81"
            )
        if self.defect and self.defect.amplitude > 0.5 * self.R_over_h:
            depth = self.defect.amplitude / self.R_over_h
            raise ValueError(f"the dimple is {depth:.2g} radii deep; it must stay below half a radius")
        if self.defect and self.dimple_slope > 2:
            raise ValueError(
                f"the dimple's steepest slope is {self.dimple_slope:.3g}: too steep for a shell, at most 2"
            )
        if self.width is not None and self.width * self.R_over_h < 1:
            raise ValueError(
                f"the strip is narrower than its thickness; width must be at least {1 / self.R_over_h:.4g}"
            )
        return self

    @property
    def R_over_h(self) -> float:
        if self.radius_to_thickness is not None:
            return self.radius_to_thickness
        assert self.radius
        assert self.thickness
        return self.radius / self.thickness

    @property
    def dimple_half_width(self) -> float:
        """phi_o (rad)."""
        assert self.defect
        return self.defect.width / sqrt(sqrt(12 * (1 - self.poisson_ratio**2)) * self.R_over_h)

    @property
    def dimple_slope(self) -> float:
        """Largest |dw0/dphi| over R, at phi_o/sqrt(3)."""
        assert self.defect
        return 8 / sqrt(27) * self.defect.amplitude / self.R_over_h / self.dimple_half_width

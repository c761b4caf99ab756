"""The magnetisation and the applied field."""

from math import pi
from typing import Literal, Self

from pydantic import Field, model_validator

from magshell_fenicsx.case.base import FluxDensity, Section

MU_0 = 4e-7 * pi  # T m/A


class Direction(Section):
    """Angles in degrees: polar from e3, azimuth from e1 about e3."""

    polar: float = 0.0
    azimuth: float = 0.0


class FluxVector(Direction):
    """A direction, with its magnitude where lambda_m is not given."""

    flux_density: FluxDensity | None = Field(default=None)


class MagneticSection(Section):
    """lambda_m, or both flux densities (and shell.youngs_modulus)."""

    energy: Literal["full", "first", "torque", "second", "second_consistent"] = "full"
    lambda_m: float | None = Field(default=None, ge=-10, le=10)
    remanent: FluxVector = FluxVector()
    applied: FluxVector = FluxVector()

    @model_validator(mode="after")
    def _one_amplitude(self) -> Self:
        densities = [self.remanent.flux_density, self.applied.flux_density]
        if self.lambda_m is not None and densities != [None, None]:
            raise ValueError("give lambda_m, or the flux densities of remanent and applied, not both")
        if self.lambda_m is None and None in densities:
            raise ValueError("give lambda_m, or remanent.flux_density and applied.flux_density")
        if self.remanent.flux_density == 0:
            raise ValueError("a remanence of length zero is no magnetisation: leave the section out")
        return self

    def amplitude(self, youngs_modulus: float | None) -> float:
        """lambda_m = |Br||Ba|/(mu_0 E)."""
        if self.lambda_m is not None:
            return self.lambda_m
        Br, Ba = self.remanent.flux_density, self.applied.flux_density
        assert Br is not None
        assert Ba is not None
        assert youngs_modulus
        return Br * Ba / (MU_0 * youngs_modulus)

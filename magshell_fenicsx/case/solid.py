"""What a solid needs besides the shell that it is the body of."""

from pydantic import Field

from magshell_fenicsx.input.section import Section


class SolidSection(Section):
    """Hexahedra of degree 2 through the thickness, and the compressibility that stands for poisson_ratio: 0.5."""

    layers: int = Field(default=1, ge=1, le=10)
    """Elements through the thickness"""
    bulk_to_shear: float = Field(default=100.0, ge=10, le=1e5)
    """κ/μ, in place of ν = 0.5 and only there"""

    def refuse_unfit(self, poisson_ratio: float) -> None:
        """Refuse a compressibility beside a ratio that says all."""
        if "bulk_to_shear" in self.model_fields_set and poisson_ratio != 0.5:
            raise ValueError(
                "solid.bulk_to_shear: takes the place of shell.poisson_ratio: 0.5; here that is "
                f"{poisson_ratio:g}, which says all"
            )

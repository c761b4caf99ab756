"""What a case says of its elements: those of its mid-surface, and what a solid needs besides."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from magshell_fenicsx.input.section import Section, or_number
from magshell_fenicsx.parts.part import Context

SOLID_DEGREE = 2


class MeshSection(Section):
    """The elements: C0 interior penalty on triangles, graded towards dimple, load and held edges."""

    degree: int = Field(default=4, ge=2, le=5)
    """Degree k of the displacement. Degree 2 locks; a solid has degree 2 and no other"""
    refinement: float = Field(default=1.0, ge=0.1, le=20)
    """Divides every element size; not of a mesh file"""
    size: Annotated[float, or_number("metre"), Field(gt=0, le=1e12)] | None = None
    """Element size everywhere; by default graded, away from loads and held edges at most 0.35 R [the shell's length]"""
    penalty: float | None = Field(default=None, ge=1e-3, le=1e9)
    """σ of the interior penalty; by default 5 k²"""
    tolerance: float | None = Field(default=None, ge=1e-6, le=0.1)
    """Relative error of the run's result; chooses degree and refinement, of a solid refinement and layers"""

    @model_validator(mode="after")
    def _tolerance_chooses_the_mesh(self) -> Self:
        if self.tolerance is not None and self.model_fields_set & {"degree", "refinement"}:
            raise ValueError("tolerance chooses degree and refinement: give it or them")
        return self

    def refuse_unfit_solid(self, *, read: bool) -> None:
        """Refuse what a solid does not have; `read` says that its elements are those of a file."""
        for key in self.model_fields_set & {"degree", "penalty"}:
            if key != "degree" or self.degree != SOLID_DEGREE:
                finer = "a file with smaller elements" if read else "mesh.refinement"
                raise ValueError(f"mesh.{key}: not of a solid, which has degree {SOLID_DEGREE}; {finer} makes it finer")


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


def mesh_of(context: Context) -> MeshSection:
    """The elements that are asked for."""
    return context.of(MeshSection) or MeshSection()


def degree_of(context: Context) -> int:
    """The degree of the displacement."""
    return SOLID_DEGREE if context.solid else mesh_of(context).degree

"""Sections of all mid-surfaces: the paper's shells, surfaces of revolution, plates and meshes.

The docstrings of sections and of their keys are the text of docs/case.md.

A section is a part of a case file, checked by pydantic; validators raise ValueError. R is the
reference length, h the thickness. Lengths of a case have units (texts such as "3 mm") or are plain
numbers; without any length, results are over R and forces over E R². An assembly is several shells
in one triangulation.
"""

from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    BeforeValidator,
    Field,
    ModelWrapValidatorHandler,
    ValidationInfo,
    model_validator,
)

from magshell_fenicsx.input.expressions import Formula
from magshell_fenicsx.input.section import (
    Density,
    FileKeys,
    Length,
    Pressure,
    Section,
    WithUnit,
    in_units,
    with_unit,
)
from magshell_fenicsx.mesh.multi_shell import MultiShellMesh
from magshell_fenicsx.parts.kinds import DimpleSection, ShellKeys
from magshell_fenicsx.parts.revolution_sections import (
    AnnulusSurface,
    CapSurface,
    CylinderSurface,
    Measure,
    RevolutionSurface,
    SurfaceSection,
    TorusSurface,
)


class PlateSurface(SurfaceSection):
    """0 <= x <= length, 0 <= y <= width; edges left, right (along y), bottom, top."""

    geometry: Literal["plate"]
    length: Measure
    """Along e1; the reference length R, which formulas and dimensionless results are over
    [length]"""
    width: Measure
    """Along e2 [length]"""

    @property
    def reference(self) -> float:
        return self.length


class MeshSurface(FileKeys, SurfaceSection):
    """A .msh file: physical groups of surfaces are patches, those of curves are edges.

    What a mesh must be, and how to make one: meshes/README.md.
    """

    has_patches: ClassVar[bool] = True
    geometry: Literal["mesh"]
    file: str
    """Its path from the folder of the case; triangles of order 1 to 3"""
    radius: Measure
    """Reference length R, which formulas and dimensionless results are over [length]"""
    unit: (
        Annotated[float, BeforeValidator(in_units("metre", bare=True), json_schema_input_type=str)]
        | None
    ) = None
    """Unit of the file's coordinates, such as mm; goes with lengths that have units"""

    @model_validator(mode="before")
    @classmethod
    def _unit_of_the_file(cls, data: Any) -> Any:
        """Refuse a unit of the file without units of lengths, and the reverse."""
        if isinstance(data, dict) and isinstance(data.get("thickness"), str) != ("unit" in data):
            raise ValueError(
                "unit (of the file's coordinates, such as mm) goes with lengths that have units"
            )
        return data

    @property
    def reference(self) -> float:
        return self.radius

    @property
    def assembly(self) -> MultiShellMesh | None:
        """Several shells that stand in place of the file; None of a file."""
        in_memory = self.files.given.get(self.path)
        return in_memory if isinstance(in_memory, MultiShellMesh) else None


FLAT_GEOMETRIES = ("disc", "strip", "plate", "annulus")  # geometries
Surface = (
    CapSurface
    | CylinderSurface
    | PlateSurface
    | AnnulusSurface
    | TorusSurface
    | RevolutionSurface
    | MeshSurface
)


def _over_the_length(value: Any, info: ValidationInfo) -> Any:
    """Return the width of a strip over its length: a number unchanged, or text with a unit."""
    if not isinstance(value, str):
        return value
    radius = info.data.get("radius")
    if radius is None:
        raise ValueError(
            "a width with a unit needs radius and thickness with units; a number is over the length"
        )
    return in_units("metre")(value) / radius


class OneShape(Section):
    """Shape, thickness and material."""

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
    density: Density | None = Field(default=None, gt=0)
    """Density ρ; with it frequencies are in hertz"""
    thickness_factor: Formula | None = None
    """Multiplies h: a formula of x, y, z over R"""
    defect: DimpleSection | None = None
    """One dimple of a hemisphere; for more, or elsewhere, see imperfections"""
    width: (
        Annotated[
            float,
            WithUnit(
                _over_the_length,
                json_schema_input_type=Annotated[float, Field(gt=0, le=10)] | with_unit("metre"),
                unit="metre",
            ),
        ]
        | None
    ) = Field(default=None, gt=0, le=10)
    """Of a strip, which must have one: a number is over its length [length of the strip]"""


class ShellSection(ShellKeys, OneShape):
    """Either radius_to_thickness, or radius and thickness with units; a strip's radius is its
    length.

    Without units lengths are over R, forces over E R².

    Edges: equator (hemisphere), rim (disc), root (x = 0), tip and sides (strip).
    """

    @model_validator(mode="wrap")
    @classmethod
    def _imperfections_with_units(
        cls, data: Any, handler: ModelWrapValidatorHandler[Self], info: ValidationInfo
    ) -> Self:
        """Refuse radius and thickness as plain numbers; note the unit for imperfections.

        Pydantic calls it with the raw `data`; `handler` makes the section of them.
        """
        sizes = [data.get(key) for key in ("radius", "thickness")] if isinstance(data, dict) else []
        numbers = [size for size in sizes if isinstance(size, int | float) and size > 0]
        if len(numbers) == 2:
            ratio = f"{numbers[0] / numbers[1]:.12g}"
            raise ValueError(
                "radius and thickness: give each a unit, "
                f"or radius_to_thickness: {ratio} in their place"
            )
        cls.note_sizes(
            data,
            handler,
            info,
            with_units=isinstance(data, dict) and data.get("thickness") is not None,
        )
        return handler(data)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        """Refuse keys that contradict each other or the geometry, with a ValueError."""
        lengths = [self.radius, self.thickness]
        if self.radius_to_thickness is not None:
            if lengths != [None, None]:
                raise ValueError("give radius_to_thickness, or radius and thickness, not both")
        elif None in lengths:
            raise ValueError("give radius_to_thickness, or both radius and thickness")
        elif not 10 <= self.R_over_h <= 1e5:
            raise ValueError(
                f"radius/thickness is {self.R_over_h:.4g}; a thin shell needs 10 to 1e5"
            )
        if (self.width is None) == (self.geometry == "strip"):
            raise ValueError("width (over the length) belongs to geometry: strip, and only to it")
        has_no_units = self.youngs_modulus is None or self.radius is None
        if self.density is not None and has_no_units:
            raise ValueError(
                "density turns frequencies into hertz: "
                "that needs youngs_modulus, radius and thickness"
            )
        if self.defect and self.geometry != "hemisphere":
            raise ValueError("a defect needs geometry: hemisphere; elsewhere give imperfections")
        if self.width is not None and self.width * self.R_over_h < 1:
            raise ValueError(
                "the strip is narrower than its thickness; "
                f"width must be at least {1 / self.R_over_h:.4g}"
            )
        return self

    @property
    def R_over_h(self) -> float:
        """Radius over the thickness, given or computed."""
        if self.radius_to_thickness is not None:
            return self.radius_to_thickness
        assert self.radius
        assert self.thickness
        return self.radius / self.thickness

    @property
    def edge_polar(self) -> float | None:
        """Angle of the edge of a part of a sphere from e3 (degrees); None of other geometries."""
        return 90.0 if self.geometry == "hemisphere" else None

    @property
    def reference(self) -> float:
        """R in the unit of the case, or 1 without lengths: those of points are then over R."""
        return self.radius or 1.0

    @property
    def with_units(self) -> bool:
        """Whether lengths have units, and are in metres."""
        return self.radius is not None

    @property
    def modulus(self) -> float | None:
        """E that dead loads are over; 1 of a case without lengths: forces are then over E R²."""
        return self.youngs_modulus if self.with_units else 1.0

"""Sections of surfaces of revolution about e3: caps, cylinders, rings, tori and profiles.

Here are also the keys that all mid-surfaces share. Lengths are plain numbers of one unit that the
user chooses, or all have units and are then in metres. The same holds for Young's modulus, so that
loads and results are in the user's units or in SI. The docstrings of sections and of their keys are
the text of docs/case.md.

A section is a part of a case file, checked by pydantic; validators raise ValueError. R is the
reference length, h the thickness. A profile is a curve (r, z) over R that is turned about e3; its
ends are edges of the surface or, on the axis, a pole. Azimuths are around e3, polar angles from it.
An edge's name is None where the profile ends in the pole.
"""

from math import pi, radians
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, TypeAlias

import numpy as np
from pydantic import Field, ModelWrapValidatorHandler, PrivateAttr, ValidationInfo, model_validator

from magshell_fenicsx.input.expressions import Formula, formula
from magshell_fenicsx.input.section import (
    OrInMemory,
    Section,
    numbers_with_units,
    or_number,
)
from magshell_fenicsx.mesh.patch import UserField
from magshell_fenicsx.parts.kinds import DimpleSection, ShellKeys

if TYPE_CHECKING:
    from magshell_fenicsx.mesh.surfaces_of_revolution import Profile

Positive = Annotated[float, Field(gt=0)]
Measure = Annotated[float, or_number("metre", Positive), Field(gt=0)]
Modulus = Annotated[float, or_number("pascal", Positive), Field(gt=0)]
Range = Annotated[list[float], Field(min_length=2, max_length=2)]
Heights = Annotated[list[Annotated[float, or_number("metre")]], Field(min_length=2, max_length=2)]
Azimuth = Annotated[
    Range | None,
    Field(
        description="First and last, of a part, whose edges there are left and right; closed "
        "without [degree]"
    ),
]
FULL_TURN = [0.0, 360.0]  # degree
TUBE_SAMPLES = 721  # angles of the section of a tube
PROFILE_SAMPLES = 201  # of a formula
ON_AXIS = 1e-12  # over the largest radius: radii that are zero
MEASURES = (  # keys with units of a length, a stress or a density
    "thickness",
    "youngs_modulus",
    "density",
    "radius",
    "length",
    "width",
    "inner_radius",
    "tube_radius",
)


class MaterialSection(Section):
    """Thickness and material of every mid-surface."""

    thickness: Measure
    """Thickness h; R/h is 3 to 1e6 [length]"""
    youngs_modulus: Modulus | None = None
    """Young's modulus E; dead loads and flux densities need it [force/length²]"""
    poisson_ratio: float = Field(gt=-1, le=0.5)
    """Poisson's ratio ν"""
    density: Annotated[float, or_number("kilogram/metre**3", Positive), Field(gt=0)] | None = None
    """Density ρ; with it frequencies are in hertz [mass/length³]"""
    thickness_factor: Annotated[
        Formula | dict[str, Annotated[float, Field(gt=0, le=100)]] | UserField | None,
        OrInMemory(UserField),
    ] = None
    """Multiplies h: a formula of x, y, z over R, or of a mesh patch -> number"""


ProfileAndEdges: TypeAlias = "tuple[Profile, tuple[str, str | None]]"
"""The curve that is turned about e3, over R, and the names of its ends; None for a pole."""


class SurfaceSection(ShellKeys, MaterialSection):
    """The keys that all mid-surfaces have in common."""

    has_patches: ClassVar[bool] = False
    _with_units: bool = PrivateAttr(default=False)

    @model_validator(mode="wrap")
    @classmethod
    def _all_with_units_or_none(
        cls, data: Any, handler: ModelWrapValidatorHandler[Self], info: ValidationInfo
    ) -> Self:
        """Refuse a shell of which some lengths have units and others do not, with a ValueError.

        Pydantic calls it with the raw `data`; `handler` makes the section of them. It also sets
        `with_units`.
        """
        # values that are given with a unit are texts; all must be texts or none
        lengths = dict[str, Any]()
        if isinstance(data, dict):
            lengths = {key: data[key] for key in MEASURES if key in data}
        measured = {
            key: value for key, value in lengths.items() if isinstance(value, str | int | float)
        }
        are_texts = {isinstance(value, str) for value in measured.values()}
        all_or_none = "give every length and youngs_modulus a unit, or none of them"
        if len(are_texts) > 1:
            without_unit = [key for key, value in measured.items() if not isinstance(value, str)]
            raise ValueError(f"{all_or_none}: {', '.join(without_unit)} has none")
        cls.note_sizes(data, handler, info, with_units=are_texts == {True})
        section = handler(data)
        profile = getattr(section, "profile", None)
        if are_texts == {False} and [*numbers_with_units(profile, data.get("profile"), "profile")]:
            raise ValueError(f"{all_or_none}: {', '.join(measured)} has none")
        modulus = section.youngs_modulus
        is_modulus_allowed = modulus is None or 1 <= modulus <= 1e13
        if are_texts == {True} and not is_modulus_allowed:
            raise ValueError(
                f"shell.youngs_modulus: {lengths['youngs_modulus']!r}: "
                "allowed are 1 Pa to 1e13 Pa (MPa: megapascal, mPa: millipascal)"
            )
        if isinstance(data, dict):
            section._with_units = are_texts == {True}
        return section

    @model_validator(mode="after")
    def _thin(self) -> Self:
        """Refuse a shell that is not thin, and keys that do not fit, with a ValueError."""
        if not 3 <= self.R_over_h <= 1e6:
            raise ValueError(
                f"the reference length is {self.R_over_h:.4g} thicknesses; "
                "a thin shell needs 3 to 1e6"
            )
        if self.density is not None and self.youngs_modulus is None:
            raise ValueError("density turns frequencies into hertz: that needs youngs_modulus")
        if isinstance(self.thickness_factor, UserField) and self.thickness_factor.size != 1:
            raise ValueError(
                f"thickness_factor: a function of {self.thickness_factor.size} numbers; it has one"
            )
        if isinstance(self.thickness_factor, dict) and not self.has_patches:
            raise ValueError("thickness_factor: patches have names only with geometry: mesh")
        return self

    @property
    def edge_polar(self) -> float | None:
        """Angle of the edge of a part of a sphere from e3 (degrees); None of other geometries."""
        return None

    @property
    def with_units(self) -> bool:
        """Whether lengths and Young's modulus were given units, and are in SI."""
        return self._with_units

    @property
    def reference(self) -> float:
        """The length R that results and formulas are over."""
        raise NotImplementedError

    @property
    def R_over_h(self) -> float:
        """Reference length over the thickness."""
        return self.reference / self.thickness

    @property
    def modulus(self) -> float | None:
        """E that dead loads are over."""
        return self.youngs_modulus


def _refuse_azimuth(azimuth: list[float] | None) -> None:
    """Refuse first and last azimuth (degree) that do not grow, or overlap, with a ValueError."""
    first, last = azimuth or FULL_TURN
    if not 1e-3 <= last - first <= 360:
        raise ValueError(
            f"azimuth: from {first:g} to {last:g} degrees; it must grow, by at most 360"
        )


class RoundSection(SurfaceSection):
    """Has a radius; `azimuth` (degrees) is the part that there is, closed where it is not given."""

    radius: Measure
    """Reference length R, which formulas and dimensionless results are over [length]"""
    azimuth: Azimuth = None

    @model_validator(mode="after")
    def _turns_once(self) -> Self:
        _refuse_azimuth(self.azimuth)
        return self

    @property
    def reference(self) -> float:
        return self.radius

    @property
    def azimuth_range(self) -> tuple[float, float]:
        """First and last azimuth (rad)."""
        first, last = self.azimuth or FULL_TURN
        return radians(first), radians(last)

    @property
    def profile_and_edges(self) -> ProfileAndEdges:
        """The curve that is turned about e3, over R, and the names of its ends."""
        raise NotImplementedError

    @property
    def closed(self) -> bool:
        """Whether the curve ends where it begins."""
        return False


class CapSurface(RoundSection):
    """Sphere from `polar` (degrees from e3) up to the pole or a `hole`; edges rim, hole and, of a
    part, left, right.
    """

    geometry: Literal["cap"]
    polar: float = Field(default=90.0, ge=1, le=179)
    """Angle of the rim from e3 [degree]"""
    hole: float | None = Field(default=None, ge=0.1)
    """Angle of the hole's edge from e3 [degree]"""
    defect: DimpleSection | None = None
    """One dimple; for more see imperfections"""

    @model_validator(mode="after")
    def _hole_within(self) -> Self:
        """Refuse a hole that is not within the cap, and a part of a cap without one."""
        if self.hole is not None and self.hole >= self.polar - 0.1:
            raise ValueError(f"hole: {self.hole:g}: must be smaller than polar, {self.polar:g}")
        if self.hole is None and self.azimuth is not None:
            raise ValueError(
                "azimuth: a part of a cap needs a hole around the pole, such as hole: 1 (degree); "
                "or a mesh file of the part, with boundary: symmetry at its edges in mirror planes"
            )
        return self

    @property
    def edge_polar(self) -> float | None:
        return self.polar

    @property
    def profile_and_edges(self) -> ProfileAndEdges:
        """The arc from the rim to the hole, over R, and the names of its ends."""
        from magshell_fenicsx.mesh.surfaces_of_revolution import ArcProfile

        assert self.hole is not None
        # radius 1; angles from the equator upwards, to the hole's edge
        return ArcProfile(1.0, pi / 2 - radians(self.polar), pi / 2 - radians(self.hole)), (
            "rim",
            "hole",
        )


class CylinderSurface(RoundSection):
    """Around e3 from z = 0 to `length`, or a panel of it; edges bottom, top and, of a panel, left,
    right.
    """

    geometry: Literal["cylinder"]
    length: Measure
    """Along e3 [length]"""

    @property
    def profile_and_edges(self) -> ProfileAndEdges:
        """The line from bottom to top, over R, and the names of its ends."""
        from magshell_fenicsx.mesh.surfaces_of_revolution import StraightProfile

        return StraightProfile((1.0, 0.0), (1.0, self.length / self.radius)), ("bottom", "top")


class AnnulusSurface(RoundSection):
    """Flat ring; with azimuth: [0, 360] it is slit.

    Edges inner, outer and, where it is not closed, left, right.
    """

    geometry: Literal["annulus"]
    inner_radius: Measure
    """Smaller than the radius [length]"""

    @model_validator(mode="after")
    def _inner_within(self) -> Self:
        """Refuse an inner radius that is not smaller than the radius."""
        if self.inner_radius >= self.radius:
            raise ValueError(
                f"inner_radius: {self.inner_radius:g}: must be smaller than radius, {self.radius:g}"
            )
        return self

    @property
    def profile_and_edges(self) -> ProfileAndEdges:
        """The line from the outer to the inner edge, over R, and the names of its ends."""
        from magshell_fenicsx.mesh.surfaces_of_revolution import StraightProfile

        # inwards: the normal, to the right of a profile's direction, is e3
        return StraightProfile((1.0, 0.0), (self.inner_radius / self.radius, 0.0)), (
            "outer",
            "inner",
        )


class TorusSurface(RoundSection):
    """A tube around the circle of `radius`; `tube` (degrees, from outside towards e3) is the part
    of its section.

    Edges left, right and, with tube, bottom, top.
    """

    geometry: Literal["torus"]
    tube_radius: Measure
    """Of the tube's section [length]"""
    tube: Range | None = None
    """First and last angle of the tube's section; all of it without [degree]"""

    @model_validator(mode="after")
    def _hole_in_it(self) -> Self:
        """Refuse a tube that reaches the axis, or angles that do not grow."""
        first, last = self.tube or FULL_TURN
        if not 1e-3 <= last - first <= 360:
            raise ValueError(
                f"tube: from {first:g} to {last:g} degrees; it must grow, by at most 360"
            )
        angles = np.radians(np.linspace(first, last, TUBE_SAMPLES))
        least_radius = self.radius + self.tube_radius * np.cos(angles).min()
        if least_radius <= 0:
            raise ValueError(
                f"tube_radius: {self.tube_radius:g}: the tube reaches the axis; "
                f"radius is {self.radius:g}"
            )
        return self

    @property
    def profile_and_edges(self) -> ProfileAndEdges:
        """The arc of the tube's section, over R, and the names of its ends."""
        from magshell_fenicsx.mesh.surfaces_of_revolution import ArcProfile

        first, last = self.tube or FULL_TURN
        # about a centre at the radius 1 from e3
        return ArcProfile(self.tube_radius / self.radius, radians(first), radians(last), 1.0), (
            "bottom",
            "top",
        )

    @property
    def closed(self) -> bool:
        return self.tube is None


def _meets_axis_early(r: np.ndarray[Any, np.dtype[np.float64]]) -> bool:
    """Return whether a profile with these radii is on or beyond the axis, except at its end."""
    if r.max() <= 0 or r[-1] < 0:
        return True
    return bool((r[:-1] <= 0).any())


class ProfileSection(Section):
    """A smooth curve (r, z) through points, or r as a formula of z (in the case's lengths)."""

    points: list[Heights] | None = Field(default=None, min_length=2)
    """(r, z) that a spline goes through; two make a straight line [the shell's length]"""
    radius: Formula | None = None
    """r as a formula of z [the shell's length]"""
    heights: Heights | None = None
    """First and last z of the formula [the shell's length]"""

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        """Refuse a profile that is not given exactly once, or is no regular curve.

        It may reach the axis only at its end, and no two neighbouring points may be the same.
        """
        if (self.points is None) == (self.radius is None) or (self.radius is None) != (
            self.heights is None
        ):
            raise ValueError("give points, or radius (a formula of z) and heights")
        r = self.curve[:, 0]
        if not np.isfinite(self.curve).all() or _meets_axis_early(r):
            raise ValueError(
                "r must be positive along the profile; only its end may lie on the axis, as a pole"
            )
        if (np.linalg.norm(np.diff(self.curve, axis=0), axis=1) == 0).any():
            raise ValueError("two points that follow each other are the same")
        return self

    @property
    def curve(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Points (n, 2) that the curve goes through, (r, z) in the case's lengths."""
        if self.points is not None:
            return np.array(self.points)
        assert self.radius is not None
        assert self.heights is not None
        first, last = self.heights
        z = np.linspace(first, last, PROFILE_SAMPLES, dtype=np.float64)
        # formulas take x, y and z; only z may matter
        r = formula(self.radius)(0 * z, 0 * z, z)
        on_axis = np.abs(r) < ON_AXIS * np.abs(r).max()
        return np.column_stack([np.where(on_axis, 0.0, r), z])


class RevolutionSurface(SurfaceSection):
    """A profile turned about e3; the normal points to the right of its direction (outside, if it
    goes up).

    Edges bottom (its beginning), top (its end, if that is not the pole), left, right.
    """

    geometry: Literal["revolution"]
    profile: ProfileSection
    """The curve; its largest r is the reference length R"""
    azimuth: Azimuth = None
    defect: DimpleSection | None = None
    """One dimple; for more see imperfections"""

    @property
    def reference(self) -> float:
        """Largest radius of the profile."""
        return float(self.profile.curve[:, 0].max())

    @property
    def azimuth_range(self) -> tuple[float, float]:
        """First and last azimuth (rad)."""
        first, last = self.azimuth or FULL_TURN
        return radians(first), radians(last)

    @model_validator(mode="after")
    def _turns(self) -> Self:
        """Refuse azimuths that overlap, and a part of a surface with a pole."""
        _refuse_azimuth(self.azimuth)
        if self.azimuth is not None and self.profile.curve[-1, 0] == 0:
            raise ValueError("azimuth: a part of a surface with a pole cannot be built")
        return self

    @property
    def profile_and_edges(self) -> ProfileAndEdges:
        """The curve that is turned about e3, over R, and the names of its ends."""
        from magshell_fenicsx.mesh.surfaces_of_revolution import SplineProfile, StraightProfile

        curve = np.asarray(self.profile.curve / self.reference, dtype=np.float64)
        start, end = ((float(r), float(z)) for r, z in curve[:2])
        profile: Profile = StraightProfile(start, end) if len(curve) == 2 else SplineProfile(curve)
        return profile, ("bottom", None if curve[-1, 0] == 0 else "top")

    @property
    def closed(self) -> bool:
        """Whether the curve ends where it begins."""
        return False

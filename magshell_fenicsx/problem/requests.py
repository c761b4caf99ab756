"""Sections of what a case requests besides the path: modes, frequencies, gradients and pictures.

Their docstrings and those of their keys are the text of docs/case.md.
"""

from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag, field_validator

from magshell_fenicsx.input.section import Section


class StabilitySection(Section):
    """Lowest eigenpairs of the tangent, those that a reduced model excludes included.

    `at: end` is the last point of the path; `at: instabilities` every located fold and bifurcation.
    """

    modes: int = Field(default=4, ge=1, le=50)
    """How many of the lowest modes are drawn and written as fields"""
    at: Literal["end", "instabilities"] = "end"
    """At which points of the path"""


PathPoints = Annotated[
    Annotated[Literal["ends", "end", "all"], Tag("a word")]
    | Annotated[list[Annotated[int, Field(ge=0)]], Tag("points"), Field(min_length=1)],
    Discriminator(lambda data: "points" if isinstance(data, list) else "a word"),
]


class FrequenciesSection(Section):
    """Natural frequencies of small vibrations about points of the path, under the loads of each
    point.

    frequencies.csv lists ω² ρ R²/E, negative where the shell is unstable, and with `shell.density`
    hertz. A shell that nothing loads needs no support: its rigid motions are listed with ω² = 0.
    """

    count: int = Field(default=6, ge=1, le=50)
    """How many of the lowest; every unstable one is listed besides"""
    at: PathPoints = "ends"
    """At which points: the start and the end of the path, the end, all, or numbers of points in
    path.csv"""


class GradientsSection(Section):
    """Derivatives of results by numbers and by whole fields, of one adjoint solve for each result.

    Fields, per area of the undeformed shell: the remanence (vectors), its magnitude (a factor), the
    thickness (over h), the natural curvature (over 1/R, along t1 and t2 and its twist) and the
    deviation w0 of the shape (over R, along the normal). They are written as fields/gradients_*.vtu
    and drawn: where would more help most?
    """

    of: Annotated[list[str], Field(min_length=1)] = Field(default=["knockdown"])
    """Results: knockdown, critical_field (in units buckling_pressure_Pa, critical_field_mT),
    barrier, natural frequencies (omega2_1, ..., hertz_1, ...), or columns of path.csv where the
    path ends, such as force_N or forces of supports; where it ends at an instability, its load
    alone"""
    by: Annotated[list[str], Field(min_length=1)] = Field(default=["magnitude", "thickness"])
    """remanence, magnitude, thickness, curvature, deviation; amplitudes (lambda_m); keys of the
    case with a number, in SI if it has a unit"""


COLOURED_FIELDS = (  # fields with colours
    *("w_over_h", "E_1", "E_2", "M_1", "M_2"),
    *("stretch_1", "stretch_2", "stretch_3", "sigma_1", "sigma_2"),
    *("p_mag", "f_mag", "k", "tau", "couple", "gap_over_h", "contact_pressure"),
)
Range = Annotated[list[float], Field(min_length=2, max_length=2)]


class CameraSection(Section):
    """The direction from the shell to the eye; e3 points up in all pictures."""

    polar: float = Field(default=55.0, ge=1, le=179)
    """Angle from e3 [degrees]"""
    azimuth: float = -60.0
    """Angle around e3 from e1 [degrees]"""


class OutputSection(Section):
    """Pictures of a run, and shells for ParaView; `magshell plot` has the same keys as options.
    PNG files are always drawn."""

    formats: list[Literal["png", "svg", "pdf"]] = Field(default_factory=list)
    """Further formats: svg and pdf have text as text, and the shell as an image"""
    width: float | None = Field(default=None, ge=30, le=1000)
    """Of a picture; by default 90 with one panel, 180 with more [mm]"""
    dpi: int = Field(default=200, ge=50, le=1200)
    """Pixels per inch, also of the shell in svg and pdf"""
    font_size: float = Field(default=8.0, ge=3, le=40)
    """Of all text [points]"""
    camera: CameraSection | None = None
    """From where the shell is seen; by default from above, on the side of its largest
    displacement"""
    ranges: dict[str, Range] = Field(default_factory=dict)
    """Field -> values of the first and the last colour, over the field's unit (w over h) also in a
    case with units: w_over_h, E_1, E_2, M_1, M_2, stretch_1, stretch_2, stretch_3, sigma_1,
    sigma_2, p_mag, f_mag, k, tau, couple, gap_over_h, contact_pressure; by default those of the
    data"""
    whole: bool = False
    """With the pictures of a half shell, write the whole one at every point for ParaView:
    fields/whole.pvd"""

    @field_validator("ranges")
    @classmethod
    def _ranges_are_known(cls, ranges: dict[str, list[float]]) -> dict[str, list[float]]:
        """Check that ranges are those of fields with colours, with the smaller value first."""
        for name, (low, high) in ranges.items():
            if name not in COLOURED_FIELDS:
                raise ValueError(
                    f"{name}: no field with colours; there are {', '.join(COLOURED_FIELDS)}"
                )
            if not low < high:
                raise ValueError(f"{name}: the first value must be less than the second")
        return ranges

"""How pictures look: keys of the section `output`, and options of `magshell plot`."""

from typing import Annotated, Literal

from pydantic import Field, field_validator

from magshell_fenicsx.input.section import Section

DRAWN = (  # fields with colours
    *("w_over_h", "E_1", "E_2", "M_1", "M_2"),
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
    """Pictures of a run; `magshell plot` has the same keys as options. PNG files are always drawn."""

    formats: list[Literal["png", "svg", "pdf"]] = Field(default_factory=list)
    """Further formats: svg and pdf have text as text, and the shell as an image"""
    width: float | None = Field(default=None, ge=30, le=1000)
    """Of a picture; by default 90 with one panel, 180 with more [mm]"""
    dpi: int = Field(default=200, ge=50, le=1200)
    """Pixels per inch, also of the shell in svg and pdf"""
    font_size: float = Field(default=8.0, ge=3, le=40)
    """Of all text [points]"""
    camera: CameraSection | None = None
    """From where the shell is seen; by default from above, on the side of its largest displacement"""
    ranges: dict[str, Range] = Field(default_factory=dict)
    """Field -> values of the first and the last colour: w_over_h, E_1, E_2, M_1, M_2, p_mag, f_mag, k, tau, couple,
    gap_over_h, contact_pressure; by default those of the data"""

    @field_validator("ranges")
    @classmethod
    def _ranges_are_known(cls, ranges: dict[str, list[float]]) -> dict[str, list[float]]:
        for name, (low, high) in ranges.items():
            if name not in DRAWN:
                raise ValueError(f"{name}: no field with colours; there are {', '.join(DRAWN)}")
            if not low < high:
                raise ValueError(f"{name}: the first value must be less than the second")
        return ranges

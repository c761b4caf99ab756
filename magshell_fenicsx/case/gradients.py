"""Gradients after a run: of which results, by what."""

from typing import Annotated

from pydantic import Field

from magshell_fenicsx.input.section import Section

FIELDS = ("remanence", "magnitude", "thickness", "curvature", "deviation")


class GradientsSection(Section):
    """Derivatives of results by numbers and by whole fields, of one adjoint solve for each result.

    Fields, per area of the undeformed shell: the remanence (vectors), its magnitude (a factor), the thickness (over h),
    the natural curvature (over 1/R, along t1 and t2 and its twist) and the deviation w0 of the shape (over R, along the
    normal). They are written as fields/gradients_*.vtu and drawn: where would more help most?
    """

    of: Annotated[list[str], Field(min_length=1)] = Field(default=["knockdown"])
    """Results: knockdown, critical_field (in units buckling_pressure_Pa, critical_field_mT), barrier, natural
    frequencies (omega2_1, ..., hertz_1, ...), or columns of path.csv where the path ends, such as force_N or forces of
    supports; where it ends at an instability, its load alone"""
    by: Annotated[list[str], Field(min_length=1)] = Field(default=["magnitude", "thickness"])
    """remanence, magnitude, thickness, curvature, deviation; amplitudes (lambda_m); keys of the case with a number,
    in SI if it has a unit"""

"""The stability report: which modes, and where on the path."""

from typing import Literal

from pydantic import Field

from magshell_fenicsx.input.section import Section


class StabilitySection(Section):
    """Lowest eigenpairs of the tangent, those that a reduced model excludes included.

    `at: end` is the last point of the path; `at: instabilities` every located fold and bifurcation.
    """

    modes: int = Field(default=4, ge=1, le=50)
    """How many of the lowest modes are drawn and written as fields"""
    at: Literal["end", "instabilities"] = "end"
    """At which points of the path"""

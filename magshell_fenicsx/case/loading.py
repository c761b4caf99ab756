"""The mechanical load, applied after the field, and how it is controlled."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from magshell_fenicsx.case.base import Section
from magshell_fenicsx.case.fields import Direction


class PressureSection(Section):
    """Live pressure, p > 0 from outside."""

    kind: Literal["pressure"]
    control: Literal["volume", "load"] = "volume"
    until: Literal["limit", "target"] = "limit"
    pressure: float | None = Field(default=None, description="target p/p_c", ge=-1e3, le=1e3)
    volume_change: float | None = Field(default=None, description="target Delta V/R^3", ge=-5, le=5)
    points: int = Field(default=10, ge=1, le=10000)

    @model_validator(mode="after")
    def _target_fits_control(self) -> Self:
        wanted = {"load": "pressure", "volume": "volume_change"}[self.control]
        given = [key for key in ("pressure", "volume_change") if getattr(self, key) is not None]
        if self.until == "target" and given != [wanted]:
            raise ValueError(f"until: target with control: {self.control} needs {wanted} (and nothing else) as target")
        if self.until == "limit" and given:
            raise ValueError(f"{given[0]} is a target: it goes with until: target")
        return self


class IndentationSection(Section):
    """A dead force along the undeformed normal at one point."""

    kind: Literal["indentation"]
    at: Direction
    control: Literal["displacement", "load"] = "displacement"
    depth: float | None = Field(default=None, description="target w/h at the load", ge=-1e4, le=1e4)
    force: float | None = Field(default=None, description="target F R/(2 pi D)", ge=-1e6, le=1e6)
    points: int = Field(default=20, ge=1, le=10000)
    patch: float = Field(default=0.0, description="radius/h of the loaded patch, 0 for a point", ge=0, le=1000)

    @model_validator(mode="after")
    def _target_fits_control(self) -> Self:
        wanted, other = ("depth", "force") if self.control == "displacement" else ("force", "depth")
        if not getattr(self, wanted) or getattr(self, other) is not None:
            raise ValueError(f"control: {self.control} needs {wanted} (not zero), and no {other}")
        return self


class FieldSection(Section):
    """The field itself is the load: lambda_m from zero, with its instabilities located.

    `until: target` ends at magnetic.lambda_m; `until: limit` goes on in its direction to the first
    instability. control: conjugate follows the path through a fold of lambda_m.
    """

    kind: Literal["field"]
    control: Literal["conjugate", "load"] = "conjugate"
    until: Literal["limit", "target"] = "target"
    points: int = Field(default=10, ge=1, le=10000)

    @model_validator(mode="after")
    def _target_is_a_load(self) -> Self:
        if self.until == "target" and self.control != "load":
            raise ValueError("until: target needs control: load, for its target is lambda_m")
        return self


class RotationSection(Section):
    """The applied field, at its full magnitude, turns on the shortest way to another direction.

    The requested points are equal angles apart; between two of them the field moves along the chord.
    """

    kind: Literal["rotation"]
    to: Direction
    points: int = Field(default=12, ge=1, le=10000)


LoadingSection = Annotated[
    PressureSection | IndentationSection | FieldSection | RotationSection, Field(discriminator="kind")
]

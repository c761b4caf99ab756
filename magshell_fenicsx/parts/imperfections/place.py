"""Where a local imperfection is, and what all imperfections have in common."""

from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from magshell_fenicsx.input.direction import Direction
from magshell_fenicsx.input.section import Section, or_number, texts
from magshell_fenicsx.parts.imperfections.sized import half_width, over

Coordinates = Annotated[list[Annotated[float, or_number("metre")]], Field(min_length=3, max_length=3)]


class At(Direction):
    """A direction from the centre of a sphere, `polar: 0` of a pole or a centre; or a place of the perfect surface."""

    point: Coordinates | None = None
    """Place on the perfect surface, on any shape [the shell's length; over R if that has no unit]"""

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if self.point is not None and {"polar", "azimuth"} & self.model_fields_set:
            raise ValueError("give a point, or polar and azimuth")
        return self

    def words(self) -> str:
        """Where it is."""
        if self.point is not None:
            return f"at ({', '.join(f'{x:g}' for x in self.point)})"
        return f"at polar {self.polar:g}, azimuth {self.azimuth:g}" if self.polar else "at the pole"


class ImperfectionSection(Section):
    """Base of all kinds: w0 along the outward normal of the perfect surface."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Numbers that a knockdown factor is differentiated by, as paths of keys below the section."""
        return ("amplitude",)

    kind: str

    def account(self) -> str:
        """Its words in the account of what is built."""
        return self.kind

    def refuse_unfit(self, R_over_h: float, nu: float) -> None:
        """See that a shell can have it; raises ValueError otherwise."""


class LocalSection(ImperfectionSection):
    """Base of those around a place."""

    amplitude: Annotated[float, over("h")] = Field(ge=-50, le=50)
    """Depth δ, inwards; a bump is negative [h]"""
    width: Annotated[float, over("width")] = Field(ge=0.05, le=50)
    """Half-width φo of a dimple, φg of a Gaussian one, times (√(12(1 - ν²)) R/h)^(1/2); with a unit R φo, R φg"""
    at: At = At.model_construct()
    """Its centre"""

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("amplitude", "width", "at.polar", "at.azimuth")

    def half_width(self, R_over_h: float, nu: float) -> float:
        """Over R (rad)."""
        return half_width(self.width, R_over_h, nu)


def places_with_units(shell: dict[str, Any]) -> list[str]:
    """The keys of imperfections' places in plain data of a shell that are text with a unit."""
    items = shell.get("imperfections") or []
    points = {i: item["at"].get("point") for i, item in enumerate(items) if "at" in item}
    return [f"shell.imperfections.{i}.at.point" for i, point in points.items() if [*texts(point)]]

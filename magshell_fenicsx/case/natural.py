"""The natural shape: the curvature and the size that the shell would have without stress."""

import re
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from magshell_fenicsx.case.fields import Formula
from magshell_fenicsx.parts.section import _NUMBER, Section, in_units

_PER_LENGTH = re.compile(rf"\s*({_NUMBER})[\s*]*(?:/\s*|1\s*/\s*)([^\W\d]+)\s*|\s*({_NUMBER})[\s*]*([^\W\d]+)\s*(\*\*|\^)\s*-1\s*")


def per_length(value: Any) -> Any:
    """Text such as "5/m" or "5 m^-1" as a number in 1/m; all else, formulas too, as it is."""
    if not (isinstance(value, str) and (found := _PER_LENGTH.fullmatch(value))):
        return value
    number, unit = found[1] or found[4], found[3] or found[6]
    return value if unit in ("x", "y", "z", "pi") else in_units("1/metre")(f"{number} {unit}**-1")


Curvature = Annotated[Annotated[float, Field(ge=-1e9, le=1e9)] | Formula, BeforeValidator(per_length)]
Stretch = Annotated[float, Field(ge=0.05, le=20)]
Curvatures = Curvature | Annotated[list[Curvature], Field(min_length=3, max_length=3)]
Stretches = Stretch | Formula | Annotated[list[Stretch | Formula], Field(min_length=2, max_length=2)]


class NaturalSection(Section):
    """The curvature and the size that the shell would have without stress: growth, swelling, pre-stretch.

    Both grow with amplitudes of their own, natural_curvature and natural_stretch, from 0 (the shell as drawn) to 1 (what
    is given here) and beyond: a step of kind: natural drives one; without one, both grow to 1 before the field. Formulas
    are of the undeformed place x, y, z in the shell's length. A mapping has a value for each patch of a mesh, for the
    dimple, and for the rest.
    """

    curvature: Curvatures | dict[str, Curvatures] | None = None
    """In addition to the drawn one, per natural length, positive where the surface bends towards its normal: one number
    for all directions (a sphere), or k11, k22, k12 in the frame of `along` [1/length]"""
    stretch: Stretches | dict[str, Stretches] | None = None
    """Natural over drawn length: one number for all directions, the thickness too, or two along t1 and t2 of `along`,
    with the thickness as drawn"""
    along: Literal["meridian"] | Annotated[list[float | Formula], Field(min_length=3, max_length=3)] | None = None
    """t1 of the frame t1, t2 = n x t1: away from the pole on the meridians of e3, or the part in the surface of a
    vector; by default [1, 0, 0] of a strip, a plate and a mesh, meridian of all else"""

    @model_validator(mode="after")
    def _something_grows(self) -> Self:
        if self.curvature is None and self.stretch is None:
            raise ValueError("give curvature, stretch, or both")
        for key in ("curvature", "stretch"):
            of_patches = getattr(self, key)
            if isinstance(of_patches, dict):
                for name, value in of_patches.items():
                    if any(isinstance(v, str) for v in (value if isinstance(value, list) else [value])):
                        raise ValueError(f"{key}.{name}: of a patch numbers, no formulas")
        return self

    @property
    def formulas(self) -> list[str]:
        """Those of the curvature and the stretch."""
        return [text for value in (self.curvature, self.stretch) for text in components(value) if isinstance(text, str)]


def components(value: Any) -> list[float | str]:
    """The numbers and formulas of a curvature or stretch, none of patches."""
    return value if isinstance(value, list) else [] if value is None or isinstance(value, dict) else [value]


def measured(data: Any) -> list[str]:
    """The keys of plain data whose curvature has a unit."""
    def units(value: Any) -> bool:
        values = value.values() if isinstance(value, dict) else value if isinstance(value, list) else [value]
        return any(units(v) if isinstance(v, list) else per_length(v) is not v for v in values)

    return ["natural.curvature"] if isinstance(data, dict) and units(data.get("curvature")) else []

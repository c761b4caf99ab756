"""What all rigid bodies have in common."""

import re
from collections.abc import Iterator, Mapping
from math import inf
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from magshell_fenicsx.input.section import Section, or_number
from magshell_fenicsx.parts.imperfections.place import At, Coordinates
from magshell_fenicsx.quantities.registry import endings

Axis = Annotated[list[Annotated[float, Field(ge=-1e9, le=1e9)]], Field(min_length=3, max_length=3)]
Size = Annotated[float, or_number("metre"), Field(gt=0, le=1e9)]
LENGTHS = ("position", "radius", "edge", "size")


class BodySection(Section):
    """Base of all kinds: a rigid body without friction.

    It touches the shell's face, half a thickness from the mid-surface. `kind: contact` moves it; otherwise it stays.
    """

    kind: str
    at: At = At.model_construct()
    """Where it first touches; it gives `direction`, and without `position` the place: the front of the body touches
    the undeformed shell there"""
    side: Literal["outside", "inside"] = "outside"
    """The side of the shell that it is on"""
    direction: Axis | None = None
    """Of the approach; by default along the shell's normal at `at`, towards the shell"""
    position: Coordinates | None = None
    """Where it is at approach 0: a point of a plane, the centre of a sphere, cylinder or box, the middle of a rod's
    end [the shell's length; over R if that has no unit]"""
    stiffness: float | None = Field(default=None, gt=0, le=1e12)
    """k of the penalty k s²/2 per area of a penetration s; by default 1e6 D/(R² h²) of a plane, of another body of
    radius r 15 (1 + R/r) times as much, and four times as much each time that the penetration would exceed its bound
    [E h/R²]"""
    penetration: float = Field(default=1e-3, ge=1e-6, le=0.1)
    """Largest penetration that is allowed; with a given `stiffness` the run stops where it is more [h]"""

    @property
    def ahead(self) -> float:
        """How far its front is from its reference point, in the case's unit."""
        return 0.0

    @property
    def blunt(self) -> float:
        """Radius of what touches, in the case's unit; infinite for a plane."""
        return float(getattr(self, "radius", inf))

    @model_validator(mode="after")
    def _directions(self) -> Self:
        for key in ("direction", "axis"):
            given = getattr(self, key, None)
            if given is not None and not any(given):
                raise ValueError(f"{key}: must not be zero")
        return self


def refuse_unfit_bodies(bodies: Mapping[str, BodySection], *, solid: bool) -> None:
    """Refuse names, and bodies beside a solid."""
    for name in bodies:
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,39}", name):
            raise ValueError(f"bodies.{name}: a name is a letter, then letters, digits and _; at most 40")
        if name in endings():
            raise ValueError(f"bodies.{name}: is taken, by columns in this unit; choose another name")
    if bodies and solid:
        raise ValueError("bodies: press on a shell; of a solid give a force on a patch (kind: indentation, patch)")


def with_units(bodies: Mapping[str, Any] | None) -> Iterator[str]:
    """The keys of plain data of bodies that are text with a unit."""
    for name, body in (bodies or {}).items():
        data = {key: body.get(key) for key in LENGTHS} | {"at.point": (body.get("at") or {}).get("point")}
        for key, value in data.items():
            if any(isinstance(x, str) for x in (value if isinstance(value, list) else [value])):
                yield f"bodies.{name}.{key}"

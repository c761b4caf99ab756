"""Dead loads, which keep their direction."""

from math import copysign
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from magshell_fenicsx.case.loads.step import Count, Now, PathStep, Target, Until
from magshell_fenicsx.parts.section import Section, or_number

Finite = Annotated[float, Field(ge=-1e30, le=1e30)]
Moment = Annotated[float, or_number("newton", Finite), Field(ge=-1e30, le=1e30)]
DeadPressure = Annotated[float, or_number("pascal", Finite), Field(ge=-1e30, le=1e30)]
Three = Field(min_length=3, max_length=3)
Force = Annotated[list[Moment], Three]
PerLength = Annotated[list[Annotated[float, or_number("newton/metre", Finite), Field(ge=-1e30, le=1e30)]], Three]
PerArea = Annotated[list[DeadPressure], Three]


class DeadLoadSection(Section):
    """One load, at a point of `points`, on an edge, or over the surface, in the units of the shell's numbers.

    On an edge: `force` in all, `per_length`, or `moment` per length about the edge's first tangent, which turns
    with the edge. Over the surface (`over: all`, or a patch of a mesh): `per_area`, or `pressure` along the
    undeformed normal, positive from outside.
    """

    at: str | None = None
    """A point of `points`"""
    edge: str | None = None
    """An edge of the geometry"""
    over: str | None = None
    """all, or a patch of a mesh"""
    force: Force | None = None
    """At a point, or in all on an edge [force]"""
    per_length: PerLength | None = None
    """On an edge [force/length]"""
    moment: Moment | None = None
    """On an edge, about its tangent with the surface on its left; positive turns the normal outward [force]"""
    per_area: PerArea | None = None
    """Over the surface [force/length²]"""
    pressure: DeadPressure | None = None
    """Over the surface, against the undeformed normal [force/length²]"""

    @model_validator(mode="after")
    def _one_load_in_one_place(self) -> Self:
        fitting = {"at": ("force",), "edge": ("force", "per_length", "moment"), "over": ("per_area", "pressure")}
        places = [place for place in fitting if getattr(self, place) is not None]
        if len(places) != 1:
            raise ValueError(
                "a load is at a point, on an edge, or on a part of the surface: give one of at, edge, over"
            )
        quantities = {key for keys in fitting.values() for key in keys}
        given = sorted(key for key in quantities if getattr(self, key) is not None)
        if len(given) != 1 or given[0] not in fitting[places[0]]:
            raise ValueError(f"with {places[0]} goes one of {', '.join(fitting[places[0]])}")
        value = getattr(self, given[0])
        if not (any(value) if isinstance(value, list) else value):
            raise ValueError(f"{given[0]}: is zero")
        return self


class DeadSection(PathStep):
    """Loads that keep their direction and grow by a common factor.

    A target is the `factor`, or the `displacement` of the loads along themselves (their work over the sum of
    their sizes) in the units of the shell's lengths.
    """

    amplitude: ClassVar[str] = "load"
    conjugate: ClassVar[str] = "displacement along the loads"
    targets: ClassVar[dict[str, Target]] = {
        "factor": Target("load", "load_factor"),
        "displacement": Target("conjugate", "w_over_h"),
    }
    kind: Literal["dead"]
    loads: list[DeadLoadSection] = Field(min_length=1, max_length=1000)
    """At a factor of one"""
    control: Literal["load", "displacement", "arc"] = "arc"
    """What is prescribed step by step: the factor, the displacement, or arc length, which passes every fold"""
    until: Until = "target"
    factor: float | None = Field(default=None, ge=-1e9, le=1e9)
    """Target of the common factor; with control: load or arc"""
    displacement: Annotated[float, or_number("metre"), Field(ge=-1e9, le=1e9)] | None = None
    """Target of the displacement along the loads; with control: displacement or arc [the shell's length]"""
    points: Count = 20

    @model_validator(mode="after")
    def _moments_have_no_displacement(self) -> Self:
        if self.turns and (self.control == "displacement" or self.displacement is not None):
            raise ValueError("displacement: a moment has none; take control: arc or load with factor")
        if self.branches and self.turns:
            raise ValueError("branches: not with a moment, whose potential counts the turns along one path")
        return self

    @property
    def turns(self) -> bool:
        """Whether a moment is among the loads."""
        return any(load.moment is not None for load in self.loads)

    @property
    def place(self) -> Any:
        return self.loads

    def first(self, change: float, now: Now, *, by_load: bool) -> float:
        return change / self.points if by_load else copysign(1e-3, change)

    def step(self, change: float | None, now: Now) -> float | None:
        return abs(change) / self.points if self.control == "displacement" and change else None

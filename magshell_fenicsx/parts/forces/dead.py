"""Dead loads, which keep their direction."""

from math import copysign
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from magshell_fenicsx.input.expressions import Formula, is_formula
from magshell_fenicsx.input.section import Section, in_units, or_number
from magshell_fenicsx.parts.part import Setting
from magshell_fenicsx.parts.step import Count, Now, PathStep, ProgrammeStep, Target, Until

Finite = Annotated[float, Field(ge=-1e30, le=1e30)]
Moment = Annotated[float, or_number("newton", Finite), Field(ge=-1e30, le=1e30)]
Three = Field(min_length=3, max_length=3)
Force = Annotated[list[Moment], Three]
LARGEST = 1e30


def _or_formula(unit: str) -> Any:
    """A number, text with a unit, or a formula of x, y, z."""

    def read(value: Any) -> Any:
        if isinstance(value, str) and is_formula(value):
            return value
        found = in_units(unit)(value)
        if isinstance(found, bool) or not isinstance(found, int | float) or not abs(found) <= LARGEST:
            raise ValueError(f"{value!r}: allowed are numbers up to {LARGEST:g} in size, with a unit, and formulas")
        return found

    return BeforeValidator(read, json_schema_input_type=Finite | str)


Varying = float | str
PerLength = Annotated[list[Annotated[Varying, _or_formula("newton/metre")]], Three]
PerArea = Annotated[list[Annotated[Varying, _or_formula("pascal")]], Three]
VaryingPressure = Annotated[Varying, _or_formula("pascal")]


class DeadLoadSection(Section):
    """One load, at a point of `points`, on an edge, or over the surface, in the units of the shell's numbers.

    On an edge: `force` in all, `per_length`, or `moment` per length about the edge's first tangent, which turns
    with the edge. Over the surface (`over: all`, or a patch of a mesh): `per_area`, or `pressure` along the
    undeformed normal, positive from outside. What is per length or area may be a formula of the undeformed place
    x, y, z in the shell's length, such as "cos(2*arctan2(y, x))".
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
    pressure: VaryingPressure | None = None
    """Over the surface, against the undeformed normal [force/length²]"""
    potential: Formula | None = None
    """Over all: energy per undeformed area as a formula of the deformed place x, y, z in the shell's length, whose
    negative gradient is the force: gravity, springs, a field of force [force/length]"""

    @model_validator(mode="after")
    def _one_load_in_one_place(self) -> Self:
        fitting = {
            "at": ("force",),
            "edge": ("force", "per_length", "moment"),
            "over": ("per_area", "pressure", "potential"),
        }
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
        if self.potential is not None and self.over != "all":
            raise ValueError(f"potential: goes with over: all, not with {self.over}")
        return self

    @property
    def vector(self) -> list[Varying] | None:
        """Its components, if it has a direction in space."""
        return next((list(v) for v in (self.force, self.per_length, self.per_area) if v is not None), None)

    @property
    def varies(self) -> bool:
        """Whether it has a formula of the undeformed place."""
        return isinstance(self.pressure, str) or any(isinstance(v, str) for v in self.vector or [])


class DeadSection(PathStep):
    """Loads that keep their direction and grow by a common factor.

    A target is the `factor`, or the `displacement` of the loads along themselves (their work over the sum of
    their sizes) in the units of the shell's lengths.
    """

    amplitude: ClassVar[str] = "load"
    conjugate: ClassVar[str] = "displacement along the loads"
    measured: ClassVar[bool] = True
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
        if self.control == "displacement" or self.displacement is not None:
            for has, what in ((self.turns, "moment"), (self.by_place, "potential")):
                if has:
                    raise ValueError(f"displacement: a {what} has none; take control: arc or load with factor")
        if self.branches and self.turns:
            raise ValueError("branches: not with a moment, whose potential counts the turns along one path")
        return self

    @property
    def turns(self) -> bool:
        """Whether a moment is among the loads."""
        return any(load.moment is not None for load in self.loads)

    @property
    def by_place(self) -> bool:
        """Whether a potential is among the loads."""
        return any(load.potential is not None for load in self.loads)

    @property
    def place(self) -> Any:
        return self.loads

    @property
    def held_conjugate(self) -> bool:
        return not (self.turns or self.by_place)

    def refuse_unfit(self, step: ProgrammeStep, setting: Setting) -> None:
        setting.has_modulus("loads of kind: dead")
        for i, load in enumerate(self.loads):
            setting.has_point(f"{step.key}.loads.{i}.at", load.at)

    def first(self, change: float, now: Now, *, by_load: bool) -> float:
        return change / self.points if by_load else copysign(1e-3, change)

    def step(self, change: float | None, now: Now) -> float | None:
        return abs(change) / self.points if self.control == "displacement" and change else None

"""The mechanical load, applied after the field, how it is controlled, and where its path ends."""

from collections.abc import Mapping
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from magshell_fenicsx.case.fields import Direction
from magshell_fenicsx.parts.section import Section, or_number

Until = Annotated[
    Literal["limit", "bifurcation", "target", "points"],
    Field(
        description="Where the path ends: at the first instability (limit; past one that a half or a meridian excludes "
        "it goes on to the model's own, up to twice the load), at the first bifurcation, through folds, at the target, "
        "or after `points` steps by arc length"
    ),
]
Count = Annotated[int, Field(ge=1, le=10000, description="Equal parts to the target, each a row; or steps")]
LEAST_TARGET = 1e-9
Finite = Annotated[float, Field(ge=-1e30, le=1e30)]
Moment = Annotated[float, or_number("newton", Finite), Field(ge=-1e30, le=1e30)]
DeadPressure = Annotated[float, or_number("pascal", Finite), Field(ge=-1e30, le=1e30)]
Three = Field(min_length=3, max_length=3)
Force = Annotated[list[Moment], Three]
PerLength = Annotated[list[Annotated[float, or_number("newton/metre", Finite), Field(ge=-1e30, le=1e30)]], Three]
PerArea = Annotated[list[DeadPressure], Three]
Wanted = Mapping[str, tuple[str, ...]]  # control -> the targets that it can have


class PathSection(Section):
    """What every load that is followed along a path has in common."""

    until: Until
    points: Count = 10
    branches: bool = False
    """Follow both directions of the branch at the first bifurcation too, to the target or for `points` steps"""
    sensitivities: bool = False
    """Derive the load at the fold that ends the path by all other amplitudes, the defect and each patch's remanence"""

    def _check(self, control: str, until: Until, targets: Mapping[str, float | None], wanted: Wanted) -> None:
        """One target that fits the control with `until: target`, none elsewhere."""
        given, fitting = [key for key, value in targets.items() if value is not None], wanted[control]
        for key in given:
            if abs(targets[key] or 0.0) < LEAST_TARGET:
                raise ValueError(f"{key} is a target and must not be zero (at least {LEAST_TARGET:g} in size)")
        if until == "target" and (len(given) != 1 or given[0] not in fitting):
            names = " or ".join(fitting) or "another control"
            raise ValueError(f"until: target with control: {control} needs {names} (and nothing else) as target")
        if until in ("limit", "bifurcation") and given:
            raise ValueError(f"{given[0]} is a target: it goes with until: target")
        if until == "points" and control != "arc":
            raise ValueError("until: points counts steps by arc length: it goes with control: arc")


class PressureSection(PathSection):
    """Live pressure, which follows the surface; p > 0 from outside."""

    kind: Literal["pressure"]
    control: Literal["volume", "load", "arc"] = "volume"
    """What is prescribed step by step: ΔV, p, or arc length, which passes every fold. Beside a free edge no ΔV is
    conjugate to p: arc is then the default"""
    until: Until = "limit"
    pressure: float | None = Field(default=None, ge=-1e3, le=1e3)
    """Target p; with control: load or arc [p_c]"""
    volume_change: float | None = Field(default=None, ge=-5, le=5)
    """Target ΔV; with control: volume or arc [R³]"""

    @model_validator(mode="after")
    def _target_fits_control(self) -> Self:
        wanted = {"load": ("pressure",), "volume": ("volume_change",), "arc": ("pressure", "volume_change")}
        targets = {"pressure": self.pressure, "volume_change": self.volume_change}
        self._check(self.control, self.until, targets, wanted)
        return self


class Place(Direction):
    """A direction from the centre of a hemisphere or cap, `polar: 0` of a pole, centre or tip; or a named point."""

    point: str | None = None
    """Name of a point of `points`, on any geometry"""

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if self.point is not None and {"polar", "azimuth"} & self.model_fields_set:
            raise ValueError("give a point, or polar and azimuth")
        return self


class IndentationSection(PathSection):
    """A dead force along the undeformed normal at one place of the shell.

    F > 0 pushes in. With `until: points` a depth may be given that the mesh shall be fine enough for.
    """

    kind: Literal["indentation"]
    at: Place
    """Where the force is; on a hemisphere polar is below 89"""
    control: Literal["displacement", "load", "arc"] = "displacement"
    """What is prescribed step by step: w, F, or arc length, which passes every fold"""
    until: Until = "target"
    depth: float | None = Field(default=None, ge=-1e4, le=1e4)
    """Target w under the load; with control: displacement or arc [h]"""
    force: float | None = Field(default=None, ge=-1e6, le=1e6)
    """Target F; with control: load or arc [2πD/R]"""
    points: Count = 20
    patch: float = Field(default=0.0, ge=0, le=1000)
    """Radius of the patch that the force is spread over, from 0.3; 0 is a point [h]"""

    @model_validator(mode="after")
    def _target_fits_control(self) -> Self:
        wanted = {"load": ("force",), "displacement": ("depth",), "arc": ("depth", "force")}
        self._check(self.control, self.until, {"depth": self.depth, "force": self.force}, wanted)
        return self


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


class DeadSection(PathSection):
    """Loads that keep their direction and grow by a common factor.

    A target is the `factor`, or the `displacement` of the loads along themselves (their work over the sum of
    their sizes) in the units of the shell's lengths.
    """

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
    def _target_fits_control(self) -> Self:
        wanted = {"load": ("factor",), "displacement": ("displacement",), "arc": ("factor", "displacement")}
        self._check(self.control, self.until, {"factor": self.factor, "displacement": self.displacement}, wanted)
        if any(load.moment is not None for load in self.loads) and (
            self.control == "displacement" or self.displacement is not None
        ):
            raise ValueError("displacement: a moment has none; take control: arc or load with factor")
        if self.branches and any(load.moment is not None for load in self.loads):
            raise ValueError("branches: not with a moment, whose potential counts the turns along one path")
        return self


class FieldSection(PathSection):
    """The field itself is the load: lambda_m from zero, with its instabilities located.

    `until: target` ends at magnetic.lambda_m, the others go on in its direction. By default the path
    is followed by arc length, through folds of lambda_m.
    """

    kind: Literal["field"]
    control: Literal["load", "arc"] = "arc"
    """What is prescribed step by step: λ_m, or arc length, which passes its folds"""
    until: Until = "target"

    @model_validator(mode="after")
    def _steps_are_by_arc_length(self) -> Self:
        if self.until == "points" and self.control != "arc":
            raise ValueError("until: points counts steps by arc length: it goes with control: arc")
        return self


class RotationSection(Section):
    """The applied field, at its full magnitude, turns on the shortest way to another direction.

    The requested points are equal angles apart; the field keeps its magnitude.
    """

    kind: Literal["rotation"]
    to: Direction
    """Its last direction"""
    points: Annotated[int, Field(ge=1, le=10000)] = 12
    """Equal angles to it"""


LoadingSection = Annotated[
    PressureSection | IndentationSection | FieldSection | RotationSection | DeadSection, Field(discriminator="kind")
]

"""A force that pushes on one place."""

from math import copysign
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from magshell_fenicsx.input.direction import Direction
from magshell_fenicsx.input.targets import over
from magshell_fenicsx.parts.part import Setting
from magshell_fenicsx.parts.step import Count, Now, PathStep, ProgrammeStep, Target, Until
from magshell_fenicsx.quantities.units import POINT_FORCE, THICKNESS

LEAST_HUMP = 0.01  # F of the first step towards the top of an energy barrier


class Place(Direction):
    """A direction from the centre of a hemisphere or cap, `polar: 0` of a pole, centre or tip; or a named point."""

    point: str | None = None
    """Name of a point of `points`, on any geometry"""

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if self.point is not None and {"polar", "azimuth"} & self.model_fields_set:
            raise ValueError("give a point, or polar and azimuth")
        return self


class IndentationSection(PathStep):
    """A dead force along the undeformed normal at one place of the shell.

    F > 0 pushes in. With `until: points` a depth may be given that the mesh shall be fine enough for.
    """

    amplitude: ClassVar[str] = "force"
    conjugate: ClassVar[str] = "displacement under the force"
    targets: ClassVar[dict[str, Target]] = {
        "depth": Target("conjugate", "w_over_h"),
        "force": Target("load", "force"),
    }
    kind: Literal["indentation"]
    at: Place = Place()
    """Where the force is, by default the pole or the centre; on a hemisphere polar is below 89"""
    control: Literal["displacement", "load", "arc"] = "displacement"
    """What is prescribed step by step: w, F, or arc length, which passes every fold; the default is load with a target
    `force`"""
    until: Until = "target"
    depth: Annotated[float, over(THICKNESS)] | None = Field(default=None, ge=-1e4, le=1e4)
    """Target w under the load; with control: displacement or arc [h]"""
    force: Annotated[float, over(POINT_FORCE)] | None = Field(default=None, ge=-1e6, le=1e6)
    """Target F; with control: load or arc [2πD/R]"""
    points: Count = 20
    patch: Annotated[float, over(THICKNESS)] = Field(default=0.0, ge=0, le=1000)
    """Radius of the patch that the force is spread over, from 0.3; 0 is a point [h]"""

    @property
    def place(self) -> Any:
        return self.at, self.patch

    def refuse_unfit(self, step: ProgrammeStep, setting: Setting) -> None:
        setting.on_shell(step.key, self.at.polar)
        setting.has_point(f"{step.key}.at.point", self.at.point)
        if setting.solid and not self.patch:
            raise ValueError(
                "loading.patch: 0: a point force sinks into a solid without limit; give the patch its radius over h "
                "(of the paper's indenter, 0.2 mm at R = 25.2 mm, with R/h = 90: 0.714)"
            )

    def first(self, change: float, now: Now, *, by_load: bool) -> float:
        if self.until == "zero":
            return LEAST_HUMP
        return change / self.points if self.control == "load" else copysign(1.0, change)

    def step(self, change: float | None, now: Now) -> float | None:
        return now.unit if self.control == "displacement" else None

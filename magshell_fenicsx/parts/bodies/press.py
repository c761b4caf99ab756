"""A rigid body that presses on the shell."""

from math import copysign
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from magshell_fenicsx.input.targets import over
from magshell_fenicsx.parts.step import Control, Count, Now, PathStep, Target, Until
from magshell_fenicsx.parts.supports.motion import Name
from magshell_fenicsx.quantities.units import POINT_FORCE, THICKNESS

FIRST = 0.1  # of h: the first step of the approach towards a force


class ContactSection(PathStep):
    """A body of `bodies` that approaches the shell along its direction, without friction.

    The conjugate of the approach is the force on the body. Free flight up to the first contact is one step.
    """

    conjugate: ClassVar[str] = "force on the body"
    conjugate_control: ClassVar[str] = "force"
    targets: ClassVar[dict[str, Target]] = {
        "approach": Target("load", "approach_over_h"),
        "force": Target("conjugate", "force"),
    }
    kind: Literal["contact"]
    body: Name | None = None
    """Its name in `bodies`; not needed if there is one"""
    control: Literal["approach", "force", "arc"] = "arc"
    """What is prescribed step by step: the approach, the force, or arc length, which passes every fold"""
    until: Until = "target"
    approach: Annotated[float, over(THICKNESS)] | None = Field(default=None, ge=-1e6, le=1e6)
    """Target of the approach, from where the body is at first; with control: approach or arc [h]"""
    force: Annotated[float, over(POINT_FORCE)] | None = Field(default=None, ge=-1e6, le=1e6)
    """Target of the force on the body; with control: force or arc [2πD/R]"""
    points: Count = 20

    @property
    def amplitude(self) -> str:  # type: ignore[override]  # each body has an amplitude of its own
        return f"approach_{self.body}" if self.body else "approach"

    @property
    def place(self) -> Any:
        return self.body

    @property
    def prescribed(self) -> Control:
        return "load" if self.control == "approach" else super().prescribed

    def first(self, change: float, now: Now, *, by_load: bool) -> float:
        return change / self.points if by_load else copysign(FIRST, -change)

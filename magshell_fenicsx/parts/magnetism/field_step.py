"""The applied field as a load: its strength and its direction."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from magshell_fenicsx.input.direction import Direction
from magshell_fenicsx.parts.step import Drive, Now, PathStep, Step, Target, Until


class FieldSection(PathStep):
    """The field itself is the load: lambda_m from zero, with its instabilities located.

    `until: target` ends at the field of `magnetic` or its `factor`, the others go on in its direction. By default the
    path is followed by arc length, through folds of lambda_m.
    """

    amplitude: ClassVar[str] = "lambda_m"
    targets: ClassVar[dict[str, Target]] = {"factor": Target("load", "lambda_m")}
    kind: Literal["field"]
    control: Literal["load", "arc"] = "arc"
    """What is prescribed step by step: λ_m, or arc length, which passes its folds"""
    until: Until = "target"
    factor: float | None = Field(default=None, ge=-1e3, le=1e3)
    """Target over the field of `magnetic`; 1 by default, 0 switches the field off"""

    @property
    def _end(self) -> float | None:
        return 1.0

    def scale(self, now: Now) -> float:
        return now.size


class FieldBefore(FieldSection):
    """The field that is applied before the one load of a case; it ends at the first instability."""

    def drive(self, now: Now) -> Drive:
        return Drive("arc", "load", now.size, [now.size], now.size / 2, now.size)


class RotationSection(Step):
    """The applied field, at its magnitude, turns on the shortest way to another direction.

    The requested points are equal angles apart; the field keeps its magnitude. A gradient, formulas and sources turn
    with it, about the origin; the direction of formulas, and of sources that are the whole field, is e3 at first.
    """

    amplitude: ClassVar[str] = "angle"
    kind: Literal["rotation"]
    to: Direction
    """Its last direction"""
    points: Annotated[int, Field(ge=1, le=10000)] = 12
    """Equal angles to it"""

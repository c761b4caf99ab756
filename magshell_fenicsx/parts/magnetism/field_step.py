"""The applied field as a load: its strength and its direction."""

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.input.section import Direction
from magshell_fenicsx.parts.magnetism.fields import MagneticSection, strength
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.step import Drive, Now, PathStep, ProgrammeStep, Step, Target, Until
from magshell_fenicsx.shape.symmetry import Leaves

if TYPE_CHECKING:
    from magshell_fenicsx.shape.outline import Outline

SAME = 1e-9  # cosine of directions: rounding


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

    @classmethod
    def before(cls, context: Context, loading: Step | None) -> list[tuple[str, Step]]:
        driven = loading is not None and cls.amplitude in (loading.amplitude, *loading.drives)
        return [] if driven or not strength(context) else [("magnetic", FieldBefore(kind="field"))]

    def refuse_unfit(self, step: ProgrammeStep, context: Context) -> None:
        if not strength(context):
            raise ValueError(f"{step.key}.kind: field needs magnetic.lambda_m, not zero, for its target or direction")


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
    holdable: ClassVar[bool] = False
    kind: Literal["rotation"]
    to: Direction
    """Its last direction"""
    points: Annotated[int, Field(ge=1, le=10000)] = 12
    """Equal angles to it"""

    def refuse_unfit(self, step: ProgrammeStep, context: Context) -> None:
        before = direction_before(step.number, context)
        if before is None or not strength(context):
            raise ValueError(f"{step.key}.kind: rotation needs a field: magnetic.lambda_m, not zero")
        driven = context.driven_before(step.number)
        if context.whole and FieldSection.amplitude not in driven:
            raise ValueError(f"{step.key}.kind: rotation needs a field: a step of kind: field before it")
        if abs(before @ self.to.vector()) > 1 - SAME:
            where = "the field at its beginning" if self.amplitude in driven else "magnetic.applied"
            raise ValueError(f"{step.key}.to: must be neither parallel nor opposite to {where}")

    def leaves(self, step: ProgrammeStep, context: Context, outline: "Outline") -> list[Leaves]:
        return [Leaves("the field turns", [self.to.vector()])]


def direction_before(number: int, context: Context) -> NDArray[np.float64] | None:
    """The unit vector (3,) of the field where a step begins; None without a field."""
    turned = [step.load.to for step in context.before(number) if isinstance(step.load, RotationSection)]
    if turned:
        return turned[-1].vector()
    magnetic = context.of(MagneticSection)
    return magnetic.applied.vector() if magnetic else None

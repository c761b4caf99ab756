"""A source of the applied field as a load: its place, its angle or its strength changes."""

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.parts.course import Now, Target, Until
from magshell_fenicsx.parts.magnetism.field_step import FieldSection
from magshell_fenicsx.parts.magnetism.fields import MagneticSection
from magshell_fenicsx.parts.magnetism.sources.source import SourceSection
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.step import Count, PathStep, ProgrammeStep
from magshell_fenicsx.parts.supports.motion import Finite, Lengths, Name
from magshell_fenicsx.quantities.registry import QUANTITIES, TAKEN


class SpinSection(Section):
    """A rotation of a source about an axis through its position, wherever that is."""

    axis: Annotated[list[Finite], Field(min_length=3, max_length=3)]
    """Along it, of any length"""
    angle: float = Field(ge=-36000, le=36000)
    """By the right-hand rule [degrees]"""

    @model_validator(mode="after")
    def _there_is_one(self) -> Self:
        if not any(self.axis) or not self.angle:
            raise ValueError("axis and angle must not be zero")
        return self


class SourceStep(PathStep):
    """A source moves, turns or becomes stronger, in proportion to a factor.

    Its conjugate is the force of the shell on the source along the motion, the torque about the axis, or, of the
    strength, minus the derivative of the energy by it. Later steps may drive the same source again, from where it is
    then. The field must be there: a step of kind: field before, in a list of steps.
    """

    conjugate: ClassVar[str] = "force on the source"
    targets: ClassVar[dict[str, Target]] = {"factor": Target("load", "source")}
    kind: Literal["source"]
    name: Name = "source"
    """Name of the factor, which is its column in path.csv"""
    source: int | str = 0
    """Name of the source, or its number in magnetic.applied.sources, from 0"""
    move: Lengths | None = None
    """Translation for a factor of one [m]"""
    to: Lengths | None = None
    """The same by its end: the position for a factor of one, of a source that no other step moves [m]"""
    turn: SpinSection | None = None
    """Rotation for a factor of one"""
    strength: float | None = Field(default=None, ge=-1e6, le=1e6)
    """Factor of the field for a factor of one, from 1"""
    control: Literal["load", "arc"] = "arc"
    """What is prescribed step by step: the factor, or arc length, which passes every fold"""
    until: Until = "target"
    factor: float | None = Field(default=None, ge=-1e9, le=1e9)
    """Target of the factor, 1 by default"""
    points: Count = 10

    @model_validator(mode="after")
    def _one_change(self) -> Self:
        given = [key for key in ("move", "to", "turn", "strength") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError("give one of move, to, turn and strength")
        if self.strength == 1 or (self.move and not any(self.move)):
            raise ValueError(f"{given[0]}: changes nothing")
        if self.name in ({*TAKEN, *QUANTITIES} - {"source"}):
            raise ValueError(f"name: {self.name}: is taken; choose another name for the factor of the source")
        return self

    @property
    def amplitude(self) -> str:  # type: ignore[override]  # each has a name of its own
        return self.name

    @property
    def place(self) -> Any:
        return self.source, self.move, self.to, self.turn, self.strength

    @property
    def _end(self) -> float | None:
        return 1.0

    def scale(self, now: Now) -> float:
        return abs(self.factor or 1.0)

    def number(self, sources: Sequence[SourceSection]) -> int | None:
        """The number of its source; None if there is no such source."""
        if isinstance(self.source, int):
            return self.source if 0 <= self.source < len(sources) else None
        return next((i for i, one in enumerate(sources) if one.name == self.source), None)

    def refuse_unfit(self, step: ProgrammeStep, context: Context) -> None:
        magnetic, key = context.of(MagneticSection), step.key
        sources = (magnetic.applied.sources if magnetic else None) or []
        if self.number(sources) is None:
            names = [one.name or str(i) for i, one in enumerate(sources)]
            raise ValueError(
                f"{key}.source: {self.source}: magnetic.applied.sources has no such source; allowed: "
                f"{', '.join(names) or 'none'}"
            )
        if context.whole and FieldSection.amplitude not in context.driven_before(step.number):
            raise ValueError(f"{key}.kind: source needs the field of its source: a step of kind: field before it")
        loads = (each for each in context.steps if each.name != step.name)
        others = [each.load for each in loads if isinstance(each.load, SourceStep)]
        same = (other for other in others if other.number(sources) == self.number(sources))
        if self.to and any(other.move or other.to for other in same):
            raise ValueError(f"{key}.to: another step moves the same source: give move")

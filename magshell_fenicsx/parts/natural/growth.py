"""The natural shape as a load: its curvature or its stretch grows."""

from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from magshell_fenicsx.parts.course import Target, Until
from magshell_fenicsx.parts.natural.section import NaturalSection
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.step import PathStep, ProgrammeStep, Step


class GrowthSection(PathStep):
    """The natural shape grows from the drawn one: the factor of `natural.curvature`, or of `natural.stretch` less one.

    `until: target` ends at a factor, the others need `grows`.
    """

    targets: ClassVar[dict[str, Target]] = {
        "curvature": Target("load", "natural_curvature"),
        "stretch": Target("load", "natural_stretch"),
    }
    kind: Literal["natural"]
    control: Literal["load", "arc"] = "arc"
    """What is prescribed step by step: the factor, or arc length, which passes its folds"""
    until: Until = "target"
    grows: Literal["curvature", "stretch"] | None = None
    """What grows, where no target says it"""
    curvature: float | None = Field(default=None, ge=-1e3, le=1e3)
    """Target of the factor of natural.curvature"""
    stretch: float | None = Field(default=None, ge=-1e3, le=1e3)
    """Target of the factor of natural.stretch less one"""

    @model_validator(mode="after")
    def _one_grows(self) -> Self:
        said = {self.grows, *self._given} - {None}
        if len(said) != 1:
            raise ValueError("give curvature or stretch, the factor that it grows to, or without a target grows")
        return self

    @property
    def key(self) -> str:
        """The key of `natural` that grows."""
        return self.grows or "".join(self._given)

    @property
    def amplitude(self) -> str:  # type: ignore[override]
        return f"natural_{self.key}"

    @classmethod
    def before(cls, context: Context, loading: Step | None) -> list[tuple[str, Step]]:
        natural = context.of(NaturalSection)
        if isinstance(loading, cls) or natural is None:
            return []
        keys = [key for key in ("stretch", "curvature") if getattr(natural, key) is not None]
        return [("natural", cls.model_validate({"kind": "natural", key: 1.0})) for key in keys]

    def refuse_unfit(self, step: ProgrammeStep, context: Context) -> None:
        if getattr(context.of(NaturalSection), self.key, None) is None:
            raise ValueError(f"loading.{self.key}: is a factor of natural.{self.key}: give that too")

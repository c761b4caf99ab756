"""The keys of a case that take one of several kinds: bodies, imperfections and sources.

A section is the part of a case under a key, as a pydantic model; its key `kind` chooses one of the
classes of the registry.
"""

from typing import TYPE_CHECKING, Annotated, Any, Self, Union

from pydantic import Field, ModelWrapValidatorHandler, ValidationInfo, model_validator

from magshell_fenicsx.input.section import ChosenByKey
from magshell_fenicsx.parts.bodies.body import BodySection
from magshell_fenicsx.parts.imperfections.dimple import DimpleSection as DimpleSection
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionSection, note_sizes
from magshell_fenicsx.parts.laminate import LaminateSection
from magshell_fenicsx.parts.magnetism.sources.source import SourceSection
from magshell_fenicsx.parts.motion.history import Branches, Time
from magshell_fenicsx.parts.registry import registered_classes
from magshell_fenicsx.parts.rubber import LawKeys


def _any_of(role: str) -> Any:
    """Return the union of the sections that are registered under a role, chosen by `kind`."""
    return Annotated[Union[registered_classes(role)], ChosenByKey("kind")]  # noqa: UP007


if TYPE_CHECKING:
    Body = BodySection
    Imperfection = ImperfectionSection
    Source = SourceSection
else:
    Body, Imperfection, Source = map(_any_of, ("bodies", "imperfections", "sources"))

Bodies = Annotated[dict[str, Body], Field(max_length=100)]
Imperfections = Annotated[list[Imperfection], Field(max_length=1000)]
Sources = Annotated[list[Source], Field(min_length=1, max_length=1000)]


class ShellKeys(LawKeys):
    """The keys of every shell that parts add."""

    laminate: LaminateSection | None = None
    """Plies in place of one isotropic material, with law: koiter"""
    viscosity: Time | None = None
    """Of Kelvin and Voigt in steps of kind: time: viscosity over Young's modulus"""
    relaxation: Branches = Field(default=[])
    """Branches of Maxwell in steps of kind: time, relaxed before each of these"""
    imperfections: Imperfections = Field(default=[])
    """Deviations of the mid-surface along its normal, added up"""

    @model_validator(mode="after")
    def _laminate_fits(self) -> Self:
        """Refuse a laminate with a law of rubber."""
        if self.laminate and self.law != "koiter":
            raise ValueError(
                f"laminate: needs law: koiter: its strains are small; here the law is {self.law}"
            )
        return self

    @classmethod
    def note_sizes(
        cls,
        data: Any,
        handler: ModelWrapValidatorHandler[Any],
        info: ValidationInfo,
        *,
        with_units: bool,
    ) -> None:
        """Call `imperfection.note_sizes`, before a shell's own validation."""
        note_sizes(data, handler, info, with_units=with_units)

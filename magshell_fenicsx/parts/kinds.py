"""The kinds of bodies, imperfections and sources: each is a file of its package, with its section.

A new kind is such a file, named after it, and its name here. A section is the part of a case under
a key, as a pydantic model; its key `kind` chooses the class.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, Self, Union, get_args

from pydantic import Field, ModelWrapValidatorHandler, ValidationInfo, model_validator

from magshell_fenicsx.input.section import ChosenByKey, Section
from magshell_fenicsx.parts.bodies.body import BodySection
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionSection, note_sizes
from magshell_fenicsx.parts.laminate import LaminateSection
from magshell_fenicsx.parts.magnetism.sources.source import SourceSection
from magshell_fenicsx.parts.motion.history import Branches, Time
from magshell_fenicsx.parts.rubber import LawKeys

if TYPE_CHECKING:
    from magshell_fenicsx.parts.imperfections.dimple import DimpleSection

REGISTERED: dict[str, tuple[str, ...]] = {
    # package -> kinds in the order of the documentation
    "bodies": ("plane", "sphere", "cylinder", "rod", "box", "ellipsoid"),
    "imperfections": ("dimple", "gaussian", "formula", "data", "modes", "random"),
    "magnetism.sources": ("cylinder", "cuboid", "sphere", "ring", "coil", "grid", "formula"),
}


def section_of(package: str, kind: str) -> type[Section]:
    """Return the section class of a kind in a package of kinds, such as "bodies".

    It is the one class in the file of the kind with this value of the key `kind`.
    """
    module = import_module(f"{__package__}.{package}.{kind}")
    # what the module itself defines, without what it imports
    module_members = (
        member
        for member in vars(module).values()
        if getattr(member, "__module__", "") == module.__name__
    )
    sections = [
        member
        for member in module_members
        if isinstance(member, type) and issubclass(member, Section)
    ]
    # the values of the key's Literal are the kinds of the class: one class has this kind
    (section,) = (
        member for member in sections if kind in get_args(member.model_fields["kind"].annotation)
    )
    return section


def _any_of(package: str) -> Any:
    """Return the union of the sections of all kinds of a package, chosen by the key `kind`."""
    sections = tuple(section_of(package, kind) for kind in REGISTERED[package])
    return Annotated[Union[sections], ChosenByKey("kind")]  # noqa: UP007


if TYPE_CHECKING:
    Body = BodySection
    Imperfection = ImperfectionSection
    Source = SourceSection
    Dimple = DimpleSection
else:
    Body, Imperfection, Source = map(_any_of, REGISTERED)
    Dimple = section_of("imperfections", "dimple")

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

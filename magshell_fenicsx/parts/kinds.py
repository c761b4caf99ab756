"""The keys of a case that take one of several kinds: bodies, imperfections, sources and laws.

A section is the part of a case under a key, as a pydantic model; its key `kind` chooses one of the
classes of the registry, of laws the key `law` of a shell.
"""

from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, Union, get_args, get_origin

from pydantic import (
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    ValidationInfo,
    create_model,
    model_validator,
)

from magshell_fenicsx.input.messages import meaning
from magshell_fenicsx.input.section import ChosenByKey, Section
from magshell_fenicsx.parts.bodies.body import BodySection
from magshell_fenicsx.parts.imperfections.dimple import DimpleSection as DimpleSection
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionSection, note_sizes
from magshell_fenicsx.parts.laminate import LaminateSection
from magshell_fenicsx.parts.laws.law_section import LawSection
from magshell_fenicsx.parts.magnetism.sources.source import SourceSection
from magshell_fenicsx.parts.motion.history import Branches, Time
from magshell_fenicsx.parts.registry import registered_classes


def _any_of(role: str) -> Any:
    """Return the union of the sections that are registered under a role, chosen by `kind`."""
    return Annotated[Union[registered_classes(role)], ChosenByKey("kind")]  # noqa: UP007


LAWS: dict[str, type[LawSection]] = {  # by their names, the values of the key `law`
    name: section
    for section in registered_classes("laws")
    for name in get_args(section.model_fields["law"].annotation)
}

if TYPE_CHECKING:
    Body = BodySection
    Imperfection = ImperfectionSection
    Source = SourceSection
    LawName = str
else:
    Body, Imperfection, Source = map(_any_of, ("bodies", "imperfections", "sources"))
    LawName = Literal[tuple(LAWS)]

Bodies = Annotated[dict[str, Body], Field(max_length=100)]
Imperfections = Annotated[list[Imperfection], Field(max_length=1000)]
Sources = Annotated[list[Source], Field(min_length=1, max_length=1000)]


SECTION_BY_KEY = {key: section for section in LAWS.values() for key in section.own_keys()}


class LawChoice(Section):
    """The key of a shell that chooses its law; the keys of all laws are added to it."""

    law: LawName = "koiter"
    """Koiter's for small strains; the others for rubber, incompressible at any stretch, with E = 6
    (C10 + C01)"""

    @property
    def law_section(self) -> LawSection:
        """The law with its keys."""
        section = LAWS[self.law]
        return section.model_construct(law=self.law, **self._values_of(section))

    @model_validator(mode="after")
    def _law_fits(self) -> Self:
        """Check that keys of a law go with this law alone, and that rubber is incompressible."""
        for name, section in LAWS.items():
            self._refuse_misplaced(section, is_chosen=name == self.law)
        try:
            LAWS[self.law].model_validate({"law": self.law, **self._values_of(LAWS[self.law])})
        except ValidationError as e:
            raise ValueError(e.errors()[0]["msg"].removeprefix("Value error, ")) from None
        # a key of the shells that inherit from this class, not of the class itself
        nu = getattr(self, "poisson_ratio", 0.5)
        if self.law_section.incompressible and nu != 0.5:
            raise ValueError(
                f"poisson_ratio: {nu:g}: law: {self.law} is incompressible: give 0.5, or law: "
                "koiter"
            )
        return self

    def _refuse_misplaced(self, section: type[LawSection], *, is_chosen: bool) -> None:
        """Refuse keys of a law without it, the law without them, and lists of unequal lengths.

        `is_chosen` says whether the shell has this law. Lists have a number for each term of the
        law's energy.
        """
        values = self._values_of(section)
        missing = [key for key, value in values.items() if value is None]
        if is_chosen and missing:
            raise ValueError(f"law: {self.law} needs {' and '.join(missing)}")
        lengths = [
            len(value or [])
            for key, value in values.items()
            if get_origin(section.model_fields[key].annotation) is list
        ]
        is_misplaced = not is_chosen and len(missing) < len(values)
        if not is_misplaced and len({*lengths}) <= 1:
            return
        counts = f", with {' and '.join(map(str, lengths))} numbers" if lengths else ""
        raise ValueError(
            f"{', '.join(values)}: {section.keys_text}; here the law is {self.law}{counts}"
        )

    def _values_of(self, section: type[LawSection]) -> dict[str, Any]:
        """Return the keys of a law -> their values in this shell, None where it has none."""
        return {key: getattr(self, key) for key in section.own_keys()}


def _optional_key(section: type[LawSection], key: str) -> tuple[Any, Any]:
    """Return type and default of a law's key where a shell may be without it."""
    field = section.model_fields[key]
    annotation: Any = (
        Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation
    )
    return annotation | None, Field(default=None, description=meaning(section, key))


if TYPE_CHECKING:
    LawKeys = LawChoice
else:
    LawKeys = create_model(
        "LawKeys",
        __base__=LawChoice,
        __module__=__name__,
        **{key: _optional_key(section, key) for key, section in SECTION_BY_KEY.items()},
    )


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

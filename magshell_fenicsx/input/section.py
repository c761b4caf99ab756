"""The base of all sections of a case: strict types, no unknown keys, units, files, choices.

A case has few of many kinds of sections, so a validator is built only when a case has the section.
Targets with units become numbers over sizes of the case, such as the thickness, at validation. The
context of a validation is a mapping that pydantic passes to all validators: the shell, which comes
first, puts its sizes there under "given". Units have the names of pint, such as "metre". A field is
a key of a section class, and its annotation the type. A digest is a hash of a file or an object.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, reduce
from math import isnan, nan
from operator import or_
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol, Self, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    PrivateAttr,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from magshell_fenicsx.platform.input_files import Files
from magshell_fenicsx.quantities.quantity import CaseSizes, Unit

if TYPE_CHECKING:
    import pint


# one number, then units; pint alone would evaluate any formula, even 9**9**9
_NUMBER = r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?"
_UNIT = r"[^\W\d]+(\s*(\*\*|\^)\s*-?[0-9])?"
_NUMBER_AND_UNITS = re.compile(rf"\s*{_NUMBER}[\s*]*{_UNIT}([\s*/]+{_UNIT})*\s*")


@cache
def _units() -> "pint.UnitRegistry":
    """Return pint's registry of units, imported on first use: the import is slow, rarely needed."""
    import pint

    return pint.UnitRegistry()


class Section(BaseModel):
    """A section of the case file.

    The docstring of a key appears in docs/case.md and in the schema; its unit is in brackets at the
    end. See `meaning`. A section that is a default is made by `model_construct`: a validator built
    at import would serve no case.
    """

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False, defer_build=True
    )

    def __setstate__(self, state: dict[Any, Any]) -> None:
        """Restore a section from another rank, and build the schema of its class if need be.

        This rank may not have needed the class yet; without its schema the section could not be
        written.
        """
        super().__setstate__(state)
        if not type(self).__pydantic_complete__:
            type(self).model_rebuild()


def with_unit(unit: str) -> Any:
    """Return the annotated type of text such as "25.2 mm", for validation and the JSON schema.

    Its pattern checks for a number and something after it; only pint checks the names of units.
    """
    pattern = rf"^\s*{_NUMBER}[\s*]*[^\s\d*]"
    return Annotated[str, Field(pattern=pattern, examples=[_example(unit)])]


def _quantity(unit: str) -> Any:
    """Return a pydantic validator that converts text with a unit to a float in `unit`.

    `unit` is in pint's words, such as "metre". A bare number is refused.
    """

    def convert(value: Any) -> float:
        """Return the number of a text in `unit`; refuse a bare number."""
        if not isinstance(value, str):
            raise ValueError(f'needs a unit, for example "{_example(unit)}"')
        return _converted(value, unit)

    return BeforeValidator(convert, json_schema_input_type=with_unit(unit))


def _converted(value: str, unit: str) -> float:
    """Return the number of a text with a unit, such as "25.2 mm", converted to another unit.

    Raises
    ------
    ValueError
        If the text is no number with a unit, or of another dimension.
    """
    import pint

    try:
        if not _NUMBER_AND_UNITS.fullmatch(value):
            raise ValueError(value)
        quantity = _units().Quantity(value)
        return float(quantity.to(unit).magnitude)
    except pint.DimensionalityError as e:
        raise ValueError(f"is not convertible to {unit}: it has the dimension {e.dim1}") from None
    except Exception:  # pint raises many types for invalid text
        raise ValueError(f'is not a number with a unit such as "{_example(unit)}"') from None


def number_and_unit(text: str) -> tuple[str, str]:
    """Return the number and the unit of a text, both as text.

    The unit of a bare number is empty. Of a text that does not begin with a number, both are empty.

    Examples
    --------
    >>> number_and_unit("-40mT"), number_and_unit("2.5e-3"), number_and_unit("full")
    (('-40', 'mT'), ('2.5e-3', ''), ('', ''))
    """
    if re.fullmatch(_NUMBER, text.strip()):
        return text.strip(), ""
    if not _NUMBER_AND_UNITS.fullmatch(text):
        return "", ""
    number_match = re.match(rf"\s*({_NUMBER})", text)
    return (number_match[1], text[number_match.end() :].strip(" *")) if number_match else ("", "")


def in_unit(text: str, unit: str) -> float:
    """Return the number of a text in a unit; a bare zero counts as a number in any unit.

    `unit` is in pint's words, and empty for a bare number.

    Raises
    ------
    ValueError
        If the text is no number with a unit, or of another dimension.
    """
    number, unit_of_text = number_and_unit(text)
    # a bare number, where that is allowed
    if number and not unit_of_text:
        value = float(number)
        if not unit or value == 0:
            return value
    if not unit or not number:
        raise ValueError(f"{text} is not convertible to {unit or 'a bare number'}")
    # the same unit needs no rounding by a conversion
    return float(number) if unit_of_text == unit else _converted(text, unit)


def si_size(unit: str) -> float:
    """Return the size of a unit in SI; 1 for no unit.

    Examples
    --------
    >>> si_size("mT"), si_size("")
    (0.001, 1.0)
    """
    return float(_units().Quantity(1.0, unit).to_base_units().magnitude) if unit else 1.0


def in_units(unit: str, *, bare: bool = False) -> Callable[[Any], float]:
    """Return a function that converts text with a unit to a float in `unit`, and keeps numbers.

    If `bare`, the text is a unit without a number, and the result is the size of this unit.
    """

    def convert(value: Any) -> Any:
        """Return the number of a text in `unit`, or the size of a unit; keep any other value."""
        if isinstance(value, bool) or not isinstance(value, str):
            return value
        return _converted(f"1 {value}" if bare else value, unit)

    return convert


@dataclass(frozen=True, slots=True)
class WithUnit(BeforeValidator):
    """The validator of a number that may have a unit, which `unit` names in pint's words."""

    unit: str = ""


def or_number(unit: str, number: Any = float) -> WithUnit:
    """Return a pydantic validator that keeps a number, or converts text with a unit to `unit`.

    Parameters
    ----------
    unit
        The unit in pint's words.
    number
        Type of the number in the schema.
    """
    schema_type = number | with_unit(unit)
    return WithUnit(in_units(unit), json_schema_input_type=schema_type, unit=unit)


def numbers_with_units(validated: Any, data: Any, key: str) -> Iterator[str]:
    """Iterate over the keys whose values were text with a unit in the case, and became numbers.

    Targets over a size of the case are left out, as their messages name the units that they need.

    Parameters
    ----------
    validated
        The section, list or mapping that was made of the data.
    data
        Plain data of the case, of the same structure.
    key
        Key of the data in the case.

    Yields
    ------
    str
        The key in the case, such as "shell.radius".
    """
    if isinstance(validated, BaseModel) and isinstance(data, Mapping):
        for name, field in type(validated).model_fields.items():
            if name in data and not is_over_unit(field.annotation, field.metadata):
                yield from numbers_with_units(getattr(validated, name), data[name], f"{key}.{name}")
    elif isinstance(validated, Mapping) and isinstance(data, Mapping):
        for name, value in validated.items():
            yield from numbers_with_units(value, data.get(name), f"{key}.{name}")
    elif isinstance(validated, list) and isinstance(data, list):
        for i, (value, item) in enumerate(zip(validated, data, strict=True)):
            yield from numbers_with_units(value, item, f"{key}.{i}")
    elif isinstance(validated, float) and isinstance(data, str):  # a text that became a number
        yield key


def is_length(annotation: Any, metadata: Iterable[Any] = ()) -> bool:
    """Return whether a field of a section takes a length with a unit, or a list of lengths.

    Parameters
    ----------
    annotation
        Type of the field.
    metadata
        Annotations that pydantic keeps apart from the type, such as validators.
    """
    # validators of this type itself; then the types within it, such as the items of a list
    validators = (validator for validator in metadata if isinstance(validator, WithUnit))
    if any(validator.unit == "metre" for validator in validators):
        return True
    return any(is_length(part, getattr(part, "__metadata__", ())) for part in get_args(annotation))


@dataclass(frozen=True)
class OrInMemory:
    """An annotation of a union, one member of which only a Python program can give, as an object.

    The object is kept as it is. Other values are validated as the rest of the union.

    Attributes
    ----------
    kind
        The class of these objects. Each has a `digest`, by which the written case refers to it.
    """

    kind: Any

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return the schema of the union's other members, wrapped to keep objects of `kind`."""
        other_members = reduce(or_, (part for part in get_args(source) if part is not self.kind))
        # how the value is written: `_serialized` gets the usual function to write the others
        serialization = core_schema.wrap_serializer_function_ser_schema(self._serialized)
        schema = handler.generate_schema(other_members)
        return core_schema.no_info_wrap_validator_function(
            self._validated, schema, serialization=serialization
        )

    def _validated(self, value: Any, validate: Callable[[Any], Any]) -> Any:
        """Return an object of `kind` as it is, else what `validate` makes of the value."""
        return value if isinstance(value, self.kind) else validate(value)

    def _serialized(self, value: Any, serialize: Callable[[Any], Any]) -> Any:
        """Return the digest of an object of `kind`, else the serialised value."""
        return value.digest if isinstance(value, self.kind) else serialize(value)


_EXAMPLES = {
    "metre": "25.2 mm",
    "millimetre": "0.5 mm",
    "millimetre**3": "80 mm^3",
    "pascal": "1.8 MPa",
    "tesla": "60 mT",
    "newton": "20 mN",
    "newton/metre": "5 N/m",
    "kilogram/metre**3": "2000 kg/m^3",
    "second": "2.5 s",
    "1/second": "20 Hz",
}


def _example(unit: str) -> str:
    """Return an example of text with a unit, such as "25.2 mm" for "metre"."""
    power = re.sub(r"^1/(\w+)(?:\*\*(\d))?$", lambda match: f"{match[1]}^-{match[2] or 1}", unit)
    return _EXAMPLES.get(unit, f"5 {power.replace('**', '^')}")


Length = Annotated[float, _quantity("metre")]
Pressure = Annotated[float, _quantity("pascal")]
Finite = Annotated[float, Field(ge=-1e9, le=1e9)]
Vector = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Lengths = Annotated[
    list[Annotated[float, or_number("metre", Finite), Field(ge=-1e9, le=1e9)]],
    Field(min_length=3, max_length=3),
]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=40)]
FluxDensity = Annotated[float, _quantity("tesla")]
Density = Annotated[float, _quantity("kilogram/metre**3")]


def _not_zero(v: list[float]) -> list[float]:
    if not any(v):
        raise ValueError("must not be zero")
    return v


# A direction, by a vector of any length.
DirectionVector = Annotated[Vector, AfterValidator(_not_zero)]


class AboutAxis(Section):
    """A rotation about an axis."""

    axis: Vector
    """Along it, of any length"""
    angle: float = Field(ge=-36000, le=36000)
    """By the right-hand rule [degrees]"""

    @model_validator(mode="after")
    def _there_is_one(self) -> Self:
        if not any(self.axis) or not self.angle:
            raise ValueError("axis and angle must not be zero")
        return self


class Direction(Section):
    """Angles in degrees: polar from e3, azimuth from e1 about e3."""

    polar: float = 0.0
    """Angle from e3 [degree]"""
    azimuth: float = 0.0
    """Angle from e1 about e3 [degree]"""

    def vector(self, turn: float = 0.0) -> NDArray[np.float64]:
        """Return the unit vector (3,) in a frame that is turned by `turn` (rad) about e3."""
        polar, azimuth = np.radians(self.polar), np.radians(self.azimuth) - turn
        return np.array(
            [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
        )


@dataclass(frozen=True)
class ChosenByKey:
    """An annotation of a union of sections, one of which is chosen by a key such as `kind`.

    The key of each section is a `Literal` of the values that choose the section.

    Attributes
    ----------
    key
        The key that chooses.
    former_values
        Pairs: a value of the key in older case files, and the present one with its meaning.
    """

    key: str
    former_values: tuple[tuple[str, str], ...] = ()

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return a tagged union of the sections, in which `key` has the tag.

        The validator of a section is built when a case has it. Former values of the key are
        replaced before validation.
        """
        choices = {
            tag: handler.generate_schema(Annotated[section, LazyValidation(section)])
            for section in get_args(source)
            for tag in get_args(section.model_fields[self.key].annotation)
        }
        union = core_schema.tagged_union_schema(choices, self.key)
        if not self.former_values:
            return union
        return core_schema.no_info_before_validator_function(self._with_present_value, union)

    def _with_present_value(self, data: Any) -> Any:
        """Return the data of a section, with the present value of its key for a former one."""
        value = data.get(self.key) if isinstance(data, dict) else None
        present_values = dict(self.former_values)
        if not isinstance(value, str) or value not in present_values:
            return data
        return {**data, self.key: present_values[value]}


@dataclass(frozen=True)
class LazyValidation:
    """An annotation of a section class whose validator is built when a case has the section."""

    section: type[BaseModel]

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(self._validated)

    def _validated(self, value: Any, info: ValidationInfo) -> BaseModel:
        """Return the section of a value; `info` holds the context of the validation of the case."""
        return self.section.model_validate(value, context=info.context)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        self.section.model_rebuild()
        return handler(self.section.__pydantic_core_schema__)


class FileKeys(Section):
    """A section that may read a file; its path is relative to the folder of the case."""

    file: str | None = None
    """From the folder of the case"""

    _folder: Path = PrivateAttr(default_factory=Path)
    _files: Files = PrivateAttr(default_factory=Files)

    def model_post_init(self, context: Any, /) -> None:
        """Take the folder and the files of the case from the context of its validation."""
        options = context or {}  # of a case without a file there is none
        self._folder = Path(options.get("folder", "")).absolute()
        self._files = options.get("files") or Files()

    @field_validator("file", check_fields=False)
    @classmethod
    def _refuse_bad_name(cls, name: str | None) -> str | None:
        """Refuse a name of a file that is empty or has a zero byte."""
        if name is not None and "\0" in name:
            raise ValueError(f"{name!r}: a file's name has no zero byte")
        if name == "":
            raise ValueError("the name is empty; give that of a file")
        return name

    @property
    def path(self) -> Path:
        """Path of the file; relative paths are from the folder of the case."""
        return self._folder / (self.file or "")

    @property
    def files(self) -> Files:
        """The store of file contents of the case, in which each file is read once."""
        return self._files

    @property
    def digest(self) -> str | None:
        """Hash of the file's content; None if it cannot be read."""
        return self._files.digest(self.path)


def digests(sections: Mapping[str, object]) -> dict[str, str | None]:
    """Return hashes of the files that sections read, by the keys of the files.

    Parameters
    ----------
    sections
        Key of the case -> its section; only those with a file count.

    Returns
    -------
    dict
        Key of a file, such as "shell.file" -> hash; None if the file cannot be read.
    """
    return {
        f"{key}.file": s.digest for key, s in sections.items() if isinstance(s, FileKeys) and s.file
    }


class Sized(Protocol):
    """The sizes of a shell, which a case may give with or without units.

    Attributes
    ----------
    youngs_modulus
        In Pa with units; None if the case has none.
    R_over_h
        Radius, or reference length, over the thickness.
    reference
        R in metres with units, else in the case's own length.
    density
        In kg/m³ with units; None if the case has none.
    with_units
        Whether lengths of the shell have units.
    """

    @property
    def geometry(self) -> str: ...
    @property
    def youngs_modulus(self) -> float | None: ...
    @property
    def R_over_h(self) -> float: ...
    @property
    def poisson_ratio(self) -> float: ...
    @property
    def density(self) -> float | None: ...
    @property
    def reference(self) -> float: ...
    @property
    def with_units(self) -> bool: ...


def case_sizes(shell: Sized) -> CaseSizes:
    """Return the sizes that give units to numbers of a case, such as R and E; nan if missing."""
    # E of these geometries always has a unit.
    has_pascals = shell.with_units or shell.geometry in ("hemisphere", "disc", "strip")
    R = shell.reference if shell.with_units else nan
    E = shell.youngs_modulus if has_pascals and shell.youngs_modulus else nan
    rho = shell.density if shell.with_units and shell.density else nan
    return CaseSizes(shell.poisson_ratio, shell.R_over_h, R, E, rho)


def _put_sizes_into_context(shell: Any, info: ValidationInfo) -> Any:
    if isinstance(info.context, dict):
        info.context["given"] = case_sizes(shell)
    return shell


# Annotation of the shell, which comes before the loads: their units need its sizes.
NOTED = AfterValidator(_put_sizes_into_context)


@dataclass(frozen=True, slots=True)
class OverUnit(BeforeValidator):
    """The validator of a number over a size of the case, such as a displacement over h."""


def over_size(unit: Unit) -> OverUnit:
    """Return a validator that converts text with a unit to a number over a size such as h.

    A number is kept: it is over that size already. The sizes are those of the shell, which
    validation has put into its context before.
    """

    def convert(value: Any, info: ValidationInfo) -> Any:
        """Return a text with a unit over the size in the context, and any other value unchanged."""
        if not isinstance(value, str):
            return value
        value_in_unit = in_units(unit.text)(value)
        # without sizes the shell is wrong, and its own message says so: any number will do
        if info.context and "given" not in info.context:
            return 1.0
        sizes = (info.context or {}).get("given")
        size = unit.size(sizes) if sizes else nan
        if isnan(size):
            raise ValueError(f"has a unit: that needs {unit.needs}; a number is in {unit.key}")
        return value_in_unit / size

    return OverUnit(convert, json_schema_input_type=float | with_unit(unit.text))


def is_over_unit(annotation: Any, metadata: Iterable[Any] = ()) -> bool:
    """Return whether a field takes text with a unit as a number over a size of the case.

    `annotation` is the type of the field, `metadata` what pydantic keeps apart, such as validators.
    """
    # of an optional field the number is a member of a union
    nested = (
        validator
        for part in (annotation, *get_args(annotation))
        for validator in getattr(part, "__metadata__", ())
    )
    return any(isinstance(validator, OverUnit) for validator in (*metadata, *nested))


def over_unit(annotation: Any, text: str, shell: Sized) -> float:
    """Return the number over a size of a shell that a field makes of text with a unit.

    Parameters
    ----------
    annotation
        Type of the field, for which `is_over_unit` is true.
    text
        A number with a unit, such as "2 mm".

    Raises
    ------
    ValueError
        If the text is no number with a unit, has another dimension, or the shell lacks the size.
    """
    try:
        context = {"given": case_sizes(shell)}
        return float(TypeAdapter(annotation).validate_python(text, context=context))
    except ValidationError as e:
        raise ValueError(e.errors()[0]["msg"].removeprefix("Value error, ")) from None

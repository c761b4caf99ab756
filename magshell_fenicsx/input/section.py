"""The base of all sections of a case: strict types, no unknown keys, units, files, choices.

Of sections that are chosen by a key, only the validators of chosen ones are built: a case has few
of many. Targets with units become numbers over the sizes of their case at the door.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, reduce
from math import isnan, nan
from operator import or_
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol, Self, TypeAlias, get_args

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
    """Return pint's units, imported on first use: the import is slow, and rarely needed."""
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
    """Return the schema of text with a unit; only pint checks the names of units."""
    pattern = rf"^\s*{_NUMBER}[\s*]*[^\s\d*]"
    return Annotated[str, Field(pattern=pattern, examples=[_example(unit)])]


def _quantity(unit: str) -> Any:
    """Return a validator: text with a unit -> a float in `unit`."""

    def convert(value: Any) -> float:
        if not isinstance(value, str):
            raise ValueError(f'needs a unit, for example "{_example(unit)}"')
        return _converted(value, unit)

    return BeforeValidator(convert, json_schema_input_type=with_unit(unit))


def _converted(value: str, unit: str) -> float:
    """Return a number with a unit in another unit; raise a ValueError if it is none."""
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
    """Return the number and the unit of a text.

    The unit of a bare number is empty; of a word both are.

    Examples
    --------
    >>> number_and_unit("-40mT"), number_and_unit("2.5e-3"), number_and_unit("full")
    (('-40', 'mT'), ('2.5e-3', ''), ('', ''))
    """
    if re.fullmatch(_NUMBER, text.strip()):
        return text.strip(), ""
    if not _NUMBER_AND_UNITS.fullmatch(text):
        return "", ""
    number = re.match(rf"\s*({_NUMBER})", text)
    return (number[1], text[number.end() :].strip(" *")) if number else ("", "")


def in_unit(text: str, unit: str) -> float:
    """Return a number with a unit in another unit; a bare zero has any.

    Raises
    ------
    ValueError
        If it is none, or of another dimension.
    """
    number, text_unit = number_and_unit(text)
    if not text_unit and number and (not unit or float(number) == 0):
        return float(number)
    if not unit or not number:
        raise ValueError(f"{text} is not convertible to {unit or 'a bare number'}")
    return float(number) if text_unit == unit else _converted(text, unit)


def si_size(unit: str) -> float:
    """Return the size of a unit in SI; 1 for no unit.

    Examples
    --------
    >>> si_size("mT"), si_size("")
    (0.001, 1.0)
    """
    return float(_units().Quantity(1.0, unit).to_base_units().magnitude) if unit else 1.0


def in_units(unit: str, *, bare: bool = False) -> Callable[[Any], float]:
    """Return a validator: text with a unit -> a float in `unit`; a number stays as it is.

    With `bare`, the text is a unit without a number, and the result is its size.
    """

    def convert(value: Any) -> Any:
        if isinstance(value, bool) or not isinstance(value, str):
            return value
        return _converted(f"1 {value}" if bare else value, unit)

    return convert


@dataclass(frozen=True, slots=True)
class WithUnit(BeforeValidator):
    """The validator of a number that may have a unit."""

    unit: str = ""


def or_number(unit: str, number: Any = float) -> WithUnit:
    """Return a validator: a number unchanged, or text converted to `unit`.

    Parameters
    ----------
    number
        Type of the number in the schema.
    """
    schema_type = number | with_unit(unit)
    return WithUnit(in_units(unit), json_schema_input_type=schema_type, unit=unit)


def numbers_with_units(validated: Any, data: Any, key: str) -> Iterator[str]:
    """Iterate over keys within a section's plain data whose text became a number.

    These had a unit. Targets over a size of the case are left out; they say themselves what they
    need.

    Parameters
    ----------
    validated
        The section, list or mapping that was made of the data.
    data
        Plain data of the case.
    key
        Key of the data in the case.
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
    elif isinstance(validated, float) and isinstance(data, str):
        yield key


def is_length(annotation: Any, metadata: Iterable[Any] = ()) -> bool:
    """Return whether a field with this annotation takes a length with a unit, or a list of them."""
    validators = (validator for validator in metadata if isinstance(validator, WithUnit))
    if any(validator.unit == "metre" for validator in validators):
        return True
    return any(is_length(part, getattr(part, "__metadata__", ())) for part in get_args(annotation))


@dataclass(frozen=True)
class OrInMemory:
    """An annotation of a union, one of whose members only a program gives, as an object in memory.

    Attributes
    ----------
    kind
        The class of these objects, which have a `digest`.
    """

    kind: Any

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        others = reduce(or_, (part for part in get_args(source) if part is not self.kind))
        serialization = core_schema.wrap_serializer_function_ser_schema(self._serialized)
        schema = handler.generate_schema(others)
        return core_schema.no_info_wrap_validator_function(
            self._validated, schema, serialization=serialization
        )

    def _validated(self, value: Any, validate: Callable[[Any], Any]) -> Any:
        return value if isinstance(value, self.kind) else validate(value)

    def _serialized(self, value: Any, serialize: Callable[[Any], Any]) -> Any:
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
    """Return an example of text with a unit."""
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
    """An annotation of a union of sections, one of which is chosen by a key.

    Each section has the values that choose it as the key's `Literal`.

    Attributes
    ----------
    former_values
        Values of the key in older case files, each with the one that stands for it now.
    """

    key: str
    former_values: tuple[tuple[str, str], ...] = ()

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
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
        """Return the data of a section with the present value of its key."""
        value = data.get(self.key) if isinstance(data, dict) else None
        present_values = dict(self.former_values)
        if not isinstance(value, str) or value not in present_values:
            return data
        return {**data, self.key: present_values[value]}


@dataclass(frozen=True)
class LazyValidation:
    """An annotation of a section whose validator is built when a case has it."""

    section: type[BaseModel]

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(self._validated)

    def _validated(self, value: Any, info: ValidationInfo) -> BaseModel:
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
        options = context or {}
        self._folder = Path(options.get("folder", "")).absolute()
        self._files = options.get("files") or Files()

    @field_validator("file", check_fields=False)
    @classmethod
    def _refuse_bad_name(cls, name: str | None) -> str | None:
        if name is not None and "\0" in name:
            raise ValueError(f"{name!r}: a file's name has no zero byte")
        if name == "":
            raise ValueError("the name is empty; give that of a file")
        return name

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self._folder / (self.file or "")

    @property
    def files(self) -> Files:
        """The contents of the files of its case."""
        return self._files

    @property
    def digest(self) -> str | None:
        """Hash of the file's content; None if it cannot be read."""
        return self._files.digest(self.path)


def digests(sections: Mapping[str, object]) -> dict[str, str | None]:
    """Return hashes of the files that sections read, by the keys of the files."""
    return {
        f"{key}.file": s.digest for key, s in sections.items() if isinstance(s, FileKeys) and s.file
    }


# See `parts.rubber.LawKeys.rubber`.
Rubberlike: TypeAlias = float | tuple[tuple[float, ...], tuple[float, ...]]


class Sized(Protocol):
    """A shell with or without units."""

    @property
    def geometry(self) -> str: ...
    @property
    def youngs_modulus(self) -> float | None: ...
    @property
    def R_over_h(self) -> float: ...

    @property
    def rubber(self) -> Rubberlike | None: ...
    @property
    def poisson_ratio(self) -> float: ...
    @property
    def density(self) -> float | None: ...
    @property
    def reference(self) -> float: ...
    @property
    def with_units(self) -> bool: ...


def case_sizes(shell: Sized) -> CaseSizes:
    """Return the sizes that a shell has with units."""
    # E of these geometries always has a unit.
    in_pascals = shell.with_units or shell.geometry in ("hemisphere", "disc", "strip")
    R = shell.reference if shell.with_units else nan
    E = shell.youngs_modulus if in_pascals and shell.youngs_modulus else nan
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
    """The validator of a number over a size of the case."""


def over_size(unit: Unit) -> OverUnit:
    """Return a validator: text with a unit -> a number over a size of the case, such as h.

    A number is one already.
    """

    def convert(value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, str):
            return value
        exact = in_units(unit.text)(value)
        if info.context and "given" not in info.context:
            return 1.0  # the shell is wrong, and its own message says so: any number will do
        sizes = (info.context or {}).get("given")
        size = unit.size(sizes) if sizes else nan
        if isnan(size):
            raise ValueError(f"has a unit: that needs {unit.needs}; a number is in {unit.key}")
        return exact / size

    return OverUnit(convert, json_schema_input_type=float | with_unit(unit.text))


def is_over_unit(annotation: Any, metadata: Iterable[Any] = ()) -> bool:
    """Return whether a field takes text with a unit as a number over a size of the case."""
    nested = (
        validator
        for part in (annotation, *get_args(annotation))
        for validator in getattr(part, "__metadata__", ())
    )
    return any(isinstance(validator, OverUnit) for validator in (*metadata, *nested))


def over_unit(annotation: Any, text: str, shell: Sized) -> float:
    """Return the number that such a field makes of text with a unit.

    Raises
    ------
    ValueError
        If it is none, of another dimension, or the shell lacks what it needs.
    """
    try:
        context = {"given": case_sizes(shell)}
        return float(TypeAdapter(annotation).validate_python(text, context=context))
    except ValidationError as e:
        raise ValueError(e.errors()[0]["msg"].removeprefix("Value error, ")) from None

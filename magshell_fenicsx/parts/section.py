"""What all sections of a case share: strict types, no unknown keys, numbers with units."""

import re
from collections.abc import Callable, Iterator
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

if TYPE_CHECKING:
    import pint

# one number, then units; pint itself would compute any formula, 9**9**9 included
_NUMBER = r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?"
_UNIT = r"[^\W\d]+(\s*(\*\*|\^)\s*-?[0-9])?"
_NUMBER_AND_UNITS = re.compile(rf"\s*{_NUMBER}[\s*]*{_UNIT}([\s*/]+{_UNIT})*\s*")


@cache
def _units() -> "pint.UnitRegistry":
    """Made for the first number with a unit: most cases have none, and pint takes long to import."""
    import pint

    return pint.UnitRegistry()


class Section(BaseModel):
    """A section of the case file.

    The docstring of a key is its line in docs/case.md and in the schema; what it is in stands in brackets at its end.
    """

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False, use_attribute_docstrings=True, defer_build=True
    )


def with_unit(unit: str) -> Any:
    """What the schema says of text with a unit; names of units are checked by pint alone."""
    return Annotated[str, Field(pattern=rf"^\s*{_NUMBER}[\s*]*[^\s\d*]", examples=[_example(unit)])]


def _quantity(unit: str) -> Any:
    """A validator: text with a unit -> a float in `unit`."""

    def convert(value: Any) -> float:
        if not isinstance(value, str):
            raise ValueError(f'needs a unit, for example "{_example(unit)}"')
        return _converted(value, unit)

    return BeforeValidator(convert, json_schema_input_type=with_unit(unit))


def _converted(value: str, unit: str) -> float:
    import pint

    try:
        if not _NUMBER_AND_UNITS.fullmatch(value):
            raise ValueError(value)
        quantity = _units().Quantity(value)
        return float(quantity.to(unit).magnitude)
    except pint.DimensionalityError as e:
        raise ValueError(f"is not convertible to {unit}: it has the dimension {e.dim1}") from None
    except Exception:  # pint raises many kinds for text that is no quantity
        raise ValueError(f'is not a number with a unit such as "{_example(unit)}"') from None


def in_units(unit: str, *, bare: bool = False) -> Callable[[Any], float]:
    """A validator: text with a unit -> a float in `unit`; a number stays as it is.

    With `bare`, the text is the unit alone, and is turned into its size.
    """

    def convert(value: Any) -> Any:
        if isinstance(value, bool) or not isinstance(value, str):
            return value
        return _converted(f"1 {value}" if bare else value, unit)

    return convert


def or_number(unit: str, number: Any = float) -> BeforeValidator:
    """A validator: a number as it is, or text with a unit in `unit`; `number` is the type that the schema tells."""
    return BeforeValidator(in_units(unit), json_schema_input_type=number | with_unit(unit))


NAMES = {"at", "edge", "over", "kind", "control", "until", "radius"}  # text without being quantities


def texts(part: Any, path: str = "") -> Iterator[str]:
    """Where in plain data numbers stand as text, with a unit."""
    for key, value in part.items() if isinstance(part, dict) else enumerate(part if isinstance(part, list) else []):
        if isinstance(value, str) and key not in NAMES:
            yield f"{path}{key}"
        yield from texts(value, f"{path}{key}.")


_EXAMPLES = {
    "metre": "25.2 mm",
    "pascal": "1.8 MPa",
    "tesla": "60 mT",
    "newton": "20 mN",
    "newton/metre": "5 N/m",
}


def _example(unit: str) -> str:
    return _EXAMPLES.get(unit, f"5 {unit.replace('**', '^')}")


Length = Annotated[float, _quantity("metre")]
Pressure = Annotated[float, _quantity("pascal")]
FluxDensity = Annotated[float, _quantity("tesla")]

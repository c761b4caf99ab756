"""What all sections of a case share: strict types, no unknown keys, numbers with units."""

import re
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict

if TYPE_CHECKING:
    import pint

# one number, then units; pint itself would compute any formula, 9**9**9 included
_NUMBER = r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[-+]?[0-9]+)?"
_UNIT = r"[^\W\d]+(\s*(\*\*|\^)\s*-?[0-9])?"
_NUMBER_AND_UNITS = re.compile(rf"\s*{_NUMBER}[\s*]*{_UNIT}([\s*/]+{_UNIT})*\s*", re.IGNORECASE)


@cache
def _units() -> "pint.UnitRegistry":
    """Made for the first number with a unit: most cases have none, and pint takes long to import."""
    import pint

    return pint.UnitRegistry()


class Section(BaseModel):
    """A section of the case file."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _quantity(unit: str) -> Any:
    """A validator: text with a unit -> a float in `unit`."""

    def convert(value: Any) -> float:
        if not isinstance(value, str):
            raise ValueError(f'needs a unit, for example "{_EXAMPLES[unit]}"')
        return _converted(value, unit)

    return BeforeValidator(convert)


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
        raise ValueError(f'is not a number with a unit such as "{_EXAMPLES[unit]}"') from None


def in_units(unit: str, *, bare: bool = False) -> Callable[[Any], float]:
    """A validator: text with a unit -> a float in `unit`; a number stays as it is.

    With `bare`, the text is the unit alone, and is turned into its size.
    """

    def convert(value: Any) -> Any:
        if isinstance(value, bool) or not isinstance(value, str):
            return value
        return _converted(f"1 {value}" if bare else value, unit)

    return convert


_EXAMPLES = {"metre": "25.2 mm", "pascal": "1.8 MPa", "tesla": "60 mT"}
Length = Annotated[float, _quantity("metre")]
Pressure = Annotated[float, _quantity("pascal")]
FluxDensity = Annotated[float, _quantity("tesla")]

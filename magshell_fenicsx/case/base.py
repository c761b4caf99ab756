"""What all sections of a case share: strict types, no unknown keys, numbers with units."""

from typing import Annotated, Any

import pint
from pydantic import BaseModel, BeforeValidator, ConfigDict

_units = pint.UnitRegistry()


class Section(BaseModel):
    """A section of the case file."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _quantity(unit: str) -> Any:
    """A validator: text with a unit -> a float in `unit`."""

    def convert(value: Any) -> float:
        if not isinstance(value, str):
            raise ValueError(f'needs a unit, for example "{_EXAMPLES[unit]}"')
        try:
            quantity = _units.Quantity(value)
            return float(quantity.to(unit).magnitude)
        except pint.DimensionalityError as e:
            raise ValueError(f"is not convertible to {unit}: it has the dimension {e.dim1}") from None
        except Exception:  # pint raises many kinds for text that is no quantity
            raise ValueError(f'is not a number with a unit such as "{_EXAMPLES[unit]}"') from None

    return BeforeValidator(convert)


_EXAMPLES = {"metre": "25.2 mm", "pascal": "1.8 MPa", "tesla": "60 mT"}
Length = Annotated[float, _quantity("metre")]
Pressure = Annotated[float, _quantity("pascal")]
FluxDensity = Annotated[float, _quantity("tesla")]

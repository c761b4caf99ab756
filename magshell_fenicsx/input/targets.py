"""Targets with units, which become numbers over the sizes of their case at the door."""

from typing import Any, Protocol

from pydantic import AfterValidator, BeforeValidator, ValidationInfo

from magshell_fenicsx.input.section import in_units, with_unit
from magshell_fenicsx.quantities.units import sizes

UNITS = {"h": "millimetre", "p_c": "pascal", "R³": "millimetre**3", "2πD/R": "newton"}  # those of `sizes`


class Sized(Protocol):
    """A shell with or without units."""

    @property
    def geometry(self) -> str: ...
    @property
    def youngs_modulus(self) -> float | None: ...
    @property
    def R_over_h(self) -> float: ...
    @property
    def reference(self) -> float: ...
    @property
    def with_units(self) -> bool: ...


def given(shell: Sized) -> tuple[float | None, float | None]:
    """R (m) and E (Pa) of a shell; None for one without a unit."""
    in_pascals = shell.with_units or shell.geometry in ("hemisphere", "disc", "strip")  # whose E always has a unit
    return shell.reference if shell.with_units else None, shell.youngs_modulus if in_pascals else None


def _note(shell: Any, info: ValidationInfo) -> Any:
    if isinstance(info.context, dict):
        R, E = given(shell)
        info.context["sizes"] = sizes(shell.poisson_ratio, shell.R_over_h, R=R, E=E)
    return shell


NOTED = AfterValidator(_note)  # of the shell, which comes before the loads


def over(scale: str) -> BeforeValidator:
    """A validator: text with a unit -> a number over a size of the case, such as h; a number is one already."""

    def convert(value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, str):
            return value
        exact = in_units(UNITS[scale])(value)
        if info.context and "sizes" not in info.context:
            return 1.0  # the shell is wrong, and its own message says so: any number will do
        known = (info.context or {}).get("sizes", {})
        if scale not in known:
            needed = "youngs_modulus and lengths of the shell with units"
            raise ValueError(f"has a unit: that needs {needed}; a number is in {scale}")
        return exact / known[scale]

    return BeforeValidator(convert, json_schema_input_type=float | with_unit(UNITS[scale]))

"""Targets with units, which become numbers over the sizes of their case at the door."""

from math import isnan, nan
from typing import Any, Protocol

from pydantic import AfterValidator, BeforeValidator, ValidationInfo

from magshell_fenicsx.input.section import in_units, with_unit
from magshell_fenicsx.quantities.units import Given, Unit


class Sized(Protocol):
    """A shell with or without units."""

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


def given(shell: Sized) -> Given:
    """What a shell gives with units."""
    in_pascals = shell.with_units or shell.geometry in ("hemisphere", "disc", "strip")  # whose E always has a unit
    R = shell.reference if shell.with_units else nan
    E = shell.youngs_modulus if in_pascals and shell.youngs_modulus else nan
    rho = shell.density if shell.with_units and shell.density else nan
    return Given(shell.poisson_ratio, shell.R_over_h, R, E, rho)


def _note(shell: Any, info: ValidationInfo) -> Any:
    if isinstance(info.context, dict):
        info.context["given"] = given(shell)
    return shell


NOTED = AfterValidator(_note)  # of the shell, which comes before the loads


def over(unit: Unit) -> BeforeValidator:
    """A validator: text with a unit -> a number over a size of the case, such as h; a number is one already."""

    def convert(value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, str):
            return value
        exact = in_units(unit.text)(value)
        if info.context and "given" not in info.context:
            return 1.0  # the shell is wrong, and its own message says so: any number will do
        shell = (info.context or {}).get("given")
        size = unit.size(shell) if shell else nan
        if isnan(size):
            raise ValueError(f"has a unit: that needs {unit.needs}; a number is in {unit.key}")
        return exact / size

    return BeforeValidator(convert, json_schema_input_type=float | with_unit(unit.text))

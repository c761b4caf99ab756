"""Sizes of imperfections with units, which become numbers over the sizes of their shell at the door."""

from collections.abc import Mapping
from math import sqrt
from typing import Any, Literal, Protocol

from pydantic import BeforeValidator, ModelWrapValidatorHandler, ValidationError, ValidationInfo

from magshell_fenicsx.input.section import in_units, with_unit

KEYS = ("imperfections", "defect")
CONTEXT = "of imperfections"  # key of the context of a validation: scale -> size in m, none without units
UNITS = {"h": "h", "width": "the unit of a dimple's width"}


class Shell(Protocol):
    """A shell with or without units."""

    @property
    def R_over_h(self) -> float: ...
    @property
    def reference(self) -> float: ...
    @property
    def poisson_ratio(self) -> float: ...


def half_width(width: float, R_over_h: float, nu: float) -> float:
    """Width of an imperfection over R (rad), from the width over (h R)^(1/2)/(12 (1 - nu^2))^(1/4)."""
    return width / sqrt(sqrt(12 * (1 - nu**2)) * R_over_h)


def note_sizes(data: Any, handler: ModelWrapValidatorHandler[Any], info: ValidationInfo, *, with_units: bool) -> None:
    """Note what the imperfections in plain data of a shell are over: the shell without them has these sizes.

    A wrong shell has none: its own message says what is wrong.
    """
    if (
        not isinstance(info.context, dict)
        or not isinstance(data, dict)
        or not any(map(_has_text, _imperfections(data)))
    ):
        return
    info.context.pop(CONTEXT, None)
    try:
        shell: Shell = handler({key: value for key, value in data.items() if key not in KEYS})
    except ValidationError:
        return
    R, R_over_h = shell.reference, shell.R_over_h
    sizes = {"h": R / R_over_h, "width": R * half_width(1.0, R_over_h, shell.poisson_ratio)}
    info.context[CONTEXT] = sizes if with_units else {}


def over(scale: Literal["h", "width"]) -> BeforeValidator:
    """A validator: a length with a unit -> a number over h, or in the unit of a dimple's width; or a number."""

    def convert(value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, str):
            return value
        exact = in_units("metre")(value)
        if info.context and CONTEXT not in info.context:
            return 1.0  # the shell is wrong: any number will do
        sizes = (info.context or {}).get(CONTEXT)
        if not sizes:
            raise ValueError(f"has a unit: that needs lengths of the shell with units; a number is in {UNITS[scale]}")
        return exact / sizes[scale]

    return BeforeValidator(convert, json_schema_input_type=float | with_unit("millimetre"))


def sizes_noted(info: ValidationInfo) -> Mapping[str, Any]:
    """The part of the context of a validation with the sizes, for what is validated later."""
    return {CONTEXT: (info.context or {}).get(CONTEXT, {})}


def _imperfections(data: dict[str, Any]) -> list[Any]:
    listed = data.get("imperfections")
    return [*(listed if isinstance(listed, list) else []), data.get("defect")]


def _has_text(part: Any) -> bool:
    """Whether a part of plain data has text that begins with a number, or the unit of random numbers."""
    if isinstance(part, dict):
        return any(key == "unit" or _has_text(value) for key, value in part.items())
    if isinstance(part, list):
        return any(map(_has_text, part))
    return isinstance(part, str) and part.strip()[:1] in {*"+-.0123456789"}

"""A load as a function of time: ramp, step, triangle, sine, a table, or a formula; and the
viscosity of a shell.

A history is a load's values over the time of a step, in one of several forms of the case file. A
level is such a value; like a time it may be text with a unit, whose meaning depends on the load. A
`Curve` is a history as a function (t, before) -> value: t is the time since the step began, and at
a jump `before` chooses the value before it. An ability is what a section adds to a problem; an
offer is a property of the case that it may take away from others, such as a material without
viscosity.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag

from magshell_fenicsx.input.expressions import formula
from magshell_fenicsx.input.section import Section, in_units, number_and_unit, with_unit
from magshell_fenicsx.parts.ability import Ability, Context, Offer

Value = Callable[[Any], float]  # a time or a level as a plain number
Curve = Callable[
    [float, bool], float
]  # of the time since the step began, at a jump before or after it


def measured(unit: str) -> Any:
    """Return the type of a number or text with a unit, for keys of the case file.

    Text stays text, since what a number without a unit means depends on the case.

    Parameters
    ----------
    unit
        Unit that the text must have, such as "second".
    """

    def check(value: float | str) -> float | str:
        in_units(unit)(value)  # which refuses text without this unit
        return value

    return Annotated[
        float | str, BeforeValidator(check, json_schema_input_type=float | with_unit(unit))
    ]


def _level(value: float | str) -> float | str:
    """Return a value of a history; text without a unit is refused with a ValueError."""
    if isinstance(value, str) and not number_and_unit(value)[1]:
        raise ValueError('is not a number with a unit such as "400 Pa"')
    return value


Time: TypeAlias = measured("second")  # type: ignore[valid-type]
Level: TypeAlias = Annotated[  # what its unit means depends on the load
    float | Annotated[str, Field(examples=["400 Pa"])], AfterValidator(_level)
]


class RampHistory(Section):
    """A ramp from the present load to a value, constant after that."""

    kind: Literal["ramp"]
    to: Level
    """Value at its end, as a target of the load would be, with a unit or without one: 400 Pa or 0.5
    of p_c, a force, an approach, the speed of a spin, the factor of a support. Of the field: a flux
    density, or a part of that in `magnetic`"""
    over: Time
    """Time that it takes"""


class StepHistory(Section):
    """A jump."""

    kind: Literal["step"]
    to: Level
    """Value after it"""
    at: Time = 0.0
    """Time of the jump"""


class WaveHistory(Section):
    """Up and down around a mean value, which it has at first."""

    kind: Literal["triangle", "sine"]
    """With corners, or without"""
    size: Level
    """Largest distance from the mean"""
    period: Time
    """Time of a full wave"""
    mean: Level = 0.0
    """Mean value"""


def _formula(text: str) -> str:
    """Return a formula of the time t; other text is refused with a ValueError."""
    try:
        # formulas know x, y, z as variables: t is written as x, and these are refused
        if re.search(r"\b[xyz]\b", text):
            raise ValueError(text)
        formula(re.sub(r"\bt\b", "x", text))
    except ValueError:
        raise ValueError(
            f"{text!r} is not a formula of the time t, such as 0.5*sin(2*pi*t)"
        ) from None
    return text


Row = Annotated[tuple[Time, Level], Field(strict=False)]
History: TypeAlias = Annotated[
    Annotated[RampHistory, Tag("ramp")]
    | Annotated[StepHistory, Tag("step")]
    | Annotated[WaveHistory, Tag("wave")]
    | Annotated[str, AfterValidator(_formula), Tag("formula")]
    | Annotated[list[Row], Field(min_length=2, max_length=100000), Tag("table")],
    Discriminator(lambda data: _tag(data)),
]


def _tag(data: Any) -> str | None:
    """Return the tag of a history's type for pydantic: of text, a list, or a section by its kind.

    It is None if the data are none of these. Data are as in the case file, or a section already.
    """
    if isinstance(data, str | list):
        return "formula" if isinstance(data, str) else "table"
    kind = data.get("kind") if isinstance(data, dict) else getattr(data, "kind", None)
    return {"ramp": "ramp", "step": "step", "triangle": "wave", "sine": "wave"}.get(str(kind))


def curve(history: History, time: Value, level: Value, start: float) -> Curve:
    """Return a load's history as a function of time: (t, before) -> value.

    `t` is the time since the history began. With `before` the value at a jump is that before it.

    Parameters
    ----------
    history
        A ramp, step, wave, formula or table of the case.
    time, level
        Convert a time, and a value of the history, to a number; either may have a unit.
    start
        The value before the history began.
    """
    if isinstance(history, str):
        # formulas are of arrays of places x, y, z: t stands in place of x
        function = formula(re.sub(r"\bt\b", "x", history))
        return lambda t, before: float(function(*np.array([t, 0.0, 0.0]).reshape(3, 1))[0])
    if isinstance(history, RampHistory):
        duration, end_value = time(history.over), level(history.to)
        # a straight line, and then the value at its end
        return lambda t, before: float(start + (end_value - start) * min(t / duration, 1.0))
    if isinstance(history, StepHistory):
        jump_time, end_value = time(history.at), level(history.to)

        def jump(t: float, before: bool) -> float:
            if t == jump_time:
                return start if before else end_value
            return end_value if t > jump_time else start

        return jump
    if isinstance(history, WaveHistory):
        return _wave(history, time, level)
    return _interpolation([time(t) for t, _ in history], [level(v) for _, v in history])


def _wave(history: WaveHistory, time: Value, level: Value) -> Curve:
    """Return a sine, or a triangle that has the turning points of the sine, as a `Curve`."""
    size, period, mean = level(history.size), time(history.period), level(history.mean)
    if history.kind == "sine":
        return lambda t, before: float(mean + size * np.sin(2 * np.pi * t / period))
    return lambda t, before: float(
        mean + size * (2 / np.pi) * np.arcsin(np.sin(2 * np.pi * t / period))
    )


def _interpolation(times: Sequence[float], values: Sequence[float]) -> Curve:
    """Return straight lines between the values of a table, with its jumps, as a `Curve`.

    Two rows at one time make a jump. Outside the table the first or last value holds.
    """

    def interpolated(t: float, before: bool) -> float:
        # the first row after t; with `before` the first row at t or after it
        row = int(np.searchsorted(times, t, side="left" if before else "right"))
        if row == 0:
            return values[0]
        if row == len(times):
            return values[-1]
        t0, t1 = times[row - 1 : row + 1]
        return values[row - 1] + (values[row] - values[row - 1]) * (t - t0) / (t1 - t0)

    return interpolated


def marks(history: History, time: Value, end: float) -> list[float]:
    """Return the times within (0, end) at which a history jumps or has a kink.

    Parameters
    ----------
    time
        Converts a time of the history to a number.
    """
    times: list[float] = []
    if isinstance(history, RampHistory):
        times = [time(history.over)]
    elif isinstance(history, StepHistory):
        times = [time(history.at)]
    elif isinstance(history, WaveHistory) and history.kind == "triangle":
        quarter = time(history.period) / 4  # corners are at odd quarters
        times = [quarter * i for i in range(1, int(end / quarter) + 1, 2)]
    elif isinstance(history, list):
        times = [time(t) for t, _ in history]
    return [t for t in times if 0 < t < end]


def times_of(history: History) -> list[float | str]:
    """Return all times that a history names, as in the case."""
    if isinstance(history, list):
        return [t for t, _ in history]
    return [getattr(history, key) for key in ("over", "at", "period") if hasattr(history, key)]


def levels_of(history: History) -> list[float | str]:
    """Return all values that a history names, as in the case."""
    if isinstance(history, list):
        return [level for _, level in history]
    return [getattr(history, key) for key in ("to", "size", "mean") if hasattr(history, key)]


Ratio: TypeAlias = measured("pascal")  # type: ignore[valid-type]


class BranchSection(Section):
    """A branch of Maxwell: a spring in series with a dashpot, beside the elastic shell."""

    modulus: Ratio
    """Its Young's modulus, text with a unit, or a number over that of the shell"""
    time: Time
    """Its relaxation time"""


Branches = Annotated[list[BranchSection], Field(max_length=20)]


@dataclass(frozen=True)
class ViscousMaterial(Ability):
    """The viscosity and relaxation of a shell.

    Attributes
    ----------
    viscosity
        A time, as in the case; None without.
    branches
        Maxwell's springs and dashpots in series.
    """

    viscosity: float | str | None
    branches: Sequence[BranchSection]

    @classmethod
    def from_context(cls, context: Context) -> "ViscousMaterial | None":
        """Return the viscosity and relaxation of a case's shell; None without."""
        shell = context.shell
        return (
            cls(shell.viscosity, shell.relaxation)
            if shell.viscosity is not None or shell.relaxation
            else None
        )

    def withdraws(self, context: Context) -> dict[Offer, str]:
        """Return the offer that a viscous shell takes from the case -> what to do."""
        return {"a material without viscosity": "leave out shell.viscosity and shell.relaxation"}

    def refuse_unfit(self, context: Context) -> None:
        """Check that the viscous numbers are positive and that their units have a meaning.

        Raises
        ------
        ValueError
            With the key and what is needed.
        """
        # key below `shell` -> value as in the case
        times = {f"relaxation.{i}.time": branch.time for i, branch in enumerate(self.branches)}
        moduli = {
            f"relaxation.{i}.modulus": branch.modulus for i, branch in enumerate(self.branches)
        }
        if self.viscosity is not None:
            times = {"viscosity": self.viscosity, **times}
        # text with a unit needs a case in which it can be made dimensionless
        has_units = context.time_unit is not None and context.shell.with_units
        for key, value in (times | moduli).items():
            context.needs(f"shell.{key}", "a mid-surface", "the area as drawn")
            if in_units("pascal" if key in moduli else "second")(value) <= 0:
                raise ValueError(f"shell.{key}: {value}: must be positive")
            if isinstance(value, str) and not has_units:
                raise ValueError(
                    f"shell.{key}: {value}: its unit needs shell.density, youngs_modulus and "
                    "lengths"
                )

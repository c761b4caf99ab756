"""The points of a study: cases with keys; axes of `--over`, and the points of their product.

An axis is one direction of a sweep: a key of the case with its values, or several keys that are
tied with `+` and take the same values. A point has a value for each axis. A key is a path of words
with dots into the case; a source is a case file with settings `key=value`.
"""

import copy
import hashlib
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import prod
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from magshell_fenicsx.input.section import in_unit, number_and_unit
from magshell_fenicsx.input.source import CaseError, Source, override, read_source
from magshell_fenicsx.parts.magnetism.interaction import has_effect
from magshell_fenicsx.problem.memory import refuse_beyond_memory

# what the front end makes of a source; `problem()` makes its problem: a study does not know its
# class
Case = Any
MakeCase = Callable[[Source], Case]
MOST_POINTS = 10_000
FORMS = "write it as key.path=start:stop:count or key.path=value,value,..."


class StudyPoint(Protocol):
    """A point of a study: one of its cases."""

    @property
    def case(self) -> Case:
        """The validated case."""

    @property
    def key(self) -> str:
        """Name of its outcome; equal problems have equal keys."""

    @property
    def label(self) -> str:
        """The point in words, on a line of its own when it is computed."""


@dataclass(frozen=True)
class Axis:
    """One direction of a sweep: keys of the case that take the same values.

    Attributes
    ----------
    keys
        Keys that are tied: they take the same value.
    values
        Values as in the case file.
    """

    keys: tuple[str, ...]
    values: tuple[str, ...]

    @property
    def name(self) -> str:
        """The keys as in `--over`."""
        return "+".join(self.keys)

    @cached_property
    def unit(self) -> str:
        """Unit of the first value that has one; "" without."""
        return next(filter(None, (number_and_unit(value)[1] for value in self.values)), "")

    @cached_property
    def numbers(self) -> list[float] | None:
        """The values as numbers in the axis's unit; None if one of them is a word."""
        try:
            return [self.number(value) for value in self.values]
        except ValueError:
            return None

    def number(self, value: str) -> float:
        """Return a value as a number in the axis's unit; a word raises ValueError."""
        return in_unit(value, self.unit)


def last_numeric_axis(axes: Sequence[Axis]) -> Axis | None:
    """Return the last axis with numbers, along which curves are drawn and folds are followed.

    None if there is none.
    """
    return next((axis for axis in reversed(axes) if axis.numbers), None)


def parse_axes(texts: Sequence[str]) -> list[Axis]:
    """Read all texts of `--over` as the axes of a sweep.

    Raises
    ------
    CaseError
        If one has another form, or a key is swept twice.
    """
    axes = [parse_axis(text) for text in texts]
    keys = [key for axis in axes for key in axis.keys]
    for key in keys:
        if keys.count(key) > 1:
            raise CaseError(
                f"--over: {key} is swept twice; keys that vary together are tied with +"
            )
    return axes


def parse_axis(text: str) -> Axis:
    """Read one text of `--over` as an axis of a sweep.

    Raises
    ------
    CaseError
        If it has another form.

    Examples
    --------
    >>> parse_axis("a.x+a.y=0:90:3")
    Axis(keys=('a.x', 'a.y'), values=('0', '45', '90'))
    >>> parse_axis("magnetic.energy=full,first").values
    ('full', 'first')
    >>> parse_axis("magnetic.applied.flux_density=-40mT:0.04T:3").values
    ('-40 mT', '0 mT', '40 mT')
    """
    path, equals, values = text.partition("=")
    keys = tuple(key.strip() for key in path.split("+"))
    if not equals or not all(re.fullmatch(r"\w+(\.\w+)*", key) for key in keys):
        raise CaseError(f"--over {text}: {FORMS}; keys that vary together are tied with +")
    return Axis(keys, _range(text, values) if ":" in values else _list(text, values))


def _range(text: str, values: str) -> tuple[str, ...]:
    """Return the values of start:stop:count, equidistant with both ends.

    They are in the unit of the first end that has one.

    Parameters
    ----------
    text
        The whole argument of `--over`, for messages.

    Raises
    ------
    CaseError
        If the values have another form.
    """
    try:
        first, last, number = values.split(":")
        unit = number_and_unit(first)[1] or number_and_unit(last)[1]
        start, stop = (in_unit(end, unit) if unit else float(end) for end in (first, last))
        count = int(number)
    except ValueError:
        raise CaseError(
            f"--over {text}: {values} is not start:stop:count (two numbers of one unit and a whole "
            "number)"
        ) from None
    if not (math.isfinite(start) and math.isfinite(stop)):
        raise CaseError(f"--over {text}: start and stop must be finite")
    if not 2 <= count <= MOST_POINTS:
        raise CaseError(f"--over {text}: count is {count}; allowed 2 to {MOST_POINTS}")
    # adding 0.0 turns -0.0 into 0.0
    return tuple(f"{value + 0.0:.12g} {unit}".rstrip() for value in np.linspace(start, stop, count))


def _list(text: str, values: str) -> tuple[str, ...]:
    """Return the values of a list with commas, stripped.

    Parameters
    ----------
    text
        The whole argument of `--over`, for messages.

    Raises
    ------
    CaseError
        If a value is missing, or is a section or a list.
    """
    items = tuple(value.strip() for value in values.split(","))
    if not all(items):
        raise CaseError(f"--over {text}: a value is missing; {FORMS}")
    if re.search(r"[\[\]{}]", values):
        raise CaseError(
            f"--over {text}: only numbers and words can be swept, not sections or lists"
        )
    return items


@dataclass(frozen=True)
class SweepPoint:
    """One point of a sweep: a case with a value for each axis.

    Attributes
    ----------
    values
        Swept key -> its value at this point, as text.
    case
        The validated case.
    key
        Hash of the problem; equal problems have equal keys in any sweep and version.
    """

    values: dict[str, str]
    case: Case
    key: str

    @property
    def label(self) -> str:
        """Keys and values in words, for example `energy=full, remanent.polar=45`."""
        return ", ".join(f"{short_key(key)}={value}" for key, value in self.values.items())


def point_columns(axes: Sequence[Axis], point: SweepPoint) -> dict[str, Any]:
    """Return the columns of a point in a table: swept keys, their numbers, and `point`, its key.

    Values that have a unit are text as in the case file; their numbers have the unit in the name of
    the column, `key_unit`.
    """
    columns: dict[str, Any] = {**point.values, "point": point.key}
    for axis in axes:
        if axis.unit and axis.numbers:
            columns |= {f"{key}_{axis.unit}": axis.number(point.values[key]) for key in axis.keys}
    return columns


def make_points(source: Source, axes: Sequence[Axis], make_case: MakeCase) -> list[SweepPoint]:
    """Return all points, in the order of the product, the last axis fastest.

    Raises
    ------
    CaseError
        If any point is not a valid case; nothing has been computed then.
    """
    count = prod(len(axis.values) for axis in axes)
    if count > MOST_POINTS:
        raise CaseError(f"--over: {count} points; allowed at most {MOST_POINTS}")
    values_of_axes = [axis.values for axis in axes]
    return [make_point(source, axes, values, make_case) for values in product(*values_of_axes)]


def swept_source(file: Path, axes: Sequence[Axis], settings: Sequence[str]) -> Source:
    """Return the source of the case that is swept, with its settings.

    Raises
    ------
    CaseError
        If the case cannot be read, or a setting is of a swept key.
    """
    source = read_source(file)
    for setting in settings:
        if setting.partition("=")[0].strip() in {key for axis in axes for key in axis.keys}:
            raise CaseError(f"--set {setting}: this key is swept by --over")
        override(source, setting)
    return source


def make_point(
    source: Source, axes: Sequence[Axis], values: Sequence[str], make_case: MakeCase
) -> SweepPoint:
    """Return the point with one value for each axis.

    Raises
    ------
    CaseError
        If it is not a valid case, or needs more memory than there is; the message names the point.
    """
    point_source = copy.deepcopy(source)
    values_by_key = {
        key: value for axis, value in zip(axes, values, strict=True) for key in axis.keys
    }
    assignments = [f"{key}={value}" for key, value in values_by_key.items()]
    try:
        for assignment in assignments:
            override(point_source, assignment)
        case = make_case(point_source)
        refuse_beyond_memory(case.problem())  # raises its errors, such as a missing mirror plane
    except CaseError as e:
        message = str(e)
        # the user gave --over, not --set
        for assignment in assignments:
            message = message.replace(f"--set {assignment}", f"--over {assignment}")
        raise CaseError(f"{message}\nin the point {', '.join(assignments)}") from None
    return SweepPoint(values_by_key, case, identity(case))


def identity(case: Case) -> str:
    """Return a hash of the problem: of the case with its defaults, and of its mesh file.

    A magnetic section that has no effect does not count, as one with a field of zero.
    """
    data = case.model_dump(mode="json") | case.outside
    if not has_effect(case.context):
        del data["magnetic"]
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def short_key(key: str) -> str:
    """Return the last word of a key, for an angle with the word before: "remanent.polar"."""
    words = key.split(".")
    return ".".join(words[-2:] if words[-1] in ("polar", "azimuth") else words[-1:])


def value_at(data: Any, path: Sequence[str]) -> Any:
    """Return the value of a key in plain data of a case; None if there is no such key.

    Parameters
    ----------
    path
        The words of the key; a number is the index of an item.
    """
    for word in path:
        try:
            data = data[int(word)] if isinstance(data, list) else data[word]
        except (LookupError, ValueError, TypeError):
            return None
    return data

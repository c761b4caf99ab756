"""The points of a sweep: the product of its axes, each a valid case."""

import copy
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import prod
from pathlib import Path

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import CaseError, Source, override, read_source
from magshell_fenicsx.problem.limits import refuse_beyond_memory
from magshell_fenicsx.problem.planner import make_plan
from magshell_fenicsx.studies.sweep.axes import MOST_POINTS, Axis


@dataclass(frozen=True)
class SweepPoint:
    """One point.

    Attributes
    ----------
    values
        Swept key -> its value at this point, as text.
    key
        Hash of the problem; equal problems have equal keys in any sweep and version.
    """

    values: dict[str, str]
    case: Case
    key: str

    @property
    def label(self) -> str:
        """For example `energy=full, remanent.polar=45`."""
        return ", ".join(f"{short(key)}={value}" for key, value in self.values.items())


def make_points(file: Path, axes: Sequence[Axis], settings: Sequence[str] = ()) -> list[SweepPoint]:
    """All points, in the order of the product, the last axis fastest.

    Raises
    ------
    CaseError
        If any point is not a valid case; nothing has been computed then.
    """
    source = swept_source(file, axes, settings)
    count = prod(len(axis.values) for axis in axes)
    if count > MOST_POINTS:
        raise CaseError(f"--over: {count} points; allowed at most {MOST_POINTS}")
    return [make_point(source, axes, values) for values in product(*(axis.values for axis in axes))]


def swept_source(file: Path, axes: Sequence[Axis], settings: Sequence[str]) -> Source:
    """The case that is swept, with the settings.

    Raises
    ------
    CaseError
        If it cannot be read, or a setting is of a swept key.
    """
    source = read_source(file)
    for setting in settings:
        if setting.partition("=")[0].strip() in {key for axis in axes for key in axis.keys}:
            raise CaseError(f"--set {setting}: this key is swept by --over")
        override(source, setting)
    return source


def make_point(source: Source, axes: Sequence[Axis], values: Sequence[str]) -> SweepPoint:
    """The point with one value for each axis."""
    here = copy.deepcopy(source)
    chosen = {key: value for axis, value in zip(axes, values, strict=True) for key in axis.keys}
    assignments = [f"{key}={value}" for key, value in chosen.items()]
    try:
        for assignment in assignments:
            override(here, assignment)
        case = Case.from_source(here)
        refuse_beyond_memory(case, make_plan(case))  # raises the errors of the plan, such as a missing mirror plane
    except CaseError as e:
        message = str(e)
        for assignment in assignments:
            message = message.replace(f"--set {assignment}", f"--over {assignment}")
        raise CaseError(f"{message}\nin the point {', '.join(assignments)}") from None
    return SweepPoint(chosen, case, identity(case))


def identity(case: Case) -> str:
    """Hash of the problem: the resolved case, without a zero field, and its mesh file."""
    data = case.model_dump(mode="json") | case.outside
    if not case.lambda_m:
        del data["magnetic"]
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def short(key: str) -> str:
    """The short name of a key: `energy`, `remanent.polar`."""
    words = key.split(".")
    return ".".join(words[-2:] if words[-1] in ("polar", "azimuth") else words[-1:])

"""The numbers of a design: their bounds and units, against the case that it starts from."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.design import DesignSection
from magshell_fenicsx.input.section import in_unit
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.simulate.numbers import number_of

Array = NDArray[np.float64]


def refuse_unfit_numbers(source: Source, case: Case, design: DesignSection) -> tuple[Array, tuple[str, ...]]:
    """The bounds (numbers, 2) of the numbers of a design, and their units.

    Raises
    ------
    CaseError
        If a key has no number, another unit, or starts beyond its bounds.
    """
    found, units = [], []
    for key in design.numbers:
        low, high, unit = design.bounds(key)
        try:
            value, written = number_of(case, key), _written(source, key)
        except CaseError as e:
            raise CaseError(f"design.numbers: {e}") from None
        if isinstance(written, str):
            try:
                value = in_unit(written, unit)
            except ValueError:
                raise CaseError(
                    f"design.numbers: {key}: the case gives {written}: its bounds need such a unit"
                ) from None
        elif unit:
            raise CaseError(f"design.numbers: {key}: is a number without a unit in the case: so are its bounds")
        if not low <= value <= high:
            raise CaseError(f"design.numbers: {key}: the case starts at {value:g}, beyond {low:g} to {high:g}")
        found.append((low, high))
        units.append(unit)
    return np.array(found, dtype=float).reshape(-1, 2), tuple(units)


def _written(source: Source, key: str) -> Any:
    """The value at a key as it was written; None of a default."""
    part: Any = source.data
    for name in key.split("."):
        part = part[int(name)] if isinstance(part, list) else part.get(name) if isinstance(part, dict) else None
    return part

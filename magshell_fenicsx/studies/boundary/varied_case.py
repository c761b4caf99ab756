"""The case of a boundary of stability at all values of the key that varies."""

import copy
import hashlib
import json
import re
from dataclasses import asdict, dataclass

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.input.section import in_unit, number_and_unit
from magshell_fenicsx.input.source import CaseError, Source, override
from magshell_fenicsx.problem.memory import refuse_beyond_memory
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.simulate.perfect import with_modes
from magshell_fenicsx.simulate.perturbation import KEYS_OUTSIDE_THE_MODEL
from magshell_fenicsx.studies.points import MakeCase, value_at

FORM_HINT = "write it as key.path=first:last or key.path=first:last:steps, with numbers of one unit"
DEFAULT_STEPS, MAX_STEPS = 20, 1000


@dataclass(frozen=True)
class VariedKey:
    """The key of a case that varies, and its range.

    Attributes
    ----------
    first, last
        First and last value in `unit`, in either order.
    unit
        Unit of the values; "" without.
    steps
        Least number of steps between both.
    """

    key: str
    first: float
    last: float
    unit: str
    steps: int

    @property
    def ends(self) -> tuple[float, float]:
        """The least and the largest value, in rising order."""
        return min(self.first, self.last), max(self.first, self.last)

    def text(self, value: float) -> str:
        """Return a value in the unit as in the case file."""
        return f"{float(value)!r} {self.unit}".rstrip()


def parse_range(text: str) -> VariedKey:
    """Read `--over`, the key of a boundary and its range.

    Raises
    ------
    CaseError
        If the text has another form, or is no range.

    Examples
    --------
    >>> parse_range("magnetic.applied.flux_density=-40mT:0.04T")
    VariedKey(key='magnetic.applied.flux_density', first=-40.0, last=40.0, unit='mT', steps=20)
    >>> parse_range("foundation.stiffness=0:1e-3:40").steps
    40
    """
    key, _, values = text.partition("=")
    bounds_and_steps = values.split(":")
    # the values are first:last or first:last:steps
    try:
        if not re.fullmatch(r"\w+(\.\w+)*", key) or len(bounds_and_steps) not in (2, 3):
            raise ValueError
        # the unit of the first bound that has one counts for both
        unit = number_and_unit(bounds_and_steps[0])[1] or number_and_unit(bounds_and_steps[1])[1]
        first, last = (in_unit(text_of_bound, unit) for text_of_bound in bounds_and_steps[:2])
        steps = int(bounds_and_steps[2]) if len(bounds_and_steps) == 3 else DEFAULT_STEPS
    except ValueError:
        raise CaseError(f"--over {text}: {FORM_HINT}") from None
    if not np.isfinite([first, last]).all() or first == last:
        raise CaseError(f"--over {text}: first and last must be two different finite numbers")
    if not 1 <= steps <= MAX_STEPS:
        raise CaseError(f"--over {text}: steps is {steps}; allowed 1 to {MAX_STEPS}")
    if key.split(".")[0] in KEYS_OUTSIDE_THE_MODEL:
        raise CaseError(
            f"--over {text}: {key.split('.')[0]} is no part of the shell or of its loads, so has "
            "no boundary"
        )
    return VariedKey(key, first, last, unit, steps)


@dataclass(frozen=True)
class VariedCase:
    """A case with a key that varies in a range.

    Attributes
    ----------
    source
        The file of the case, with its settings.
    span
        The key and its range.
    make_case
        Makes a case of its source.
    """

    source: Source
    span: VariedKey
    make_case: MakeCase

    def start_value(self, *, may_be_outside: bool) -> float:
        """Return the value of the key, in the unit of the range, at which the boundary starts.

        It is the value of the case; outside the range the nearest end. If the case has no number in
        this unit there, such as a word, it is the first value of the range.

        Parameters
        ----------
        may_be_outside
            Whether the value of the case may be outside the range.

        Raises
        ------
        CaseError
            If the key is a section, a list or a truth value, or its value is outside.
        """
        span, key_path = self.span, self.span.key.split(".")
        value_in_case = value_at(self.source.data, key_path)
        if value_in_case is None:  # the case file does not have the key: its default counts
            value_in_case = value_at(self.make_case(self.source).model_dump(mode="json"), key_path)
        try:
            value = in_unit(str(value_in_case), span.unit)
        except ValueError:  # no number in this unit
            if isinstance(value_in_case, dict | list | bool):
                type_name = type(value_in_case).__name__
                raise CaseError(
                    f"--over {span.key}: is no number in the case, but {type_name}"
                ) from None
            value = span.first
        if not may_be_outside and not span.ends[0] <= value <= span.ends[1]:
            raise CaseError(
                f"--over {span.key}: the run that it starts from has {span.text(value)}, outside "
                "the range"
            )
        return float(np.clip(value, *span.ends))

    def problem(self, value: float) -> Problem:
        """Return the problem of the case at a value of the key, in the unit of the range.

        It has the modes of the perfect shell that its imperfections need.

        Raises
        ------
        CaseError
            If the problem is not valid.
        """
        source_at_value = copy.deepcopy(self.source)
        assignment = f"{self.span.key}={self.span.text(value)}"
        try:
            override(source_at_value, assignment)
            problem: Problem = self.make_case(source_at_value).problem()
            refuse_beyond_memory(problem)
        except CaseError as e:
            raise CaseError(str(e).replace(f"--set {assignment}", f"--over {assignment}")) from None
        return with_modes(problem, MPI.COMM_SELF) if problem.pending_modes else problem

    def identity(self, start: str) -> str:
        """Return a hash of the case, the range and the start of its boundary; journals have it."""
        case = self.make_case(self.source)
        data = [
            case.model_dump(mode="json") | case.outside,
            asdict(self.span),
            *([start] if start else []),
        ]
        return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]

"""The number of a run that `--result` names: a scalar.

It is a number of summary.json, or COLUMN@COLUMN=VALUE: a column of path.csv at the point of the
path where another column (the place) first has a value. A critical field is its strength at an
instability; a snap is a jump of a motion in time. Rows of branches and of excluded modes are no
part of the path.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from scipy.interpolate import barycentric_interpolate

import magshell_fenicsx.parts.registered  # noqa: F401  the columns of parts are in the registry
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.quantities.registry import OWN_MODES, amplitude, is_column_of_numbers
from magshell_fenicsx.runs.summary import IN_UNITS

OF_SNAPS = {"snap_time": "time", "snap_departure": "departure", "snap_jump": "jump"}
IN_SUMMARY = ("knockdown", "barrier", "critical_field", *OF_SNAPS)
IN_SUMMARY_IN_UNITS = tuple(sorted(set[str]().union(*IN_UNITS.values())))  # of a case with units
FREQUENCY = re.compile(r"(omega2|hertz)_[1-9]\d*")
FORMS = (
    f"write {', '.join((*IN_SUMMARY, *IN_SUMMARY_IN_UNITS))}, COLUMN@COLUMN=VALUE or COLUMN@end, "
    "with columns of path.csv"
)


@dataclass(frozen=True)
class Scalar:
    """A named number of a run, such as the knockdown factor or a column at a place of the path.

    Attributes
    ----------
    name
        The text of `--result`.
    column, at, value
        For a number of the path: its column, and the column and value at which it is taken. `at` is
        "end" for the last point.
    """

    name: str
    column: str = ""
    at: str = ""
    value: float = 0.0

    @property
    def is_frequency(self) -> bool:
        """Whether it is a natural frequency where the path ends."""
        return bool(FREQUENCY.fullmatch(self.column))

    def value_in(
        self, summary: Mapping[str, Any], rows: Sequence[Mapping[str, str]]
    ) -> float | None:
        """Return the number; None if the run does not have it.

        Parameters
        ----------
        summary, rows
            The content of summary.json and of path.csv.
        """
        if self.name in IN_SUMMARY_IN_UNITS:
            return _number((summary.get("in_units") or {}).get(self.name))
        if self.name in ("knockdown", "barrier"):
            return _number(summary[self.name])
        if self.name == "critical_field":
            # the first limit point of the field
            points = (
                point["value"]
                for point in summary["limit_points"]
                if self.name in amplitude(point["amplitude"]).critical_names
            )
            return _number(next(points, None))
        if self.name in OF_SNAPS:
            first_snap: Mapping[str, float] = next(iter(summary.get("snaps", ())), {})
            # snaps of earlier versions have `time` alone
            return _number(first_snap.get(OF_SNAPS[self.name]))
        # a number of the path; branches and excluded modes are left out
        path = [row for row in rows if row["branch"] == "0" and row["mode"] in OWN_MODES]
        # the rows must have both columns; "end" is no column
        needed_columns = {self.column, self.at} - {"end"}
        # the last row has the frequencies of the end, too
        if not path or not needed_columns <= set(path[-1 if self.at == "end" else 0]):
            return None
        if self.at == "end":
            return float(path[-1][self.column])
        return _crossing(path, self.column, self.at, self.value)

    def error_in(
        self, errors: Mapping[str, float], rows: Sequence[Mapping[str, str]]
    ) -> float | None:
        """Return the estimated error of the number; None if it has no estimate.

        A number of the path has one at its last point.

        Parameters
        ----------
        errors, rows
            `errors` of summary.json, and the content of path.csv.
        """
        if not self.column:
            return _number(errors.get(self.name))
        path = [row for row in rows if row["branch"] == "0" and row["mode"] in OWN_MODES]
        is_at_end = self.at == "end"
        if path and self.at in path[-1]:
            *earlier_places, last_place = (float(row[self.at]) for row in path)
            is_passed_before = any(
                (a - self.value) * (b - self.value) <= 0 for a, b in pairwise(earlier_places)
            )
            is_last = math.isclose(last_place, self.value, rel_tol=1e-9)
            is_at_end = is_last and not is_passed_before
        return _number(errors.get(f"{self.column}@end")) if is_at_end else None


def parse_scalar(text: str, *, with_frequencies: bool = False) -> Scalar:
    """Read `--result`, the name of a number of a run.

    Parameters
    ----------
    with_frequencies
        Whether natural frequencies at the end, such as "hertz_1@end", are such numbers.

    Raises
    ------
    CaseError
        If the text has another form.

    Examples
    --------
    >>> parse_scalar("force_N@w_mm=2.5").at
    'w_mm'
    >>> parse_scalar("force@w_over_h=10")
    Scalar(name='force@w_over_h=10', column='force', at='w_over_h', value=10.0)
    """
    if text in (*IN_SUMMARY, *IN_SUMMARY_IN_UNITS):
        return Scalar(text)
    column, _, place = text.partition("@")
    place_column, _, number = place.partition("=")
    if FREQUENCY.fullmatch(column):
        if with_frequencies and place == "end":
            return Scalar(text, column, "end")
        raise CaseError(
            f"--result {text}: {column} is a natural frequency, which path.csv has not: runs with "
            "frequencies: {at: end} list it in frequencies.csv; design, identify and gradients "
            f"take it as a result, and sweep as {column}@end"
        )
    # both names must be columns with numbers; "end" has no second one
    for name in (column, place_column) if place != "end" else (column,):
        if not is_column_of_numbers(name):
            raise CaseError(
                f"--result {text}: {name or 'nothing'} is no column with numbers; {FORMS}"
            )
    if place == "end":
        return Scalar(text, column, "end")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise CaseError(f"--result {text}: {number or 'nothing'} is no finite number; {FORMS}")
    return Scalar(text, column, place_column, value)


def _crossing(
    path: Sequence[Mapping[str, str]], column: str, place_column: str, value: float
) -> float | None:
    """Return a column at the first place with a value, by cubic interpolation; None without one.

    The interpolation uses points of one load, because the curve has a corner at the end of the
    field. At a requested point of the path the result is the number in its row.

    Parameters
    ----------
    path
        Rows of path.csv without branches.
    place_column, value
        Column that has the value at the place.
    """
    places = [float(row[place_column]) for row in path]
    # the first interval (i, i + 1) of the path that has the value within
    i = next(
        (
            i
            for i in range(len(places) - 1)
            if (places[i] - value) * (places[i + 1] - value) <= 0 and places[i] != places[i + 1]
        ),
        None,
    )
    if i is None:
        # a target is reached within the solver's tolerance
        target_reached = bool(places) and math.isclose(places[-1], value, rel_tol=1e-9)
        return float(path[-1][column]) if target_reached else None
    # the interval's ends, and one more point on either side if the same load varies there
    first, last = i, i + 1
    if i and path[i]["amplitude"] == path[i + 1]["amplitude"]:
        first -= 1
    if i + 2 < len(path) and path[i + 2]["amplitude"] == path[i + 1]["amplitude"]:
        last += 1
    window = slice(first, last + 1)
    # where the place turns back, linear between the two points around it
    if not _monotone(places[window]):
        window = slice(i, i + 2)
    values = [float(row[column]) for row in path[window]]
    return float(barycentric_interpolate(places[window], values, value))


def _monotone(x: Sequence[float]) -> bool:
    """Return whether numbers only grow, or only fall."""
    steps = [b - a for a, b in pairwise(x)]
    return all(step > 0 for step in steps) or all(step < 0 for step in steps)


def _number(value: float | None) -> float | None:
    """Return a number as a float; None stays None."""
    return None if value is None else float(value)

"""Input of `magshell identify`: measured columns as readings of a case.

A reading (`simulate.readings.Reading`) is a result of the case, `of`, at a place of its last step.
A place is a value of the load or displacement that this step prescribes. A setting is an assignment
`key=value` to a key of the case. A measured shape is given by points on the undeformed shell with
their displacements; the points are added to the case's named points. A noise is the standard
deviation of errors of measurement. A column that `changes` names counts from the begin of the last
step. A location is the key or file with which an error message begins.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.input.tables import (
    TableError,
    TableRows,
    column_size,
    read_rows,
)
from magshell_fenicsx.platform.input_files import Files
from magshell_fenicsx.quantities.registry import QUANTITIES, endings
from magshell_fenicsx.simulate.gradients.instabilities import FOLDS
from magshell_fenicsx.simulate.gradients.vibration import NAMES
from magshell_fenicsx.simulate.readings import Reading
from magshell_fenicsx.studies.identify.parameters import parameters_of, refuse_size
from magshell_fenicsx.studies.identify.result_names import DISPLACEMENTS, ResultNames
from magshell_fenicsx.studies.identify.sections import CandidateSection, IdentifySection
from magshell_fenicsx.studies.points import Case

Array = NDArray[np.float64]
# a header in the data: a name, and perhaps a unit in brackets
HEADER = re.compile(r"\s*([\w.]+)\s*(?:[\[(]\s*([^\])]+?)\s*[\])])?\s*")
MOST_READINGS = 10_000
# columns of a shape: places, beside `DISPLACEMENTS` of these
SHAPE = ("x", "y", "z")
OF_POINTS = "measured_"  # names of these places in the case


@dataclass(frozen=True)
class MeasuredColumn:
    """A measured result: a column of the data file.

    Attributes
    ----------
    header
        Name in the file, without the unit.
    of
        Name of the result; for a displacement of a shape its ending after the point's name ("_ux").
    unit
        Unit of the result in the case; "" if it has none.
    noise
        Standard deviation of the noise in `unit`; nan if it is to be estimated.
    """

    header: str
    of: str
    unit: str
    noise: float


@dataclass(frozen=True)
class MeasuredTable:
    """Measured data, as readings of a case.

    Attributes
    ----------
    columns
        The measured results.
    readings
        Settings of the case, as for `--set` -> readings, in the order of `data`.
    data, column
        (n,) the measured numbers in the case's units, and the index in `columns` of each.
    places
        Name of the result that gives the places; "" without.
    shape
        Name of a point of the measured shape -> its coordinates (x, y, z) on the undeformed shell,
        in the unit of its displacements.
    missing
        Header of a column -> number of rows in which it is empty.
    rows
        Settings -> file and line of each reading, for messages.
    """

    columns: tuple[MeasuredColumn, ...]
    readings: Mapping[tuple[str, ...], list[Reading]]
    data: Array
    column: NDArray[np.int64]
    places: str
    shape: Mapping[str, list[float]] = field(default_factory=dict)
    missing: Mapping[str, int] = field(default_factory=dict)
    rows: Mapping[tuple[str, ...], list[str]] = field(default_factory=dict)


def _in_units(point: Sequence[float], units: Mapping[str, str | None]) -> list[float | str]:
    """Return coordinates (x, y, z) as a case has them: text where there is a unit."""
    return [
        f"{v!r} {units[axis]}" if units[axis] else v for v, axis in zip(point, SHAPE, strict=True)
    ]


def with_shape(file: Path, source: Source) -> tuple[Source, list[str], dict[str, list[float]]]:
    """Return the case with the points of a measured shape among its named points.

    Rows at the same point share one name.

    Returns
    -------
    source
        The case; unchanged if the file has no columns x, y, z.
    names
        Name of the point of each row; empty without a shape.
    shape
        Name of a point -> its coordinates (x, y, z) in the file's units.

    Raises
    ------
    CaseError
        If coordinates lack displacements, or a coordinate is missing.
    """
    table = _rows_of(file)
    columns, units = table.columns, table.units
    location, present_axes = f"--data {file}", [name for name in SHAPE if name in columns]
    if not present_axes:
        return source, [], {}
    if len(present_axes) < len(SHAPE) or not any(name in columns for name in DISPLACEMENTS):
        raise CaseError(
            f"{location}: a shape needs the columns {', '.join(SHAPE)} "
            f"and of {', '.join(DISPLACEMENTS)} one or more"
        )
    # coordinates (x, y, z) of each row
    coordinates = np.column_stack([columns[name] for name in SHAPE])
    rows: list[list[float]] = [list(map(float, row)) for row in coordinates]
    for axis in SHAPE:
        _refuse_missing(axis, columns[axis], table.lines, location)
    # a point has the number of the first row with it: in reversed order this one is written last
    point_names = {tuple(row): f"{OF_POINTS}{i}" for i, row in reversed(list(enumerate(rows, 1)))}
    shape = {point_names[tuple(row)]: row for row in rows}
    points_of_shape = {name: _in_units(row, units) for name, row in shape.items()}
    # the named points of the case, and these
    data = {**source.data, "points": {**(source.data.get("points") or {}), **points_of_shape}}
    shape_source = Source(source.name, data, source.places, source.folder, source.files)
    return shape_source, [point_names[tuple(row)] for row in rows], shape


def _rows_of(file: Path) -> TableRows:
    """Read the rows of a data file; its `TableError` becomes a `CaseError` with the file's name."""
    try:
        return read_rows(file, Files())
    except TableError as e:
        raise CaseError(f"--data {file}: {e}") from None


def _refuse_missing(name: str, values: Array, lines: Sequence[int], location: str) -> None:
    """Check that a column of places or keys has a number in every row.

    Parameters
    ----------
    name, values
        Header of the column, and its numbers; nan where a cell is empty.
    lines
        Line of each row in the file, for the message.
    location
        The data file, for the message.

    Raises
    ------
    CaseError
        With the first row without a number.
    """
    rows_without_number = np.flatnonzero(np.isnan(values))
    if rows_without_number.size:
        line = lines[rows_without_number[0]]
        raise CaseError(f"{location}: line {line}: {name}: has a row without a number")


def refuse_twice(
    header: str, result: str, earlier_headers: Mapping[str, str], location: str
) -> None:
    """Check that a column is of another result, or key, than all earlier columns.

    Parameters
    ----------
    header, result
        Header of the column, and the result or key that it has.
    earlier_headers
        Result or key -> header, of the earlier columns.

    Raises
    ------
    CaseError
        With both headers.
    """
    quantity = quantity_of(result)
    duplicate = next((name for name in earlier_headers if quantity_of(name) == quantity), None)
    if duplicate is not None:
        raise CaseError(
            f"{location}: {earlier_headers[duplicate]} and {header} are one measurement in two "
            "columns: leave one out"
        )


def quantity_of(result: str) -> str:
    """Return one name for a result in all its units; of a fold the name of its load.

    Examples
    --------
    >>> quantity_of("w_mm"), quantity_of("tip_ux_mm"), quantity_of("omega2_3")
    ('w_over_h', 'tip_ux', 'hertz_3')
    """
    if result in FOLDS:
        return f"fold of {FOLDS[result]}"
    if result.startswith("omega2_"):
        return result.replace("omega2_", "hertz_")
    for quantity in QUANTITIES.values():
        if any(result == in_units.name for in_units in quantity.in_units):
            return quantity.name
    # any other result: its name without a unit at the end, such as "_mm"
    ending = next((ending for ending in endings() if result.endswith(f"_{ending}")), "")
    return result.removesuffix(f"_{ending}")


def table_of(
    file: Path,
    case: Case,
    section: IdentifySection,
    rows: Sequence[str] = (),
    shape: Mapping[str, list[float]] | None = None,
) -> MeasuredTable:
    """Read the measured columns of a data file as readings of a case.

    Parameters
    ----------
    rows
        Name of the point of each row, from `with_shape`; empty without a measured shape.
    shape
        Name of a point -> its coordinates in the file's units, from `with_shape`.

    Raises
    ------
    CaseError
        If a column is no result or has no unit, or if the section names a missing column.
    """
    rows_of_file = _rows_of(file)
    columns, units = rows_of_file.columns, rows_of_file.units
    names, location, headers_by_result = ResultNames(case), f"--data {file}", dict[str, str]()
    place_values: Array = np.full(0, np.nan)
    # key -> unit and values of a column of settings; measured columns with their values
    keys, results = dict[str, tuple[str, Array]](), list[tuple[MeasuredColumn, Array]]()
    places = displacement_unit = ""
    for header, values in columns.items():
        name, unit = _name_and_unit(header, units[header])
        # a dotted name is a key of the case: a setting of each row
        if "." in name:
            refuse_twice(header, name, headers_by_result, location)
            _refuse_missing(header, values, rows_of_file.lines, location)
            keys[name], headers_by_result[name] = (unit or "", values), header
            continue
        if rows and name in SHAPE:
            continue  # `with_shape` has read these columns
        is_displacement = bool(rows) and name in DISPLACEMENTS
        # displacements of all points have one unit; the first point stands for them
        result, case_unit, factor = names.result_of(
            f"{rows[0]}_{name}" if is_displacement else name, unit, location
        )
        refuse_twice(header, result, headers_by_result, location)
        headers_by_result[result] = header
        # the column of what the last step prescribes has the places
        if names.places and result == names.places.column:
            _refuse_missing(header, values, rows_of_file.lines, location)
            place_values, places = values * factor, result
            continue
        noise = _noise_of_column(section, names, name, result)
        if is_displacement:  # of all points: without the name of the first one
            result, displacement_unit = result.removeprefix(rows[0]), case_unit
        results.append((MeasuredColumn(name, result, case_unit, noise), values * factor))
    if not results:
        raise CaseError(f"{location}: has no column with a result of this case")
    _refuse_unknown(section, [measured_column for measured_column, _ in results], location)
    table = _grouped_by_settings(
        results,
        keys,
        place_values,
        places,
        section,
        location,
        points=rows,
        lines=rows_of_file.lines,
    )
    return replace(table, shape=_in_displacement_unit(shape or {}, units, displacement_unit))


def _name_and_unit(header: str, unit_of_column: str | None) -> tuple[str, str | None]:
    """Return the name of a column without its unit in brackets, and the unit; None without one.

    Parameters
    ----------
    unit_of_column
        The unit of the column where the header has none in brackets.
    """
    header_match = HEADER.fullmatch(header)
    if not header_match:
        return header, None
    return header_match[1], header_match[2] or unit_of_column


def _noise_of_column(section: IdentifySection, names: ResultNames, name: str, result: str) -> float:
    """Return the standard deviation of the noise of a measured column, in the result's unit.

    It is nan if the section does not give it, so that it is to be estimated.

    Parameters
    ----------
    name, result
        Name of the column in the file, and of its result in the case; the section may use either.

    Raises
    ------
    CaseError
        If its unit is missing or of another dimension, or it is not positive or out of bounds.
    """
    noise = section.noise.get(name, section.noise.get(result))
    if noise is None:
        return np.nan
    deviation = names.amount(noise, result, f"identify.noise.{name}")
    refuse_size(deviation, noise, f"identify.noise.{name}")
    return deviation


def _in_displacement_unit(
    shape: Mapping[str, list[float]], units: Mapping[str, str | None], displacement_unit: str
) -> dict[str, list[float]]:
    """Return the points of a measured shape with coordinates in the unit of its displacements.

    Parameters
    ----------
    shape
        Name of a point -> its coordinates (x, y, z) in the file's units.
    units
        Header of a column -> its unit in the file; a coordinate without one has that of the
        displacements.
    displacement_unit
        Unit of the displacements in the case; "" if they have none.
    """
    # sizes of the file's units of coordinates in the unit of displacements
    unit_factors = list[float]()
    for axis in SHAPE if shape else ():
        axis_unit = units[axis] or displacement_unit
        unit_factors.append(
            column_size(axis, axis_unit, displacement_unit) if displacement_unit else 1.0
        )
    shape_in_unit = dict[str, list[float]]()
    for name, coordinates in shape.items():
        shape_in_unit[name] = [a * b for a, b in zip(coordinates, unit_factors, strict=True)]
    return shape_in_unit


def _refuse_unknown(
    section: IdentifySection, columns: Iterable[MeasuredColumn], location: str
) -> None:
    """Check that the keys of `noise` and `changes` name columns of the data file.

    Parameters
    ----------
    location
        The data file, for the message.

    Raises
    ------
    CaseError
        If a name is no column.
    """
    column_names = {name for column in columns for name in (column.header, column.of)}
    for key, items in (("noise", section.noise), ("changes", section.changes)):
        if unknown := next((name for name in items if name not in column_names), None):
            raise CaseError(
                f"identify.{key}: {unknown}: {location} has no such column, only "
                f"{', '.join(sorted(column_names))}"
            )


def _grouped_by_settings(
    results: list[tuple[MeasuredColumn, Array]],
    keys: Mapping[str, tuple[str, Array]],
    place_values: Array,
    places: str,
    section: IdentifySection,
    location: str,
    points: Sequence[str],
    lines: Sequence[int],
) -> MeasuredTable:
    """Collect the rows as readings, grouped by their settings; an empty cell was not measured.

    All readings of one case, that of the same settings, are then taken in one run.

    Parameters
    ----------
    results
        The measured columns, with their numbers (rows,) in the case's units.
    keys
        Key of the case -> its unit and its numbers (rows,).
    place_values, places
        (rows,) place of each row, and the name of that column; "" without places.
    location, lines
        The file, and the line of each row in it, for messages.
    points
        Name of the point of each row; empty without a measured shape.

    Raises
    ------
    CaseError
        If there are no numbers, too many, or not finite ones.
    """
    # settings -> the readings with them, their numbers, the indices of their columns, and their
    # file and line
    readings, data = dict[tuple[str, ...], list[Reading]](), dict[tuple[str, ...], list[float]]()
    column, rows = dict[tuple[str, ...], list[int]](), dict[tuple[str, ...], list[str]]()
    _, values_of_first_column = results[0]
    for row in range(len(values_of_first_column)):
        settings = _settings_of_row(keys, row)
        place = float(place_values[row]) if places else None
        point = points[row] if points else ""
        for number, (measured_column, values) in enumerate(results):
            value = float(values[row])
            if np.isnan(value):
                continue
            reading = _reading_of(measured_column, place, point, section)
            readings.setdefault(settings, []).append(reading)
            data.setdefault(settings, []).append(value)
            column.setdefault(settings, []).append(number)
            rows.setdefault(settings, []).append(f"{location}: line {lines[row]}")
    # all numbers, one settings after the other, and the indices of their columns
    numbers = np.array([value for group in data.values() for value in group])
    if not 0 < len(numbers) <= MOST_READINGS or not np.isfinite(numbers).all():
        raise CaseError(
            f"{location}: has {len(numbers)} numbers; allowed are 1 to {MOST_READINGS}, all finite"
        )
    column_numbers = np.array(
        [number for group in column.values() for number in group], dtype=np.int64
    )
    return MeasuredTable(
        columns=tuple(measured_column for measured_column, _ in results),
        readings=readings,
        data=numbers,
        column=column_numbers,
        places=places,
        missing=_empty_cells(results),
        rows=rows,
    )


def _settings_of_row(keys: Mapping[str, tuple[str, Array]], row: int) -> tuple[str, ...]:
    """Return the settings `key=value` of a row of the data, with units as in the file."""
    return tuple(
        f"{key}={float(values[row])!r} {unit}".rstrip() for key, (unit, values) in keys.items()
    )


def _empty_cells(results: list[tuple[MeasuredColumn, Array]]) -> dict[str, int]:
    """Return header -> number of rows in which it is empty, of the measured columns with such."""
    counts = {
        measured_column.header: int(np.isnan(values).sum()) for measured_column, values in results
    }
    return {header: count for header, count in counts.items() if count}


def _reading_of(
    measured_column: MeasuredColumn, place: float | None, point: str, section: IdentifySection
) -> Reading:
    """Return the reading of a measured column in one row of the data.

    Parameters
    ----------
    place
        Place of the row; None: the end of the path.
    point
        Name of the row's point of a measured shape; "" without a shape.
    """
    of, changes = measured_column.of, section.changes
    # "_ux" is a displacement of the row's point
    result = f"{point}{of}" if of.startswith("_") else of
    # whether it counts from the begin of the last step
    is_change = of in changes or measured_column.header in changes
    return Reading(result, None if _is_of_whole_path(of) else place, is_change)


def _is_of_whole_path(result: str) -> bool:
    """Return whether a result is a number of a whole path, without a place.

    Such are folds, frequencies and the barrier.
    """
    return result in (*FOLDS, "barrier") or bool(NAMES.fullmatch(result))


def refuse_unfit_section(source: Source, case: Case, section: IdentifySection) -> None:
    """Check the parts of an `identify` section that need no data.

    Parameters must be numbers of the case, and all named results must exist.

    Raises
    ------
    CaseError
        With the key that is wrong.
    """
    parameters_of(source, case, section)
    names = ResultNames(case)
    for key, items in (("noise", section.noise), ("changes", section.changes)):
        for name in items:
            names.refuse_strange(name, f"identify.{key}")
    for i, candidate_section in enumerate(section.candidates):
        candidate(names, candidate_section, f"identify.candidates.{i}")


def candidate(
    names: ResultNames, section: CandidateSection, key: str
) -> tuple[Reading, str, float]:
    """Return the reading of a candidate, a measurement that may be made next.

    Returns
    -------
    reading
        The result and its place.
    unit
        Unit of the result in the case; "" without.
    noise
        Standard deviation of such a measurement, in this unit.

    Raises
    ------
    CaseError
        If there is no such result or place, or a unit is wrong.
    """
    # a candidate is named as the case names it, with its unit in the name
    result, unit, _ = names.result_of(section.of, unit=None, location=f"{key}.of")
    noise = names.amount(section.noise, result, f"{key}.noise")
    refuse_size(noise, section.noise, f"{key}.noise")
    if section.at is None:
        return Reading(result), unit, noise
    if names.places is None:
        raise CaseError(
            f"{key}.at: the case has no last step that prescribes a load or a displacement"
        )
    return Reading(result, names.amount(section.at, names.places.column, f"{key}.at")), unit, noise

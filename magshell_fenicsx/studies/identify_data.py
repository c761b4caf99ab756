"""Input of `magshell identify`: measured columns as readings of a case, and parameters with priors.

A reading (`simulate.readings.Reading`) is a result of the case, `of`, at a place of its last step.
A place is a value of the load or displacement that this step prescribes. A setting is an assignment
`key=value` to a key of the case. A fold is a result that is a critical load (`FOLDS`: name -> load;
`SCALES` has those with a unit). A measured shape is given by points on the undeformed shell with
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

from magshell_fenicsx.input.section import in_unit, number_and_unit
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.input.tables import (
    MAX_MEASURED_NUMBER,
    TableError,
    TableRows,
    column_size,
    read_rows,
)
from magshell_fenicsx.platform.input_files import Files
from magshell_fenicsx.quantities.registry import QUANTITIES, endings
from magshell_fenicsx.simulate.gradients.instabilities import FOLDS, SCALES, refuse_unitless
from magshell_fenicsx.simulate.gradients.results import NamesOnlyScene, refuse_no_result
from magshell_fenicsx.simulate.gradients.vibration import NAMES
from magshell_fenicsx.simulate.perturbation import number_at_key
from magshell_fenicsx.simulate.readings import PrescribedQuantity, Reading
from magshell_fenicsx.simulate.results import differentiable
from magshell_fenicsx.studies.design_blocks import NumberVariable
from magshell_fenicsx.studies.identify_sections import Amount, CandidateSection, IdentifySection
from magshell_fenicsx.studies.points import value_at
from magshell_fenicsx.studies.runner import Case

Array = NDArray[np.float64]
# a header in the data: a name, and perhaps a unit in brackets
HEADER = re.compile(r"\s*([\w.]+)\s*(?:[\[(]\s*([^\])]+?)\s*[\])])?\s*")
MOST_READINGS = 10_000
# columns of a shape: places, and what they are displaced by
SHAPE, MOVED = ("x", "y", "z"), ("ux", "uy", "uz")
OF_POINTS = "measured_"  # names of these places in the case


@dataclass(frozen=True)
class Parameter:
    """A number of the case that is to be identified, with its prior.

    Attributes
    ----------
    number
        Key, unit and value at the start.
    mean, deviation
        Mean and standard deviation of the prior, in the unit of the number. Without a prior the
        mean is the value at the start, and the deviation is infinite.
    """

    number: NumberVariable
    mean: float
    deviation: float

    @property
    def key(self) -> str:
        """Dotted key of the number in the case file."""
        return self.number.name

    @property
    def unit(self) -> str:
        """Unit in which the case gives the number; "" for a bare number."""
        return self.number.unit

    @property
    def start(self) -> float:
        """Value in the case file, in `unit`."""
        return float(self.number.start[0])


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


class ResultNames:
    """Names of the results of a case, and of the quantity that its last step prescribes.

    Attributes
    ----------
    scene
        A scene without mesh, which knows names and units alone.
    places
        The load or displacement of the last step; None if there is none.

    `_dimensionless_names` are the names of all results without a unit.
    """

    def __init__(self, case: Case) -> None:
        """Make a scene without mesh for a case, and find the quantity of its last step."""
        self.scene = NamesOnlyScene(case.problem())
        try:
            self.places: PrescribedQuantity | None = PrescribedQuantity(self.scene)
        except CaseError:
            self.places = None

    def result_of(self, name: str, unit: str | None, location: str) -> tuple[str, str, float]:
        """Find the result of the case that a name and a unit in the data mean.

        Parameters
        ----------
        unit
            Unit of the data; None for a bare number.
        location
            Key or file with which messages begin.

        Returns
        -------
        result
            Name of the result in the case, such as `w_mm` for `w` in m.
        case_unit
            Unit of the result; "" if it has none.
        factor
            Size of `unit` in `case_unit`, by which data are multiplied.

        Raises
        ------
        CaseError
            If there is no such result, or a unit is missing or of another dimension.
        """
        units_by_result = self._units_by_result()
        if unit is None:
            self._refuse_missing_unit(name, units_by_result, location)
            _, case_unit = units_by_result.get(name, ("", ""))
            result, factor = name, 1.0
        else:
            # the result itself, or the name with a unit behind it
            fitting = [
                result_name
                for result_name in units_by_result
                if result_name == name
                or re.fullmatch(rf"{re.escape(name)}_[A-Za-z]\w*", result_name)
            ]
            if not fitting:
                raise CaseError(
                    f"{location}: {name}: has the unit {unit}, but no result of this name has one "
                    "in this case"
                )
            result = min(fitting, key=len)  # the name with nothing but a unit behind it
            _, case_unit = units_by_result[result]
            try:
                factor = column_size(name, unit, case_unit)
            except TableError as e:
                raise CaseError(f"{location}: {e}") from None
        # what the last step prescribes gives the place of a reading, and is no result
        if self.places is None or result != self.places.column:
            refuse_no_result(self.scene, [result], location)
            if result in SCALES:
                refuse_unitless(self.scene, result)
        return result, case_unit, factor

    def _units_by_result(self) -> dict[str, tuple[str, str]]:
        """Return name of a result in units of the case -> its dimensionless name, and its unit.

        Critical loads and frequencies in units have no other name here: "buckling_pressure_Pa" ->
        ("buckling_pressure_Pa", "Pa").
        """
        units_by_result = {
            q.name: (dimensionless_name, q.si)
            for dimensionless_name in self._dimensionless_names
            if (q := self.scene.sizes.column(dimensionless_name))
        }
        units_by_result |= {
            result_name: (result_name, result_name.rpartition("_")[2]) for result_name in SCALES
        } | {"hertz_1": ("hertz_1", "Hz")}
        return units_by_result

    def _refuse_missing_unit(
        self, name: str, units_by_result: Mapping[str, tuple[str, str]], location: str
    ) -> None:
        """Check that a name without a unit does not mean a result with one.

        In a case with units "w" would mean "w_mm", and "buckling_pressure" would mean
        "buckling_pressure_Pa".

        Parameters
        ----------
        units_by_result
            Name of a result in units of the case -> its dimensionless name, and its unit.

        Raises
        ------
        CaseError
            With the unit that is missing.
        """
        is_unknown = name not in self._dimensionless_names and name not in FOLDS

        def is_name_with_unit(result_name: str) -> bool:
            """Return whether the name becomes that of a result with a unit behind it."""
            dimensionless_name, unit = units_by_result[result_name]
            if dimensionless_name == name and result_name.startswith(f"{name}_"):
                return True
            return is_unknown and result_name == f"{name}_{unit}"

        name_with_unit = next(filter(is_name_with_unit, units_by_result), None)
        if name_with_unit and name_with_unit != name:
            _, unit = units_by_result[name_with_unit]
            raise CaseError(f"{location}: {name}: has no unit: write {name} [{unit}]")

    @property
    def _dimensionless_names(self) -> list[str]:
        """Names of all results without a unit; that of what the last step prescribes is first."""
        scene = self.scene
        place_names = [self.places.dimensionless_column] if self.places else []
        results = differentiable(scene, scene.unloaded())
        return [*place_names, *(name for name in results if name not in place_names)]

    def refuse_strange(self, name: str, location: str) -> None:
        """Check that a name of a column of data is a result of the case, with or without its unit.

        Raises
        ------
        CaseError
            If no result has the name.
        """
        names_in_units = [
            q.name for name in self._dimensionless_names if (q := self.scene.sizes.column(name))
        ]
        names = [
            *self._dimensionless_names,
            *names_in_units,
            *FOLDS,
            # critical loads without their unit
            *(base_name.rpartition("_")[0] for base_name in FOLDS if base_name in SCALES),
            *MOVED,
        ]
        if name not in names and not NAMES.fullmatch(name):
            raise CaseError(
                f"{location}: {name}: the case has no such result; allowed are {', '.join(names)}"
            )

    def amount(self, amount: Amount, result: str, location: str) -> float:
        """Return an amount (a number, or text with a unit) in the unit of a result in the case.

        Raises
        ------
        CaseError
            If the unit is missing or of another dimension.
        """
        number, unit = number_and_unit(str(amount))
        # unit of the result in the case, and the factor from `unit` to it; 1 without a unit
        _, case_unit, factor = (
            self._result_in_another_unit(result, unit, location)
            if unit
            else self.result_of(result, None, location)
        )
        lacks_unit = case_unit and not unit
        if lacks_unit and float(number):  # zero needs no unit
            raise CaseError(
                f"{location}: {_text(amount)}: needs a unit, such as {_text(amount)} {case_unit}"
            )
        return float(number) * factor

    def _result_in_another_unit(
        self, result_name: str, unit: str, location: str
    ) -> tuple[str, str, float]:
        """Return a result, its unit in the case, and the size of another unit in this unit.

        The name is that in the case, which may end with the case's unit: "w_mm".

        Raises
        ------
        CaseError
            If the result has no unit, or one of another dimension.
        """
        result, case_unit, _ = self.result_of(result_name, None, location)
        if not case_unit:
            raise CaseError(
                f"{location}: {result_name} has no unit, so this number has none: {unit}"
            )
        try:
            return result, case_unit, column_size(result_name, unit, case_unit)
        except TableError as e:
            raise CaseError(f"{location}: {e}") from None


def _text(amount: Amount) -> str:
    """Return an amount as a text for messages."""
    return amount if isinstance(amount, str) else f"{amount:g}"


def refuse_size(deviation: float, text: Amount, location: str) -> None:
    """Check that a standard deviation is positive and that its square is a floating-point number.

    Parameters
    ----------
    text
        The deviation as written in the case, for messages.

    Raises
    ------
    CaseError
        If it is not positive, or out of bounds.
    """
    if not deviation > 0:
        raise CaseError(f"{location}: must be positive, here {_text(text)}")
    if not 1 / MAX_MEASURED_NUMBER <= deviation <= MAX_MEASURED_NUMBER:
        raise CaseError(
            f"{location}: {_text(text)}: allowed are numbers from {1 / MAX_MEASURED_NUMBER:g} to "
            f"{MAX_MEASURED_NUMBER:g}"
        )


def parameters_of(source: Source, case: Case, section: IdentifySection) -> tuple[Parameter, ...]:
    """Return the parameters of an `identify` section, with their starts and priors.

    Raises
    ------
    CaseError
        If a key has no number, or its prior another unit.
    """
    parameters = []
    for key, parameter_section in section.parameters.items():
        location = f"identify.parameters.{key}"
        try:
            number_at_key(case.context, key)  # raises an error if there is no number
            start, unit = _number_as_written(source, case, key)
            # of the prior, in the unit of the number; nan without a prior
            mean, deviation = (
                _in_unit_of(unit, amount, key)
                for amount in (parameter_section.prior, parameter_section.deviation)
            )
        except CaseError as e:
            raise CaseError(f"{location}: {e}") from None
        if parameter_section.deviation is not None:
            refuse_size(deviation, parameter_section.deviation, f"{location}.deviation")
        if parameter_section.prior is None:
            mean, deviation = start, np.inf
        # a variable of a design is scaled with its bounds: with 0 and 1 it is the number itself
        number = NumberVariable(key, start=np.array([start]), bounds=(0.0, 1.0), unit=unit)
        parameters.append(Parameter(number, mean, deviation))
    return tuple(parameters)


def _number_as_written(source: Source, case: Case, key: str) -> tuple[float, str]:
    """Return the number at a key in the unit of the case file, and this unit ("" without).

    A default, which the file does not give, is taken from the validated case.
    """
    text = value_at(source.data, key.split("."))
    number, unit = number_and_unit(str(text))
    return (float(number), unit) if number else (number_at_key(case.context, key), "")


def _in_unit_of(unit: str, amount: Amount | None, key: str) -> float:
    """Return an amount of a prior in a unit; nan for None.

    Parameters
    ----------
    unit
        Unit of the number in the case; "" for a bare number.
    key
        Key of the number, for the message.

    Raises
    ------
    CaseError
        If the amount has no such unit.
    """
    if amount is None:
        return np.nan
    try:
        _, unit_of_amount = number_and_unit(str(amount))
        if unit and not unit_of_amount:
            raise ValueError
        return in_unit(str(amount), unit)
    except ValueError:
        expected = f"the unit {unit}" if unit else "no unit"
        raise CaseError(
            f"{_text(amount)}: the case gives {key} with {expected}: so has its prior"
        ) from None


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
    if len(present_axes) < len(SHAPE) or not any(name in columns for name in MOVED):
        raise CaseError(
            f"{location}: a shape needs the columns {', '.join(SHAPE)} and of {', '.join(MOVED)} "
            "one or more"
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
        is_displacement = bool(rows) and name in MOVED
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

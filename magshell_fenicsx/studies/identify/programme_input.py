"""Input of a prediction: from a section of `identify.predict` to its programme.

A programme is a case whose history is predicted. A column is a result along a step, a column of
path.csv; a scalar is a number of a whole run. A place is a value of the load or displacement of a
step, or of the time, at which columns are compared with data. A location is the key with which an
error message begins.
"""

import copy
from collections.abc import Container, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError, Source, override, read_source
from magshell_fenicsx.input.tables import TableError, column_size, read_rows
from magshell_fenicsx.output.store.table import COLUMNS, TEXTS
from magshell_fenicsx.platform.input_files import Files
from magshell_fenicsx.problem.columns import extra_columns, sizes_in_units
from magshell_fenicsx.quantities.registry import amplitude
from magshell_fenicsx.studies.identify.data import refuse_twice
from magshell_fenicsx.studies.identify.parameters import Parameter, parameters_of
from magshell_fenicsx.studies.identify.programmes import PathColumn, Programme
from magshell_fenicsx.studies.identify.remanence_field import without_room
from magshell_fenicsx.studies.identify.sections import IdentifySection, ProgrammeSection
from magshell_fenicsx.studies.points import Case, MakeCase, value_at
from magshell_fenicsx.studies.results import Scalar, parse_scalar

Array = NDArray[np.float64]


def programme(
    name: str,
    source: Source,
    parameters: Sequence[Parameter],
    section: ProgrammeSection,
    make_case: MakeCase,
    *,
    with_field: bool = False,
) -> Programme:
    """Build the programme of a section of `identify.predict`; collective.

    Parameters
    ----------
    name
        Name of the section.
    source
        The identified case, whose place the section's own case can take.
    with_field
        Whether a remanence field is identified; the case must then have room for its points.

    Raises
    ------
    CaseError
        If the case or a setting is not valid, a parameter is missing, or there is no such result.
    """
    location = f"identify.predict.{name}"
    try:
        base = _case_of_programme(source, parameters, section, with_field=with_field)
        problem = make_case(base).problem()
    except CaseError as e:
        raise CaseError(f"{location}: {e}") from None
    names = _PathColumnNames(problem)
    last_step = len(problem.programme)
    # without data the last step's load is the place of its columns
    load_column = (
        names.in_case_units(amplitude(problem.programme[-1].name).column) if last_step else ""
    )
    place, columns = load_column, list[PathColumn]()
    places: Array | None = None
    steps: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
    if section.data:
        place, places, steps, columns = _measured(
            source.folder / section.data, names, last=last_step, location=f"{location}.data"
        )
    columns += _columns_without_data(section, names, measured={column.of for column in columns})
    # a name with "@" is a number at one place; other names that are no columns are scalars too
    scalars = [
        _scalar(result, location)
        for result in section.of
        if "@" in result or result not in names.all
    ]
    if columns and not place:
        raise CaseError(
            f"{location}.of: the case has no step, so no column along it: give a number, such as "
            "knockdown"
        )
    predicted = {text for column in columns for text in (column.header, column.of)}
    if unknown := next((result for result in section.changes if result not in predicted), None):
        raise CaseError(
            f"{location}.changes: {unknown}: is no column that is predicted; these are "
            f"{', '.join(predicted)}"
        )
    columns = [
        replace(column, change=bool({column.header, column.of} & {*section.changes}))
        for column in columns
    ]
    return Programme(
        name=name,
        source=base,
        samples=section.samples,
        make_case=make_case,
        last=last_step,
        place=place,
        places=places,
        steps=steps,
        columns=columns,
        scalars=scalars,
    )


def _case_of_programme(
    source: Source, parameters: Sequence[Parameter], section: ProgrammeSection, *, with_field: bool
) -> Source:
    """Return the case that is predicted: the identified or another one, with the settings.

    Parameters
    ----------
    source
        The identified case.
    with_field
        Whether a remanence field is identified; the case must then have room for its points.

    Raises
    ------
    CaseError
        If the case or a setting is not valid, or lacks a parameter or the room for the field.
    """
    case_source = copy.deepcopy(source)
    if section.case:
        case_source = read_source(source.folder / section.case)
    for setting in section.settings:
        override(case_source, setting)
    for key in ("identify", "ensemble", "design"):  # a run does not need them
        case_source.data.pop(key, None)
    if missing_key := next(
        (p.key for p in parameters if value_at(case_source.data, p.key.split(".")) is None), None
    ):
        raise CaseError(f"{section.case or 'the case'} has no {missing_key}, which is looked for")
    if with_field and (missing_room := without_room(case_source.data, source.data)):
        raise CaseError(f"{section.case or 'the case'}: {missing_room}")
    return case_source


def _columns_without_data(
    section: ProgrammeSection, names: "_PathColumnNames", measured: Container[str]
) -> list[PathColumn]:
    """Return the columns along the last step that the section asks for beside the measured ones.

    Parameters
    ----------
    measured
        Columns of path.csv that are measured.
    """
    # name in the section, and column in the case's units; a name with "@" is a scalar
    names_and_columns = [
        (result, names.in_case_units(result))
        for result in section.of
        if "@" not in result and result in names.all
    ]
    return [
        PathColumn(result, of=column, data=np.zeros(0), change=False)
        for result, column in names_and_columns
        if column not in measured
    ]


def refuse_unfit_programmes(
    source: Source, case: Case, section: IdentifySection, make_case: MakeCase
) -> None:
    """Check that cases, settings and results of all predictions exist; collective.

    Raises
    ------
    CaseError
        If the case or a setting of a prediction is not valid, or it has no such result.
    """
    parameters = parameters_of(source, case, section) if section.predict else ()
    for name, programme_section in section.predict.items():
        programme(
            name,
            source,
            parameters,
            programme_section,
            make_case,
            with_field=section.remanence is not None,
        )


def _scalar(result: str, location: str) -> Scalar:
    """Read the name of a number of a run, such as "knockdown" or "force_N@w_mm=2".

    Raises
    ------
    CaseError
        If it has another form; the message begins with the location.
    """
    try:
        return parse_scalar(result)
    except CaseError as e:
        raise CaseError(f"{location}.of: {str(e).removeprefix('--result ')}") from None


class _PathColumnNames:
    """Names of the numeric columns of path.csv that a case has.

    Attributes
    ----------
    all
        The names without units, as keys of a dict in order.
    sizes
        Sizes of the case's units, which give the columns in units.
    """

    def __init__(self, problem: Any) -> None:
        self.sizes = sizes_in_units(problem)
        numbers = (name for name in (*COLUMNS, *extra_columns(problem)) if name not in TEXTS)
        self.all = dict.fromkeys(numbers)

    def in_case_units(self, name: str) -> str:
        """Return the name of a column in the units of the case; without units its own name."""
        in_units = self.sizes.column(name)
        return in_units.name if in_units else name

    def column_of(self, name: str, unit: str | None, location: str) -> tuple[str, float]:
        """Find the column of path.csv that a name and a unit in the data mean.

        Parameters
        ----------
        unit
            Unit of the data; None for a bare number.
        location
            Key and file with which messages begin.

        Returns
        -------
        column
            Name of the column.
        factor
            Size of `unit` in the unit of the column, by which data are multiplied.

        Raises
        ------
        CaseError
            If there is no such column, or a unit is missing or of another dimension.
        """
        # name of a column in the units of the case -> its unit
        unit_of_column = {q.name: q.si for base in self.all if (q := self.sizes.column(base))}
        if unit is None:
            if name not in self.all or name in TEXTS:
                raise CaseError(f"{location}: {name}: is no column of path.csv of this case")
            if (column_in_units := self.in_case_units(name)) != name:
                raise CaseError(
                    f"{location}: {name}: has no unit: "
                    f"write {name} [{unit_of_column[column_in_units]}]"
                )
            return name, 1.0
        # the column itself, or the name with an ending, such as its unit
        fitting = [
            column for column in unit_of_column if column == name or column.startswith(f"{name}_")
        ]
        if not fitting:
            raise CaseError(
                f"{location}: {name}: has the unit {unit}, but no column of this name has one in "
                "this case"
            )
        column = min(fitting, key=len)  # the shortest: nothing but a unit behind the name
        try:
            return column, column_size(name, unit, unit_of_column[column])
        except TableError as e:
            raise CaseError(f"{location}: {e}") from None


def _measured(
    file: Path, names: _PathColumnNames, last: int, location: str
) -> tuple[str, Array, NDArray[np.int64], list[PathColumn]]:
    """Read the data of a prediction: places in the first column, then measured columns.

    Parameters
    ----------
    names
        Columns of path.csv that the case has.
    last
        Number of the last step, in which rows without a column `step` are.
    location
        Key with which messages begin.

    Returns
    -------
    place
        Column of path.csv that gives the places.
    places, steps
        (n,) place and step of each row.
    columns
        The measured results.

    Raises
    ------
    CaseError
        If there is no measured column, or a row has no place or no valid step.
    """
    try:
        rows = read_rows(file, Files())
    except TableError as e:
        raise CaseError(f"{location}: {file.name}: {e}") from None
    columns, units, location = rows.columns, rows.units, f"{location}: {file.name}"
    values_by_header = {header: values for header, values in columns.items() if header != "step"}
    if len(values_by_header) < 2:
        raise CaseError(
            f"{location}: needs two columns or more: the place first, then what was measured there"
        )
    # for each column its header, its column of path.csv, the size of its unit in that of path.csv,
    # and its numbers
    measured = [
        (header, *names.column_of(header, units[header], location), values)
        for header, values in values_by_header.items()
    ]
    headers_by_result = dict[str, str]()
    for header, result, _, _ in measured:
        refuse_twice(header, result, headers_by_result, location)
        headers_by_result[result] = header
    # the first column has the places
    (_, place, factor, place_values), *measured_results = measured
    steps = np.asarray(columns.get("step", np.full(place_values.size, last)))
    _refuse_bad_rows(place_values, steps, last, rows.lines, location)
    path_columns = [
        PathColumn(header, of=result, data=values * factor_of_column, change=False)
        for header, result, factor_of_column, values in measured_results
    ]
    return place, place_values * factor, steps.astype(np.int64), path_columns


def _refuse_bad_rows(
    places: Array, steps: Array, last: int, lines: Sequence[int], location: str
) -> None:
    """Check that each row of the data has a place, and a step of the case.

    Parameters
    ----------
    places, steps
        (n,) place and step of each row; nan where a cell is empty.
    last
        Number of the last step, counted from 1.
    lines
        Line of each row in the file, for the message.

    Raises
    ------
    CaseError
        With the line of the first row that is wrong.
    """
    has_wrong_step = ~np.isin(steps, np.arange(1, last + 1))
    bad_rows = np.flatnonzero(np.isnan(places) | has_wrong_step)
    if bad_rows.size:
        line = lines[bad_rows[0]]
        raise CaseError(f"{location}: line {line}: a row has no place, or no step of 1 to {last}")

"""Prediction of another history of the sample from an identification, with bands.

A programme is a case whose history is predicted: the identified case with other settings, or
another one with the same parameters. It is run at the fit, and for parameters drawn from the
posterior. Between the quantiles of these runs lie 95 % of them: the band of a result. If a snap
comes earlier in some runs, the band is wide there, where slopes would say nothing.

A column is a result along a step, a column of path.csv; a scalar is a number of a whole run. A
place is a value of the load or displacement of a step, or of the time, at which columns are
compared with data. The fit has parameters x. The number 0 of a run is the run at the fit. An
outcome is the stored result of a run. The noise of a column is the standard deviation of errors of
measurement. A location is the key with which an error message begins.
"""

import copy
import time
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError, Source, override, read_source
from magshell_fenicsx.input.tables import TableError, column_size, read_rows
from magshell_fenicsx.output.store.table import COLUMNS, TEXTS, Row, write_csv
from magshell_fenicsx.platform.input_files import Files
from magshell_fenicsx.problem.columns import extra_columns, sizes_in_units
from magshell_fenicsx.quantities.registry import OWN_MODES, amplitude
from magshell_fenicsx.runs.running import run
from magshell_fenicsx.studies.identify_data import Parameter, parameters_of, refuse_twice
from magshell_fenicsx.studies.identify_drawn import NORMAL, band_of, posterior_samples
from magshell_fenicsx.studies.identify_field import without_room
from magshell_fenicsx.studies.identify_picture import draw_programme
from magshell_fenicsx.studies.identify_predicted import Predictor
from magshell_fenicsx.studies.identify_sections import IdentifySection, ProgrammeSection
from magshell_fenicsx.studies.laplace import Posterior
from magshell_fenicsx.studies.points import identity, value_at
from magshell_fenicsx.studies.results import Scalar, parse_scalar
from magshell_fenicsx.studies.runner import (
    FAILED,
    Case,
    MakeCase,
    Outcome,
    Say,
    compute,
    keep_outcome,
    outcome_of,
    stored_outcome_of_case,
)

Array = NDArray[np.float64]
# columns that are read from every run, to find its steps and leave out branches
ALWAYS = ("step", "branch", "mode", "amplitude")


@dataclass(frozen=True)
class PathColumn:
    """A result that is predicted along a step.

    Attributes
    ----------
    header
        Its name in the data, or in `of` of the section.
    of
        Its column of path.csv, in units if the case has them.
    data
        (n,) measured values in the unit of this column; empty if nothing was measured.
    change
        Whether the values are changes since the step began.
    """

    header: str
    of: str
    data: Array
    change: bool


@dataclass(frozen=True)
class Prediction:
    """The prediction of a programme.

    Attributes
    ----------
    name
        Name of the programme.
    content
        Its part of identify.json.
    said
        The sentences that are printed.
    rows
        Rows of its table identify_NAME.csv.
    """

    name: str
    content: dict[str, Any]
    said: list[str]
    rows: list[dict[str, Any]]

    def write(self, folder: Path) -> None:
        """Write table and picture into a folder; nothing if there are no rows."""
        if self.rows:
            write_csv(self.rows, list(self.rows[0]), folder / f"identify_{self.name}.csv")
            draw_programme(
                self.rows, self.name, self.content["places"], folder / f"identify_{self.name}.png"
            )


@dataclass
class Programme:
    """A case whose history is predicted.

    Attributes
    ----------
    name
        Name of its section in `identify.predict`.
    make_case
        Makes a case of its source.
    source
        The case, with its own settings.
    samples
        Number of parameter vectors drawn from the posterior.
    last
        Number of the last step of the case, counted from 1.
    place
        Column of path.csv that gives the places, the load or displacement of a step.
    places, steps
        (n,) place of each datum in this column, and the step that it is in. Without data `places`
        is None: the places are all points of the last step.
    columns
        Results along the steps.
    scalars
        Numbers of a whole run.
    keys
        Keys of the runs' files, that of the fit first; "" where drawn parameters make no case.
    """

    name: str
    source: Source
    samples: int
    make_case: MakeCase
    last: int
    place: str
    places: Array | None
    steps: NDArray[np.int64]
    columns: list[PathColumn]
    scalars: list[Scalar]
    keys: list[str] = field(default_factory=list)

    def compute(self, predictor: Predictor, posterior: Posterior, say: Say) -> None:
        """Run the case at the fit and for drawn parameters; keep the outcomes, and fill `keys`.

        Collective. The ranks share the runs, each of which is on one rank.

        Parameters
        ----------
        predictor
            Makes the case for a vector of parameters, and has the folder of the outcomes.

        Raises
        ------
        CaseError
            If the parameters of the fit make no valid case.
        """
        cases = dict[str, Case]()
        for number, x in enumerate([posterior.x, *posterior_samples(posterior, self.samples)]):
            case = self._case_at(predictor, number, x)
            if case is None:
                self.keys.append("")  # a run that cannot be made
                continue
            self.keys.append(identity(case))
            cases[self.keys[-1]] = case
        folder = predictor.folder
        # runs without a usable outcome in the folder
        missing = predictor.comm.bcast(
            [key for key in cases if self._stored_outcome(folder, key) is None]
        )
        if predictor.comm.rank == 0:
            say(f"{self.name}: {len(cases)} runs, {len(missing)} to compute")

        def computed(key: str) -> Iterator[str]:
            """Compute a run on this rank, keep its outcome, and yield a line of text."""
            outcome = self._outcome_of_run(cases[key])
            keep_outcome(outcome, cases[key], _file(folder, key))
            reason = f", {outcome.stopped}" if outcome.stopped else ""
            number = missing.index(key) + 1
            points = f"{len(outcome.curve)} points"
            yield f"{number:5d}/{len(missing)}  {self.name}: {points}{reason}"

        compute(missing, computed, predictor.comm, say)
        predictor.count += len(missing)

    def _case_at(self, predictor: Predictor, number: int, x: Array) -> Case | None:
        """Return the case of a run; None if drawn parameters make no valid case; collective.

        Parameters
        ----------
        number, x
            Number of the run, 0 for that at the fit, and its parameters (p,).

        Raises
        ------
        CaseError
            If the parameters of the fit make no valid case.
        """
        # the file of an identified field, which all ranks read after the second barrier
        vectors = predictor.folder / "points" / f"{self.name}_{number}.csv"
        if predictor.field:
            predictor.comm.Barrier()
            if predictor.comm.rank == 0:
                predictor.write(x, vectors)
            predictor.comm.Barrier()
        try:
            case = self.make_case(
                predictor.source_at(predictor.comm.bcast(x), self.source, vectors)
            )
            case.problem()  # raises errors of the case
        except CaseError as e:
            if not number:  # the run at the fit
                raise CaseError(f"identify.predict.{self.name}: at the fit: {e}") from None
            return None
        return case

    def _needed_part(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """Return the needed columns of a row."""
        return {name: row[name] for name in self._needed_columns if name in row}

    def _outcome_of_run(self, case: Case) -> Outcome:
        """Run a case on this rank; any exception becomes a failed outcome.

        The curve of the outcome keeps only the needed columns.
        """
        start_time = time.perf_counter()
        try:
            result = run(case.problem(), comm=MPI.COMM_SELF)
            outcome = outcome_of(
                result, "path", result.scene.newton.factorisation.count, columns=COLUMNS
            )
        except (
            Exception
        ) as e:  # whatever it is, the other runs go on, and the table has no band if many fail
            outcome = Outcome.failed(" ".join(f"{FAILED}{type(e).__name__}: {e}".split()))
        curve = [self._needed_part(row) for row in outcome.curve]
        return replace(outcome, curve=curve, wall_s=round(time.perf_counter() - start_time, 3))

    @property
    def _needed_columns(self) -> dict[str, None]:
        """Columns of path.csv that the prediction reads, as keys of a dict in order."""
        place_and_results = [self.place, *(column.of for column in self.columns)]
        names = [
            *ALWAYS,
            *place_and_results,
            *(name for scalar in self.scalars for name in (scalar.column, scalar.at)),
        ]
        # a scalar of the summary has no column; "end" stands for the last point of the path
        return dict.fromkeys(name for name in names if name not in ("", "end"))

    def _stored_outcome(self, folder: Path, key: str) -> Outcome | None:
        """Return the stored outcome of a run; None if it is to be computed.

        A stored outcome is not used, and the run computed again, in two cases: it is that of an
        error, which may have been one of the machine; or it lacks needed columns.
        """
        outcome = stored_outcome_of_case(_file(folder, key))
        if outcome is None or (outcome.stopped or "").startswith(FAILED):
            return None
        has_needed = not outcome.curve or self._needed_columns.keys() <= outcome.curve[0].keys()
        return outcome if has_needed else None

    def prediction(self, folder: Path, noise: Mapping[str, Mapping[str, Any]]) -> Prediction:
        """Return the prediction with its bands from the stored runs.

        Parameters
        ----------
        folder
            Folder of the identification.
        noise
            Column -> its noise, as in identify.json; `deviation` is the standard deviation.

        Raises
        ------
        CaseError
            If the run at the fit fails.
        """
        outcomes = [
            stored_outcome_of_case(_file(folder, key)) if key else None for key in self.keys
        ]
        fit_run, drawn_outcomes = outcomes[0], outcomes[1:]
        assert fit_run
        if not fit_run.curve:
            raise CaseError(
                f"identify.predict.{self.name}: nothing is predicted at the fit: {fit_run.stopped}"
            )
        # the runs of drawn parameters that have a path
        runs = [item for item in drawn_outcomes if item and item.curve]
        curves = [_PathCurve(item.curve, self.place) for item in (fit_run, *runs)]
        places, steps = self.places, self.steps
        if places is None:  # without data: all points of the last step of the fit
            fit_places, _ = curves[0].along_step(self.last)
            places = np.array(fit_places)
            steps = np.full(places.size, self.last, dtype=np.int64)
        rows = [
            row
            for column in self.columns
            for row in self._rows(
                column, places, steps, curves, self._noise(column, noise), len(drawn_outcomes)
            )
        ]
        numbers = {
            item.name: self._number(item, fit_run, runs, len(drawn_outcomes))
            for item in self.scalars
        }
        measured_count, count_inside = _counts_of_data(rows)
        content = {
            "samples": len(drawn_outcomes),
            "without_path": len(drawn_outcomes) - len(runs),
            "stopped_early": sum(1 for item in runs if item.stopped),
            "stopped": fit_run.stopped,
            "places": self.place,
            "measured": measured_count,
            "inside": count_inside,
            "numbers": numbers,
        }
        return Prediction(self.name, content, self._sentences(content), rows)

    def _sentences(self, content: Mapping[str, Any]) -> list[str]:
        """Return the sentences that are printed about a prediction.

        Parameters
        ----------
        content
            Its part of identify.json.
        """
        sentences = []
        if content["measured"]:
            sentences.append(
                f"{self.name}: {content['inside']} of {content['measured']} data within their "
                "predicted bands"
            )
        for name, number in content["numbers"].items():
            value = "nothing" if number["value"] is None else f"{number['value']:.6g}"
            band = (
                f", 95 % between {number['low']:.6g} and {number['high']:.6g}"
                if number["low"] is not None
                else ""
            )
            sentences.append(
                f"{self.name}: {name} = {value} predicted{band}, from {number['runs']} runs"
            )
        if content["stopped"]:
            sentences.append(
                f"warning: {self.name}: at the fit the run stopped early: {content['stopped']}"
            )
        if count := content["without_path"] + content["stopped_early"]:
            sentences.append(
                f"warning: {self.name}: {count} of {content['samples']} runs are lost or stopped "
                "early"
            )
        return sentences

    def _noise(self, column: PathColumn, noise: Mapping[str, Mapping[str, Any]]) -> float:
        """Return the standard deviation of the noise of a column; 0 if the identification has none.

        Parameters
        ----------
        noise
            Column or header -> its noise, as in identify.json.
        """
        return next(
            (
                float(noise[name]["deviation"])
                for name in (column.header, column.of)
                if name in noise
            ),
            0.0,
        )

    def _rows(
        self,
        column: PathColumn,
        places: Array,
        steps: NDArray[np.int64],
        curves: "Sequence[_PathCurve]",
        noise: float,
        samples: int,
    ) -> Iterator[dict[str, Any]]:
        """Yield the rows of a column in the table of the prediction, one for each place.

        A missing number is "". `low` and `high` are the band of the runs. The band of a measured
        value is wider: on each side its width is the root of the sum of two squares, of the width
        of the runs' band and of `NORMAL` standard deviations of the noise.

        Parameters
        ----------
        places, steps
            (n,) places and their steps.
        curves
            The run at the fit, then those of drawn parameters.
        noise
            Standard deviation of a measurement of the column.
        samples
            Number of drawn parameter vectors, of which some runs may have failed.
        """
        # (runs, places), the fit first
        predicted_values = np.array([curve.values_at(column, places, steps) for curve in curves])
        for i, place in enumerate(places):
            # at the fit; and the range of 95 % of the runs, None if too few have a value
            value, band = predicted_values[0, i], band_of(predicted_values[1:, i], samples)
            low = high = low_measured = high_measured = np.nan
            if band:
                low, high = band
                low_measured = value - np.hypot(value - min(low, value), NORMAL * noise)
                high_measured = value + np.hypot(max(high, value) - value, NORMAL * noise)
            row = {
                "step": int(steps[i]),
                self.place: float(place),
                "result": column.of,
                "measured": float(column.data[i]) if column.data.size else np.nan,
                "predicted": float(value),
                "low": low,
                "high": high,
                "low_measured": low_measured,
                "high_measured": high_measured,
            }
            yield {
                name: "" if isinstance(v, float) and not np.isfinite(v) else v
                for name, v in row.items()
            }

    @staticmethod
    def _number(
        scalar: Scalar, first: Outcome, runs: Sequence[Outcome], samples: int
    ) -> dict[str, Any]:
        """Return a number of the run at the fit, its 95 % band and the number of runs that have it.

        Parameters
        ----------
        first
            Outcome at the fit.
        runs
            Outcomes of drawn parameters that have a path.
        samples
            Number of drawn parameter vectors, of which some runs may have failed.
        """
        values = np.array(
            [np.nan if (v := outcome.value(scalar)) is None else v for outcome in runs]
        )
        # the range of 95 % of the runs; None if too few have the number
        band = band_of(values, samples)
        low, high = band or (None, None)
        return {
            "value": first.value(scalar),
            "low": low,
            "high": high,
            "runs": int(np.isfinite(values).sum()),
        }


class _PathCurve:
    """The curve of a run, read step by step; branches and excluded modes are left out.

    Attributes
    ----------
    _rows
        Rows of path.csv that are left.
    _place
        Column of path.csv that gives the places.

    Parameters
    ----------
    rows, place
        All rows of path.csv, and the column that gives the places.
    """

    def __init__(self, rows: Sequence[Row], place: str) -> None:
        self._rows = [row for row in rows if row["branch"] == 0 and row["mode"] in OWN_MODES]
        self._place = place

    def along_step(self, step: int, column: str = "") -> tuple[list[float], list[float]]:
        """Return places and values of a column in a step, from the point where the step begins.

        Without a column the values are the places. Both are empty if the run has no such step.
        """
        rows_of_step = [i for i, row in enumerate(self._rows) if row["step"] == step]
        if not rows_of_step:
            return [], []
        # the row before the first one of a step is the point where the step begins
        begin, end = max(rows_of_step[0] - 1, 0), rows_of_step[-1] + 1
        rows = self._rows[begin:end]
        places = [float(row[self._place]) for row in rows]
        return places, [float(row[column or self._place]) for row in rows]

    def values_at(self, column: PathColumn, places: Array, steps: NDArray[np.int64]) -> Array:
        """Return the values (n,) of a column at places (n,) in their steps (n,).

        Between two points of the path the column is linear. Where a path passes a place several
        times, the first counts; nan where the path does not pass.
        """
        values = np.full(len(places), np.nan)
        for step in np.unique(steps):
            # places x and values y of the points of the path in this step
            x, y = map(np.array, self.along_step(int(step), column.of))
            if x.size < 2:
                continue
            y = y - y[0] if column.change else y
            # ends of the intervals between neighbouring points, wider by rounding
            slack = 1e-9 * np.ptp(x)
            low, high = np.minimum(x[:-1], x[1:]) - slack, np.maximum(x[:-1], x[1:]) + slack
            has_length = x[1:] != x[:-1]
            for i in np.flatnonzero(steps == step):
                has_place = (low <= places[i]) & (places[i] <= high) & has_length
                passed = np.flatnonzero(has_place)
                if passed.size:
                    k = passed[0]  # the first interval counts
                    part = np.clip((places[i] - x[k]) / (x[k + 1] - x[k]), 0, 1)
                    values[i] = y[k] + (y[k + 1] - y[k]) * part
        return values


def _counts_of_data(rows: Sequence[Mapping[str, Any]]) -> tuple[int, int]:
    """Return the number of data that have a band, and the number of those within their bands.

    Parameters
    ----------
    rows
        Rows of the table; an empty number is "".
    """
    measured = [row for row in rows if row["measured"] != "" and row["low_measured"] != ""]
    is_inside = [row["low_measured"] <= row["measured"] <= row["high_measured"] for row in measured]
    return len(measured), int(sum(is_inside))


def _file(folder: Path, key: str) -> Path:
    """Return the file of a run's outcome in the folder of the identification."""
    return folder / "points" / f"{key}.json"


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

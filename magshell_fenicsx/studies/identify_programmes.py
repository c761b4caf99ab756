"""Another history of the sample, predicted with what an identification has found: runs of the
posterior, as bands.

The case is run at the fit, and for parameters drawn from the posterior. Between the quantiles of
these runs lie 95 % of them; so a snap that comes earlier in some of them makes a wide band there,
where slopes would say nothing.
"""

import copy
import time
from collections.abc import Iterator, Mapping, Sequence
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
ALWAYS = ("step", "branch", "mode", "amplitude")


@dataclass(frozen=True)
class PathColumn:
    """A result along a step: its name in the data, its column of path.csv, and the data in the unit
    of that.
    """

    header: str
    of: str
    data: Array
    change: bool


@dataclass(frozen=True)
class Prediction:
    """Prediction of a programme: as in identify.json, in words, and as rows of its table."""

    name: str
    content: dict[str, Any]
    said: list[str]
    rows: list[dict[str, Any]]

    def write(self, folder: Path) -> None:
        """Write table and picture."""
        if self.rows:
            write_csv(self.rows, list(self.rows[0]), folder / f"identify_{self.name}.csv")
            draw_programme(
                self.rows, self.name, self.content["places"], folder / f"identify_{self.name}.png"
            )


@dataclass
class Programme:
    """A case that is predicted.

    Attributes
    ----------
    source
        The case, with its own settings.
    places, steps
        Column of path.csv, what it is at each place of the data, and the steps of these; without
        data these are all points of the last step.
    keys
        Of the runs, that of the fit first; "" where drawn parameters make no case.
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
        """Run the case at the fit and for drawn parameters; collective, and every rank computes
        runs of its own.
        """
        cases = dict[str, Case]()
        for number, x in enumerate([posterior.x, *posterior_samples(posterior, self.samples)]):
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
                case.problem()
            except CaseError as e:
                if not number:
                    raise CaseError(f"identify.predict.{self.name}: at the fit: {e}") from None
                self.keys.append("")
                continue
            self.keys.append(identity(case))
            cases[self.keys[-1]] = case
        folder = predictor.folder
        missing = predictor.comm.bcast([key for key in cases if self._outcome(folder, key) is None])
        if predictor.comm.rank == 0:
            say(f"{self.name}: {len(cases)} runs, {len(missing)} to compute")

        def computed(key: str) -> Iterator[str]:
            outcome = self._run(cases[key])
            keep_outcome(outcome, cases[key], _file(folder, key))
            why = f", {outcome.stopped}" if outcome.stopped else ""
            number = missing.index(key) + 1
            points = f"{len(outcome.curve)} points"
            yield f"{number:5d}/{len(missing)}  {self.name}: {points}{why}"

        compute(missing, computed, predictor.comm, say)
        predictor.count += len(missing)

    def _run(self, case: Case) -> Outcome:
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
        curve = [{name: row[name] for name in self._needed if name in row} for row in outcome.curve]
        return replace(outcome, curve=curve, wall_s=round(time.perf_counter() - start_time, 3))

    @property
    def _needed(self) -> dict[str, None]:
        place_and_results = [self.place, *(item.of for item in self.columns)]
        names = [
            *ALWAYS,
            *place_and_results,
            *(name for item in self.scalars for name in (item.column, item.at)),
        ]
        return dict.fromkeys(name for name in names if name not in ("", "end"))

    def _outcome(self, folder: Path, key: str) -> Outcome | None:
        """Return the stored outcome of a run; None after an error, which may have been one of the
        machine, so that it is tried again.
        """
        outcome = stored_outcome_of_case(_file(folder, key))
        if outcome is None or (outcome.stopped or "").startswith(FAILED):
            return None
        complete = not outcome.curve or self._needed.keys() <= outcome.curve[0].keys()
        return outcome if complete else None

    def prediction(
        self, folder: Path, posterior: Posterior, noise: Mapping[str, Mapping[str, Any]]
    ) -> Prediction:
        """Return the prediction with its bands from the stored runs.

        Raises
        ------
        CaseError
            If the run at the fit fails.
        """
        outcomes = [
            stored_outcome_of_case(_file(folder, key)) if key else None for key in self.keys
        ]
        first, drawn_ones = outcomes[0], outcomes[1:]
        assert first
        if not first.curve:
            raise CaseError(
                f"identify.predict.{self.name}: nothing is predicted at the fit: {first.stopped}"
            )
        runs = [item for item in drawn_ones if item and item.curve]
        curves = [_PathCurve(item.curve, self.place) for item in (first, *runs)]
        places, steps = self.places, self.steps
        if places is None:
            places = np.array(curves[0].along_step(self.last)[0])
            steps = np.full(places.size, self.last, dtype=np.int64)
        rows = [
            row
            for column in self.columns
            for row in self._rows(
                column, places, steps, curves, self._noise(column, noise), len(drawn_ones)
            )
        ]
        numbers = {
            item.name: self._number(item, first, runs, len(drawn_ones)) for item in self.scalars
        }
        measured = [row for row in rows if row["measured"] != "" and row["low_measured"] != ""]
        count_inside = int(
            sum(row["low_measured"] <= row["measured"] <= row["high_measured"] for row in measured)
        )
        stopped = [item.stopped for item in runs if item.stopped]
        lost_count = len(drawn_ones) - len(runs)
        content = {
            "samples": len(drawn_ones),
            "without_path": lost_count,
            "stopped_early": len(stopped),
            "stopped": first.stopped,
            "places": self.place,
            "measured": len(measured),
            "inside": count_inside,
            "numbers": numbers,
        }
        return Prediction(self.name, content, self._sentences(content), rows)

    def _sentences(self, content: Mapping[str, Any]) -> list[str]:
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
        """The standard deviation of such a measurement, where the identification knows it."""
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
        values = np.array([curve.values_at(column, places, steps) for curve in curves])
        for i, place in enumerate(places):
            value, band = values[0, i], band_of(values[1:, i], samples)
            low, high = band or (np.nan, np.nan)
            row = {
                "step": int(steps[i]),
                self.place: float(place),
                "result": column.of,
                "measured": float(column.data[i]) if column.data.size else np.nan,
                "predicted": float(value),
                "low": low,
                "high": high,
                "low_measured": value - np.hypot(value - min(low, value), NORMAL * noise)
                if band
                else np.nan,
                "high_measured": value + np.hypot(max(high, value) - value, NORMAL * noise)
                if band
                else np.nan,
            }
            yield {
                name: "" if isinstance(v, float) and not np.isfinite(v) else v
                for name, v in row.items()
            }

    @staticmethod
    def _number(
        scalar: Scalar, first: Outcome, runs: Sequence[Outcome], samples: int
    ) -> dict[str, Any]:
        values = np.array(
            [np.nan if (v := outcome.value(scalar)) is None else v for outcome in runs]
        )
        band = band_of(values, samples)
        low, high = band or (None, None)
        return {
            "value": first.value(scalar),
            "low": low,
            "high": high,
            "runs": int(np.isfinite(values).sum()),
        }


class _PathCurve:
    """The curve of a run, read step by step."""

    def __init__(self, rows: Sequence[Row], place: str) -> None:
        self._rows = [row for row in rows if row["branch"] == 0 and row["mode"] in OWN_MODES]
        self._place = place

    def along_step(self, step: int, column: str = "") -> tuple[list[float], list[float]]:
        """Places and values of a column in a step, from the point where it begins."""
        rows_of_step = [i for i, row in enumerate(self._rows) if row["step"] == step]
        rows = (
            self._rows[max(rows_of_step[0] - 1, 0) : rows_of_step[-1] + 1] if rows_of_step else []
        )
        return [float(row[self._place]) for row in rows], [
            float(row[column or self._place]) for row in rows
        ]

    def values_at(self, column: PathColumn, places: Array, steps: NDArray[np.int64]) -> Array:
        """Return a column where the path first passes each place in its step; nan where it does
        not.
        """
        values = np.full(len(places), np.nan)
        for step in np.unique(steps):
            x, y = map(np.array, self.along_step(int(step), column.of))
            if x.size < 2:
                continue
            y = y - y[0] if column.change else y
            slack = 1e-9 * np.ptp(x)
            for i in np.flatnonzero(steps == step):
                low, high = np.minimum(x[:-1], x[1:]) - slack, np.maximum(x[:-1], x[1:]) + slack
                passed = np.flatnonzero(
                    (low <= places[i]) & (places[i] <= high) & (x[1:] != x[:-1])
                )
                if passed.size:
                    k = passed[0]
                    values[i] = y[k] + (y[k + 1] - y[k]) * np.clip(
                        (places[i] - x[k]) / (x[k + 1] - x[k]), 0, 1
                    )
        return values


def _file(folder: Path, key: str) -> Path:
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
    """Build the programme of a section; collective. If a field is identified, the case must have
    room for its points.

    Raises
    ------
    CaseError
        If the case or a setting is none, lacks a parameter, or has no such result.
    """
    location = f"identify.predict.{name}"
    base = copy.deepcopy(source)
    try:
        if section.case:
            base = read_source(source.folder / section.case)
        for setting in section.settings:
            override(base, setting)
        for key in ("identify", "ensemble", "design"):
            base.data.pop(key, None)
        if lacking := next(
            (p.key for p in parameters if value_at(base.data, p.key.split(".")) is None), None
        ):
            raise CaseError(f"{section.case or 'the case'} has no {lacking}, which is looked for")
        if with_field and (missing_room := without_room(base.data, source.data)):
            raise CaseError(f"{section.case or 'the case'}: {missing_room}")
        problem = make_case(base).problem()
    except CaseError as e:
        raise CaseError(f"{location}: {e}") from None
    names = _PathColumnNames(problem)
    last = len(problem.programme)
    load_column = names.in_case_units(amplitude(problem.programme[-1].name).column) if last else ""
    place, columns = load_column, list[PathColumn]()
    places: Array | None = None
    steps: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
    if section.data:
        place, places, steps, columns = _measured(
            source.folder / section.data, names, last, f"{location}.data"
        )
    measured = {key.of for key in columns}
    for result in section.of:
        if "@" not in result and result in names.all:
            column_in_units = names.in_case_units(result)
            columns += (
                []
                if column_in_units in measured
                else [PathColumn(result, column_in_units, np.zeros(0), change=False)]
            )
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
    predicted = {text for key in columns for text in (key.header, key.of)}
    if unknown := next((result for result in section.changes if result not in predicted), None):
        raise CaseError(
            f"{location}.changes: {unknown}: is no column that is predicted; these are "
            f"{', '.join(predicted)}"
        )
    columns = [
        replace(key, change=bool({key.header, key.of} & {*section.changes})) for key in columns
    ]
    return Programme(
        name, base, section.samples, make_case, last, place, places, steps, columns, scalars
    )


def refuse_unfit_programmes(
    source: Source, case: Case, section: IdentifySection, make_case: MakeCase
) -> None:
    """Check that cases, settings and results of all predictions exist; collective.

    Raises
    ------
    CaseError
        See `programme`.
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
    try:
        return parse_scalar(result)
    except CaseError as e:
        raise CaseError(f"{location}.of: {str(e).removeprefix('--result ')}") from None


class _PathColumnNames:
    """The columns of path.csv that a case has."""

    def __init__(self, problem: Any) -> None:
        self.sizes = sizes_in_units(problem)
        numbers = (name for name in (*COLUMNS, *extra_columns(problem)) if name not in TEXTS)
        self.all = dict.fromkeys(numbers)

    def in_case_units(self, name: str) -> str:
        """The column in units of a column, or itself."""
        in_units = self.sizes.column(name)
        return in_units.name if in_units else name

    def column_of(self, name: str, unit: str | None, location: str) -> tuple[str, float]:
        """The column of a name with a unit, and what one of that unit is in it.

        Raises
        ------
        CaseError
            If there is none, or a unit is missing.
        """
        in_units = {q.name: q.si for base in self.all if (q := self.sizes.column(base))}
        if unit is None:
            if name not in self.all or name in TEXTS:
                raise CaseError(f"{location}: {name}: is no column of path.csv of this case")
            if (column_in_units := self.in_case_units(name)) != name:
                raise CaseError(
                    f"{location}: {name}: has no unit: write {name} [{in_units[column_in_units]}]"
                )
            return name, 1.0
        fitting = [column for column in in_units if column == name or column.startswith(f"{name}_")]
        for column in sorted(fitting, key=len):
            try:
                return column, column_size(name, unit, in_units[column])
            except TableError as e:
                raise CaseError(f"{location}: {e}") from None
        raise CaseError(
            f"{location}: {name}: has the unit {unit}, but no column of this name has one in this "
            "case"
        )


def _measured(
    file: Path, names: _PathColumnNames, last: int, location: str
) -> tuple[str, Array, NDArray[np.int64], list[PathColumn]]:
    """The place, what it is in each row, the rows' steps, and the columns."""
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
    measured = [
        (header, *names.column_of(header, units[header], location), values)
        for header, values in values_by_header.items()
    ]
    headers_by_result = dict[str, str]()
    for header, result, _, _ in measured:
        refuse_twice(header, result, headers_by_result, location)
        headers_by_result[result] = header
    (_, place, factor, place_values), *others = measured
    steps = np.asarray(columns.get("step", np.full(place_values.size, last)))
    for row in np.flatnonzero(np.isnan(place_values) | ~np.isin(steps, np.arange(1, last + 1)))[:1]:
        raise CaseError(
            f"{location}: line {rows.lines[row]}: a row has no place, or no step of 1 to {last}"
        )
    return (
        place,
        place_values * factor,
        steps.astype(np.int64),
        [PathColumn(h, result, v * f, change=False) for h, result, f, v in others],
    )

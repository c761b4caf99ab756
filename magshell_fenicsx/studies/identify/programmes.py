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

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.quantities.registry import OWN_MODES
from magshell_fenicsx.runs.running import run
from magshell_fenicsx.studies.identify.laplace import Posterior
from magshell_fenicsx.studies.identify.picture import draw_programme
from magshell_fenicsx.studies.identify.posterior_samples import NORMAL, band_of, posterior_samples
from magshell_fenicsx.studies.identify.predictor import Predictor
from magshell_fenicsx.studies.outcome import FAILED, Outcome, outcome_of
from magshell_fenicsx.studies.points import Case, MakeCase, identity
from magshell_fenicsx.studies.results import Scalar
from magshell_fenicsx.studies.runner import Say, compute_points, say_on_first_rank
from magshell_fenicsx.studies.store import OutcomeStore, write_table

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
            write_table(self.rows, folder / f"identify_{self.name}.csv")
            draw_programme(
                self.rows, self.name, self.content["places"], folder / f"identify_{self.name}.png"
            )


@dataclass(frozen=True)
class ProgrammeRun:
    """A run of a programme.

    Attributes
    ----------
    case, key
        The validated case, and a hash of its problem.
    label
        Name of the programme.
    """

    case: Case
    key: str
    label: str


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
        runs = dict[str, ProgrammeRun]()
        for number, x in enumerate([posterior.x, *posterior_samples(posterior, self.samples)]):
            case = self._case_at(predictor, number, x)
            if case is None:
                self.keys.append("")  # a run that cannot be made
                continue
            key = identity(case)
            self.keys.append(key)
            runs[key] = ProgrammeRun(case, key, self.name)
        comm, store = predictor.comm, _store(predictor.folder)
        missing = store.missing(runs.values(), comm, self._is_usable)
        say_on_first_rank(say, comm)(f"{self.name}: {len(runs)} runs, {len(missing)} to compute")
        compute_points(missing, self._outcome_of_run, store, comm, say, words=_points_text)
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

    def _outcome_of_run(self, programme_run: ProgrammeRun) -> Outcome:
        """Compute a run on this rank; any exception becomes a failed outcome.

        The curve of the outcome keeps only the needed columns.
        """
        start_time = time.perf_counter()
        try:
            outcome = outcome_of(run(programme_run.case.problem(), comm=MPI.COMM_SELF))
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

    def _is_usable(self, outcome: Outcome) -> bool:
        """Return whether a stored outcome has the needed columns, and is not that of an error.

        The error may have been one of the machine.
        """
        if outcome.is_error:
            return False
        return not outcome.curve or self._needed_columns.keys() <= outcome.curve[0].keys()

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
        store = _store(folder)
        outcomes = [store.outcome(key) if key else None for key in self.keys]
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


def _store(folder: Path) -> OutcomeStore[Outcome]:
    """Return the outcomes of the runs in the folder of the identification."""
    return OutcomeStore(folder / "points", Outcome)


def _points_text(outcome: Outcome) -> str:
    """Return the outcome of a run in words: its points, and why it ended early."""
    reason = f", {outcome.stopped}" if outcome.stopped else ""
    return f"{len(outcome.curve)} points{reason}"

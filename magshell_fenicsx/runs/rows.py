"""Rows of path.csv and their columns, made from the records of a path.

A record is a point of a history with its origin: label, step, scene, and the clock of a motion
(time, work and energies since the begin of its step). A row has a record's columns by name. A scene
is the model of a problem with its solver. A motion is a step in time. The journal keeps the values
of all points, which a resumed run takes from there. h is the thickness.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.point import RecordedValues
from magshell_fenicsx.continuation.transient import MIN_ENERGY_DISPLACEMENT
from magshell_fenicsx.output.store.table import COLUMNS, Row
from magshell_fenicsx.parts.motion.motion_step import TimeSection
from magshell_fenicsx.parts.step import BALANCE, ProgrammeStep
from magshell_fenicsx.parts.step_course import SnapSection
from magshell_fenicsx.quantities.registry import amplitude
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene

if TYPE_CHECKING:
    import pandas

ROWS_SHOWN = 30  # of a table in a notebook
SUMMED_COLUMNS = ("time", "dissipated", "work")


class RowMaker:
    """Maker of the rows of one path, which takes its records in their order.

    A record is a point of a history with its origin; a row is a mapping of columns of path.csv.

    Attributes
    ----------
    _scene
        The first scene of the path; a record of a larger model has a scene of its own.
    _count
        Number of rows so far.
    _field_end
        w_over_h at the last point of a field that comes before the loads.
    _sums, _sums_before, _step
        Sums of the columns in time at the last record, and before its step; number of that step.
    _is_programme
        Whether the case has a list of steps.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._count, self._field_end = scene, 0, 0.0
        self._sums = dict.fromkeys(SUMMED_COLUMNS, 0.0)
        self._sums_before, self._step = dict(self._sums), 0
        # a field that is the only load is no field before the loads
        self._is_programme = scene.problem.listed

    def row(self, record: Record, wall_s: float) -> Row:
        """Return the next row of path.csv for a record; collective.

        `wall_s` is the time in seconds since the start of the run.
        """
        scene = record.scene or self._scene
        point, journal = record.point, self._scene.journal
        values = journal.recorded_values(lambda: RecordedValues(scene.observe(point.state))).values
        is_field_step = self._is_programme and amplitude(record.amplitude).is_field
        # w_from_field_over_h is measured from the last point of a field that comes before the loads
        if record.label in ("start", "field") or is_field_step:
            self._field_end = values["w_over_h"]
        self._count += 1
        row: Row = {
            "point": self._count - 1,
            "label": record.label,
            "amplitude": record.amplitude,
            **values,
            "w_from_field_over_h": values["w_over_h"] - self._field_end,
            "negative_pivots": point.negative_pivots,
            "negative_pivots_held": point.negative_pivots_held,
            "iterations": point.iterations,
            "factorisations": point.factorisations,
            "wall_s": round(wall_s, 3),
            "mode": record.mode,
            "branch": record.branch,
            "error_over_h": point.error,
            "load_error": point.load_error,
            "excluded_pivots": record.excluded_pivots,
            "step": record.step,
            **self._in_time(record, values),
        }
        return {**row, **self._scene.sizes.values(row)}

    def _in_time(self, record: Record, values: Mapping[str, float]) -> dict[str, float]:
        """Return the columns of steps in time; empty if the path has no such steps.

        Time, work and dissipated energy are sums over all steps of the programme; a record has them
        since the begin of its step. `values` are the observed values of the record, by column.
        """
        if "time" not in self._scene.extra_columns:
            return {}
        if record.step != self._step:  # a new step: its clock begins at zero
            self._sums_before, self._step = dict(self._sums), record.step
        since_begin = {name: record.clock.get(name, 0.0) for name in SUMMED_COLUMNS}
        self._sums = {name: self._sums_before[name] + since_begin[name] for name in SUMMED_COLUMNS}
        stored_energy = (record.scene or self._scene).energy_of_shell(
            record.point.state, values["energy"]
        )
        values_of_record = {name: record.clock.get(name, 0.0) for name in ("kinetic", "imbalance")}
        return {**self._sums, **values_of_record, "stored": stored_energy}


def imbalances(
    programme: Iterable[ProgrammeStep], rows: Sequence[Row], length: float
) -> Iterator[str]:
    """Yield warnings about steps in time that gain or lose more energy than their `balance` allows.

    Parameters
    ----------
    rows
        The rows of the path.
    length
        A displacement of the system that counts as of order one, over R.
    """
    for step in programme:
        # a static step has a limit too, as its snap may be a motion
        max_imbalance = step.load.balance if isinstance(step.load, TimeSection) else BALANCE
        step_imbalances = [
            _imbalance(row, length)
            for row in rows
            if row["step"] == step.number and row.get("imbalance")
        ]
        worst = max(step_imbalances, key=abs, default=0.0)
        if abs(worst) > max_imbalance:
            yield (
                f"step {step.number}: its steps in time {'gain' if worst > 0 else 'lose'} "
                f"{abs(worst):.2g} of the energies, more than balance: {max_imbalance:g}; "
                "take a smaller step, tolerance or balance, or rho_inf: 1, which loses none"
            )


def _chooses_step_length(motion: TimeSection | SnapSection) -> bool:
    """Return whether a motion chooses the length of its steps itself.

    One to an instability does not count, as it ends where states become unstable; nor does a snap.
    """
    if isinstance(motion, SnapSection):
        return False
    return motion.step is None and motion.until != "instability"


def motion_errors(programme: Iterable[ProgrammeStep], all_rows: Sequence[Row]) -> Iterator[str]:
    """Yield warnings about motions whose error is, or may be, larger than their tolerance.

    Parameters
    ----------
    all_rows
        The rows of the path, of static steps too.
    """
    for step in programme:
        load = step.load
        motion = load if isinstance(load, TimeSection) else load.end.snap
        rows = [
            row for row in all_rows if row["step"] == step.number and row["amplitude"] == "time"
        ]
        if motion is None or not rows:
            continue
        error = max(float(row["error_over_h"]) for row in rows)
        if motion.errors == "motion" and error > motion.tolerance:
            yield (
                f"step {step.number}: the estimated error of its motion is {error:.2g} h, "
                f"more than tolerance: {motion.tolerance:g}; even the shortest steps leave it"
            )
        estimates_own_steps = motion.errors == "step" and _chooses_step_length(motion)
        is_unstable = any(int(row["negative_pivots"]) for row in rows)
        if estimates_own_steps and is_unstable:
            yield (
                f"step {step.number}: it passes unstable states, which magnify the errors of its "
                "steps in time; errors: motion keeps those of the motion below tolerance"
            )


def _imbalance(row: Row, length: float) -> float:
    """Return the energy imbalance of a row over the sum of its energies.

    A small displacement of the system's `length` bounds the sum from below.
    """
    # near rest all energies are small, and their ratio would be rounding
    energies = sum(abs(float(row[name])) for name in ("kinetic", "stored", "dissipated", "work"))
    return float(row["imbalance"]) / (energies + (MIN_ENERGY_DISPLACEMENT * length) ** 2)


def rows(scene: Scene, records: Iterable[Record]) -> list[Row]:
    """Return the rows of some records of a scene, with nan for the time; collective."""
    maker = RowMaker(scene)
    return [maker.row(record, np.nan) for record in records]


class Table(dict[str, NDArray[np.generic]]):
    """Columns by name, each an array (rows,)."""

    def __missing__(self, key: object) -> NDArray[np.generic]:
        names = ", ".join([*self][3:5])
        raise KeyError(f"{key!r}: columns have names, such as {names}; rows are in result.rows")

    def __repr__(self) -> str:
        """Return the size and the names of the columns."""
        return f"Table of {self._row_count} rows: {', '.join(self)}"

    def _repr_html_(self) -> str:
        """Return the first rows as a table of a notebook, without columns that are all zero."""
        names = [name for name, values in self.items() if np.any(values != np.zeros_like(values))]
        shown = min(self._row_count, ROWS_SHOWN)
        head = "".join(f"<th>{escape(name)}</th>" for name in names)
        rows = "".join(
            "<tr>" + "".join(f"<td>{_cell(self[name][i])}</td>" for name in names) + "</tr>"
            for i in range(shown)
        )
        rest = self._row_count - shown
        more = f"<p>and {rest} further rows</p>" if rest else ""
        return f"<table><tr>{head}</tr>{rows}</table>{more}"

    @property
    def _row_count(self) -> int:
        """Number of rows."""
        return len(next(iter(self.values()), ()))

    def to_pandas(self) -> "pandas.DataFrame":
        """Return a frame of pandas, which the package does not need otherwise.

        Raises
        ------
        ModuleNotFoundError
            If pandas is not there.
        """
        try:
            import pandas
        except ModuleNotFoundError:
            raise ModuleNotFoundError(
                "to_pandas: needs pandas: python3 -m pip install pandas"
            ) from None
        return pandas.DataFrame(dict(self))


def _cell(value: Any) -> str:
    """Return a value as the text of a cell: numbers with six digits."""
    return escape(f"{value:.6g}" if isinstance(value, float) else str(value))


def table(rows: Sequence[Row], extra: Iterable[str]) -> Table:
    """Return the columns of rows: those that every run has, and the named extra ones."""
    columns = Table()
    for name in (*COLUMNS, *extra):
        columns[name] = np.array([row[name] for row in rows])
    return columns


def columns(scene: Scene, records: Iterable[Record] | Record) -> Table:
    """Return the columns of path.csv except wall_s, each an array (records,). Collective.

    `columns(...).to_pandas()` is a frame of pandas.

    Raises
    ------
    ValueError
        If the arguments are in another order, or a record is of another model.
    """
    records = list(records) if isinstance(records, Iterable) else [records]
    Scene.refuse_other_arguments("columns", scene, records)
    by_name = table(rows(scene, records), scene.extra_columns)
    del by_name["wall_s"]
    return by_name

"""The outcome of a run of a study.

An outcome is found along the path of the run, or as a fold that is followed from another run. A
knockdown k_d is the pressure of the first fold over the classical one. A scalar is a named number
of a run.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from magshell_fenicsx.output.store.table import COLUMNS, Row
from magshell_fenicsx.runs.summary import Result, in_units, snaps
from magshell_fenicsx.simulate.discretisation_error import ErrorEstimates
from magshell_fenicsx.studies.results import Scalar

OutcomeOrigin = Literal["path", "fold"]
FAILED = "failed: "  # what `stopped` begins with if an error ended the run


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run, or of a fold that was followed from another run.

    Attributes
    ----------
    knockdown
        k_d; None if there is no instability under pressure.
    limit
        The first limit point (the one of k_d) as in summary.json, or the event that ends a motion;
        None without.
    stopped
        Why the run ended before its target; None if it reached it.
    dofs
        Number of unknowns; None for a run that failed.
    wall_s
        Wall time.
    curve
        Every accepted point, with the columns of path.csv.
    found
        "path": the full path was computed; "fold": the fold of another run was followed, and the
        curve has only this point.
    factorisations
        Factorisations of the model's tangent, including failed attempts; without those for excluded
        modes.
    barrier
        The energy barrier over E h R²; None if the case does not ask for one.
    cpu_s
        CPU time of a sample of an ensemble.
    in_units
        Numbers of a case with units, as in summary.json.
    snaps
        As in summary.json.
    errors
        Name of a result -> its estimated absolute error, as in summary.json; empty if nobody asked.
    errors_not_estimated
        Name of a result -> why it has no estimate, as in summary.json.
    """

    knockdown: float | None
    limit: dict[str, Any] | None
    stopped: str | None
    dofs: int | None
    wall_s: float
    curve: list[Row]
    found: OutcomeOrigin
    factorisations: int
    barrier: float | None = None
    cpu_s: float = 0.0
    in_units: dict[str, float] = field(default_factory=dict)
    snaps: list[dict[str, Any]] = field(default_factory=list)
    errors: dict[str, float] = field(default_factory=dict)
    errors_not_estimated: dict[str, str] = field(default_factory=dict)

    @classmethod
    def failed(cls, why: str, wall_s: float = 0.0, factorisations: int = 0) -> "Outcome":
        """Return the outcome of a run without a result, for a reason."""
        return cls(None, None, why, None, wall_s, [], "path", factorisations)

    @property
    def is_error(self) -> bool:
        """Whether an error ended the run, which may have been one of the machine."""
        return (self.stopped or "").startswith(FAILED)

    def value(self, scalar: Scalar) -> float | None:
        """Return a named number of the run; None if the run does not have it."""
        if not self.curve:  # a failed run
            return None
        # summary.json, as far as a scalar reads it
        summary = {
            "knockdown": self.knockdown,
            "barrier": self.barrier,
            "limit_points": [self.limit] if self.limit else [],
            "snaps": self.snaps,
            "in_units": self.in_units,
        }
        # rows as texts, as in path.csv
        rows = [_texts_of(row) for row in self.curve]
        return scalar.value_in(summary, rows)

    def error(self, scalar: Scalar) -> float | None:
        """Return the estimated error of a named number of the run; None without an estimate."""
        return scalar.error_in(self.errors, [_texts_of(row) for row in self.curve])

    @property
    def why_not_estimated(self) -> str | None:
        """Why results have no estimated error; None if all have one."""
        reasons = (f"{name}: {reason}" for name, reason in self.errors_not_estimated.items())
        return "; ".join(reasons) or None

    def serves(self, scalar: Scalar) -> bool:
        """Return whether the outcome is enough for a number.

        A fold alone has the knockdown only. A path must have the columns of the number.
        """
        if scalar.name == "knockdown":
            return True
        if self.found != "path":
            return False
        if scalar.is_frequency and self.stopped is None:
            return bool(self.curve) and any(scalar.column in row for row in self.curve)
        needed = {scalar.column, scalar.at} & set(COLUMNS)  # those that an outcome may leave out
        return not self.curve or needed <= self.curve[0].keys()


def _texts_of(row: Mapping[str, Any]) -> dict[str, str]:
    """Return the values of a row as texts."""
    return {key: str(v) for key, v in row.items()}


def _kept_part(row: Row, kept_columns: Iterable[str]) -> Row:
    """Return those of some columns that a row has, without numbers of numpy."""
    return {
        key: v if isinstance(v := row[key], str | int) else float(v)
        for key in kept_columns
        if key in row
    }


def outcome_of(
    result: Result,
    origin: OutcomeOrigin = "path",
    factorisations: int | None = None,
    wall_s: float = 0.0,
    columns: Sequence[str] = COLUMNS,
    estimates: ErrorEstimates | None = None,
) -> Outcome:
    """Return the outcome of a run, or of a fold in the form of a run.

    Parameters
    ----------
    origin
        "path" for a run, "fold" for a fold that was followed.
    factorisations
        Number of factorisations; None for those of the result's own scene.
    columns
        Columns of path.csv that the curve keeps, beside those that the scene adds.
    estimates
        `Result.error_estimates`, where they are wanted.
    """
    if factorisations is None:
        factorisations = result.scene.newton.factorisation.count
    # the limit point of k_d first, as `False` is sorted before `True`; the others stay in order
    limit_points = sorted(
        result.limit_points,
        key=lambda p: p["amplitude"] != "pressure" or p["value"] != result.knockdown,
    )
    # columns of the curve, each once and in order
    kept_columns = dict.fromkeys((*columns, *result.scene.extra_columns))
    return Outcome(
        knockdown=result.knockdown,
        limit=next(iter(limit_points), None) or _event(result),
        stopped=result.stopped,
        dofs=result.scene.model.system.dofs,
        wall_s=round(wall_s, 3),
        curve=[_kept_part(row, kept_columns) for row in result.rows],
        found=origin,
        factorisations=factorisations,
        barrier=result.barrier,
        in_units=in_units(result),
        snaps=snaps(result.rows) if origin == "path" else [],  # a fold alone has no path
        errors=estimates.errors if estimates else {},
        errors_not_estimated=estimates.reasons if estimates else {},
    )


def _event(result: Result) -> dict[str, Any] | None:
    """Return the point at which an event or an instability ended a motion, as a limit point.

    None if the run ended otherwise.
    """
    last_row, steps = result.rows[-1], result.scene.problem.programme
    # what ends the last step; only a motion in time has the amplitude "time"
    until = getattr(steps[-1].load, "until", "") if steps else ""
    if result.stopped or last_row["amplitude"] != "time":
        return None
    if until not in ("event", "instability"):
        return None
    common = {key: last_row[key] for key in ("p_over_pc", "w_pole_over_h", "amplitude")}
    return {**common, "kind": until, "mode": "", "value": last_row["time"]}

"""Differences between two curves, and the number by which runs are compared."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magshell_fenicsx.quantities.registry import amplitude
from magshell_fenicsx.studies.compare.runs import ModelRun
from magshell_fenicsx.studies.study.scalar import Scalar

W = "w"  # displacement of the mid-surface since the end of the field


@dataclass(frozen=True)
class Difference:
    """Loads of both models at the same displacement."""

    w_over_h: float
    shell: float
    solid: float

    @property
    def relative(self) -> float:
        """Relative difference of the solid from the shell."""
        return self.solid / self.shell - 1


def amplitude_of(run: ModelRun) -> str:
    """The amplitude that varied last."""
    return run.rows[-1]["amplitude"]


def curve(run: ModelRun) -> tuple[list[float], list[float]]:
    """Displacements and loads of the last part of the path, without branches."""
    y = amplitude(amplitude_of(run)).column
    return [float(row[W]) for row in loaded(run)], [float(row[y]) for row in loaded(run)]


def loaded(run: ModelRun) -> list[dict[str, str]]:
    """The rows of the last part of the path and the row before it, with the displacement since that row.

    The field displaces the mid-surface of a solid by nu lambda_m R/h more (of w/h), since it also stretches the
    thickness. The displacement since the end of the field excludes this.
    """
    varied = amplitude_of(run)
    x = "w_point_over_h" if varied == "force" else "w_pole_over_h"  # the same point in both models
    first = next(i for i, row in enumerate(run.rows) if row["amplitude"] == varied)
    before = run.rows[max(first - 1, 0)]
    part = [before, *(row for row in run.rows[first:] if row["amplitude"] == varied and row["branch"] == "0")]
    return [{**row, W: repr(float(row[x]) - float(before[x]))} for row in part]


def places(runs: Sequence[ModelRun]) -> list[float]:
    """The displacements 1, 2, ... that all runs reach, or their last common one if it is below 1.

    Empty if a run has no targets: its steps are too long to interpolate between them.
    """
    if not all(any(row["label"] == "target" for row in loaded(run)) for run in runs):
        return []
    end = min(max(curve(run)[0]) for run in runs)
    return [float(w) for w in range(1, int(end + 1e-6) + 1)] or [end]


def differences(shell: ModelRun, solid: ModelRun) -> list[Difference]:
    """The differences at the displacements that both runs reach."""
    found = []
    for place in places([shell, solid]):
        loads = [load_at(run, place) for run in (shell, solid)]
        if loads[0] is not None and loads[1] is not None:
            found.append(Difference(place, loads[0], loads[1]))
    return found


def load_at(run: ModelRun, w: float) -> float | None:
    """The load at a displacement; None if the run does not reach it."""
    return Scalar("", amplitude(amplitude_of(run)).column, W, w).of(run.summary, loaded(run))


def judged(runs: Sequence[ModelRun], at: float | None) -> tuple[str, list[float | None]]:
    """The name and the values of the compared number: k_d if all runs have it, else the load at a displacement."""
    if all(run.summary["knockdown"] is not None for run in runs):
        return "knockdown", [float(run.summary["knockdown"]) for run in runs]
    if at is None:
        return "nothing", [None for _ in runs]
    return f"{amplitude(amplitude_of(runs[0])).column} at w/h = {at:g}", [load_at(run, at) for run in runs]


def time_at(error: float, runs: Sequence[tuple[float, float]]) -> float | None:
    """Run time in seconds for an error, interpolated between runs (error, seconds); None outside their range.

    Examples
    --------
    >>> round(time_at(0.01, [(0.1, 1.0), (0.001, 100.0)]), 9)
    10.0
    """
    ordered = sorted((e, s) for e, s in runs if e > 0)
    if not ordered or not ordered[0][0] <= error <= ordered[-1][0]:
        return None
    e, s = np.log(np.array(ordered)).T
    return float(np.exp(np.interp(np.log(error), e, s)))

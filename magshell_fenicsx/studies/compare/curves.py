"""Curves of load over displacement of a shell and of a solid, and the differences between them.

A curve is the load over the displacement w/h in the last part of the path, in which the last
amplitude (load parameter) varies. Loads are compared at places, displacements that both models
reach. h and R are thickness and reference length.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from magshell_fenicsx.quantities.registry import amplitude
from magshell_fenicsx.studies.compare.model_runs import ModelRun
from magshell_fenicsx.studies.results import Scalar

W = "w"  # displacement of the mid-surface since the end of the field


@dataclass(frozen=True)
class Difference:
    """The loads of both models at the same displacement.

    Attributes
    ----------
    w_over_h
        The displacement.
    shell, solid
        The loads.
    """

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
    """Return displacements w/h and loads of the last part of the path, without branches.

    The last part is that in which the last amplitude varies. The displacement counts from its
    begin.
    """
    y = amplitude(amplitude_of(run)).column
    return [float(row[W]) for row in loaded(run)], [float(row[y]) for row in loaded(run)]


def loaded(run: ModelRun) -> list[dict[str, str]]:
    """Return the rows of path.csv of the last part of the path, and the row before it.

    In the last part the last amplitude varies. The column `W` has the displacement since the row
    before.

    The field displaces the mid-surface of a solid more, by its strength times Poisson's ratio and
    R, since it also stretches the thickness. The displacement since the end of the field excludes
    this.
    """
    load_name = amplitude_of(run)
    # the same point in both models: of a force where it acts
    displacement_column = "w_point_over_h" if load_name == "force" else "w_pole_over_h"
    first = next(i for i, row in enumerate(run.rows) if row["amplitude"] == load_name)
    row_before = run.rows[max(first - 1, 0)]
    load_rows = [
        row for row in run.rows[first:] if row["amplitude"] == load_name and row["branch"] == "0"
    ]
    # with the displacement since the row before, as text like all columns
    begin = float(row_before[displacement_column])
    return [
        {**row, W: repr(float(row[displacement_column]) - begin)}
        for row in (row_before, *load_rows)
    ]


def _has_target(run: ModelRun) -> bool:
    """Return whether a run has reached a target while its load varied."""
    return any(row["label"] == "target" for row in loaded(run))


def places(runs: Sequence[ModelRun]) -> list[float]:
    """Return the displacements w/h = 1, 2, ... that all runs reach.

    If the last common displacement is below 1, the list has that alone. It is empty if a run has no
    targets: its steps are too long to interpolate between them.
    """
    if not all(_has_target(run) for run in runs):
        return []
    end = min(max(curve(run)[0]) for run in runs)
    # the tolerance is for an end that is a whole number but for rounding
    return [float(w) for w in range(1, int(end + 1e-6) + 1)] or [end]


def differences(shell: ModelRun, solid: ModelRun) -> list[Difference]:
    """Return the differences of the loads at the displacements that both runs reach."""
    loads_at_places = (
        (place, load_at(shell, place), load_at(solid, place)) for place in places([shell, solid])
    )
    return [
        Difference(place, shell_load, solid_load)
        for place, shell_load, solid_load in loads_at_places
        if shell_load is not None and solid_load is not None
    ]


def load_at(run: ModelRun, w: float) -> float | None:
    """Return the load of a run at a displacement w/h; None if the run does not reach it."""
    # the column of the load, where the displacement first has this value
    load = Scalar("", column=amplitude(amplitude_of(run)).column, at=W, value=w)
    return load.value_in(run.summary, loaded(run))

"""The status of a run, as one line of text: how far it is and how long it may take.

A programme is the list of load steps of a case; each drives an amplitude (a load parameter), whose
value is a column of path.csv, up to a target or an event. The conjugate of an amplitude is the
displacement on which it does work. A row has the columns of path.csv at a point. A step of the
programme has many points, and the solver takes a step in arc length to each. A scene is the model
of a problem with its solver.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.output.store.table import SOLUTION, Row
from magshell_fenicsx.parts.registered import OBSERVABLES
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.quantities.quantity import format_number
from magshell_fenicsx.quantities.registry import Sizes, amplitude, shown_quantity
from magshell_fenicsx.simulate.scene import Scene

EVENT_WORDS = {"limit": "the first instability", "bifurcation": "the first bifurcation"}


@dataclass(frozen=True)
class PathEnd:
    """The event at which a step of the programme ends, by which its progress is measured.

    Attributes
    ----------
    column
        Column of path.csv: the load, or the quantity with a target.
    end
        Value of the column at the end; None if the path ends at another event.
    words
        Words for that event, such as "the first instability".
    steps
        Number of steps after which the path ends; None if it ends otherwise.
    sizes
        Sizes of dimensionless numbers in the case's units.
    """

    column: str
    end: float | None = None
    words: str = ""
    steps: int | None = None
    sizes: Sizes = field(default_factory=Sizes)

    def completed_part(self, first: Row, row: Row, steps: int) -> float | None:
        """Return the completed part of the path, from 0 to 1; None if the end is unknown.

        Parameters
        ----------
        first, row
            Rows of path.csv: of the point where the path begins, and of the present one.
        steps
            Number of steps so far.
        """
        if self.steps is not None:
            return steps / self.steps
        first_value = float(first[self.column])
        if self.end is None or self.end == first_value:
            return None
        return (float(row[self.column]) - first_value) / (self.end - first_value)

    def text(self, row: Row) -> str:
        """Return the present value and the end, in the case's units if the row has them.

        Examples
        --------
        >>> PathEnd("w_over_h", 20.0).text({"w_over_h": 5.0})
        'w/h 5 -> 20'
        """
        shown = shown_quantity(self.column, row)
        size, unit = 1.0, ""  # of a column without a second one in units
        if shown.name != self.column:
            size, unit = self.sizes.size(self.column), f" {shown.si}"
        value = format_number(float(row[shown.name]), ".4g")
        if self.end is None:
            return f"{shown.ascii_symbol} {value}{unit} -> {self.words}"
        return f"{shown.ascii_symbol} {value} -> {self.end * size:.4g}{unit}"


def path_end(scene: Scene, step: ProgrammeStep) -> PathEnd:
    """Return the event at which a step of the programme of a scene ends.

    A scene is the model of a problem with its solver.
    """
    problem, load, load_column = scene.problem, step.load, amplitude(step.name).column
    # an end of the step's own, in words
    planned_end = load.expected_end(problem.context.at_step(step), problem.loads, problem.azimuth)
    if planned_end:
        return PathEnd(load_column, planned_end.end, planned_end.words, planned_end.steps)
    # a number of steps, or an event
    if step.until == "points":
        return PathEnd(load_column, words=f"{load.points} steps", steps=load.points)
    if step.until != "target" or load.end.target is None:
        return PathEnd(load_column, words=EVENT_WORDS.get(step.until, ""))
    target, value = load.end.target
    if target.quantity == "load":
        return PathEnd(load_column, value)
    # a target of the conjugate: in a column of a part
    for observables in OBSERVABLES:
        if column := observables.conjugates(problem.loads).get(step.name):
            return PathEnd(column, value)
    # or a displacement over h, in a column of its own if there is one
    own_column = f"w_{step.name}_over_h"
    displacement_column = own_column if own_column in scene.extra_columns else target.column
    h_in_unit_of_target = problem.length * problem.material.h if load.in_lengths else 1.0
    return PathEnd(displacement_column, value / h_in_unit_of_target)


def time_left(begin: tuple[float, float], present: tuple[float, float]) -> float | None:
    """Return the seconds to the end at the average speed so far; None if nothing or all is done.

    Parameters
    ----------
    begin, present
        Completed part (0 to 1) and time (s), at two points of the path.

    Examples
    --------
    >>> time_left((0.0, 10.0), (0.25, 20.0))
    30.0
    """
    completed, seconds = present[0] - begin[0], present[1] - begin[1]
    if completed <= 0 or present[0] >= 1:
        return None
    return seconds * (1 - present[0]) / completed


def clock(seconds: float) -> str:
    """Return a time as minutes and seconds, and hours from one hour on.

    Examples
    --------
    >>> clock(7.4), clock(3671)
    ('0:07', '1:01:11')
    """
    minutes, remaining_seconds = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60}:{minutes % 60:02d}:{remaining_seconds:02d}"
    return f"{minutes}:{remaining_seconds:02d}"


def status_line(what: str, seconds: float) -> str:
    """Return an activity in a few words and the time so far (s), as `clock` shows it."""
    return f"{what}  {clock(seconds)}"


class RunProgress:
    """Reporter of the status of a run; a `continuation.point.Progress`, which path solvers call.

    Parameters
    ----------
    scene
        The model of the problem with its solver.
    report
        Function that shows a status line in place of the one before.
    start
        Start of the run, in seconds of `time.perf_counter`.

    Attributes
    ----------
    _scene, _report, _start
        The parameters of these names.
    _path_ends
        End of each step of the programme.
    _step
        Number of the present step of the programme, from 1.
    _row, _first
        Rows of path.csv: of the last point of the path, and of the point where the step begins.
    _points, _steps
        Number of points of the run, and of steps of the solver in this step of the programme.
    _at_begin, _at_present
        Completed part of the step and time (s): where the speed is measured from, and now.
    """

    def __init__(self, scene: Scene, report: Callable[[str], None], start: float) -> None:
        self._scene, self._report, self._start = scene, report, start
        self._path_ends = [
            replace(path_end(scene, step), sizes=scene.sizes) for step in scene.problem.programme
        ]
        self._row: Row = {}  # of the last point of the path
        self._first: Row = {}  # of the point where the step of the programme begins
        self._step = 1  # of the programme
        self._points = self._steps = 0  # of the run, and of the solver in this step
        # completed part of the step and time (s), where the speed is measured from and now
        self._at_begin = self._at_present = (0.0, 0.0)

    def beginning(self, step: int) -> None:
        """Note that the programme's step of this number, from 1, begins at the last point."""
        self._step, self._first, self._steps = step, self._row, 0
        self._at_begin = self._at_present = (0.0, self._at_present[1])

    def accepted(self, row: Row, *, is_known: bool) -> None:
        """Note a new point, and the completed part of its step.

        Parameters
        ----------
        row
            The point's row of path.csv.
        is_known
            Whether an interrupted run had found the point: then it does not count for the speed.
        """
        present_time = time.perf_counter()
        self._points += 1
        if row["label"] == SOLUTION:  # of a search, beside the path
            return
        self._row = row
        self._steps += row["label"] == "step"
        completed_part = None
        if self._first and self._path_end:
            completed_part = self._path_end.completed_part(self._first, row, self._steps)
        self._at_present = (completed_part or 0.0, present_time)
        if is_known:
            self._at_begin = self._at_present

    def trying(self, here: Point, length: float) -> None:
        """Report that a step begins at an accepted point, with the goal and the time that is left.

        Parameters
        ----------
        here
            The accepted point.
        length
            Length of the step in the arc length s of the path.
        """
        now, h = time.perf_counter(), self._scene.problem.material.h
        # largest change of an unknown over h, by the tangent du/ds of the path
        change = float(np.abs(here.du).max(initial=0.0)) * abs(length) / h
        # the time so far, and about how much is left since the last point
        remaining = None if self._branched else time_left(self._at_begin, self._at_present)
        time_text = clock(now - self._start)
        if remaining is not None:
            since_point = now - self._at_present[1]
            time_text += f", about {clock(max(0.0, remaining - since_point))} left"
        # where the path is, and its goal
        step_of_programme = ""
        if self._scene.problem.listed:
            step_of_programme = f" in step {self._step} of {len(self._path_ends)}"
        goal = ""
        if self._snaps:
            goal = "the snap"
        elif self._path_end:
            goal = self._path_end.text(self._row)
        parts = f"{self._count}{step_of_programme}", goal, time_text, f"du/h {change:.2g}"
        self._report("  ".join(part for part in parts if part))

    def doing(self, what: str) -> None:
        """Report an activity other than a step; `what` names it in a few words."""
        self._report(status_line(f"{self._count}  {what}", time.perf_counter() - self._start))

    @property
    def _count(self) -> str:
        """The number of points so far, as text."""
        return f"{self._points} point{'s' * (self._points != 1)}"

    @property
    def _path_end(self) -> PathEnd | None:
        """End of the present step of the programme; None without steps."""
        return self._path_ends[self._step - 1] if self._path_ends else None

    @property
    def _load(self) -> Any:
        """Load of the present step; None without steps."""
        steps = self._scene.problem.programme
        return steps[self._step - 1].load if steps else None

    @property
    def _branched(self) -> bool:
        """Whether the case requests branches; their number is not known in advance."""
        return self._load is not None and self._load.end.branch_points > 0

    @property
    def _snaps(self) -> bool:
        """Whether the step has reached the instability where `then: snap` releases the shell."""
        if getattr(self._load, "then", None) != "snap":
            return False
        begin = "bifurcation" if self._load.until == "bifurcation" else "fold"
        return self._row.get("label") == begin or self._row.get("amplitude") == "time"

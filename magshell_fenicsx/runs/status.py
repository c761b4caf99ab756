"""The status of a run, as one line of text: how far it is and how long it may take."""

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
from magshell_fenicsx.quantities.registry import Sizes, amplitude, quantity, shown_quantity
from magshell_fenicsx.simulate.scene import Scene

EVENT_WORDS = {"limit": "the first instability", "bifurcation": "the first bifurcation"}


@dataclass(frozen=True)
class PathEnd:
    """End of a path.

    Attributes
    ----------
    column
        Column of path.csv: the load, or the quantity with a target.
    end
        Its value at the end; None if the path ends at another event.
    words
        Words for that event.
    steps
        Number of steps after which the path ends; None if it ends otherwise.
    sizes
        Sizes in the case's units.
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
            The point where the path begins, and the present one.
        steps
            Number of steps so far.
        """
        if self.steps is not None:
            return steps / self.steps
        begin = float(first[self.column])
        if self.end is None or self.end == begin:
            return None
        return (float(row[self.column]) - begin) / (self.end - begin)

    def text(self, row: Row) -> str:
        """Return the present value and the end.

        Examples
        --------
        >>> PathEnd("w_over_h", 20.0).text({"w_over_h": 5.0})
        'w/h 5 -> 20'
        """
        q = shown_quantity(self.column, row)
        size, unit = 1.0, ""
        if q.name != self.column:
            size = self.sizes.by_unit.get(quantity(self.column).scale, 1.0)
            unit = f" {q.si}"
        value = format_number(float(row[q.name]), ".4g")
        if self.end is None:
            return f"{q.ascii_symbol} {value}{unit} -> {self.words}"
        return f"{q.ascii_symbol} {value} -> {self.end * size:.4g}{unit}"


def path_end(scene: Scene, step: ProgrammeStep) -> PathEnd:
    """Return the end of a step of the programme."""
    load, varied_amplitude = step.load, amplitude(step.name)
    if planned_end := load.expected_end(
        step, scene.problem.context, scene.problem.loads, scene.problem.azimuth
    ):
        return PathEnd(
            varied_amplitude.column, planned_end.end, planned_end.words, planned_end.steps
        )
    if step.until == "points":
        return PathEnd(varied_amplitude.column, words=f"{load.points} steps", steps=load.points)
    if step.until != "target" or load.target is None:
        return PathEnd(varied_amplitude.column, words=EVENT_WORDS.get(step.until, ""))
    target, value = load.target
    if target.quantity == "load":
        return PathEnd(varied_amplitude.column, value * load.size(scene.problem.context))
    for observables in OBSERVABLES:
        if column := observables.conjugates(scene.problem.loads).get(step.name):
            return PathEnd(column, value)
    own_column = f"w_{step.name}_over_h"
    in_h = scene.problem.length * scene.problem.material.h if load.in_lengths else 1.0
    return PathEnd(own_column if own_column in scene.extra_columns else target.column, value / in_h)


def time_left(begin: tuple[float, float], present: tuple[float, float]) -> float | None:
    """Return seconds to the end at the average speed so far; None if nothing or everything is done.

    Parameters
    ----------
    begin, present
        Completed part and time in seconds, at two points of the path.

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
    """Return hours, minutes and seconds.

    Examples
    --------
    >>> clock(7.4), clock(3671)
    ('0:07', '1:01:11')
    """
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"
    return f"{minutes}:{rest:02d}"


def status_line(what: str, seconds: float) -> str:
    """Return the present activity, and the time so far."""
    return f"{what}  {clock(seconds)}"


class RunProgress:
    """Reporter of the status of a run; a `continuation.point.Progress`.

    Parameters
    ----------
    report
        Function that shows a status line in place of the one before.
    start
        Start of the run, in seconds of `time.perf_counter`.
    """

    def __init__(self, scene: Scene, report: Callable[[str], None], start: float) -> None:
        self._scene, self._report, self._start = scene, report, start
        self._path_ends = [
            replace(path_end(scene, step), sizes=scene.sizes) for step in scene.problem.programme
        ]
        self._row: Row = {}
        self._first: Row = {}
        self._step = 1
        self._points = self._steps = 0
        self._at_begin = self._at_present = (0.0, 0.0)

    def beginning(self, step: int) -> None:
        """Note that a step of the programme begins at the last point; its number is from 1."""
        self._step, self._first, self._steps = step, self._row, 0
        self._at_begin = self._at_present = (0.0, self._at_present[1])

    def accepted(self, row: Row, *, is_known: bool) -> None:
        """Note a new point; `is_known` if an interrupted run had found it."""
        present_time = time.perf_counter()
        self._points += 1
        if row["label"] == SOLUTION:
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
        """Report a step of a length from a point."""
        now, h = time.perf_counter(), self._scene.problem.material.h
        step = float(np.abs(here.du).max(initial=0.0)) * abs(length) / h
        remaining = None if self._branched else time_left(self._at_begin, self._at_present)
        times = clock(now - self._start)
        if remaining is not None:
            since_point = now - self._at_present[1]
            times += f", about {clock(max(0.0, remaining - since_point))} left"
        number = ""
        if self._scene.problem.listed:
            number = f" in step {self._step} of {len(self._path_ends)}"
        goal = ""
        if self._snaps:
            goal = "the snap"
        elif self._path_end:
            goal = self._path_end.text(self._row)
        parts = f"{self._count}{number}", goal, times, f"du/h {step:.2g}"
        self._report("  ".join(part for part in parts if part))

    def doing(self, what: str) -> None:
        """Report another activity."""
        self._report(status_line(f"{self._count}  {what}", time.perf_counter() - self._start))

    @property
    def _count(self) -> str:
        return f"{self._points} point{'s' * (self._points != 1)}"

    @property
    def _path_end(self) -> PathEnd | None:
        return self._path_ends[self._step - 1] if self._path_ends else None

    @property
    def _load(self) -> Any:
        """Load of the present step; None without steps."""
        steps = self._scene.problem.programme
        return steps[self._step - 1].load if steps else None

    @property
    def _branched(self) -> bool:
        """Whether the case requests branches; their number is not known in advance."""
        return self._load is not None and self._load.branch_points > 0

    @property
    def _snaps(self) -> bool:
        """Whether the step has come to its fold and the shell is released there."""
        released = self._row.get("label") == "fold" or self._row.get("amplitude") == "time"
        return released and getattr(self._load, "then", None) == "snap"

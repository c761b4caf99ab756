"""The status of a run, as one line of text."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.output.store.table import SOLUTION, Row
from magshell_fenicsx.parts.registered import SEEN
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.quantities.quantity import format_number
from magshell_fenicsx.quantities.registry import Sizes, amplitude, quantity, shown_quantity
from magshell_fenicsx.simulate.scene import Scene

WORDS = {"limit": "the first instability", "bifurcation": "the first bifurcation"}


@dataclass(frozen=True)
class Aim:
    """The end of a path.

    Attributes
    ----------
    column
        Column of path.csv: the load, or the quantity with a target.
    end
        Its value at the end; None if the path ends at another event.
    words
        That event.
    steps
        Number of steps after which the path ends; None if it ends otherwise.
    sizes
        Of the case's units.
    """

    column: str
    end: float | None = None
    words: str = ""
    steps: int | None = None
    sizes: Sizes = field(default_factory=Sizes)

    def part(self, first: Row, row: Row, steps: int) -> float | None:
        """The completed part of the path at a point, after some steps; None if the end is unknown.

        Parameters
        ----------
        first
            The point where the path begins.
        """
        if self.steps is not None:
            return steps / self.steps
        begin = float(first[self.column])
        if self.end is None or self.end == begin:
            return None
        return (float(row[self.column]) - begin) / (self.end - begin)

    def text(self, row: Row) -> str:
        """The present value and the end.

        Examples
        --------
        >>> Aim("w_over_h", 20.0).text({"w_over_h": 5.0})
        'w/h 5 -> 20'
        """
        q, of = shown_quantity(self.column, row), self.sizes.by_unit.get(quantity(self.column).scale, 1.0)
        size, unit = (of, f" {q.si}") if q.name != self.column else (1.0, "")
        end = self.words if self.end is None else f"{self.end * size:.4g}{unit}"
        return f"{q.ascii_symbol} {format_number(float(row[q.name]), '.4g')}{unit * (self.end is None)} -> {end}"


def aim(scene: Scene, step: ProgrammeStep) -> Aim:
    """The end of a step."""
    load, varied = step.load, amplitude(step.name)
    if ahead := load.ahead(step, scene.problem.context, scene.problem.loads, scene.problem.azimuth):
        return Aim(varied.column, ahead.end, ahead.words, ahead.steps)
    if step.until == "points":
        return Aim(varied.column, words=f"{load.points} steps", steps=load.points)
    if step.until != "target" or load.target is None:
        return Aim(varied.column, words=WORDS.get(step.until, ""))
    target, value = load.target
    if target.quantity == "load":
        return Aim(varied.column, value * load.size(scene.problem.context))
    for room in SEEN:
        if column := room.conjugates(scene.problem.loads).get(step.name):
            return Aim(column, value)
    own = f"w_{step.name}_over_h"
    in_h = scene.problem.length * scene.problem.material.h if load.in_lengths else 1.0
    return Aim(own if own in scene.extra_columns else target.column, value / in_h)


def time_left(begun: tuple[float, float], now: tuple[float, float]) -> float | None:
    """Seconds to the end at the average speed so far; None if nothing or everything is done.

    Parameters
    ----------
    begun, here
        Completed part and time in seconds, at two points of the path.

    Examples
    --------
    >>> time_left((0.0, 10.0), (0.25, 20.0))
    30.0
    """
    done, taken = now[0] - begun[0], now[1] - begun[1]
    return taken * (1 - now[0]) / done if done > 0 and now[0] < 1 else None


def clock(seconds: float) -> str:
    """Hours, minutes and seconds.

    Examples
    --------
    >>> clock(7.4), clock(3671)
    ('0:07', '1:01:11')
    """
    minutes, rest = divmod(round(seconds), 60)
    return (
        f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"
        if minutes >= 60
        else f"{minutes}:{rest:02d}"
    )


def waiting(what: str, seconds: float) -> str:
    """The present activity, and the time so far."""
    return f"{what}  {clock(seconds)}"


class RunProgress:
    """Reports the status of a run; a `continuation.point.Progress`.

    Parameters
    ----------
    report
        Called with a status line that replaces the one before.
    start
        Start of the run, in seconds of `time.perf_counter`.
    """

    def __init__(self, scene: Scene, report: Callable[[str], None], start: float) -> None:
        self._scene, self._report, self._start = scene, report, start
        self._aims = [
            replace(aim(scene, step), sizes=scene.sizes) for step in scene.problem.programme
        ]
        self._row: Row = {}
        self._first: Row = {}
        self._step = 1
        self._points = self._steps = 0
        self._begun = self._here = (0.0, 0.0)

    def beginning(self, step: int) -> None:
        """Note that a step of the programme begins at the last point; its number is from 1."""
        self._step, self._first, self._steps = step, self._row, 0
        self._begun = self._here = (0.0, self._here[1])

    def accepted(self, row: Row, *, known: bool) -> None:
        """Note a new point; `known` if an interrupted run had found it."""
        now = time.perf_counter()
        self._points += 1
        if row["label"] == SOLUTION:
            return
        self._row = row
        self._steps += row["label"] == "step"
        part = self._aim.part(self._first, row, self._steps) if self._first and self._aim else None
        self._here = (part or 0.0, now)
        if known:
            self._begun = self._here

    def trying(self, here: Point, length: float) -> None:
        now, h = time.perf_counter(), self._scene.problem.material.h
        step = float(np.abs(here.du).max(initial=0.0)) * abs(length) / h
        left = None if self._branched else time_left(self._begun, self._here)
        times = clock(now - self._start)
        if left is not None:
            times += f", about {clock(max(0.0, left - (now - self._here[1])))} left"
        of = f" in step {self._step} of {len(self._aims)}" if self._scene.problem.listed else ""
        ahead = "the snap" if self._snaps else self._aim.text(self._row) if self._aim else ""
        self._report(
            "  ".join(
                part for part in (f"{self._count}{of}", ahead, times, f"du/h {step:.2g}") if part
            )
        )

    def doing(self, what: str) -> None:
        self._report(waiting(f"{self._count}  {what}", time.perf_counter() - self._start))

    @property
    def _count(self) -> str:
        return f"{self._points} point{'s' * (self._points != 1)}"

    @property
    def _aim(self) -> Aim | None:
        return self._aims[self._step - 1] if self._aims else None

    @property
    def _load(self) -> Any:
        """What the present step drives; None without steps."""
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

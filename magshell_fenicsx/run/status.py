"""The status of a run, as one line of text."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from math import acos, degrees, isclose

import numpy as np

from magshell_fenicsx.case.loading import (
    DeadSection,
    FieldSection,
    IndentationSection,
    PathSection,
    PressureSection,
    RotationSection,
)
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.quantities.registry import quantity
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
    """

    column: str
    end: float | None = None
    words: str = ""
    steps: int | None = None

    def part(self, row: Row, steps: int) -> float | None:
        """The completed part of the path at a point, after some steps; None if the end is unknown."""
        if self.steps is not None:
            return steps / self.steps
        return float(row[self.column]) / self.end if self.end else None

    def text(self, row: Row) -> str:
        """The present value and the end.

        Examples
        --------
        >>> Aim("w_over_h", 20.0).text({"w_over_h": 5.0})
        'w/h 5 -> 20'
        """
        end = self.words if self.end is None else f"{self.end:.4g}"
        return f"{quantity(self.column).plain} {float(row[self.column]) + 0.0:.4g} -> {end}"  # no minus zero


def aim(scene: Scene) -> Aim:
    """The end of the path that follows the field."""
    case, loading = scene.case, scene.case.loading
    targets: dict[str, float | None] = {"lambda_m": case.lambda_m}
    if isinstance(loading, PressureSection):
        targets = {"p_over_pc": loading.pressure, "volume_change": loading.volume_change}
    elif isinstance(loading, IndentationSection):
        targets = {"force": loading.force, "w_over_h": loading.depth}
    elif isinstance(loading, DeadSection):
        far = loading.displacement
        h = scene.plan.length * scene.plan.material.h
        targets = {"load_factor": loading.factor, "w_over_h": None if far is None else far / h}
    elif isinstance(loading, RotationSection) and case.magnetic:
        targets = {"field_angle": degrees(acos(case.magnetic.applied.vector() @ loading.to.vector()))}
    until, load = loading.until if isinstance(loading, PathSection) else "target", next(iter(targets))
    if until == "points" and isinstance(loading, PathSection):
        return Aim(load, words=f"{loading.points} steps", steps=loading.points)
    if until != "target":
        return Aim(load, words=WORDS[until])
    return next(Aim(column, end) for column, end in targets.items() if end is not None)


def time_left(begun: tuple[float, float], here: tuple[float, float]) -> float | None:
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
    done, taken = here[0] - begun[0], here[1] - begun[1]
    return taken * (1 - here[0]) / done if done > 0 and here[0] < 1 else None


def clock(seconds: float) -> str:
    """Hours, minutes and seconds.

    Examples
    --------
    >>> clock(7.4), clock(3671)
    ('0:07', '1:01:11')
    """
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}" if minutes >= 60 else f"{minutes}:{rest:02d}"


def waiting(what: str, seconds: float) -> str:
    """The present activity, and the time so far."""
    return f"{what}  {clock(seconds)}"


class RunProgress:
    """Reports the status of a run; a `continuation.listener.Progress`.

    Parameters
    ----------
    report
        Called with a status line that replaces the one before.
    start
        Start of the run, in seconds of `time.perf_counter`.
    """

    def __init__(self, scene: Scene, report: Callable[[str], None], start: float) -> None:
        self._scene, self._report, self._start, self._aim = scene, report, start, aim(scene)
        self._row: Row = {}
        self._points = self._steps = 0
        self._begun = self._here = (0.0, 0.0)

    def accepted(self, row: Row, *, known: bool) -> None:
        """Note a new point; `known` if an interrupted run had found it."""
        now = time.perf_counter()
        self._row, self._points = row, self._points + 1
        on_load = row["label"] not in ("start", "field") or self._loads_by_field
        self._steps += on_load and row["label"] == "step"
        part = self._aim.part(row, self._steps)
        self._here = (part or 0.0, now)
        if known or not on_load or self._points == 1:
            self._begun = self._here

    def trying(self, here: Point, length: float) -> None:
        now, h = time.perf_counter(), self._scene.plan.material.h
        step = float(np.abs(here.du).max(initial=0.0)) * abs(length) / h
        in_field = self._in_field
        ahead = Aim("lambda_m", self._scene.case.lambda_m) if in_field else self._aim
        left = None if in_field or self._branched else time_left(self._begun, self._here)
        times = clock(now - self._start)
        if left is not None:
            times += f", about {clock(max(0.0, left - (now - self._here[1])))} left"
        self._report(f"{self._count}  {ahead.text(self._row)}  step {step:.2g} h  {times}")

    def doing(self, what: str) -> None:
        self._report(waiting(f"{self._count}  {what}", time.perf_counter() - self._start))

    @property
    def _count(self) -> str:
        return f"{self._points} point{'s' * (self._points != 1)}"

    @property
    def _loads_by_field(self) -> bool:
        return isinstance(self._scene.case.loading, FieldSection | None)

    @property
    def _in_field(self) -> bool:
        """Whether the field is still growing, before the load."""
        before_load = self._row["label"] in ("start", "field") and not self._loads_by_field
        return before_load and not isclose(float(self._row["lambda_m"]), self._scene.case.lambda_m)

    @property
    def _branched(self) -> bool:
        """Whether the case requests branches; their number is not known in advance."""
        loading = self._scene.case.loading
        return isinstance(loading, PathSection) and loading.branches

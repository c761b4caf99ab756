"""What a run is at, as one line of text for people who wait for it."""

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
    """Where a path leads.

    Attributes
    ----------
    column
        Of path.csv, the load or what is asked for.
    end
        Its value at the end; None where the path ends otherwise.
    words
        What the path ends at then.
    steps
        Number of steps after which it ends; None where it ends otherwise.
    """

    column: str
    end: float | None = None
    words: str = ""
    steps: int | None = None

    def part(self, row: Row, steps: int) -> float | None:
        """What of the way is done at a point, after so many steps; None where the length of the way is not known."""
        if self.steps is not None:
            return steps / self.steps
        return float(row[self.column]) / self.end if self.end else None

    def told(self, row: Row) -> str:
        """Where a point is on the way.

        Examples
        --------
        >>> Aim("w_over_h", 20.0).told({"w_over_h": 5.0}), Aim("p_over_pc", words="the first instability").told(
        ...     {"p_over_pc": 0.25}
        ... )
        ('w/h 5 -> 20', 'p/pc 0.25 -> the first instability')
        """
        end = self.words if self.end is None else f"{self.end:.4g}"
        return f"{quantity(self.column).plain} {float(row[self.column]) + 0.0:.4g} -> {end}"  # no minus zero


def aim(scene: Scene) -> Aim:
    """Where the path of a scene leads after the field."""
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
    """Seconds to the end if the rest goes as fast as what is done; None if nothing is done yet, or all.

    Parameters
    ----------
    begun, here
        Part of the way and seconds, at two of its points.

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
    """What is done, and the time so far."""
    return f"{what}  {clock(seconds)}"


class RunProgress:
    """Tells what the history of a scene is at; a `solve.progress.Progress`.

    Parameters
    ----------
    tell
        Called with a line that replaces the one before.
    start
        When the run began, in seconds of the clock.
    """

    def __init__(self, scene: Scene, tell: Callable[[str], None], start: float) -> None:
        self._scene, self._tell, self._start, self._aim = scene, tell, start, aim(scene)
        self._row: Row = {}
        self._points = self._steps = 0
        self._begun = self._here = (0.0, 0.0)

    def accepted(self, row: Row, *, known: bool) -> None:
        """A point was found; `known` if an interrupted run had found it."""
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
        said = f"  step {step:.2g} h  {clock(now - self._start)}"
        if left is not None:
            said += f", about {clock(max(0.0, left - (now - self._here[1])))} left"
        self._tell(f"{self._count}  {ahead.told(self._row)}{said}")

    def doing(self, what: str) -> None:
        self._tell(waiting(f"{self._count}  {what}", time.perf_counter() - self._start))

    @property
    def _count(self) -> str:
        return f"{self._points} point{'s' * (self._points != 1)}"

    @property
    def _loads_by_field(self) -> bool:
        return isinstance(self._scene.case.loading, FieldSection | None)

    @property
    def _in_field(self) -> bool:
        """Whether the field grows, before the load."""
        before_load = self._row["label"] in ("start", "field") and not self._loads_by_field
        return before_load and not isclose(float(self._row["lambda_m"]), self._scene.case.lambda_m)

    @property
    def _branched(self) -> bool:
        """Whether branches come after the path, or not: nobody knows before."""
        loading = self._scene.case.loading
        return isinstance(loading, PathSection) and loading.branches

"""Steps along a path: the next one as it is planned, and how long the one after it is, by what
became of it.
"""

from dataclasses import dataclass

import numpy as np

from magshell_fenicsx.continuation.point import PathStopped, Point, StepOptions
from magshell_fenicsx.continuation.snes import HIDDEN

MOST_LEAPS = 3  # longer steps that are tried if rounding hides a point
# at a point that was found too far away; a third point before it means that it is on another branch
LOOKS = 2
LEAST_PART = 0.25  # of a step, to which it is shortened before a fold
SHORTER = 1 - 1e-9  # rounding must not decide whether one step reaches a target
LOOKED_BACK = 4  # points from which the next is foreseen: three, and one with which they are judged


@dataclass(frozen=True)
class Ahead:
    """What happens to forces on the straight way from a point to a first guess.

    Attributes
    ----------
    part
        Of the way, at which forces set in: a step ends there. 1 if none do.
    behind
        Whether it ends just behind; else just before.
    lets_go
        Whether forces of the point are lost at the guess: then its tangent alone foresees the next
        one.
    """

    part: float = 1.0
    behind: bool = False
    lets_go: bool = False


@dataclass(frozen=True)
class Plan:
    """The next step: where it ends, the points that foresee it, its length without forces that set
    in, and those.
    """

    s: float
    seen: list[Point]
    length: float
    ahead: Ahead


@dataclass
class Far:
    """A point that was found too far away, why it is no step, whether it has its own inertia, and
    the looks at it.
    """

    point: Point
    reason: str
    exact: bool
    looks: int = 0


@dataclass
class Course:
    """A path on its way.

    Attributes
    ----------
    passed
        The last points that foresee the next one.
    step
        The length of the next step, where nothing shortens it.
    leaps
        The number of failed steps since the last point.
    far
        A point that a step found too far away.
    vain
        The last point before forces set in, if nothing was found behind that.
    """

    passed: list[Point]
    step: float
    leaps: int = 0
    far: Far | None = None
    vain: Point | None = None

    @property
    def here(self) -> Point:
        """The last point."""
        return self.passed[-1]

    def length(self, way: float) -> float:
        """Of the next step on a way to a target: no tiny step is left before that."""
        pieces = max(1.0, np.ceil(SHORTER * abs(way) / self.step)) if np.isfinite(way) else np.inf
        return abs(way) / pieces if pieces < 3 else self.step

    def failed(self, plan: Plan, reason: str, smallest: float) -> None:
        """A step failed: the next one is another one.

        Raises
        ------
        PathStopped
            If that would be shorter than the smallest.
        """
        if plan.ahead.part < 1 and plan.ahead.behind:
            self.vain, self.far = self.here, None
            return
        self.leaps += 1
        over = reason == HIDDEN and self.leaps <= MOST_LEAPS  # step over the singular tangent
        self.step = 2 * plan.length if over else plan.length / 2
        if not self.step >= smallest:
            raise PathStopped(reason, self.here)

    def reached(
        self, point: Point, plan: Plan, options: StepOptions, *, straight: bool, corner: bool
    ) -> None:
        """A step ended at a point, almost straight, or behind a corner."""
        o, length = options, plan.length
        if straight and (point.factorisations <= o.easy or point.iterations <= o.few):
            longer = min(self.step + length / 2, 2 * length)
            self.step = min(max(self.step, longer), o.largest)  # a target may have cut it
        elif point.factorisations >= o.hard and plan.ahead.part == 1:
            self.step = 0.6 * length
        before = [] if plan.ahead.part < 1 or corner else self.passed[1 - LOOKED_BACK :]
        self.passed, self.leaps = [*before, point], 0

    def reached_again(self, point: Point, length: float) -> None:
        """The point that was too far away is a step from here."""
        self.passed, self.step, self.far = [*self.passed[1 - LOOKED_BACK :], point], length, None

    def still_far(self, far: Far, length: float) -> None:
        """It is not, at a length ahead, or behind if that is negative."""
        if length > 0:
            self.step = min(self.step, max(length / 2, LEAST_PART * self.step))
        self.far = far if far.looks < LOOKS else None

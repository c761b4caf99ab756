"""A walk along a path to its goal, with every instability and every requested point on the way."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from magshell_fenicsx.continuation.events import instabilities
from magshell_fenicsx.continuation.path import Path, Quantity
from magshell_fenicsx.continuation.point import PathStopped, Point
from magshell_fenicsx.continuation.system import State

Label = Literal["step", "target", "fold", "bifurcation"]
Until = Literal["limit", "bifurcation", "target", "points"]
MOST_STEPS = 1000
SAME = 1e-2  # distance along the path, in the system's lengths, below which two folds are one


@dataclass(frozen=True)
class Goal:
    """Where a walk ends, and which points are requested on the way.

    Attributes
    ----------
    until
        "limit": at the first instability, or at the last target; "bifurcation": at the first
        bifurcation, through folds; "target": at the last target; "points": after `steps` steps.
    targets
        Requested points: values of s or, on a path by arc length, of `quantity`.
    quantity
        "load": the amplitude; "conjugate": the displacement conjugate to it.
    steps
        With every other `until`, the largest number of steps.
    sense
        Direction of s if there is no target.
    """

    until: Until
    targets: Sequence[float] = ()
    quantity: Quantity = "load"
    steps: int = MOST_STEPS
    sense: float = 1.0


class Walk:
    """A walk; iterate over it once.

    Parameters
    ----------
    renew
        The state of the first of two successive points with other amplitudes beside that of the path, from which the
        walk goes on in place of the second; None if that is accepted.

    Attributes
    ----------
    points
        The start, the steps so far, and the instability or target that ended the walk.
    done
        Whether the last point ends the walk.
    """

    def __init__(
        self, path: Path, start: Point, goal: Goal, renew: Callable[[Point, Point], State | None] | None = None
    ) -> None:
        self.path, self.goal, self.points, self._renew = path, goal, [start], renew
        self.done = False
        self._folds: list[Point] = []

    def __iter__(self) -> Iterator[tuple[Label, Point]]:
        """Labels and points, in the order of the path.

        Raises
        ------
        PathStopped
            If the path is lost, returns to a fold that it has passed, or needs more steps than allowed.
        """
        options, shorter = self.path.options, None
        while True:
            for point, reached in self.path.towards(self.points[-1], self._ahead()):
                low, shorter = self.points[-1], None
                if self._renew and (state := self._renew(low, point)):
                    self.points[-1], shorter = self.path.renewed(low, state), abs(point.s - low.s)
                    break
                try:
                    between = self._between(low, point)
                except PathStopped:  # the step had left the branch: approach in shorter steps
                    shorter = abs(point.s - low.s) / 4
                    break
                for label, found, self.done in between:
                    yield label, found
                    if label == "fold":
                        self._refuse_loop(found)
                    if self.done:
                        self.points.append(found)
                        return
                self.points.append(point)
                self.done = not self._ahead() or (self.goal.until == "points" and len(self.points) > self.goal.steps)
                yield ("target" if reached else "step"), point
                if len(self.points) > self.goal.steps:
                    if self.goal.until == "points":
                        return
                    raise PathStopped(
                        f"{self.goal.steps} steps have not reached the {self.goal.until}", point, final=True
                    )
            if shorter is None:
                return
            if shorter < options.smallest:
                raise PathStopped("an instability cannot be located", self.points[-1])
            self.path = self.path.in_steps(replace(options, first=shorter))

    def _refuse_loop(self, fold: Point) -> None:
        """Stop at a fold that was passed before. Two successive folds may be close, so the last one is not compared."""
        name, u = self.path.name, fold.state.u
        mu = fold.state.mu[name]
        for known in self._folds[:-1]:
            if self.path.metric.norm(u - known.state.u, mu - known.state.mu[name]) < SAME:
                said = "the path has come back to this fold: a closed loop, which leads nowhere else"
                raise PathStopped(said, fold, final=True)
        self._folds.append(fold)

    @property
    def _by_arc(self) -> bool:
        return self.path.control == "arc"

    def _ahead(self) -> list[float]:
        """The values of s that are still to be reached."""
        goal, here = self.goal, self.points[-1].s
        if self._by_arc:
            return [np.inf]
        if not goal.targets:
            return [float(np.copysign(np.inf, goal.sense))]
        sense = goal.targets[-1] - self.points[0].s
        return [t for t in goal.targets if (t - here) * sense > 0]

    def _between(self, low: Point, high: Point) -> list[tuple[Label, Point, bool]]:
        """Instabilities and, with arc length, targets between two points; the flag marks the end of the walk."""
        found: list[tuple[Label, Point, bool]] = []
        for event in instabilities(self.path, low, high):
            ends = self.goal.until in ("limit", event.kind)
            found.append((event.kind, event.point, ends))
            if ends:
                break
        if self._by_arc and self.goal.targets:
            found += self._crossed(low, high)
        return sorted(found, key=lambda item: abs(item[1].s - low.s))

    def _crossed(self, low: Point, high: Point) -> Iterator[tuple[Label, Point, bool]]:
        """The targets between two points, each solved for."""
        path, quantity, targets = self.path, self.goal.quantity, self.goal.targets
        a, b = path.value(quantity, low.state), path.value(quantity, high.state)
        for target in targets:
            if a == target and (b - a) * self.goal.sense < 0:  # a shorter step sees the load rise first
                raise PathStopped(f"{path.name} falls from the start", low)
            if (target - a) * (target - b) < 0 or b == target:
                s = low.s + (target - a) / (b - a) * (high.s - low.s)
                guess = path.between(s, low, path.seen_from(low, high))
                point = path.solve(path.given(quantity, target), s, guess)
                if isinstance(point, str):
                    raise PathStopped(point, low)
                yield "target", point, self.goal.until in ("target", "limit") and target == targets[-1]

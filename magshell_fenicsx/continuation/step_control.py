"""Step control along a path: the planned step, and the length of the next one after its outcome.

s is the quantity that controls a path, for example its arc length; lengths of steps are in units of
s. An onset is where contact forces begin. A rejected point is a solution that may lie on another
branch, and is compared again with later points. A leap is a longer step after a failure.
"""

from dataclasses import dataclass

import numpy as np

from magshell_fenicsx.continuation.point import PathStopped, Point, StepOptions
from magshell_fenicsx.continuation.snes import HIDDEN_BY_ROUNDING

MAX_LEAPS = 3  # number of longer steps that are tried where rounding hides a point
# number of accepted points from which a rejected one is retried; a third one before it would mean
# that it is on another branch
MAX_RETRIES = 2
MIN_FRACTION_BEFORE_FOLD = 0.25  # of a step: the least to which it is shortened before a fold
BELOW_ONE = 1 - 1e-9  # rounding must not decide whether one step reaches a target
PREDICTOR_POINTS = 4  # three points extrapolate the next one, a fourth estimates their error


@dataclass(frozen=True)
class StepEvent:
    """Onset and loss of contact forces on the straight segment from a point to a predicted state.

    Attributes
    ----------
    fraction
        Fraction of the segment at which new forces begin: a step ends there. 1 if none begin.
    ends_behind
        Whether the step ends just behind the onset; else just before.
    loses_forces
        Whether forces of the point are lost at the prediction: then only the tangent at the point
        predicts the next one.
    is_deep
        Whether faces may lie deep in each other at the prediction: its correction takes patience.
    """

    fraction: float = 1.0
    ends_behind: bool = False
    loses_forces: bool = False
    is_deep: bool = False


@dataclass(frozen=True)
class StepPlan:
    """A planned step from the current point of a path.

    Attributes
    ----------
    s
        The controlled quantity at the end of the step.
    predictors
        Points from which the end is extrapolated, the current one last.
    length
        Length of the step in s without an onset of forces.
    event
        Onset and loss of forces on the step.
    """

    s: float
    predictors: list[Point]
    length: float
    event: StepEvent


@dataclass
class RejectedPoint:
    """A solution that is too far from the point where its step began.

    Attributes
    ----------
    reason
        Why it was rejected.
    exact
        Whether its inertia is that of its own tangent.
    retries
        How many later points it was compared with.
    """

    point: Point
    reason: str
    exact: bool
    retries: int = 0


@dataclass
class StepController:
    """The recent points of a path and the length of its next step.

    Attributes
    ----------
    points
        The last points, from which the next one is extrapolated.
    step
        The length of the next step, unless something shortens it.
    has_onsets
        Whether contact forces begin within steps. Then a solve may be hard for what begins to
        touch, however short its step is.
    leaps
        The number of failed steps since the last point; a few of them may be followed by leaps.
    rejected
        A solution that a step rejected as too far.
    hard_step
        Length and number of factorisations of the last step, if its solve was hard; else None.
    onset_without_solution
        The last point before an onset of forces, if no solution was found behind the onset.
    """

    points: list[Point]
    step: float
    has_onsets: bool = False
    leaps: int = 0
    rejected: RejectedPoint | None = None
    hard_step: tuple[float, int] | None = None
    onset_without_solution: Point | None = None

    @property
    def current(self) -> Point:
        """The last point."""
        return self.points[-1]

    def length(self, distance: float) -> float:
        """Return the length in s of the next step towards a target.

        The last steps before a target have equal lengths, so that none of them is tiny.

        Parameters
        ----------
        distance
            Distance of the target in s, of either sign; it may be infinite.
        """
        steps = np.inf  # number of equal steps to the target
        if np.isfinite(distance):
            steps = max(1.0, np.ceil(BELOW_ONE * abs(distance) / self.step))
        # the last two steps are equal; with more of them ahead the next one has its usual length
        return abs(distance) / steps if steps < 3 else self.step

    def reject_step(self, plan: StepPlan, reason: str, smallest: float) -> None:
        """Choose the length of another step after one that failed.

        It is half as long; where rounding hides the solution it is twice as long, a few times.

        Parameters
        ----------
        plan
            The step that failed.
        reason
            Why it failed.
        smallest
            The smallest length in s.

        Raises
        ------
        PathStopped
            If the next step would be shorter than the smallest.
        """
        # no solution was found just behind an onset: the step is tried again with the same length,
        # and then goes on past the onset
        if plan.event.fraction < 1 and plan.event.ends_behind:
            self.onset_without_solution, self.rejected = self.current, None
            return
        self.leaps += 1
        # a longer step may pass a singular tangent
        leaps_over = reason == HIDDEN_BY_ROUNDING and self.leaps <= MAX_LEAPS
        # a step to a target or an onset is shorter: half of its length might end there again
        tried = abs(plan.s - self.current.s)
        is_shorter = 2 * smallest <= tried < BELOW_ONE * plan.length
        length = tried if is_shorter else plan.length
        self.step = 2 * plan.length if leaps_over else length / 2
        if not self.step >= smallest:
            raise PathStopped(reason, self.current)

    def accept_step(
        self, point: Point, plan: StepPlan, options: StepOptions, *, straight: bool, kink: bool
    ) -> None:
        """Append the end of a step to the points, and adapt the step length.

        Parameters
        ----------
        point
            The end of the step, with the work of its solve.
        plan
            The step as it was planned.
        straight
            Whether the path is straight enough for a longer step.
        kink
            Whether the path has a kink in the step: then no earlier point predicts the next one.
        """
        length = plan.length
        # the length of the next step
        easy = (
            point.factorisations <= options.easy_factorisations
            or point.iterations <= options.easy_iterations
        )
        if straight and easy:
            longer = min(self.step + length / 2, 2 * length)
            # not less than before: this step may have been short only to end at a target
            self.step = min(max(self.step, longer), options.largest)
        # a step to an onset says nothing about the length
        is_hard = point.factorisations >= options.hard_factorisations
        if is_hard and not (straight and easy) and plan.event.fraction == 1:
            self.step = 0.6 * length if self._shortening_pays(length, point) else length
        self.hard_step = (length, point.factorisations) if is_hard else None
        # at most three points before this one, and none before an onset or a kink
        smooth = plan.event.fraction == 1 and not kink
        earlier_points = self.points[1 - PREDICTOR_POINTS :] if smooth else []
        self.points, self.leaps = [*earlier_points, point], 0

    def _shortening_pays(self, length: float, point: Point) -> bool:
        """Return whether a step shorter than the last one, which had a hard solve, may pay.

        It does not where a shorter step has taken as much work per length as the hard step before:
        what begins to touch in it makes its solve hard.

        Parameters
        ----------
        length
            The length of the last step in s.
        point
            The end of that step, with the work of its solve.
        """
        if not (self.has_onsets and self.hard_step):
            return True
        length_before, factorisations_before = self.hard_step
        work, work_before = point.factorisations / length, factorisations_before / length_before
        return length > length_before or work < work_before

    def accept_rejected(self, point: Point, length: float) -> None:
        """Append a solution that was rejected before, a step of a length from the last point."""
        earlier_points = self.points[1 - PREDICTOR_POINTS :]  # at most three
        self.points, self.step = [*earlier_points, point], length
        self.rejected = None

    def keep_rejected(self, rejected: RejectedPoint, length: float) -> None:
        """Keep a solution that is still too far, or drop it after too many comparisons.

        Parameters
        ----------
        length
            How far ahead it lies in s; negative if it lies behind the last point.
        """
        # the next step ends about half way to the solution ahead
        if length > 0:
            self.step = min(self.step, max(length / 2, MIN_FRACTION_BEFORE_FOLD * self.step))
        self.rejected = rejected if rejected.retries < MAX_RETRIES else None

"""Rows of a motion: its states at given times, from the journal if it has them, and their errors.

Departures from unstable states magnify the errors of steps, by a factor that the end of the motion
alone shows. So where the error at the rows is asked for, a motion is computed with longer steps
first. The first such run shows when the motion is fastest: until then no step is longer than there.
Two more show the error, which goes as the square of the steps.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import scipy

from magshell_fenicsx.continuation.advance import TimeSteps, TimeStopped, advance
from magshell_fenicsx.continuation.device import HeldConjugate
from magshell_fenicsx.continuation.motion import Motion
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import State, Vector, max_abs
from magshell_fenicsx.continuation.transient import FactoredState, Integrator
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import make_stage

EVENT_TIME_TOLERANCE = 1e-9  # of an interval
COARSE_TOLERANCE_RATIO = 10.0  # the tolerance of the first run over that of the motion
MAX_COARSE_TOLERANCE = 1e-2
FAST_SPEED = 0.5  # of the largest speed: the steps of rows with more are those of a fast motion
AIMED_ERROR = 0.4  # part of the tolerance that the error at the rows is meant to be
MAX_STEP_RATIO = 8  # the steps of the last coarse run over those of the motion, at most
MIN_STEP_RATIO = 1 / 64  # steps of the motion over those of the second coarse run
# steps of the motion over those of the last coarse run: below that the difference from it shows the
# error
CLEAR_STEP_RATIO = 0.7
TINY_ERROR = 1e-300  # avoids a division by zero
POINTS_OF_ROW = 3  # in the journal


@dataclass(frozen=True)
class RefinedSteps:
    """Steps for the tolerance of a motion, with what coarser runs show of its error.

    Attributes
    ----------
    steps
        Those of the motion.
    rows
        The displacements of the last coarse run.
    errors
        Their estimated errors, over the system's length.
    ratio
        Steps of the motion over those of the last coarse run.
    """

    steps: TimeSteps
    rows: Sequence[Vector]
    errors: Sequence[float]
    ratio: float

    def error(self, scene: Scene, row: int, u: Vector | None) -> float:
        """Return the estimated error of the motion's displacement, over the system's length.

        Parameters
        ----------
        row
            Number of the row.
        u
            The displacement at the row; None for the error before it.
        """
        row, square = min(row, len(self.rows) - 1), self.ratio**2
        if u is None or self.ratio > CLEAR_STEP_RATIO:
            return square * self.errors[row]
        return square / (1 - square) * _distance(scene, u, self.rows[row])


def _distance(scene: Scene, u: Vector, other: Vector) -> float:
    """Return the largest difference of two displacements over the system's length; collective."""
    system = scene.model.system
    return max_abs(system.comm, u - other) / system.length


@dataclass(frozen=True)
class StepRefinement:
    """Refinement of the steps of a motion until the error at its rows is below the tolerance.

    Attributes
    ----------
    scene, held_conjugates, marks
        See `MotionRows`.
    begin
        A new integrator and the motion's begin.
    ends
        The times of rows.
    is_over
        Whether a motion need not be followed beyond the second of two rows; the third argument is
        the largest kinetic energy.
    """

    scene: Scene
    held_conjugates: Mapping[str, HeldConjugate]
    marks: Collection[float]
    begin: Callable[[], tuple[Integrator, Motion]]
    ends: Sequence[float]
    is_over: Callable[[Motion, Motion, float], bool]

    def __call__(self, steps: TimeSteps) -> RefinedSteps:
        """Return steps with which the error at all rows is below the tolerance."""
        scene, tolerance = self.scene, steps.tolerance
        coarse_tolerance = min(COARSE_TOLERANCE_RATIO * tolerance, MAX_COARSE_TOLERANCE)
        coarse_steps = replace(steps, tolerance=max(tolerance, coarse_tolerance))
        speeds = [
            (max_abs(scene.model.system.comm, motion.v), motion.t, mean_step)
            for motion, mean_step in self._rows(coarse_steps)
        ]
        largest_speed, fastest, _ = max(speeds)
        longest = max(step for speed, _, step in speeds if speed >= FAST_SPEED * largest_speed)
        coarse_steps = replace(coarse_steps, longest=longest, fastest=fastest)
        rows = [motion.u for motion, _ in self._rows(coarse_steps)]
        refinement, ratio = 1.0, 0.5
        while True:
            refinement *= ratio
            errors = list[float]()
            for i, (motion, _) in enumerate(self._rows(coarse_steps.refined(refinement))):
                coarser_u = rows[min(i, len(rows) - 1)]
                errors.append(ratio**2 / (1 - ratio**2) * _distance(scene, motion.u, coarser_u))
                rows[i : i + 1] = [motion.u]
            largest_error = max(*errors, TINY_ERROR)
            needed = refinement * float(np.sqrt(AIMED_ERROR * tolerance / largest_error))
            needed = min(
                max(needed, MIN_STEP_RATIO), (tolerance / coarse_steps.tolerance) ** (1 / 3)
            )
            if needed * MAX_STEP_RATIO >= refinement:
                refined = coarse_steps.refined(needed)
                return RefinedSteps(refined, rows[: len(errors)], errors, needed / refinement)
            ratio = 0.25

    def _rows(self, steps: TimeSteps) -> Iterator[tuple[Motion, float]]:
        """Yield the motion at each row, and the mean step before it."""
        integrator, motion = self.begin()
        rows = MotionRows(self.scene, integrator, self.held_conjugates, steps, self.marks)
        time_step, largest_kinetic = steps.first, integrator.kinetic(motion)
        for end in self.ends:
            previous, count = motion, integrator.steps
            self.scene.progress.trying(_progress_point(motion), end - motion.t)
            motion, time_step = rows.advanced(previous, time_step, end)
            largest_kinetic = max(largest_kinetic, integrator.kinetic(motion))
            yield motion, (motion.t - previous.t) / (integrator.steps - count)
            if self.is_over(previous, motion, largest_kinetic):
                return


def _progress_point(motion: Motion) -> Point:
    """Return a motion as a point that a listener to the progress of a run gets."""
    return Point(State(motion.u, motion.mu), motion.t, motion.v, 0.0, 0, 0)


@dataclass
class MotionRows:
    """Moves a scene from row to row.

    Parameters
    ----------
    held_conjugates
        See `make_stage`.
    marks
        Times at which loads have kinks or jumps.
    refinement
        Chooses the steps for the tolerance of these; None: they are taken as they are.
    """

    scene: Scene
    integrator: Integrator
    held_conjugates: Mapping[str, HeldConjugate]
    steps: TimeSteps
    marks: Collection[float]
    refinement: StepRefinement | None = None
    _refined_steps: RefinedSteps | None = field(default=None, init=False)
    # of the journal: what the latest factors belonged to
    _factored_point: Point | None = field(default=None, init=False)

    def advanced(
        self, motion: Motion, time_step: float, end: float, *, is_known: bool = False
    ) -> tuple[Motion, float]:
        """Return the motion at a later time, and the step to go on with.

        Parameters
        ----------
        is_known
            Whether the journal has the motion at that time.
        """
        check = partial(self.scene.journal.check, is_known)
        for t in [*sorted(t for t in self.marks if motion.t < t < end), end]:
            # the acceleration after a mark is another one
            if motion.t in self.marks and self.integrator.begins_anew(motion.t):
                motion = self.integrator.begin(motion.t, motion.u, motion.v, motion)
            motion, time_step = advance(self.integrator, motion, t, self.steps, time_step, check)
        return motion, time_step

    def crossing(
        self, motion: Motion, time_step: float, end: Motion, event: Callable[[Motion], float]
    ) -> float:
        """Return the time between two motions at which a function of them changes its sign."""
        tolerance = EVENT_TIME_TOLERANCE * (end.t - motion.t)
        known_motions = {motion.t: motion, end.t: end}
        self._refactor()

        def event_at(t: float) -> float:
            return event(known_motions.get(t) or self.advanced(motion, time_step, t)[0])

        time = float(scipy.optimize.brentq(event_at, motion.t, end.t, xtol=tolerance))
        return max(time, motion.t + tolerance)

    def journalled(
        self, motion: Motion, time_step: float, end: float
    ) -> tuple[Motion, float, Point]:
        """Return the motion at a later time, the step to go on with, and the point there.

        In the journal these are three points: the motion, what it needs besides, and what the
        latest factors belong to.
        """
        scene, integrator = self.scene, self.integrator
        points = list[Point]()
        while len(points) < POINTS_OF_ROW and isinstance(recorded := scene.journal.replay(), Point):
            points.append(recorded)
        is_known = len(points) == POINTS_OF_ROW
        # the journal has no place for the strains of viscous branches: these are computed again
        if is_known and integrator.viscous is None:
            return self._replayed(*points)
        self._refactor()
        iterations, factorisations = integrator.iterations, integrator.factorisation.count
        try:
            # not before it is needed: a journal may have all rows
            if self.refinement and not self._refined_steps:
                self._refined_steps = self.refinement(self.steps)
                self.steps = self._refined_steps.steps
            scene.progress.trying(_progress_point(motion), end - motion.t)
            motion, time_step = self.advanced(motion, time_step, end, is_known=is_known)
        except TimeStopped as e:
            raise Stopped(str(e)) from None
        iterations = integrator.iterations - iterations
        factorisations = integrator.factorisation.count - factorisations
        state = scene.model.system.with_moved_supports(State(motion.u, motion.mu))
        error, pivots = self._error(motion, end), self._negative_pivots(state)
        point = Point(
            state,
            motion.t,
            motion.v,
            time_step,
            pivots,
            pivots,
            iterations,
            factorisations,
            error=error,
            habit=scene.newton.factorisation.habit,
        )
        for recorded in (point, *self._companions(motion))[len(points) :]:
            scene.journal.record(recorded)
        return motion, time_step, point

    def _replayed(
        self, point: Point, companion: Point, factored_point: Point
    ) -> tuple[Motion, float, Point]:
        """Return a row from its three points of the journal."""
        self._factored_point = factored_point
        self.scene.newton.factorisation.habit = point.habit
        motion = Motion(
            t=point.s,
            u=point.state.u,
            v=point.du,
            a=companion.state.u,
            mu=dict(point.state.mu),
            work=companion.s,
            dissipated=companion.dmu,
            potentials=dict(companion.state.mu),
            error=companion.error,
        )
        return motion, point.dmu, point

    def _companions(self, motion: Motion) -> tuple[Point, Point]:
        """Return the points of the journal with what a motion and its factors need besides."""
        zero, integrator = 0.0 * motion.a, self.integrator
        companion = Point(
            State(motion.a, motion.potentials),
            motion.work,
            zero,
            motion.dissipated,
            0,
            0,
            error=motion.error,
        )
        factored = integrator.factored_state
        if factored is None:
            factored = FactoredState(zero, {}, 0.0, integrator.factorisation.habit)
        state = State(factored.u, factored.mu)
        return companion, Point(state, factored.dt, zero, 0.0, 0, 0, habit=factored.habit)

    def _error(self, motion: Motion, end: float) -> float:
        """Return the estimated error of a motion over the system's length; 0 if it is unknown."""
        if not (self.refinement and self._refined_steps):
            return 0.0
        ends = self.refinement.ends
        row = int(np.searchsorted(ends, end))
        return self._refined_steps.error(self.scene, row, motion.u if end == ends[row] else None)

    def _negative_pivots(self, state: State) -> int:
        """Return the number of unstable directions at a state.

        Rigid motions that are free have no stiffness: the sign of their pivots is rounding.
        """
        stage = make_stage(self.scene, state, self.held_conjugates)
        if self.scene.free_in_time:
            return 0
        return stage.newton.factor_at(stage.enter(state)).negative_pivots

    def _refactor(self) -> None:
        """Make the factors that the run had: others end iterations elsewhere, within their
        tolerance.
        """
        factored, self._factored_point = self._factored_point, None
        # beside a body factors belong to a whole step: each interval makes its own
        if self.integrator.contact:
            self.integrator.factored_state = None
        if factored and factored.s and not self.integrator.contact:
            state = factored.state
            self.integrator.factor(
                FactoredState(state.u, dict(state.mu), factored.s, factored.habit)
            )
        elif factored:
            self.integrator.factorisation.habit = factored.habit

"""Rows of a motion: its states at given times, from the journal if it has them, and their errors.

Departures from unstable states magnify the errors of steps, by a factor that the end of the motion
alone shows. So where the error at the rows is asked for, a motion is computed with longer steps
first. The first such run shows when the motion is fastest: until then no step is longer than there.
Two more show the error, which goes as the square of the steps.

Words and symbols:

- A row is a line of the results at a given time; an event may end the motion between two rows.
- The journal keeps results of an interrupted run as `Point`s, whose fields then have other
  meanings: `s` is the time, `du` the velocity, `dmu` the next time step. To replay is to take a
  result from the journal instead of computing it.
- Factors are those of the matrix of a step, kept for several steps. Their habit is the choice
  between two sparse solvers, on which rounding depends.
- Marks are times at which loads have kinks or jumps.
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
        Options of the motion's time steps.
    rows
        Displacements at the rows of the last coarse run.
    errors
        Estimated errors of these displacements, over the system's length.
    ratio
        Length of the motion's steps over that of the last coarse run's steps.
    """

    steps: TimeSteps
    rows: Sequence[Vector]
    errors: Sequence[float]
    ratio: float

    def error(self, scene: Scene, row: int, u: Vector | None) -> float:
        """Return the estimated error of the motion's displacement, over the system's length.

        Collective.

        Parameters
        ----------
        row
            Number of the row, or of the next row of a time between rows.
        u
            The displacement at the row; None at a time between rows.
        """
        row = min(row, len(self.rows) - 1)  # the coarse run may have ended earlier
        # errors go as the square of the steps: this is the motion's error over the coarse run's
        error_ratio = self.ratio**2
        if u is None or self.ratio > CLEAR_STEP_RATIO:
            return error_ratio * self.errors[row]
        # the difference of both runs is 1 - error_ratio of the coarse run's error
        return error_ratio / (1 - error_ratio) * _distance(scene, u, self.rows[row])


def _distance(scene: Scene, u: Vector, other: Vector) -> float:
    """Return the largest difference of two displacements over the system's length; collective."""
    system = scene.model.system
    return max_abs(system.comm, u - other) / system.length


@dataclass(frozen=True)
class StepRefinement:
    """Refinement of the steps of a motion until the error at its rows is below the tolerance.

    Attributes
    ----------
    held_conjugates
        Amplitude that is unknown -> its conjugate: the displacement on which it does work.
    marks
        Times at which loads have kinks or jumps.
    begin
        Function that returns a new integrator, and the motion at its begin.
    ends
        Times of the rows, ascending.
    is_over
        Function of the motions at two successive rows, and the largest kinetic energy so far:
        whether a motion need not be followed beyond the second row.
    """

    scene: Scene
    held_conjugates: Mapping[str, HeldConjugate]
    marks: Collection[float]
    begin: Callable[[], tuple[Integrator, Motion]]
    ends: Sequence[float]
    is_over: Callable[[Motion, Motion, float], bool]

    def __call__(self, steps: TimeSteps) -> RefinedSteps:
        """Return steps with which the error at all rows is below the tolerance; collective.

        The first run measures speeds, and limits the steps before the fastest time. The second run
        repeats it with this limit. Further runs have shorter steps by `ratio`, first one half and
        then a quarter, until the last is fine enough to tell which steps the motion needs.

        Parameters
        ----------
        steps
            Options of time steps, with the tolerance.
        """
        scene, tolerance = self.scene, steps.tolerance
        coarse_tolerance = min(COARSE_TOLERANCE_RATIO * tolerance, MAX_COARSE_TOLERANCE)
        coarse_steps = replace(steps, tolerance=max(tolerance, coarse_tolerance))
        # first run: at each row the speed, the time and the mean step before the row
        speeds = [
            (max_abs(scene.model.system.comm, motion.v), motion.t, mean_step)
            for motion, mean_step in self._rows(coarse_steps)
        ]
        largest_speed, time_of_largest_speed, _ = max(speeds)
        longest_step = max(step for speed, _, step in speeds if speed >= FAST_SPEED * largest_speed)
        # second run: displacements at its rows
        coarse_steps = replace(coarse_steps, longest=longest_step, fastest=time_of_largest_speed)
        rows = [motion.u for motion, _ in self._rows(coarse_steps)]
        # further runs. step_factor: their steps over those of the second run; ratio: over those of
        # the run before
        step_factor, ratio = 1.0, 0.5
        while True:
            step_factor *= ratio
            errors = self._errors(coarse_steps.refined(step_factor), rows, ratio)
            # the steps that the motion needs, over those of the second run
            largest_error = max(*errors, TINY_ERROR)
            needed_factor = step_factor * float(np.sqrt(AIMED_ERROR * tolerance / largest_error))
            needed_factor = min(
                max(needed_factor, MIN_STEP_RATIO),
                # no longer than the tolerance of single steps asks for, whose error is cubic
                (tolerance / coarse_steps.tolerance) ** (1 / 3),
            )
            is_fine_enough = needed_factor * MAX_STEP_RATIO >= step_factor
            if is_fine_enough:
                return RefinedSteps(
                    steps=coarse_steps.refined(needed_factor),
                    rows=rows[: len(errors)],
                    errors=errors,
                    ratio=needed_factor / step_factor,
                )
            ratio = 0.25

    def _errors(self, steps: TimeSteps, rows: list[Vector], ratio: float) -> list[float]:
        """Return the estimated errors at the rows of a run, over the system's length; collective.

        They come from the difference between this run and the run before, whose errors go as the
        square of the steps.

        Parameters
        ----------
        steps
            Options of this run's time steps.
        rows
            Displacements at the rows of the run before; those of this run replace them.
        ratio
            Length of this run's steps over that of the run before.
        """
        errors = list[float]()
        for i, (motion, _) in enumerate(self._rows(steps)):
            coarser_u = rows[min(i, len(rows) - 1)]  # that run may have ended earlier
            difference = _distance(self.scene, motion.u, coarser_u)
            # the difference is 1 - ratio² of the coarser run's error, and this run has ratio² of it
            errors.append(ratio**2 / (1 - ratio**2) * difference)
            rows[i : i + 1] = [motion.u]  # replaces the row, or appends one
        return errors

    def _rows(self, steps: TimeSteps) -> Iterator[tuple[Motion, float]]:
        """Yield the motion at each row, and the mean time step before this row."""
        integrator, motion = self.begin()
        rows = MotionRows(self.scene, integrator, self.held_conjugates, steps, self.marks)
        time_step, largest_kinetic = steps.first, integrator.kinetic(motion)
        for end in self.ends:
            previous, steps_before = motion, integrator.steps
            self.scene.progress.trying(_progress_point(motion), end - motion.t)
            motion, time_step = rows.advanced(previous, time_step, end)
            largest_kinetic = max(largest_kinetic, integrator.kinetic(motion))
            yield motion, (motion.t - previous.t) / (integrator.steps - steps_before)
            if self.is_over(previous, motion, largest_kinetic):
                return


def _progress_point(motion: Motion) -> Point:
    """Return a motion as a point, for listeners to the progress of a run.

    Time is its s, velocity its du; pivots are not known.
    """
    return Point(State(motion.u, motion.mu), motion.t, motion.v, 0.0, 0, 0)


@dataclass
class MotionRows:
    """Moves a motion from row to row, and keeps its rows in the journal.

    Parameters
    ----------
    integrator
        Integrator of time steps, whose counts of iterations and factors go on from row to row.
    held_conjugates
        Amplitude that is unknown -> its conjugate: the displacement on which it does work.
    steps
        Options of time steps.
    marks
        Times at which loads have kinks or jumps.
    refinement
        Chooses steps so that the errors of rows are within the tolerance of `steps`; None: these
        are taken as they are.

    Attributes
    ----------
    _refined_steps
        Steps that the refinement has chosen, with errors; None before it has.
    _factored_point
        Point of the journal with the state to which the latest factors belonged; None where the
        factors are there, or the journal has not been replayed.
    """

    scene: Scene
    integrator: Integrator
    held_conjugates: Mapping[str, HeldConjugate]
    steps: TimeSteps
    marks: Collection[float]
    refinement: StepRefinement | None = None
    _refined_steps: RefinedSteps | None = field(default=None, init=False)
    _factored_point: Point | None = field(default=None, init=False)

    def advanced(
        self, motion: Motion, time_step: float, end: float, *, is_known: bool = False
    ) -> tuple[Motion, float]:
        """Return the motion at a later time, and the time step to go on with; collective.

        Parameters
        ----------
        time_step
            First time step.
        end
            The later time.
        is_known
            Whether the journal has the motion at that time.
        """
        # called between time steps, where the run may stop
        check = partial(self.scene.journal.check, is_known)
        for mark in [*sorted(mark for mark in self.marks if motion.t < mark < end), end]:
            # the acceleration may jump at a mark
            if motion.t in self.marks and self.integrator.begins_anew(motion.t):
                motion = self.integrator.begin(motion.t, motion.u, motion.v, motion)
            motion, time_step = advance(self.integrator, motion, mark, self.steps, time_step, check)
        return motion, time_step

    def crossing(
        self, motion: Motion, time_step: float, end: Motion, event: Callable[[Motion], float]
    ) -> float:
        """Return the time between two motions at which a function of a motion changes its sign.

        Parameters
        ----------
        time_step
            First time step after `motion`.
        end
            The later motion.
        event
            The function.
        """
        tolerance = EVENT_TIME_TOLERANCE * (end.t - motion.t)
        known_motions = {motion.t: motion, end.t: end}
        self._refactor()

        def event_at(t: float) -> float:
            """Return the function at a time between the two motions."""
            return event(known_motions.get(t) or self.advanced(motion, time_step, t)[0])

        time = float(scipy.optimize.brentq(event_at, motion.t, end.t, xtol=tolerance))
        return max(time, motion.t + tolerance)  # time must go on

    def journalled(
        self, motion: Motion, time_step: float, end: float
    ) -> tuple[Motion, float, Point]:
        """Return the motion at a later time, from the journal if this has it; collective.

        In the journal a row is three points: the motion, a companion with its acceleration and
        work, and the state to which the latest factors belong. An interrupted run may have left
        only some of them.

        Returns
        -------
        motion, time_step, point
            The motion, the time step to go on with, and the point for a record.

        Raises
        ------
        Stopped
            If time steps become too small.
        """
        scene, integrator = self.scene, self.integrator
        known_points = self._known_points()
        is_known = len(known_points) == POINTS_OF_ROW
        # the journal has no strains of viscous branches: a motion with these is computed again
        if is_known and integrator.viscous is None:
            point, companion, factored_point = known_points
            return self._replayed(point, companion, factored_point)
        self._refactor()
        iterations_before = integrator.iterations
        factorisations_before = integrator.factorisation.count
        try:
            # not before it is needed: a journal may have all rows
            if self.refinement and not self._refined_steps:
                self._refined_steps = self.refinement(self.steps)
                self.steps = self._refined_steps.steps
            scene.progress.trying(_progress_point(motion), end - motion.t)
            motion, time_step = self.advanced(motion, time_step, end, is_known=is_known)
        except TimeStopped as e:
            raise Stopped(str(e)) from None
        iterations = integrator.iterations - iterations_before
        factorisations = integrator.factorisation.count - factorisations_before
        point = self._point_of(motion, time_step, end)
        point = replace(point, iterations=iterations, factorisations=factorisations)
        # those of the three points that the journal does not have yet
        for new_point in (point, *self._companions(motion))[len(known_points) :]:
            scene.journal.record(new_point)
        return motion, time_step, point

    def _point_of(self, motion: Motion, time_step: float, end: float) -> Point:
        """Return the motion at a row as a point, with its error and pivots; collective.

        `time_step` is the step to go on with, `end` the time of the motion.
        """
        state = self.scene.model.system.with_moved_supports(State(motion.u, motion.mu))
        error, pivots = self._error(motion, end), self._negative_pivots(state)
        habit = self.scene.newton.factorisation.habit
        return Point(state, motion.t, motion.v, time_step, pivots, pivots, error=error, habit=habit)

    def _known_points(self) -> list[Point]:
        """Return the points of the next row that the journal has, at most three."""
        points = list[Point]()
        while len(points) < POINTS_OF_ROW:
            recorded = self.scene.journal.replay()
            if not isinstance(recorded, Point):
                break
            points.append(recorded)
        return points

    def _replayed(
        self, point: Point, companion: Point, factored_point: Point
    ) -> tuple[Motion, float, Point]:
        """Return motion, next time step and point of a row from its three points of the journal.

        They are the point of the motion, that with its acceleration and work, and that of the
        latest factors.
        """
        # the factors are made again only if the motion goes on from here
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
        """Return the two points of the journal that follow the point of a motion.

        The first has the acceleration as u, potentials as mu, work as s, dissipation as dmu, and
        the error. The second has the state to which the latest factors belong, and as s their time
        step, which is 0 without such a state.
        """
        zero_vector, integrator = 0.0 * motion.a, self.integrator
        companion = Point(
            State(motion.a, motion.potentials),
            motion.work,
            zero_vector,
            motion.dissipated,
            0,
            0,
            error=motion.error,
        )
        factored_state = integrator.factored_state
        if factored_state is None:
            factored_state = FactoredState(zero_vector, {}, 0.0, integrator.factorisation.habit)
        state = State(factored_state.u, factored_state.mu)
        return companion, Point(
            state, factored_state.dt, zero_vector, 0.0, 0, 0, habit=factored_state.habit
        )

    def _error(self, motion: Motion, end: float) -> float:
        """Return the estimated error of a motion over the system's length; 0 without a refinement.

        Parameters
        ----------
        end
            Time of the motion; at an event between rows the error of the next row counts.
        """
        if not (self.refinement and self._refined_steps):
            return 0.0
        row_times = self.refinement.ends
        row = int(np.searchsorted(row_times, end))
        return self._refined_steps.error(
            self.scene, row, motion.u if end == row_times[row] else None
        )

    def _negative_pivots(self, state: State) -> int:
        """Return the number of unstable directions at a state; collective.

        It is 0 for a shell that moves freely. Free rigid motions have no stiffness: the sign of
        their pivots is rounding.
        """
        stage = make_stage(self.scene, state, self.held_conjugates)
        if self.scene.free_in_time:
            return 0
        return stage.newton.factor_at(stage.enter(state)).negative_pivots

    def _refactor(self) -> None:
        """Make the factors again that the interrupted run had, so that the motion repeats.

        With other factors, iterations would end elsewhere within their tolerance. Collective.
        """
        factored_point, self._factored_point = self._factored_point, None
        # beside a body factors belong to a whole step: each interval makes its own
        if self.integrator.contact:
            self.integrator.factored_state = None
        if not factored_point:
            return
        # s is the time step of the factors, 0 if there were none
        if factored_point.s and not self.integrator.contact:
            state = factored_point.state
            self.integrator.factor(
                FactoredState(state.u, dict(state.mu), factored_point.s, factored_point.habit)
            )
        else:  # the choice of the solver alone
            self.integrator.factorisation.habit = factored_point.habit

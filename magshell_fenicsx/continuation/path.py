"""Continuation of an equilibrium path by load, by conjugate displacement or by arc length.

A polynomial through the last points and their tangents predicts the next point, Newton's method on
the bordered system corrects it, and the step length adapts. A corrected point is rejected if the
path between both points would not be smooth: then the step jumped to another branch. Where contact
forces begin within a step, the path has kinks, and the step ends at the onset. Theory:
docs/theory.md, "Equilibria, paths, instabilities".

mu is the amplitude (load parameter) that varies; q = -dPi/dmu is its conjugate, the displacement on
which it does work. s is the controlled quantity: mu, q or the arc length, and a point's tangent is
d(u, mu)/ds. Arc length is measured from a base point along its tangent, or along the direction
`across` where the path turns sharply. Inertia is the number of unstable directions, from negative
pivots. Predictors are the last points: a polynomial through them, with their tangents,
extrapolates the next one. Lengths are displacements in units of the system's length. The argument
`stress` is a list of displacements with weights: the tangent matrix takes the weighted sum of their
stresses in place of the stress of u, since small errors of a guess u change its own stress much.
Results pass through a journal, from which an interrupted run resumes.

A point has its state (u, mu), its tangent (du, dmu) and its s. Its `normal` is the direction along
which arc length is measured from it: `across` if it is set, else the tangent.
"""

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import asdict, replace
from typing import Literal

import numpy as np

from magshell_fenicsx.continuation.control import (
    ConstraintRow,
    Hyperplane,
    Metric,
    PrescribedConjugate,
    PrescribedLoad,
)
from magshell_fenicsx.continuation.interpolation import flat_beyond, hermite
from magshell_fenicsx.continuation.newton import BorderedNewton, Response
from magshell_fenicsx.continuation.point import (
    NoJournal,
    NoProgress,
    PathStopped,
    Point,
    Progress,
    RecordedValues,
    SolverJournal,
    StepOptions,
)
from magshell_fenicsx.continuation.snes import GUESS_TOO_FAR
from magshell_fenicsx.continuation.step_control import (
    MIN_FRACTION_BEFORE_FOLD,
    PREDICTOR_POINTS,
    RejectedPoint,
    StepController,
    StepEvent,
    StepPlan,
)
from magshell_fenicsx.continuation.system import (
    Direction,
    State,
    WeightedDisplacement,
    dot,
    extrapolated_stress,
    max_abs,
)

Quantity = Literal["load", "conjugate"]
Control = Literal["load", "conjugate", "arc"]
StepEnd = Callable[[float, Sequence[Point]], float]  # (s, predictors) -> s where the step ends
# number of hard solves after which the tangent takes the stress extrapolated from the last point,
# which costs a tenth more time
HARD_SOLVES_BEFORE_EXTRAPOLATED_STRESS = 2
# step limit, as a multiple of the predicted distance to a fold: a longer one may end on another
# branch
MAX_STEP_PAST_FOLD = 1.15
HARMLESS_PREDICTION_ERROR = 0.05  # in lengths: such an error of a prediction shortens no step
MAX_ERROR_GROWTH = 2.0  # prediction error over that of the last prediction
SHARP_TURN = "the path turns sharply, or the step jumped to another branch"
# successive failures after which no line search is tried: a path that ends has no point ahead
FAILURES_BEFORE_NO_SEARCH = 5
# in lengths: distance up to which old factors begin a solve where their inertia is not needed
FACTOR_REUSE_DISTANCE = 0.05
# a longer correction of a prediction is given up: over its distance, and at least in lengths
MAX_CORRECTION, MIN_CORRECTION_LIMIT = 3.0, 0.1
MAX_ESTIMATE_CORRECTION = 0.01  # in lengths: the single correction of an estimated point
# ratio of the distance of two states to the length of their tangents, above which they are not on
# one path
MAX_DISTANCE_RATIO = 3.0
ZERO_DISPLACEMENT = 1e-6  # in lengths: smaller displacements count as zero
# two points are on different branches if their tangents leave this fraction of their distance
# unexplained; points that are nearer, in lengths, may differ by rounding
MAX_UNEXPLAINED_BY_ARC, MIN_DISTANCE_OF_BRANCHES = 0.5, 1e-3


class NotANumber(RuntimeError):
    """A path cannot begin: its tangent is not a number."""


class Path:
    """An equilibrium path in one amplitude, the others being fixed.

    All methods that solve or compare displacements are collective.

    Parameters
    ----------
    newton
        The corrector.
    name
        The amplitude mu that varies.
    control
        The meaning of s. "load": the amplitude; "conjugate": the displacement conjugate to it;
        "arc": the arc length in a `Metric`, along the tangent of the previous point.
    options
        Lengths of steps, in units of s, and the rules of their change.
    scale
        An amplitude that counts as of order one in the arc length.
    journal
        Stores every result of `recorded`, and replays the results of an interrupted run.
    progress
        Is told of every step before it is tried.
    step_event
        Called with the state of a point and a predicted state. It returns the onset and loss of
        forces on the straight segment between them; None: forces never begin within a step.

    Attributes
    ----------
    system
        The system that `newton` solves.
    metric
        The inner product and norm of directions (du, dmu), which define arc length.
    solves
        Number of solves so far, also of those that failed.

    The private field `_hard_solves` counts solves that failed or took many factorisations,
    `_successive_failures` solves that failed one after the other. They decide how later solves are
    tried. `_journal` and `_step_event` are the parameters of these names.
    """

    def __init__(
        self,
        newton: BorderedNewton,
        name: str,
        control: Control,
        options: StepOptions,
        scale: float = 1.0,
        journal: SolverJournal | None = None,
        progress: Progress | None = None,
        step_event: Callable[[State, State], StepEvent] | None = None,
    ) -> None:
        """Begin with no failures."""
        self.newton, self.name, self.control, self.options = newton, name, control, options
        self.system = newton.system
        self.metric = Metric(newton.system, scale)
        self.solves = self._hard_solves = 0
        self._successive_failures = 0
        self._journal, self.progress = journal or NoJournal(), progress or NoProgress()
        self._step_event = step_event

    def start(self, state: State, sense: float = 1.0) -> Point:
        """Return the first point of a path, from a state in equilibrium.

        Parameters
        ----------
        sense
            The sign of dmu/ds with arc-length control; ignored with another control.

        Raises
        ------
        NotANumber
            If the tangent at the state is not a number.
        """
        # the tangent per unit of mu; the target of the row does not matter
        row = PrescribedLoad(self.name, 0.0)
        response = self.newton.response(state, self.name, row, exact=True)
        if not np.isfinite(dot(self.system.comm, response.du, response.du)):
            raise NotANumber("the tangent at its begin is not a number")
        # rate: ds/dmu. The tangent per unit of mu, divided by it, is the tangent per unit of s
        if self.control == "arc":
            s, rate = 0.0, float(np.copysign(self.metric.norm(response.du, 1.0), sense))
        else:
            s = self.value(self.control, state)
            rate = 1.0 if self.control == "load" else response.softness
        return self._point(state, s, response).with_tangent_per(rate)

    def correct(
        self, s: float, guess: State, base: Point, *, max_step: float = np.inf
    ) -> Point | str:
        """Return the point at `s` near a guess, or the reason why the solve failed.

        Parameters
        ----------
        base
            Arc length is measured from this point, along its tangent.
        max_step
            Length, in lengths of the system, of an iteration's step that ends the solve as failed.
        """
        stress: Sequence[WeightedDisplacement] = ()
        if self._has_many_hard_solves:
            stress = extrapolated_stress(base.state.u, (s - base.s) * base.du)
        return self.solve(self._row(s, base), s, guess, stress, max_step=max_step)

    def correct_between(
        self, s: float, low: Point, high: Point, base: Point, *, needs_inertia: bool = True
    ) -> Point | str:
        """Return the point at `s` between two others, or the reason why the solve failed.

        The cubic through both points and their tangents is the guess.

        Parameters
        ----------
        base
            Arc length is measured from this point, along its tangent.
        needs_inertia
            Whether the numbers of unstable directions of the result must be valid.
        """
        t = (s - low.s) / (high.s - low.s)
        stress = [(1 - t, low.state.u), (t, high.state.u)]
        # `across` is set if the path turns sharply at a kink ahead: a straight line from `low` then
        # leads towards the kink, while a cubic would bend around it
        ends = (low,) if base.across else (low, high)
        guess = self.interpolated_state(s, *ends)
        # factors of the other end begin the solve only if the inertia of the result is not needed
        neighbour = None if needs_inertia else high.state
        return self.solve(
            self._row(s, base), s, guess, stress, neighbour=neighbour, needs_inertia=needs_inertia
        )

    def estimate_between(self, s: float, low: Point, high: Point, base: Point) -> Point | str:
        """Estimate the point at `s` between two others by one correction with known factors.

        The tangent of the point is interpolated, and its inertia is that of `low`.

        Parameters
        ----------
        base
            Arc length is measured from this point, along its tangent.

        Returns
        -------
        The point, or the reason if the correction is too large.
        """

        def estimate() -> Point | str:
            """Correct the interpolated state once, and give it the interpolated tangent."""
            guess = self.interpolated_state(s, low, high)
            self.newton.ensure_factors_near(high.state)
            state = self.newton.correct_once(
                guess, self.name, self._row(s, base), MAX_ESTIMATE_CORRECTION
            )
            t = (s - low.s) / (high.s - low.s)
            du, dmu = (1 - t) * low.du + t * high.du, (1 - t) * low.dmu + t * high.dmu
            # the softness dq/dmu is unknown, and not needed
            tangent = Response(du, dmu, softness=0.0, negative_pivots=low.negative_pivots)
            return self._point(state, s, tangent) if state else GUESS_TOO_FAR

        return self.recorded(estimate)

    def recorrected(self, point: Point, state: State) -> Point:
        """Solve again at the s of a point, with other values of the fixed amplitudes.

        Parameters
        ----------
        state
            The guess, near the point, with the other values.

        Returns
        -------
        The new point, as base of the next step.

        Raises
        ------
        PathStopped
            If the solve fails.
        """
        corrected = self.correct(point.s, state, point)
        if isinstance(corrected, str):
            raise PathStopped(corrected, point)
        return self.as_base(corrected)

    def solve(
        self,
        row: ConstraintRow,
        s: float,
        guess: State,
        stress: Sequence[WeightedDisplacement] = (),
        *,
        neighbour: State | None = None,
        max_step: float = np.inf,
        needs_inertia: bool = True,
    ) -> Point | str:
        """Return the point near a guess on which a row holds, or the reason why the solve failed.

        The tangent of the point is per unit of the row. Collective.

        Parameters
        ----------
        row
            The scalar equation g(u, mu) = 0 that is solved together with equilibrium.
        s
            The value of s that the point gets.
        stress
            Weighted displacements whose stress replaces that of the guess in the first matrix.
        neighbour
            A nearby solution, whose factors may begin the solve; None: no other factors may.
        max_step
            Length, in lengths of the system, of an iteration's step that ends the solve as failed.
        needs_inertia
            Whether the numbers of unstable directions of the point must be valid.
        """
        self.solves += 1
        point = self.recorded(
            lambda: self._newton_point(
                row, s, guess, stress, neighbour, max_step=max_step, needs_inertia=needs_inertia
            )
        )
        if isinstance(point, str):
            # a solve that failed was hard, unless its guess was too far away: this says nothing
            # about the stress
            self._hard_solves += point != GUESS_TOO_FAR
            self._successive_failures += 1
        else:
            self._hard_solves += point.factorisations >= self.options.hard_factorisations
            self._successive_failures = 0
        return point

    def _newton_point(
        self,
        row: ConstraintRow,
        s: float,
        guess: State,
        stress: Sequence[WeightedDisplacement],
        neighbour: State | None,
        *,
        max_step: float,
        needs_inertia: bool,
    ) -> Point | str:
        """Return the point that Newton's method finds, or the reason why it fails; not recorded.

        Parameters
        ----------
        row, s
            The equation that is solved together with equilibrium, and the s of the point.
        guess, stress
            Where the method begins, and what gives the stress of its first matrix.
        neighbour
            A nearby solution, whose factors may begin the solve; None: no other factors may.
        max_step
            A longer step, in lengths, ends the solve as failed.
        needs_inertia
            Whether the numbers of unstable directions must be valid.
        """
        if neighbour:
            self._prepare_factors(guess, neighbour, needs_inertia=needs_inertia)
        count = self.newton.factorisation.count
        result = self.newton.solve(
            guess,
            self.name,
            row,
            stress,
            search=self._successive_failures < FAILURES_BEFORE_NO_SEARCH,
            # without a neighbour the result must not depend on what was factored before
            reuse_distance=FACTOR_REUSE_DISTANCE if neighbour else 0.0,
            max_step=max_step,
        )
        if not result.converged:
            return result.reason
        factorisations = self.newton.factorisation.count - count
        # after many hard solves the tangent is computed with the matrix of the point itself
        response = self.newton.response(
            result.state,
            self.name,
            row,
            exact=self._has_many_hard_solves,
        )
        return replace(
            self._point(result.state, s, response),
            iterations=result.iterations,
            factorisations=factorisations,
            error=result.error,
        )

    def _prepare_factors(self, guess: State, neighbour: State, *, needs_inertia: bool) -> None:
        """Factor the tangent at a neighbour of a guess, unless known factors serve. Collective.

        Any known factors serve, however far their state is. If the inertia is needed and the guess
        is close to the neighbour, only factors of a state near the neighbour serve.
        """
        distance = np.inf
        reach = FACTOR_REUSE_DISTANCE * self.system.length
        if needs_inertia and max_abs(self.system.comm, guess.u - neighbour.u) < reach:
            distance = FACTOR_REUSE_DISTANCE
        self.newton.ensure_factors_near(neighbour, distance)

    @property
    def _has_many_hard_solves(self) -> bool:
        """Whether so many solves were hard that the tangents take an extrapolated stress."""
        return self._hard_solves >= HARD_SOLVES_BEFORE_EXTRAPOLATED_STRESS

    def recorded(self, solve: Callable[[], Point | str]) -> Point | str:
        """Return the result of `solve` or, in a resumed run, the recorded one. Collective.

        All results pass through the journal, in a fixed order. A replayed point also restores
        `habit`, the choice between two factorisations, so that the run continues with the same
        rounding.

        Parameters
        ----------
        solve
            Called, if no recorded result is left. It returns a point, or the reason why there is
            none.
        """
        recorded_result, factors = self._journal.replay(), self.newton.factorisation
        if recorded_result is not None:
            if isinstance(recorded_result, Point):
                factors.habit = recorded_result.habit
            return recorded_result
        habit_before, result = factors.habit, solve()
        if isinstance(result, Point):
            result = replace(result, habit=factors.habit)
        else:
            # the journal stores only the reason of a failure, so a replay could not restore a
            # habit that the failed solve has changed
            factors.habit = habit_before
        self._journal.record(result)
        return result

    def recorded_values(self, find: Callable[[], RecordedValues]) -> RecordedValues:
        """Return the values of `find` or, in a resumed run, the recorded ones. Collective."""
        return self._journal.recorded_values(find)

    def _event(self, current: State, guess: State) -> StepEvent:
        """Return the onset and loss of forces on the straight segment between two states.

        The event is recorded in the journal, as it costs as much as a solve.
        """
        step_event = self._step_event
        if step_event is None:  # no forces begin
            return StepEvent()
        recorded = self.recorded_values(lambda: RecordedValues(asdict(step_event(current, guess))))
        return StepEvent(**recorded.values)

    def point_at_state(
        self, state: State, direction: Direction, base: Point, negative_pivots: int
    ) -> Point:
        """Return the point of the path at a state in equilibrium, with a given tangent.

        Parameters
        ----------
        direction
            Tangent (du, dmu) of any length.
        base
            Arc length is measured from this point.
        negative_pivots
            Number of unstable directions of the state at fixed amplitudes.
        """
        du, dmu = direction
        u, mu, name = state.u, state.mu, self.name
        # change of the conjugate q = -dPi/dmu along the direction; curvature is d2Pi/dmu2
        curvature = self.system.curvature(u, mu, name, name)
        dq = -dot(self.system.comm, self.system.load(u, mu, name), du) - curvature * dmu
        softness = dq / dmu if dmu else np.inf
        # s of the point, and its change along the direction
        if self.control == "arc":
            s = self._arc_length(state, base)
            rate = self.metric.inner(base.normal, direction)
        else:
            s = self.value(self.control, state)
            rate = dmu if self.control == "load" else dq
        response = Response(du, dmu, softness, negative_pivots)
        return self._point(state, s, response).with_tangent_per(rate)

    def _arc_length(self, state: State, base: Point) -> float:
        """Return the arc length of a state: that of the base plus the chord along its normal."""
        chord = (state.u - base.state.u, state.mu[self.name] - base.state.mu[self.name])
        return base.s + self.metric.inner(base.normal, chord)

    def measured_from(self, base: Point, point: Point) -> Point:
        """Return a point with arc length measured from a base; unchanged with another control."""
        if self.control != "arc":
            return point
        return replace(point, s=self._arc_length(point.state, base))

    def as_base(self, point: Point) -> Point:
        """Return a point with a tangent of length one, as base from which arc length is measured.

        The point is unchanged with control by load or conjugate, or if its `across` is set: then
        the tangent is not the direction of its arc length.
        """
        if self.control != "arc" or point.across:
            return point
        return point.with_tangent_per(self.metric.norm(point.du, point.dmu))

    def relative_to(self, base: Point, point: Point) -> Point:
        """Return a point with its tangent per unit of s, where s is measured from `base`.

        The point is unchanged with another control than by arc length.
        """
        if self.control != "arc":
            return point
        return point.with_tangent_per(self._rate(base, point))

    def _rate(self, base: Point, point: Point) -> float:
        """Return the change of arc length, measured from `base`, along the tangent at a point."""
        return self.metric.inner(base.normal, (point.du, point.dmu))

    def base_before(self, low: Point, high: Point) -> Point:
        """Return the first of two points as the base from which the second is measured.

        Where the path turns by more than 90 degrees between them, arc length along the first
        tangent would fall; it is measured along the displacement du alone. This does not measure a
        second point at which only a body moves.
        """
        if self.control != "arc" or self._rate(low, high) > 0:
            return low
        along_displacement = self._measured_along_displacement(low)
        if self._rate(along_displacement, high):
            return along_displacement
        return replace(low, across=None)

    def _measured_along_displacement(self, point: Point) -> Point:
        """Return a point with arc length along its displacement du, not its tangent (du, dmu).

        Behind a sharp turn of the path, arc length along the tangent would fall.
        """
        squared_norm = self.metric.inner((point.du, 0.0), (point.du, 0.0))
        if not squared_norm:
            return point
        # du over |du|^2: its inner product with du is one, so s grows as along the tangent
        return replace(point, across=(np.asarray(point.du / squared_norm, dtype=np.float64), 0.0))

    def value(self, quantity: Quantity, state: State) -> float:
        """Return the amplitude of the path, or the displacement conjugate to it, at a state."""
        if quantity == "load":
            return state.mu[self.name]
        return -self.system.potential(state.u, state.mu, self.name)

    def prescribed(self, quantity: Quantity, target: float) -> ConstraintRow:
        """Return the row that holds the amplitude, or its conjugate displacement, at a target."""
        if quantity == "load":
            return PrescribedLoad(self.name, target)
        return PrescribedConjugate(self.system, self.name, target)

    def continue_to(
        self,
        start: Point,
        targets: Sequence[float],
        step_end: StepEnd = lambda s, predictors: s,
    ) -> Iterator[tuple[Point, bool]]:
        """Yield accepted points through every target in turn, each with whether it is a target.

        A point that was rejected as too far is compared with the next accepted points. If it lies
        one step ahead of one of them, it is accepted without a solve. Collective.

        Parameters
        ----------
        targets
            Values of s, in the order of the path; infinite values have no end.
        step_end
            Called with the planned s at the end of a step and the points that predict it. It
            returns the s at which the step ends, the planned one or a nearer one.

        Raises
        ------
        PathStopped
            If a step of the smallest length fails.
        """
        has_onsets = self.newton.options.has_onsets
        controller = StepController([start], self.options.first, has_onsets)
        for target in targets:
            while (current := controller.current).s != target:
                plan = self._plan(controller, target, step_end)
                result = self._try_plan(current, plan)
                passes_kinks = False
                # a rejected point is kept for later, or accepted if only kinks explain the turn
                if isinstance(result, RejectedPoint):
                    passes_kinks = self._passes_kinks(current, result, plan)
                    controller.rejected = None if passes_kinks else result
                    result = self.as_base(result.point) if passes_kinks else result.reason
                if isinstance(result, str):
                    controller.reject_step(plan, result, self.options.smallest)
                    continue
                # the step is accepted; a point that was rejected earlier may follow at once
                straight = self._cosine(current, result) > self.options.growth_cosine
                kink = passes_kinks or self._has_kink(current, result)
                controller.accept_step(result, plan, self.options, straight=straight, kink=kink)
                yield result, result.s == target
                rejected = controller.rejected
                if rejected and self._retry(controller, rejected, np.sign(target - current.s)):
                    yield controller.current, controller.current.s == target

    def _plan(self, controller: StepController, target: float, step_end: StepEnd) -> StepPlan:
        """Plan the next step towards a target.

        The step is shortened so that its prediction is good. It ends a little behind a fold of mu,
        or where contact forces begin.

        Parameters
        ----------
        controller
            The last points and the length of the next step.
        target
            The value of s to reach; it may be infinite.
        step_end
            Returns the s at which the step ends, from the planned s and the predictors.
        """
        points, current = controller.points, controller.current
        distance = target - current.s
        length = controller.length(distance)
        length = min(length, self._length_past_fold(points, length))
        # the polynomial that predicted the last point better predicts the next one: the quintic
        # through three points, or the cubic through two
        cubic_error, quintic_error = self._prediction_errors(points)
        takes_quintic = quintic_error < cubic_error
        # the quintic shows the error of the cubic, by which the step is shortened. It needs three
        # points for this, but four to show its own error
        is_third_point = len(points) == PREDICTOR_POINTS - 1
        shows_cubic_error = is_third_point and not self.newton.options.has_onsets
        if takes_quintic or shows_cubic_error:
            end = current.s + np.copysign(length, distance)
            length *= self._predictable_fraction(points, end, cubic_error)
        s = target if length == abs(distance) else current.s + np.copysign(length, distance)
        predictors = points[-3:] if takes_quintic else points[-2:]
        s = step_end(s, predictors)
        # the onset of forces on the way, unless no solution was found behind it before
        event = StepEvent(is_deep=self._step_event is not None)
        if current is not controller.onset_without_solution:
            event = self._event(current.state, self.predicted_state(s, predictors))
        # where forces are lost, earlier points mislead: the tangent at the current point alone
        # predicts the end, and the onsets on the way there may be others
        if event.loses_forces:
            predictors = points[-1:]
            event = self._event(current.state, self.predicted_state(s, predictors))
        if event.fraction < 1:
            s = current.s + event.fraction * (s - current.s)
        return StepPlan(s, predictors, length, event)

    def _try_plan(self, current: Point, plan: StepPlan) -> Point | RejectedPoint | str:
        """Try a planned step from the current point.

        Returns
        -------
        The next point, a rejected point that is too far away, or the reason why there is none.
        """
        event = plan.event
        result = self._try_step(plan.s, plan.predictors, is_deep=event.is_deep)
        if event.fraction < 1 and not event.ends_behind:  # it ends just before an onset of forces
            return self._checked_before_onset(current, result)
        # behind an onset the load may turn back: arc length along the displacement still grows
        arc_has_failed = self.control == "arc" and not isinstance(result, Point)
        if event.ends_behind and arc_has_failed:
            across = [self._measured_along_displacement(current)]
            return self._try_step(plan.s, across, is_deep=event.is_deep)
        return result

    def _retry(self, controller: StepController, rejected: RejectedPoint, sense: float) -> bool:
        """Accept a rejected point if it lies one step ahead of the last point.

        Parameters
        ----------
        controller
            Gets the point as its last one, or keeps it as rejected.
        sense
            The sign of the change of s towards the target.

        Returns
        -------
        Whether the point was accepted.
        """
        rejected.retries += 1
        current = controller.current
        point = self.measured_from(current, rejected.point)
        length = (point.s - current.s) * sense  # negative if the point lies behind
        # the inertia may be that of a nearby matrix (not `exact`): it serves only where it shows no
        # instability
        has_inertia = rejected.exact or not point.has_instability_since(current)
        if length > 0 and has_inertia:
            point = self.relative_to(current, point)
            if not self._jump(current, point):
                controller.accept_rejected(self.as_base(point), length)
                return True
        controller.keep_rejected(rejected, length)
        return False

    def _length_past_fold(self, points: Sequence[Point], length: float) -> float:
        """Return the length in s from the last point to a little behind the next fold of mu.

        The fold is where the cubic through the last two points is stationary. The length is
        infinite if there is none, or with load control.

        Parameters
        ----------
        length
            The length that is planned without a fold, of which a fraction is always allowed.
        """
        if len(points) < 2 or self.control == "load":
            return np.inf
        previous, current = points[-2:]
        step, current_per_s = current.s - previous.s, self.relative_to(previous, current)
        mean_slope = (current.state.mu[self.name] - previous.state.mu[self.name]) / step
        # where the cubic is stationary, in units of the last step: 1 is the current point
        fold_place = flat_beyond(mean_slope, previous.dmu, current_per_s.dmu)
        length_past_fold = MAX_STEP_PAST_FOLD * (fold_place - 1) * abs(step)
        return max(length_past_fold, MIN_FRACTION_BEFORE_FOLD * length)

    def _prediction_errors(self, points: Sequence[Point]) -> list[float]:
        """Return the errors of the cubic and of the quintic at the last point.

        The cubic goes through the two points before the last one, the quintic through three. An
        error is the largest displacement; it is infinite if there are too few points.
        """
        # n counts the last point too
        return [
            self._prediction_error(points[-n:-1], points[-1]) if len(points) >= n else np.inf
            for n in (3, 4)
        ]

    def _predictable_fraction(self, points: Sequence[Point], s: float, last_error: float) -> float:
        """Return the fraction of a step to `s` at which the cubic still predicts well enough.

        The error of the cubic is its difference from the quintic. It is allowed if it is harmless,
        or about as large as that of the last cubic.

        Parameters
        ----------
        last_error
            The error of the cubic at the last point, as a displacement.
        """
        cubic, quintic = (self.predicted_state(s, points[-count:]).u for count in (2, 3))
        error = max_abs(self.system.comm, quintic - cubic)
        allowed = max(HARMLESS_PREDICTION_ERROR * self.system.length, MAX_ERROR_GROWTH * last_error)
        # the error of a cubic grows with the fourth power
        return min(1.0, (allowed / error) ** 0.25) if error else 1.0

    def _prediction_error(self, points: Sequence[Point], point: Point) -> float:
        """Return the largest displacement between a point and its prediction by earlier points."""
        guess = self.predicted_state(self.measured_from(points[-1], point).s, points)
        return max_abs(self.system.comm, guess.u - point.state.u)

    def predicted_state(self, s: float, points: Sequence[Point]) -> State:
        """Extrapolate the polynomial through points with their tangents to `s`.

        Parameters
        ----------
        s
            Controlled quantity at the predicted state; arc length is measured from the last point.
        points
            Points in the order of the path. Those before a reversal of s do not count.
        """
        *earlier_points, last_point = points
        # one and the same s for all
        predictors = [
            self.relative_to(last_point, self.measured_from(last_point, point))
            for point in earlier_points
        ]
        predictors.append(last_point)
        # s must change in one sense from each point to the next
        while len(predictors) > 1:
            steps = np.diff([point.s for point in predictors])
            if not min(steps) * max(steps) <= 0:
                break
            predictors.pop(0)
        return self._hermite_state(s, predictors)

    def interpolated_state(self, s: float, *points: Point) -> State:
        """Interpolate a guess at `s` by the polynomial through points with their tangents.

        Through two points it is a cubic. The tangents must be per unit of one and the same s.
        """
        return self._hermite_state(s, points)

    def _hermite_state(self, s: float, points: Sequence[Point]) -> State:
        """Return the state at `s` of the Hermite polynomial through points with their tangents."""
        last_state, name = points[-1].state, self.name
        u, mu = np.array(last_state.u), last_state.mu[name]
        # for each point the weight of its value and that of its tangent
        weights = hermite(s, [point.s for point in points])
        for (value_weight, slope_weight), point in zip(weights, points, strict=True):
            # differences from the last state are summed: unknowns that do not move keep their
            # value to the last digit
            u += value_weight * (point.state.u - last_state.u) + slope_weight * point.du
            mu_change = point.state.mu[name] - last_state.mu[name]
            mu += value_weight * mu_change + slope_weight * point.dmu
        return last_state.with_(u, name, float(mu))

    def _try_step(
        self, s: float, predictors: Sequence[Point], *, is_deep: bool
    ) -> Point | RejectedPoint | str:
        """Predict and correct the point at `s`.

        Parameters
        ----------
        predictors
            Points of which the last is the current one; the polynomial through them is the guess.
        is_deep
            Whether faces may lie deep in each other at the guess.

        Returns
        -------
        The point as base of the next step, a rejected point that is too far away, or the reason why
        there is none.
        """
        current = predictors[-1]
        self.progress.trying(current, s - current.s)
        guess = self.predicted_state(s, predictors)
        # a solve with long steps is given up, but not from deep in a contact: there the steps of a
        # solve may grow before they shrink
        max_step = np.inf
        if not is_deep:
            distance = max_abs(self.system.comm, guess.u - current.state.u) / self.system.length
            max_step = max(MAX_CORRECTION * distance, MIN_CORRECTION_LIMIT)
        point = self.correct(s, guess, current, max_step=max_step)
        if isinstance(point, str):
            return point
        # an instability is only believed with the inertia of the point's own tangent
        exact = point.has_instability_since(current)
        if exact:
            point = self.with_own_inertia(point, current)
        reason_of_jump = self._jump(current, point)
        if reason_of_jump:
            return RejectedPoint(point, reason_of_jump, exact)
        return self.as_base(point)

    def _jump(self, current: Point, next_point: Point) -> str | None:
        """Return why the ends of a step do not lie on one smooth arc; None if they do.

        Parameters
        ----------
        next_point
            The corrected point, whose tangent is per unit of s measured from `current`.
        """
        changed_pivots = abs(next_point.negative_pivots - current.negative_pivots)
        if (
            changed_pivots > 1
            and abs(next_point.s - current.s) > self.options.max_step_past_several
        ):
            return "the step passed several instabilities, or jumped to another branch"
        # a kink changes no inertia, except where the load turns back there: then arc length is
        # measured along `across`
        inertia_allows_kink = changed_pivots == 0 or current.across is not None
        if self.newton.options.has_onsets and inertia_allows_kink:
            return None if self._is_explained_by_kink(current, next_point) else SHARP_TURN
        return None if self._is_smooth(current, next_point) else SHARP_TURN

    def _is_smooth(self, current: Point, next_point: Point) -> bool:
        """Return whether the tangents at both ends of a step allow a smooth arc between them.

        Their cosine must be large enough, and the mean of both tangents times the change of s must
        be nearly the displacement of the step.
        """
        gap, distance = self._gap_of_arc(current, next_point)
        is_straight = self._cosine(current, next_point) >= self.options.min_cosine
        return is_straight and gap <= max(self.options.max_gap * distance, ZERO_DISPLACEMENT)

    def _checked_before_onset(
        self, current: Point, next_point: Point | RejectedPoint | str
    ) -> Point | RejectedPoint | str:
        """Return the result of a step that ends before an onset of forces, if it is right.

        The next point is replaced by the reason `SHARP_TURN` if forces have begun, or if the path
        has a kink before the point. Other results are returned unchanged.
        """
        if not isinstance(next_point, Point):
            return next_point
        is_before = self._event(current.state, next_point.state).fraction == 1.0
        if is_before and self._is_smooth(current, self.relative_to(current, next_point)):
            return next_point
        return SHARP_TURN

    def _has_kink(self, current: Point, next_point: Point) -> bool:
        """Return whether the path has a kink between two points.

        A kink separates the points: those before it predict nothing behind it.
        """
        if not self.newton.options.has_onsets:
            return False
        return not self._is_smooth(current, self.relative_to(current, next_point))

    def _passes_kinks(self, current: Point, rejected: RejectedPoint, plan: StepPlan) -> bool:
        """Return whether the shortest step turns sharply at kinks, where points of a body touch.

        Such a step is accepted. Halving it further would not help: the shorter step would end
        before a kink that lies just ahead, or behind two kinks that are close together.

        Parameters
        ----------
        rejected
            The end of the step, which was rejected for its sharp turn.
        """
        # only for the shortest step: others are tried again at half their length
        if plan.length / 2 >= self.options.smallest or self.control != "arc":
            return False
        if not self.newton.options.has_onsets or rejected.reason != SHARP_TURN:
            return False
        if rejected.point.has_instability_since(current):
            return False
        return not self.are_apart(current, self.relative_to(current, rejected.point))

    def are_apart(self, low: Point, high: Point, rounding: float = ZERO_DISPLACEMENT) -> bool:
        """Return whether two points lie too far apart for one path, given their tangents.

        Their distance is compared with the change of s times the faster of both tangents.

        Parameters
        ----------
        high
            The second point, whose tangent is per unit of s measured from `low`.
        rounding
            Distances below it, in lengths of the system, count as zero.
        """
        comm = self.system.comm
        speed = max(max_abs(comm, low.du), max_abs(comm, high.du))
        reach = MAX_DISTANCE_RATIO * abs(high.s - low.s) * speed
        distance = max_abs(comm, high.state.u - low.state.u)
        return distance > max(reach, rounding * self.system.length)

    def _gap_of_arc(self, low: Point, high: Point) -> tuple[float, float]:
        """Return how much of the way between two points their tangents do not explain, in lengths.

        Returns
        -------
        gap
            The displacement between the points, less that by the trapezoidal rule.
        distance
            The displacement itself.
        """
        chord = high.state.u - low.state.u
        unexplained = chord - (high.s - low.s) / 2 * (low.du + high.du)
        gap, distance = (
            max_abs(self.system.comm, v) / self.system.length for v in (unexplained, chord)
        )
        return gap, distance

    def may_be_one_arc(self, low: Point, high: Point) -> bool:
        """Return whether the tangents of two points allow one arc between them, however curved.

        They do not if, by the trapezoidal rule, they leave most of the displacement from one point
        to the other unexplained, which is larger than by rounding. Where contact forces begin the
        result is True: a path with kinks has any tangents.

        Parameters
        ----------
        high
            The second point, whose tangent is per unit of s measured as for `low`.
        """
        if self.newton.options.has_onsets:
            return True
        gap, distance = self._gap_of_arc(low, high)
        return distance < MIN_DISTANCE_OF_BRANCHES or gap < MAX_UNEXPLAINED_BY_ARC * distance

    def _is_explained_by_kink(self, current: Point, next_point: Point) -> bool:
        """Return whether a path with one kink somewhere between two points joins them.

        It follows the tangent of the first point up to the kink, then that of the second.
        """
        comm, length = self.system.comm, next_point.s - current.s
        # change of the tangent at the kink
        turn = next_point.du - current.du
        # the second point less the end of a straight path along the first tangent
        deviation = next_point.state.u - current.state.u - length * current.du
        square = dot(comm, turn, turn)
        # with one kink the deviation is `turn` times the length in s behind the kink; least squares
        # give this length, which is at most that of the step
        after_kink = dot(comm, turn, deviation) / square if square else 0.0
        after_kink = min(max(after_kink / length, 0.0), 1.0) * length
        # the part of the displacement that the kink does not explain, and the whole displacement
        gap = max_abs(comm, deviation - after_kink * turn)
        distance = max_abs(comm, deviation + length * current.du)
        return gap <= max(self.options.max_gap * distance, ZERO_DISPLACEMENT * self.system.length)

    def _cosine(self, a: Point, b: Point) -> float:
        """Return the cosine between the displacements du of the tangents at two points.

        It is 1 if the amplitude moves nothing at one of them.
        """
        lengths = self.metric.norm(a.du, 0.0) * self.metric.norm(b.du, 0.0)
        if lengths < ZERO_DISPLACEMENT**2:
            return 1.0
        return self.metric.inner((a.du, 0.0), (b.du, 0.0)) / lengths

    def with_own_inertia(self, point: Point, base: Point) -> Point:
        """Return a point with the tangent and inertia of its own K, not of a nearby one.

        It takes a factorisation. Collective.

        Parameters
        ----------
        base
            The point from which the arc length of `point` is measured.
        """
        row = self._row(point.s, base)
        response = self.newton.response(point.state, self.name, row, exact=True)
        return replace(
            self._point(point.state, point.s, response),
            iterations=point.iterations,
            factorisations=point.factorisations + 1,
            error=point.error,
        )

    def _row(self, s: float, base: Point) -> ConstraintRow:
        """Return the row that holds at `s`, with arc length measured from `base`."""
        if self.control == "arc":
            return Hyperplane(self.metric, self.name, base.state, base.normal, s - base.s)
        return self.prescribed(self.control, s)

    def _point(self, state: State, s: float, response: Response) -> Point:
        """Return a point with its tangent and two numbers of unstable directions.

        One number is for a fixed amplitude mu. The other is for a fixed conjugate q, where mu is
        free; by Haynsworth's inertia additivity it follows from dq/dmu = R_mu . K^-1 R_mu -
        Pi_mumu, which is minus a Schur complement. If mu is a load, a fixed displacement q is a
        constraint: one unstable direction less where dq/dmu < 0. If mu is a position, a fixed force
        q makes it a further unknown: one more where dq/dmu >= 0.

        Parameters
        ----------
        response
            The tangent, its softness dq/dmu, and the number of negative pivots at fixed amplitudes.
        """
        pivots = response.negative_pivots
        mu_is_load = self.name not in self.system.coordinates
        # with a fixed q
        pivots_held = pivots + int(response.softness >= 0) - int(mu_is_load)
        return Point(state, s, response.du, response.dmu, pivots, pivots_held)

    def with_step_options(self, options: StepOptions) -> "Path":
        """Return a copy of the path with other step lengths, which shares solver and journal."""
        path = copy(self)
        path.options = options
        return path

"""Following an equilibrium path by load, by conjugate displacement or by arc length, with adaptive
steps.
"""

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import asdict, replace
from typing import Literal

import numpy as np

from magshell_fenicsx.continuation.control import GivenConjugate, GivenLoad, Hyperplane, Metric, Row
from magshell_fenicsx.continuation.interpolated import flat_beyond, hermite
from magshell_fenicsx.continuation.newton import BorderedNewton, Response
from magshell_fenicsx.continuation.point import (
    Finding,
    Journal,
    NoJournal,
    NoProgress,
    PathStopped,
    Point,
    Progress,
    StepOptions,
)
from magshell_fenicsx.continuation.snes import DIVERGED, FAR
from magshell_fenicsx.continuation.stepping import LEAST_PART, LOOKED_BACK, Ahead, Course, Far, Plan
from magshell_fenicsx.continuation.system import Direction, State, Weighted, dot, followed, max_abs

Quantity = Literal["load", "conjugate"]
Control = Quantity | Literal["arc"]
Arrive = Callable[[float, Sequence[Point]], float]
# after so many hard solves the tangent takes the stress extrapolated from the last point: a tenth
# more time
MANY = 2
BEHIND = 1.15  # of the length to a fold that is foreseen: a longer step may end on another branch
GUESSED = 0.05  # in lengths: an error of a first guess that shortens no step
WORSE = 2.0  # such an error, over that of the last guess
TURNS = "the path turns sharply, or the step jumped to another branch"
# failures one after the other, after which no line search is tried: a path that ends has no point
# ahead
VAIN = 5
NEAR = 0.05  # in lengths: old factors begin a solve up to here where nobody counts with them
WILD, LEAST_MOST = (
    3.0,
    0.1,
)  # of the way to a guess, and in lengths: a longer correction of it is given up
ABOUT = (
    0.01  # in lengths: a last correction of a state that is looked at, but is no point of the path
)
FARTHER = 3.0  # states so many times as far apart as their tangents lead are not on one path
SEEN = 1e-6  # in lengths of the system: smaller displacements count as zero
# of the arc length, to which steps shrink before a first touch: from deeper inside a hard body the
# correction is led astray
TOUCH = 1e-6


class NotANumber(RuntimeError):
    """A path cannot begin: its tangent is not a number."""


class Path:
    """An equilibrium path in one amplitude, the others being fixed.

    Parameters
    ----------
    name
        The amplitude that varies.
    control
        The meaning of s. "load": the amplitude; "conjugate": the displacement conjugate to it;
        "arc": the arc length in a `Metric`, along the tangent of the point before.
    scale
        An amplitude that counts as of order one in the arc length.
    journal
        Records every result of `recorded`, and replays the results of an interrupted run.
    progress
        Gets every step before it is tried.
    setting_in
        What happens to forces on the straight way from a point to a first guess; None if nothing
        does.
    """

    def __init__(
        self,
        newton: BorderedNewton,
        name: str,
        control: Control,
        options: StepOptions,
        scale: float = 1.0,
        journal: Journal | None = None,
        progress: Progress | None = None,
        setting_in: Callable[[State, State], Ahead] | None = None,
    ) -> None:
        self.newton, self.name, self.control, self.options = newton, name, control, options
        self.system = newton.system
        self.metric = Metric(newton.system, scale)
        self._hard = 0  # number of solves that failed or took many matrices
        self._vain = 0  # number of solves that failed, one after the other
        self._journal, self.progress = journal or NoJournal(), progress or NoProgress()
        self._setting_in = setting_in

    def start(self, state: State, sense: float = 1.0) -> Point:
        """The first point of a path, from a state in equilibrium.

        Parameters
        ----------
        sense
            The sign of dmu/ds with control by arc length.
        """
        response = self.newton.response(state, self.name, GivenLoad(self.name, 0.0), exact=True)
        if not np.isfinite(dot(self.system.comm, response.du, response.du)):
            raise NotANumber("the tangent at its begin is not a number")
        if self.control == "arc":
            s, rate = 0.0, float(np.copysign(self.metric.norm(response.du, 1.0), sense))
        else:
            s, rate = (
                self.value(self.control, state),
                1.0 if self.control == "load" else response.softness,
            )
        return self._point(state, s, response).per(rate)

    def at(self, s: float, guess: State, base: Point, *, most: float = np.inf) -> Point | str:
        """The point at `s`, or the reason why the solve failed.

        Parameters
        ----------
        base
            Arc length is measured from this point, along its tangent.
        most
            As of `BorderedNewton.solve`.
        """
        stress = followed(base.state.u, (s - base.s) * base.du) if self._hard >= MANY else ()
        return self.solve(self._row(s, base), s, guess, stress, most=most)

    def inside(
        self, s: float, low: Point, high: Point, base: Point, *, counted: bool = True
    ) -> Point | str:
        """The point at `s` between two others, or the reason why the solve failed; `base` as in
        `at`.
        """
        t = (s - low.s) / (high.s - low.s)
        stress = [(1 - t, low.state.u), (t, high.state.u)]
        ends, near = (low,) if base.across else (low, high), None if counted else high.state
        guess = self.between(s, *ends)  # to a corner, not around it
        return self.solve(self._row(s, base), s, guess, stress, near=near, counted=counted)

    def about(self, s: float, low: Point, high: Point, base: Point) -> Point | str:
        """About the point at `s` between two others, without its own inertia; where that is too
        uncertain, why.
        """

        def find() -> Point | str:
            guess = self.between(s, low, high)
            self.newton.stand_at(high.state)
            state = self.newton.corrected(guess, self.name, self._row(s, base), ABOUT)
            t = (s - low.s) / (high.s - low.s)
            along = Response(
                (1 - t) * low.du + t * high.du,
                (1 - t) * low.dmu + t * high.dmu,
                0.0,
                low.negative_pivots,
            )
            return self._point(state, s, along) if state else FAR

        return self.recorded(find)

    def renewed(self, point: Point, state: State) -> Point:
        """The point at the same s with other amplitudes beside that of the path, from a state near
        it.

        Raises
        ------
        PathStopped
            If none is found.
        """
        again = self.at(point.s, state, point)
        if isinstance(again, str):
            raise PathStopped(again, point)
        return self.as_base(again)

    def solve(
        self,
        row: Row,
        s: float,
        guess: State,
        stress: Sequence[Weighted] = (),
        *,
        near: State | None = None,
        most: float = np.inf,
        counted: bool = True,
    ) -> Point | str:
        """The point on which a row holds, or the reason why the solve failed; its tangent is per
        unit of the row.

        With a solution `near` by, old factors may begin. Unless `counted`, nobody asks for unstable
        directions.
        """
        old = (
            NEAR if near else 0.0
        )  # a tangent of the path must not depend on what was factored before its point

        def find() -> Point | str:
            if near:
                close = (
                    counted
                    and max_abs(self.system.comm, guess.u - near.u) < NEAR * self.system.length
                )
                self.newton.stand_at(near, NEAR if close else np.inf)
            before, search = self.newton.factorisation.count, self._vain < VAIN
            outcome = self.newton.solve(
                guess, self.name, row, stress, search=search, near=old, most=most
            )
            if not outcome.converged:
                return outcome.reason
            spent = self.newton.factorisation.count - before
            exact = self._hard >= MANY  # the extrapolated stress is only as good as the tangent
            response = self.newton.response(
                outcome.state, self.name, row, exact=exact, counted=counted
            )
            found = self._point(outcome.state, s, response)
            return replace(
                found, iterations=outcome.iterations, factorisations=spent, error=outcome.error
            )

        point = self.recorded(find)
        self._hard += (
            point != FAR if isinstance(point, str) else point.factorisations >= self.options.hard
        )
        self._vain = self._vain + 1 if isinstance(point, str) else 0
        return point

    def recorded(self, find: Callable[[], Point | str]) -> Point | str:
        """The result of `find`, or the result of an interrupted run at this place in the journal."""
        kept, factors = self._journal.replay(), self.newton.factorisation
        if kept is not None:
            if isinstance(kept, Point):
                factors.habit = kept.habit
            return kept
        habit, result = factors.habit, find()
        if isinstance(result, Point):
            result = replace(result, habit=factors.habit)
        else:
            factors.habit = habit  # a failure is kept as its reason alone
        self._journal.record(result)
        return result

    def noted(self, find: Callable[[], Finding]) -> Finding:
        """What is found at points of the path, or was in an interrupted run at this place in the
        journal."""
        return self._journal.noted(find)

    def _ahead(self, here: State, guess: State) -> Ahead:
        """What happens to forces on the straight way between two states."""
        setting_in = self._setting_in
        if setting_in is None:
            return Ahead()
        return Ahead(**self.noted(lambda: Finding(asdict(setting_in(here, guess)))).values)

    def on(self, state: State, direction: Direction, base: Point, negative_pivots: int) -> Point:
        """The point of a state on the path, with a given tangent of any length."""
        du, dmu = direction
        u, mu, name = state.u, state.mu, self.name
        bend = self.system.curvature(u, mu, name, name)
        dq = -dot(self.system.comm, self.system.load(u, mu, name), du) - bend * dmu
        rate = {"load": dmu, "conjugate": dq, "arc": self.metric.inner(base.normal, direction)}[
            self.control
        ]
        softness = dq / dmu if dmu else np.inf
        s = (
            self._arc_length(state, base)
            if self.control == "arc"
            else self.value(self.control, state)
        )
        return self._point(state, s, Response(du, dmu, softness, negative_pivots)).per(rate)

    def _arc_length(self, state: State, base: Point) -> float:
        chord = (state.u - base.state.u, state.mu[self.name] - base.state.mu[self.name])
        return base.s + self.metric.inner(base.normal, chord)

    def measured_from(self, base: Point, point: Point) -> Point:
        """The point with its arc length from a base; unchanged with another control."""
        return (
            replace(point, s=self._arc_length(point.state, base))
            if self.control == "arc"
            else point
        )

    def as_base(self, point: Point) -> Point:
        """The point with a tangent of length one, so that arc length can be measured from it."""
        return (
            point.per(self.metric.norm(point.du, point.dmu))
            if self.control == "arc" and not point.across
            else point
        )

    def before(self, low: Point, high: Point) -> Point:
        """The first of two points, from which the second is measured: see `_beside`."""
        sharp = self.control == "arc" and self.metric.inner(low.normal, (high.du, high.dmu)) <= 0
        return self._beside(low) if sharp else low

    def _beside(self, point: Point) -> Point:
        """The point with arc length along its displacement: a path that turns sharply has none
        along its tangent.
        """
        square = self.metric.inner((point.du, 0.0), (point.du, 0.0))
        return (
            replace(point, across=(np.asarray(point.du / square, dtype=np.float64), 0.0))
            if square
            else point
        )

    def value(self, quantity: Quantity, state: State) -> float:
        """The amplitude of the path, or the displacement conjugate to it, at a state."""
        if quantity == "load":
            return state.mu[self.name]
        return -self.system.potential(state.u, state.mu, self.name)

    def given(self, quantity: Quantity, target: float) -> Row:
        """The row that holds the amplitude, or the displacement conjugate to it, at a target."""
        return (
            GivenLoad(self.name, target)
            if quantity == "load"
            else GivenConjugate(self.system, self.name, target)
        )

    def towards(
        self, start: Point, targets: Sequence[float], arrive: Arrive = lambda s, seen: s
    ) -> Iterator[tuple[Point, bool]]:
        """Accepted points through every target in turn; the flag marks the targets.

        A point that was found too far away is looked at again from the next points: it is a step of
        theirs for nothing. `arrive` may shorten a step to some s that is foreseen from some points.

        Raises
        ------
        PathStopped
            If a step of the smallest length fails.
        """
        course = Course([start], self.options.first)
        for target in targets:
            while (here := course.here).s != target:
                plan = self._planned(course, target, arrive)
                tried = self._tried(here, plan)
                corners = isinstance(tried, Far) and self._passes_corners(here, tried, plan)
                if isinstance(tried, Far):
                    course.far, tried = (
                        (None, self.as_base(tried.point)) if corners else (tried, tried.reason)
                    )
                if isinstance(tried, str):
                    course.failed(plan, tried, self._smallest(tried))
                    continue
                straight = self._cosine(here, tried) > self.options.straight
                corner = corners or self._corner(here, tried)
                course.reached(tried, plan, self.options, straight=straight, corner=corner)
                yield tried, tried.s == target
                if course.far and self._look_again(course, course.far, np.sign(target - here.s)):
                    yield course.here, course.here.s == target

    def _planned(self, course: Course, target: float, arrive: Arrive) -> Plan:
        """The next step on the way to a target: it ends a little behind a fold, or where forces set
        in.
        """
        passed, here, way = course.passed, course.here, target - course.here.s
        length = course.length(way)
        length = min(length, self._past_fold(passed, length))
        cubic, quintic = self._missed(passed)
        smooth = quintic < cubic
        if smooth or (len(passed) == LOOKED_BACK - 1 and not self.newton.options.kinks):
            length *= self._foreseen(passed, here.s + np.copysign(length, way), cubic)
        s = target if length == abs(way) else here.s + np.copysign(length, way)
        seen, ahead = passed[-3:] if smooth else passed[-2:], Ahead()
        s = arrive(s, seen)
        if here is not course.vain:
            ahead = self._ahead(here.state, self.extended(s, seen))
        if ahead.lets_go:  # others may meet on the way that its tangent foresees
            seen = passed[-1:]
            ahead = self._ahead(here.state, self.extended(s, seen))
        return Plan(
            here.s + ahead.part * (s - here.s) if ahead.part < 1 else s, seen, length, ahead
        )

    def _tried(self, here: Point, plan: Plan) -> Point | Far | str:
        """The next point, one that is too far away, or why there is none; see `_reached` before
        forces set in.
        """
        tried, ahead = self._try(plan.s, plan.seen), plan.ahead
        if ahead.part < 1 and not ahead.behind:
            return self._reached(here, tried)
        sharp = ahead.behind and self.control == "arc" and not isinstance(tried, Point)
        return self._try(plan.s, [self._beside(here)]) if sharp else tried

    def _look_again(self, course: Course, far: Far, sense: float) -> bool:
        """Whether a point that was found too far away is a step from the last one; if so it is the
        last one now.
        """
        here, again = course.here, self.measured_from(course.here, far.point)
        length, far.looks = (again.s - here.s) * sense, far.looks + 1
        solved = length > 0 and (far.exact or not again.turned_from(here))
        if found := solved and not self._jumped(here, again := self.seen_from(here, again)):
            course.reached_again(self.as_base(again), length)
        else:
            course.still_far(far, length)
        return found

    def _past_fold(self, passed: Sequence[Point], length: float) -> float:
        """The length to a little behind the next fold of mu, where the cubic through two points has
        its maximum.
        """
        if len(passed) < 2 or self.control == "load":
            return np.inf
        before, here = passed[-2:]
        way, last = here.s - before.s, self.seen_from(before, here)
        rise = (here.state.mu[self.name] - before.state.mu[self.name]) / way
        return max(
            BEHIND * (flat_beyond(rise, before.dmu, last.dmu) - 1) * abs(way), LEAST_PART * length
        )

    def _missed(self, passed: Sequence[Point]) -> list[float]:
        """By how much the cubic through two points and the quintic through three miss the next one,
        the last of all.
        """
        return [
            self._distance(passed[-n:-1], passed[-1]) if len(passed) >= n else np.inf
            for n in (3, 4)
        ]

    def _foreseen(self, passed: Sequence[Point], s: float, missed: float) -> float:
        """The part of a step to `s` whose first guess misses little, or about as much as the last
        cubic missed.
        """
        cubic, quintic = (self.extended(s, passed[-count:]).u for count in (2, 3))
        error = max_abs(self.system.comm, quintic - cubic)
        allowed = max(GUESSED * self.system.length, WORSE * missed)
        return (
            min(1.0, (allowed / error) ** 0.25) if error else 1.0
        )  # the error of a cubic grows with the fourth power

    def _distance(self, passed: Sequence[Point], point: Point) -> float:
        """How far a point is from where earlier ones led."""
        guess = self.extended(self.measured_from(passed[-1], point).s, passed)
        return max_abs(self.system.comm, guess.u - point.state.u)

    def extended(self, s: float, passed: Sequence[Point]) -> State:
        """A state at `s`, of the polynomial through points with their tangents; arc length is from
        the last.

        Points before a turn of s do not count.
        """
        last = passed[-1]
        seen = [
            *(self.seen_from(last, self.measured_from(last, point)) for point in passed[:-1]),
            last,
        ]
        while (
            len(seen) > 1 and min(steps := np.diff([point.s for point in seen])) * max(steps) <= 0
        ):
            seen.pop(0)
        return self._joined(s, seen)

    def between(self, s: float, *points: Point) -> State:
        """A first guess at `s`: the Hermite polynomial through points with their tangents, a cubic
        through two.
        """
        return self._joined(s, points)

    def _joined(self, s: float, points: Sequence[Point]) -> State:
        last, name = points[-1].state, self.name
        u, mu = np.array(last.u), last.mu[name]
        for (value, slope), point in zip(
            hermite(s, [point.s for point in points]), points, strict=True
        ):
            u += (
                value * (point.state.u - last.u) + slope * point.du
            )  # what does not move stays, to the last digit
            mu += value * (point.state.mu[name] - last.mu[name]) + slope * point.dmu
        return last.with_(u, name, float(mu))

    def seen_from(self, base: Point, point: Point) -> Point:
        """The point with its tangent per unit of s, where s is measured from `base`."""
        if self.control != "arc":
            return point
        return point.per(self.metric.inner(base.normal, (point.du, point.dmu)))

    def _try(self, s: float, passed: Sequence[Point]) -> Point | Far | str:
        """The next point, foreseen from some points, or one that is too far away, or the reason why
        there is none.
        """
        here = passed[-1]
        self.progress.trying(here, s - here.s)
        guess = self.extended(s, passed)
        moved = max_abs(self.system.comm, guess.u - here.state.u) / self.system.length
        grows = (
            self.newton.options.kinks
        )  # steps may, where forces set in; given up there, they end beside the path
        point = self.at(s, guess, here, most=np.inf if grows else max(WILD * moved, LEAST_MOST))
        if isinstance(point, str):
            return point
        if turned := point.turned_from(here):
            point = self.exact(point, here)
        reason = self._jumped(here, point)
        return Far(point, reason, turned) if reason else self.as_base(point)

    def _jumped(self, here: Point, there: Point) -> str | None:
        """The reason to reject a step whose ends do not lie on one smooth arc; None if there is
        none.
        """
        length = there.s - here.s
        if (
            abs(there.negative_pivots - here.negative_pivots) > 1
            and abs(length) > self.options.passes_several
        ):
            return "the step passed several instabilities, or jumped to another branch"
        same = there.negative_pivots == here.negative_pivots or here.across is not None
        corner = (
            self.newton.options.kinks and same
        )  # no corner is an instability, but where the load turns back
        return None if (self._explained if corner else self._smooth)(here, there) else TURNS

    def _smooth(self, here: Point, there: Point) -> bool:
        """Whether the ends of a step lie on one smooth arc, as far as their tangents show."""
        chord = there.state.u - here.state.u
        unexplained = chord - (there.s - here.s) / 2 * (here.du + there.du)
        gap, whole = (
            max_abs(self.system.comm, v) / self.system.length for v in (unexplained, chord)
        )
        return self._cosine(here, there) >= self.options.turn and gap <= max(
            self.options.gap * whole, SEEN
        )

    def _reached(self, here: Point, there: Point | Far | str) -> Point | Far | str:
        """A point before forces set in, unless they did, or there is a corner."""
        if not isinstance(there, Point):
            return there
        clear = self._ahead(here.state, there.state).part == 1.0
        return there if clear and self._smooth(here, self.seen_from(here, there)) else TURNS

    def _corner(self, here: Point, there: Point) -> bool:
        """Whether the path has a corner between two points, from before which nothing behind it is
        foreseen.
        """
        return self.newton.options.kinks and not self._smooth(here, self.seen_from(here, there))

    def _passes_corners(self, here: Point, far: Far, plan: Plan) -> bool:
        """Whether a turn by arc length, in the shortest step, is that of corners where points of a
        body touch.

        Half as long a step would end before a corner that is just ahead, or behind two that are
        close.
        """
        shortest = plan.length / 2 < self.options.smallest
        if not (
            shortest
            and self.control == "arc"
            and self.newton.options.corners
            and far.reason == TURNS
        ):
            return False
        return not far.point.turned_from(here) and not self.are_apart(
            here, self.seen_from(here, far.point)
        )

    def _smallest(self, reason: str) -> float:
        """The smallest step after a failure: a shorter one by arc length where a body may be just
        ahead.
        """
        astray = reason in (FAR, DIVERGED) and self.newton.options.corners
        smallest = self.options.smallest
        return min(smallest, TOUCH) if astray and self.control == "arc" else smallest

    def are_apart(self, low: Point, high: Point, least: float = SEEN) -> bool:
        """Whether two points are farther apart than a path between them is long, as their tangents
        show it.

        A distance below `least`, in lengths of the system, is that of rounding.
        """
        comm = self.system.comm
        reach = FARTHER * abs(high.s - low.s) * max(max_abs(comm, low.du), max_abs(comm, high.du))
        return max_abs(comm, high.state.u - low.state.u) > max(reach, least * self.system.length)

    def _explained(self, here: Point, there: Point) -> bool:
        """Whether a path with a corner somewhere between two points leads from one to the other."""
        comm, length = self.system.comm, there.s - here.s
        turn, rest = there.du - here.du, there.state.u - here.state.u - length * here.du
        square = dot(comm, turn, turn)
        after = dot(comm, turn, rest) / square if square else 0.0  # of the way, behind the corner
        after = min(max(after / length, 0.0), 1.0) * length
        gap = max_abs(comm, rest - after * turn)
        return gap <= max(
            self.options.gap * max_abs(comm, rest + length * here.du), SEEN * self.system.length
        )

    def _cosine(self, a: Point, b: Point) -> float:
        """The cosine between the displacements of two tangents; 1 if the amplitude moves nothing
        there.
        """
        lengths = self.metric.norm(a.du, 0.0) * self.metric.norm(b.du, 0.0)
        if lengths < SEEN**2:
            return 1.0
        return self.metric.inner((a.du, 0.0), (b.du, 0.0)) / lengths

    def exact(self, point: Point, base: Point) -> Point:
        """The point with the tangent and the inertia of its own K, not of the K of a state near by."""
        row = self._row(point.s, base)
        again = self._point(
            point.state, point.s, self.newton.response(point.state, self.name, row, exact=True)
        )
        return replace(
            again,
            iterations=point.iterations,
            factorisations=point.factorisations + 1,
            error=point.error,
        )

    def _row(self, s: float, base: Point) -> Row:
        if self.control == "arc":
            return Hyperplane(self.metric, self.name, base.state, base.normal, s - base.s)
        return self.given(self.control, s)

    def _point(self, state: State, s: float, response: Response) -> Point:
        """A point with its tangent and both numbers of unstable directions.

        With q held instead of mu, there is one unstable direction less where dq/dmu < 0. This is
        Haynsworth's inertia additivity: dq/dmu = R_mu . K^-1 R_mu - Pi_mumu is minus the Schur
        complement. A coordinate whose force is held has one more instead where dq/dmu > 0.
        """
        pivots = response.negative_pivots
        held = pivots + int(response.softness >= 0) - int(self.name not in self.system.coordinates)
        return Point(state, s, response.du, response.dmu, pivots, held)

    def in_steps(self, options: StepOptions) -> "Path":
        """The same path with other step lengths."""
        other = copy(self)
        other.options = options
        return other

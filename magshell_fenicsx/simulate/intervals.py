"""The rows of a motion: its states at given times, from the journal where it has them, and their
errors.

Departures from unstable states magnify the errors of steps, by a factor that the end of the motion
alone shows. So a motion whose error at the rows is asked for is rehearsed with longer steps. The
first rehearsal shows when it is fastest: until then no step is longer than there. Two more show the
error, which goes as the square of the steps.
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
from magshell_fenicsx.simulate.stage import staged

CLOSE = 1e-9  # of an interval: the error of an event's time
COARSER = 10.0  # the tolerance of the first rehearsal over that of the motion
COARSEST = 1e-2
FAST = 0.5  # of the largest speed: the steps of rows with more are those of a fast motion
AIM = 0.4  # part of the tolerance that the error at the rows is meant to be
FARTHEST = 8  # the steps of the last rehearsal over those of the motion, at most
SHORTEST = 1 / 64  # steps of the motion over those of the second rehearsal
CLEAR = 0.7  # of the last rehearsal's steps: below that the difference from it shows the error


@dataclass(frozen=True)
class Rehearsal:
    """What rehearsals show of a motion.

    Attributes
    ----------
    steps
        Those of the motion.
    rows
        The displacements of the last rehearsal.
    errors
        Their estimated errors, over the system's length.
    part
        Steps of the motion over those of the last rehearsal.
    """

    steps: TimeSteps
    rows: Sequence[Vector]
    errors: Sequence[float]
    part: float

    def error(self, scene: Scene, row: int, u: Vector | None) -> float:
        """Estimated error of the motion's displacement over the system's length, at a row or,
        without u, before it.
        """
        row, square = min(row, len(self.rows) - 1), self.part**2
        if u is None or self.part > CLEAR:
            return square * self.errors[row]
        return square / (1 - square) * _distance(scene, u, self.rows[row])


def _distance(scene: Scene, u: Vector, other: Vector) -> float:
    system = scene.model.system
    return max_abs(system.comm, u - other) / system.length


@dataclass(frozen=True)
class Rehearsed:
    """A motion that can be rehearsed.

    Attributes
    ----------
    scene, held, marks
        See `Intervals`.
    begin
        A new integrator and the motion's begin.
    ends
        The times of rows.
    over
        Whether a motion need not be followed beyond the second of two rows; the third is the
        largest kinetic energy.
    """

    scene: Scene
    held: Mapping[str, HeldConjugate]
    marks: Collection[float]
    begin: Callable[[], tuple[Integrator, Motion]]
    ends: Sequence[float]
    over: Callable[[Motion, Motion, float], bool]

    def __call__(self, steps: TimeSteps) -> Rehearsal:
        """Choose steps with which the error at all rows is below the tolerance."""
        scene, tolerance = self.scene, steps.tolerance
        coarse = replace(steps, tolerance=max(tolerance, min(COARSER * tolerance, COARSEST)))
        speeds = [
            (max_abs(scene.model.system.comm, now.v), now.t, dt) for now, dt in self._rows(coarse)
        ]
        speed, fastest, _ = max(speeds)
        longest = max(dt for v, _, dt in speeds if v >= FAST * speed)
        coarse, part = replace(coarse, longest=longest, fastest=fastest), 1.0
        rows, ratio = [now.u for now, _ in self._rows(coarse)], 0.5
        while True:
            part *= ratio
            errors = list[float]()
            for i, (now, _) in enumerate(self._rows(coarse.refined(part))):
                before = rows[min(i, len(rows) - 1)]
                errors.append(ratio**2 / (1 - ratio**2) * _distance(scene, now.u, before))
                rows[i : i + 1] = [now.u]
            wanted = part * float(np.sqrt(AIM * tolerance / max(*errors, 1e-300)))
            wanted = min(max(wanted, SHORTEST), (tolerance / coarse.tolerance) ** (1 / 3))
            if wanted * FARTHEST >= part:
                return Rehearsal(coarse.refined(wanted), rows[: len(errors)], errors, wanted / part)
            ratio = 0.25

    def _rows(self, steps: TimeSteps) -> Iterator[tuple[Motion, float]]:
        """The motion at each row, and the mean step before it."""
        integrator, now = self.begin()
        walk, dt = Intervals(self.scene, integrator, self.held, steps, self.marks), steps.first
        most = integrator.kinetic(now)
        for end in self.ends:
            before, count = now, integrator.steps
            self.scene.progress.trying(
                Point(State(now.u, now.mu), now.t, now.v, 0.0, 0, 0), end - now.t
            )
            now, dt = walk.moved(before, dt, end)
            most = max(most, integrator.kinetic(now))
            yield now, (now.t - before.t) / (integrator.steps - count)
            if self.over(before, now, most):
                return


@dataclass
class Intervals:
    """Moves a scene from row to row.

    Parameters
    ----------
    held
        See `staged`.
    marks
        Times at which loads have kinks or jumps.
    rehearse
        Chooses the steps for the tolerance of these; None: they are taken as they are.
    """

    scene: Scene
    integrator: Integrator
    held: Mapping[str, HeldConjugate]
    steps: TimeSteps
    marks: Collection[float]
    rehearse: Rehearsed | None = None
    _rehearsal: Rehearsal | None = field(default=None, init=False)
    _last: Point | None = field(
        default=None, init=False
    )  # of the journal, what the factors belonged to

    def moved(
        self, now: Motion, dt: float, end: float, *, known: bool = False
    ) -> tuple[Motion, float]:
        """The motion at a later time, which may be `known` already, and the step to go on with."""
        between = partial(self.scene.journal.check, known)
        for t in [*sorted(t for t in self.marks if now.t < t < end), end]:
            if now.t in self.marks and self.integrator.begins_anew(
                now.t
            ):  # the acceleration after it
                now = self.integrator.begin(now.t, now.u, now.v, now)
            now, dt = advance(self.integrator, now, t, self.steps, dt, between)
        return now, dt

    def crossing(
        self, now: Motion, dt: float, end: Motion, beyond: Callable[[Motion], float]
    ) -> float:
        """The time between two motions at which a function of them changes its sign."""
        close, ends = CLOSE * (end.t - now.t), {now.t: now, end.t: end}
        self._refactor()

        def at(t: float) -> float:
            return beyond(ends.get(t) or self.moved(now, dt, t)[0])

        time = float(scipy.optimize.brentq(at, now.t, end.t, xtol=close))
        return max(time, now.t + close)

    def journalled(self, now: Motion, dt: float, end: float) -> tuple[Motion, float, Point]:
        """The motion at a later time, the step to go on with, and the point there.

        In the journal these are three points: the motion, what it needs besides, and what the
        latest factors belong to.
        """
        scene, integrator = self.scene, self.integrator
        points = list[Point]()
        while len(points) < 3 and isinstance(part := scene.journal.replay(), Point):
            points.append(part)
        again = (
            integrator.viscous is not None
        )  # the journal has no place for a branch's strains: computed again
        if len(points) == 3 and not again:
            first, second, self._last = points
            scene.newton.factorisation.habit = first.habit
            mu, potentials = dict(first.state.mu), dict(second.state.mu)
            u, v, a = first.state.u, first.du, second.state.u
            return (
                Motion(first.s, u, v, a, mu, second.s, second.dmu, potentials, second.error),
                first.dmu,
                first,
            )
        self._refactor()
        before = integrator.steps, integrator.iterations, integrator.factorisation.count
        try:
            if (
                self.rehearse and not self._rehearsal
            ):  # not before it is needed: a journal may have all rows
                self._rehearsal = self.rehearse(self.steps)
                self.steps = self._rehearsal.steps
            scene.progress.trying(Point(State(now.u, now.mu), now.t, now.v, 0.0, 0, 0), end - now.t)
            now, dt = self.moved(now, dt, end, known=len(points) == 3)
        except TimeStopped as e:
            raise Stopped(str(e)) from None
        spent = integrator.iterations - before[1], integrator.factorisation.count - before[2]
        error = 0.0
        if self.rehearse and self._rehearsal:
            ends = self.rehearse.ends
            row = int(np.searchsorted(ends, end))
            error = self._rehearsal.error(scene, row, now.u if end == ends[row] else None)
        state = scene.model.system.with_moved_supports(State(now.u, now.mu))
        stage = staged(scene, state, self.held)
        # rigid motions that are free have no stiffness: the sign of their pivots is rounding
        pivots = (
            0 if scene.free_in_time else stage.newton.factor_at(stage.enter(state)).negative_pivots
        )
        still = 0.0 * now.a
        habit = scene.newton.factorisation.habit
        point = Point(state, now.t, now.v, dt, pivots, pivots, *spent, error=error, habit=habit)
        rest = Point(
            State(now.a, now.potentials), now.work, still, now.dissipated, 0, 0, error=now.error
        )
        made = integrator.factored_state or FactoredState(
            still, {}, 0.0, integrator.factorisation.habit
        )
        factors = Point(State(made.u, made.mu), made.dt, still, 0.0, 0, 0, habit=made.habit)
        for part in (point, rest, factors)[len(points) :]:
            scene.journal.record(part)
        return now, dt, point

    def _refactor(self) -> None:
        """Make the factors that the run had kept: others end iterations elsewhere, within their
        tolerance.
        """
        last, self._last = self._last, None
        if (
            self.integrator.contact
        ):  # beside a body factors belong to a whole step: each interval makes its own
            self.integrator.factored_state = None
        if last and last.s and not self.integrator.contact:
            self.integrator.factor(
                FactoredState(last.state.u, dict(last.state.mu), last.s, last.habit)
            )
        elif last:
            self.integrator.factorisation.habit = last.habit

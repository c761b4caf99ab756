"""The rows of a motion: its states at given times, from the journal where it has them."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial

import scipy

from magshell_fenicsx.continuation.advance import TimeSteps, TimeStopped, advance
from magshell_fenicsx.continuation.device import Held
from magshell_fenicsx.continuation.motion import Motion
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.continuation.transient import Factored, Integrator
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import staged

CLOSE = 1e-9  # of an interval: the error of an event's time


@dataclass
class Intervals:
    """Moves a scene from row to row.

    Parameters
    ----------
    held
        See `staged`.
    marks
        Times at which loads have kinks or jumps.
    """

    scene: Scene
    integrator: Integrator
    held: Mapping[str, Held]
    steps: TimeSteps
    marks: Collection[float]
    _last: Point | None = field(default=None, init=False)  # of the journal, what the factors belonged to

    def moved(self, now: Motion, dt: float, end: float, *, known: bool = False) -> tuple[Motion, float]:
        """The motion at a later time, which may be `known` already, and the step to go on with."""
        between = partial(self.scene.journal.check, known)
        for t in [*sorted(t for t in self.marks if now.t < t < end), end]:
            if now.t in self.marks and self.integrator.jumps(now.t):  # the acceleration after it
                now = self.integrator.begin(now.t, now.u, now.v, now)
            now, dt = advance(self.integrator, now, t, self.steps, dt, between)
        return now, dt

    def crossing(self, now: Motion, dt: float, end: Motion, beyond: Callable[[Motion], float]) -> float:
        """The time between two motions at which a function of them changes its sign."""
        close, ends = CLOSE * (end.t - now.t), {now.t: now, end.t: end}
        self._refactor()

        def at(t: float) -> float:
            return beyond(ends.get(t) or self.moved(now, dt, t)[0])

        found = float(scipy.optimize.brentq(at, now.t, end.t, xtol=close))
        return max(found, now.t + close)

    def journalled(self, now: Motion, dt: float, end: float) -> tuple[Motion, float, Point]:
        """The motion at a later time, the step to go on with, and the point there.

        In the journal these are three points: the motion, what it needs besides, and what the latest factors belong to.
        """
        scene, integrator = self.scene, self.integrator
        known = list[Point]()
        while len(known) < 3 and isinstance(part := scene.journal.replay(), Point):
            known.append(part)
        again = integrator.viscous is not None  # the journal has no place for a branch's strains: computed again
        if len(known) == 3 and not again:
            first, second, self._last = known
            scene.newton.factorisation.habit = first.habit
            mu, potentials = dict(first.state.mu), dict(second.state.mu)
            u, v, a = first.state.u, first.du, second.state.u
            return Motion(first.s, u, v, a, mu, second.s, second.dmu, potentials, second.error), first.dmu, first
        self._refactor()
        before = integrator.steps, integrator.iterations, integrator.factorisation.count
        scene.progress.trying(Point(State(now.u, now.mu), now.t, now.v, 0.0, 0, 0), end - now.t)
        try:
            now, dt = self.moved(now, dt, end, known=len(known) == 3)
        except TimeStopped as e:
            raise Stopped(str(e)) from None
        spent = integrator.iterations - before[1], integrator.factorisation.count - before[2]
        state = scene.model.system.placed(State(now.u, now.mu))
        stage = staged(scene, state, self.held)
        pivots = stage.newton.factor_at(stage.enter(state)).negative_pivots
        still = 0.0 * now.a
        point = Point(state, now.t, now.v, dt, pivots, pivots, *spent, habit=scene.newton.factorisation.habit)
        rest = Point(State(now.a, now.potentials), now.work, still, now.dissipated, 0, 0, error=now.error)
        made = integrator.factored or Factored(still, {}, 0.0, integrator.factorisation.habit)
        factors = Point(State(made.u, made.mu), made.dt, still, 0.0, 0, 0, habit=made.habit)
        for part in (point, rest, factors)[len(known) :]:
            scene.journal.record(part)
        return now, dt, point

    def _refactor(self) -> None:
        """Make the factors that the run had kept: others end iterations elsewhere, within their tolerance."""
        last, self._last = self._last, None
        if self.integrator.averaged:  # beside a body factors belong to a whole step: each interval makes its own
            self.integrator.factored = None
        if last and last.s and not self.integrator.averaged:
            self.integrator.factor(Factored(last.state.u, dict(last.state.mu), last.s, last.habit))
        elif last:
            self.integrator.factorisation.habit = last.habit

"""Following an equilibrium path by load, by conjugate displacement or by arc length, with adaptive steps."""

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from magshell_fenicsx.continuation.control import GivenConjugate, GivenLoad, Hyperplane, Metric, Row
from magshell_fenicsx.continuation.journal import Journal, NoJournal
from magshell_fenicsx.continuation.listener import NoProgress, Progress
from magshell_fenicsx.continuation.newton import HIDDEN, BorderedNewton, Response
from magshell_fenicsx.continuation.point import PathStopped, Point
from magshell_fenicsx.continuation.system import State, Vector, Weighted, dot, followed, max_abs

Control = Literal["load", "conjugate", "arc"]
MOST_LEAPS = 3  # longer steps that are tried where rounding hides a point
MANY = 2  # hard solves after which the tangent takes the stress that follows from the last point, which costs a tenth
SEEN = 1e-6  # a displacement that counts, in lengths of the system


@dataclass(frozen=True)
class StepOptions:
    """Adaptive step length.

    Attributes
    ----------
    first, largest, smallest
        Step lengths in units of s.
    easy, hard
        Factorisations up to which a step grows, and from which it shrinks.
    few
        Iterations up to which it grows too.
    straight
        Cosine between the tangents of successive points above which a step grows.
    turn
        Least cosine between the tangents of successive points; a sharper turn is
        taken for a jump to another branch and tried again with a smaller step.
    gap
        Largest part of a step that the tangents at its ends may leave unexplained, likewise.
    """

    first: float
    largest: float
    smallest: float
    easy: int = 2
    hard: int = 4
    few: int = 4
    straight: float = 0.9
    turn: float = 0.5
    gap: float = 0.1


class Path:
    """An equilibrium path in one amplitude, the others being fixed.

    Parameters
    ----------
    name
        The amplitude that varies.
    control
        What s is. "load": the amplitude; "conjugate": the displacement conjugate to it;
        "arc": the arc length in a `Metric`, along the tangent of the point before.
    scale
        An amplitude that counts as of order one in the arc length.
    journal
        Keeps every result of `at`, and gives back those of an interrupted run.
    progress
        Hears of every step before it is tried.
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
    ) -> None:
        self.newton, self.name, self.control, self.options = newton, name, control, options
        self.system = newton.system
        self.metric = Metric(newton.system, scale)
        self._hard = 0  # solves that failed or took many matrices
        self._journal, self.progress = journal or NoJournal(), progress or NoProgress()

    def start(self, state: State, sense: float = 1.0) -> Point:
        """The point of a state that is in equilibrium already.

        Parameters
        ----------
        sense
            Of the arc length: the sign of dmu/ds.
        """
        response = self.newton.response(state, self.name, GivenLoad(self.name, 0.0), exact=True)
        if self.control == "load":
            s, rate = state.mu[self.name], 1.0
        elif self.control == "conjugate":
            s, rate = self._conjugate(state), response.softness
        else:
            s, rate = 0.0, float(np.copysign(self.metric.norm(response.du, 1.0), sense))
        return self._point(state, s, response).per(rate)

    def at(self, s: float, guess: State, base: Point) -> Point | str:
        """Solve for the point at `s`, or say why that failed.

        Parameters
        ----------
        base
            The point whose tangent arc length is measured along.
        """
        stress = followed(base.state.u, (s - base.s) * base.du) if self._hard >= MANY else ()
        return self.solve(self._row(s, base), s, guess, stress)

    def inside(self, s: float, low: Point, high: Point, base: Point) -> Point | str:
        """Solve for the point at `s` between two others; `base` is as that of `at`."""
        t = (s - low.s) / (high.s - low.s)
        stress = [(1 - t, low.state.u), (t, high.state.u)]
        return self.solve(self._row(s, base), s, self.between(s, low, high), stress)

    def solve(self, row: Row, s: float, guess: State, stress: Sequence[Weighted] = ()) -> Point | str:
        """Solve for the point on which a row holds, or say why that failed; the tangent is per unit of the row."""
        found = self.recorded(lambda: self._solve(row, s, guess, stress))
        self._hard += isinstance(found, str) or found.factorisations >= self.options.hard
        return found

    def recorded(self, find: Callable[[], Point | str]) -> Point | str:
        """What is found, or what an interrupted run had found here."""
        known = self._journal.replay()
        if known is not None:
            return known
        found = find()
        self._journal.record(found)
        return found

    def on(self, state: State, direction: tuple[Vector, float], base: Point, negative_pivots: int) -> Point:
        """The point of a state on the path, with a tangent that has been found otherwise.

        Parameters
        ----------
        direction
            The tangent (du, dmu), of any length.
        """
        du, dmu = direction
        u, mu, name = state.u, state.mu, self.name
        bend = self.system.curvature(u, mu, name, name)
        dq = -dot(self.system.comm, self.system.load(u, mu, name), du) - bend * dmu
        rate = {"load": dmu, "conjugate": dq, "arc": self.metric.inner((base.du, base.dmu), direction)}[self.control]
        softness = dq / dmu if dmu else np.inf
        return self._point(state, self._s(state, base), Response(du, dmu, softness, negative_pivots)).per(rate)

    def _s(self, state: State, base: Point) -> float:
        """The controlled quantity at a state."""
        mu = state.mu[self.name]
        if self.control == "load":
            return mu
        if self.control == "conjugate":
            return self._conjugate(state)
        chord = (state.u - base.state.u, mu - base.state.mu[self.name])
        return base.s + self.metric.inner((base.du, base.dmu), chord)

    def towards(self, start: Point, targets: Sequence[float]) -> Iterator[tuple[Point, bool]]:
        """Accepted points through every target in turn; the flag marks the targets.

        Raises
        ------
        PathStopped
            If a step of the smallest length fails.
        """
        before, here, step, leaps = None, start, self.options.first, 0
        for target in targets:
            while here.s != target:
                way = target - here.s
                pieces = max(1.0, np.ceil(abs(way) / step)) if np.isfinite(way) else np.inf
                length = abs(way) / pieces if pieces < 3 else step  # no stub of a step before a target
                s = target if pieces == 1 else here.s + np.copysign(length, way)
                found = self._try(s, before, here)
                if isinstance(found, str):
                    leaps += 1
                    over = found == HIDDEN and leaps <= MOST_LEAPS  # past the singular tangent, not into it
                    step = 2 * length if over else length / 2
                    if step < self.options.smallest:
                        raise PathStopped(found, here)
                    continue
                leaps = 0
                straight = self._cosine(here, found) > self.options.straight
                o = self.options
                if (found.factorisations <= o.easy or found.iterations <= o.few) and straight:
                    step = min(max(step, 1.5 * length), o.largest)
                elif found.factorisations >= o.hard:
                    step = 0.6 * length
                before, here = here, found
                yield here, here.s == target

    def predict(self, s: float, before: Point | None, here: Point) -> State:
        """Cubic through the last two points with their tangents (linear at the start)."""
        if before is not None:
            return self.between(s, before, here)
        a = s - here.s
        return here.state.with_(here.state.u + a * here.du, self.name, here.state.mu[self.name] + a * here.dmu)

    def between(self, s: float, low: Point, high: Point) -> State:
        """Hermite cubic through two points, as first guess."""
        L, name = high.s - low.s, self.name
        t = (s - low.s) / L
        h00, h10, h01, h11 = 2 * t**3 - 3 * t**2 + 1, t**3 - 2 * t**2 + t, 3 * t**2 - 2 * t**3, t**3 - t**2
        u = h00 * low.state.u + h01 * high.state.u + L * (h10 * low.du + h11 * high.du)
        mu = h00 * low.state.mu[name] + h01 * high.state.mu[name] + L * (h10 * low.dmu + h11 * high.dmu)
        return low.state.with_(u, name, float(mu))

    def seen_from(self, base: Point, point: Point) -> Point:
        """The point with its tangent per unit of s as measured at `base`."""
        if self.control != "arc":
            return point
        return point.per(self.metric.inner((base.du, base.dmu), (point.du, point.dmu)))

    def _try(self, s: float, before: Point | None, here: Point) -> Point | str:
        self.progress.trying(here, s - here.s)
        found = self.at(s, self.predict(s, before, here), here)
        if isinstance(found, str):
            return found
        if found.negative_pivots != here.negative_pivots or found.dmu * here.dmu < 0:
            found = self.exact(found, here)
        if trouble := self._jumped(here, found):
            return trouble
        if self.control != "arc":
            return found
        return found.per(self.metric.norm(found.du, found.dmu))

    def _jumped(self, here: Point, found: Point) -> str | None:
        """Why a step is not trusted: its ends do not look like ends of one smooth arc."""
        length = found.s - here.s
        if abs(found.negative_pivots - here.negative_pivots) > 1 and abs(length) > self.options.first / 8:
            return "the step passed several instabilities, or jumped to another branch"
        chord = found.state.u - here.state.u
        unexplained = chord - length / 2 * (here.du + found.du)
        gap, whole = (max_abs(self.system.comm, v) / self.system.length for v in (unexplained, chord))
        if self._cosine(here, found) < self.options.turn or gap > max(self.options.gap * whole, SEEN):
            return "the path turns sharply, or the step jumped to another branch"
        return None

    def _size(self, v: Vector) -> float:
        return self.metric.norm(v, 0.0)

    def _cosine(self, a: Point, b: Point) -> float:
        """Between the displacements of two tangents; 1 if the amplitude moves nothing there."""
        lengths = self._size(a.du) * self._size(b.du)
        if lengths < SEEN**2:
            return 1.0
        return self.metric.weight * dot(self.system.comm, a.du, b.du) / lengths

    def _solve(self, row: Row, s: float, guess: State, stress: Sequence[Weighted]) -> Point | str:
        before = self.newton.factorisation.count
        outcome = self.newton.solve(guess, self.name, row, stress)
        if not outcome.converged:
            return outcome.reason
        spent = self.newton.factorisation.count - before
        exact = self._hard >= MANY  # the stress that follows is as good as the tangent
        found = self._point(outcome.state, s, self.newton.response(outcome.state, self.name, row, exact=exact))
        return replace(found, iterations=outcome.iterations, factorisations=spent, error=outcome.error)

    def exact(self, point: Point, base: Point) -> Point:
        """The point with the tangent and the inertia of its own K, not of one near by."""
        row = self._row(point.s, base)
        found = self._point(point.state, point.s, self.newton.response(point.state, self.name, row, exact=True))
        spent = point.factorisations + 1
        return replace(found, iterations=point.iterations, factorisations=spent, error=point.error)

    def _row(self, s: float, base: Point) -> Row:
        if self.control == "load":
            return GivenLoad(self.name, s)
        if self.control == "conjugate":
            return GivenConjugate(self.system, self.name, s)
        return Hyperplane(self.metric, self.name, base.state, (base.du, base.dmu), s - base.s)

    def _conjugate(self, state: State) -> float:
        return -self.system.potential(state.u, state.mu, self.name)

    def _point(self, state: State, s: float, response: Response) -> Point:
        """Holding q instead of mu takes one unstable direction away where dq/dmu < 0.

        This is Haynsworth's inertia additivity: dq/dmu = R_mu . K^-1 R_mu - Pi_mumu is minus the Schur complement.
        A coordinate whose force is held adds one instead where dq/dmu > 0.
        """
        pivots = response.negative_pivots
        held = pivots + (response.softness >= 0) - (self.name not in self.system.coordinates)
        return Point(state, s, response.du, response.dmu, pivots, held)

    def in_steps(self, options: StepOptions) -> "Path":
        """The same path in other steps."""
        other = copy(self)
        other.options = options
        return other

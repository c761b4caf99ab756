"""A walk along a path to its goal, with every instability located and every requested point on the
way.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np

from magshell_fenicsx.continuation.bifurcation import SCATTER, BifurcationLost, find_bifurcation
from magshell_fenicsx.continuation.control import projected
from magshell_fenicsx.continuation.interpolated import corner, stationary
from magshell_fenicsx.continuation.modes import NoEigenpair, Stability, critical_mode
from magshell_fenicsx.continuation.path import SEEN, Path, Quantity
from magshell_fenicsx.continuation.point import PathStopped, Point, StepTooLong
from magshell_fenicsx.continuation.system import Direction, State, Vector, Weighted, max_abs
from magshell_fenicsx.continuation.targets import TargetMissed, arriving, targets_between

MOST_TRIALS = 60  # so many bisections reduce any bracket to rounding
FLAT = 0.01  # a smaller slope of the amplitude, over the slope at the step's start, means a fold
MIDDLE = (
    0.5,
    0.35,
    0.65,
    0.2,
    0.8,
)  # places in a bracket, tried in turn, for a point between its ends
MOST_HALVINGS = 12  # of a step with several instabilities; what is left counts as one
MOST_SOLVES = 60  # in the search for one instability, with its repetitions in shorter steps
MOST_REPEATED = 3  # searches in shorter steps, before several instabilities count as a cluster
PARTED = 1e-4  # in lengths: about a neutral mode rounding moves a state by less
BESIDE = (
    0.5  # of the way between two points: what is farther from their cubic lies on another branch
)
Label = Literal["step", "target", "fold", "bifurcation"]
Until = Literal["limit", "bifurcation", "target", "points"]
MOST_STEPS = 1000
LOCATED = 1e-8  # relative: of the amplitude at an instability
SAME = 1e-2  # distance along the path, in the system's lengths, below which two folds are one


@dataclass(frozen=True)
class Instability:
    """A point at which the tangent is singular.

    Attributes
    ----------
    kind
        "fold": the amplitude is stationary; "bifurcation": it is not.
    """

    point: Point
    kind: Literal["fold", "bifurcation"]


class Clustered(PathStopped):
    """Several instabilities, between `point` and `high`, are not parted by the points that can be
    found there."""

    def __init__(self, point: Point, high: Point) -> None:
        super().__init__("several instabilities lie too close to each other", point)
        self.high = high


@dataclass
class Allowance:
    """Bounds of the search for the next instability, its repetitions in shorter steps included.

    Attributes
    ----------
    solves
        That have been tried.
    repeated
        Number of searches that ended between instabilities which they could not part.
    end
        Of the step in which the last search failed.
    clustered
        Whether that was between instabilities.
    """

    solves: int = 0
    repeated: int = 0
    end: Point | None = None
    clustered: bool = False

    @property
    def spent(self) -> bool:
        """Whether no further solve is allowed."""
        return self.solves >= MOST_SOLVES

    def renew(self) -> None:
        """Begin with the next instability."""
        self.solves, self.repeated, self.end, self.clustered = 0, 0, None, False


def instabilities(
    path: Path,
    low: Point,
    high: Point,
    tolerance: float = LOCATED,
    allowance: Allowance | None = None,
) -> Iterator[Instability]:
    """All singular points between two successive points, in order, as far as inertia and tangents
    reveal them.

    Parameters
    ----------
    tolerance
        Of the amplitude, relative.
    allowance
        Of this search and of those before it for the same instability; None: there were none.

    Raises
    ------
    PathStopped
        If Newton's method fails between the two points.
    Clustered
        If no point is found between several instabilities.
    """
    search = _Search(path, low, tolerance, allowance or Allowance())
    yield from search.between(low, path.seen_from(low, high), MOST_HALVINGS)


@dataclass
class _Search:
    """A search between two points, the first of which is the base of solves; counts are since the
    last result.
    """

    path: Path
    base: Point
    tolerance: float
    allowance: Allowance = field(default_factory=Allowance)
    iterations: int = 0
    factorisations: int = 0

    def between(self, low: Point, high: Point, halvings: int) -> Iterator[Instability]:
        change = abs(high.negative_pivots - low.negative_pivots)
        turned = low.dmu * high.dmu < 0
        if change == 0 and not turned:
            return
        self.path.progress.doing("locating an instability")
        single = change == 1 or not halvings
        if single and turned:
            fold = self.fold(low, high)
            point = self.spent(fold) if change == 1 else self.finished(fold)
            before = (
                low.negative_pivots,
                low.negative_pivots_held,
            )  # rounding decides what its own matrix counts
            yield Instability(
                replace(point, negative_pivots=before[0], negative_pivots_held=before[1]), "fold"
            )
        elif single:
            point = self.crossing(low, high) or self.bracketed(low, high)
            if abs(point.dmu) < FLAT * abs(low.dmu):
                raise PathStopped("the step passed a fold and left the branch", low)
            yield Instability(point, "bifurcation")
        else:
            middle = self.middle(low, high)
            if middle is None:
                self.refuse_apart(low, high)
                raise Clustered(low, high)
            yield from self.between(low, middle, halvings - 1)
            yield from self.between(middle, high, halvings - 1)

    def solve(self, s: float, low: Point, high: Point) -> Point:
        """A point whose number of unstable directions nobody asks for."""
        solved = self.try_at(s, low, high, counted=False)
        if isinstance(solved, str):
            raise PathStopped(f"locating an instability: {solved}", low)
        return solved

    def try_at(self, s: float, low: Point, high: Point, *, counted: bool = True) -> Point | str:
        solved = self.path.inside(s, low, high, self.base, counted=counted)
        if isinstance(solved, str):
            return solved
        self.iterations += solved.iterations
        self.factorisations += solved.factorisations
        return "the iteration has left the branch" if self.left(solved, low, high) else solved

    def left(self, point: Point, low: Point, high: Point) -> bool:
        """Whether a point is so far from the cubic between two points that it lies on another
        branch.
        """
        if self.base.across:  # no cubic goes around a corner
            return False
        system, guess = self.path.system, self.path.between(point.s, low, high)
        off = max_abs(system.comm, point.state.u - guess.u)
        chord = max_abs(system.comm, high.state.u - low.state.u)
        return off > max(BESIDE * chord, SEEN * system.length)

    def middle(self, low: Point, high: Point) -> Point | None:
        """A point somewhere between two others, with its own inertia; rounding may hide some
        places.
        """
        for part in MIDDLE:
            if self.allowance.spent:
                return None
            self.allowance.solves += 1
            solved = self.try_at(low.s + part * (high.s - low.s), low, high)
            if not isinstance(solved, str):
                return self.path.exact(solved, self.base)
        return None

    def crossing(self, low: Point, high: Point) -> Point | None:
        """The bifurcation between two points, as the solution of a regular system; None if there is
        no solution.
        """
        path = self.path
        if path.newton.factorisation.skewed:
            return None  # the regular system needs a symmetric tangent
        try:
            modes = [critical_mode(path.newton, end.state) for end in (low, high)]
        except NoEigenpair:
            return None
        a, b = (mode.eigenvalue for mode in modes)
        t = a / (a - b) if a * b < 0 else 0.5
        guess = path.between(low.s + t * (high.s - low.s), low, high)
        pivots = sorted(end.negative_pivots for end in (low, high))
        for mode in sorted(modes, key=lambda mode: abs(mode.eigenvalue)):
            stress = [(1 - t, low.state.u), (t, high.state.u)]
            solved = path.recorded(partial(self._regular, guess, mode.vector, stress, low, high))
            if isinstance(solved, str):
                continue
            inside = min(low.s, high.s) <= solved.s <= max(low.s, high.s)
            if (
                inside
                and pivots[0] <= solved.negative_pivots < pivots[1]
                and not self.left(solved, low, high)
            ):
                return self.spent(solved)
        return None

    def _regular(
        self, guess: State, phi: Vector, stress: Sequence[Weighted], low: Point, high: Point
    ) -> Point | str:
        path = self.path
        try:
            bifurcation = find_bifurcation(path.newton, guess, phi, path.name, stress)
        except BifurcationLost:
            return "no bifurcation was found"
        self.iterations += bifurcation.iterations
        self.factorisations += bifurcation.factorisations
        # the null vector and the response span the tangents of both branches; this one continues
        # the path
        state, along = bifurcation.state, self._slope(bifurcation.state, low, high)
        direction = projected(
            path.metric, along, [(bifurcation.phi, 0.0), (-bifurcation.response, 1.0)]
        )
        point = path.on(state, direction, self.base, bifurcation.unstable)
        return replace(point, error=bifurcation.error, load_error=bifurcation.load_error)

    def _slope(self, state: State, low: Point, high: Point) -> Direction:
        """The path's tangent near a state between two points, interpolated."""
        name = self.path.name
        t = (state.mu[name] - low.state.mu[name]) / (high.state.mu[name] - low.state.mu[name])
        t = min(max(t, 0.0), 1.0)
        return (1 - t) * low.du + t * high.du, (1 - t) * low.dmu + t * high.dmu

    def bracketed(self, low: Point, high: Point) -> Point:
        """The last point before an instability, by bisection until rounding spoils the inertia."""
        name = self.path.name
        for _ in range(MOST_TRIALS):
            width = abs(high.state.mu[name] - low.state.mu[name])
            middle = (
                self.middle(low, high) if width > self.tolerance * abs(low.state.mu[name]) else None
            )
            if middle is None:
                break
            low, high = (
                (middle, high) if middle.negative_pivots == low.negative_pivots else (low, middle)
            )
            self.refuse_apart(low, high)
        return replace(self.spent(low), load_error=abs(high.state.mu[name] - low.state.mu[name]))

    def refuse_apart(self, low: Point, high: Point) -> None:
        """Refuse two points that are not on one path.

        An imperfect bifurcation has two paths close to each other, of different inertia: a bracket
        with an end on each shrinks to nothing in s and contains no instability.
        """
        if self.path.are_apart(low, high, PARTED):
            raise PathStopped("the step jumped to another branch", low)

    def spent(self, point: Point) -> Point:
        """The point with the work since the last located one."""
        done = replace(point, iterations=self.iterations, factorisations=self.factorisations)
        self.iterations = self.factorisations = 0
        self.allowance.renew()
        return done

    def finished(self, point: Point) -> Point:
        """The point with its own tangent and inertia, and with the work."""
        self.factorisations += 1
        return replace(self.spent(self.path.exact(point, self.base)), load_error=point.load_error)

    def fold(self, low: Point, high: Point) -> Point:
        """Zero of dmu/ds: stationary point of the cubic through both ends, repeated."""
        name = self.path.name
        for _ in range(MOST_TRIALS):
            s = _stationary(low, high, name, corner if self.base.across else stationary)
            point = self.solve(s, low, high)
            mu = point.state.mu[name]
            other = high if point.dmu * low.dmu > 0 else low
            curvature = (other.dmu - point.dmu) / (other.s - point.s)
            rest = abs(point.dmu**2 / (2 * curvature))
            if rest <= self.tolerance * abs(mu):
                return replace(point, load_error=rest)
            low, high = (point, high) if point.dmu * low.dmu > 0 else (low, point)
        return point

    def rest(self, point: Point, stability: Stability, slope: float, most: float) -> float:
        """How far the load is from where the eigenvalue is zero, and what rounding of the tangent
        hides of that.

        Parameters
        ----------
        slope
            Derivative of the eigenvalue by the load; zero if it is not known.
        most
            How far it is at most.
        """
        u = point.state.u
        sides = np.random.default_rng(self.path.system.comm.rank).choice(
            [-1.0, 1.0], (2, u.size)
        )  # as rounding does
        near = [u, *(u + side * np.spacing(u) for side in sides)]
        values = [critical_mode(stability, State(v, point.state.mu)).eigenvalue for v in near]
        return float((abs(values[0]) + SCATTER * np.ptp(values)) / abs(slope)) if slope else most

    def bifurcation(self, low: Point, high: Point, stability: Stability) -> Point:
        """The zero of the eigenvalue that changes sign, by the Illinois variant of regula falsi.

        It ends when two successive guesses agree to tolerance^(3/4). If the eigenvalue shows a
        larger error, it goes on until that is no longer halved. The method's order is 1.44, and
        close to zero the eigenvalue is only rounding.
        """
        name, side, last, best = self.path.name, 0, np.inf, None
        first = critical_mode(stability, low.state)
        a, b = first.eigenvalue, critical_mode(stability, high.state).eigenvalue
        ends = (low.state.mu[name], a), (high.state.mu[name], b)  # loads and eigenvalues
        for _ in range(MOST_TRIALS):
            # the eigenvalue nearest to zero need not be the one that changes sign
            t = a / (a - b) if a * b < 0 else 0.5
            tried = self.try_at(low.s + t * (high.s - low.s), low, high)
            point = self.middle(low, high) if isinstance(tried, str) else tried
            if point is None:  # the path's own tangent is singular there as well
                break
            mu = point.state.mu[name]
            moved, width = (
                abs(point.s - last) * abs(point.dmu),
                abs(high.s - low.s) * abs(point.dmu),
            )
            if moved <= self.tolerance**0.75 * abs(mu) and a * b < 0:
                found = replace(
                    point, load_error=self.rest(point, stability, _slope_of(*ends), width)
                )
                stalled = best and found.load_error > best.load_error / 2
                if stalled or found.load_error <= self.tolerance * abs(mu):
                    return min(best or found, found, key=lambda one: one.load_error)
                best = found  # the next guess, from the other side, may be nearer
            if width <= self.tolerance * abs(mu) and not best:
                return replace(
                    point,
                    load_error=max(width, self.rest(point, stability, _slope_of(*ends), width)),
                )
            last, mode = point.s, critical_mode(stability, point.state)
            if mode.negative_pivots != first.negative_pivots:
                high, b = point, mode.eigenvalue
                ends = ends[0], (mu, b)
                a = a / 2 if side == 1 else a
                side = 1
            else:
                low, a = point, mode.eigenvalue
                ends = (mu, a), ends[1]
                b = b / 2 if side == -1 else b
                side = -1
        return best or replace(low, load_error=abs(high.state.mu[name] - low.state.mu[name]))


def _slope_of(low: tuple[float, float], high: tuple[float, float]) -> float:
    """The slope between two loads with their eigenvalues; zero if these have one sign: they are not
    of one mode.
    """
    (a, first), (b, last) = low, high
    return (last - first) / (b - a) if first * last < 0 and a != b else 0.0


def _stationary(
    low: Point, high: Point, name: str, find: Callable[[float, float, float], float]
) -> float:
    """Where the Hermite cubic of mu(s) is stationary between the ends, or where else one finds it."""
    L = high.s - low.s
    return low.s + L * find((high.state.mu[name] - low.state.mu[name]) / L, low.dmu, high.dmu)


def locate_bifurcation(
    path: Path, stable: Point, unstable: Point, stability: Stability, tolerance: float = LOCATED
) -> Point:
    """Where a tangent other than the path's own becomes singular, between two successive points.

    Parameters
    ----------
    stability
        The tangent of the modes that the model excludes.
    tolerance
        Of the amplitude, relative.

    Raises
    ------
    PathStopped
        If Newton's method fails between the two points, or no eigenpair is found.
    """
    search = _Search(path, stable, tolerance)
    try:
        return search.finished(
            search.bifurcation(stable, path.seen_from(stable, unstable), stability)
        )
    except NoEigenpair as e:
        raise PathStopped(f"locating an instability: {e}", stable) from None


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
        The state of the first of two successive points with other amplitudes beside that of the
        path, from which the walk goes on in place of the second; None if that is accepted. It
        raises `StepTooLong` if it must not be. Where no solution is found with such amplitudes it
        is asked again, and may accept the second point now.
    refused
        Why no instability or target may be at a point; "" if one may. The step that has passed it
        is repeated in shorter ones, at whose ends `renew` is asked.

    Attributes
    ----------
    points
        The start, the steps so far, and the instability or target that ended the walk.
    done
        Whether the last point ends the walk.
    clusters
        The first points before, and behind, instabilities that were not parted. Such a cluster
        counts as one instability, at the first of both points; its width is the error of the
        amplitude.
    """

    def __init__(
        self,
        path: Path,
        start: Point,
        goal: Goal,
        renew: Callable[[Point, Point], State | None] | None = None,
        refused: Callable[[Point], str] = lambda point: "",
    ) -> None:
        self._refused = refused
        self.path, self.goal, self.points, self._renew = path, goal, [start], renew
        self.done = False
        self.clusters: list[tuple[Point, Point]] = []
        self._folds: list[Point] = []
        self._allowance = Allowance()

    def __iter__(self) -> Iterator[tuple[Label, Point]]:
        """Labels and points, in the order of the path.

        Raises
        ------
        PathStopped
            If the path is lost, returns to a fold that it has passed, or needs more steps than
            allowed.
        """
        options, shorter, why = self.path.options, None, ""
        while True:
            for point, reached in self._steps():
                low, shorter = self.path.before(self.points[-1], point), None
                try:
                    state = self._renew(low, point) if self._renew else None
                except StepTooLong as e:
                    shorter, why = abs(point.s - low.s) / 4, str(e)
                    break
                if state:
                    try:
                        self.points[-1], shorter = (
                            self.path.renewed(low, state),
                            abs(point.s - low.s),
                        )
                        self._allowance.end = None  # it has the amplitudes before
                        break
                    except PathStopped as e:
                        if self._renew and self._renew(
                            low, point
                        ):  # nearer to the first point the change is smaller
                            shorter, why = abs(point.s - low.s) / 4, str(e)
                            break
                try:
                    between = self._between(low, point)
                except PathStopped as e:  # the step had left the branch: approach in shorter steps
                    shorter, why = abs(point.s - low.s) / 4, "an instability cannot be located"
                    why = str(e) if isinstance(e, TargetMissed) else why
                    break
                if why := next(filter(None, (self._refused(each[1]) for each in between)), ""):
                    shorter = abs(point.s - low.s) / 4
                    break
                for label, event, self.done in between:
                    yield label, event
                    if label == "fold":
                        self._refuse_loop(event)
                    if self.done:
                        self.points.append(event)
                        return
                self.points.append(point)
                self.done = not self._ahead() or (
                    self.goal.until == "points" and len(self.points) > self.goal.steps
                )
                yield ("target" if reached else "step"), point
                if len(self.points) > self.goal.steps:
                    if self.goal.until == "points":
                        return
                    raise PathStopped(
                        f"{self.goal.steps} steps have not reached the {self.goal.until}",
                        point,
                        final=True,
                    )
            if shorter is None:
                return
            if shorter < options.smallest:
                raise PathStopped(why, self.points[-1])
            # a step must still reach behind instabilities between which there are no points
            several = options.passes_several if self._allowance.clustered else 0.0
            self.path = self.path.in_steps(replace(options, first=shorter, several=several))

    def _steps(self) -> Iterator[tuple[Point, bool]]:
        """Points ahead, as `Path.towards` has them; the end of an earlier step where none is found
        before a cluster."""
        try:
            yield from self.path.towards(self.points[-1], self._ahead(), self._arrive)
        except PathStopped:
            here, allowance = self.points[-1], self._allowance
            if not (allowance.end and allowance.clustered):
                raise
            end = self.path.as_base(self.path.measured_from(here, allowance.end))
            allowance.repeated, allowance.end = MOST_REPEATED, None  # it is tried once
            yield end, end.s in self._ahead()
            yield from self._steps()

    def _refuse_loop(self, fold: Point) -> None:
        """Stop at a fold that was passed before.

        Two successive folds may be close, so the last one is not compared.
        """
        name, u = self.path.name, fold.state.u
        mu = fold.state.mu[name]
        for passed in self._folds[:-1]:
            if self.path.metric.norm(u - passed.state.u, mu - passed.state.mu[name]) < SAME:
                said = (
                    "the path has come back to this fold: a closed loop, which leads nowhere else"
                )
                raise PathStopped(said, fold, final=True)
        self._folds.append(fold)

    @property
    def _by_arc(self) -> bool:
        return self.path.control == "arc"

    def _ahead(self) -> list[float]:
        """The values of s that are still to be reached."""
        goal, s = self.goal, self.points[-1].s
        if self._by_arc:
            return [np.inf]
        if not goal.targets:
            return [float(np.copysign(np.inf, goal.sense))]
        sense = goal.targets[-1] - self.points[0].s
        return [t for t in goal.targets if (t - s) * sense > 0]

    def _arrive(self, s: float, seen: Sequence[Point]) -> float:
        """The end of a step; by arc length, it passes the last target of the walk by little."""
        goal = self.goal
        ends = self._by_arc and goal.targets and goal.until in ("target", "limit")
        return arriving(self.path, goal.quantity, goal.targets[-1], s, seen) if ends else s

    def _between(self, low: Point, high: Point) -> list[tuple[Label, Point, bool]]:
        """Instabilities and, with arc length, targets between two points; the flag marks the end of
        the walk.
        """
        events: list[tuple[Label, Point, bool]] = []
        for event in self._located(low, high):
            ends = self.goal.until in ("limit", event.kind)
            events.append((event.kind, event.point, ends))
            if ends:
                break
        if self._by_arc and self.goal.targets:
            until, targets = self.goal.until in ("target", "limit"), self.goal.targets
            seen = [*self.points[-2:-1], low]
            folds = (event for label, event, _ in events if label == "fold" and event.s != low.s)
            for end in (*(self.path.as_base(fold) for fold in folds), high):
                seen = [*seen[-2:], end]  # a target just below a fold is passed on both sides of it
                for target, point in targets_between(
                    self.path, self.goal.quantity, targets, self.goal.sense, seen
                ):
                    events.append(("target", point, until and target == targets[-1]))
        return sorted(events, key=lambda item: abs(item[1].s - low.s))

    def _located(self, low: Point, high: Point) -> Iterator[Instability]:
        """Instabilities between two points; several that shorter steps do not part count as one."""
        allowance, way = self._allowance, high.s - low.s
        beyond = allowance.end is not None and (high.s - allowance.end.s) * way > 0
        if beyond and not high.turned_from(low):
            allowance.renew()  # shorter steps have passed the place: there was nothing on this path
        try:
            yield from instabilities(self.path, low, high, allowance=allowance)
        except Clustered as e:
            allowance.end, allowance.clustered = high, True
            allowance.repeated += 1
            shortest = abs(way) / 4 < self.path.options.smallest
            if allowance.repeated <= MOST_REPEATED and not allowance.spent and not shortest:
                raise
            allowance.renew()
            yield self._cluster(e.point, e.high)
            behind = self.path.as_base(e.high)
            yield from self._located(behind, self.path.measured_from(behind, high))
        except PathStopped:
            allowance.end, allowance.clustered = high, False
            raise

    def _cluster(self, low: Point, high: Point) -> Instability:
        """Instabilities between two points as one: a fold if the amplitude turns back between
        them."""
        name = self.path.name
        point = replace(low, load_error=abs(high.state.mu[name] - low.state.mu[name]))
        self.clusters.append((point, high))
        return Instability(point, "fold" if low.dmu * high.dmu < 0 else "bifurcation")

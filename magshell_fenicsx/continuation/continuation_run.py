"""A continuation run from a start to a goal: locates instabilities, and solves at targets.

Between two successive points of a path the change of inertia and the sign of dmu/ds show
instabilities. Folds (limit points) are located by interpolation of mu(s), bifurcations (branch
points) as solutions of a regular system or by bisection. Instabilities that cannot be separated
count as one cluster. Theory: docs/theory.md.

The inertia of a point is `negative_pivots`: its number of unstable directions at a fixed amplitude
mu, the one load parameter that varies. s is the controlled quantity of the path: load, conjugate
displacement or arc length, which is measured from a base point along its tangent, or along the
direction `across` where the path turns sharply. A bracket is two points, `low` and `high`, with
something between them. Budget and `iterations`, `factorisations` count the work. A conjugate is the
displacement on which the amplitude does work.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from magshell_fenicsx.continuation.bifurcation import (
    LOAD_ERROR_FACTOR,
    BifurcationLost,
    find_bifurcation,
)
from magshell_fenicsx.continuation.control import nearest_combination
from magshell_fenicsx.continuation.interpolation import kink, stationary
from magshell_fenicsx.continuation.modes import NoEigenpair, Stability, critical_mode
from magshell_fenicsx.continuation.path import ZERO_DISPLACEMENT, Path, Quantity
from magshell_fenicsx.continuation.point import PathStopped, Point, StepTooLong
from magshell_fenicsx.continuation.system import (
    Direction,
    State,
    Vector,
    WeightedDisplacement,
    max_abs,
)
from magshell_fenicsx.continuation.targets import (
    TargetMissed,
    end_near_last_target,
    targets_between,
)

MAX_TRIALS = 60  # so many bisections reduce any bracket to rounding
# a smaller slope of the amplitude, over the slope at the step's start, means a fold
FOLD_SLOPE_RATIO = 0.01
# places in a bracket, tried in turn, for a point between its ends
MIDDLE_FRACTIONS = (0.5, 0.35, 0.65, 0.2, 0.8)
MAX_HALVINGS = 12  # of a step with several instabilities; what is left counts as one
MAX_REPEATED_SEARCHES = 3  # in shorter steps, before several instabilities count as a cluster
# in lengths: near a neutral mode rounding moves a state by less
ROUNDING_NEAR_NEUTRAL_MODE = 1e-4
# of the distance of two points: what deviates more from their cubic lies on another branch
MAX_DEVIATION_FROM_CUBIC = 0.5
Label = Literal["step", "target", "fold", "bifurcation"]
Until = Literal["limit", "bifurcation", "target", "points"]
MAX_STEPS = 1000
LOAD_TOLERANCE = 1e-8  # relative: of the amplitude at an instability
# in lengths: distance up to which two branches that part at an imperfection pass near each other
MAX_BRANCH_DISTANCE = 0.1
# distance in the path's metric below which two folds are one
SAME_FOLD_DISTANCE = 1e-2


@dataclass(frozen=True)
class Instability:
    """A point of a path at which the tangent matrix is singular.

    Attributes
    ----------
    point
        The located point, with the estimated error of its amplitude in `load_error`.
    kind
        "fold": the amplitude is stationary along the path; "bifurcation": it is not.
    """

    point: Point
    kind: Literal["fold", "bifurcation"]


class InstabilityNotLocated(PathStopped):
    """An instability is known to lie between two points, and its place no better.

    Attributes
    ----------
    point, high
        The last point before it, and the first point behind it.
    """

    def __init__(self, reason: str, point: Point, high: Point) -> None:
        super().__init__(reason, point)
        self.high = high


class UnseparatedInstabilities(InstabilityNotLocated):
    """No solution was found between several instabilities, so they cannot be separated."""

    def __init__(self, point: Point, high: Point) -> None:
        super().__init__("several instabilities lie too close to each other", point, high)


class BranchesApart(InstabilityNotLocated):
    """Two points of a bracket lie on two branches, which pass each other without a meeting.

    So they do beside a perturbed bifurcation: an imperfection parts the branches that cross at it.
    """

    def __init__(self, point: Point, high: Point) -> None:
        super().__init__("the step jumped to another branch", point, high)


@dataclass
class LocationBudget:
    """Count of the work on one instability, over all searches in shorter and shorter steps.

    Attributes
    ----------
    max_solves
        Number of solves after which an instability counts as located no better than its bracket.
    solves
        Number of solves that were tried: in searches, and on the steps from one search to the next.
    repeated
        Number of searches that ended between instabilities which they could not separate.
    end
        End of the step in which the last search failed; None if no search has failed.
    clustered
        Whether the last search failed between several instabilities, or between two branches that
        pass near each other.
    apart
        The two branches, where the last search ended between branches that pass near each other;
        None otherwise.
    """

    max_solves: int
    solves: int = 0
    repeated: int = 0
    end: Point | None = None
    clustered: bool = False
    apart: BranchesApart | None = None

    @property
    def exhausted(self) -> bool:
        """Whether no further solve is allowed."""
        return self.solves >= self.max_solves

    def renew(self) -> None:
        """Reset all counts, for the search of the next instability."""
        self.solves, self.repeated, self.end, self.clustered = 0, 0, None, False
        self.apart = None


def instabilities(
    path: Path,
    low: Point,
    high: Point,
    tolerance: float = LOAD_TOLERANCE,
    budget: LocationBudget | None = None,
) -> Iterator[Instability]:
    """Yield the singular points between two successive points of a path, in their order.

    Inertia and the sign of dmu/ds reveal the instabilities: two that cancel in both are missed.
    Collective.

    Parameters
    ----------
    low, high
        Successive accepted points; arc length is measured from `low`.
    tolerance
        Relative error of the amplitude at an instability.
    budget
        Work on this search and earlier ones for the same instability; None: there were none.

    Raises
    ------
    PathStopped
        If Newton's method fails between the two points.
    UnseparatedInstabilities
        If no point is found between several instabilities.
    BranchesApart
        If the two points prove to lie on different branches.
    """
    budget = budget or LocationBudget(path.options.max_location_solves)
    locator = _InstabilityLocator(path, low, tolerance, budget)
    yield from locator.locate(low, path.relative_to(low, high), MAX_HALVINGS)


@dataclass
class _InstabilityLocator:
    """Locator of the instabilities between two points of a path.

    Attributes
    ----------
    base
        The first point, from which arc length is measured.
    tolerance
        Relative error of the amplitude at an instability.
    budget
        Solves so far in the search for the next instability, and their limit.
    iterations, factorisations
        Work since the last located instability.
    """

    path: Path
    base: Point
    tolerance: float
    budget: LocationBudget
    iterations: int = 0
    factorisations: int = 0

    def locate(self, low: Point, high: Point, halvings: int) -> Iterator[Instability]:
        """Yield the instabilities between two points, in the order of the path.

        A bracket with several instabilities is halved until each half has one. Then interpolation
        locates a fold, and a regular system or bisection a bifurcation. Collective.

        Parameters
        ----------
        halvings
            Number of halvings that are left; without any, several instabilities count as one.

        Raises
        ------
        PathStopped
            If a solve fails, or the step has left the branch.
        UnseparatedInstabilities
            If no point is found between several instabilities.
        """
        changed_pivots = abs(high.negative_pivots - low.negative_pivots)
        turns_back = low.dmu * high.dmu < 0
        if changed_pivots == 0 and not turns_back:
            return
        self.path.progress.doing("locating an instability")
        single = changed_pivots == 1 or not halvings
        if single and turns_back:
            fold = self.locate_fold(low, high)
            # if the inertia changes by another number than one, the fold's own tangent is factored
            point = self.with_work(fold) if changed_pivots == 1 else self.with_own_inertia(fold)
            # the tangent at a fold is singular, so that rounding would decide on its inertia: the
            # fold has the inertia of the first end
            point = replace(
                point,
                negative_pivots=low.negative_pivots,
                negative_pivots_held=low.negative_pivots_held,
            )
            yield Instability(point, "fold")
        elif single:
            point = self.solve_bifurcation(low, high) or self.bisect_bifurcation(low, high)
            # at a bifurcation the load still changes along the path; at a fold it does not
            if abs(point.dmu) < FOLD_SLOPE_RATIO * abs(low.dmu):
                raise PathStopped("the step passed a fold and left the branch", low)
            yield Instability(point, "bifurcation")
        else:
            middle = self.middle(low, high)
            if middle is None:
                self.refuse_apart(low, high)
                raise UnseparatedInstabilities(low, high)
            yield from self.locate(low, middle, halvings - 1)
            yield from self.locate(middle, high, halvings - 1)

    def solve(self, s: float, low: Point, high: Point) -> Point:
        """Return the point at s on the branch between two points.

        Its numbers of unstable directions are not valid; this saves factorisations.

        Raises
        ------
        PathStopped
            If the solve fails.
        """
        point = self.try_solve(s, low, high, needs_inertia=False)
        if isinstance(point, str):
            raise PathStopped(f"locating an instability: {point}", low)
        return point

    def try_solve(
        self, s: float, low: Point, high: Point, *, needs_inertia: bool = True
    ) -> Point | str:
        """Return the point at s on the branch between two points, or the reason why there is none.

        Parameters
        ----------
        needs_inertia
            Whether the numbers of unstable directions of the result must be valid.
        """
        point = self.path.correct_between(s, low, high, self.base, needs_inertia=needs_inertia)
        if isinstance(point, str):
            return point
        self.iterations += point.iterations
        self.factorisations += point.factorisations
        if self.is_on_another_branch(point, low, high):
            return "the iteration has left the branch"
        return point

    def is_on_another_branch(self, point: Point, low: Point, high: Point) -> bool:
        """Return whether a point lies far from the cubic through two points and their tangents."""
        if self.base.across:  # no cubic goes around a kink
            return False
        system, cubic = self.path.system, self.path.interpolated_state(point.s, low, high)
        deviation = max_abs(system.comm, point.state.u - cubic.u)
        chord = max_abs(system.comm, high.state.u - low.state.u)
        return deviation > max(MAX_DEVIATION_FROM_CUBIC * chord, ZERO_DISPLACEMENT * system.length)

    def middle(self, low: Point, high: Point) -> Point | None:
        """Return a point between two others, with the inertia of its own tangent.

        Several fractions of the bracket are tried: rounding near a singular tangent may hide some
        points. If no solve succeeds, or the budget is exhausted, the result is None.
        Each trial counts in the budget.
        """
        for fraction in MIDDLE_FRACTIONS:
            if self.budget.exhausted:
                return None
            self.budget.solves += 1
            point = self.try_solve(low.s + fraction * (high.s - low.s), low, high)
            if not isinstance(point, str):
                return self.path.with_own_inertia(point, self.base)
        return None

    def solve_bifurcation(self, low: Point, high: Point) -> Point | None:
        """Return the bifurcation between two points as a solution of a regular system.

        The critical modes of both ends are tried as first null vectors. A solution counts if it
        lies between the ends in s and its inertia fits theirs.

        Returns
        -------
        The point; None if there is no such solution.
        """
        path = self.path
        # the regular system needs a symmetric tangent, and a bifurcation without imperfection
        if path.newton.factorisation.skewed or self.budget.apart:
            return None
        try:
            modes = [critical_mode(path.newton, end.state) for end in (low, high)]
        except NoEigenpair:
            return None
        a, b = (mode.eigenvalue for mode in modes)
        # t: place of the zero between both ends by linear interpolation of the eigenvalue; two
        # eigenvalues of one sign do not show it, and the middle is taken
        t = a / (a - b) if a * b < 0 else 0.5
        guess = path.interpolated_state(low.s + t * (high.s - low.s), low, high)
        # the first tangent takes the stress interpolated between both ends
        stress_sources = [(1 - t, low.state.u), (t, high.state.u)]
        least_pivots, most_pivots = sorted(end.negative_pivots for end in (low, high))
        for mode in sorted(modes, key=lambda mode: abs(mode.eigenvalue)):
            solve = partial(self._regular_solution, guess, mode.vector, stress_sources, low, high)
            # a point, or the reason why there is none; the journal records it
            point = path.recorded(solve)
            if isinstance(point, str):
                continue
            if not min(low.s, high.s) <= point.s <= max(low.s, high.s):
                continue
            # the inertia of the point does not count its null vector: it is at least that of one
            # end, and below that of the other end
            if not least_pivots <= point.negative_pivots < most_pivots:
                continue
            if not self.is_on_another_branch(point, low, high):
                return self.with_work(point)
        return None

    def _regular_solution(
        self,
        guess: State,
        phi: Vector,
        stress_sources: Sequence[WeightedDisplacement],
        low: Point,
        high: Point,
    ) -> Point | str:
        """Solve the regular system of a bifurcation, and give the result the tangent of this path.

        Parameters
        ----------
        guess
            A state near the bifurcation.
        stress_sources
            Pairs of a weight and a displacement. In the first tangent the weighted sum of their
            stresses replaces the stress of the guess.
        phi
            A vector near the null vector.
        low, high
            Points on both sides, whose tangents tell this path from the one that crosses it.

        Returns
        -------
        The point with its error estimates, or the reason why there is none.
        """
        path = self.path
        try:
            bifurcation = find_bifurcation(path.newton, guess, phi, path.name, stress_sources)
        except BifurcationLost:
            return "no bifurcation was found"
        self.iterations += bifurcation.iterations
        self.factorisations += bifurcation.factorisations
        # two branches cross here: their tangents are combinations of the null vector and of the
        # response to the load. The combination nearest to the path's tangent continues this path
        state, tangent = bifurcation.state, self._interpolated_tangent(bifurcation.state, low, high)
        direction = nearest_combination(
            path.metric, tangent, [(bifurcation.phi, 0.0), (-bifurcation.response, 1.0)]
        )
        point = path.point_at_state(state, direction, self.base, bifurcation.unstable)
        return replace(point, error=bifurcation.error, load_error=bifurcation.load_error)

    def _interpolated_tangent(self, state: State, low: Point, high: Point) -> Direction:
        """Return the tangent (du, dmu) of the path near a state between two points.

        It is interpolated between their tangents, linearly in the amplitude.
        """
        name = self.path.name
        t = (state.mu[name] - low.state.mu[name]) / (high.state.mu[name] - low.state.mu[name])
        t = min(max(t, 0.0), 1.0)
        return (1 - t) * low.du + t * high.du, (1 - t) * low.dmu + t * high.dmu

    def bisect_bifurcation(self, low: Point, high: Point) -> Point:
        """Return the last point before an instability, by bisection.

        Each half is judged by the inertia of the point between them. Bisection ends at the
        tolerance, or where no point is found between both ends. The width of the last bracket in
        the amplitude is the point's `load_error`.

        Raises
        ------
        BranchesApart
            If both ends prove to lie on different branches.
        """
        name = self.path.name
        for _ in range(MAX_TRIALS):
            width = abs(high.state.mu[name] - low.state.mu[name])
            if not width > self.tolerance * abs(low.state.mu[name]):
                break
            middle = self.middle(low, high)
            if middle is None:
                break
            if middle.negative_pivots == low.negative_pivots:  # not yet past the instability
                low = middle
            else:
                high = middle
            self.refuse_apart(low, high)
            if not self.path.may_be_one_arc(low, high):
                raise BranchesApart(low, high)
        width = abs(high.state.mu[name] - low.state.mu[name])
        return replace(self.with_work(low), load_error=width)

    def refuse_apart(self, low: Point, high: Point) -> None:
        """Raise if two points are too far apart to lie on one path.

        An imperfect bifurcation has two paths close to each other, of different inertia. A bracket
        with an end on each shrinks to nothing in s and contains no instability.

        Raises
        ------
        BranchesApart
            If the points lie on different paths.
        """
        if self.path.are_apart(low, high, ROUNDING_NEAR_NEUTRAL_MODE):
            raise BranchesApart(low, high)

    def with_work(self, point: Point) -> Point:
        """Return a located point with the work that it took, and reset all counts of work."""
        located = replace(point, iterations=self.iterations, factorisations=self.factorisations)
        self.iterations = self.factorisations = 0
        self.budget.renew()
        return located

    def with_own_inertia(self, point: Point) -> Point:
        """Return a located point with its own tangent and inertia, and the work that it took."""
        self.factorisations += 1
        located = self.with_work(self.path.with_own_inertia(point, self.base))
        return replace(located, load_error=point.load_error)

    def locate_fold(self, low: Point, high: Point) -> Point:
        """Return the point between two others where dmu/ds is zero.

        The cubic mu(s) through both ends has a stationary place between them. The path is solved at
        that s, and the solution replaces one end. This is repeated until the estimated error of the
        amplitude is below the tolerance.

        Raises
        ------
        PathStopped
            If a solve fails.
        """
        name = self.path.name
        for _ in range(MAX_TRIALS):
            s = _stationary_place(low, high, name, kink if self.base.across else stationary)
            point = self.solve(s, low, high)
            mu = point.state.mu[name]
            is_before = point.dmu * low.dmu > 0
            opposite_end = high if is_before else low
            curvature = (opposite_end.dmu - point.dmu) / (opposite_end.s - point.s)
            # near its extremum mu(s) is a parabola, with this curvature
            load_error = abs(point.dmu**2 / (2 * curvature))
            point = replace(point, load_error=load_error)
            if load_error <= self.tolerance * abs(mu):
                return point
            low, high = (point, high) if is_before else (low, point)
        return point

    def distance_to_zero(
        self, point: Point, stability: Stability, slope: float, upper_bound: float
    ) -> float:
        """Estimate how far the load of a point is from the zero of its critical eigenvalue.

        The estimate includes the rounding of the tangent: the scatter of the eigenvalue when u is
        rounded differently.

        Parameters
        ----------
        stability
            Gives the tangent with that eigenvalue.
        slope
            Derivative of the eigenvalue by the load; zero if it is unknown.
        upper_bound
            Upper bound of the distance, which is returned if the slope is unknown.
        """
        u = point.state.u
        # two copies of u, with each entry one unit in the last place larger or smaller, at random
        random = np.random.default_rng(self.path.system.comm.rank)
        rounded = [u + signs * np.spacing(u) for signs in random.choice([-1.0, 1.0], (2, u.size))]
        eigenvalues = [
            critical_mode(stability, State(v, point.state.mu)).eigenvalue for v in [u, *rounded]
        ]
        if not slope:
            return upper_bound
        # the eigenvalue itself, and the scatter of the three
        error = abs(eigenvalues[0]) + LOAD_ERROR_FACTOR * np.ptp(eigenvalues)
        return float(error / abs(slope))

    def locate_zero_eigenvalue(self, low: Point, high: Point, stability: Stability) -> Point:
        """Return the point between two others where an eigenvalue of `stability` is zero.

        The Illinois variant of regula falsi is of order 1.44: if two successive guesses agree to
        tolerance^(3/4), the error of the second is below the tolerance. If the eigenvalue there
        shows a larger error, the search goes on as long as each step halves that error. An error
        that is not halved is rounding. The `load_error` of the point is valid even if the tolerance
        is not reached.

        Parameters
        ----------
        stability
            The tangent whose eigenvalue changes sign; it may differ from the tangent of the path.

        Raises
        ------
        NoEigenpair
            If the eigenpair nearest to zero is not found at a point.
        """
        name, last_s = self.path.name, np.inf
        best: Point | None = None  # the last guess that agreed with the one before
        low_mode = critical_mode(stability, low.state)
        high_mode = critical_mode(stability, high.state)
        bracket = _EigenvalueBracket(name, low, high, low_mode.eigenvalue, high_mode.eigenvalue)
        for _ in range(MAX_TRIALS):
            low, high = bracket.low, bracket.high
            result = self.try_solve(bracket.next_place, low, high)
            point = self.middle(low, high) if isinstance(result, str) else result
            if point is None:  # the path's own tangent is singular there as well
                break
            mu = point.state.mu[name]
            # in the load: distance from the last guess, and width of the bracket
            load_change = abs(point.s - last_s) * abs(point.dmu)
            width = abs(high.s - low.s) * abs(point.dmu)
            # two successive guesses agree
            if load_change <= self.tolerance**0.75 * abs(mu) and bracket.changes_sign:
                load_error = self.distance_to_zero(point, stability, bracket.slope, width)
                zero = replace(point, load_error=load_error)
                stalled = best and load_error > best.load_error / 2
                if stalled or load_error <= self.tolerance * abs(mu):
                    return min(best or zero, zero, key=lambda point: point.load_error)
                best = zero  # the next guess, from the other side, may be nearer
            # no two guesses agree, but the bracket itself is small enough
            if width <= self.tolerance * abs(mu) and not best:
                load_error = self.distance_to_zero(point, stability, bracket.slope, width)
                return replace(point, load_error=max(width, load_error))
            # the point replaces the end that has the same inertia
            last_s, mode = point.s, critical_mode(stability, point.state)
            is_behind = mode.negative_pivots != low_mode.negative_pivots
            bracket.replace_end(point, mode.eigenvalue, is_high=is_behind)
        low, high = bracket.low, bracket.high
        return best or replace(low, load_error=abs(high.state.mu[name] - low.state.mu[name]))


class _EigenvalueBracket:
    """Two points between which an eigenvalue is zero, and the Illinois variant of regula falsi.

    Parameters
    ----------
    name
        The amplitude, which is the load.
    low, high
        The points.
    low_value, high_value
        The eigenvalues there.

    Private fields: `_low_end` and `_high_end` are pairs of the load and the eigenvalue at the
    points. `_low_value` and `_high_value` are the values that are interpolated: the eigenvalues,
    one of which may be halved. `_last_side` tells which point was replaced last: 1 for `high`, -1
    for `low`, 0 for none.
    """

    def __init__(
        self, name: str, low: Point, high: Point, low_value: float, high_value: float
    ) -> None:
        self.low, self.high, self._name, self._last_side = low, high, name, 0
        self._low_value, self._high_value = low_value, high_value
        self._low_end = low.state.mu[name], low_value
        self._high_end = high.state.mu[name], high_value

    @property
    def changes_sign(self) -> bool:
        """Whether the two eigenvalues have opposite signs; else they belong to different modes."""
        return self._low_value * self._high_value < 0

    @property
    def next_place(self) -> float:
        """The s at which to solve next: the zero by linear interpolation, or else the middle."""
        a, b = self._low_value, self._high_value
        t = a / (a - b) if self.changes_sign else 0.5
        return self.low.s + t * (self.high.s - self.low.s)

    @property
    def slope(self) -> float:
        """Slope d(eigenvalue)/d(load) between the points.

        It is zero if both eigenvalues have one sign: then they do not belong to one mode.
        """
        (low_load, low_eigenvalue), (high_load, high_eigenvalue) = self._low_end, self._high_end
        return (
            (high_eigenvalue - low_eigenvalue) / (high_load - low_load)
            if low_eigenvalue * high_eigenvalue < 0 and low_load != high_load
            else 0.0
        )

    def replace_end(self, point: Point, eigenvalue: float, *, is_high: bool) -> None:
        """Replace one end by a point with its eigenvalue: `high` if `is_high`, else `low`.

        If the other end stays for the second time in turn, its interpolated value is halved.
        """
        load = point.state.mu[self._name]
        if is_high:
            self.high, self._high_value, self._high_end = point, eigenvalue, (load, eigenvalue)
            self._low_value = self._low_value / 2 if self._last_side == 1 else self._low_value
            self._last_side = 1
        else:
            self.low, self._low_value, self._low_end = point, eigenvalue, (load, eigenvalue)
            self._high_value = self._high_value / 2 if self._last_side == -1 else self._high_value
            self._last_side = -1


def _stationary_place(
    low: Point, high: Point, name: str, find: Callable[[float, float, float], float]
) -> float:
    """Return the s between two points where mu(s) of the amplitude `name` is stationary.

    Parameters
    ----------
    find
        Called with the mean slope of mu and its slopes at both ends. It returns the fraction of the
        interval at which mu is stationary, 0 to 1: `stationary` or `kink`.
    """
    length = high.s - low.s
    mean_slope = (high.state.mu[name] - low.state.mu[name]) / length
    return low.s + length * find(mean_slope, low.dmu, high.dmu)


def locate_bifurcation(
    path: Path,
    stable: Point,
    unstable: Point,
    stability: Stability,
    tolerance: float = LOAD_TOLERANCE,
) -> Point:
    """Locate where another tangent than the path's own is singular, between two successive points.

    Collective.

    Parameters
    ----------
    stable, unstable
        The points; the arc length of both is measured from the first.
    stability
        The tangent of symmetry-breaking modes, which has other inertia at both points.
    tolerance
        Relative error of the amplitude.

    Returns
    -------
    The point with its own inertia, and with the estimated error of the amplitude.

    Raises
    ------
    PathStopped
        If Newton's method fails between the two points, or no eigenpair is found.
    """
    budget = LocationBudget(path.options.max_location_solves)
    locator = _InstabilityLocator(path, stable, tolerance, budget)
    try:
        zero = locator.locate_zero_eigenvalue(stable, path.relative_to(stable, unstable), stability)
        return locator.with_own_inertia(zero)
    except NoEigenpair as e:
        raise PathStopped(f"locating an instability: {e}", stable) from None


@dataclass(frozen=True)
class ContinuationGoal:
    """The end of a continuation run, and the points that are requested before it.

    Attributes
    ----------
    until
        "limit": at the first instability; "bifurcation": at the first bifurcation, through folds;
        both at the last target at the latest; "target": there; "points": after `steps` steps.
    targets
        Requested points: values of s or, on a path by arc length, of `quantity`.
    quantity
        "load": the amplitude; "conjugate": the displacement on which it does work.
    steps
        With every other `until`, the largest number of steps.
    sense
        Direction of s if there is no target.
    """

    until: Until
    targets: Sequence[float] = ()
    quantity: Quantity = "load"
    steps: int = MAX_STEPS
    sense: float = 1.0


class ContinuationRun:
    """A run along a path to its goal; iterate over it once.

    Between each two points of the path it locates the instabilities, and on a path by arc length it
    solves at the targets.

    Parameters
    ----------
    start
        The first point of the path.
    renew
        Called with two successive points. It returns the state of the first with other values of
        the amplitudes that the path does not vary, from which the run continues in place of the
        second; None if the second is accepted. It raises `StepTooLong` if the second must not be
        accepted. Where no solution is found with the other values it is called again, and may
        accept the second point then.
    refuse
        Called with each located instability or target. It returns why the run must not end at that
        point, or "" if it may. The step that has passed the point is repeated in shorter ones, at
        whose ends `renew` is called.

    Attributes
    ----------
    points
        The start, the steps so far, and the instability or target that ended the run.
    done
        Whether the last point ends the run.
    clusters
        Pairs of the last point before and the first point behind instabilities that were not
        separated. Such a cluster counts as one instability, at the first of both points; its width
        is the error of the amplitude.

    The private field `_folds` has the located folds, `_budget` the work on the next instability,
    `_counted_solves` the number of solves of the path up to the last search. `_by_arc` tells
    whether s is the arc length.
    """

    def __init__(
        self,
        path: Path,
        start: Point,
        goal: ContinuationGoal,
        renew: Callable[[Point, Point], State | None] | None = None,
        refuse: Callable[[Point], str] = lambda point: "",
    ) -> None:
        """Begin at the start; the located folds are kept, to detect a closed loop."""
        self._refuse = refuse
        self.path, self.goal, self.points, self._renew = path, goal, [start], renew
        self.done = False
        self.clusters: list[tuple[Point, Point]] = []
        self._folds: list[Point] = []
        self._budget = LocationBudget(path.options.max_location_solves)
        self._counted_solves = 0  # of the path, up to the last search

    def __iter__(self) -> Iterator[tuple[Label, Point]]:
        """Yield pairs of a label and a point, in the order of the path.

        The start is not yielded. Where `renew` or `refuse` rejects the end of a step, the path
        continues from the last point in shorter steps. Collective.

        Raises
        ------
        PathStopped
            If the path is lost, returns to a fold that it has passed, or needs more steps than
            allowed.
        """
        options = self.path.options
        # the length of the next step where the last one is rejected, and the reason for that
        shorter_step, reason = None, ""
        while True:
            # the next points of the path; the base of a step is the point before it
            for point, is_target in self._steps():
                low, shorter_step = self.path.base_before(self.points[-1], point), None
                # `renew` has changed amplitudes at the begin of the step, or refuses its end: the
                # length of the step that follows instead, and why (or "")
                renewal = self._renewed_step(low, point)
                if renewal:
                    shorter_step, new_reason = renewal
                    reason = new_reason or reason
                    break
                # instabilities and targets in the step, which may end before its planned end
                end, events, shorter_step, new_reason = self._end_of_step(low, point)
                reason = new_reason or reason
                if end is None:
                    break
                for label, event, self.done in events:  # each tells whether it ends the run
                    yield label, event
                    if label == "fold":
                        self._refuse_loop(event)
                    if self.done:
                        self.points.append(event)
                        return
                # the end of the step itself
                self.points.append(end)
                has_all_points = self.goal.until == "points" and len(self.points) > self.goal.steps
                self.done = not self._remaining_targets() or has_all_points
                yield ("target" if is_target and end is point else "step"), end
                if has_all_points:
                    return
                self._refuse_more_steps()
                if shorter_step is not None:
                    break
            if shorter_step is None:  # the path has reached its end
                return
            if shorter_step < options.smallest:
                raise PathStopped(reason, self.points[-1])
            # a step must still reach behind instabilities between which there are no points
            several = options.max_step_past_several if self._budget.clustered else 0.0
            self.path = self.path.with_step_options(
                replace(options, first=shorter_step, several=several)
            )

    def _refuse_more_steps(self) -> None:
        """Raise `PathStopped` if the run has taken as many steps as allowed."""
        goal, last_point = self.goal, self.points[-1]
        if len(self.points) > goal.steps:
            message = f"{goal.steps} steps have not reached the {goal.until}"
            raise PathStopped(message, last_point, final=True)

    def _end_of_step(
        self, low: Point, point: Point
    ) -> tuple[Point | None, list[tuple[Label, Point, bool]], float | None, str]:
        """Return where a step ends, with the events before.

        A step over two branches that pass near each other ends before them: shorter steps find the
        way from there.

        Parameters
        ----------
        low, point
            The begin of the step, and its planned end.

        Returns
        -------
        end
            The end; None if the step must be repeated in a shorter one.
        events
            For each event its label, its point, and whether it ends the run.
        next_step
            Length in s of the next step, and its reason; None and "" if steps go on as planned.
        """
        events, refusal = self._accepted_events(low, point)
        if not refusal:
            return point, events, None, ""
        apart = self._budget.apart
        if apart and (apart.point.s - low.s) * (point.s - low.s) > 0:
            end = self.path.as_base(apart.point)
            events, refusal_before = self._accepted_events(low, end)
            if not (refusal_before or self._renewed_step(low, end)):
                next_step = max(abs(apart.high.s - end.s) / 4, self.path.options.smallest)
                return end, events, next_step, refusal
        return None, [], abs(point.s - low.s) / 4, refusal

    def _renewed_step(self, low: Point, point: Point) -> tuple[float, str] | None:
        """Replace the first of two points in `points`, if `renew` changes amplitudes there.

        Returns
        -------
        The length in s of the next step from the first point, and the reason if the second was
        refused, else ""; None if the second is accepted.
        """
        length = abs(point.s - low.s)
        try:
            state = self._renew(low, point) if self._renew else None
        except StepTooLong as e:
            return length / 4, str(e)
        if not state:
            return None
        try:
            self.points[-1] = self.path.recorrected(low, state)
        except PathStopped as e:
            # no solution with other amplitudes. Unless `renew` now accepts the second point, the
            # step is shortened: nearer to the first point the amplitudes change by less
            if self._renew and self._renew(low, point):
                return length / 4, str(e)
            return None
        self._budget.end = None  # it has the previous amplitudes
        return length, ""

    def _steps(self) -> Iterator[tuple[Point, bool]]:
        """Yield the next points of the path, each with whether it is a target.

        Where no point is found before a cluster (instabilities that could not be separated), the
        end of the earlier step that passed the cluster is yielded instead, once.

        Raises
        ------
        PathStopped
            If a step of the smallest length fails.
        """
        try:
            targets = self._remaining_targets()
            yield from self.path.continue_to(self.points[-1], targets, self._step_end)
        except PathStopped:
            current, budget = self.points[-1], self._budget
            if not (budget.end and budget.clustered):
                raise
            end = self.path.as_base(self.path.measured_from(current, budget.end))
            # this end is tried once: with no repeated searches left, instabilities that are still
            # not separated count as a cluster
            budget.repeated, budget.end = MAX_REPEATED_SEARCHES, None
            yield end, end.s in self._remaining_targets()
            yield from self._steps()

    def _refuse_loop(self, fold: Point) -> None:
        """Remember a fold, and raise if the path has passed it before.

        Two successive folds may be close, so the last one is not compared.

        Raises
        ------
        PathStopped
            If the path has come back to an earlier fold: it is a closed loop.
        """
        name, u = self.path.name, fold.state.u
        mu = fold.state.mu[name]
        for passed in self._folds[:-1]:
            distance = self.path.metric.norm(u - passed.state.u, mu - passed.state.mu[name])
            if distance < SAME_FOLD_DISTANCE:
                message = (
                    "the path has come back to this fold: a closed loop, which leads nowhere else"
                )
                raise PathStopped(message, fold, final=True)
        self._folds.append(fold)

    @property
    def _by_arc(self) -> bool:
        """Whether s is the arc length, so that steps do not end at targets."""
        return self.path.control == "arc"

    def _remaining_targets(self) -> list[float]:
        """Return the values of s that the path has yet to reach, in order; infinite without an end.

        On a path by arc length the targets are located between its points, so s has no end.
        """
        goal, s = self.goal, self.points[-1].s
        if self._by_arc:
            return [np.inf]
        if not goal.targets:
            return [float(np.copysign(np.inf, goal.sense))]
        sense = goal.targets[-1] - self.points[0].s
        return [t for t in goal.targets if (t - s) * sense > 0]

    def _step_end(self, s: float, predictors: Sequence[Point]) -> float:
        """Return the s at which a planned step to `s` ends; `Path.continue_to` calls it.

        A path by arc length ends its step close behind the last target.

        Parameters
        ----------
        predictors
            The points from which the end of the step is extrapolated.
        """
        goal = self.goal
        ends_at_target = bool(goal.targets) and goal.until != "points"
        if self._by_arc and ends_at_target:
            return end_near_last_target(self.path, goal.quantity, goal.targets[-1], s, predictors)
        return s

    def _accepted_events(
        self, low: Point, high: Point
    ) -> tuple[list[tuple[Label, Point, bool]], str]:
        """Return the events between two points, and why the step must be repeated in shorter ones.

        Returns
        -------
        For each event its label, its point, and whether it ends the run; and the reason, "" if the
        step is accepted.
        """
        try:
            events = self._events_between(low, high)
        except PathStopped as e:  # the step had left the branch
            return [], str(e) if isinstance(e, TargetMissed) else "an instability cannot be located"
        # the first reason that is not empty, or ""
        refusals = (self._refuse(point) for _, point, _ in events)
        return events, next(filter(None, refusals), "")

    def _events_between(self, low: Point, high: Point) -> list[tuple[Label, Point, bool]]:
        """Return the instabilities and the targets between two points, in the order of the path.

        Targets are solved for only on a path by arc length; elsewhere steps end at them.

        Returns
        -------
        For each event its label, its point, and whether it ends the run.
        """
        events: list[tuple[Label, Point, bool]] = []
        for instability in self._located(low, high):
            ends_run = self.goal.until in ("limit", instability.kind)
            events.append((instability.kind, instability.point, ends_run))
            if ends_run:
                break
        if self._by_arc and self.goal.targets:
            folds = [point for label, point, _ in events if label == "fold" and point.s != low.s]
            ends_run = self.goal.until != "points"
            for target, point in self._targets_around(low, folds, high):
                events.append(("target", point, ends_run and target == self.goal.targets[-1]))
        return sorted(events, key=lambda event: abs(event[1].s - low.s))

    def _targets_around(
        self, low: Point, folds: Sequence[Point], high: Point
    ) -> Iterator[tuple[float, Point]]:
        """Yield the targets between two points, each with its value and its point.

        The folds between the points divide the path: a target just below a fold is passed on both
        sides of it.
        """
        # the point before `low`, then `low`: it stands for the last of `points`, from which it may
        # differ in the direction along which arc length is measured
        predictors = [*self.points[-2:-1], low]
        for end in (*(self.path.as_base(fold) for fold in folds), high):
            # the targets between the last two of these points; all of them serve a guess
            predictors = [*predictors[-2:], end]
            yield from targets_between(
                self.path, self.goal.quantity, self.goal.targets, self.goal.sense, predictors
            )

    def _located(self, low: Point, high: Point) -> Iterator[Instability]:
        """Yield the instabilities between two successive points, in the order of the path.

        A search that ends between several instabilities is repeated in shorter steps. If shorter
        steps do not separate them either, the instabilities count as one cluster.

        Raises
        ------
        UnseparatedInstabilities
            If the step must be repeated in shorter ones.
        PathStopped
            If a solve between the points fails.
        """
        budget, step = self._budget, high.s - low.s
        is_beyond = budget.end is not None and (high.s - budget.end.s) * step > 0
        if is_beyond and not high.has_instability_since(low):
            budget.renew()  # shorter steps have passed the place: there was nothing on this path
        if budget.end:  # the steps since the last search
            budget.solves += self.path.solves - self._counted_solves
        self._counted_solves = self.path.solves
        try:
            yield from instabilities(self.path, low, high, budget=budget)
        except InstabilityNotLocated as e:
            self._counted_solves = self.path.solves
            budget.end, budget.clustered, budget.apart = high, True, None
            if not isinstance(e, BranchesApart):
                budget.repeated += 1
            elif self._pass_near(e.point, e.high):
                budget.end, budget.apart = e.high, e
            else:
                budget.clustered = False
            is_shortest = abs(step) / 4 < self.path.options.smallest
            may_repeat = budget.repeated <= MAX_REPEATED_SEARCHES and not budget.exhausted
            if not budget.clustered or (may_repeat and not is_shortest):
                raise
            budget.renew()
            yield self._cluster(e.point, e.high)
            # the rest of the step, from the first point behind the cluster
            base_behind = self.path.as_base(e.high)
            yield from self._located(base_behind, self.path.measured_from(base_behind, high))
        except PathStopped:
            budget.end, budget.clustered, budget.apart = high, False, None
            self._counted_solves = self.path.solves
            raise

    def _pass_near(self, low: Point, high: Point) -> bool:
        """Return whether two points on different branches are near each other.

        Then the branches are those of a perturbed bifurcation. Where shells touch, branches part
        for other reasons.
        """
        system, newton = self.path.system, self.path.newton
        distance = max_abs(system.comm, high.state.u - low.state.u)
        return not newton.options.has_onsets and distance < MAX_BRANCH_DISTANCE * system.length

    def _cluster(self, low: Point, high: Point) -> Instability:
        """Record the instabilities between two points as a cluster; return them as one instability.

        It is a fold if the amplitude turns back between the points. Its error is the distance of
        both points in the amplitude.
        """
        name = self.path.name
        point = replace(low, load_error=abs(high.state.mu[name] - low.state.mu[name]))
        self.clusters.append((point, high))
        return Instability(point, "fold" if low.dmu * high.dmu < 0 else "bifurcation")

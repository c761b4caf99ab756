"""Stability against symmetry-breaking modes along a path: their number, and where it changes.

A model with symmetry excludes modes that break it. `StabilityMonitor` evaluates the inertia of
their tangents at points of the path, in families of modes that share a tangent, and locates the
points where a mode becomes neutral.

Modes of one family share a tangent, for example all waves of one number; a mode is neutral where
its eigenvalue is zero, and unstable below. Inertia is the number of unstable directions of a
tangent. An evaluation has these numbers at one point of the path, `counts` by family; a crossing is
a point where a mode is neutral. The softest mode has the eigenvalue of least magnitude; it softens
as that falls. Arc length is measured anew from the first point of each segment. Results pass
through the path's journal, from which an interrupted run resumes.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from typing import Protocol

import numpy as np

from magshell_fenicsx.continuation.continuation_run import locate_bifurcation
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.modes import Stability
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import PathStopped, Point, RecordedValues
from magshell_fenicsx.continuation.system import State, Vector, dot

# halvings of a step in which several modes of a family change; what is left counts as one
MAX_HALVINGS = 12
# factor by which the softest mode may soften faster than between the last two evaluations
MAX_SOFTENING_RATIO = 2.0
MAX_SKIPPED = 4  # successive points without an evaluation
# halvings of a step between whose ends modes may soften and recover
MAX_RECOVERY_HALVINGS = 3
ITERATIONS_FROM_LAST_MODE = 4  # inverse iterations from the last softest mode
ITERATIONS_FROM_RANDOM = 12  # inverse iterations if there is no such mode
# fraction of a general vector in the start vector, so that modes of another symmetry are found
GENERAL_FRACTION = 0.1


@dataclass(frozen=True)
class InertiaChange:
    """The numbers of unstable directions of a family of modes before and after a step.

    Attributes
    ----------
    stability
        The tangent of the family at any state.
    """

    stability: Stability
    count_before: int
    count_after: int


class PathSegment:
    """The path between two successive points, with all points on it that were computed.

    Arc length is measured along the tangent of the first point. Methods that solve are collective.

    Parameters
    ----------
    low, high
        The two points.

    Private fields: `_low` is the first point, as base of the arc length of all others. `_points`
    are all known points of the segment, in the order of the path.
    """

    def __init__(self, path: Path, low: Point, high: Point) -> None:
        self._path, self._low = path, path.base_before(path.as_base(low), high)
        self._points = [self._low, path.measured_from(self._low, high)]

    def distance(self, point: Point) -> float:
        """Return the distance of a point from the first one, in s."""
        return abs(self._path.measured_from(self._low, point).s - self._low.s)

    def middle(self) -> Point | None:
        """Return the point half way in s between both ends; None if it is not found.

        Its numbers of unstable directions are not valid.
        """
        try:
            return self._middle(self._points[0], self._points[-1], solve=True, needs_inertia=False)
        except PathStopped:
            return None

    def estimated_middle(self) -> Point | None:
        """Estimate the point half way in s without a solve; None if that is too uncertain."""
        low, high = self._points[0], self._points[-1]
        estimate = self._path.estimate_between(
            (low.s + high.s) / 2, low, self._path.relative_to(low, high), low
        )
        return None if isinstance(estimate, str) else estimate

    def crossings(self, change: InertiaChange) -> Iterator[tuple[Point, int]]:
        """Yield each point at which a mode of a family is neutral, in the order of the path.

        Yields
        ------
        The point, and the change of the number of unstable directions there.

        Raises
        ------
        PathStopped
            If a point between the ends is not found.
        """
        ends = self._points[0], self._points[-1]
        counts = {id(ends[0]): change.count_before, id(ends[1]): change.count_after}
        yield from self._crossings_between(*ends, change, counts, MAX_HALVINGS)

    def _crossings_between(
        self, low: Point, high: Point, change: InertiaChange, counts: dict[int, int], halvings: int
    ) -> Iterator[tuple[Point, int]]:
        """Yield each crossing between two points, with its change of the number of unstable modes.

        Parameters
        ----------
        low, high
            Two points of the segment, in the order of the path.
        change
            The tangent of the family, and its numbers at the ends of the whole segment.
        counts
            Identity `id` of a point -> number of unstable directions of the family there; new
            points are added.
        halvings
            Number of halvings that are left; without any, several crossings count as one.
        """
        count_before, count_after = counts[id(low)], counts[id(high)]
        if count_before == count_after:
            return
        # several crossings are separated at a point between them; for one no new point is solved
        are_several = abs(count_after - count_before) > 1
        middle = self._middle(low, high, solve=are_several and halvings > 0)
        if middle is None:
            base = self._path.as_base(low)
            crossing = locate_bifurcation(
                self._path, base, self._path.measured_from(base, high), change.stability
            )
            self._insert(crossing)
            yield crossing, count_after - count_before
        else:
            counts[id(middle)] = change.stability.factor_at(middle.state).negative_pivots
            yield from self._crossings_between(low, middle, change, counts, halvings - 1)
            yield from self._crossings_between(middle, high, change, counts, halvings - 1)

    def _middle(
        self, low: Point, high: Point, *, solve: bool, needs_inertia: bool = True
    ) -> Point | None:
        """Return a point between two points of the segment, preferably one that is known.

        Parameters
        ----------
        solve
            Whether a new point half way is computed if none is known.
        needs_inertia
            Whether the numbers of unstable directions of a new point must be valid.

        Returns
        -------
        The point; None if none is known and `solve` is not set.

        Raises
        ------
        PathStopped
            If the solve fails.
        """
        low_index, high_index = self._index_of(low), self._index_of(high)
        if high_index - low_index > 1:
            return self._points[(low_index + high_index) // 2]
        if not solve:
            return None
        path, s = self._path, (low.s + high.s) / 2
        middle = path.correct_between(
            s, low, path.relative_to(low, high), self._low, needs_inertia=needs_inertia
        )
        if isinstance(middle, str):
            raise PathStopped(f"locating an instability: {middle}", low)
        return self._insert(middle)

    def _index_of(self, point: Point) -> int:
        """Return the place among the points of the segment where this same object is."""
        return next(i for i, p in enumerate(self._points) if p is point)

    def _insert(self, point: Point) -> Point:
        """Insert a point in the order of the path, and return it with its s measured from `low`."""
        measured = self._path.measured_from(self._low, point)
        self._points.append(measured)
        self._points.sort(key=lambda p: abs(p.s - self._low.s))
        return measured


class ModeFamily(Protocol):
    """Symmetry-breaking modes that share a tangent; a `modes.Stability`."""

    @property
    def label(self) -> str:
        """Name of the family in records, "antisymmetric" or "m = 7"."""

    def factor_at(self, state: State) -> Factorisation:
        """Factor the family's tangent at a state of the model."""


class FamilyTangents(Protocol):
    """The tangents of several families of modes, as one array that is linear in the matrices."""

    def sampled_tangents(self, state: State) -> Vector:
        """Return the array of tangents at a state of the model. Collective."""

    def counts_from(self, numbers: Vector) -> Sequence[int]:
        """Return the numbers of unstable directions of all families from an array of tangents."""

    def indefinite(self, numbers: Vector) -> set[int]:
        """Return the indices in `counts` of families whose tangents are not positive definite.

        Parameters
        ----------
        numbers
            An array of tangents, or a linear combination of such arrays.
        """


class SymmetryBreakingModes(Protocol):
    """All symmetry-breaking modes that a model excludes, in families that share a tangent."""

    @property
    def tangents(self) -> FamilyTangents | None:
        """The tangents of several families.

        None if there is one family, or if crossings are not located.
        """

    @property
    def families(self) -> Sequence[ModeFamily]:
        """The families whose crossings are located: the first ones of `counts`, or none."""

    def counts(self, state: State) -> Sequence[int]:
        """Return the numbers of unstable directions of all families at a state of the model."""


def unstable_count(modes: SymmetryBreakingModes | None, state: State) -> int:
    """Return the number of unstable directions at a state among symmetry-breaking modes.

    It is 0 for a model that excludes no modes (None). Collective.
    """
    return sum(modes.counts(state)) if modes else 0


@dataclass(frozen=True)
class Crossing:
    """A point where a mode of a family is neutral.

    Attributes
    ----------
    label
        Name of the family.
    unstable
        Number of symmetry-breaking unstable directions there.
    """

    label: str
    point: Point
    unstable: int


@dataclass(frozen=True)
class _InertiaEvaluation:
    """The inertia of the symmetry-breaking modes at a point of a path.

    Attributes
    ----------
    distance
        Length of the path from its first point up to this one, in the path's metric.
    counts
        Numbers of unstable directions of all families.
    softest, vector
        Magnitude of the eigenvalue nearest to zero of the only family, and its mode; infinite and
        None if there are several.
    numbers
        Function that computes the tangents of several families at this point, as one array of
        numbers, see `FamilyTangents`; None if there is one family.
    """

    point: Point
    distance: float
    counts: tuple[int, ...]
    softest: float = np.inf
    vector: Vector | None = None
    numbers: Callable[[], Vector] | None = None


class StabilityMonitor:
    """Monitors the unstable directions that a model excludes along a path.

    An evaluation counts the unstable directions at a point. Several families are evaluated at every
    accepted point. The tangent of a single family costs as much as the model's. So a point is
    skipped if the softest mode would not yet be neutral there, even if it softened
    `MAX_SOFTENING_RATIO` times as fast per length of the path as between the last two evaluations.
    At first no point is skipped, then at most one in a row, two, and `MAX_SKIPPED`. If the next
    evaluation shows that the mode softened faster, and to less than a half, or that the number of
    unstable directions has changed, all skipped points are evaluated.

    Between two points several families may soften and recover. The tangents of the parabola through
    the last three evaluations are means of three matrices (its Bernstein coefficients): those at
    both ends and one between. If that one is not positive definite for a family that is stable at
    both ends, the point half way is evaluated, and so on. It is always evaluated in the first
    interval of a path whose first point is.

    Parameters
    ----------
    excluded
        None if the model excludes no modes.

    Attributes
    ----------
    unlocated
        The reason why a change could not be located, for the first such change; "" if there is
        none.

    Private fields: `_path` is the present path, `_expand` maps its states to those of the model,
    and `_families` are the families whose crossings are located. `_last_point` has the displacement
    `_u` and the distance `_distance` along the path. `_last_evaluation` and `_previous_evaluation`
    are the last two evaluations, `_softening_rate` is the change of the softest eigenvalue per
    distance between them. `_skipped` has the points since then that were not evaluated, with their
    distances; `_may_skip` is how many in a row may be. `_counts_before_path` are the counts at the
    end of the previous path.
    """

    def __init__(self, excluded: SymmetryBreakingModes | None) -> None:
        """Begin before any path."""
        self._excluded = excluded
        self._families = excluded.families if excluded else []
        self._last_evaluation: _InertiaEvaluation | None = None
        self._previous_evaluation: _InertiaEvaluation | None = None
        self._counts_before_path: tuple[int, ...] = ()
        self._u: Vector | None = None
        self._skipped: list[tuple[Point, float]] = []
        self.unlocated = ""

    @property
    def unstable(self) -> int:
        """The number of unstable directions at the last evaluation."""
        return sum(self._last_evaluation.counts) if self._last_evaluation else 0

    def begin(
        self,
        path: Path,
        start: Point,
        expand: Callable[[State], State] = lambda state: state,
        *,
        evaluate: bool = False,
    ) -> None:
        """Begin to monitor a path at its first point. Collective.

        The last evaluation is kept if the path begins at the last point of the previous one.
        Otherwise the first point is evaluated only if the second proves to be unstable. `pass_to`
        then returns it as a crossing of each family that is unstable there and was not so at the
        last evaluation, or not in this number.

        Parameters
        ----------
        expand
            Maps a state of the path to a state of the model.
        evaluate
            Whether the first point is evaluated now; then it is no crossing.
        """
        last_evaluation = self._last_evaluation
        self._counts_before_path = (
            last_evaluation.counts if last_evaluation else (0,) * len(self._families)
        )
        # the same object as at the end of the previous path, which was not skipped there: the last
        # evaluation is that of this point
        is_last_point = start.state.u is self._u and not self._skipped
        known_evaluation = last_evaluation if is_last_point else None
        # begin anew at the first point, where nothing is known of softening
        self._path, self._expand = path, expand
        self._last_point, self._u, self._distance = start, start.state.u, 0.0
        self._softening_rate: float | None = None
        self._may_skip, self._skipped, self._previous_evaluation = 0, [], None
        # the evaluation of the first point: a known one, a new one, or none yet
        self._last_evaluation = None
        if known_evaluation:
            self._last_evaluation = replace(known_evaluation, point=start, distance=0.0)
        elif evaluate:
            self._last_evaluation = self._evaluate(start, 0.0)
        else:  # evaluated later, if it proves to be needed
            self._skipped.append((start, 0.0))

    def pass_to(self, point: Point, *, evaluate: bool = False) -> list[Crossing]:
        """Go on to the next accepted point; return the crossings on the way, in order. Collective.

        Parameters
        ----------
        evaluate
            Whether the point must be evaluated; else the only family may be skipped there.
        """
        self._distance += self._distance_between(self._last_point, point)
        self._last_point, self._u = point, point.state.u
        may_skip = not evaluate and len(self._families) == 1
        if may_skip and self._is_still_stiff:
            self._skipped.append((point, self._distance))
            return []
        return self._crossings_to_last_point()

    def _distance_between(self, first: Point, second: Point) -> float:
        """Return the straight distance of two points in the path's metric."""
        name, (a, b) = self._path.name, (first.state, second.state)
        return self._path.metric.norm(b.u - a.u, b.mu[name] - a.mu[name])

    def end(self) -> list[Crossing]:
        """End the path: evaluate its last point, if that was skipped. Collective.

        Return the crossings on the way to the point, as `pass_to` does.
        """
        if self._last_evaluation and self._last_evaluation.point is self._last_point:
            return []
        self._skipped = [
            (point, distance) for point, distance in self._skipped if point is not self._last_point
        ]
        return self._crossings_to_last_point()

    @property
    def _is_still_stiff(self) -> bool:
        """Whether the only family cannot be neutral at the last point."""
        return len(self._skipped) < self._may_skip and self._least_softest > 0

    @property
    def _least_softest(self) -> float:
        """The least eigenvalue that the softest mode of the only family may have at the last point.

        The mode softens at most `MAX_SOFTENING_RATIO` times as fast as before. The value is -inf
        without a known rate of softening.
        """
        evaluation, rate = self._last_evaluation, self._softening_rate
        if evaluation is None or rate is None:
            return -np.inf
        distance = self._distance - evaluation.distance
        return evaluation.softest - MAX_SOFTENING_RATIO * rate * distance

    def _crossings_to_last_point(self) -> list[Crossing]:
        """Evaluate the last point, and locate all crossings since the last evaluation.

        Skipped points are evaluated too if the last one shows that a mode softened unexpectedly.
        The number of points that may be skipped next is adapted.

        Returns
        -------
        The crossings, in the order of the path.
        """
        previous = self._last_evaluation
        new_evaluation = self._evaluate(self._last_point, self._distance)
        # faster than was allowed for, and by much
        softened = previous is not None and new_evaluation.softest < min(
            self._least_softest, previous.softest / 2
        )
        changed = (
            new_evaluation.counts != previous.counts if previous else any(new_evaluation.counts)
        )
        # all evaluations from the previous to the last point, in the order of the path
        evaluations = [new_evaluation]
        self._may_skip = min(max(1, 2 * len(self._skipped)), MAX_SKIPPED)
        is_unexpected = softened or changed
        if self._skipped and is_unexpected:
            evaluations = [*(self._evaluate(*skipped) for skipped in self._skipped), new_evaluation]
            self._may_skip = 0
        if previous:
            evaluations = self._with_recoveries([previous, *evaluations])
        # the last two ones are kept for the next call
        self._last_evaluation, self._skipped = new_evaluation, []
        self._previous_evaluation = evaluations[-2] if len(evaluations) > 1 else None
        self._softening_rate = _softening_rate(*evaluations[-2:]) if len(evaluations) > 1 else None
        # crossings between each two of them
        crossings = [] if previous else list(self._crossings_at_start(evaluations[0]))
        for low, high in pairwise(evaluations):
            if low.counts != high.counts:
                crossings += self._crossings_between(low, high)
        return crossings

    def _with_recoveries(self, evaluations: list[_InertiaEvaluation]) -> list[_InertiaEvaluation]:
        """Return successive evaluations, with new ones in between where modes may recover.

        A mode recovers if it becomes unstable and stable again within a step.
        """
        refined, before_low = evaluations[:1], self._previous_evaluation
        for low, high in pairwise(evaluations):
            refined += [*self._recoveries(before_low, low, high, MAX_RECOVERY_HALVINGS), high]
            before_low = refined[-2]  # before `high`, the first one of the next pair
        return refined

    def _recoveries(
        self,
        other: _InertiaEvaluation | None,
        low: _InertiaEvaluation,
        high: _InertiaEvaluation,
        halvings: int,
    ) -> Iterator[_InertiaEvaluation]:
        """Yield new evaluations between two, where a mode may become unstable and stable again.

        Parameters
        ----------
        other
            A third evaluation, before or after both, for a parabola; None: the middle is evaluated.
        low, high
            Successive evaluations.
        halvings
            Number of halvings of the step that are left.
        """
        can_be_halved = bool(halvings) and low.point.s != high.point.s
        if not can_be_halved or not self._may_recover(other, low, high):
            return
        segment = PathSegment(self._path, low.point, high.point)
        # an estimated point costs no solve; it counts if in both halves no mode may recover
        estimate = self._evaluate_between(low, high, segment.estimated_middle())
        if estimate and estimate.counts == low.counts == high.counts:
            # arguments for both halves: a third evaluation, then the ends of the half
            arguments_of_halves = (other or high, low, estimate), (low, estimate, high)
            if not any(self._may_recover(*arguments) for arguments in arguments_of_halves):
                yield estimate
                return
        # otherwise the point half way is solved, and both halves are examined
        middle = self._evaluate_between(low, high, segment.middle())
        if middle is None:
            return
        yield from self._recoveries(other or high, low, middle, halvings - 1)
        yield middle
        yield from self._recoveries(low, middle, high, halvings - 1)

    def _evaluate_between(
        self, low: _InertiaEvaluation, high: _InertiaEvaluation, point: Point | None
    ) -> _InertiaEvaluation | None:
        """Evaluate the inertia at a point between two evaluations; None without a point.

        The length of the path between them is divided in the ratio of the straight distances.
        """
        if point is None:
            return None
        to_low, to_high = (self._distance_between(end.point, point) for end in (low, high))
        distance = low.distance + (high.distance - low.distance) * to_low / (to_low + to_high)
        return self._evaluate(point, distance)

    def _may_recover(
        self,
        other: _InertiaEvaluation | None,
        low: _InertiaEvaluation,
        high: _InertiaEvaluation,
    ) -> bool:
        """Return whether a family that is stable at both ends of a step may be unstable within it.

        The tangents are interpolated by a parabola through three evaluations. Its inner Bernstein
        coefficient decides: if that is positive definite, as at both ends, so is the tangent
        between.

        Parameters
        ----------
        other
            A third evaluation, before or after both; None: a recovery is always possible.
        low, high
            The evaluations at both ends.
        """
        tangents = self._excluded.tangents if self._excluded else None
        if not tangents or high.distance == low.distance:
            return False
        if low.numbers is None or high.numbers is None:
            return False
        if other is None or other.numbers is None:
            return True
        # no parabola through two points at one place
        if other.distance in (low.distance, high.distance):
            return True
        # places of the three evaluations on the path, and functions that compute their tangents
        distances = other.distance, low.distance, high.distance
        computations = other.numbers, low.numbers, high.numbers

        def find() -> RecordedValues:
            """Compute whether the matrix between the ends is indefinite for a stable family."""
            tangents_between = _inner_bernstein_coefficient(
                distances, [compute() for compute in computations]
            )
            # indices of families
            indefinite = tangents.indefinite(tangents_between)
            recovers = any(not low.counts[i] and not high.counts[i] for i in indefinite)
            return RecordedValues({"recovers": recovers})

        return bool(self._path.recorded_values(find).values["recovers"])

    def _crossings_at_start(self, evaluation: _InertiaEvaluation) -> Iterator[Crossing]:
        """Yield a crossing at the first point for each family that became unstable before it.

        The numbers of unstable directions are compared with those at the end of the last path.
        """
        # counts may have further families, whose crossings are not located
        counts = zip(self._families, evaluation.counts, self._counts_before_path, strict=False)
        for family, count, count_before in counts:
            if count and count != count_before:
                yield Crossing(family.label, evaluation.point, sum(evaluation.counts))

    def _crossings_between(
        self, low: _InertiaEvaluation, high: _InertiaEvaluation
    ) -> list[Crossing]:
        """Return the crossings between two evaluated points, in the order of the path.

        If a crossing cannot be located, the reason is kept in `unlocated`.
        """
        segment = PathSegment(self._path, low.point, high.point)
        # (distance from `low`, label of the family, point, change of its number) of each crossing
        located = list[tuple[float, str, Point, int]]()
        # only the first families of the counts are located
        for family, count_before, count_after in zip(
            self._families, low.counts, high.counts, strict=False
        ):
            inertia_change = InertiaChange(
                _ExpandedStability(family, self._expand), count_before, count_after
            )
            try:
                located += [
                    (segment.distance(point), family.label, point, rise)
                    for point, rise in segment.crossings(inertia_change)
                ]
            except PathStopped as e:
                self.unlocated = self.unlocated or str(e)
        crossings, unstable_count = list[Crossing](), sum(low.counts)
        for _, label, point, rise in sorted(located, key=lambda crossing: crossing[0]):
            # at the crossing itself the neutral mode does not count
            crossings.append(Crossing(label, point, min(unstable_count, unstable_count + rise)))
            unstable_count += rise
        return crossings

    def _evaluate(self, point: Point, distance: float) -> _InertiaEvaluation:
        """Evaluate the inertia of all families at a point, a distance along the path. Collective.

        The result is recorded in the journal of the path.
        """
        excluded = self._excluded
        if excluded is None:
            return _InertiaEvaluation(point, distance, ())
        tangents, state = excluded.tangents, self._expand(point.state)
        # computed when they are first needed: a replayed result does not need them
        numbers = cache(partial(tangents.sampled_tangents, state)) if tangents else None
        start_vector = self._last_evaluation.vector if self._last_evaluation else None

        def find() -> RecordedValues:
            """Compute the inertia; of a single family also the softest mode."""
            if tangents and numbers:
                counts = [*tangents.counts_from(numbers())]
                return RecordedValues({"counts": counts, "softest": np.inf})
            if len(self._families) != 1:
                return RecordedValues({"counts": [*excluded.counts(state)], "softest": np.inf})
            factors = self._families[0].factor_at(state)
            softest, vector = _softest_mode(factors, start_vector)
            return RecordedValues({"counts": [factors.negative_pivots], "softest": softest}, vector)

        recorded = self._path.recorded_values(find)
        return _InertiaEvaluation(
            point,
            distance,
            tuple(recorded.values["counts"]),
            recorded.values["softest"],
            recorded.vector,
            numbers,
        )


@dataclass(frozen=True)
class _ExpandedStability:
    """A family's tangent for the states of a path, which `expand` maps to states of the model."""

    family: ModeFamily
    expand: Callable[[State], State]

    def factor_at(self, state: State) -> Factorisation:
        return self.family.factor_at(self.expand(state))


def _softest_mode(factors: Factorisation, start_vector: Vector | None) -> tuple[float, Vector]:
    """Return an upper bound of the least magnitude of an eigenvalue, and its vector.

    Inverse iteration finds them; the vector has length one. Collective.

    Parameters
    ----------
    start_vector
        The vector at an earlier point; None if there is none.
    """
    comm = factors.matrix.comm.tompi4py()
    v = np.sin(1.0 + np.arange(factors.matrix.getLocalSize()[0]) + comm.rank)
    if start_vector is not None:
        v = start_vector + GENERAL_FRACTION * v / np.sqrt(dot(comm, v, v))
    eigenvalue_size = np.inf
    # |v|/|K^-1 v| is never below the least magnitude of an eigenvalue
    for _ in range(ITERATIONS_FROM_RANDOM if start_vector is None else ITERATIONS_FROM_LAST_MODE):
        v = factors.solve(v / np.sqrt(dot(comm, v, v)))
        eigenvalue_size = 1 / np.sqrt(dot(comm, v, v))
    return eigenvalue_size, eigenvalue_size * v


def _inner_bernstein_coefficient(distances: Sequence[float], numbers: Sequence[Vector]) -> Vector:
    """Return the inner Bernstein coefficient of a parabola over its last interval.

    On the interval a parabola is a mean, with weights between 0 and 1, of its values at both ends
    and of this coefficient.

    Parameters
    ----------
    distances
        Three places: another one, and the ends of the interval.
    numbers
        The values at these places.
    """
    (third, low, high), (at_third, at_low, at_high) = distances, numbers
    step = high - low
    # divided differences: of the interval and beside it, then of second order
    slope, other_slope = (at_high - at_low) / step, (at_low - at_third) / (low - third)
    half_curvature = (slope - other_slope) / (high - third)
    return np.asarray((at_low + at_high) / 2 - step**2 / 2 * half_curvature)


def _softening_rate(a: _InertiaEvaluation, b: _InertiaEvaluation) -> float | None:
    """Return the change of the softest eigenvalue per length of the path between evaluations.

    If the numbers of unstable directions differ, the eigenvalue has changed its sign. The rate is
    None between points at one place.
    """
    if b.distance == a.distance:
        return None
    eigenvalue_change = (
        abs(b.softest - a.softest) if a.counts == b.counts else a.softest + b.softest
    )
    return eigenvalue_change / (b.distance - a.distance)

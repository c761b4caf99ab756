"""The unstable modes that a model excludes: their number along a path, and the points where it
changes.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from typing import Protocol

import numpy as np

from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.modes import Stability
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import Finding, PathStopped, Point
from magshell_fenicsx.continuation.system import State, Vector, dot
from magshell_fenicsx.continuation.walk import locate_bifurcation

MOST_HALVINGS = (
    12  # of a step in which several modes of a family change; what is left counts as one
)
# the softest mode is assumed to soften at most so many times as fast as between the last two looks
FASTER = 2.0
MOST_PASSED = 4  # the most successive points without a look
CLOSER = 3  # halvings of a step between whose ends modes may soften and recover
ITERATIONS = 4  # inverse iterations from the last softest mode
FIRST = 12  # inverse iterations if there is no such mode
NEW = (
    0.1  # part of a general vector in the start vector, so that modes of another symmetry are found
)


@dataclass(frozen=True)
class Change:
    """A family of modes, and its numbers of unstable directions before and after a step."""

    stability: Stability
    before: int
    after: int


class Step:
    """The part of a path between two successive points, with all points on it that were computed.

    Arc length is measured along the tangent of the first point.
    """

    def __init__(self, path: Path, low: Point, high: Point) -> None:
        self._path, self._low = path, path.before(path.as_base(low), high)
        self._points = [self._low, path.measured_from(self._low, high)]

    def place(self, point: Point) -> float:
        """The distance of a point from the first one, in s."""
        return abs(self._path.measured_from(self._low, point).s - self._low.s)

    def middle(self) -> Point | None:
        """The point half way between the first and the last one; None if it is not found."""
        try:
            return self._middle(self._points[0], self._points[-1], solve=True, counted=False)
        except PathStopped:
            return None

    def about_middle(self) -> Point | None:
        """About that point, without a solve; None if that is too uncertain."""
        low, high = self._points[0], self._points[-1]
        found = self._path.about((low.s + high.s) / 2, low, self._path.seen_from(low, high), low)
        return None if isinstance(found, str) else found

    def crossings(self, change: Change) -> Iterator[tuple[Point, int]]:
        """Each point at which a mode is neutral, and the change of the number of unstable
        directions there.
        """
        ends = self._points[0], self._points[-1]
        counts = {id(ends[0]): change.before, id(ends[1]): change.after}
        yield from self._between(*ends, change, counts, MOST_HALVINGS)

    def _between(
        self, low: Point, high: Point, change: Change, counts: dict[int, int], halvings: int
    ) -> Iterator[tuple[Point, int]]:
        before, after = counts[id(low)], counts[id(high)]
        if before == after:
            return
        middle = self._middle(low, high, solve=abs(after - before) > 1 and halvings > 0)
        if middle is None:
            base = self._path.as_base(low)
            crossing = locate_bifurcation(
                self._path, base, self._path.measured_from(base, high), change.stability
            )
            self._kept(crossing)
            yield crossing, after - before
        else:
            counts[id(middle)] = change.stability.factor_at(middle.state).negative_pivots
            yield from self._between(low, middle, change, counts, halvings - 1)
            yield from self._between(middle, high, change, counts, halvings - 1)

    def _middle(
        self, low: Point, high: Point, *, solve: bool, counted: bool = True
    ) -> Point | None:
        """A point between two others: a known one, else a new one if `solve` is set."""
        first, last = (
            next(i for i, p in enumerate(self._points) if p is end) for end in (low, high)
        )
        if last - first > 1:
            return self._points[(first + last) // 2]
        if not solve:
            return None
        path, s = self._path, (low.s + high.s) / 2
        middle = path.inside(s, low, path.seen_from(low, high), self._low, counted=counted)
        if isinstance(middle, str):
            raise PathStopped(f"locating an instability: {middle}", low)
        return self._kept(middle)

    def _kept(self, point: Point) -> Point:
        seen = self._path.measured_from(self._low, point)
        self._points.append(seen)
        self._points.sort(key=lambda p: abs(p.s - self._low.s))
        return seen


class Family(Protocol):
    """Modes that a model excludes and that share a tangent; an `events.Stability`."""

    @property
    def label(self) -> str:
        """Their name in records, "antisymmetric" or "m = 7"."""

    def factor_at(self, state: State) -> Factorisation:
        """Factor their tangent at a state of the model."""


class Tangents(Protocol):
    """Those of several families together, as numbers in which they are linear."""

    def numbers(self, state: State) -> Vector:
        """Those at a state of the model."""

    def counts_of(self, numbers: Vector) -> Sequence[int]:
        """Numbers of unstable directions of all families."""

    def indefinite(self, numbers: Vector) -> set[int]:
        """The places in `counts` of families whose tangents are not positive definite."""


class Excluded(Protocol):
    """All modes that a model excludes."""

    @property
    def tangents(self) -> Tangents | None:
        """Of several families; None if there is one, or if crossings are not located."""

    @property
    def families(self) -> Sequence[Family]:
        """Those whose crossings are located: the first ones of `counts`, or none."""

    def counts(self, state: State) -> Sequence[int]:
        """Numbers of unstable directions of all families at a state of the model."""


@dataclass(frozen=True)
class Crossing:
    """A point where a mode of a family is neutral, and the number of excluded unstable directions
    there.
    """

    label: str
    point: Point
    unstable: int


@dataclass(frozen=True)
class _Look:
    """The excluded modes at a point.

    Attributes
    ----------
    along
        The length of the path up to the point.
    counts
        Numbers of unstable directions of all families.
    softest, vector
        Magnitude of the eigenvalue nearest to zero of the only family, and its mode; None if there
        are several.
    numbers
        Gives the tangents of several families, see `Tangents`; None if there are none.
    """

    point: Point
    along: float
    counts: tuple[int, ...]
    softest: float = np.inf
    vector: Vector | None = None
    numbers: Callable[[], Vector] | None = None


class Watch:
    """Looks along a path for the unstable directions that a model excludes.

    A look counts the unstable directions at a point. Several families get a look at every accepted
    point. The tangent of a single family costs as much as the model's. So a point is skipped if the
    softest mode would not yet be neutral there, even if it softened `FASTER` times as fast per
    length of the path as between the last two looks. At first no point is skipped, then at most one
    in a row, two, and `MOST_PASSED`. If the next look shows that the mode softened faster, and to
    less than a half, or that the number of unstable directions has changed, all skipped points get
    a look.

    Between two points several families may soften and recover. The tangents of the parabola through
    the last three looks are means of three matrices (its Bernstein coefficients): those at both
    ends and one between. If that one is not positive definite for a family that is stable at both
    ends, the point half way gets a look, and so on. It gets one in the first interval of a path
    whose first point has one.

    Parameters
    ----------
    excluded
        None if the model excludes no modes.

    Attributes
    ----------
    unlocated
        The reason why a change could not be located, for the first such change; "" if there is
        none.
    """

    def __init__(self, excluded: Excluded | None) -> None:
        self._excluded = excluded
        self._families = excluded.families if excluded else []
        self._looked: _Look | None = None
        self._earlier: _Look | None = None  # before the last look
        self._before: tuple[int, ...] = ()
        self._u: Vector | None = None
        self._passed: list[tuple[Point, float]] = []
        self.unlocated = ""

    @property
    def unstable(self) -> int:
        """The number of unstable directions at the last look."""
        return sum(self._looked.counts) if self._looked else 0

    def begin(
        self,
        path: Path,
        start: Point,
        expand: Callable[[State], State] = lambda state: state,
        *,
        look: bool = False,
    ) -> None:
        """Begin to watch a path at its first point.

        If that is not the last point of the path before, it gets a look only if the second point is
        unstable. If it is unstable too, `pass_to` returns it as a crossing of each family whose
        number is not that of the last look.

        Parameters
        ----------
        expand
            Maps a state of the path to a state of the model.
        look
            Whether the first point gets a look now; then it is no crossing.
        """
        self._before = self._looked.counts if self._looked else (0,) * len(self._families)
        looked = self._looked if start.state.u is self._u and not self._passed else None
        self._path, self._expand, self._last, self._u, self._along = (
            path,
            expand,
            start,
            start.state.u,
            0.0,
        )
        self._rate: float | None = None
        self._may_pass, self._passed, self._earlier = 0, [], None
        self._looked = replace(looked, point=start, along=0.0) if looked else None
        if look and not looked:
            self._looked = self._look(start, 0.0)
        elif not looked:
            self._passed.append((start, 0.0))

    def pass_to(self, point: Point, *, look: bool = False) -> list[Crossing]:
        """Go on to the next accepted point; the crossings on the way, in order.

        Parameters
        ----------
        look
            Whether the point must get a look.
        """
        self._along += self._length(self._last, point)
        self._last, self._u = point, point.state.u
        if not look and len(self._families) == 1 and self._still_stiff:
            self._passed.append((point, self._along))
            return []
        return self._changes()

    def _length(self, first: Point, second: Point) -> float:
        """The straight distance of two points."""
        name, (a, b) = self._path.name, (first.state, second.state)
        return self._path.metric.norm(b.u - a.u, b.mu[name] - a.mu[name])

    def end(self) -> list[Crossing]:
        """Look at the last point, if it was skipped; the crossings, see `pass_to`."""
        if self._looked and self._looked.point is self._last:
            return []
        self._passed = [passed for passed in self._passed if passed[0] is not self._last]
        return self._changes()

    @property
    def _still_stiff(self) -> bool:
        """Whether the only family cannot be neutral at the last point."""
        return len(self._passed) < self._may_pass and self._at_least > 0

    @property
    def _at_least(self) -> float:
        """The least eigenvalue that the softest mode may have at the last point; -inf without a
        rate.
        """
        if self._looked is None or self._rate is None:
            return -np.inf
        return self._looked.softest - FASTER * self._rate * (self._along - self._looked.along)

    def _changes(self) -> list[Crossing]:
        """Look at the last point and, if necessary, at the skipped ones; the crossings up to it."""
        before, last = self._looked, self._look(self._last, self._along)
        softer = before is not None and last.softest < min(self._at_least, before.softest / 2)
        changed = last.counts != before.counts if before else any(last.counts)
        looks, self._may_pass = [last], min(max(1, 2 * len(self._passed)), MOST_PASSED)
        if self._passed and (softer or changed):
            looks, self._may_pass = [*(self._look(*passed) for passed in self._passed), last], 0
        looks = self._with_closer([before, *looks]) if before else looks
        self._looked, self._passed, self._earlier = last, [], looks[-2] if len(looks) > 1 else None
        self._rate = _rate(*looks[-2:]) if len(looks) > 1 else None
        changes = [] if before else list(self._at_start(looks[0]))
        for low, high in pairwise(looks):
            if low.counts != high.counts:
                changes += self._between(low, high)
        return changes

    def _with_closer(self, looks: list[_Look]) -> list[_Look]:
        """Some looks, with those between them where modes may soften and recover."""
        every, earlier = looks[:1], self._earlier
        for low, high in pairwise(looks):
            every += [*self._closer(earlier, low, high, CLOSER), high]
            earlier = every[-2]
        return every

    def _closer(
        self, other: _Look | None, low: _Look, high: _Look, halvings: int
    ) -> Iterator[_Look]:
        """Looks between two, from a third one before or after these; without one the middle is
        looked at.
        """
        if not halvings or low.point.s == high.point.s or not self._may_recover(other, low, high):
            return
        step = Step(self._path, low.point, high.point)
        about = self._look_between(low, high, step.about_middle())
        if about and about.counts == low.counts == high.counts:
            ends = (other or high, low, about), (low, about, high)
            if not any(self._may_recover(*three) for three in ends):
                yield about
                return
        look = self._look_between(low, high, step.middle())
        if look is None:
            return
        yield from self._closer(other or high, low, look, halvings - 1)
        yield look
        yield from self._closer(low, look, high, halvings - 1)

    def _look_between(self, low: _Look, high: _Look, point: Point | None) -> _Look | None:
        if point is None:
            return None
        part, rest = (self._length(end.point, point) for end in (low, high))
        return self._look(point, low.along + (high.along - low.along) * part / (part + rest))

    def _may_recover(self, other: _Look | None, low: _Look, high: _Look) -> bool:
        """Whether a family that is stable at both ends of a step may be unstable in it, by a
        parabola.
        """
        tangents = self._excluded.tangents if self._excluded else None
        if not tangents or low.numbers is None or high.numbers is None or high.along == low.along:
            return False
        if other is None or other.numbers is None or other.along in (low.along, high.along):
            return True
        at, numbers = (
            (other.along, low.along, high.along),
            (other.numbers, low.numbers, high.numbers),
        )

        def find() -> Finding:
            indefinite = tangents.indefinite(_between_looks(at, [each() for each in numbers]))
            return Finding(
                {"recovers": any(not low.counts[i] and not high.counts[i] for i in indefinite)}
            )

        return bool(self._path.noted(find).values["recovers"])

    def _at_start(self, look: _Look) -> Iterator[Crossing]:
        """The families that are unstable at the first point, and were not so on the path before."""
        for family, count, before in zip(self._families, look.counts, self._before, strict=False):
            if count and count != before:
                yield Crossing(family.label, look.point, sum(look.counts))

    def _between(self, low: _Look, high: _Look) -> list[Crossing]:
        """The crossings between two points, in the order of the path."""
        step, located = (
            Step(self._path, low.point, high.point),
            list[tuple[float, str, Point, int]](),
        )
        for family, before, after in zip(self._families, low.counts, high.counts, strict=False):
            change = Change(_Expanded(family, self._expand), before, after)
            try:
                located += [
                    (step.place(p), family.label, p, rise) for p, rise in step.crossings(change)
                ]
            except PathStopped as e:
                self.unlocated = self.unlocated or str(e)
        crossings, unstable = list[Crossing](), sum(low.counts)
        for _, label, point, rise in sorted(located, key=lambda item: item[0]):
            crossings.append(Crossing(label, point, min(unstable, unstable + rise)))
            unstable += rise
        return crossings

    def _look(self, point: Point, along: float) -> _Look:
        if self._excluded is None:
            return _Look(point, along, ())
        excluded, tangents, state = (
            self._excluded,
            self._excluded.tangents,
            self._expand(point.state),
        )
        numbers = cache(partial(tangents.numbers, state)) if tangents else None
        near = self._looked.vector if self._looked else None

        def find() -> Finding:
            if tangents and numbers:
                return Finding({"counts": [*tangents.counts_of(numbers())], "softest": np.inf})
            if len(self._families) != 1:
                return Finding({"counts": [*excluded.counts(state)], "softest": np.inf})
            factors = self._families[0].factor_at(state)
            softest, vector = _softest(factors, near)
            return Finding({"counts": [factors.negative_pivots], "softest": softest}, vector)

        found = self._path.noted(find)
        return _Look(
            point,
            along,
            tuple(found.values["counts"]),
            found.values["softest"],
            found.vector,
            numbers,
        )


@dataclass(frozen=True)
class _Expanded:
    """A family, for the states of a path that `expand` maps to states of the model."""

    family: Family
    expand: Callable[[State], State]

    def factor_at(self, state: State) -> Factorisation:
        return self.family.factor_at(self.expand(state))


def _softest(factors: Factorisation, near: Vector | None) -> tuple[float, Vector]:
    """The magnitude of the eigenvalue nearest to zero, an upper bound, and its vector."""
    comm = factors.matrix.comm.tompi4py()
    v = np.sin(1.0 + np.arange(factors.matrix.getLocalSize()[0]) + comm.rank)
    if near is not None:
        v = near + NEW * v / np.sqrt(dot(comm, v, v))
    size = np.inf
    for _ in range(FIRST if near is None else ITERATIONS):
        v = factors.solve(v / np.sqrt(dot(comm, v, v)))
        size = 1 / np.sqrt(dot(comm, v, v))
    return size, size * v


def _between_looks(along: Sequence[float], numbers: Sequence[Vector]) -> Vector:
    """What a parabola through three has, in the mean, between the last two: its inner Bernstein
    coefficient there."""
    (other, low, high), (before, first, last) = along, numbers
    step = high - low
    slopes = (last - first) / step, (first - before) / (low - other)
    bend = (slopes[0] - slopes[1]) / (high - other)  # half the second derivative
    return np.asarray((first + last) / 2 - step**2 / 2 * bend)


def _rate(a: _Look, b: _Look) -> float | None:
    """The change of the softest eigenvalue per length of the path; None for zero length."""
    if b.along == a.along:
        return None
    change = abs(b.softest - a.softest) if a.counts == b.counts else a.softest + b.softest
    return change / (b.along - a.along)

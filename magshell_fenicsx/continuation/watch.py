"""Which modes that a model excludes are unstable along a path, and where each becomes unstable or stable again."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np

from magshell_fenicsx.continuation.crossings import Change, Step
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import PathStopped, Point
from magshell_fenicsx.continuation.system import State, Vector, dot

FASTER = 2.0  # than between the last two looks the softest mode may soften before it is looked at again
MOST_PASSED = 4  # points in a row that are not looked at
ITERATIONS = 4  # of inverse iteration from the last softest mode
FIRST = 12  # the same where there is none
NEW = 0.1  # of a start vector in all directions, lest a mode of another symmetry stays unseen


class Family(Protocol):
    """Modes that a model excludes and that share a tangent; a `solve.events.Stability`."""

    @property
    def label(self) -> str:
        """What a record of them says, "antisymmetric" or "m = 7"."""

    def factor_at(self, state: State) -> Factorisation:
        """Factor their tangent at a state of the model."""


class Excluded(Protocol):
    """All modes that a model excludes."""

    @property
    def families(self) -> Sequence[Family]: ...

    def counts(self, state: State) -> Sequence[int]:
        """Numbers of unstable directions of all families at a state of the model."""


@dataclass(frozen=True)
class Crossing:
    """Where a mode of a family is neutral, and how many excluded directions are unstable there."""

    label: str
    point: Point
    unstable: int


@dataclass(frozen=True)
class _Look:
    """What was seen at a point.

    Attributes
    ----------
    along
        The length of the path up to the point.
    counts
        Numbers of unstable directions of all families.
    softest, vector
        The size of the eigenvalue nearest to zero of the only family, and its mode; None if it was not asked for.
    """

    point: Point
    along: float
    counts: tuple[int, ...]
    softest: float = np.inf
    vector: Vector | None = None


class Watch:
    """Looks along a path for the unstable directions that a model excludes.

    Several families are looked at at every accepted point. A single one, whose tangent costs as much as the model's,
    is passed over at a point if its softest mode, softening `FASTER` times as fast per length of the path as between
    the last two looks, would not be neutral yet: at first at no point, then at one in a row, at two, at
    `MOST_PASSED`. If the next look shows that it softened faster, and to less than a half, or that the number of
    unstable directions is another, all points passed over are looked at.

    Attributes
    ----------
    unlocated
        Why a change could not be located, of the first such change; "" if there is none.
    """

    def __init__(self, excluded: Excluded | None) -> None:
        self._excluded = excluded
        self._families = excluded.families if excluded else []
        self._looked: _Look | None = None
        self._u: Vector | None = None
        self._passed: list[tuple[Point, float]] = []
        self.unlocated = ""

    @property
    def unstable(self) -> int:
        """The number of unstable directions at the last point, as far as it was looked at."""
        return sum(self._looked.counts) if self._looked else 0

    def begin(
        self, path: Path, start: Point, expand: Callable[[State], State] = lambda state: state, *, look: bool = False
    ) -> None:
        """Begin to watch a path at its first point.

        Unless it is the last point of the path before, that is looked at only if the second one is unstable; if it
        is unstable too, `pass_to` gives it as a crossing.

        Parameters
        ----------
        expand
            From a state of the path to one of the model.
        look
            Whether it is looked at now; then it is no crossing.
        """
        known = self._looked if start.state.u is self._u and not self._passed else None
        self._path, self._expand, self._last, self._u, self._along = path, expand, start, start.state.u, 0.0
        self._rate: float | None = None
        self._may_pass, self._passed = 0, []
        self._looked = replace(known, point=start, along=0.0) if known else None
        if look and not known:
            self._looked = self._look(start, 0.0)
        elif not known:
            self._passed.append((start, 0.0))

    def pass_to(self, point: Point, *, look: bool = False) -> list[Crossing]:
        """Go on to the next accepted point; what became unstable or stable on the way, in order.

        Parameters
        ----------
        look
            Whether it must be looked at.
        """
        name, last = self._path.name, self._last.state
        self._along += self._path.metric.norm(point.state.u - last.u, point.state.mu[name] - last.mu[name])
        self._last, self._u = point, point.state.u
        may_pass = len(self._families) == 1 and len(self._passed) < self._may_pass and not look
        if may_pass and self._at_least > 0:
            self._passed.append((point, self._along))
            return []
        return self._changes()

    def end(self) -> list[Crossing]:
        """Look at the last point, unless that was done; see `pass_to`."""
        if self._looked and self._looked.point is self._last:
            return []
        self._passed = [passed for passed in self._passed if passed[0] is not self._last]
        return self._changes()

    @property
    def _at_least(self) -> float:
        """How soft the softest mode may have become at the last point; without a rate, anything."""
        if self._looked is None or self._rate is None:
            return -np.inf
        return self._looked.softest - FASTER * self._rate * (self._along - self._looked.along)

    def _changes(self) -> list[Crossing]:
        """Look at the last point, and, if need be, at those passed over; what changed up to it."""
        before, here = self._looked, self._look(self._last, self._along)
        softer = before is not None and here.softest < min(self._at_least, before.softest / 2)
        changed = here.counts != before.counts if before else any(here.counts)
        looks, self._may_pass = [here], min(max(1, 2 * len(self._passed)), MOST_PASSED)
        if self._passed and (softer or changed):
            looks, self._may_pass = [*(self._look(*passed) for passed in self._passed), here], 0
        looks = [before, *looks] if before else looks
        self._looked, self._passed = here, []
        self._rate = _rate(*looks[-2:]) if len(looks) > 1 else None
        found = [] if before else list(self._at_start(looks[0]))
        for low, high in pairwise(looks):
            if low.counts != high.counts:
                found += self._between(low, high)
        return found

    def _at_start(self, look: _Look) -> Iterator[Crossing]:
        """What is unstable from the first point on."""
        for family, count in zip(self._families, look.counts, strict=True):
            if count:
                yield Crossing(family.label, look.point, sum(look.counts))

    def _between(self, low: _Look, high: _Look) -> list[Crossing]:
        """Where the numbers of unstable directions change between two points, in the order of the path."""
        step, located = Step(self._path, low.point, high.point), list[tuple[float, str, Point, int]]()
        for family, before, after in zip(self._families, low.counts, high.counts, strict=True):
            change = Change(_Expanded(family, self._expand), before, after)
            try:
                located += [(step.place(p), family.label, p, rise) for p, rise in step.crossings(change)]
            except PathStopped as e:
                self.unlocated = self.unlocated or str(e)
        found, unstable = list[Crossing](), sum(low.counts)
        for _, label, point, rise in sorted(located, key=lambda item: item[0]):
            found.append(Crossing(label, point, min(unstable, unstable + rise)))
            unstable += rise
        return found

    def _look(self, point: Point, along: float) -> _Look:
        state = self._expand(point.state)
        if self._excluded is None or len(self._families) > 1:
            return _Look(point, along, tuple(self._excluded.counts(state)) if self._excluded else ())
        factors = self._families[0].factor_at(state)
        softest, vector = _softest(factors, self._looked.vector if self._looked else None)
        return _Look(point, along, (factors.negative_pivots,), softest, vector)


@dataclass(frozen=True)
class _Expanded:
    """A family at the states of a path whose amplitudes stand for others."""

    family: Family
    expand: Callable[[State], State]

    def factor_at(self, state: State) -> Factorisation:
        return self.family.factor_at(self.expand(state))


def _softest(factors: Factorisation, near: Vector | None) -> tuple[float, Vector]:
    """The size of the eigenvalue nearest to zero, never too small, and its vector."""
    comm = factors.matrix.comm.tompi4py()
    v = np.sin(1.0 + np.arange(factors.matrix.getLocalSize()[0]) + comm.rank)
    if near is not None:
        v = near + NEW * v / np.sqrt(dot(comm, v, v))
    size = np.inf
    for _ in range(FIRST if near is None else ITERATIONS):
        v = factors.solve(v / np.sqrt(dot(comm, v, v)))
        size = 1 / np.sqrt(dot(comm, v, v))
    return size, size * v


def _rate(a: _Look, b: _Look) -> float | None:
    """At which the softest mode changes per length of the path; None where there is no length."""
    if b.along == a.along:
        return None
    change = abs(b.softest - a.softest) if a.counts == b.counts else a.softest + b.softest
    return change / (b.along - a.along)

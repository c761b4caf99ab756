"""Locating the points of a step at which excluded modes are neutral."""

from collections.abc import Iterator
from dataclasses import dataclass

from magshell_fenicsx.continuation.events import Stability, locate_bifurcation
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import PathStopped, Point

MOST_HALVINGS = 12  # of a step in which several modes of a family change; what is left counts as one


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
        self._path, self._low = path, path.as_base(low)
        self._points = [self._low, path.measured_from(self._low, high)]

    def place(self, point: Point) -> float:
        """The distance of a point from the first one, in s."""
        return abs(self._path.measured_from(self._low, point).s - self._low.s)

    def crossings(self, change: Change) -> Iterator[tuple[Point, int]]:
        """Each point at which a mode is neutral, and the change of the number of unstable directions there."""
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
            found = locate_bifurcation(self._path, base, self._path.measured_from(base, high), change.stability)
            self._kept(found)
            yield found, after - before
        else:
            counts[id(middle)] = change.stability.factor_at(middle.state).negative_pivots
            yield from self._between(low, middle, change, counts, halvings - 1)
            yield from self._between(middle, high, change, counts, halvings - 1)

    def _middle(self, low: Point, high: Point, *, solve: bool) -> Point | None:
        """A point between two others: a known one, else a new one if `solve` is set."""
        first, last = (next(i for i, p in enumerate(self._points) if p is end) for end in (low, high))
        if last - first > 1:
            return self._points[(first + last) // 2]
        if not solve:
            return None
        path, s = self._path, (low.s + high.s) / 2
        found = path.inside(s, low, path.seen_from(low, high), self._low)
        if isinstance(found, str):
            raise PathStopped(f"locating an instability: {found}", low)
        return self._kept(found)

    def _kept(self, point: Point) -> Point:
        seen = self._path.measured_from(self._low, point)
        self._points.append(seen)
        self._points.sort(key=lambda p: abs(p.s - self._low.s))
        return seen

"""Requested points of a path by arc length: the loads or displacements that lie between two points,
each solved for.
"""

from collections.abc import Callable, Iterator, Sequence

from magshell_fenicsx.continuation.path import Path, Quantity
from magshell_fenicsx.continuation.point import PathStopped, Point

# of the way to the last target: a step ends there, so that its factors serve at the target
BEHIND = 1.01
JOINED, APART = (
    4,
    0.1,
)  # points that a polynomial goes through, and their least distance over that around a target
MOST_TRIALS = 20
CLOSE = 1e-6  # of the way that is left between two places: nearer ones are the same


class TargetMissed(PathStopped):
    """The solve at a requested point between two points of the path failed."""


def arriving(
    path: Path, quantity: Quantity, target: float, s: float, seen: Sequence[Point]
) -> float:
    """The end of a step to `s`: close behind the last target, where points foresee that it is
    passed.
    """
    here = seen[-1].s

    def missed(s: float) -> float:
        return path.value(quantity, path.extended(s, seen)) - target

    passed = missed(here) * missed(s) < 0
    return (
        here + min(BEHIND * (_zero(missed, here, s) - here) / (s - here), 1.0) * (s - here)
        if passed
        else s
    )


def targets_between(
    path: Path, quantity: Quantity, targets: Sequence[float], sense: float, points: Sequence[Point]
) -> Iterator[tuple[float, Point]]:
    """The targets between two successive points with their own points, in the order of the path.

    Parameters
    ----------
    quantity, targets
        What has these values at the requested points.
    sense
        The sign of its change along the path.
    points
        Both, and before them the point before, if there is one.

    Raises
    ------
    PathStopped
        If the path turns back at once, or a target is not found.
    """
    low, high = points[-2:]
    a, b = path.value(quantity, low.state), path.value(quantity, high.state)
    if a in targets and (b - a) * sense < 0:  # a shorter step sees the load rise first
        raise PathStopped(f"{path.name} falls from the start", low)
    smooth = (
        points[-2:] if path.newton.options.kinks else points
    )  # no polynomial goes on behind a corner
    around = [path.seen_from(low, path.measured_from(low, point)) for point in smooth]
    inside = [target for target in targets if (target - a) * (target - b) < 0 or b == target]
    for target in sorted(inside, key=lambda target: abs(target - a)):
        point = path.measured_from(low, _solved(path, quantity, target, around))
        around.insert(-1, path.seen_from(low, point))
        yield target, point


def _solved(path: Path, quantity: Quantity, target: float, around: Sequence[Point]) -> Point:
    """The point at a target between the last two of some points, from the polynomial through them
    and some before.
    """
    low, high = near = list(around[-2:])
    for earlier in reversed(around[:-2]):  # too close ones would multiply rounding
        if len(near) < JOINED and abs(near[0].s - earlier.s) > APART * abs(high.s - low.s):
            near.insert(0, earlier)

    def missed(s: float) -> float:
        return path.value(quantity, path.between(s, *near)) - target

    s = _zero(missed, low.s, high.s)
    t = (s - low.s) / (high.s - low.s)
    stress = [(1 - t, low.state.u), (t, high.state.u)]
    # between different counts a target has its own; the step's end serves where it is close behind
    counts = {(point.negative_pivots, point.negative_pivots_held) for point in (low, high)}
    end = (
        high.state
        if len(counts) == 1 and abs(high.s - s) < 2 * (BEHIND - 1) * abs(high.s - low.s)
        else None
    )
    point = path.solve(path.given(quantity, target), s, path.between(s, *near), stress, near=end)
    if isinstance(point, str):
        raise TargetMissed(f"a requested point cannot be found: {point}", low)
    return point


def _zero(f: Callable[[float], float], low: float, high: float) -> float:
    """About where a function is zero between two places, by Illinois' regula falsi; the second if
    it has one sign.
    """
    a, b = f(low), f(high)
    place, side = high, 0
    for _ in range(MOST_TRIALS if a * b < 0 else 0):
        before, place = place, low + (high - low) * a / (a - b)
        if abs(place - before) <= CLOSE * abs(high - low) or not (value := f(place)):
            break
        if value * b < 0:
            low, a, b = place, value, b / 2 if side < 0 else b
            side = -1
        else:
            high, b, a = place, value, a / 2 if side > 0 else a
            side = 1
    return place

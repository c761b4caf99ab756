"""Where a wave first becomes unstable on an axisymmetric path."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import scipy

from magshell_fenicsx.axisymmetric.waves import Waves
from magshell_fenicsx.solve.path import Path, PathStopped, Point
from magshell_fenicsx.solve.system import State


@dataclass(frozen=True)
class ExcludedWaves:
    """What an axisymmetric model does not see."""

    waves: Waves

    def is_unstable(self, state: State) -> bool:
        """Whether some wave is unstable at an axisymmetric state."""
        return bool(self.waves.unstable(state))

    def first_instability(self, path: Path, points: Sequence[Point]) -> tuple[str, Point] | None:
        """The first instability in waves around the axis, "m = 7" for instance; None if there is none."""
        found = first_circumferential_instability(self.waves, path, points)
        return None if found is None else (f"m = {found[0]}", found[1])


def first_circumferential_instability(waves: Waves, path: Path, points: Sequence[Point]) -> tuple[int, Point] | None:
    """The first point of a path at which some wave m >= 1 becomes unstable.

    Parameters
    ----------
    points
        Accepted points in the order of the path. The last is looked at first, then those
        before it by bisection: a path that becomes unstable and stable again passes for stable.

    Returns
    -------
    m, point
        The wave, and the point located to 1e-7 of the step that it lies in; None if no
        wave is unstable at the last point. If the first point is unstable it is
        returned as it is.

    Raises
    ------
    PathStopped
        If Newton fails between two points that it had found.
    """
    late = waves.unstable(points[-1].state)
    if not late:
        return None
    likely_first = sorted(range(1, waves.largest + 1), key=lambda m: m not in late)

    def is_unstable(number: int) -> bool:
        return any(waves.negative_pivots(points[number].state, m) for m in likely_first)

    after = bisect_left(range(len(points) - 1), True, key=is_unstable)
    high = points[after]
    candidates = waves.unstable(high.state)
    if after == 0:
        return min(candidates, key=lambda m: waves.critical_eigenvalue(high.state, m)), high
    low = points[after - 1]
    high = path.seen_from(low, high)
    found = {low.s: low, high.s: high}

    def margins(s: float) -> dict[int, float]:
        if s not in found:
            point = path.at(s, path.between(s, low, high), low)
            if isinstance(point, str):
                raise PathStopped(f"locating a circumferential instability: {point}", low)
            found[s] = point
        return {m: waves.critical_eigenvalue(found[s].state, m) for m in candidates}

    root = scipy.optimize.brentq(lambda s: min(margins(s).values()), low.s, high.s, xtol=1e-7 * abs(high.s - low.s))
    last = margins(root)
    return min(last, key=lambda m: last[m]), found[root]

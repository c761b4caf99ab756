"""The first instability: a boundary that goes on with another mode where that becomes critical before its own."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from math import copysign

from magshell_fenicsx.continuation.augmented import Locus, NoSystem
from magshell_fenicsx.continuation.boundary import Boundary, BoundaryLost, Label
from magshell_fenicsx.continuation.system import Vector

ASIDE = 0.01  # of the range: how far beyond a crossing the other mode is taken up
HALVINGS = 7  # of that distance, until the mode is found there, and comes first


def critical(
    curve: Callable[[int, Locus], Boundary],
    null_vector: Callable[[Locus, int, int], Vector],
    mode: Boundary,
    start: Locus,
    sense: float,
    ends: tuple[float, float],
    steps: int,
) -> Iterator[tuple[Label, Locus, Boundary]]:
    """Points from a start until p leaves its range, each with the boundary that it is on.

    Where another mode becomes critical before that of the boundary, the boundary goes on with it.

    Parameters
    ----------
    curve
        The boundary of a family (0: of the model's own modes) that goes on from a crossing.
    null_vector
        Of a crossing, the family there, and that of the boundary before: the mode that becomes critical.
    mode, start, sense, ends, steps
        The first boundary, and as of `Boundary.followed`.

    Raises
    ------
    BoundaryLost, NoSystem
        See `Boundary.followed`; there is no system where another mode is taken up.
    """
    begun_by: int | None = None  # the family of the boundary before, where this one begins at their crossing
    while True:
        last, crossing = start, None
        for label, locus in mode.followed(start, sense, ends, steps):
            if last is start and label == "crossing" and locus.met == begun_by:
                continue
            yield label, locus, mode
            if label == "crossing" and not last.unstable:
                crossing = locus
                break
            last = locus
        if crossing is None:
            return
        before, mode, sense = mode.m, curve(crossing.met, crossing), crossing.p - last.p
        phi = null_vector(crossing, mode.m, before)
        if before and mode.m not in (0, before):  # neither equation knows of the other
            start = mode.start(crossing.p, crossing.state, phi)
            start, begun_by = replace(start, unstable=start.unstable - start.unstable_of(before)), before
        else:
            start, begun_by = _beyond(mode, crossing, phi, sense, ends), None
            yield "point", start, mode


def _beyond(mode: Boundary, crossing: Locus, phi: Vector, sense: float, ends: tuple[float, float]) -> Locus:
    """A point of a boundary near its crossing, where its equations are singular: if possible the first instability."""
    room = (ends[1] if sense > 0 else ends[0]) - crossing.p
    off = copysign(min(ASIDE * mode.scales[1], abs(room) / 2), sense)
    farthest: Locus | None = None
    for halvings_left in range(HALVINGS, -1, -1):
        try:
            start = mode.start(crossing.p + off, crossing.state, phi)
        except (BoundaryLost, NoSystem):
            if not halvings_left and farthest is None:
                raise
        else:
            if not start.unstable:
                return start
            farthest = farthest or start
        off /= 2
    assert farthest
    return farthest

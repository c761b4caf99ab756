"""The first instability: a boundary that goes on with another mode where that becomes critical before its own."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import copysign

from magshell_fenicsx.continuation.augmented import Locus, NoSystem
from magshell_fenicsx.continuation.boundary import Boundary, BoundaryLost, Label
from magshell_fenicsx.continuation.system import Vector

ASIDE = 0.01  # of the range: how far beyond a crossing the other mode is taken up
HALVINGS = 7  # of that distance, until the mode is found there, and comes first
ALIKE = 1e-3  # of a load: modes at a start that are so near are taken for one another by a path

Curve = Callable[[int, Locus], Boundary]
NullVector = Callable[[Locus, int, int], Vector]
Followed = Iterator[tuple[Label, Locus, Boundary]]


def critical(
    curve: Curve,
    null_vector: NullVector,
    mode: Boundary,
    start: Locus,
    sense: float,
    ends: tuple[float, float],
    steps: int,
) -> Followed:
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
        See `Boundary.followed`; there is no system where another mode is taken up; or other modes are unstable first,
        and none of them is found.
    """
    search = _Search(curve, null_vector, ends)
    begun_by: int | None = None  # the family of the boundary before, where this one begins at their crossing
    while True:
        last, onward = start, None
        for label, locus in mode.followed(start, sense, ends, steps):
            if last is start and label == "crossing" and locus.met == begun_by:
                continue
            if not last.unstable and label in ("point", "end") and _families_before(mode, locus):
                onward, sense = search.overtaking(mode, locus), locus.p - last.p
                yield label, onward.start, onward.mode
                if label == "end":
                    return
                break
            if label != "crossing" or last.unstable:
                yield label, locus, mode
                last = locus
                continue
            sense = locus.p - last.p
            try:
                onward = search.beyond(mode, locus, sense)
            except BoundaryLost:
                yield label, locus, mode
                raise
            yield label, replace(locus, met=onward.mode.m), mode
            if onward.begun_by is None:
                yield "point", onward.start, onward.mode
            break
        if onward is None:
            return
        mode, start, begun_by = onward.mode, onward.start, onward.begun_by


def first_mode(curve: Curve, null_vector: NullVector, mode: Boundary, start: Locus) -> tuple[Boundary, Locus]:
    """Return the boundary that a start belongs to, and its point: another mode's where that comes just before.

    A path that has two modes at nearly one load may have named the second. Where others come long before, the start is
    an instability beyond the first, and stays.
    """
    if not _families_before(mode, start):
        return mode, start
    try:
        before = _Search(curve, null_vector, (start.p, start.p)).overtaking(mode, start)
    except BoundaryLost:
        return mode, start
    one, other = (locus.state.mu[mode.name] for locus in (start, before.start))
    return (before.mode, before.start) if abs(one - other) <= ALIKE * abs(one) else (mode, start)


@dataclass(frozen=True)
class _Onward:
    """A boundary that goes on, its first point, and where that is a crossing the family of the boundary before."""

    mode: Boundary
    start: Locus
    begun_by: int | None = None


@dataclass(frozen=True)
class _Search:
    """Looks for the mode that is the first, among those that are unstable where another one is neutral."""

    curve: Curve
    null_vector: NullVector
    ends: tuple[float, float]

    def beyond(self, mode: Boundary, crossing: Locus, sense: float) -> _Onward:
        """Return what goes on from a crossing: the mode that becomes critical, or a third one that does so there too.

        Raises
        ------
        BoundaryLost
            If none of them is the first beyond it.
        """

        def taken_up(family: int) -> Iterator[_Onward]:
            other, phi = self._of(family, crossing, mode.m)
            if mode.m and family not in (0, mode.m):  # neither equation knows of the other
                start = other.start(crossing.p, crossing.state, phi)
                yield _Onward(other, replace(start, unstable=start.unstable - start.unstable_of(mode.m)), mode.m)
            yield _Onward(other, _beyond(other, crossing, phi, sense, self.ends))

        return self._first([crossing.met], taken_up, mode, crossing)

    def overtaking(self, mode: Boundary, locus: Locus) -> _Onward:
        """Return the mode that is the first where that of a boundary is not any more, at the same p.

        Raises
        ------
        BoundaryLost
            If none is found.
        """

        def taken_up(family: int) -> Iterator[_Onward]:
            other, phi = self._of(family, locus, mode.m)
            yield _Onward(other, other.start(locus.p, locus.state, phi))

        return self._first(_families_before(mode, locus), taken_up, mode, locus)

    def _of(self, family: int, locus: Locus, before: int) -> tuple[Boundary, Vector]:
        return self.curve(family, locus), self.null_vector(locus, family, before)

    def _first(
        self, families: Sequence[int], taken_up: Callable[[int], Iterator[_Onward]], mode: Boundary, locus: Locus
    ) -> _Onward:
        """The first mode of some families, and of those that prove to be unstable before these."""
        asked, why = [*families], "none that comes before it is the first there"
        for family in asked:  # which grows
            try:
                for onward in taken_up(family):
                    if not onward.start.unstable:
                        return onward
                    found = _families_before(onward.mode, onward.start)
                    asked += [other for other in found if other not in asked and other != mode.m]
            except (BoundaryLost, NoSystem) as e:
                why = str(e)
        load = locus.state.mu[mode.name]
        raise BoundaryLost(
            f"at {locus.p:.6g}, load {load:.6g}: another mode is unstable first, and is not found: {why}"
        )


def _families_before(mode: Boundary, locus: Locus) -> list[int]:
    """The families with modes that are unstable at a point; the model's own ones along its own are a `meeting`."""
    return [i for i, count in enumerate(locus.counts) if count and not i == mode.m == 0]


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

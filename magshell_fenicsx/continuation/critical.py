"""The first instability: a boundary that goes on with another mode where that becomes critical
before its own.
"""

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
        Of a crossing, the family there, and that of the boundary before: the mode that becomes
        critical.
    mode, start, sense, ends, steps
        The first boundary, and as of `Boundary.followed`.

    Raises
    ------
    BoundaryLost, NoSystem
        See `Boundary.followed`; there is no system where another mode is taken up; or other modes
        are unstable first, and none of them is found.
    """
    search = _Search(curve, null_vector, ends)
    begun_by: int | None = (
        None  # the family of the boundary before, where this one begins at their crossing
    )
    while True:
        last, successor = start, None
        for label, locus in mode.followed(start, sense, ends, steps):
            if last is start and label == "crossing" and locus.met == begun_by:
                continue
            if not last.unstable and label in ("point", "end") and _unstable_families(mode, locus):
                successor, sense = search.overtaking_mode(mode, locus), locus.p - last.p
                yield label, successor.start, successor.mode
                if label == "end":
                    return
                break
            if label != "crossing" or last.unstable:
                yield label, locus, mode
                last = locus
                continue
            sense = locus.p - last.p
            try:
                successor = search.mode_beyond(mode, locus, sense)
            except BoundaryLost:
                yield label, locus, mode
                raise
            yield label, replace(locus, met=successor.mode.m), mode
            if successor.begun_by is None:
                yield "point", successor.start, successor.mode
            break
        if successor is None:
            return
        mode, start, begun_by = successor.mode, successor.start, successor.begun_by


def first_mode(
    curve: Curve, null_vector: NullVector, mode: Boundary, start: Locus
) -> tuple[Boundary, Locus]:
    """Return the boundary that a start belongs to, and its point: another mode's where that comes
    just before.

    A path that has two modes at nearly one load may have named the second. Where others come long
    before, the start is an instability beyond the first, and stays.
    """
    if not _unstable_families(mode, start):
        return mode, start
    try:
        before = _Search(curve, null_vector, (start.p, start.p)).overtaking_mode(mode, start)
    except BoundaryLost:
        return mode, start
    one, other = (locus.state.mu[mode.name] for locus in (start, before.start))
    return (before.mode, before.start) if abs(one - other) <= ALIKE * abs(one) else (mode, start)


@dataclass(frozen=True)
class _Successor:
    """The boundary that goes on after another one.

    Attributes
    ----------
    mode, start
        The boundary, and its first point.
    begun_by
        The family of the boundary before, where both cross at the first point; None elsewhere.
    """

    mode: Boundary
    start: Locus
    begun_by: int | None = None


@dataclass(frozen=True)
class _Search:
    """The search for the first mode, among those that are unstable where another one is neutral.

    Attributes
    ----------
    curve, null_vector, ends
        As of `critical`.
    """

    curve: Curve
    null_vector: NullVector
    ends: tuple[float, float]

    def mode_beyond(self, mode: Boundary, crossing: Locus, sense: float) -> _Successor:
        """Return what goes on from a crossing: the mode that becomes critical, or a third one that
        does so there too.

        Raises
        ------
        BoundaryLost
            If none of them is the first beyond it.
        """

        def starts_of(family: int) -> Iterator[_Successor]:
            other, phi = self._boundary_of(family, crossing, mode.m)
            if mode.m and family not in (0, mode.m):  # neither equation knows of the other
                start = other.start(crossing.p, crossing.state, phi)
                yield _Successor(
                    other,
                    replace(start, unstable=start.unstable - start.unstable_of(mode.m)),
                    mode.m,
                )
            yield _Successor(other, _beyond(other, crossing, phi, sense, self.ends))

        return self._first_of([crossing.met], starts_of, mode, crossing)

    def overtaking_mode(self, mode: Boundary, locus: Locus) -> _Successor:
        """Return the mode that is the first where that of a boundary is not any more, at the same
        p.

        Raises
        ------
        BoundaryLost
            If none is found.
        """

        def starts_of(family: int) -> Iterator[_Successor]:
            other, phi = self._boundary_of(family, locus, mode.m)
            yield _Successor(other, other.start(locus.p, locus.state, phi))

        return self._first_of(_unstable_families(mode, locus), starts_of, mode, locus)

    def _boundary_of(self, family: int, locus: Locus, before: int) -> tuple[Boundary, Vector]:
        """Return the boundary of a family that is taken up after another one, and its null vector
        at a point."""
        return self.curve(family, locus), self.null_vector(locus, family, before)

    def _first_of(
        self,
        families: Sequence[int],
        starts_of: Callable[[int], Iterator[_Successor]],
        mode: Boundary,
        locus: Locus,
    ) -> _Successor:
        """Return the first mode of some families, and of those that prove to be unstable before
        these.

        Parameters
        ----------
        starts_of
            Family -> where it may be taken up, one after the other.
        mode, locus
            The boundary that ends, and its last point, for the message.

        Raises
        ------
        BoundaryLost
            If none is found.
        """
        families_asked, why = [*families], "none that comes before it is the first there"
        for family in families_asked:  # which grows
            try:
                for successor in starts_of(family):
                    if not successor.start.unstable:
                        return successor
                    unstable_there = _unstable_families(successor.mode, successor.start)
                    families_asked += [
                        other
                        for other in unstable_there
                        if other not in families_asked and other != mode.m
                    ]
            except (BoundaryLost, NoSystem) as e:
                why = str(e)
        load = locus.state.mu[mode.name]
        raise BoundaryLost(
            f"at {locus.p:.6g}, load {load:.6g}: another mode is unstable first, and is not found: {why}"
        )


def _unstable_families(mode: Boundary, locus: Locus) -> list[int]:
    """Return the families with modes that are unstable at a point of a boundary.

    Not the model's own family along its own boundary: such a place is a `meeting`.
    """
    return [i for i, count in enumerate(locus.counts) if count and not i == mode.m == 0]


def _beyond(
    mode: Boundary, crossing: Locus, phi: Vector, sense: float, ends: tuple[float, float]
) -> Locus:
    """Return a point of a boundary near its crossing, where its equations are singular: if possible
    the first instability."""
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

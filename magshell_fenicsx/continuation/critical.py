"""The boundary of the first instability, which may change from one mode to another.

Each mode has a boundary of its own. Along one, a crossing shows where another mode becomes critical
before it; from there the boundary of that mode is followed.

A mode is represented by its `Boundary`, a curve in (u, mu, p) whose points are instabilities of
that mode; p is the second parameter, `ends` its range and `sense` the sign of its change. Modes
belong to families, by number: 0 are the model's own, 1, 2, ... symmetry-breaking ones; `mode.m` is
the family. `unstable` and `counts` of a point are numbers of unstable directions other than its own
mode, in all and by family: where they are zero, the mode is the first. `met` is the family that
crosses there.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import copysign

from magshell_fenicsx.continuation.augmented import BoundaryPoint, NoSystem
from magshell_fenicsx.continuation.boundary import Boundary, BoundaryLost, Label
from magshell_fenicsx.continuation.system import Vector

# of the range of p: distance beyond a crossing at which the other mode is searched first
DISTANCE_BEYOND_CROSSING = 0.01
MAX_HALVINGS = 7  # of that distance, until the mode is found there, and is the first
# relative difference of two loads at a start, below which a path may confuse the modes
LOAD_TOLERANCE = 1e-3

BoundaryOfFamily = Callable[[int, BoundaryPoint], Boundary]  # (family, first point) -> boundary
# (crossing, family, family of the previous boundary) -> mode that becomes critical there
NullVector = Callable[[BoundaryPoint, int, int], Vector]
LabelledPoints = Iterator[tuple[Label, BoundaryPoint, Boundary]]


def critical_boundary(
    curve: BoundaryOfFamily,
    null_vector: NullVector,
    mode: Boundary,
    start: BoundaryPoint,
    sense: float,
    ends: tuple[float, float],
    steps: int,
) -> LabelledPoints:
    """Yield labels, points and their boundaries from a start until p leaves its range.

    The boundary of the first critical mode is followed: where another mode becomes critical first,
    its boundary takes over. Collective.

    Parameters
    ----------
    curve
        Returns the boundary of a family (0: of the model's own modes) that begins at a crossing.
    null_vector
        Returns the mode that becomes critical at a crossing, from the crossing, the family, and the
        family of the previous boundary.
    mode, start
        The first boundary, and its first point.
    sense, ends
        Sign of dp at the start, and the range of p: its least and largest value.
    steps
        No step changes p by more than its scale over this number.

    Raises
    ------
    BoundaryLost, NoSystem
        If a boundary cannot be followed, there is no system at the point where another boundary
        begins, or other modes are unstable first and none of them is found.
    """
    search = _FirstModeSearch(curve, null_vector, ends)
    # the family of the previous boundary, where this one begins at their crossing
    begun_by: int | None = None
    while True:
        # successor: the boundary that takes over; None as long as this one goes on
        last_point, successor = start, None
        for label, point in mode.follow(start, sense, ends, steps):
            # the crossing at which this boundary began is found again: it is left out
            if last_point is start and (label, point.met) == ("crossing", begun_by):
                continue
            # other modes have become unstable, though no crossing was located
            may_be_overtaken = label in ("point", "end") and not last_point.unstable
            if may_be_overtaken and _unstable_families(mode, point):
                successor, sense = search.overtaking_mode(mode, point), point.p - last_point.p
                yield label, successor.start, successor.mode
                if label == "end":
                    return
                break
            # no change of the first mode: at any other event, and at crossings behind which other
            # modes were unstable already
            if label != "crossing" or last_point.unstable:
                yield label, point, mode
                last_point = point
                continue
            # a crossing: the other mode becomes critical first beyond it
            sense = point.p - last_point.p
            try:
                successor = search.mode_beyond(mode, point, sense)
            except BoundaryLost:
                yield label, point, mode
                raise
            yield label, replace(point, met=successor.mode.m), mode
            if successor.begun_by is None:  # it begins beside the crossing
                yield "point", successor.start, successor.mode
            break
        if successor is None:
            return
        mode, start, begun_by = successor.mode, successor.start, successor.begun_by


def first_mode(
    curve: BoundaryOfFamily, null_vector: NullVector, mode: Boundary, start: BoundaryPoint
) -> tuple[Boundary, BoundaryPoint]:
    """Return the boundary to which an instability belongs, and its point on that boundary.

    A path with two modes at nearly one load may have named the second: if another mode becomes
    critical just before, its boundary is returned. If others become critical long before, the path
    has passed the first instability; then the given boundary and point are returned. Collective.

    Parameters
    ----------
    curve, null_vector
        Return the boundary of a family that begins at a point, and a vector near its null vector.
    mode, start
        The boundary that the path has named, and the point on it.
    """
    if not _unstable_families(mode, start):
        return mode, start
    try:
        search = _FirstModeSearch(curve, null_vector, (start.p, start.p))
        overtaking = search.overtaking_mode(mode, start)
    except BoundaryLost:
        return mode, start
    # the path cannot tell two modes at nearly one load apart
    load, other_load = (point.state.mu[mode.name] for point in (start, overtaking.start))
    if abs(load - other_load) <= LOAD_TOLERANCE * abs(load):
        return overtaking.mode, overtaking.start
    return mode, start


@dataclass(frozen=True)
class _Successor:
    """The boundary that continues after another one.

    Attributes
    ----------
    mode, start
        The boundary, and its first point.
    begun_by
        The family of the previous boundary, where both cross at the first point; None elsewhere.
    """

    mode: Boundary
    start: BoundaryPoint
    begun_by: int | None = None


@dataclass(frozen=True)
class _FirstModeSearch:
    """The search for the mode that becomes critical first, where others are unstable too.

    Attributes
    ----------
    curve
        Returns the boundary of a family that begins at a point.
    null_vector
        Returns a vector near its null vector, from the point, the family and the previous family.
    ends
        The range of p.
    """

    curve: BoundaryOfFamily
    null_vector: NullVector
    ends: tuple[float, float]

    def mode_beyond(self, mode: Boundary, crossing: BoundaryPoint, sense: float) -> _Successor:
        """Return the boundary beyond a crossing, of the mode that becomes critical there.

        It may belong to a third mode that becomes critical there too. If the equations of both
        modes do not couple, it begins at the crossing itself. If they do, they are singular there,
        and the boundary begins at a p beside the crossing.

        Parameters
        ----------
        mode
            The boundary on which the crossing lies.
        sense
            Sign of the change of p along the boundary.

        Raises
        ------
        BoundaryLost
            If none of the modes is the first beyond the crossing.
        """

        def starts_of(family: int) -> Iterator[_Successor]:
            """Yield the boundary of a family with each point at which it may begin.

            That is the crossing, if the equations do not couple, then a point beyond it.
            """
            boundary, phi = self._boundary_of(family, crossing, mode.m)
            if mode.m and family not in (0, mode.m):  # the two equations do not couple
                start = boundary.start(crossing.p, crossing.state, phi)
                # the mode of the boundary that ends is neutral there and does not count
                unstable = start.unstable - start.unstable_of(mode.m)
                yield _Successor(boundary, replace(start, unstable=unstable), mode.m)
            yield _Successor(boundary, _point_beyond(boundary, crossing, phi, sense, self.ends))

        return self._first_of([crossing.met], starts_of, mode, crossing)

    def overtaking_mode(self, mode: Boundary, point: BoundaryPoint) -> _Successor:
        """Return the first mode at a point of a boundary at which other modes are unstable.

        Its boundary starts at the same p.

        Raises
        ------
        BoundaryLost
            If no such mode is found.
        """

        def starts_of(family: int) -> Iterator[_Successor]:
            """Yield the point of a family's boundary at the same p."""
            boundary, phi = self._boundary_of(family, point, mode.m)
            yield _Successor(boundary, boundary.start(point.p, point.state, phi))

        return self._first_of(_unstable_families(mode, point), starts_of, mode, point)

    def _boundary_of(
        self, family: int, point: BoundaryPoint, previous_family: int
    ) -> tuple[Boundary, Vector]:
        """Return the boundary of a family that follows another one at a point, and its null vector.

        Parameters
        ----------
        previous_family
            The family of the boundary that ends there.
        """
        return self.curve(family, point), self.null_vector(point, family, previous_family)

    def _first_of(
        self,
        families: Sequence[int],
        starts_of: Callable[[int], Iterator[_Successor]],
        mode: Boundary,
        point: BoundaryPoint,
    ) -> _Successor:
        """Return the first boundary, among those of some families, whose mode is the first.

        A mode is the first if no other mode is unstable at the point where its boundary begins.
        Families of modes that are unstable there become candidates, too.

        Parameters
        ----------
        families
            The first candidates.
        starts_of
            Called with a family. It yields its boundary with the points at which that may begin.
        mode, point
            The boundary that ends, and its last point, for the message.

        Raises
        ------
        BoundaryLost
            If no mode is the first.
        """
        candidates, reason = [*families], "none that comes before it is the first there"
        for family in candidates:  # the list grows in the loop
            try:
                for successor in starts_of(family):
                    if not successor.start.unstable:
                        return successor
                    for other_family in _unstable_families(successor.mode, successor.start):
                        if other_family not in candidates and other_family != mode.m:
                            candidates.append(other_family)
            except (BoundaryLost, NoSystem) as e:
                reason = str(e)
        load = point.state.mu[mode.name]
        raise BoundaryLost(
            f"at {point.p:.6g}, load {load:.6g}: another mode is unstable first, "
            f"and is not found: {reason}"
        )


def _unstable_families(mode: Boundary, point: BoundaryPoint) -> list[int]:
    """Return the families with modes that are unstable at a point of a boundary.

    The model's own family, 0, does not count along its own boundary: such a place is a `meeting`.
    """
    return [i for i, count in enumerate(point.counts) if count and not i == mode.m == 0]


def _point_beyond(
    mode: Boundary, crossing: BoundaryPoint, phi: Vector, sense: float, ends: tuple[float, float]
) -> BoundaryPoint:
    """Return a point of a boundary near a crossing, at which its equations are singular.

    The distance is halved until no mode is unstable at the point; if this never happens, it is the
    farthest point.

    Parameters
    ----------
    mode
        The boundary that begins at the crossing.
    phi
        A vector near its null vector.
    sense
        Sign of the change of p from the crossing.
    ends
        The range of p.

    Raises
    ------
    BoundaryLost, NoSystem
        If no point is found.
    """
    available = (ends[1] if sense > 0 else ends[0]) - crossing.p
    distance = min(DISTANCE_BEYOND_CROSSING * mode.scales[1], abs(available) / 2)
    dp = copysign(distance, sense)
    farthest: BoundaryPoint | None = None
    for halvings_left in range(MAX_HALVINGS, -1, -1):
        try:
            start = mode.start(crossing.p + dp, crossing.state, phi)
        except (BoundaryLost, NoSystem):
            if not halvings_left and farthest is None:  # no distance has a point
                raise
        else:
            if not start.unstable:
                return start
            farthest = farthest or start
        dp /= 2
    assert farthest
    return farthest

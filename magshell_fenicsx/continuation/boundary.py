"""Boundaries of stability: a fold or a bifurcation continued in a second parameter p.

Both are curves in (u, mu, p), whose equations `augmented` has, and `symmetry_breaking` for
symmetry-breaking modes. They are followed by arc length, through turning points of p; cubics
predict. Along folds v . (R_mu dmu + R_p dp) = 0. So where p turns, mu turns too and the curve goes
along v alone, a cusp, at which v . Pi'''(v, v) is zero; or v . R_mu is zero: two folds meet at a
bifurcation.

A `BoundaryPoint` has the state, the null vector phi of K and the boundary's tangent `way`; a
`CurveVector` (du, dmu, dp) is a direction or, as a prediction, a point (u, mu, p). mu is the one
unknown load parameter (amplitude), by name. `low` and `high` are two successive points, a guess the
predicted (u, mu, p). A row is the scalar equation that says where on the boundary a point is. R =
dPi/du, K = dR/du, v is phi with another scale; Pi''' is the third derivative of the potential.
Numbers of unstable directions never count phi.

`family` is a `SystemFamily`: one system for each p, costly if each is made anew. A family of modes,
by number, shares a tangent: 0 the model's own modes, 1, 2, ... symmetry-breaking modes, which the
model excludes. A turn is where p turns back; a meeting, on a boundary of the model, where a second
mode of the model is neutral; a crossing, where any other second mode is. At these two `second` is
zero, the eigenvalue nearest to zero other than that of phi.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal, cast

import numpy as np

from magshell_fenicsx.continuation.augmented import (
    AugmentedRows,
    BoundaryPoint,
    CurveRow,
    CurveVector,
    DifferenceSystem,
    Kind,
    NoSystem,
    SystemFamily,
)
from magshell_fenicsx.continuation.fold import AugmentedTangent
from magshell_fenicsx.continuation.interpolation import (
    hermite,
    interpolated,
    slope_weights,
    stationary,
)
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.symmetry_breaking import (
    SymmetryBreakingRows,
    SymmetryBreakingSystems,
    nearest_eigenvalue,
)
from magshell_fenicsx.continuation.system import State, Vector, dot, max_abs

Label = Literal["start", "point", "cusp", "turn", "meeting", "crossing", "end"]
# estimated remaining error of u, in lengths; along v it changes the load by its square
TOLERANCE = 1e-6
LOAD_TOLERANCE = 1e-9  # the same of the load, over its scale
MAX_ITERATIONS = 8
MAX_STEP = 10.0  # in lengths; a longer one counts as divergence
EASY_ITERATIONS = 2  # iterations after which a step grows
# cosine of successive tangents: a smaller one is refused; with a larger one steps grow
MIN_COSINE, GROWTH_COSINE = 0.6, 0.95
MAX_CORRECTION = 0.5  # of a step: a larger correction of its prediction counts as a jump
MIN_NULL_VECTOR_COSINE = 0.5  # of successive null vectors
MIN_STEP_RATIO = 1e-4  # the smallest step over the first
# part of p in the tangent from which points of costly systems are taken at a given p
MIN_SLOPE_FOR_GIVEN_P = 0.2
TURN_TOLERANCE = 1e-10  # of the range of p: how closely p is stationary where it turns
MIN_BRACKET = 1e-9  # of a step: distance of a turn from the ends of its bracket
MAX_TRIALS, MAX_POINTS = 12, 400
END_BISECTIONS = 50  # for the place where a prediction leaves the range
MAX_MEETING_POINTS = 8  # points that are solved near a meeting
INTERPOLATED_POINTS = 4  # of these, that are interpolated
MEETING_TOLERANCE = 1e-3  # of the step: distance of an interpolated meeting from a point
ROUNDING = 1e-12  # relative, of an amplitude
# points whose systems give a slope by p, and their least distance, over the range
SLOPE_POINTS, MIN_SLOPE_DISTANCE = 3, 1e-3


class BoundaryLost(RuntimeError):
    """The boundary could not be followed further; the message gives the reason."""


class Boundary:
    """A boundary of stability in the plane of an amplitude mu and of a second parameter p.

    Each `BoundaryPoint` on it is an instability at its p. All methods that solve are collective.

    Parameters
    ----------
    family
        The systems at all p; for m > 0 with the tangents of symmetry-breaking modes.
    name
        The amplitude mu, which is unknown.
    kind
        Whether the instability is a fold or a bifurcation.
    scales
        Changes of the amplitude and of p that count as of order one in the arc length.
    recorded
        Called with a function that solves. It returns the function's result or, in a resumed run,
        the stored one.
    m
        The family of symmetry-breaking modes in which the bifurcation is; 0: it is one of the model
        itself.
    watched
        Whether symmetry-breaking modes are counted along a boundary of the model itself.

    Private fields: `_counts_families` tells whether symmetry-breaking modes are counted at points.
    `start` sets `_weight`, the factor of du . du in the metric, `_length`, the system's length, and
    `_comm`, its communicator. `_solved_at` are the values of p of all solved points.
    """

    def __init__(
        self,
        family: SystemFamily | SymmetryBreakingSystems,
        name: str,
        kind: Kind,
        scales: tuple[float, float],
        recorded: "Callable[[Callable[[], BoundaryPoint | str]], BoundaryPoint | str]" = (
            lambda solve: solve()
        ),
        m: int = 0,
        watched: bool = False,
    ) -> None:
        self.family, self.name, self.kind, self.scales, self.m = family, name, kind, scales, m
        self._counts_families = watched or m > 0
        self._recorded = recorded
        self._weight = 0.0
        self._solved_at = list[float]()

    def inner(self, a: CurveVector, b: CurveVector) -> float:
        """Return the inner product <a, b> of the arc length. Collective.

        u counts by its mean square over the system's length, mu and p over their scales.
        """
        mu_scale, p_scale = self.scales
        displacement = self._weight * dot(self._comm, a.du, b.du)
        return displacement + a.dmu * b.dmu / mu_scale**2 + a.dp * b.dp / p_scale**2

    def start(self, p: float, state: State, phi: Vector) -> BoundaryPoint:
        """Return the point at p near an instability that a path has located. Collective.

        Parameters
        ----------
        state
            The state at the instability.
        phi
            A vector near the null vector.

        Raises
        ------
        BoundaryLost
            If no point is found, or a load has no potential.
        """
        solver = self.family.solver_at(p)
        system = solver.system
        self._comm, self._length = system.comm, system.length
        # of du . du in the metric: the mean square over the length
        self._weight = 1 / (float(system.comm.allreduce(system.size)) * system.length**2)
        if solver.factor_at(state).skewed:
            raise BoundaryLost(
                "a load without potential: its tangent is not symmetric, "
                "and no boundary is followed"
            )
        point = self._solve(p, state, b=phi, row=_row_at(p), neighbour=None)
        if isinstance(point, str):
            raise BoundaryLost(f"the {self.kind} at {p:.6g} is not found again: {point}")
        return replace(point, p=p)

    def follow(
        self, start: BoundaryPoint, sense: float, ends: tuple[float, float], steps: int
    ) -> Iterator[tuple[Label, BoundaryPoint]]:
        """Yield pairs of a label and a point, from a start until p leaves its range.

        The start itself is not yielded. Cusps, turns, meetings and crossings come between the
        points. Collective.

        Parameters
        ----------
        start
            A point of the boundary.
        sense
            Sign of dp at the start.
        ends
            The range of p: its least and largest value.
        steps
            No step changes p by more than its scale over this number.

        Raises
        ------
        BoundaryLost
            If the smallest step fails, or the points are too many.
        """
        current = start if start.way.dp * sense >= 0 else _reversed(start)
        previous: tuple[BoundaryPoint, float] | None = None  # the previous point, and its step
        max_dp = self.scales[1] / steps
        # the arc length that changes p by `max_dp`, at most 10/steps where p hardly changes
        first_length = min(
            max_dp / max(abs(current.way.dp), 1e-3 * self.scales[1]), 2.0 / steps * 5
        )
        length = first_length
        for _ in range(MAX_POINTS):
            guess = self._predict(previous, current, length)
            guess_is_inside = ends[0] < guess.dp < ends[1]
            if not guess_is_inside:
                end = self._point_at_end(previous, current, length, ends)
                if end:
                    end_point, distance = end
                    yield from self._events_between(current, end_point, distance)
                    yield "end", end_point
                    return
            # the next point, or the reason why there is none: first that of a guess outside the
            # range, behind which no end point was found
            point: BoundaryPoint | str = "the end of the range is not reached at once"
            if guess_is_inside:
                point = self._correct(current, guess, length)
            # another trial with half the length
            if isinstance(point, str):
                length /= 2
                if length < MIN_STEP_RATIO * first_length:
                    raise BoundaryLost(
                        f"at {current.p:.6g}, load {current.state.mu[self.name]:.6g}: {point}"
                    )
                continue
            if not ends[0] < point.p < ends[1]:  # outside the range, though its guess was inside
                length /= 2
                continue
            step = self._distance(current, point, length)
            yield from self._events_between(current, point, step)
            yield "point", point
            length = min(
                self._adapted_length(length, current, point, max_dp), 3 * first_length, 2 * step
            )
            previous, current = (current, step), point
        raise BoundaryLost(f"{MAX_POINTS} points have not reached the end of the range")

    def _adapted_length(
        self, length: float, low: BoundaryPoint, high: BoundaryPoint, max_dp: float
    ) -> float:
        """Return the length of the step from `high`, after a step of `length` from `low` to it.

        Easy steps on a straight stretch grow, hard ones shrink. The new step changes p by little
        more than `max_dp`.
        """
        is_straight = self.inner(low.way, high.way) > GROWTH_COSINE
        if high.factorisations <= EASY_ITERATIONS and is_straight:
            length = 1.5 * length
        elif high.factorisations > 2 * EASY_ITERATIONS:
            length = 0.7 * length
        return min(length, 1.2 * max_dp / max(abs(high.way.dp), 1e-300))

    def _events_between(
        self, low: BoundaryPoint, high: BoundaryPoint, length: float
    ) -> Iterator[tuple[Label, BoundaryPoint]]:
        """Yield cusps, turns, meetings and crossings between two successive points.

        A turn is where p turns back, and a cusp is one where v . Pi'''(v, v) changes its sign too.
        Where the number of unstable directions of a family of modes differs, a second mode becomes
        neutral between the points: a meeting within the model's own family, a crossing otherwise.

        Parameters
        ----------
        length
            Distance of the points along the tangent of the first.
        """
        if low.way.dp * high.way.dp < 0:
            turn = self._locate_turn(low, high, length)
            is_cusp = self.kind == "fold" and low.cubic * high.cubic < 0
            yield "cusp" if is_cusp else "turn", turn
        if self._counts_families:
            yield from self._crossings_between(low, high, length)
        elif low.unstable != high.unstable:
            point = self._locate_meeting(low, high, length, count=lambda point: point.unstable)
            if point:
                yield "meeting", point

    def _crossings_between(
        self, low: BoundaryPoint, high: BoundaryPoint, length: float
    ) -> Iterator[tuple[Label, BoundaryPoint]]:
        """Yield meetings and crossings between two points at which modes are counted by family.

        Parameters
        ----------
        length
            Distance of the points along the tangent of the first.
        """
        families = range(max(len(low.counts), len(high.counts)))
        changed_families = [i for i in families if low.unstable_of(i) != high.unstable_of(i)]
        located = {
            i: self._locate_meeting(
                low, high, length, count=partial(BoundaryPoint.unstable_of, family=i), family=i
            )
            for i in changed_families
        }
        events = [(i, point) for i, point in located.items() if point]
        # in the order of p; `counts` are those of all families just before each point
        counts = [low.unstable_of(i) for i in families]
        for i, point in sorted(events, key=lambda event: abs(event[1].p - low.p)):
            if i == self.m == 0:  # a mode of the model, on a boundary of the model
                yield "meeting", replace(point, met=i)
            else:
                # the located point has counts of a nearby point, which may lie beyond other
                # crossings: they are replaced
                unstable = sum(counts)
                yield "crossing", replace(point, met=i, counts=tuple(counts), unstable=unstable)
            counts[i] = high.unstable_of(i)

    def _predict(
        self, previous: tuple[BoundaryPoint, float] | None, current: BoundaryPoint, length: float
    ) -> CurveVector:
        """Predict the point (u, mu, p) after a step of a length along the current tangent.

        Parameters
        ----------
        previous
            The point before the current one, and the distance between them. The cubic through both
            points with their tangents predicts; if it is None, the tangent does.
        """
        if previous is None:
            mu, tangent = current.state.mu[self.name], current.way
            return CurveVector(
                current.state.u + length * tangent.du,
                mu + length * tangent.dmu,
                current.p + length * tangent.dp,
            )
        low, step = previous
        # the place on the cubic: 0 at the previous point, 1 at the current one. The length along
        # the current tangent is projected on the tangent of the previous point
        t = 1 + length * self.inner(low.way, current.way) / step
        return self._hermite(low, current, step, t)

    def _hermite(
        self, low: BoundaryPoint, high: BoundaryPoint, step: float, t: float
    ) -> CurveVector:
        """Return the place (u, mu, p) on the cubic through two points and their tangents.

        Parameters
        ----------
        step
            Distance of both points, measured along the tangent of the first.
        t
            The place in units of the step: 0 at the first point, 1 at the second.
        """
        name = self.name
        # the second tangent has length one; per unit of distance along the first it is longer
        stretch = 1 / self.inner(low.way, high.way)
        # weights of the values at both points, and of the slopes per unit of t
        (low_weight, low_slope_weight), (high_weight, high_slope_weight) = hermite(t, (0.0, 1.0))
        # weights of both tangents, which are slopes per unit of distance
        a, b = step * low_slope_weight, step * stretch * high_slope_weight

        def cubic(x0: float, d0: float, x1: float, d1: float) -> float:
            """Return the value for the values x0, x1 and slopes d0, d1 at both points."""
            return low_weight * x0 + a * d0 + high_weight * x1 + b * d1

        u = low_weight * low.state.u + a * low.way.du + high_weight * high.state.u + b * high.way.du
        return CurveVector(
            u,
            cubic(low.state.mu[name], low.way.dmu, high.state.mu[name], high.way.dmu),
            cubic(low.p, low.way.dp, high.p, high.way.dp),
        )

    def _correct(
        self, current: BoundaryPoint, guess: CurveVector, length: float
    ) -> BoundaryPoint | str:
        """Return the point near a guess, or the reason why there is none.

        The point is solved at the predicted p if systems at other p are costly, so that one system
        serves all iterations; otherwise at a distance along the current tangent.

        Parameters
        ----------
        length
            That distance.
        """
        if not self._is_taken_at_given_p(current):
            return self._correct_at_distance(current, guess, length)
        return self._correct_on_row(current, guess, length, _row_at(guess.dp), low_order=True)

    def _is_taken_at_given_p(self, current: BoundaryPoint) -> bool:
        """Return whether the point after the current one is solved at a given p.

        This is so if systems are costly and p changes enough along the boundary; near a turn there
        may be no point at a given p.
        """
        slope = abs(current.way.dp) / self.scales[1]
        return self.family.costly and slope > MIN_SLOPE_FOR_GIVEN_P

    def _distance(self, current: BoundaryPoint, next_point: BoundaryPoint, length: float) -> float:
        """Return the distance between two successive points along the tangent of the first.

        Parameters
        ----------
        length
            The distance at which the second point was solved, if it was not solved at a given p.
        """
        if not self._is_taken_at_given_p(current):
            return length
        # at a given p the distance was not prescribed: it follows from the solution
        name = self.name
        chord = CurveVector(
            next_point.state.u - current.state.u,
            next_point.state.mu[name] - current.state.mu[name],
            next_point.p - current.p,
        )
        return self.inner(current.way, chord)

    def _correct_at_distance(
        self,
        base: BoundaryPoint,
        guess: CurveVector,
        length: float,
        *,
        eigenvalue_family: int | None = None,
    ) -> BoundaryPoint | str:
        """Return the point at a distance along the tangent of a base, or why there is none.

        Parameters
        ----------
        length
            The distance from the base.
        eigenvalue_family
            The family whose second eigenvalue the point gets; None: none.
        """
        tangent, (mu_scale, p_scale), name = base.way, self.scales, self.name

        def value(u: Vector, m: float, q: float) -> float:
            """Return <tangent, (u, m, q) - base> - length, which is zero at the point."""
            chord = CurveVector(u - base.state.u, m - base.state.mu[name], q - base.p)
            return self.inner(tangent, chord) - length

        # the gradient of that value by u, mu and p
        row = CurveRow(
            self._weight * tangent.du, tangent.dmu / mu_scale**2, tangent.dp / p_scale**2, value
        )
        return self._correct_on_row(base, guess, length, row, eigenvalue_family=eigenvalue_family)

    def _correct_with_eigenvalue(
        self, base: BoundaryPoint, guess: CurveVector, s: float, family: int
    ) -> BoundaryPoint | str:
        """Return a point with the second eigenvalue of a family, or the reason why there is none.

        The point is at the distance `s` from a base. A boundary of symmetry-breaking modes (m > 0)
        has equations that do not couple with another family. Its point is solved at the p of the
        guess instead, where that is cheaper.
        """
        if not (self.m and self._is_taken_at_given_p(base)):
            return self._correct_at_distance(base, guess, s, eigenvalue_family=family)
        return self._correct_on_row(
            base, guess, s, _row_at(guess.dp), eigenvalue_family=family, low_order=True
        )

    def _correct_on_row(
        self,
        base: BoundaryPoint,
        guess: CurveVector,
        length: float,
        row: CurveRow,
        *,
        eigenvalue_family: int | None = None,
        low_order: bool = False,
    ) -> BoundaryPoint | str:
        """Return the point near a guess on which a row holds, or the reason why it is not accepted.

        It is not accepted if it is far from the guess, or if the boundary turns sharply between the
        base and the point: then the step has jumped to another boundary.

        Parameters
        ----------
        length
            Length of the step from the base, in which the correction of the guess is measured.
        eigenvalue_family
            The family whose second eigenvalue the point gets; None: none.
        low_order
            Whether a difference by p of low order is enough.
        """
        name = self.name
        point = self._solve(
            p=guess.dp,
            state=State(guess.du, {name: guess.dmu}),
            b=base.phi,
            row=row,
            neighbour=base,
            eigenvalue_family=eigenvalue_family,
            low_order=low_order,
        )
        if isinstance(point, str):
            return point
        # the fields of the guess are those of a point: u, mu, p
        correction = CurveVector(
            point.state.u - guess.du, point.state.mu[name] - guess.dmu, point.p - guess.dp
        )
        if np.sqrt(self.inner(correction, correction)) > MAX_CORRECTION * abs(length):
            return "a step ends far from its prediction"
        if self.inner(base.way, point.way) < MIN_COSINE:
            return "the boundary turns too sharply"
        return point

    def _point_at_end(
        self,
        previous: tuple[BoundaryPoint, float] | None,
        current: BoundaryPoint,
        length: float,
        ends: tuple[float, float],
    ) -> tuple[BoundaryPoint, float] | None:
        """Return the point at the end of the range of p, and its distance from the current point.

        Bisection finds where the prediction leaves the range; the point is solved at that end.

        Parameters
        ----------
        previous
            The point before the current one and its distance, from which the cubic predicts.
        length
            A step whose prediction is outside the range.
        ends
            The range of p.

        Returns
        -------
        The point and its distance; None if the boundary does not reach the end in this step.
        """
        # the distance at which the prediction leaves the range
        inside, outside = 0.0, length
        for _ in range(END_BISECTIONS):
            middle = (inside + outside) / 2
            is_inside = ends[0] < self._predict(previous, current, middle).dp < ends[1]
            inside, outside = (middle, outside) if is_inside else (inside, middle)
        guess = self._predict(previous, current, outside)
        end = float(min(ends, key=lambda end: abs(end - guess.dp)))
        point = self._solve(
            p=end,
            state=State(guess.du, {self.name: guess.dmu}),
            b=current.phi,
            row=_row_at(end),
            neighbour=current,
            low_order=self._is_taken_at_given_p(current),
        )
        # a point behind a turn, behind a sharp bend or far from the guess lies on another part of
        # the boundary
        if isinstance(point, str) or point.way.dp * current.way.dp < 0:
            return None
        if self.inner(point.way, current.way) < MIN_COSINE:
            return None
        correction = CurveVector(
            point.state.u - guess.du, point.state.mu[self.name] - guess.dmu, 0.0
        )
        if np.sqrt(self.inner(correction, correction)) > MAX_CORRECTION * outside:
            return None
        return replace(point, p=end), outside

    def _locate_turn(self, low: BoundaryPoint, high: BoundaryPoint, length: float) -> BoundaryPoint:
        """Return the point between two others where p turns.

        It is the stationary point of the cubic through both, repeated with the solved point in
        place of one end. Collective.

        Parameters
        ----------
        length
            Distance of the points along the tangent of the first.
        """
        # a, b: distances of `low` and `high` along the tangent of the base, the first point
        base, a, b = low, 0.0, length
        best = min(low, high, key=lambda point: abs(point.way.dp))
        for _ in range(MAX_TRIALS):
            # slopes of p by the distance along the tangent of the base
            d0, d1 = (point.way.dp / self.inner(base.way, point.way) for point in (low, high))
            s = a + (b - a) * stationary((high.p - low.p) / (b - a), d0, d1)
            # the step is measured along the tangent of `low`; t is the place in it, from 0 to 1
            step, t = (b - a) / self.inner(base.way, low.way), (s - a) / (b - a)
            guess = self._hermite(low, high, step, t)
            middle = self._correct_at_distance(base, guess, s)
            if isinstance(middle, str):  # rounding prevents a solve: the cubic is as good
                state = best.state.with_(guess.du, self.name, float(guess.dmu))
                return replace(best, p=float(guess.dp), state=state)
            best = middle if abs(middle.way.dp) < abs(best.way.dp) else best
            is_before = middle.way.dp * low.way.dp > 0
            opposite_end, distance_to_end = (high, b - s) if is_before else (low, s - a)
            curvature = abs(opposite_end.way.dp - middle.way.dp) / distance_to_end
            # near the turn p is a parabola in the arc length
            error = middle.way.dp**2 / (2 * curvature) if curvature else 0.0
            is_accurate = error <= TURN_TOLERANCE * self.scales[1]
            if is_accurate or min(s - a, b - s) < MIN_BRACKET * length:
                break
            # the solved point replaces the end on its side of the turn
            if is_before:
                low, a = middle, s
            else:
                high, b = middle, s
        return best

    def _locate_meeting(
        self,
        low: BoundaryPoint,
        high: BoundaryPoint,
        length: float,
        count: Callable[[BoundaryPoint], int],
        family: int = 0,
    ) -> BoundaryPoint | None:
        """Locate the point between two others where a second eigenvalue of a family is zero.

        Inverse interpolation of the eigenvalue finds it. The modes of the boundary's own family and
        of the model couple with its equations, which are singular there. So the point is
        interpolated between solved points that are close by. Other families do not couple, and
        points may be solved much closer to it. Collective.

        Parameters
        ----------
        length
            Distance of the points along the tangent of the first.
        count
            Returns the number of unstable directions of the family at a point.
        family
            The family: 0 for the model itself.

        Returns
        -------
        The point; None if no point is found between the two.
        """
        is_coupled = family in (0, self.m)
        tolerance = MEETING_TOLERANCE if is_coupled else MEETING_TOLERANCE**2
        # distances from `low` with their solved points, those with the smallest eigenvalues first
        solved = list[tuple[float, BoundaryPoint]]()
        # a, b: distances between which the number of unstable directions changes; s: the next one
        # at which a point is solved
        a, b, s = 0.0, length, length / 2
        for _ in range(MAX_MEETING_POINTS):
            guess = self._hermite(low, high, length, s / length)
            # a point with its second eigenvalue; near the meeting there may be none
            point = self._correct_with_eigenvalue(low, guess, s, family)
            if isinstance(point, str):
                break
            if any(s == other_s or point.second == other.second for other_s, other in solved):
                break  # nothing more to interpolate
            solved = sorted([*solved, (s, point)], key=lambda entry: abs(entry[1].second))
            solved = solved[:INTERPOLATED_POINTS]
            a, b = (s, b) if count(point) == count(low) else (a, s)
            s = (a + b) / 2
            if len(solved) > 1:
                distances = [distance for distance, _ in solved]
                # inverse interpolation: the distance at which the eigenvalue is zero
                zero = interpolated([point.second for _, point in solved], distances, 0.0)
                is_inside = a < zero < b
                change = abs(zero - distances[0])  # from the best solved point
                outside_by_rounding = not is_inside and change < MEETING_TOLERANCE * length
                if outside_by_rounding or change < tolerance * length:
                    s = zero
                    break
                s = zero if is_inside else s  # else bisection
        if len(solved) < 2:  # too few to interpolate
            return solved[0][1] if solved else None
        return self._interpolated_point(solved, s)

    def _interpolated_point(
        self, solved: Sequence[tuple[float, BoundaryPoint]], s: float
    ) -> BoundaryPoint:
        """Return the nearest solved point, with p and amplitude interpolated at the distance `s`.

        The amplitude is interpolated a second time without the last of the solved points. The
        difference of both results is added to the load error.

        Parameters
        ----------
        solved
            Pairs of a distance and its point, those with the smallest second eigenvalues first.
        """
        distances = [distance for distance, _ in solved]
        _, nearest = solved[0]
        loads = [point.state.mu[self.name] for _, point in solved]
        p = interpolated(distances, [point.p for _, point in solved], s)
        load = interpolated(distances, loads, s)
        load_change = abs(load - interpolated(distances[:-1], loads[:-1], s))
        return replace(
            nearest,
            p=p,
            state=nearest.state.with_(nearest.state.u, self.name, load),
            load_error=load_change + nearest.load_error,
        )

    def _rows(
        self,
        newton: BorderedNewton,
        state: State,
        b: Vector,
        p: float,
        difference: Sequence[tuple[float, float]],
    ) -> AugmentedRows | SymmetryBreakingRows:
        """Return the equations of Newton's step at a state, whose tangent is bordered by b.

        Parameters
        ----------
        newton
            The solver of the system at p.
        b
            A vector near the null vector: with it as border the singular tangent becomes regular.
        difference
            Pairs of a weight and a p: derivatives by p are weighted sums over the systems there.
        """
        if self.m:
            family = cast(SymmetryBreakingSystems, self.family)
            return SymmetryBreakingRows(newton, state, self.name, b, self.m, family, p, difference)
        # the unknown amplitude is the same in the systems at all p
        tangent, load = AugmentedTangent(newton, state, b), {self.name: state.mu[self.name]}
        systems = [
            DifferenceSystem(
                weight,
                self.family.solver_at(q).system,
                {**self.family.amplitudes(q), **load},
                is_same_p=p == q,
            )
            for weight, q in difference
        ]
        return AugmentedRows(
            self.kind, newton.system, state, self.name, tangent, systems, self.scales
        )

    def _counts(
        self, rows: AugmentedRows | SymmetryBreakingRows, p: float, state: State
    ) -> Sequence[int]:
        """Return `BoundaryPoint.counts`: the unstable directions of each family, without phi."""
        if isinstance(rows, SymmetryBreakingRows):
            return rows.counts()
        if not self._counts_families:
            return [rows.unstable]
        return [rows.unstable, *cast(SymmetryBreakingSystems, self.family).counts(p, state)]

    def _second_eigenvalue(
        self, rows: AugmentedRows | SymmetryBreakingRows, family: int, p: float, state: State
    ) -> float:
        """Return the eigenvalue of a family nearest to zero, other than that of the null vector.

        Parameters
        ----------
        rows
            Rows of the last step of Newton's method, at the state.
        """
        # on a boundary of the model itself the rows know no tangent of a symmetry-breaking family
        if family and not self.m:
            systems = cast(SymmetryBreakingSystems, self.family)
            return nearest_eigenvalue(systems.factored_tangent(p, state, family), self._comm)
        return rows.eigenvalue(family, p, state)

    def _solve(
        self,
        p: float,
        state: State,
        b: Vector,
        row: CurveRow,
        neighbour: BoundaryPoint | None,
        *,
        eigenvalue_family: int | None = None,
        low_order: bool = False,
    ) -> BoundaryPoint | str:
        """Return the point near a guess on which a row holds, or the reason why there is none.

        The result passes through `recorded`. Collective.

        Parameters
        ----------
        p, state, b
            The guess, and a vector near the null vector.
        row
            The equation that says where on the boundary the point is.
        neighbour
            A nearby point, whose null vector and tangent orient those of the result; None: any
            sign.
        eigenvalue_family
            The family whose second eigenvalue the point gets; None: none.
        low_order
            Whether a difference by p of low order is enough: p is given, and derivatives by p only
            serve the tangent of the boundary.
        """

        def solve() -> BoundaryPoint | str:
            """Run Newton's method.

            Its result has the `habit` of the factorisation, with which a resumed run rounds alike.
            """
            try:
                point = self._iterate(
                    float(p),
                    state,
                    b,
                    row,
                    neighbour,
                    eigenvalue_family=eigenvalue_family,
                    low_order=low_order,
                )
            except NoSystem as e:
                return str(e)
            if isinstance(point, str) or self.family.costly:
                return point
            return replace(point, habit=self.family.solver_at(point.p).factorisation.habit)

        point = self._recorded(solve)
        # a stored result has not run `solve`: what that leaves behind is set here
        if isinstance(point, BoundaryPoint):
            self._solved_at.append(point.p)
            if not self.family.costly:
                self.family.solver_at(point.p).factorisation.habit = point.habit
        return point

    def _difference(self, p: float, *, low_order: bool) -> Sequence[tuple[float, float]]:
        """Return weights and values of p of a difference formula for the derivative by p.

        Parameters
        ----------
        low_order
            Whether a formula of low order is enough. It may use the last solved p, whose systems
            exist already; the formula of the family makes new ones.

        Returns
        -------
        Pairs of a weight and its p.
        """
        # p itself and the last solved values of p, not too close to one another
        values = [p]
        min_distance = MIN_SLOPE_DISTANCE * self.scales[1]
        for q in reversed(self._solved_at):
            is_apart = min(abs(q - value) for value in values) > min_distance
            if is_apart and len(values) <= SLOPE_POINTS:
                values.append(q)
        if low_order and len(values) > SLOPE_POINTS:
            return slope_weights(values)
        return self.family.difference_weights(p, low_order=low_order)

    def _iterate(
        self,
        p: float,
        state: State,
        b: Vector,
        row: CurveRow,
        neighbour: BoundaryPoint | None,
        *,
        eigenvalue_family: int | None,
        low_order: bool,
    ) -> BoundaryPoint | str:
        """Run Newton's method for the point on which a row holds.

        A step of the method solves the augmented equations (`rows`) for (du, dmu, dp). From the
        equations of the last step `_settled_point` makes the point.

        Parameters
        ----------
        p, state
            The guess.
        b
            A vector near the null vector.
        neighbour
            A nearby point, whose null vector and tangent orient those of the result; None: any
            sign.
        eigenvalue_family
            The family whose second eigenvalue is computed; None: none.
        low_order
            Whether a difference by p of low order is enough.

        Returns
        -------
        The point, or the reason why there is none.

        Raises
        ------
        NoSystem
            If there is no system at a p on the way.
        """
        u, mu, name = state.u, float(state.mu[self.name]), self.name
        difference = self._difference(p, low_order=low_order)
        # of all steps: sizes of du in lengths of the system, and magnitudes of dmu
        sizes, load_changes = list[float](), list[float]()
        while True:
            newton = self.family.solver_at(p)
            system, latest = newton.system, State(u, {**self.family.amplitudes(p), name: mu})
            try:
                rows = self._rows(newton, latest, b, p, difference)
                step = rows.step(row, row.value(u, mu, p))
            except np.linalg.LinAlgError:
                return "the tangent is singular in more than one direction"
            b = rows.v  # the border of the next matrix
            sizes.append(max_abs(system.comm, step.du) / system.length)
            load_changes.append(abs(step.dmu))
            if _diverges(sizes, step):
                return "Newton's method diverges"
            u, mu, p = u + step.du, float(mu + step.dmu), float(p + step.dp)
            if self._has_converged(sizes, load_changes):
                break
            if len(sizes) == MAX_ITERATIONS:
                return f"Newton's method has not converged in {MAX_ITERATIONS} iterations"
        point = self._settled_point(
            rows, row, CurveVector(u, mu, p), neighbour, eigenvalue_family=eigenvalue_family
        )
        return point if isinstance(point, str) else replace(point, factorisations=len(sizes))

    def _settled_point(
        self,
        rows: AugmentedRows | SymmetryBreakingRows,
        row: CurveRow,
        place: CurveVector,
        neighbour: BoundaryPoint | None,
        *,
        eigenvalue_family: int | None,
    ) -> BoundaryPoint | str:
        """Return the point of the boundary at a converged place, or why there is none.

        A last step with the same matrix reduces the residual. The same equations give the tangent
        of the boundary.

        Parameters
        ----------
        rows
            The equations of the last step, with the null vector `rows.v`.
        row
            The equation that says where on the boundary the point is.
        place
            (u, mu, p) after the last step.
        neighbour
            A nearby point, whose null vector and tangent orient those of the result; None: any
            sign.
        eigenvalue_family
            The family whose second eigenvalue is computed; None: none.

        Returns
        -------
        The point, without its number of factorisations; or the reason why there is none.
        """
        name, comm, u, mu, p = self.name, self._comm, place.du, place.dmu, place.dp
        last_system = self.family.solver_at(p).system
        rows.set_residual(last_system.residual(u, {**self.family.amplitudes(p), name: mu}))
        last_step = rows.step(row, row.value(u, mu, p), settled=True)
        u, mu, p = u + last_step.du, float(mu + last_step.dmu), float(p + last_step.dp)
        # the null vector of length one, with the orientation that it has at the neighbour
        v = rows.v / np.sqrt(dot(comm, rows.v, rows.v))
        if neighbour is not None:
            cosine = dot(comm, v, neighbour.phi)
            if abs(cosine) < MIN_NULL_VECTOR_COSINE:
                return "the null vector is another one"
            v = v * np.sign(cosine)
        # the tangent of the boundary: a solution without value of the row
        direction = rows.step(row, None)
        # divided by this norm it has length one, and the orientation of the neighbour's
        norm = np.sqrt(self.inner(direction, direction))
        if neighbour is not None and self.inner(direction, neighbour.way) < 0:
            norm = -norm
        # `bend` and `pull` of the rows are those of `rows.v`, which is `scale` times v
        scale = dot(comm, rows.v, v)
        state = State(u, {**self.family.amplitudes(p), name: mu})
        counts = self._counts(rows, p, state)
        second = np.nan
        if eigenvalue_family is not None:
            second = self._second_eigenvalue(rows, eigenvalue_family, p, state)
        return BoundaryPoint(
            p=p,
            state=state,
            phi=np.asarray(v),
            unstable=sum(counts),
            counts=counts,
            way=CurveVector(direction.du / norm, direction.dmu / norm, direction.dp / norm),
            cubic=rows.bend / scale**3,
            pull=rows.pull / scale,
            second=second,
            load_error=abs(last_step.dmu) + ROUNDING * abs(mu),
            factorisations=0,
        )

    def _has_converged(self, sizes: Sequence[float], load_changes: Sequence[float]) -> bool:
        """Return whether the remaining errors of u and of the load are small.

        Further steps are expected to shrink by the ratio of the last two steps, or by one half if
        that is less. Then they sum up to the last step times ratio/(1 - ratio). Steps below the
        tolerance that shrink slowly are rounding.

        Parameters
        ----------
        sizes
            Sizes of the steps so far, in lengths of the system.
        load_changes
            Magnitudes of their changes of the amplitude.
        """
        ratio, shrinks_slowly = 0.5, False  # after one step
        if len(sizes) > 1:
            ratio = min(sizes[-1] / sizes[-2], 0.5) if sizes[-2] else 0.5
            shrinks_slowly = sizes[-1] > sizes[-2] / 2
        remaining = ratio / (1 - ratio)  # the sum of all further steps over the last one
        is_rounding = shrinks_slowly and sizes[-1] <= TOLERANCE
        u_has_converged = sizes[-1] * remaining <= TOLERANCE or is_rounding
        load_error = load_changes[-1] * remaining
        load_has_converged = shrinks_slowly or load_error <= LOAD_TOLERANCE * self.scales[0]
        return u_has_converged and load_has_converged


def _diverges(sizes: Sequence[float], step: CurveVector) -> bool:
    """Return whether the last step of Newton's method is too long, not finite, or grows.

    Parameters
    ----------
    sizes
        Sizes of du of the steps so far, in lengths of the system.
    step
        The last step.
    """
    if not (sizes[-1] <= MAX_STEP and np.isfinite(step.dmu + step.dp)):
        return True
    return len(sizes) > 2 and sizes[-1] > max(2 * sizes[-2], TOLERANCE)


def _row_at(p: float) -> CurveRow:
    """Return the row q - p = 0 of a point (u, mu, q) at a given p."""
    return CurveRow(None, 0.0, 1.0, lambda u, mu, q: q - p)


def _reversed(point: BoundaryPoint) -> BoundaryPoint:
    """Return the same point with the opposite tangent."""
    tangent = point.way
    return replace(point, way=CurveVector(-tangent.du, -tangent.dmu, -tangent.dp))

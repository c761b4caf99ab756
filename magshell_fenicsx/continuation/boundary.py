"""The boundary of stability: a fold or a bifurcation followed in a second number p, through turning
points.

Both are curves in (u, mu, p), see `augmented` and, of modes that the model excludes, `excluded`.
They are followed by arc length; cubics predict. Along folds v . (R_mu dmu + R_p dp) = 0. So where p
turns, mu turns too and the curve goes along v alone, a cusp, at which v . Pi'''(v, v) is zero; or v
. R_mu is zero: two folds meet at a bifurcation.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal, cast

import numpy as np

from magshell_fenicsx.continuation.augmented import Family, Kind, Lines, Locus, NoSystem, Row, Way
from magshell_fenicsx.continuation.excluded import ExcludedLines, Excluding, nearest_eigenvalue
from magshell_fenicsx.continuation.fold import AugmentedTangent
from magshell_fenicsx.continuation.interpolated import hermite, interpolated, slope, stationary
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.system import State, Vector, dot, max_abs

Label = Literal["start", "point", "cusp", "turn", "meeting", "crossing", "end"]
TOLERANCE = (
    1e-6  # estimated remaining error of u, in lengths; along v it changes the load by its square
)
LOAD_TOLERANCE = 1e-9  # the same of the load, over its scale
MOST_ITERATIONS = 8
LARGEST_STEP = 10.0  # in lengths; a longer one counts as divergence
EASY = 2  # iterations after which a step grows
MOST_TURN, STRAIGHT = (
    0.6,
    0.95,
)  # cosines of successive tangents: less is refused; with more, steps grow
GAP = 0.5  # of a step: a larger correction of its prediction counts as a jump
ALIKE = 0.5  # cosine of successive null vectors
SMALLEST = 1e-4  # of the first step
STEEP = 0.2  # part of p in the tangent from which costly systems are taken at a given p
SPECIAL = 1e-10  # of the range of p: how closely p is stationary where it turns
MOST_TRIALS, MOST_POINTS = 12, 400
MOST_LOOKS, LOOKED, CLOSE = (
    8,
    4,
    1e-3,
)  # points near a meeting, those that are interpolated, and their distance
ROUNDING = 1e-12  # relative, of an amplitude
LAST, APART = (
    3,
    1e-3,
)  # points whose systems give a slope by p, and their distance at least, over the range


class BoundaryLost(RuntimeError):
    """The boundary could not be followed further; the message gives the reason."""


class Boundary:
    """A boundary in the plane of an amplitude and of p.

    Parameters
    ----------
    name
        The amplitude that is unknown.
    scales
        Of the amplitude and of p: changes that count as of order one in the arc length.
    recorded
        Gets each solve, and gives its result or that of an interrupted boundary at this place.
    m
        The family of modes that the model excludes in which the bifurcation is; 0: it is one of the
        model itself.
    watched
        Whether the modes that the model excludes are counted along its own.
    """

    def __init__(
        self,
        family: Family | Excluding,
        name: str,
        kind: Kind,
        scales: tuple[float, float],
        recorded: "Callable[[Callable[[], Locus | str]], Locus | str]" = lambda solve: solve(),
        m: int = 0,
        watched: bool = False,
    ) -> None:
        self.family, self.name, self.kind, self.scales, self.m = family, name, kind, scales, m
        self._watched = watched or m > 0
        self._recorded = recorded
        self._weight = 0.0
        self._solved_at = list[float]()

    def inner(self, a: Way, b: Way) -> float:
        """<a, b>: root mean square of u over the length, and the numbers over their scales."""
        mu, p = self.scales
        return (
            self._weight * dot(self._comm, a.du, b.du) + a.dmu * b.dmu / mu**2 + a.dp * b.dp / p**2
        )

    def start(self, p: float, state: State, phi: Vector) -> Locus:
        """The point at p near an instability that a path has located.

        Raises
        ------
        BoundaryLost
            If none is found.
        """
        system = self.family.at(p).system
        self._comm, self._length = system.comm, system.length
        self._weight = 1 / (float(system.comm.allreduce(system.size)) * system.length**2)
        if self.family.at(p).factor_at(state).skewed:
            raise BoundaryLost(
                "a load without potential: its tangent is not symmetric, and no boundary is followed"
            )
        again = self._solved(p, state, phi, _at(p), None)
        if isinstance(again, str):
            raise BoundaryLost(f"the {self.kind} at {p:.6g} is not found again: {again}")
        return replace(again, p=p)

    def followed(
        self, start: Locus, sense: float, ends: tuple[float, float], steps: int
    ) -> Iterator[tuple[Label, Locus]]:
        """Points from a start until p leaves its range.

        Parameters
        ----------
        sense
            Sign of dp at the start.
        steps
            No step changes p by more than its scale over this number.

        Raises
        ------
        BoundaryLost
            If the smallest step fails.
        """
        here = start if start.way.dp * sense >= 0 else _turned(start)
        before: tuple[Locus, float] | None = None  # the point before, and the step from it
        most = self.scales[1] / steps
        length = first = min(most / max(abs(here.way.dp), 1e-3 * self.scales[1]), 2.0 / steps * 5)
        for _ in range(MOST_POINTS):
            guess = self._ahead(before, here, length)
            if not ends[0] < guess.dp < ends[1]:
                last = self._last(before, here, length, ends)
                if last:
                    yield from self._between(here, *last)
                    yield "end", last[0]
                    return
            tried: Locus | str = "the end of the range is not reached at once"
            if ends[0] < guess.dp < ends[1]:
                tried = self._onward(here, guess, length)
            if isinstance(tried, str):
                length /= 2
                if length < SMALLEST * first:
                    raise BoundaryLost(
                        f"at {here.p:.6g}, load {here.state.mu[self.name]:.6g}: {tried}"
                    )
                continue
            step = self._distance(here, tried, length)
            yield from self._between(here, tried, step)
            if not ends[0] < tried.p < ends[1]:  # the prediction had not shown it
                length /= 2
                continue
            yield "point", tried
            straight = self.inner(here.way, tried.way) > STRAIGHT
            before, here = (here, step), tried
            if tried.factorisations <= EASY and straight:
                length = 1.5 * length
            elif tried.factorisations > 2 * EASY:
                length = 0.7 * length
            length = min(length, 1.2 * most / max(abs(here.way.dp), 1e-300), 3 * first, 2 * step)
        raise BoundaryLost(f"{MOST_POINTS} points have not reached the end of the range")

    def _between(self, low: Locus, high: Locus, length: float) -> Iterator[tuple[Label, Locus]]:
        """What is special between two successive points."""
        if low.way.dp * high.way.dp < 0:
            turn = self._stationary(low, high, length)
            is_cusp = self.kind == "fold" and low.cubic * high.cubic < 0
            yield "cusp" if is_cusp else "turn", turn
        if not self._watched:
            if low.unstable != high.unstable and (
                met := self._meeting(low, high, length, lambda one: one.unstable)
            ):
                yield "meeting", met
            return
        families = range(max(len(low.counts), len(high.counts)))
        changed = [i for i in families if low.unstable_of(i) != high.unstable_of(i)]
        met_by = {
            i: self._meeting(low, high, length, partial(Locus.unstable_of, family=i), i)
            for i in changed
        }
        counts = [low.unstable_of(i) for i in families]
        for i, met in sorted(
            met_by.items(), key=lambda each: abs(each[1].p - low.p) if each[1] else 0.0
        ):
            if met is None:
                continue
            if i == self.m == 0:
                yield "meeting", replace(met, met=i)
            else:  # its own counts are those of a point close by, which may be beyond other crossings
                yield "crossing", replace(met, met=i, counts=tuple(counts), unstable=sum(counts))
            counts[i] = high.unstable_of(i)

    def _ahead(self, before: tuple[Locus, float] | None, here: Locus, length: float) -> Way:
        """The point after a step: by the cubic through the last two points and their tangents."""
        if before is None:
            return self._plus(here, length, here.way)
        low, step = before
        return self._hermite(low, here, step, 1 + length * self.inner(low.way, here.way) / step)

    def _plus(self, here: Locus, t: float, way: Way) -> Way:
        mu = here.state.mu[self.name]
        return Way(here.state.u + t * way.du, mu + t * way.dmu, here.p + t * way.dp)

    def _hermite(self, low: Locus, high: Locus, step: float, t: float) -> Way:
        """The cubic at t in units of the step, which is measured along the tangent at the low end."""
        faster = 1 / self.inner(low.way, high.way)
        (h00, h10), (h01, h11) = hermite(t, (0.0, 1.0))
        a, b, name = step * h10, step * faster * h11, self.name

        def at(x0: float, d0: float, x1: float, d1: float) -> float:
            return h00 * x0 + a * d0 + h01 * x1 + b * d1

        return Way(
            h00 * low.state.u + a * low.way.du + h01 * high.state.u + b * high.way.du,
            at(low.state.mu[name], low.way.dmu, high.state.mu[name], high.way.dmu),
            at(low.p, low.way.dp, high.p, high.way.dp),
        )

    def _onward(self, here: Locus, guess: Way, length: float) -> Locus | str:
        """The next point: where it is predicted in p if systems are costly, else at a distance."""
        if not self._at_given_p(here):
            return self._at_distance(here, guess, length)
        row = _at(guess.dp)
        return self._tried(here, guess, length, row, rough=True)

    def _at_given_p(self, here: Locus) -> bool:
        return self.family.costly and abs(here.way.dp) / self.scales[1] > STEEP

    def _distance(self, here: Locus, there: Locus, length: float) -> float:
        """Along the tangent of the first point; the length of the step where it was taken at that."""
        if not self._at_given_p(here):
            return length
        name = self.name
        off = Way(
            there.state.u - here.state.u,
            there.state.mu[name] - here.state.mu[name],
            there.p - here.p,
        )
        return self.inner(here.way, off)

    def _at_distance(
        self, base: Locus, guess: Way, length: float, *, look: int | None = None
    ) -> Locus | str:
        """The point at a distance along the tangent of another one."""
        way, (mu, p), name = base.way, self.scales, self.name

        def value(u: Vector, m: float, q: float) -> float:
            return (
                self.inner(way, Way(u - base.state.u, m - base.state.mu[name], q - base.p)) - length
            )

        row = Row(self._weight * way.du, way.dmu / mu**2, way.dp / p**2, value)
        return self._tried(base, guess, length, row, look=look)

    def _looked_at(self, base: Locus, guess: Way, s: float, family: int) -> Locus | str:
        """A point with the eigenvalue of a family; where families do not couple, at a given p if
        that is cheaper.
        """
        if not (self.m and self._at_given_p(base)):
            return self._at_distance(base, guess, s, look=family)
        return self._tried(base, guess, s, _at(guess.dp), look=family, rough=True)

    def _tried(
        self,
        base: Locus,
        guess: Way,
        length: float,
        row: Row,
        *,
        look: int | None = None,
        rough: bool = False,
    ) -> Locus | str:
        name = self.name
        point = self._solved(
            guess.dp,
            State(guess.du, {name: guess.dmu}),
            base.phi,
            row,
            base,
            look=look,
            rough=rough,
        )
        if isinstance(point, str):
            return point
        off = Way(point.state.u - guess.du, point.state.mu[name] - guess.dmu, point.p - guess.dp)
        if np.sqrt(self.inner(off, off)) > GAP * abs(length):
            return "a step ends far from its prediction"
        if self.inner(base.way, point.way) < MOST_TURN:
            return "the boundary turns too sharply"
        return point

    def _last(
        self,
        before: tuple[Locus, float] | None,
        here: Locus,
        length: float,
        ends: tuple[float, float],
    ) -> tuple[Locus, float] | None:
        """The point at the end of the range, and its distance; None if the boundary does not go
        there at once.
        """
        low, high = 0.0, length
        for _ in range(50):  # where the prediction leaves the range
            middle = (low + high) / 2
            inside = ends[0] < self._ahead(before, here, middle).dp < ends[1]
            low, high = (middle, high) if inside else (low, middle)
        guess = self._ahead(before, here, high)
        end = float(min(ends, key=lambda end: abs(end - guess.dp)))
        row = _at(end)
        guessed, rough = State(guess.du, {self.name: guess.dmu}), self._at_given_p(here)
        last = self._solved(end, guessed, here.phi, row, here, rough=rough)
        if (
            isinstance(last, str)
            or last.way.dp * here.way.dp < 0
            or self.inner(last.way, here.way) < MOST_TURN
        ):
            return None
        off = Way(last.state.u - guess.du, last.state.mu[self.name] - guess.dmu, 0.0)
        return None if np.sqrt(self.inner(off, off)) > GAP * high else (replace(last, p=end), high)

    def _stationary(self, low: Locus, high: Locus, length: float) -> Locus:
        """Where p turns between two points: the stationary point of the cubic through both,
        repeated.
        """
        base, a, b = low, 0.0, length  # distances along the tangent of the base
        best = min(low, high, key=lambda one: abs(one.way.dp))
        for _ in range(MOST_TRIALS):
            s = _zero_of_slope(a, low, b, high, base, self)
            guess = self._hermite(
                low, high, (b - a) / self.inner(base.way, low.way), (s - a) / (b - a)
            )
            middle = self._at_distance(base, guess, s)
            if isinstance(middle, str):  # rounding: the cubic is as good
                state = best.state.with_(guess.du, self.name, float(guess.dmu))
                return replace(best, p=float(guess.dp), state=state)
            best = middle if abs(middle.way.dp) < abs(best.way.dp) else best
            other, gap = (high, b - s) if middle.way.dp * low.way.dp > 0 else (low, s - a)
            curvature = abs(other.way.dp - middle.way.dp) / gap
            rest = middle.way.dp**2 / (2 * curvature) if curvature else 0.0
            if rest <= SPECIAL * self.scales[1] or min(s - a, b - s) < 1e-9 * length:
                break
            low, high, a, b = (
                (middle, high, s, b) if middle.way.dp * low.way.dp > 0 else (low, middle, a, s)
            )
        return best

    def _meeting(
        self, low: Locus, high: Locus, length: float, count: Callable[[Locus], int], family: int = 0
    ) -> Locus | None:
        """Where a second eigenvalue, of a family, is zero between two points, by inverse
        interpolation.

        The bordered tangent may be singular there, so the point itself is interpolated between
        others close by; where families do not couple it is not, and these may be closer.
        """
        close = CLOSE if family in (0, self.m) else CLOSE**2
        looked_at, a, b = list[tuple[float, float, Locus]](), 0.0, length
        s = length / 2
        for _ in range(MOST_LOOKS):
            guess = self._hermite(low, high, length, s / length)
            tried = self._looked_at(low, guess, s, family)
            if isinstance(tried, str) or any(
                s == place or tried.second == second for place, second, _ in looked_at
            ):
                break
            looked_at = sorted(
                [*looked_at, (s, tried.second, tried)], key=lambda each: abs(each[1])
            )[:LOOKED]
            a, b = (s, b) if count(tried) == count(low) else (a, s)
            s = (a + b) / 2
            if len(looked_at) > 1:
                ahead = interpolated(
                    [each[1] for each in looked_at], [each[0] for each in looked_at], 0.0
                )
                nearest_place = looked_at[0][0]
                by_rounding = not a < ahead < b and abs(ahead - nearest_place) < CLOSE * length
                if by_rounding or abs(ahead - nearest_place) < close * length:
                    s = ahead
                    break
                s = ahead if a < ahead < b else s
        if len(looked_at) < 2:
            return looked_at[0][2] if looked_at else None
        places, mu = [each[0] for each in looked_at], self.name
        nearest, loads = looked_at[0][2], [each[2].state.mu[mu] for each in looked_at]
        p, load = (
            interpolated(places, [each[2].p for each in looked_at], s),
            interpolated(places, loads, s),
        )
        error = abs(load - interpolated(places[:-1], loads[:-1], s)) + nearest.load_error
        return replace(
            nearest, p=p, state=nearest.state.with_(nearest.state.u, mu, load), load_error=error
        )

    def _lines(
        self,
        newton: BorderedNewton,
        state: State,
        b: Vector,
        p: float,
        beside: Sequence[tuple[float, float]],
    ) -> Lines | ExcludedLines:
        """The rows of Newton's step at a state."""
        if self.m:
            return ExcludedLines(
                newton, state, self.name, b, self.m, cast(Excluding, self.family), p, beside
            )
        tangent = AugmentedTangent(newton, state, b)
        return Lines(
            self.kind, newton.system, state, self.name, tangent, self.family, p, beside, self.scales
        )

    def _counts(self, lines: Lines | ExcludedLines, p: float, state: State) -> Sequence[int]:
        """See `Locus`."""
        if isinstance(lines, ExcludedLines):
            return lines.counts()
        excluded = cast(Excluding, self.family).counts(p, state) if self._watched else ()
        return [lines.unstable, *excluded]

    def _eigenvalue(
        self, lines: Lines | ExcludedLines, family: int, p: float, state: State
    ) -> float:
        """The second one of a family."""
        if family and not self.m:
            return nearest_eigenvalue(
                cast(Excluding, self.family).factored(p, state, family), self._comm
            )
        return lines.eigenvalue(family, p, state)

    def _solved(
        self,
        p: float,
        state: State,
        b: Vector,
        row: Row,
        near: Locus | None,
        *,
        look: int | None = None,
        rough: bool = False,
    ) -> Locus | str:
        """The point near a guess on which a row holds, or the reason why there is none."""

        def by_newton() -> Locus | str:
            try:
                solved = self._iterated(float(p), state, b, row, near, look=look, rough=rough)
            except NoSystem as e:
                return str(e)
            if isinstance(solved, str) or self.family.costly:
                return solved
            return replace(solved, habit=self.family.at(solved.p).factorisation.habit)

        found = self._recorded(by_newton)
        if isinstance(found, Locus):
            self._solved_at.append(found.p)
            if not self.family.costly:
                self.family.at(found.p).factorisation.habit = found.habit
        return found

    def _beside(self, p: float, *, rough: bool) -> Sequence[tuple[float, float]]:
        """Weights and values of p of a difference by p; a rough one from the last points, which
        have their systems.
        """
        places = [p]
        for q in reversed(self._solved_at):
            if (
                min(abs(q - place) for place in places) > APART * self.scales[1]
                and len(places) <= LAST
            ):
                places.append(q)
        return slope(places) if rough and len(places) > LAST else self.family.beside(p, rough=rough)

    def _iterated(
        self,
        p: float,
        state: State,
        b: Vector,
        row: Row,
        near: Locus | None,
        *,
        look: int | None,
        rough: bool,
    ) -> Locus | str:
        u, mu, name = state.u, float(state.mu[self.name]), self.name
        beside = self._beside(p, rough=rough)
        sizes, changes = list[float](), list[float]()
        while True:
            newton = self.family.at(p)
            system, latest = newton.system, State(u, {**self.family.amplitudes(p), name: mu})
            try:
                lines = self._lines(newton, latest, b, p, beside)
                way = lines.step(row, row.value(u, mu, p))
            except np.linalg.LinAlgError:
                return "the tangent is singular in more than one direction"
            b = lines.v
            sizes.append(max_abs(system.comm, way.du) / system.length)
            changes.append(abs(way.dmu))
            if not (sizes[-1] <= LARGEST_STEP and np.isfinite(way.dmu + way.dp)):
                return "Newton's method diverges"
            if len(sizes) > 2 and sizes[-1] > max(2 * sizes[-2], TOLERANCE):
                return "Newton's method diverges"
            u, mu, p = u + way.du, float(mu + way.dmu), float(p + way.dp)
            rate = min(sizes[-1] / sizes[-2], 0.5) if len(sizes) > 1 and sizes[-2] else 0.5
            rest = rate / (1 - rate)
            slow = sizes[-1] > sizes[-2] / 2 if len(sizes) > 1 else False
            settled = sizes[-1] * rest <= TOLERANCE or (slow and sizes[-1] <= TOLERANCE)
            if settled and (changes[-1] * rest <= LOAD_TOLERANCE * self.scales[0] or slow):
                break
            if len(sizes) == MOST_ITERATIONS:
                return f"Newton's method has not converged in {MOST_ITERATIONS} iterations"
        last = self.family.at(p).system
        lines.balance(last.residual(u, {**self.family.amplitudes(p), name: mu}))
        rest_of = lines.step(row, row.value(u, mu, p), settled=True)
        u, mu, p = u + rest_of.du, float(mu + rest_of.dmu), float(p + rest_of.dp)
        v = b / np.sqrt(dot(system.comm, b, b))
        if near is not None:
            cosine = dot(system.comm, v, near.phi)
            if abs(cosine) < ALIKE:
                return "the null vector is another one"
            v = v * np.sign(cosine)
        direction = lines.step(row, None)
        norm = np.sqrt(self.inner(direction, direction))
        if near is not None and self.inner(direction, near.way) < 0:
            norm = -norm
        scale = dot(system.comm, lines.v, v)
        state = State(u, {**self.family.amplitudes(p), name: mu})
        counts = self._counts(lines, p, state)
        return Locus(
            p=p,
            state=state,
            phi=np.asarray(v),
            unstable=sum(counts),
            counts=counts,
            way=Way(direction.du / norm, direction.dmu / norm, direction.dp / norm),
            cubic=lines.bend / scale**3,
            pull=lines.pull / scale,
            second=np.nan if look is None else self._eigenvalue(lines, look, p, state),
            load_error=abs(rest_of.dmu) + ROUNDING * abs(mu),
            factorisations=len(sizes),
        )


def _at(p: float) -> Row:
    """The row of a point at a given p."""
    return Row(None, 0.0, 1.0, lambda u, mu, q: q - p)


def _turned(locus: Locus) -> Locus:
    """The same point with the opposite tangent."""
    return replace(locus, way=Way(-locus.way.du, -locus.way.dmu, -locus.way.dp))


def _zero_of_slope(
    a: float, low: Locus, b: float, high: Locus, base: Locus, boundary: Boundary
) -> float:
    """Where the Hermite cubic of p over the distance along the base's tangent is stationary."""
    d0, d1 = (one.way.dp / boundary.inner(base.way, one.way) for one in (low, high))
    return a + (b - a) * stationary((high.p - low.p) / (b - a), d0, d1)

"""Locating the instabilities between two points of a path: folds and bifurcations."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from magshell_fenicsx.solve.factor import Factorisation
from magshell_fenicsx.solve.inverse import nearest_to_zero
from magshell_fenicsx.solve.path import Path, PathStopped, Point
from magshell_fenicsx.solve.system import State, Vector

MOST_STEPS = 60  # bisection alone halves a bracket so often that nothing is left of it
FLAT = 0.01  # slope of the amplitude, over that at the step's start, that means a fold
MOST_HALVINGS = 12  # of a step that holds several instabilities; what is left counts as one


class Stability(Protocol):
    """A tangent whose inertia tells stability."""

    def factor_at(self, state: State) -> Factorisation:
        """Factor the tangent at a state."""


@dataclass(frozen=True)
class Instability:
    """A point at which the tangent is singular.

    Attributes
    ----------
    kind
        "fold": the amplitude is stationary; "bifurcation": it is not.
    """

    point: Point
    kind: Literal["fold", "bifurcation"]


def instabilities(path: Path, low: Point, high: Point, tolerance: float = 1e-8) -> Iterator[Instability]:
    """All singular points between two successive points that their inertia and tangents tell, in order.

    Parameters
    ----------
    tolerance
        Of the amplitude, relative.

    Raises
    ------
    PathStopped
        If Newton fails between two points that it had found.
    """
    search = _Search(path, low, tolerance)
    yield from search.between(low, path.seen_from(low, high), MOST_HALVINGS)


@dataclass
class _Search:
    """Work between two points, the first of which is the base of every solve.

    `iterations` and `factorisations` are those since the last located point.
    """

    path: Path
    base: Point
    tolerance: float
    iterations: int = 0
    factorisations: int = 0

    def between(self, low: Point, high: Point, halvings: int) -> Iterator[Instability]:
        change = abs(high.negative_pivots - low.negative_pivots)
        turned = low.dmu * high.dmu < 0
        if change == 0 and not turned:
            return
        self.path.progress.doing("locating an instability")
        single = change == 1 or not halvings
        if single and turned:
            yield Instability(self.told(self.fold(low, high)), "fold")
        elif single:
            point = self.bifurcation(low, high, self.path.newton)
            if abs(point.dmu) < FLAT * abs(low.dmu):
                raise PathStopped("the step passed a fold and left the branch", low)
            yield Instability(self.told(point), "bifurcation")
        else:
            middle = self.solve((low.s + high.s) / 2, low, high)
            yield from self.between(low, middle, halvings - 1)
            yield from self.between(middle, high, halvings - 1)

    def solve(self, s: float, low: Point, high: Point) -> Point:
        found = self.path.at(s, self.path.between(s, low, high), self.base)
        if isinstance(found, str):
            raise PathStopped(f"locating an instability: {found}", low)
        self.iterations += found.iterations
        self.factorisations += found.factorisations
        return found

    def told(self, point: Point) -> Point:
        here = self.path.exact(point, self.base)
        spent = replace(here, iterations=self.iterations, factorisations=self.factorisations + 1)
        self.iterations = self.factorisations = 0
        return spent

    def fold(self, low: Point, high: Point) -> Point:
        """Zero of dmu/ds: stationary point of the cubic through both ends, repeated."""
        name = self.path.name
        for _ in range(MOST_STEPS):
            s = _stationary(low, high, name)
            point = self.solve(s, low, high)
            mu = point.state.mu[name]
            other = high if point.dmu * low.dmu > 0 else low
            curvature = (other.dmu - point.dmu) / (other.s - point.s)
            if abs(point.dmu**2 / (2 * curvature)) <= self.tolerance * abs(mu):
                return point
            low, high = (point, high) if point.dmu * low.dmu > 0 else (low, point)
        return point

    def bifurcation(self, low: Point, high: Point, stability: Stability) -> Point:
        """Where the eigenvalue that changes sign is zero, by the Illinois variant of regula falsi.

        It ends when two successive guesses agree to the tolerance's power 3/4 (the order of the method
        is 1.44): the eigenvalue itself drowns in rounding before it is zero.
        """
        path, side = self.path, 0
        first = critical_mode(stability, low.state)
        a, b = first.eigenvalue, critical_mode(stability, high.state).eigenvalue
        agreed, last = self.tolerance**0.75, np.inf
        for _ in range(MOST_STEPS):
            # the eigenvalue nearest to zero need not be the one that changes sign
            t = a / (a - b) if a * b < 0 else 0.5
            point = self.solve(low.s + t * (high.s - low.s), low, high)
            mu = point.state.mu[path.name]
            if abs(point.s - last) * abs(point.dmu) <= agreed * abs(mu) and a * b < 0:
                return point
            if abs(high.s - low.s) * abs(point.dmu) <= self.tolerance * abs(mu):
                return point
            last, mode = point.s, critical_mode(stability, point.state)
            if mode.negative_pivots != first.negative_pivots:
                high, b = point, mode.eigenvalue
                a = a / 2 if side == 1 else a
                side = 1
            else:
                low, a = point, mode.eigenvalue
                b = b / 2 if side == -1 else b
                side = -1
        return point


def _stationary(low: Point, high: Point, name: str) -> float:
    """Where the Hermite cubic of mu(s) is stationary between the ends."""
    L = high.s - low.s
    rise = (high.state.mu[name] - low.state.mu[name]) / L
    c1, c2, c3 = low.dmu, 3 * rise - 2 * low.dmu - high.dmu, low.dmu + high.dmu - 2 * rise
    roots = np.roots([3 * c3, 2 * c2, c1])
    inside = [float(r.real) for r in roots if abs(r.imag) < 1e-12 and 0 < r.real < 1]
    t = inside[0] if inside else low.dmu / (low.dmu - high.dmu)
    return low.s + L * min(max(t, 1e-3), 1 - 1e-3)


def locate_bifurcation(
    path: Path, stable: Point, unstable: Point, stability: Stability, tolerance: float = 1e-8
) -> Point:
    """Where a tangent other than the path's own becomes singular, between two successive points.

    Parameters
    ----------
    stability
        Whose tangent is watched: that of modes which the model excludes.
    tolerance
        Of the amplitude, relative.

    Raises
    ------
    PathStopped
        If Newton fails between two points that it had found.
    """
    search = _Search(path, stable, tolerance)
    return search.told(search.bifurcation(stable, path.seen_from(stable, unstable), stability))


@dataclass(frozen=True)
class CriticalMode:
    """Eigenpair of a tangent whose eigenvalue is nearest to zero; `negative_pivots` of the same tangent."""

    eigenvalue: float
    vector: Vector
    negative_pivots: int


def critical_mode(stability: Stability, state: State) -> CriticalMode:
    """The eigenpair nearest to zero; the vector has length one."""
    factors = stability.factor_at(state)
    return CriticalMode(*nearest_to_zero(factors), factors.negative_pivots)

"""Locating the first instability between two points of a path: a fold or a bifurcation."""

from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.solve.factor import Factorisation
from magshell_fenicsx.solve.path import Path, PathStopped, Point
from magshell_fenicsx.solve.system import State, Vector, dot

MOST_STEPS = 60  # bisection alone halves a bracket so often that nothing is left of it


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


def locate(path: Path, stable: Point, unstable: Point, tolerance: float = 1e-8) -> Instability:
    """The first singular point between two points with different inertia.

    Parameters
    ----------
    tolerance
        Of the amplitude, relative.

    Raises
    ------
    PathStopped
        If Newton fails between two points that it had found.
    """
    low, high = stable, unstable
    work = _Work()
    while low.dmu * high.dmu < 0 and high.negative_pivots - low.negative_pivots > 1:
        middle = work.solve(path, (low.s + high.s) / 2, low, high)
        low, high = (low, middle) if middle.negative_pivots > stable.negative_pivots else (middle, high)
    if low.dmu * high.dmu < 0:
        return Instability(work.add_to(_fold(path, low, high, tolerance, work)), "fold")
    return Instability(locate_bifurcation(path, low, high, path.newton, tolerance), "bifurcation")


@dataclass
class _Work:
    """Iterations and factorisations spent while locating."""

    iterations: int = 0
    factorisations: int = 0

    def solve(self, path: Path, s: float, low: Point, high: Point) -> Point:
        found = path.at(s, _between(path, s, low, high))
        if isinstance(found, str):
            raise PathStopped(f"locating an instability: {found}", low)
        self.iterations += found.iterations
        self.factorisations += found.factorisations
        return found

    def add_to(self, point: Point) -> Point:
        return replace(point, iterations=self.iterations, factorisations=self.factorisations)


def _fold(path: Path, low: Point, high: Point, tolerance: float, work: _Work) -> Point:
    """Zero of dmu/ds: stationary point of the cubic through both ends, repeated."""
    name = path.name
    for _ in range(MOST_STEPS):
        s = _stationary(low, high, name)
        point = work.solve(path, s, low, high)
        mu = point.state.mu[name]
        other = high if point.dmu * low.dmu > 0 else low
        curvature = (other.dmu - point.dmu) / (other.s - point.s)
        if abs(point.dmu**2 / (2 * curvature)) <= tolerance * abs(mu):
            return point
        low, high = (point, high) if point.dmu * low.dmu > 0 else (low, point)
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
    """Where the eigenvalue that changes sign is zero, by the Illinois variant of regula falsi.

    Parameters
    ----------
    stability
        Whose tangent is watched: the path's own, or that of modes which the model excludes.
    tolerance
        Of the amplitude, relative.

    Raises
    ------
    PathStopped
        If Newton fails between two points that it had found.
    """
    low, high, work, side = stable, unstable, _Work(), 0
    comm = path.system.comm
    first = critical_mode(stability, low.state, comm)
    a, b = first.eigenvalue, critical_mode(stability, high.state, comm).eigenvalue
    for _ in range(MOST_STEPS):
        t = a / (a - b) if a > 0 > b else 0.5
        point = work.solve(path, low.s + t * (high.s - low.s), low, high)
        mode = critical_mode(stability, point.state, comm)
        value = mode.eigenvalue
        mu = point.state.mu[path.name]
        slope = (b - a) / (high.s - low.s)
        error = abs(value / slope * point.dmu) if a > 0 > b else np.inf
        if min(error, abs((high.s - low.s) * point.dmu)) <= tolerance * abs(mu):
            return work.add_to(point)
        if mode.negative_pivots > first.negative_pivots:
            high, b = point, value
            a = a / 2 if side == 1 else a
            side = 1
        else:
            low, a = point, value
            b = b / 2 if side == -1 else b
            side = -1
    return work.add_to(point)


@dataclass(frozen=True)
class CriticalMode:
    """Eigenpair of a tangent whose eigenvalue is nearest to zero; `negative_pivots` of the same tangent."""

    eigenvalue: float
    vector: Vector
    negative_pivots: int


def critical_mode(stability: Stability, state: State, comm: MPI.Comm, iterations: int = 12) -> CriticalMode:
    """The eigenpair nearest to zero, by inverse iteration; the vector has length one."""
    factors = stability.factor_at(state)
    v, value = np.sin(1.0 + np.arange(state.u.size) + comm.rank), 0.0
    for _ in range(iterations):
        v = v / np.sqrt(dot(comm, v, v))
        w = factors.solve(v)
        value, v = 1 / dot(comm, v, w), w
    return CriticalMode(value, v / np.sqrt(dot(comm, v, v)), factors.negative_pivots)


def _between(path: Path, s: float, low: Point, high: Point) -> State:
    """Hermite cubic through both ends, as first guess."""
    L = high.s - low.s
    t = (s - low.s) / L
    h00, h10, h01, h11 = 2 * t**3 - 3 * t**2 + 1, t**3 - 2 * t**2 + t, 3 * t**2 - 2 * t**3, t**3 - t**2
    u = h00 * low.state.u + h01 * high.state.u + L * (h10 * low.du + h11 * high.du)
    mu_low, mu_high = low.state.mu[path.name], high.state.mu[path.name]
    mu = h00 * mu_low + h01 * mu_high + L * (h10 * low.dmu + h11 * high.dmu)
    return low.state.with_(u, path.name, float(mu))

"""The quantity that is prescribed along a path, as the last row of the system for (u, mu), and the
matrix with it.

The bordered matrix is inverted by block elimination; Broyden's update goes on with it at later
iterates.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from math import sqrt
from typing import Generic, Protocol, TypeVar

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import (
    Amplitudes,
    Direction,
    Roughly,
    State,
    System,
    Vector,
    dot,
    max_abs,
)

MOST_REFINEMENTS = 4
REFINED, SIGN = 1e-3, 1e-2  # relative errors of a tangent's du and dmu
DIFFERENCE = 1e-5  # in lengths: the step of the differences that replace K times a vector
COARSE = 1e-4  # beside a tangent: a correction that such differences give well
LEAST_REST = 0.3  # Broyden's update divides the step by a number; below this one it is not trusted

V = TypeVar("V")
Residual = Callable[[Vector, Amplitudes], Vector]


class Row(Protocol):
    """g(u, mu) = 0 beside equilibrium."""

    def residual(self, state: State) -> float:
        """g."""

    def gradient(self, state: State) -> tuple[Vector | None, float]:
        """dg/du (None where it is zero) and dg/dmu."""


def slope(comm: MPI.Comm, gradient: tuple[Vector | None, float], along: Direction) -> float:
    """The derivative of g along a direction, from the gradient of its row."""
    (c, d), (du, dmu) = gradient, along
    return d * dmu + (dot(comm, c, du) if c is not None else 0.0)


@dataclass(frozen=True)
class GivenLoad:
    """Load control: mu = target."""

    name: str
    target: float

    def residual(self, state: State) -> float:
        return state.mu[self.name] - self.target

    def gradient(self, state: State) -> tuple[Vector | None, float]:
        return None, 1.0


@dataclass(frozen=True)
class GivenConjugate:
    """Displacement or volume control: -dPi/dmu = target."""

    system: System
    name: str
    target: float

    def residual(self, state: State) -> float:
        return -self.system.potential(state.u, state.mu, self.name) - self.target

    def gradient(self, state: State) -> tuple[Vector | None, float]:
        u, mu, name = state.u, state.mu, self.name
        return -self.system.load(u, mu, name), -self.system.curvature(u, mu, name, name)


@dataclass(frozen=True)
class Metric:
    """Lengths along a path of (u, mu): from the root mean square of u over the system's length, and
    mu over `scale`.

    So a step length means the same for a thick and a thin shell, and on any mesh.
    """

    system: System
    scale: float

    @cached_property
    def weight(self) -> float:
        """The factor of du . du."""
        return 1 / (float(self.system.comm.allreduce(self.system.size)) * self.system.length**2)

    def inner(self, a: Direction, b: Direction) -> float:
        """<a, b> of two directions (du, dmu)."""
        return self.weight * dot(self.system.comm, a[0], b[0]) + a[1] * b[1] / self.scale**2

    def norm(self, du: Vector, dmu: float) -> float:
        """Length of a direction."""
        return sqrt(self.inner((du, dmu), (du, dmu)))


def projected(metric: Metric, a: Direction, span: Sequence[Direction]) -> Direction:
    """The direction nearest to `a` among the combinations of others."""
    gram = [[metric.inner(p, q) for q in span] for p in span]
    parts = np.linalg.solve(gram, [metric.inner(p, a) for p in span])
    du = np.sum([part * p[0] for part, p in zip(parts, span, strict=True)], axis=0)
    return du, float(sum(part * p[1] for part, p in zip(parts, span, strict=True)))


@dataclass(frozen=True)
class Hyperplane:
    """Arc length: <normal, (u, mu) - base> = distance."""

    metric: Metric
    name: str
    base: State
    normal: Direction
    distance: float

    def residual(self, state: State) -> float:
        chord = (state.u - self.base.u, state.mu[self.name] - self.base.mu[self.name])
        return self.metric.inner(self.normal, chord) - self.distance

    def gradient(self, state: State) -> tuple[Vector | None, float]:
        return self.metric.weight * self.normal[0], self.normal[1] / self.metric.scale**2


def plus(a: Direction, factor: float, b: Direction) -> Direction:
    """a + factor b."""
    return a[0] + factor * b[0], a[1] + factor * b[1]


class Bordered:
    """The matrix [K R_mu; c d] at a state.

    Parameters
    ----------
    factors
        The factors of K at the state.
    name
        The amplitude mu.
    row
        The last row, whose gradient is (c, d).

    Attributes
    ----------
    column
        R_mu.
    rough
        Whether a small part of K is that of an earlier state, so that its solutions need not be
        better.
    """

    def __init__(
        self,
        system: System,
        factors: Factorisation,
        state: State,
        name: str,
        row: Row,
        *,
        rough: bool = False,
    ) -> None:
        self.state, self.row, self.rough, self._mu = state, row, rough, state.mu[name]
        self._comm, self._factors, self._length = system.comm, factors, system.length
        self._gradient = row.gradient(state)
        self.column = system.load(state.u, state.mu, name)
        self._x2 = factors.solve(self.column, rough=rough)
        self._schur = slope(self._comm, self._gradient, (-self._x2, 1.0))
        self._weight = dot(
            self._comm, self._x2, self._x2
        )  # dmu counts as the displacement that it causes

    def size(self, step: Direction) -> float:
        """The size of a step: the larger of du, in lengths of the system, and dmu.

        dmu counts relative to mu or as the displacement that it causes, whichever is smaller.
        """
        moved = max_abs(self._comm, self._x2) / self._length
        per_mu = min(moved, 1 / abs(self._mu)) if self._mu else moved
        return max(max_abs(self._comm, step[0]) / self._length, abs(step[1]) * per_mu)

    def solve(self, f: Vector, g: float, *, rough: bool = False) -> Direction:
        """(du, dmu) with K du + R_mu dmu = f and c.du + d dmu = g; `rough` as in
        `Factorisation.solve`.
        """
        x1 = self._factors.solve(f, rough=rough)
        dmu = (g - slope(self._comm, self._gradient, (x1, 0.0))) / self._schur
        return x1 - dmu * self._x2, dmu

    @property
    def tangent(self) -> Direction:
        """The solution for f = 0 and g = 1."""
        return np.asarray(-self._x2 / self._schur), 1 / self._schur

    def inner(self, a: Direction, b: Direction) -> float:
        """Inner product in which Broyden's update is the smallest."""
        return dot(self._comm, a[0], b[0]) + self._weight * a[1] * b[1]

    def times(self, du: Vector, dmu: float) -> Direction:
        """The matrix times a direction."""
        return self._factors.times(du) + dmu * self.column, slope(
            self._comm, self._gradient, (du, dmu)
        )


class Chord(Generic[V]):
    """A matrix that is kept over several iterates, with Broyden's update after each step.

    C. T. Kelley, Iterative Methods for Linear and Nonlinear Equations, SIAM 1995, algorithm brsol.
    Steps are subtracted.

    Parameters
    ----------
    solve
        The inverse of the matrix, times a right side.
    inner, plus
        Inner product in which the update is the smallest, and a + factor b.
    """

    def __init__(
        self,
        solve: Callable[[V], V],
        inner: Callable[[V, V], float],
        plus: Callable[[V, float, V], V],
    ) -> None:
        self._solve, self._inner, self._plus = solve, inner, plus
        self._steps = list[V]()  # those taken since the matrix was made

    def took(self, step: V) -> None:
        """Go on to the next iterate by a full step."""
        self._steps.append(step)

    def step(self, f: V) -> V:
        """The next step at the present iterate, whose residual is `f`."""
        step, inner = self._updated(f, self._steps), self._inner
        if self._steps:
            last = self._steps[-1]
            rest = 1 - inner(last, step) / inner(last, last)
            if rest > LEAST_REST:
                return self._plus(step, 1 / rest - 1, step)
            self._steps.clear()
        return step

    def solve(self, f: V, step: V) -> V:
        """The solution for any right side at the present iterate, from which `step` is the next
        one.
        """
        return self._updated(f, [*self._steps, step])

    def _updated(self, f: V, steps: Sequence[V]) -> V:
        solution, inner = self._solve(f), self._inner
        for before, after in pairwise(steps):
            solution = self._plus(solution, inner(before, solution) / inner(before, before), after)
        return solution


def refined_tangent(
    system: System,
    matrix: Bordered,
    t: Direction,
    state: State,
    load: Vector,
    row: Row,
    *,
    foreseeing: bool = False,
) -> Direction | None:
    """The path's tangent at a state, from the matrix of a state near by, by generalised conjugate
    residuals.

    If `foreseeing`, with forces that are foreseen, and computed along the tangent itself. None if
    the matrix is too far away.
    """
    near = _Near(system, matrix, state, load, row)
    if not foreseeing:
        refined = near.refined(system.residual, t)
        return refined[0] if refined else None
    assert isinstance(system, Roughly)
    for _ in range(MOST_REFINEMENTS):
        refined = near.refined(partial(system.residual, rough=True), t)
        if refined is None or system.knows_along(state.u, state.mu, refined[0][0]):
            return refined[0] if refined else None
        t = refined[0]
        near.stiffness(system.residual, t[0], t[0])  # what is foreseen from now on is right along t
    return None


@dataclass(frozen=True)
class _Near:
    """A state, and the matrix of one near by."""

    system: System
    matrix: Bordered
    state: State
    load: Vector
    row: Row

    def refined(self, residual: Residual, t: Direction) -> tuple[Direction, int] | None:
        """The tangent with some residual, from one that is nearly as good, and how often this was
        improved.
        """
        comm, gradient = self.system.comm, self.row.gradient(self.state)
        R = residual(self.state.u, self.state.mu)

        def times(t: Direction, right: float = 0.0) -> Direction:
            rest = (
                self.stiffness(residual, t[0], R) + t[1] * self.load,
                slope(comm, gradient, t) - right,
            )
            return self.matrix.solve(*rest, rough=self.matrix.rough)

        z, directions = (
            plus((0.0 * t[0], 0.0), -1.0, times(t, 1.0)),
            list[tuple[Direction, Direction, float]](),
        )
        for _ in range(MOST_REFINEMENTS):
            if max_abs(comm, z[0]) <= REFINED * max_abs(comm, t[0]) and abs(z[1]) <= SIGN * abs(
                t[1]
            ):
                t = plus(t, 1.0, z) if max_abs(comm, z[0]) > COARSE * max_abs(comm, t[0]) else t
                return t, len(directions)
            p, q = z, times(z)
            for before, image, square in directions:
                part = self.matrix.inner(image, q) / square
                p, q = plus(p, -part, before), plus(q, -part, image)
            directions.append((p, q, self.matrix.inner(q, q)))
            part = self.matrix.inner(z, q) / directions[-1][2]
            t, z = plus(t, part, p), plus(z, -part, q)
        return None

    def stiffness(self, residual: Residual, du: Vector, R: Vector) -> Vector:
        """K du by a difference of the residual, R at the state."""
        size = max_abs(self.system.comm, du)
        if size == 0.0:
            return du
        small = DIFFERENCE * self.system.length / size
        return np.asarray((residual(self.state.u + small * du, self.state.mu) - R) / small)

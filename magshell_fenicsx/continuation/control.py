"""The quantity that is prescribed along a path, as the last row of a bordered system for (u, mu).

Continuation solves R(u, mu) = 0 together with one scalar equation g(u, mu) = 0: a given load, a
given conjugate displacement or a given arc length. This module has these rows, the bordered matrix
[K R_mu; c d] with (c, d) the gradient of g, inverted by block elimination, the chord method with
Broyden's update that keeps a matrix over several iterates, and the refinement of a path's tangent
by generalised conjugate residuals.

mu is the one amplitude (load parameter) that varies, q = -dPi/dmu its conjugate: the displacement
on which it does work. R = dPi/du, K = dR/du, and R_mu is the load vector. A direction is a pair
(du, dmu). Lengths are displacements in units of the system's length.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import sqrt
from typing import Generic, Protocol, TypeVar

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import (
    Direction,
    State,
    System,
    Vector,
    dot,
    max_abs,
)

MAX_REFINEMENTS = 4
DU_TOLERANCE, DMU_TOLERANCE = 1e-3, 1e-2  # relative errors of a tangent's du and dmu
DIFFERENCE_STEP = 1e-5  # in lengths: step of the differences that replace K times a vector
# of the tangent: a larger correction is added, a smaller one is the error of such differences
DIFFERENCE_ACCURACY = 1e-4
# Broyden's update divides the step by a number; a smaller one is not trusted
MIN_BROYDEN_DIVISOR = 0.3

V = TypeVar("V")
Gradient = tuple[Vector | None, float]  # dg/du, None where it is zero, and dg/dmu


class ConstraintRow(Protocol):
    """The scalar equation g(u, mu) = 0 that is solved together with equilibrium.

    Both methods are collective.
    """

    def residual(self, state: State) -> float:
        """Return g at a state."""

    def gradient(self, state: State) -> Gradient:
        """Return dg/du (None where it is zero) and dg/dmu."""


def derivative_along(comm: MPI.Comm, gradient: Gradient, direction: Direction) -> float:
    """Return the derivative of g along a direction (du, dmu), from the gradient of its row.

    Collective.
    """
    (c, d), (du, dmu) = gradient, direction
    return d * dmu + (dot(comm, c, du) if c is not None else 0.0)


@dataclass(frozen=True)
class PrescribedLoad:
    """Load control: the row mu = target of the amplitude `name`."""

    name: str
    target: float

    def residual(self, state: State) -> float:
        return state.mu[self.name] - self.target

    def gradient(self, state: State) -> Gradient:
        return None, 1.0


@dataclass(frozen=True)
class PrescribedConjugate:
    """Displacement or volume control: the row -dPi/dmu = target of the amplitude `name`.

    -dPi/dmu is the displacement, or the volume, on which the amplitude does work.
    """

    system: System
    name: str
    target: float

    def residual(self, state: State) -> float:
        return -self.system.potential(state.u, state.mu, self.name) - self.target

    def gradient(self, state: State) -> Gradient:
        u, mu, name = state.u, state.mu, self.name
        return -self.system.load(u, mu, name), -self.system.curvature(u, mu, name, name)


@dataclass(frozen=True)
class Metric:
    """The metric of arc length along a path of (u, mu).

    It sums the squares of the root mean square of u over the system's length, and of mu over
    `scale`. So a step length means the same for a thick and a thin shell, and on any mesh.
    """

    system: System
    scale: float

    @cached_property
    def weight(self) -> float:
        """The factor of du . du."""
        return 1 / (float(self.system.comm.allreduce(self.system.size)) * self.system.length**2)

    def inner(self, a: Direction, b: Direction) -> float:
        """Return <a, b> of two directions (du, dmu). Collective."""
        return self.weight * dot(self.system.comm, a[0], b[0]) + a[1] * b[1] / self.scale**2

    def norm(self, du: Vector, dmu: float) -> float:
        """Return the length of a direction. Collective."""
        return sqrt(self.inner((du, dmu), (du, dmu)))


def nearest_combination(metric: Metric, a: Direction, span: Sequence[Direction]) -> Direction:
    """Return the linear combination of some directions that is nearest to a direction `a`.

    Collective.

    Parameters
    ----------
    metric
        The metric in which it is nearest.
    span
        The linearly independent directions that are combined.
    """

    def products_with(direction: Direction) -> list[float]:
        """Return the inner products of a direction with those of the span."""
        return [metric.inner(direction, other_direction) for other_direction in span]

    # normal equations of the least distance
    gram = [products_with(direction) for direction in span]
    coefficients = np.linalg.solve(gram, [metric.inner(direction, a) for direction in span])
    weighted = list(zip(coefficients, span, strict=True))
    du = np.sum([coefficient * du for coefficient, (du, _) in weighted], axis=0)
    dmu = sum(coefficient * dmu for coefficient, (_, dmu) in weighted)
    return du, float(dmu)


@dataclass(frozen=True)
class Hyperplane:
    """Arc-length control: the row <normal, (u, mu) - base> = distance.

    Attributes
    ----------
    metric
        The metric of the inner product.
    name
        The amplitude mu.
    base
        The state from which arc length is measured.
    normal
        The direction (du, dmu) along which it is measured.
    distance
        Arc length of the solution.
    """

    metric: Metric
    name: str
    base: State
    normal: Direction
    distance: float

    def residual(self, state: State) -> float:
        chord = (state.u - self.base.u, state.mu[self.name] - self.base.mu[self.name])
        return self.metric.inner(self.normal, chord) - self.distance

    def gradient(self, state: State) -> Gradient:
        return self.metric.weight * self.normal[0], self.normal[1] / self.metric.scale**2


def add_scaled(a: Direction, factor: float, b: Direction) -> Direction:
    """Return a + factor b."""
    return a[0] + factor * b[0], a[1] + factor * b[1]


class BorderedMatrix:
    """The matrix [K R_mu; c d] at a state, inverted by block elimination.

    The constructor and all methods are collective.

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

    Private fields: `_load_response` is K^-1 R_mu, `_schur` the Schur complement d - c . K^-1 R_mu.
    `_weight` is the factor of dmu dmu in `inner`, by which dmu counts as the displacement that it
    causes. `_gradient` is (c, d), `_mu` the amplitude, `_length` the system's length.
    """

    def __init__(
        self,
        system: System,
        factors: Factorisation,
        state: State,
        name: str,
        row: ConstraintRow,
    ) -> None:
        """Solve for the response to the load, K^-1 R_mu, of which every solution is made."""
        self.state, self.row, self._mu = state, row, state.mu[name]
        self._comm, self._factors, self._length = system.comm, factors, system.length
        self._gradient = row.gradient(state)
        self.column = system.load(state.u, state.mu, name)
        self._load_response = factors.solve(self.column)
        self._schur = derivative_along(self._comm, self._gradient, (-self._load_response, 1.0))
        self._weight = dot(self._comm, self._load_response, self._load_response)

    def size(self, step: Direction) -> float:
        """Return the size of a step (du, dmu), in lengths: the larger one of its two parts.

        dmu counts relative to mu or as the displacement that it causes, whichever is smaller.
        """
        displacement_per_mu = max_abs(self._comm, self._load_response) / self._length
        # factor of |dmu|
        scale = min(displacement_per_mu, 1 / abs(self._mu)) if self._mu else displacement_per_mu
        return max(max_abs(self._comm, step[0]) / self._length, abs(step[1]) * scale)

    def solve(self, f: Vector, g: float) -> Direction:
        """Return the (du, dmu) of K du + R_mu dmu = f and c . du + d dmu = g. Collective."""
        response = self._factors.solve(f)
        # block elimination: what K^-1 f leaves of g, over the Schur complement
        dmu = (g - derivative_along(self._comm, self._gradient, (response, 0.0))) / self._schur
        return response - dmu * self._load_response, dmu

    @property
    def tangent(self) -> Direction:
        """The solution (du, dmu) for f = 0 and g = 1: the path's tangent per unit of the row."""
        return np.asarray(-self._load_response / self._schur), 1 / self._schur

    def inner(self, a: Direction, b: Direction) -> float:
        """Return the inner product in which Broyden's update is the smallest. Collective."""
        return dot(self._comm, a[0], b[0]) + self._weight * a[1] * b[1]

    def times(self, du: Vector, dmu: float) -> Direction:
        """Return the matrix times a direction. Collective."""
        force = self._factors.times(du) + dmu * self.column
        return force, derivative_along(self._comm, self._gradient, (du, dmu))


class Chord(Generic[V]):
    """The chord method: one matrix for several iterates, with Broyden's update after each step.

    The updates are not stored as a matrix; the steps so far determine them: C. T. Kelley, Iterative
    Methods for Linear and Nonlinear Equations, SIAM 1995, algorithm brsol. Steps are subtracted
    from the iterate. V is the type of a step. The private field `_steps` has the full steps since
    the matrix was computed.

    Parameters
    ----------
    solve
        Returns the inverse of the matrix times a right side.
    inner
        The inner product in which the update is the smallest.
    add_scaled
        Returns a + factor b, from a, the factor and b.
    """

    def __init__(
        self,
        solve: Callable[[V], V],
        inner: Callable[[V, V], float],
        add_scaled: Callable[[V, float, V], V],
    ) -> None:
        self._solve, self._inner, self._add_scaled = solve, inner, add_scaled
        self._steps = list[V]()

    def accept_step(self, step: V) -> None:
        """Go on to the next iterate by a full step."""
        self._steps.append(step)

    def step(self, f: V) -> V:
        """Return the next step at the present iterate, whose residual is `f`.

        If Broyden's update cannot be trusted, all earlier updates are dropped.
        """
        step, inner = self._updated_solution(f, self._steps), self._inner
        if self._steps:
            last_step = self._steps[-1]
            # Sherman and Morrison's formula: the update by the last step makes step/divisor of it
            divisor = 1 - inner(last_step, step) / inner(last_step, last_step)
            if divisor > MIN_BROYDEN_DIVISOR:
                return self._add_scaled(step, 1 / divisor - 1, step)
            self._steps.clear()
        return step

    def solve(self, f: V, step: V) -> V:
        """Return the solution for a right side `f` with the updated matrix of the present iterate.

        Parameters
        ----------
        step
            The next step at the iterate, which the method `step` has returned.
        """
        return self._updated_solution(f, [*self._steps, step])

    def _updated_solution(self, f: V, steps: Sequence[V]) -> V:
        """Return the solution for a right side with the matrix updated by successive steps.

        Each pair of successive steps stands for one update of the inverse, by Kelley's formula.
        """
        solution, inner = self._solve(f), self._inner
        for earlier, later in pairwise(steps):
            factor = inner(earlier, solution) / inner(earlier, earlier)
            solution = self._add_scaled(solution, factor, later)
        return solution


def refined_tangent(
    system: System,
    matrix: BorderedMatrix,
    t: Direction,
    state: State,
    load: Vector,
    row: ConstraintRow,
) -> Direction | None:
    """Return the path's tangent at a state from the matrix of a nearby state. Collective.

    The tangent is refined by generalised conjugate residuals, with K times a vector from
    differences of the residual.

    Parameters
    ----------
    matrix
        The bordered matrix of the nearby state, which preconditions.
    t
        The tangent (du, dmu) of that matrix.
    state
        The solution at which the tangent is wanted.
    load
        R_mu at the state.
    row
        The last row, along which the tangent has length one.

    Returns
    -------
    The tangent; None if the matrix belongs to a state too far away.
    """
    return _TangentRefinement(system, matrix, state, load, row).refined(t)


@dataclass(frozen=True)
class _TangentRefinement:
    """Generalised conjugate residuals for the tangent at a state.

    The equations are K du + R_mu dmu = 0 and c . du + d dmu = 1.

    Attributes
    ----------
    matrix
        The bordered matrix of a nearby state: the preconditioner.
    load
        R_mu at the state.
    row
        The last row, whose gradient is (c, d).
    """

    system: System
    matrix: BorderedMatrix
    state: State
    load: Vector
    row: ConstraintRow

    def refined(self, t: Direction) -> Direction | None:
        """Return the tangent by refinement of an approximation.

        z is the residual of both equations at the present approximation, preconditioned by the
        matrix of the nearby state: it estimates the correction that is left. Each new direction p
        has the image q, the preconditioned matrix times p. The images are made orthogonal to each
        other.

        Parameters
        ----------
        t
            The approximation (du, dmu).

        Returns
        -------
        The tangent; None if the approximation is too poor.
        """
        comm, gradient = self.system.comm, self.row.gradient(self.state)
        R = self.system.residual(self.state.u, self.state.mu)

        def preconditioned_product(t: Direction, g: float = 0.0) -> Direction:
            """Return the preconditioner times (K du + R_mu dmu, c . du + d dmu - g), t = (du, dmu).

            Without g it is the image of a direction, with g = 1 minus the residual z at t.
            """
            force = self._stiffness_times(t[0], R) + t[1] * self.load
            row_value = derivative_along(comm, gradient, t) - g
            return self.matrix.solve(force, row_value)

        z = add_scaled((0.0 * t[0], 0.0), -1.0, preconditioned_product(t, 1.0))
        # earlier directions p with their images q and q . q
        earlier = list[tuple[Direction, Direction, float]]()
        for _ in range(MAX_REFINEMENTS):
            # converged: the correction z is small compared with the tangent t, in du and in dmu
            size = max_abs(comm, t[0])
            du_converged = max_abs(comm, z[0]) <= DU_TOLERANCE * size
            if du_converged and abs(z[1]) <= DMU_TOLERANCE * abs(t[1]):
                # a smaller correction is only the error of the differences
                is_significant = max_abs(comm, z[0]) > DIFFERENCE_ACCURACY * size
                return add_scaled(t, 1.0, z) if is_significant else t
            # a new direction, whose image is orthogonal to the earlier ones
            p, q = self._orthogonalised(z, preconditioned_product(z), earlier)
            square = self.matrix.inner(q, q)
            earlier.append((p, q, square))
            # a step along p changes z by a multiple of q: the step that leaves the least of z
            component = self.matrix.inner(z, q) / square
            t = add_scaled(t, component, p)
            z = add_scaled(z, -component, q)
        return None

    def _orthogonalised(
        self, p: Direction, q: Direction, earlier: Sequence[tuple[Direction, Direction, float]]
    ) -> tuple[Direction, Direction]:
        """Return a direction p and its image q, changed so that q is orthogonal to earlier images.

        Parameters
        ----------
        earlier
            Earlier directions, their images, and the square of each image.
        """
        for earlier_p, earlier_q, earlier_square in earlier:
            component = self.matrix.inner(earlier_q, q) / earlier_square
            p = add_scaled(p, -component, earlier_p)
            q = add_scaled(q, -component, earlier_q)
        return p, q

    def _stiffness_times(self, du: Vector, R: Vector) -> Vector:
        """Return K du by a forward difference of the residual.

        Parameters
        ----------
        R
            The residual at the state.
        """
        size = max_abs(self.system.comm, du)
        if size == 0.0:
            return du
        step = DIFFERENCE_STEP * self.system.length / size
        changed_residual = self.system.residual(self.state.u + step * du, self.state.mu)
        return np.asarray((changed_residual - R) / step)

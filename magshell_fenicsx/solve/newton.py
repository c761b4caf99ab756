"""PETSc SNES on the bordered system for (u, mu):

    R(u) + mu R_mu(u) = 0      K du + R_mu dmu = -R
    g(u, mu)          = 0      c.du + d    dmu = -g

One factorisation of K and two back-solves make a Newton step, whatever the last row. The bordered
matrix is kept while the residual falls, with Broyden's update on top (C. T. Kelley, Iterative
Methods for Linear and Nonlinear Equations, SIAM 1995, algorithm brsol).
The unknown vector is u with mu appended on the last rank.
"""

import weakref
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from petsc4py import PETSc

from magshell_fenicsx import compat
from magshell_fenicsx.solve.control import Row
from magshell_fenicsx.solve.factor import Factorisation
from magshell_fenicsx.solve.system import State, System, Vector, dot, max_abs

Direction = tuple[Vector, float]  # (du, dmu)
MOST_REFINEMENTS = 4
REFINED, SIGN = 1e-3, 1e-2  # relative errors of a tangent's du and dmu
DIFFERENCE = 1e-5  # lengths, of the differences that stand for K times a vector
LEAST_REST = 0.3  # of a step: an update that would lengthen it more is not trusted


@dataclass(frozen=True)
class NewtonOptions:
    """When a step counts as converged and when factors are kept.

    Attributes
    ----------
    tolerance
        Estimated remaining error of u, over the system's length.
    max_iterations
        Iterations after which a step is given up.
    contraction
        Factors are kept while an iteration lowers the residual at least by this factor.
    fresh
        Lengths between where factors were made and a solution whose tangent and inertia they still tell.
    largest_step
        An iteration that moves u by more than this many lengths is a divergence.
    """

    tolerance: float = 1e-9
    max_iterations: int = 25
    contraction: float = 0.6
    fresh: float = 0.05
    largest_step: float = 1e4


@dataclass(frozen=True)
class Outcome:
    """Where Newton ended, and what it took."""

    state: State
    converged: bool
    iterations: int
    reason: str


@dataclass(frozen=True)
class Response:
    """The tangent of a path at a solution, per unit of its row.

    Attributes
    ----------
    softness
        dq/dmu of the conjugate displacement q.
    """

    du: Vector
    dmu: float
    softness: float
    negative_pivots: int


@dataclass
class _Progress:
    """Sizes of the successive steps and residuals of one solve, and the steps since its matrix was made."""

    steps: list[float] = field(default_factory=list)
    residuals: list[float] = field(default_factory=list)
    taken: list[Direction] = field(default_factory=list)
    matrix: "_Bordered | None" = None


def _sum(a: Direction, factor: float, b: Direction) -> Direction:
    return a[0] + factor * b[0], a[1] + factor * b[1]


class _Bordered:
    """The bordered matrix at a state, by block elimination with the factors of K."""

    def __init__(self, newton: "BorderedNewton", state: State, name: str, row: Row) -> None:
        self.state, self.row = state, row
        self._comm, self._factors = newton.system.comm, newton.factor_at(state)
        self._c, self._d = row.gradient(state.u)
        self.column = newton.system.load(state.u, name)
        self._x2 = self._factors.solve(self.column)
        self._schur = self._d - (dot(self._comm, self._c, self._x2) if self._c is not None else 0.0)
        self._weight = dot(self._comm, self._x2, self._x2)  # of dmu: the displacement that it makes

    def solve(self, f: Vector, g: float) -> Direction:
        """(du, dmu) with K du + R_mu dmu = f and c.du + d dmu = g."""
        x1 = self._factors.solve(f)
        pull = dot(self._comm, self._c, x1) if self._c is not None else 0.0
        dmu = (g - pull) / self._schur
        return x1 - dmu * self._x2, dmu

    @property
    def tangent(self) -> Direction:
        """The same for f = 0 and g = 1."""
        return np.asarray(-self._x2 / self._schur), 1 / self._schur

    def inner(self, a: Direction, b: Direction) -> float:
        return dot(self._comm, a[0], b[0]) + self._weight * a[1] * b[1]

    def times(self, du: Vector, dmu: float) -> Direction:
        g = self._d * dmu + (dot(self._comm, self._c, du) if self._c is not None else 0.0)
        return self._factors.times(du) + dmu * self.column, g


class _Border:
    """What PETSc calls back; it does not keep the solver, and with it the factors, alive."""

    def __init__(self, newton: "BorderedNewton") -> None:
        self._newton = weakref.ref(newton)

    @property
    def newton(self) -> "BorderedNewton":
        newton = self._newton()
        assert newton is not None
        return newton

    def function(self, snes: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        self.newton._function(x, f)

    def jacobian(self, snes: PETSc.SNES, x: PETSc.Vec, J: PETSc.Mat, P: PETSc.Mat) -> None:
        self.newton._jacobian(x, J)

    def test(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> Any:
        return self.newton._test(iteration, norms[2])

    def apply(self, pc: PETSc.PC, f: PETSc.Vec, y: PETSc.Vec) -> None:
        self.newton._apply(f, y)

    def mult(self, J: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.newton._mult(x, y)


class BorderedNewton:
    """Solves R(u, mu) = 0 with one more row; reusable for every amplitude and row of a system.

    Attributes
    ----------
    factorisation
        Factors of the latest tangent.
    """

    def __init__(self, system: System, options: NewtonOptions | None = None) -> None:
        self.system = system
        self.options = options or NewtonOptions()
        self.factorisation = Factorisation(system.comm)
        self.iterations = 0
        self._factored: State | None = None
        self._progress = _Progress()
        comm = system.comm
        self._last = comm.rank == comm.size - 1
        n = system.size + self._last
        self._x = PETSc.Vec().createMPI((n, PETSc.DETERMINE), comm=comm)
        f = self._x.duplicate()
        me = _Border(self)
        J = PETSc.Mat().createPython(((n, PETSc.DETERMINE), (n, PETSc.DETERMINE)), context=me, comm=comm)
        J.setUp()
        self._snes = snes = PETSc.SNES().create(comm)
        snes.setOptionsPrefix("magshell_")
        snes.setFunction(me.function, f)
        snes.setJacobian(me.jacobian, J)
        snes.setConvergenceTest(me.test)
        snes.setType("newtonls")
        given = PETSc.Options("magshell_")
        if not given.hasName("snes_linesearch_type"):
            given["snes_linesearch_type"] = "basic"  # full steps; the path shortens its own when they fail
        snes.setTolerances(max_it=self.options.max_iterations)
        ksp = snes.getKSP()
        ksp.setType("preonly")
        ksp.getPC().setType("python")
        ksp.getPC().setPythonContext(me)
        ksp.setNormType(PETSc.KSP.NormType.NONE)
        snes.setFromOptions()

    def solve(self, guess: State, name: str, row: Row) -> Outcome:
        """Find the equilibrium near `guess` on which `row` holds, with mu the amplitude `name`."""
        self._guess, self._name, self._row, self._progress = guess, name, row, _Progress()
        self._join(guess.u, guess.mu[name], self._x)
        self._snes.solve(None, self._x)
        u, mu = self._split(self._x)
        iterations = self._snes.getIterationNumber()
        reason = self._snes.getConvergedReason()
        self.iterations += iterations
        return Outcome(guess.with_(u, name, mu), reason > 0, iterations, _REASONS.get(reason, f"SNES reason {reason}"))

    def factor_at(self, state: State) -> Factorisation:
        """Factor the tangent at a state, unless its factors are at hand."""
        if self._factored is not state:
            self.factorisation.factor(self.system.tangent(state.u, state.mu))
            self._factored = state
        return self.factorisation

    def response(self, state: State, name: str, row: Row, *, exact: bool = False) -> Response:
        """The path's tangent at a solution: K du + R_mu dmu = 0, c.du + d dmu = 1.

        Where the factors at hand were made near by, they serve, with the tangent refined against
        differences of the residual; `exact` factors K at the solution itself.
        """
        comm, near = self.system.comm, self._factored
        moved = np.inf if near is None else max_abs(comm, state.u - near.u) / self.system.length
        fresh = moved <= self.options.fresh and not exact
        matrix = self._bordered(near if fresh and near else state, name, row)
        tangent, load = matrix.tangent, self.system.load(state.u, name)
        if moved and fresh:
            refined = self._refined(matrix, tangent, state, load, row)
            if refined is None:
                return self.response(state, name, row, exact=True)
            tangent = refined
        du, dmu = tangent
        return Response(du, dmu, -dot(comm, load, du) / dmu, self.factorisation.negative_pivots)

    def _bordered(self, state: State, name: str, row: Row) -> "_Bordered":
        """The bordered matrix at a state, that of the last solve if it was made there for the same row."""
        last = self._progress.matrix
        if last and last.row is row and last.state is state is self._factored:
            return last
        return _Bordered(self, state, name, row)

    def _refined(self, matrix: "_Bordered", t: Direction, state: State, load: Vector, row: Row) -> Direction | None:
        """The tangent at a state from that of a matrix near by, by generalised conjugate residuals; None if too far."""
        comm, (c, d) = self.system.comm, row.gradient(state.u)
        R = self.system.residual(state.u, state.mu)

        def times(t: Direction) -> Direction:
            g = d * t[1] + (dot(comm, c, t[0]) if c is not None else 0.0)
            return matrix.solve(self._stiffness(state, R, t[0]) + t[1] * load, g)

        z, known = _sum(t, -1.0, times(t)), list[tuple[Direction, Direction, float]]()
        for _ in range(MOST_REFINEMENTS):
            if max_abs(comm, z[0]) <= REFINED * max_abs(comm, t[0]) and abs(z[1]) <= SIGN * abs(t[1]):
                return t
            p, q = z, times(z)
            for before, image, square in known:
                part = matrix.inner(image, q) / square
                p, q = _sum(p, -part, before), _sum(q, -part, image)
            known.append((p, q, matrix.inner(q, q)))
            part = matrix.inner(z, q) / known[-1][2]
            t, z = _sum(t, part, p), _sum(z, -part, q)
        return None

    def _stiffness(self, state: State, R: Vector, du: Vector) -> Vector:
        """K du by a difference of the residual from R, that of the state."""
        size = max_abs(self.system.comm, du)
        if size == 0.0:
            return du
        small = DIFFERENCE * self.system.length / size
        return np.asarray((self.system.residual(state.u + small * du, state.mu) - R) / small)

    def _function(self, x: PETSc.Vec, f: PETSc.Vec) -> None:
        u, mu = self._split(x)
        R = self.system.residual(u, {**self._guess.mu, self._name: mu})
        self._progress.residuals.append(np.sqrt(dot(self.system.comm, R, R)))
        self._join(R, self._row.residual(u, mu), f)

    def _jacobian(self, x: PETSc.Vec, J: PETSc.Mat) -> None:
        progress = self._progress
        norms = progress.residuals
        if progress.matrix is None or norms[-1] > self.options.contraction * norms[-2]:
            u, mu = self._split(x)
            progress.matrix = _Bordered(self, self._guess.with_(u, self._name, mu), self._name, self._row)
            progress.taken.clear()
        J.assemble()

    def _apply(self, f: PETSc.Vec, y: PETSc.Vec) -> None:
        """The step (SNES subtracts it) with the matrix at hand and Broyden's update of it."""
        progress, matrix = self._progress, self._progress.matrix
        assert matrix is not None
        du, dmu = matrix.solve(*self._split(f))
        taken = progress.taken
        for before, after in pairwise(taken):
            part = matrix.inner(before, (du, dmu)) / matrix.inner(before, before)
            du, dmu = _sum((du, dmu), part, after)
        if taken:
            rest = 1 - matrix.inner(taken[-1], (du, dmu)) / matrix.inner(taken[-1], taken[-1])
            if rest > LEAST_REST:
                du, dmu = _sum((du, dmu), 1 / rest - 1, (du, dmu))
            else:
                taken.clear()
        taken.append((du, dmu))
        progress.steps.append(max_abs(self.system.comm, du) / self.system.length)
        self._join(du, dmu, y)

    def _mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The bordered matrix times a vector, for SNES's line searches and monitors."""
        assert self._progress.matrix is not None
        self._join(*self._progress.matrix.times(*self._split(x)), y)

    def _test(self, iteration: int, norm: float) -> Any:
        Reason, o = PETSc.SNES.ConvergedReason, self.options
        if not np.isfinite(norm):
            return compat.NOT_A_NUMBER
        if iteration == 0:
            return Reason.CONVERGED_ITERATING
        steps = self._progress.steps
        step = steps[-1]
        growing = iteration > 2 and step > 2 * steps[-2]
        if not np.isfinite(step) or step > o.largest_step or growing:
            return Reason.DIVERGED_DTOL
        if step <= o.tolerance:
            return Reason.CONVERGED_SNORM_RELATIVE
        if iteration == 1:
            return Reason.CONVERGED_ITERATING
        rate = step / steps[-2]  # remaining error of a linearly converging sequence: step rate/(1 - rate)
        if rate < 1 and step * rate / (1 - rate) <= o.tolerance:
            return Reason.CONVERGED_SNORM_RELATIVE
        stalled = rate > 0.5 and self._progress.residuals[-1] > 0.5 * self._progress.residuals[-2]
        own = len(self._progress.taken) == 1  # the step was made with the state's own matrix
        if stalled and step <= (1e4 if own else 1e2) * o.tolerance:
            return Reason.CONVERGED_SNORM_RELATIVE  # rounding: neither steps nor residuals shrink further
        if iteration >= o.max_iterations:
            return Reason.DIVERGED_MAX_IT
        return Reason.CONVERGED_ITERATING

    def _join(self, u: Vector, mu: float, x: PETSc.Vec) -> None:
        x.setArray(np.append(u, mu) if self._last else u)

    def _split(self, x: PETSc.Vec) -> Direction:
        local = x.array_r
        mu = self.system.comm.bcast(float(local[-1]) if self._last else None, root=self.system.comm.size - 1)
        return local[: self.system.size].copy(), mu


_REASONS = {
    PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT: "too many iterations",
    compat.NOT_A_NUMBER: "the residual is not a number",
    PETSc.SNES.ConvergedReason.DIVERGED_DTOL: "the iteration diverged",
    PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE: "the tangent could not be factored",
}

"""PETSc SNES on the bordered system for (u, mu):

    R(u) + mu R_mu(u) = 0      K du + R_mu dmu = -R
    g(u, mu)          = 0      c.du + d    dmu = -g

One factorisation of K and two back-solves make a Newton step, whatever the last row.
The unknown vector is u with mu appended on the last rank.
"""

import weakref
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from petsc4py import PETSc

from magshell_fenicsx.solve.control import Row
from magshell_fenicsx.solve.factor import Factorisation
from magshell_fenicsx.solve.system import State, System, Vector, dot, max_abs


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
    largest_step
        An iteration that moves u by more than this many lengths is a divergence.
    """

    tolerance: float = 1e-9
    max_iterations: int = 25
    contraction: float = 0.3
    largest_step: float = 1e4


@dataclass(frozen=True)
class Outcome:
    """Where Newton ended, and what it took."""

    state: State
    converged: bool
    iterations: int
    reason: str


@dataclass
class _Progress:
    """Sizes of the successive steps and residuals of one solve."""

    steps: list[float] = field(default_factory=list)
    residuals: list[float] = field(default_factory=list)
    factored: bool = False


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

    def _function(self, x: PETSc.Vec, f: PETSc.Vec) -> None:
        u, mu = self._split(x)
        R = self.system.residual(u, {**self._guess.mu, self._name: mu})
        self._progress.residuals.append(np.sqrt(dot(self.system.comm, R, R)))
        self._join(R, self._row.residual(u, mu), f)

    def _jacobian(self, x: PETSc.Vec, J: PETSc.Mat) -> None:
        u, mu = self._split(x)
        norms, known = self._progress.residuals, self._progress.factored
        if not known or norms[-1] > self.options.contraction * norms[-2]:
            self.factor_at(self._guess.with_(u, self._name, mu))
            self._progress.factored = True
        self._column = self.system.load(u, self._name)
        self._c, self._d = self._row.gradient(u)
        J.assemble()

    def _apply(self, f: PETSc.Vec, y: PETSc.Vec) -> None:
        """The Newton step (SNES subtracts it): block elimination with the factors at hand."""
        comm, solve = self.system.comm, self.factorisation.solve
        R, g = self._split(f)
        if self._c is None:
            dmu = g / self._d
            du = solve(R - dmu * self._column)
        else:
            x1, x2 = solve(R), solve(self._column)
            dmu = (g - dot(comm, self._c, x1)) / (self._d - dot(comm, self._c, x2))
            du = x1 - dmu * x2
        self._progress.steps.append(max_abs(comm, du) / self.system.length)
        self._join(du, dmu, y)

    def _mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The bordered matrix times a vector, for SNES's line searches and monitors."""
        du, dmu = self._split(x)
        K = self.factorisation.matrix
        v, w = K.createVecs()
        v.setArray(du)
        K.mult(v, w)
        g = self._d * dmu + (dot(self.system.comm, self._c, du) if self._c is not None else 0.0)
        self._join(w.array + dmu * self._column, g, y)

    def _test(self, iteration: int, norm: float) -> Any:
        Reason, o = PETSc.SNES.ConvergedReason, self.options
        if not np.isfinite(norm):
            return Reason.DIVERGED_FNORM_NAN
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
        if stalled and step <= 1e4 * o.tolerance:
            return Reason.CONVERGED_SNORM_RELATIVE  # rounding: neither steps nor residuals shrink further
        if iteration >= o.max_iterations:
            return Reason.DIVERGED_MAX_IT
        return Reason.CONVERGED_ITERATING

    def _join(self, u: Vector, mu: float, x: PETSc.Vec) -> None:
        x.setArray(np.append(u, mu) if self._last else u)

    def _split(self, x: PETSc.Vec) -> tuple[Vector, float]:
        local = x.array_r
        mu = self.system.comm.bcast(float(local[-1]) if self._last else None, root=self.system.comm.size - 1)
        return local[: self.system.size].copy(), mu


_REASONS = {
    PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT: "too many iterations",
    PETSc.SNES.ConvergedReason.DIVERGED_FNORM_NAN: "the residual is not a number",
    PETSc.SNES.ConvergedReason.DIVERGED_DTOL: "the iteration diverged",
    PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE: "the tangent could not be factored",
}

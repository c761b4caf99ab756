"""PETSc's SNES around a solver that computes its own steps: its callbacks, and its reasons in words."""

import weakref
from typing import Any, Protocol

from petsc4py import PETSc

from magshell_fenicsx.continuation.iterates import Verdict
from magshell_fenicsx.platform import compat

HIDDEN = "rounding hides the solution: the tangent is nearly singular"


class Solver(Protocol):
    """The functions that SNES calls; `x`, `f` and `y` hold u and, at the end of the last rank, mu."""

    def function(self, x: PETSc.Vec, f: PETSc.Vec) -> None: ...

    def test(self, snes: PETSc.SNES, norm: float) -> Any: ...

    def apply(self, y: PETSc.Vec) -> None: ...

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None: ...


class _Callbacks:
    """The callbacks for PETSc. A weak reference, so that PETSc does not keep the solver and its factors in memory."""

    def __init__(self, newton: Solver) -> None:
        self._newton = weakref.ref(newton)

    @property
    def newton(self) -> Solver:
        newton = self._newton()
        assert newton is not None
        return newton

    def function(self, snes: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        self.newton.function(x, f)

    def jacobian(self, snes: PETSc.SNES, x: PETSc.Vec, J: PETSc.Mat, P: PETSc.Mat) -> None:
        J.assemble()

    def test(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> Any:
        return self.newton.test(snes, norms[2])

    def apply(self, pc: PETSc.PC, f: PETSc.Vec, y: PETSc.Vec) -> None:
        self.newton.apply(y)

    def mult(self, J: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.newton.mult(x, y)


def make_snes(solver: Solver, x: PETSc.Vec, max_iterations: int) -> PETSc.SNES:
    """A SNES for vectors like `x`, with full steps unless PETSc's options set a line search."""
    me, f, sizes = _Callbacks(solver), x.duplicate(), x.getSizes()
    J = PETSc.Mat().createPython((sizes, sizes), context=me, comm=x.comm)
    J.setUp()
    snes = PETSc.SNES().create(x.comm)
    snes.setOptionsPrefix("magshell_")
    snes.setFunction(me.function, f)
    snes.setJacobian(me.jacobian, J)
    snes.setConvergenceTest(me.test)
    snes.setType("newtonls")
    given = PETSc.Options("magshell_")
    if not given.hasName("snes_linesearch_type"):
        given["snes_linesearch_type"] = "basic"  # full steps; if they fail, the path takes a smaller step
    snes.setTolerances(max_it=max_iterations)
    ksp = snes.getKSP()
    ksp.setType("preonly")
    ksp.getPC().setType("python")
    ksp.getPC().setPythonContext(me)
    ksp.setNormType(PETSc.KSP.NormType.NONE)
    snes.setFromOptions()
    return snes


def in_words(verdict: Verdict, ended: int) -> str:
    """The reason why a solve ended, from the verdict on its steps and SNES's reason."""
    return _REASONS.get(verdict) or _REASONS_OF_SNES.get(ended, f"SNES reason {ended}")


REASON_OF = {
    "go on": PETSc.SNES.ConvergedReason.CONVERGED_ITERATING,
    "converged": PETSc.SNES.ConvergedReason.CONVERGED_SNORM_RELATIVE,
    "diverged": PETSc.SNES.ConvergedReason.DIVERGED_DTOL,
    "rounding": PETSc.SNES.ConvergedReason.DIVERGED_INNER,
    "too many": PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT,
}
_REASONS_OF_SNES = {
    compat.NOT_A_NUMBER: "the residual is not a number",
    PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE: "the tangent could not be factored",
}
_REASONS: dict[str, str] = {
    "converged": "converged",
    "diverged": "the iteration diverged",
    "rounding": HIDDEN,
    "too many": "too many iterations",
}

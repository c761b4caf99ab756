"""The lowest eigenpairs of a tangent, K phi = lambda M phi, without gaps.

SLEPc's Lanczos iteration runs around a shift below all eigenvalues. The inertia of K - sigma M shows that no
eigenvalue lies below the shift, and none between those found is missing.
"""

from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc
from slepc4py import SLEPc

from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.inverse import NoEigenpair, nearest_to_zero
from magshell_fenicsx.continuation.system import Tangent, Vector, symmetric_part

TOLERANCE = 1e-10  # of an eigenvalue, relative to its distance from the shift
MARGIN = 1e-6  # eigenvalues closer than this, in the same relative measure, count as one multiple eigenvalue
MOST_TRIALS = 30


class ModesNotFound(RuntimeError):
    """The lowest eigenpairs of a tangent could not be computed."""


@dataclass(frozen=True)
class Mode:
    """An eigenpair.

    Attributes
    ----------
    eigenvalue
        lambda: negative for an unstable direction.
    vector
        phi, its part on this rank, with phi . M phi = 1.
    """

    eigenvalue: float
    vector: Vector


def lowest_modes(K: PETSc.Mat, M: PETSc.Mat, count: int) -> list[Mode]:
    """The algebraically lowest eigenpairs of K phi = lambda M phi, ascending.

    Parameters
    ----------
    K
        A symmetric tangent. It may be indefinite, but not exactly singular.
    M
        A symmetric matrix, positive definite on the free degrees of freedom, with zero rows and columns for the held
        ones. Its sparsity pattern is part of that of K.
    count
        Number of eigenpairs. If there are more negative eigenvalues, all of these are returned.

    Raises
    ------
    ModesNotFound
        If Lanczos does not converge, or Sylvester's law says that some eigenvalues stay hidden.
    """
    slices = _Slices(K, M)
    wanted = min(max(count, slices.below(0.0)), slices.finite)
    # (a) the eigenvalues nearest to zero give the order of magnitude
    shift = -2 * max(abs(mode.eigenvalue) for mode in slices.around(0.0, wanted + 1, 1e-3))
    # (b) a shift with nothing below it
    trials = 0
    while slices.below(shift):
        if (trials := trials + 1) == MOST_TRIALS:
            raise ModesNotFound(f"the tangent has eigenvalues below {shift:g}")
        shift *= 4
    # (c) the eigenvalues above it; again with more if some below the last one were missed
    sought = wanted
    for _ in range(MOST_TRIALS):
        found = slices.around(shift, sought, TOLERANCE)
        last = found[wanted - 1].eigenvalue
        above = last + MARGIN * (last - shift)
        missed = slices.below(above) - sum(mode.eigenvalue < above for mode in found)
        if missed <= 0:
            return found[:wanted]
        sought += missed
    raise ModesNotFound(f"{missed} eigenvalues below {above:g} stay hidden from Lanczos")


def null_vector(K: Tangent) -> Vector:
    """The eigenvector of length one of the eigenvalue nearest to zero of a tangent.

    Raises
    ------
    ModesNotFound
        See `nearest_to_zero`.
    """
    factorisation = Factorisation(symmetric_part(K).comm.tompi4py())
    factorisation.factor(K)
    try:
        return nearest_to_zero(factorisation)[1]
    except NoEigenpair as e:
        raise ModesNotFound(str(e)) from None


class _Slices:
    """K - sigma M for several sigma: its inertia, and the eigenpairs around sigma; the latest factors are kept."""

    def __init__(self, K: PETSc.Mat, M: PETSc.Mat) -> None:
        self._K, self._M = K, M
        self._shifted = K.duplicate()
        self._shifted.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self._factorisation = Factorisation(K.comm.tompi4py())
        self._sigma: float | None = None
        self.finite = K.comm.tompi4py().allreduce(int(np.count_nonzero(M.getDiagonal().array_r)))

    def below(self, sigma: float) -> int:
        """The number of eigenvalues below sigma: negative pivots of K - sigma M."""
        if sigma != self._sigma:
            self._K.copy(self._shifted, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
            self._shifted.axpy(-sigma, self._M, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
            self._factorisation.factor(self._shifted)
            self._sigma = sigma
        return self._factorisation.negative_pivots

    def around(self, sigma: float, count: int, tolerance: float) -> list[Mode]:
        """Eigenpairs nearest to sigma, ascending."""
        self.below(sigma)
        count = min(count, self.finite)
        eps = SLEPc.EPS().create(self._K.comm)
        eps.setOptionsPrefix("magshell_modes_")
        eps.setOperators(self._K, self._M)
        eps.setProblemType(SLEPc.EPS.ProblemType.GHEP)
        eps.setWhichEigenpairs(SLEPc.EPS.Which.TARGET_MAGNITUDE)
        eps.setTarget(sigma)
        eps.setDimensions(count)
        eps.setTolerances(tolerance, 1000)
        st = eps.getST()
        st.setType(SLEPc.ST.Type.SINVERT)
        st.setMatMode(SLEPc.ST.MatMode.SHELL)
        ksp = st.getKSP()
        ksp.setType(PETSc.KSP.Type.PREONLY)
        ksp.getPC().setType(PETSc.PC.Type.PYTHON)
        ksp.getPC().setPythonContext(_BackSolve(self._factorisation))
        eps.setFromOptions()
        eps.solve()
        if eps.getConverged() < count:
            raise ModesNotFound(f"Lanczos found {eps.getConverged()} of {count} eigenpairs around {sigma:g}")
        v = self._K.createVecRight()
        modes = [Mode(float(eps.getEigenpair(i, v).real), np.array(v.array_r)) for i in range(count)]
        eps.destroy()
        return sorted(modes, key=lambda mode: mode.eigenvalue)


@dataclass(frozen=True)
class _BackSolve:
    """A preconditioner for PETSc that solves with the factors."""

    factorisation: Factorisation

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        y.setArray(self.factorisation.solve(x.array_r))

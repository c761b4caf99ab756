"""Eigenpairs of a tangent: the one nearest to zero from its factors, and the lowest without gaps.

The nearest to zero comes from Rayleigh-Ritz for K^-1 in a Krylov space, which grows by one solve at
a time until the pair's residual is small. Plain inverse iteration does not converge between
eigenvalues a and -a, and it converges slowly among many modes of almost equal stiffness, as on a
sphere.

The lowest, K phi = lambda M phi, come from SLEPc's Lanczos iteration around a shift below all
eigenvalues. The inertia of K - sigma M shows that no eigenvalue lies below the shift, and none
between those found is missing.

K is a tangent, M a mass matrix, phi a mode with its eigenvalue lambda. The inertia, or number of
negative pivots, of a factored matrix is its number of negative eigenvalues. A skewed tangent is not
symmetric; Ritz pairs are approximate eigenpairs in a Krylov space, in which theta stands for
1/lambda.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc
from slepc4py import SLEPc

from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import State, Tangent, Vector, dot, symmetric_part

# of K^-1 v - v/lambda, over 1/|lambda|; the error of the eigenvalue is of its square
TOLERANCE = 1e-8
MAX_SOLVES = 300
MAX_VECTORS, VECTORS_AFTER_RESTART = 24, 8  # of the Krylov space
# if a and -a are equally near to zero up to this relative difference, the negative one is returned
TIE_TOLERANCE = 1e-6
# after so many solves without progress, a residual at the level of rounding is accepted
PATIENCE = 12
ROUNDING = 100 * np.finfo(float).eps  # level of rounding of K v - lambda v, over the norm of K
LANCZOS_TOLERANCE = 1e-10  # of an eigenvalue, relative to its distance from the shift
# eigenvalues closer than this, in the same relative measure, count as one multiple eigenvalue
MULTIPLE_TOLERANCE = 1e-6
MAX_TRIALS = 30


class NoEigenpair(RuntimeError):
    """The eigenpair of a tangent nearest to zero could not be computed."""


def nearest_to_zero(factors: Factorisation) -> tuple[float, Vector]:
    """Return the eigenvalue of a factored tangent nearest to zero, and its eigenvector. Collective.

    The vector has length one. For a nearly singular tangent it is the null vector. Its sign is
    arbitrary; for a multiple eigenvalue it is any vector of the eigenspace.

    Raises
    ------
    NoEigenpair
        On all ranks, if the residual reaches neither the tolerance nor the level of rounding.
    """
    space, least_error, solves_without_progress = _InverseKrylovSpace(factors), np.inf, 0
    while space.solves < MAX_SOLVES:
        pair = space.grow()
        if pair.error <= TOLERANCE or space.is_whole:
            return pair.value, pair.vector
        # at the level of rounding the error falls no further
        progresses = pair.error < least_error / 2
        solves_without_progress = 0 if progresses else solves_without_progress + 1
        least_error = min(least_error, pair.error)
        is_rounding = pair.error * abs(pair.value) <= ROUNDING * space.norm
        if solves_without_progress >= PATIENCE and is_rounding:
            return pair.value, pair.vector
    raise NoEigenpair(
        f"the tangent's eigenvalue nearest to zero is not found in {MAX_SOLVES} solves: "
        f"at {pair.value:.3g} the residual is still {pair.error:.1g} of it"
    )


@dataclass(frozen=True)
class _RitzPair:
    """An approximate eigenpair.

    Attributes
    ----------
    value, vector
        The eigenvalue lambda, and its vector of length one.
    error
        The residual over 1/|lambda|, including that of a pair of the other sign that may be nearer
        to zero.
    """

    value: float
    vector: Vector
    error: float


class _InverseKrylovSpace:
    """A Krylov space of K^-1: orthonormal vectors V and their images W = K^-1 V, as rows.

    All methods are collective.

    Attributes
    ----------
    solves
        Number of solves so far.
    norm
        Largest sum of magnitudes in a row of K.

    Private fields: `_V` and `_W` have V and W in their first `_count` rows; `_size` is the number
    of all unknowns. `_next` is the vector by which the space grows next. `_factors` are those of K;
    they are `skewed` if K is not symmetric.
    """

    def __init__(self, factors: Factorisation) -> None:
        """Begin with an empty space and a fixed start vector. Collective."""
        self._factors, self._comm = factors, factors.comm
        n, self._size = factors.size  # rows on this rank, and on all
        self._count, self.solves = 0, 0
        self._V, self._W = np.empty((MAX_VECTORS, n)), np.empty((MAX_VECTORS, n))
        self._next = np.sin(1.0 + np.arange(n) + self._comm.rank)
        self.norm = factors.norm

    @property
    def is_whole(self) -> bool:
        """Whether the space contains all vectors."""
        return self._count == self._size

    def grow(self) -> _RitzPair:
        """Add one vector to the space; return the pair nearest to zero in the larger space.

        A full space is reduced to the vectors of the eigenvalues nearest to zero.

        Raises
        ------
        NoEigenpair
            If a solution is not finite.
        """
        v, k = self._next, self._count
        # the next vector, orthogonal to all others, and its image
        for _ in range(2):  # a second time against rounding
            v = v - self._sums(self._V[:k] @ v) @ self._V[:k]
            v = v / np.sqrt(dot(self._comm, v, v))
        self._V[k], self._W[k] = v, self._factors.solve(v)
        self._count, self.solves = k + 1, self.solves + 1
        # K^-1 in the space, and its eigenvalues theta in ascending order
        V, W = self._V[: k + 1], self._W[: k + 1]
        inverse = self._sums(V @ W.T)
        if not np.isfinite(inverse).all():
            raise NoEigenpair("the tangent's factors give no finite numbers")
        if self._factors.skewed:
            theta, Y = _real_pairs(inverse)
        else:
            theta, Y = np.linalg.eigh((inverse + inverse.T) / 2)
        # lambda = 1/theta is nearest to zero for the largest theta of either sign: these are the
        # first and the last one (the same one in a space of one vector)
        pairs = [self._pair(theta[i], Y[:, i]) for i in {0, len(theta) - 1}]
        pair = self._nearest(pairs)
        # a full space is reduced to the vectors of the largest theta; Y has them in the basis V,
        # orthonormal
        if self._count == MAX_VECTORS:
            largest = np.argsort(-np.abs(theta))[:VECTORS_AFTER_RESTART]
            Y = np.linalg.qr(Y[:, largest])[0] if self._factors.skewed else Y[:, largest]
            self._count = Y.shape[1]
            V[: self._count], W[: self._count] = Y.T @ V, Y.T @ W
        return pair

    def _pair(self, theta: float, y: NDArray[np.float64]) -> tuple[float, Vector, Vector]:
        """Return an eigenpair of K^-1 in the space, and its residual.

        Parameters
        ----------
        theta, y
            Eigenvalue 1/lambda, and the vector in the basis V.

        Returns
        -------
        1/lambda, its vector after one more inverse iteration, and the residual K^-1 v - theta v.
        """
        V, W = self._V[: self._count], self._W[: self._count]
        image = y @ W  # K^-1 v of the vector v = y V
        vector = image / np.sqrt(dot(self._comm, image, image))
        return theta, vector, image - theta * (y @ V)

    def _nearest(self, pairs: list[tuple[float, Vector, Vector]]) -> _RitzPair:
        """Return the pair nearest to zero, and choose the next vector of the space.

        A rival is the pair of the other sign, if its eigenvalue may be as near to zero within its
        error. The next vector is the larger one of both residuals. Of two equally near pairs the
        negative one is returned, so that the result does not depend on rounding.

        Parameters
        ----------
        pairs
            For each pair 1/lambda, its vector and its residual.
        """
        (theta, vector, residual), *rivals = sorted(pairs, key=lambda pair: -abs(pair[0]))
        residual_size = np.sqrt(dot(self._comm, residual, residual))
        self._next, error = residual, residual_size / abs(theta)
        for rival_theta, rival_vector, rival_residual in rivals:
            # the rival's eigenvalue is uncertain by its residual
            uncertainty = np.sqrt(dot(self._comm, rival_residual, rival_residual))
            least_size = (1 - TIE_TOLERANCE) * abs(theta)
            if rival_theta * theta < 0 and abs(rival_theta) + uncertainty >= least_size:
                error = max(error, uncertainty / abs(theta))
                self._next = residual if residual_size > uncertainty else rival_residual
                # equally near, and the negative one
                if rival_theta < 0 and abs(rival_theta) >= least_size:
                    theta, vector = rival_theta, rival_vector
        return _RitzPair(1 / theta, vector, error)

    def _sums(self, local_products: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums over all ranks of inner products on this rank."""
        return np.asarray(self._comm.allreduce(local_products))


def _real_pairs(A: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the real eigenvalues of a small matrix, ascending, with their vectors as columns.

    Without real eigenvalues they are the real parts of all pairs.
    """
    theta, Y = np.linalg.eig(A)
    real = theta.imag == 0.0
    theta, Y = (theta[real], Y[:, real]) if real.any() else (theta, Y)
    order = np.argsort(theta.real)
    return theta.real[order], Y.real[:, order] / np.linalg.norm(Y.real[:, order], axis=0)


class Stability(Protocol):
    """A tangent whose inertia decides stability."""

    def factor_at(self, state: State) -> Factorisation:
        """Factor the tangent at a state. Collective."""


@dataclass(frozen=True)
class CriticalMode:
    """The eigenpair of a tangent nearest to zero, and the tangent's number of negative pivots."""

    eigenvalue: float
    vector: Vector
    negative_pivots: int


def critical_mode(stability: Stability, state: State) -> CriticalMode:
    """Return the eigenpair of a tangent nearest to zero; the vector has length one. Collective.

    Raises
    ------
    NoEigenpair
        If the pair is not found.
    """
    factors = stability.factor_at(state)
    return CriticalMode(*nearest_to_zero(factors), factors.negative_pivots)


class ModesNotFound(RuntimeError):
    """The lowest eigenpairs of a tangent could not be computed."""


@dataclass(frozen=True)
class Eigenpair:
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


def lowest_modes(K: PETSc.Mat, M: PETSc.Mat, count: int, kernel: int = 0) -> list[Eigenpair]:
    """Return the algebraically lowest eigenpairs of K phi = lambda M phi, ascending. Collective.

    Parameters
    ----------
    K
        A symmetric tangent. It may be indefinite. It may be exactly singular only if `kernel` is
        given.
    M
        A symmetric matrix, positive definite on the free degrees of freedom, with zero rows and
        columns for the constrained ones. Its sparsity pattern is part of that of K.
    count
        Number of eigenpairs. If there are more negative eigenvalues, all of these are returned.
    kernel
        Dimension of the kernel of a tangent that has no negative eigenvalue. Its eigenvalues are
        returned as zero.

    Raises
    ------
    ModesNotFound
        If Lanczos does not converge, or Sylvester's law says that some eigenvalues stay hidden.
    """
    slices = _SpectrumSlices(K, M)
    # a positive semidefinite tangent with a kernel would break down at the shift zero
    requested = min(max(count, kernel or slices.count_below(0.0)), slices.finite_count)
    # (a) the eigenvalues nearest to zero, to three digits, give the order of magnitude
    around = -slices.rounding if kernel else 0.0
    nearest = slices.nearest_to(around, requested + kernel + 1, tolerance=1e-3)
    shift = -2 * max(abs(mode.eigenvalue) for mode in nearest)
    # (b) a shift with nothing below it
    trials = 0
    while slices.count_below(shift):
        if (trials := trials + 1) == MAX_TRIALS:
            raise ModesNotFound(f"the tangent has eigenvalues below {shift:g}")
        shift *= 4
    # (c) the eigenvalues above the shift. The inertia counts all below the last one that was found;
    # if Lanczos has missed some of them, it computes as many more
    computed = requested
    for _ in range(MAX_TRIALS):
        modes = slices.nearest_to(shift, computed, LANCZOS_TOLERANCE)
        last_eigenvalue = modes[requested - 1].eigenvalue
        upper_bound = last_eigenvalue + MULTIPLE_TOLERANCE * (last_eigenvalue - shift)
        found = sum(mode.eigenvalue < upper_bound for mode in modes)
        missed = slices.count_below(upper_bound) - found
        if missed <= 0:
            kernel_modes = [Eigenpair(0.0, mode.vector) for mode in modes[:kernel]]
            return kernel_modes + modes[kernel:requested]
        computed += missed
    raise ModesNotFound(f"{missed} eigenvalues below {upper_bound:g} stay hidden from Lanczos")


def null_vector(K: Tangent) -> Vector:
    """Return the eigenvector of a tangent's eigenvalue nearest to zero, of length one. Collective.

    Raises
    ------
    ModesNotFound
        If `nearest_to_zero` finds no eigenpair.
    """
    factorisation = Factorisation(symmetric_part(K).comm.tompi4py())
    factorisation.factor(K)
    try:
        return nearest_to_zero(factorisation)[1]
    except NoEigenpair as e:
        raise ModesNotFound(str(e)) from None


def lowest_mode(K: Tangent) -> Vector:
    """Return the eigenvector of a tangent's lowest eigenvalue. Collective.

    If the tangent is skewed, it is that of its symmetric part. A border is left out. Constrained
    unknowns have the eigenvalues of their rows, which are positive: the lowest one is of a mode
    wherever a direction is unstable.

    Raises
    ------
    ModesNotFound
        If the iteration does not find it.
    """
    symmetric = symmetric_part(K)
    identity = symmetric.duplicate()
    identity.shift(1.0)
    return lowest_modes(symmetric, identity, 1)[0].vector


class _SpectrumSlices:
    """The inertia of K - sigma M for several sigma, and the eigenpairs nearest to sigma.

    The latest factors are kept. All methods are collective.

    Attributes
    ----------
    finite_count
        Number of finite eigenvalues: of unknowns with mass.

    Private fields: `_shifted` is the matrix K - sigma M for the latest sigma, `_sigma`, and
    `_factorisation` has its factors.
    """

    def __init__(self, K: PETSc.Mat, M: PETSc.Mat) -> None:
        """Begin without factors; unknowns without mass have infinite eigenvalues. Collective."""
        self._K, self._M = K, M
        self._shifted = K.duplicate()
        self._shifted.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self._factorisation = Factorisation(K.comm.tompi4py())
        self._sigma: float | None = None
        diagonal = M.getDiagonal().array_r
        self.finite_count = K.comm.tompi4py().allreduce(int(np.count_nonzero(diagonal)))

    @property
    def rounding(self) -> float:
        """The magnitude that rounding may give to an eigenvalue that is zero."""
        norm = PETSc.NormType.INFINITY
        return float(ROUNDING * self._K.norm(norm) / self._M.norm(norm))

    def count_below(self, sigma: float) -> int:
        """Return the number of eigenvalues below sigma: the negative pivots of K - sigma M.

        The factors are kept for solves at this sigma.
        """
        if sigma != self._sigma:
            self._K.copy(self._shifted, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
            self._shifted.axpy(-sigma, self._M, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
            self._factorisation.factor(self._shifted)
            self._sigma = sigma
        return self._factorisation.negative_pivots

    def nearest_to(self, sigma: float, count: int, tolerance: float) -> list[Eigenpair]:
        """Return the `count` eigenpairs nearest to sigma, ascending, by SLEPc's Lanczos iteration.

        Parameters
        ----------
        tolerance
            Error of an eigenvalue, relative to its distance from sigma.

        Raises
        ------
        ModesNotFound
            If the iteration finds fewer.
        """
        self.count_below(sigma)  # factors K - sigma M, with which the iteration solves
        count = min(count, self.finite_count)
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
            raise ModesNotFound(
                f"Lanczos found {eps.getConverged()} of {count} eigenpairs around {sigma:g}"
            )
        v = self._K.createVecRight()
        modes = [
            Eigenpair(float(eps.getEigenpair(i, v).real), np.array(v.array_r)) for i in range(count)
        ]
        eps.destroy()
        return sorted(modes, key=lambda mode: mode.eigenvalue)


@dataclass(frozen=True)
class _BackSolve:
    """A preconditioner for PETSc that solves with known factors."""

    factorisation: Factorisation

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        y.setArray(self.factorisation.solve(x.array_r))

"""The eigenpair of a factored tangent K that is nearest to zero, by Rayleigh-Ritz for K^-1 in a Krylov space.

Plain inverse iteration does not converge between eigenvalues a and -a, and it converges slowly among many modes of
almost equal stiffness, as on a sphere. Here the space grows by one solve at a time until the pair's residual is small.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import Vector, dot

TOLERANCE = 1e-8  # of K^-1 v - v/lambda, over 1/|lambda|; the error of the eigenvalue is of its square
MOST_SOLVES = 300
MOST_VECTORS, KEPT = 24, 8  # vectors in the space before a restart, and after it
TIED = 1e-6  # if a and -a are equally near to zero up to this relative difference, the negative one is returned
PATIENCE = 12  # after so many solves without progress, a residual at the level of rounding is accepted
ROUNDING = 100 * np.finfo(float).eps  # level of rounding of K v - lambda v, over the norm of K


class NoEigenpair(RuntimeError):
    """The eigenpair of a tangent nearest to zero could not be computed."""


def nearest_to_zero(factors: Factorisation) -> tuple[float, Vector]:
    """Eigenvalue and eigenvector of length one; for a nearly singular tangent that is the null vector. Collective.

    The sign of the vector is arbitrary; for a multiple eigenvalue it is any vector of the eigenspace.

    Raises
    ------
    NoEigenpair
        On all ranks, if the residual reaches neither the tolerance nor the level of rounding.
    """
    space, best, waited = _Space(factors), np.inf, 0
    while space.solves < MOST_SOLVES:
        found = space.grown()
        if found.error <= TOLERANCE or space.exhausted:
            return found.value, found.vector
        waited = 0 if found.error < best / 2 else waited + 1
        best = min(best, found.error)
        if waited >= PATIENCE and found.error * abs(found.value) <= ROUNDING * space.norm:
            return found.value, found.vector
    raise NoEigenpair(
        f"the tangent's eigenvalue nearest to zero is not found in {MOST_SOLVES} solves: at {found.value:.3g} "
        f"the residual is still {found.error:.1g} of it"
    )


@dataclass(frozen=True)
class _Pair:
    """`error`: the residual over 1/|lambda|, including that of a pair of the other sign that may be nearer to zero."""

    value: float
    vector: Vector
    error: float


class _Space:
    """Orthonormal vectors V and their images W = K^-1 V."""

    def __init__(self, factors: Factorisation) -> None:
        self._factors, self._comm = factors, factors.comm
        n, self._size = factors.size
        self._count, self.solves = 0, 0
        self._V, self._W = np.empty((MOST_VECTORS, n)), np.empty((MOST_VECTORS, n))
        self._next = np.sin(1.0 + np.arange(n) + self._comm.rank)
        self.norm = factors.norm

    @property
    def exhausted(self) -> bool:
        """Whether the space is the whole one."""
        return self._count == self._size

    def grown(self) -> _Pair:
        """Add one vector; the pair nearest to zero in the larger space."""
        v, k = self._next, self._count
        for _ in range(2):  # a second time against rounding
            v = v - self._sums(self._V[:k] @ v) @ self._V[:k]
            v = v / np.sqrt(dot(self._comm, v, v))
        self._V[k], self._W[k] = v, self._factors.solve(v)
        self._count, self.solves = k + 1, self.solves + 1
        V, W = self._V[: k + 1], self._W[: k + 1]
        inverse = self._sums(V @ W.T)
        if not np.isfinite(inverse).all():
            raise NoEigenpair("the tangent's factors give no finite numbers")
        if self._factors.skewed:
            theta, Y = _real_pairs(inverse)
        else:
            theta, Y = np.linalg.eigh((inverse + inverse.T) / 2)  # ascending, of K^-1
        pairs = [self._pair(theta[i], Y[:, i]) for i in {0, len(theta) - 1}]
        pair = self._nearest(pairs)
        if self._count == MOST_VECTORS:
            far = np.argsort(-np.abs(theta))[:KEPT]
            kept = np.linalg.qr(Y[:, far])[0] if self._factors.skewed else Y[:, far]
            self._count = kept.shape[1]
            V[: self._count], W[: self._count] = kept.T @ V, kept.T @ W
        return pair

    def _pair(self, theta: float, y: NDArray[np.float64]) -> tuple[float, Vector, Vector]:
        """1/lambda, its vector after one more inverse iteration, and the residual."""
        V, W = self._V[: self._count], self._W[: self._count]
        w = y @ W
        return theta, w / np.sqrt(dot(self._comm, w, w)), w - theta * (y @ V)

    def _nearest(self, pairs: list[tuple[float, Vector, Vector]]) -> _Pair:
        (theta, w, rest), *others = sorted(pairs, key=lambda pair: -abs(pair[0]))
        size = np.sqrt(dot(self._comm, rest, rest))
        self._next, error = rest, size / abs(theta)
        for rival, rival_w, rival_rest in others:
            rival_size = np.sqrt(dot(self._comm, rival_rest, rival_rest))
            if rival * theta < 0 and abs(rival) + rival_size >= (1 - TIED) * abs(theta):
                error = max(error, rival_size / abs(theta))
                self._next = rest if size > rival_size else rival_rest
                if rival < 0 and abs(rival) >= (1 - TIED) * abs(theta):
                    theta, w = rival, rival_w
        return _Pair(1 / theta, w, error)

    def _sums(self, here: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inner products over all ranks."""
        return np.asarray(self._comm.allreduce(here))


def _real_pairs(A: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The eigenpairs of a small matrix, ascending; real eigenvalues alone if there are any, else real parts."""
    theta, Y = np.linalg.eig(A)
    real = theta.imag == 0.0
    theta, Y = (theta[real], Y[:, real]) if real.any() else (theta, Y)
    order = np.argsort(theta.real)
    return theta.real[order], Y.real[:, order] / np.linalg.norm(Y.real[:, order], axis=0)

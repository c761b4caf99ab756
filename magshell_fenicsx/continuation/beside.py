"""Factors of the sparse part of a tangent where the rest is small beside it: eigenvalues far from zero, solutions.

With K = K0 + D the matrix A = K0^-1 D has an eigenvalue -1 where K is singular. On the way K0 + t D, t from 0 to 1,
an eigenvalue nu < -1 of A makes it singular once, at t = -1/nu, with the vector x of nu: one more negative eigenvalue
where x . D x < 0, else one less. So the inertia of K is that of K0 and what the few eigenvalues of A below -1 add.
"""

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from magshell_fenicsx.continuation.system import Vector, dot

SMALL = 0.1  # eigenvalues of A within this size are not looked at one by one
LEAST, MOST = 4, 30  # products with A for them: as many as show that there are none beyond, and before it is given up
RUNS = 6  # with what was found before left out: eigenvalues may be multiple
SURE = 0.1  # error of an eigenvalue over its distance from -1
TOLERANCE, ACCEPTED = 1e-12, 1e-7  # of a solution's rest, over the first one; the second where rounding hides more
Array = NDArray[np.float64]
Map = Callable[[Vector], Vector]
Energy = Callable[[Vector], float]


class Krylov:
    """A basis of the vectors that a matrix makes of one, orthonormal, one more with each `grow`: Arnoldi's method."""

    def __init__(self, times: Map, first: Vector, comm: MPI.Comm, most: int) -> None:
        self._times, self._comm = times, comm
        self.norm = float(np.sqrt(dot(comm, first, first)))
        self.basis: list[Vector] = [np.array(first / (self.norm or 1.0), dtype=np.float64)]
        self.H = np.zeros((most + 1, most))

    def grow(self) -> int:
        """Add a vector; the number of columns of H that are made. What is left of an invariant space is zero."""
        j, w = len(self.basis) - 1, np.array(self._times(self.basis[-1]))
        for _ in range(2):
            for i, q in enumerate(self.basis):
                part = dot(self._comm, q, w)
                self.H[i, j] += part
                w -= part * q
        self.H[j + 1, j] = np.sqrt(dot(self._comm, w, w))
        self.basis.append(w / (self.H[j + 1, j] or 1.0))
        return j + 1

    def combined(self, parts: Array) -> Vector:
        return np.asarray(sum(part * q for part, q in zip(parts, self.basis, strict=False)))


def solved(times: Map, first: Vector, comm: MPI.Comm) -> Vector:
    """The solution of (I + A) x = first by generalised minimal residuals; not a number if that fails."""
    krylov, size, rest = Krylov(lambda v: v + times(v), first, comm, MOST), 0, 1.0
    if not krylov.norm:
        return first
    y: Array = np.zeros(0)
    while size < MOST and rest > TOLERANCE:
        size = krylov.grow()
        Q, R = np.linalg.qr(krylov.H[: size + 1, :size], mode="complete")
        y, before = solve_triangular(R[:size], Q[0, :size]), rest
        rest = abs(Q[0, size])
        if before < ACCEPTED and rest > before / 2:
            break
    return krylov.norm * krylov.combined(y) if rest <= ACCEPTED else np.full_like(first, np.nan)


def crossings(times: Map, energy: Energy, first: Vector, comm: MPI.Comm) -> tuple[int, float] | None:
    """How many more negative eigenvalues K0 + D has than K0, and the doubt; None if A has too many large ones.

    The doubt is the largest |nu|/|1 + nu|: with errors of D below its inverse, relative to D, the number is the same.

    Parameters
    ----------
    times
        A times a vector.
    energy
        x . D x
    first
        Begins the iteration.
    """
    more, doubt, out = 0, 0.0, list[Vector]()

    def apart(v: Vector) -> Vector:
        for q in out:
            v = v - dot(comm, q, v) * q
        return v

    for _ in range(RUNS):
        krylov, size = Krylov(lambda v: apart(times(v)), apart(first), comm, MOST), 0
        while True:
            size = krylov.grow()
            values, vectors = np.linalg.eig(krylov.H[:size, :size])
            errors = abs(krylov.H[size, size - 1] * vectors[-1])
            far = np.flatnonzero(np.abs(values) > SMALL)
            if size >= LEAST and np.all(errors[far] < SURE * np.minimum(abs(1 + values[far]), abs(values[far]))):
                break
            if size == MOST or not np.isfinite(values).all():
                return None
        doubt = max(doubt, float((np.abs(values) / np.abs(1 + values)).max()))
        if not len(far):
            return more, doubt
        for i in far[values[far].imag >= 0]:  # of a conjugate pair one
            parts = [vectors[:, i].real, vectors[:, i].imag] if values[i].imag > 0 else [vectors[:, i].real]
            vectors_of_value = [krylov.combined(part) for part in parts]
            if values[i].imag == 0 and values[i].real < -1:
                more += 1 if energy(vectors_of_value[0]) < 0 else -1
            for x in vectors_of_value:
                x = apart(x)
                out.append(x / np.sqrt(dot(comm, x, x)))
    return None


def largest(times: Map, first: Vector, comm: MPI.Comm) -> float:
    """The largest magnitude of an eigenvalue of A, to about `SURE`; infinite if it is not found."""
    krylov = Krylov(times, first, comm, MOST)
    while (size := krylov.grow()) < MOST:
        values, vectors = np.linalg.eig(krylov.H[:size, :size])
        i = int(np.argmax(np.abs(values)))
        if size >= LEAST and abs(krylov.H[size, size - 1] * vectors[-1, i]) <= SURE * abs(values[i]):
            return float(abs(values[i]))
    return np.inf

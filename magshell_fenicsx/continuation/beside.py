"""Factors of the sparse part of a tangent where the rest is small beside it: eigenvalues far from
zero, solutions.

With K = K0 + D the matrix A = K0^-1 D has an eigenvalue -1 where K is singular. On the way K0 + t
D, t from 0 to 1, an eigenvalue nu < -1 of A makes it singular once, at t = -1/nu, with the vector x
of nu: one more negative eigenvalue where x . D x < 0, else one less. So the inertia of K is that of
K0 and what the few eigenvalues of A below -1 add.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import Beside, Rest, Vector, dot

SMALL = 0.1  # eigenvalues of A within this size are not looked at one by one
LEAST, MOST = (
    4,
    30,
)  # products with A for them: as many as show that there are none beyond, and before it is given up
RUNS = 6  # with what was found before left out: eigenvalues may be multiple
SURE = 0.1  # error of an eigenvalue over its distance from -1
TOLERANCE, ACCEPTED = (
    1e-12,
    1e-7,
)  # of a solution's rest, over the first one; the second where rounding hides more
ROUGH = 3e-2  # the first of these of a step of Newton's method
SURELY = (
    0.5  # of the tangent: less that is foreseen to lack changes no sign, were its error as large
)
# a larger doubt is looked into: what is older is corrected along the vectors of large eigenvalues,
CORRECTED = 1.0
FEW = 3  # if they are not more
KEPT = 40  # products with D that are remembered
DEPENDENT = 1e-12  # square of the part of a vector that others do not have
Array = NDArray[np.float64]
Map = Callable[[Vector], Vector]


class Krylov:
    """A basis of the vectors that a matrix makes of one, orthonormal, one more with each `grow`:
    Arnoldi's method.
    """

    def __init__(self, times: Map, first: Vector, comm: MPI.Comm, most: int) -> None:
        self._times, self._comm = times, comm
        self.norm = float(np.sqrt(dot(comm, first, first)))
        self.basis: list[Vector] = [np.array(first / (self.norm or 1.0), dtype=np.float64)]
        self.H = np.zeros((most + 1, most))

    def grow(self) -> int:
        """Add a vector; the number of columns of H that are made.

        What is left of an invariant space is zero.
        """
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


class Remembered:
    """D, with its first products: what they say of it serves solutions with any K."""

    def __init__(self, D: Rest) -> None:
        self.D, self.pairs = D, list[tuple[Vector, Vector]]()

    def times(self, v: Vector) -> Vector:
        """D v. Collective."""
        product = self.D.times(v)
        if len(self.pairs) < KEPT:
            self.pairs.append((np.array(v), product))
        return product

    def of(self, D: Rest) -> "Remembered":
        """This one if it is of D, or of a multiple of it, that times its factor; else a new one."""
        factor = D.over(self.D)
        if factor == 1.0:
            return self
        other = Remembered(D)
        if factor:
            other.pairs = [(v, factor * product) for v, product in self.pairs]
        return other


class Solver:
    """Solves (I + A) x = b, A = K^-1 D, by generalised conjugate residuals that begin with all
    products so far.

    So a solution needs few products, or none: D has few large eigenvalues over K, and earlier
    vectors hold their directions (M. L. Parks, E. de Sturler, G. Mackey, D. D. Johnson, S. Maiti,
    SIAM J. Sci. Comput. 28, 2006, 1651).

    Parameters
    ----------
    back, backs
        K^-1 times a vector, and times columns.
    """

    def __init__(self, back: Map, backs: Map, of: Remembered, comm: MPI.Comm, size: int) -> None:
        self._back, self._of, self._comm = back, of, comm
        # u, and c = (I + A) u, orthonormal: columns, of which so many are kept
        self._U, self._C = (np.empty((size, KEPT + MOST), order="F") for _ in range(2))
        self._count = 0
        if of.pairs:
            U, products = (np.column_stack(each) for each in zip(*of.pairs, strict=True))
            C = U + backs(products)
            for _ in range(2):
                squares, Q = np.linalg.eigh(comm.allreduce(C.T @ C))
                kept = squares > DEPENDENT * squares[-1]
                U, C = (each @ Q[:, kept] / np.sqrt(squares[kept]) for each in (U, C))
            self._count = C.shape[1]
            self._U[:, : self._count], self._C[:, : self._count] = U, C

    def solve(self, b: Vector, tolerance: float) -> Vector:
        """The solution, with a rest, over b, below the tolerance; not a number if that fails."""
        size = np.sqrt(dot(self._comm, b, b))
        if not 0.0 < size < np.inf:
            return b
        x, r = self._without(np.zeros_like(b), np.array(b), -1.0)
        rest, m = np.sqrt(dot(self._comm, r, r)) / size, self._count
        while rest > tolerance and m < KEPT + MOST:
            u, c = self._without(r, r + self._back(self._of.times(r)), 1.0, m)
            norm = np.sqrt(dot(self._comm, c, c))
            self._U[:, m], self._C[:, m] = u / norm, c / norm
            part = dot(self._comm, self._C[:, m], r)
            x, r, m, before = x + part * self._U[:, m], r - part * self._C[:, m], m + 1, rest
            rest = np.sqrt(dot(self._comm, r, r)) / size
            if before < ACCEPTED and rest > before / 2:
                break
        self._count = min(m, KEPT)
        if not rest <= max(ACCEPTED, tolerance):
            return np.full_like(b, np.nan)
        return x + r if rest <= tolerance else x

    def _without(
        self, u: Vector, c: Vector, sign: float, count: int | None = None
    ) -> tuple[Vector, Vector]:
        """What is left of c beside the columns, and u less their sum or, with the sign -1, plus it."""
        m = self._count if count is None else count
        for _ in range(2):  # the second time for what rounding has left
            parts = self._comm.allreduce(self._C[:, :m].T @ c)
            u, c = u - sign * (self._U[:, :m] @ parts), c - self._C[:, :m] @ parts
        return u, c


@dataclass(frozen=True)
class Crossings:
    """How many more negative eigenvalues K0 + D has than K0.

    Attributes
    ----------
    doubt
        The largest |nu|/|1 + nu|: with errors of D below its inverse, relative to D, the number is
        the same.
    large
        Vectors of the eigenvalues beyond `SMALL`.
    """

    more: int
    doubt: float
    large: list[Vector]


class Apart:
    """Some vectors X and K X, and what is left of others."""

    def __init__(self, X: Sequence[Vector], KX: Sequence[Vector], comm: MPI.Comm) -> None:
        self._comm, self._any = comm, bool(X)
        if X:
            self.X, self.KX = (np.column_stack(each) for each in (X, KX))
            self.M = comm.allreduce(self.X.T @ self.KX)

    def along(self, v: Vector) -> Array:
        """The parts of v along X, with K as the inner product. Collective."""
        return np.asarray(np.linalg.solve(self.M, self._comm.allreduce(self.KX.T @ v)))

    def of(self, v: Vector) -> Vector:
        """What is left of v, which K separates from X. Collective."""
        return np.asarray(v - self.X @ self.along(v)) if self._any else v


class Corrected:
    """D where it is of an earlier state, with what it lacks along some vectors X, and symmetric.

    With F X = Y, D + F has (Powell's symmetric update, of several) F = Y C + C^T Y^T - C^T X^T Y C
    with C X = 1, here C = (X^T K X)^-1 X^T K: nothing is added between vectors that K separates
    from X.

    Parameters
    ----------
    lacks
        Y.
    """

    def __init__(
        self,
        D: Rest,
        X: Sequence[Vector],
        lacks: Sequence[Vector],
        KX: Sequence[Vector],
        comm: MPI.Comm,
    ) -> None:
        self._D, self._comm, self._apart, self._Y = (
            D,
            comm,
            Apart(X, KX, comm),
            np.column_stack(lacks),
        )
        between = comm.allreduce(self._apart.X.T @ self._Y)
        self._between = (between + between.T) / 2

    def times(self, v: Vector) -> Vector:
        """(D + F) v. Collective."""
        c, y = self._apart.along(v), self._comm.allreduce(self._Y.T @ v)
        back = np.linalg.solve(self._apart.M.T, y - self._between @ c)
        return np.asarray(self._D.times(v) + self._Y @ c + self._apart.KX @ back)


def crossings(D: Map, back: Map, first: Vector, comm: MPI.Comm) -> Crossings | None:
    """How many more negative eigenvalues K0 + D has than K0; None if A has too many large ones.

    Parameters
    ----------
    D, back
        D and K^-1 times a vector.
    first
        Begins the iteration.
    """
    more, doubt, out = 0, 0.0, list[Vector]()

    def apart(v: Vector) -> Vector:
        for q in out:
            v = v - dot(comm, q, v) * q
        return v

    for _ in range(RUNS):
        krylov, size = Krylov(lambda v: apart(back(D(v))), apart(first), comm, MOST), 0
        while True:
            size = krylov.grow()
            if not np.isfinite(krylov.H[:size, :size]).all():
                return None
            values, vectors = np.linalg.eig(krylov.H[:size, :size])
            errors = abs(krylov.H[size, size - 1] * vectors[-1])
            far = np.flatnonzero(np.abs(values) > SMALL)
            if size >= LEAST and np.all(
                errors[far] < SURE * np.minimum(abs(1 + values[far]), abs(values[far]))
            ):
                break
            if size == MOST:
                return None
        doubt = max(doubt, float((np.abs(values) / np.abs(1 + values)).max()))
        if not len(far):
            return Crossings(more, doubt, out)
        for i in far[values[far].imag >= 0]:  # of a conjugate pair one
            parts = (
                [vectors[:, i].real, vectors[:, i].imag]
                if values[i].imag > 0
                else [vectors[:, i].real]
            )
            vectors_of_value = [krylov.combined(part) for part in parts]
            if values[i].imag == 0 and values[i].real < -1:
                x = vectors_of_value[0]
                more += 1 if dot(comm, x, D(x)) < 0 else -1
            for x in vectors_of_value:
                x = apart(x)
                out.append(x / np.sqrt(dot(comm, x, x)))
    return None


def doubted(
    tangent: Beside, counted: Crossings, back: Map, K: Map, first: Vector, comm: MPI.Comm
) -> Crossings:
    """A count with the doubt that what may be of an earlier state makes; a large one is met with
    what is present.

    What is older, with an error as large as itself, changes the sign along a vector x where x .
    changing x is larger than x . (K + D) x. Of vectors that K separates from those of large
    eigenvalues, only the largest is looked at.
    """
    changing = tangent.changing
    if changing is None:
        return counted
    X, least = counted.large, SMALL / (1 - SMALL)
    KX = [K(x) for x in X]
    doubts = [
        abs(dot(comm, x, changing.times(x)) / (dot(comm, x, y) + dot(comm, x, tangent.D.times(x))))
        for x, y in zip(X, KX, strict=True)
    ]
    apart, change = Apart(X, KX, comm), tangent.change
    rest = max(
        least, largest(lambda v: apart.of(back(changing.times(apart.of(v)))), apart.of(first), comm)
    )
    if tangent.foreseen:  # the older part may be small where the present one is not
        missed = largest(lambda v: apart.of(back(change(apart.of(v)))), apart.of(first), comm)
        rest = max(rest, missed / SURELY)
    large = [i for i, doubt in enumerate(doubts) if not doubt <= CORRECTED]
    if tangent.present and rest <= CORRECTED and 0 < len(large) <= FEW:
        X, KX = ([each[i] for i in large] for each in (X, KX))
        D = Corrected(tangent.D, X, [tangent.present(x) - changing.times(x) for x in X], KX, comm)
        if again := crossings(D.times, back, first, comm):
            return replace(
                again, doubt=max([rest, *(doubt for doubt in doubts if doubt <= CORRECTED)])
            )
    return replace(counted, doubt=max([rest, *doubts]))


def largest(times: Map, first: Vector, comm: MPI.Comm) -> float:
    """The largest magnitude of an eigenvalue of A, to about `SURE`; infinite if it is not found."""
    krylov = Krylov(times, first, comm, MOST)
    while (size := krylov.grow()) < MOST:
        values, vectors = np.linalg.eig(krylov.H[:size, :size])
        i = int(np.argmax(np.abs(values)))
        if size >= LEAST and abs(krylov.H[size, size - 1] * vectors[-1, i]) <= SURE * abs(
            values[i]
        ):
            return float(abs(values[i]))
    return np.inf

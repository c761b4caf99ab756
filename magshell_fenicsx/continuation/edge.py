"""Solving with an edged matrix [K C; C^T D] by block elimination with the factors of K."""

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import Edged, Vector, dot

ROUNDING = 1e-11  # a larger residual, relative to the right side, takes a second solve


class Edge:
    """The k additional unknowns y and the Schur complement S = D - C^T K^-1 C.

    y follows u on the last rank.

    Parameters
    ----------
    solve, times
        K^-1 and K times a vector.

    Attributes
    ----------
    count
        k.
    negative_pivots
        Number that the edge adds to that of K (Haynsworth's inertia additivity), without its multipliers.
    """

    def __init__(
        self, edged: Edged, comm: MPI.Comm, solve: Callable[[Vector], Vector], times: Callable[[Vector], Vector]
    ) -> None:
        self._C, self._D, self._comm, self._solve, self._times = edged.C, edged.D, comm, solve, times
        self.count = len(edged.C)
        self._X = [solve(column) for column in self._C]
        self._S = self._D - self._products(self._X).T
        self.negative_pivots = int(np.sum(np.linalg.eigvalsh((self._S + self._S.T) / 2) < 0)) - edged.multipliers

    def times(self, x: Vector) -> Vector:
        """The whole matrix times (u, y)."""
        u, y = split(x, self.count, self._comm)
        forces = np.sum([yi * column for yi, column in zip(y, self._C, strict=True)], axis=0)
        return join(self._times(u) + forces, self._products([u])[0] + self._D @ y, self._comm)

    def solve(self, rhs: Vector) -> Vector:
        """The solution; refined once if K is so nearly singular that elimination loses digits."""
        x = self._eliminated(rhs)
        rest = rhs - self.times(x)
        if dot(self._comm, rest, rest) > ROUNDING**2 * dot(self._comm, rhs, rhs):
            x = x + self._eliminated(rest)
        return x

    def _eliminated(self, rhs: Vector) -> Vector:
        f, g = split(rhs, self.count, self._comm)
        u = self._solve(f)
        y = np.linalg.solve(self._S, g - self._products([u])[0])
        return join(u - np.sum([yi * x for yi, x in zip(y, self._X, strict=True)], axis=0), y, self._comm)

    def _products(self, vectors: list[Vector]) -> NDArray[np.float64]:
        """Inner products (len(vectors), k) with the columns of C."""
        return np.array([[dot(self._comm, v, column) for column in self._C] for v in vectors])


def join(u: Vector, y: Vector, comm: MPI.Comm) -> Vector:
    """(u, y), with y on the last rank; a new array on every rank."""
    return np.concatenate([u, y if comm.rank == comm.size - 1 else y[:0]])


def split(x: Vector, k: int, comm: MPI.Comm) -> tuple[Vector, Vector]:
    """u on this rank, a new view on every rank, and y (k,) on every rank."""
    last = comm.size - 1
    own = x.size - k * (comm.rank == last)
    return x[:own], np.asarray(comm.bcast(x[own:], root=last))

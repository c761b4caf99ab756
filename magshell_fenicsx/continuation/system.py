"""What the solvers see: vectors, a matrix and named amplitudes; nothing of shells."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

Vector = NDArray[np.float64]  # the owned part of a distributed vector
Amplitudes = Mapping[str, float]
Weighted = tuple[float, Vector]


class System(Protocol):
    """Equilibrium of Pi(u) = Pi_0(u) + sum_i mu_i Pi_i(u), spread over the ranks of `comm`.

    Attributes
    ----------
    size
        Number of unknowns on this rank.
    length
        A displacement that counts as of order one; convergence is measured with it.
    """

    comm: MPI.Comm
    size: int
    length: float

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        """dPi/du."""

    def load(self, u: Vector, name: str) -> Vector:
        """dPi_i/du: the column of the amplitude `name`."""

    def potential(self, u: Vector, name: str) -> float:
        """Pi_i(u), on every rank; -Pi_i is the displacement conjugate to the amplitude."""

    def tangent(self, u: Vector, mu: Amplitudes, stress: Sequence[Weighted] = ()) -> PETSc.Mat:
        """d2Pi/du2, assembled; the matrix is reused by the next call.

        Parameters
        ----------
        stress
            Displacements with weights. A system may take the weighted sum of their stresses in place of that of u:
            it follows a path linearly where the stress of a guess is spoilt by the guess's small errors.
        """


def followed(u: Vector, step: Vector) -> list[Weighted]:
    """The stress that follows linearly from u along a step, as weighted displacements; strain is quadratic in u."""
    return [(1.0, u), (0.5, u + step), (-0.5, u - step)]


@dataclass(frozen=True)
class State:
    """A displacement with the amplitudes that it goes with."""

    u: Vector
    mu: dict[str, float]

    def with_(self, u: Vector, name: str, value: float) -> "State":
        return State(u, {**self.mu, name: value})


def dot(comm: MPI.Comm, a: Vector, b: Vector) -> float:
    """Inner product over all ranks."""
    return float(comm.allreduce(float(a @ b)))


def max_abs(comm: MPI.Comm, a: Vector) -> float:
    """Largest entry in magnitude over all ranks."""
    return float(comm.allreduce(float(np.abs(a).max(initial=0.0)), MPI.MAX))

"""The interface between a discrete system and the solvers: vectors, a tangent, named amplitudes.

The solvers know nothing of finite elements. They see a distributed vector of unknowns u, amplitudes
mu (load parameters and prescribed positions), and the residual and tangent of a potential
Pi(u; mu). This module defines that interface and the forms that a tangent may have.

An amplitude's conjugate -dPi/dmu is the displacement on which it does work, or the force if the
amplitude is a position.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

Vector = NDArray[np.float64]  # the part of a distributed vector that this rank owns
Amplitudes = Mapping[str, float]
WeightedDisplacement = tuple[float, Vector]
Direction = tuple[Vector, float]  # (du, dmu)


@dataclass(frozen=True)
class SkewedTangent:
    """The matrix K + N of a load without potential: K symmetric, N skew-symmetric."""

    K: PETSc.Mat
    N: PETSc.Mat


@dataclass(frozen=True)
class BorderedTangent:
    """The symmetric matrix [K C; C^T D]: a tangent with k further scalar unknowns; K may be skewed.

    Attributes
    ----------
    C
        k columns, each the part of this rank.
    D
        (k, k) numbers.
    multipliers
        Number of the unknowns that are Lagrange multipliers of a constraint. Each adds one negative
        pivot that is no unstable direction.
    """

    K: PETSc.Mat | SkewedTangent
    C: Sequence[Vector]
    D: NDArray[np.float64]
    multipliers: int


Tangent: TypeAlias = PETSc.Mat | SkewedTangent | BorderedTangent


def symmetric_part(tangent: Tangent) -> PETSc.Mat:
    """Return the symmetric matrix K of a tangent, itself and not a copy.

    A border and a skew part are left out.
    """
    while isinstance(tangent, SkewedTangent | BorderedTangent):
        tangent = tangent.K
    return tangent


class System(Protocol):
    """Equilibrium of a potential Pi(u; mu), distributed over the ranks of `comm`.

    Most amplitudes multiply a term, Pi = Pi_0 + sum_i mu_i Pi_i; others enter nonlinearly. All
    methods are collective.

    Attributes
    ----------
    size
        Number of unknowns on this rank.
    length
        A displacement that counts as of order one; convergence is measured in units of it.
    coordinates
        Amplitudes that are positions, for example of a body that presses on the shell. Their
        conjugates are forces: where the force is prescribed, the position is free. All other
        amplitudes are forces: to prescribe the conjugate of one is a constraint.
    """

    comm: MPI.Comm
    size: int
    length: float
    coordinates: frozenset[str]

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        """Return R = dPi/du."""

    def load(self, u: Vector, mu: Amplitudes, name: str) -> Vector:
        """Return R_mu = d2Pi/du dmu_i, the load vector of the amplitude `name`."""

    def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
        """Return dPi/dmu_i, on every rank. The conjugate of the amplitude is -dPi/dmu_i."""

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        """Return d2Pi/dmu_i dmu_j, on every rank; zero between amplitudes that multiply a term."""

    def tangent(
        self, u: Vector, mu: Amplitudes, stress: Sequence[WeightedDisplacement] = ()
    ) -> Tangent:
        """Assemble K = d2Pi/du2, or dR/du where a load has no potential. Collective.

        The next call overwrites the matrix.

        Parameters
        ----------
        stress
            Displacements with weights. A system may use the weighted sum of their stresses in place
            of the stress of u. That sum is linear along the path, while small errors of a guess u
            change its own stress much.
        """


def extrapolated_stress(u: Vector, step: Vector) -> list[WeightedDisplacement]:
    """Return weighted displacements whose stress is that of u, extrapolated linearly along a step.

    Strain is quadratic in u, so three displacements suffice.
    """
    return [(1.0, u), (0.5, u + step), (-0.5, u - step)]


@dataclass(frozen=True)
class State:
    """A displacement u, the part of this rank, and all amplitudes by name."""

    u: Vector = field(repr=False)
    mu: dict[str, float]

    def with_(self, u: Vector, name: str, value: float) -> "State":
        """Return a state with another displacement and another value of one amplitude."""
        return State(u, {**self.mu, name: value})

    def equals(self, other: "State", comm: MPI.Comm) -> bool:
        """Return whether both states are identical on all ranks. Collective."""
        equal = self.mu == other.mu and np.array_equal(self.u, other.u)
        return bool(comm.allreduce(equal, MPI.LAND))


def dot(comm: MPI.Comm, a: Vector, b: Vector) -> float:
    """Return the inner product over all ranks. Collective."""
    return float(comm.allreduce(float(a @ b)))


def max_abs(comm: MPI.Comm, a: Vector) -> float:
    """Return the largest magnitude of an entry over all ranks. Collective."""
    return float(comm.allreduce(float(np.abs(a).max(initial=0.0)), MPI.MAX))

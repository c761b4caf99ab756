"""The interface of a system to the solvers: vectors, a matrix and named amplitudes, no shells."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

Vector = NDArray[np.float64]  # the owned part of a distributed vector
Amplitudes = Mapping[str, float]
Weighted = tuple[float, Vector]
Direction = tuple[Vector, float]  # (du, dmu)


class Rest(Protocol):
    """What is added to a sparse symmetric matrix, where all unknowns act on each other; it does not
    change.
    """

    def times(self, v: Vector) -> Vector:
        """Its product with a vector. Collective."""

    def scaled(self, factor: float) -> "Rest":
        """So many times this one."""

    def over(self, other: "Rest") -> float:
        """How many times another one this is; 0 if it is no multiple of it, or nobody knows."""

    def added_to(self, K: PETSc.Mat) -> PETSc.Mat:
        """The sum, with all entries; the matrix is reused by the next call. Collective."""


@dataclass(frozen=True)
class Beside:
    """The symmetric matrix K + D, with all entries: K sparse, D mostly small beside it.

    Attributes
    ----------
    changing
        What may be that of an earlier state: D and its part in K; D alone if None.
    present
        The product of that of the present state with a vector, dear; None if nothing is older.
        Collective.
    foreseen
        The same product as foreseen from states where forces are known, cheap; None if nothing is
        older. Collective.
    """

    K: PETSc.Mat
    D: Rest
    changing: Rest | None = None
    present: Callable[[Vector], Vector] | None = None
    foreseen: Callable[[Vector], Vector] | None = None

    def change(self, v: Vector) -> Vector:
        """Return the product of v with what is foreseen beyond the older part; zero if nothing is
        older. Collective."""
        if self.foreseen is None or self.changing is None:
            return np.zeros_like(v)
        return np.asarray(self.foreseen(v) - self.changing.times(v))


@dataclass(frozen=True)
class Skewed:
    """The matrix K + N of a load without potential: K symmetric, N skew."""

    K: PETSc.Mat
    N: PETSc.Mat


@dataclass(frozen=True)
class Edged:
    """The symmetric matrix [K C; C^T D]: a tangent with k more unknowns, which are numbers; K may
    be skewed.

    Attributes
    ----------
    C, D
        k columns on this rank, and (k, k) numbers.
    multipliers
        Number of the unknowns that enforce a constraint. Each adds one negative pivot that is no
        unstable direction.
    """

    K: "PETSc.Mat | Beside | Skewed"
    C: Sequence[Vector]
    D: NDArray[np.float64]
    multipliers: int


Tangent: TypeAlias = PETSc.Mat | Beside | Skewed | Edged


def symmetric_part(tangent: Tangent) -> PETSc.Mat:
    """The symmetric matrix of u in a tangent, itself and no copy; with all entries where all
    unknowns are coupled.
    """
    while isinstance(tangent, Skewed | Edged):
        tangent = tangent.K
    return tangent.D.added_to(tangent.K) if isinstance(tangent, Beside) else tangent


class System(Protocol):
    """Equilibrium of an energy Pi(u; mu), spread over the ranks of `comm`.

    Most amplitudes multiply a term, Pi = Pi_0 + sum_i mu_i Pi_i; a parameter may also enter freely.

    Attributes
    ----------
    size
        Number of unknowns on this rank.
    length
        A displacement that counts as of order one; convergence is measured with it.
    coordinates
        Amplitudes that are positions, for example of a body that presses on the shell. Their
        conjugates are forces: where the force is held, the position is free. All other amplitudes
        are forces: where the conjugate of one is held, that is a constraint.
    """

    comm: MPI.Comm
    size: int
    length: float
    coordinates: frozenset[str]

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        """dPi/du."""

    def load(self, u: Vector, mu: Amplitudes, name: str) -> Vector:
        """d2Pi/du dmu_i: the column of the amplitude `name`."""

    def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
        """dPi/dmu_i, on every rank. The conjugate of the amplitude is -dPi/dmu_i."""

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        """d2Pi/dmu_i dmu_j, on every rank; zero between amplitudes that multiply their terms."""

    def tangent(self, u: Vector, mu: Amplitudes, stress: Sequence[Weighted] = ()) -> Tangent:
        """d2Pi/du2, assembled, or dR/du where a load has no potential; the matrix is reused by the
        next call.

        Parameters
        ----------
        stress
            Displacements with weights. A system may use the weighted sum of their stresses in place
            of the stress of u. That sum is linear along the path, while small errors of a guess u
            spoil its own stress.
        """


@runtime_checkable
class Roughly(Protocol):
    """A system that may have a part of its tangent that is dear, and mostly small beside the
    others.

    Attributes
    ----------
    dear
        Whether it has one.
    """

    @property
    def dear(self) -> bool: ...

    def residual(self, u: Vector, mu: Amplitudes, *, rough: bool = False) -> Vector:
        """As that of `System`; if `rough`, forces of that part may be foreseen from states before."""

    def knows_along(self, u: Vector, mu: Amplitudes, du: Vector) -> bool:
        """Whether forces foreseen near a state are right along a direction."""

    def tangent(
        self, u: Vector, mu: Amplitudes, stress: Sequence[Weighted] = (), *, rough: bool = False
    ) -> Tangent:
        """As that of `System`; if `rough`, that part may be that of an earlier state."""


def followed(u: Vector, step: Vector) -> list[Weighted]:
    """The stress extrapolated linearly from u along a step, as weighted displacements; strain is
    quadratic in u.
    """
    return [(1.0, u), (0.5, u + step), (-0.5, u - step)]


@dataclass(frozen=True)
class State:
    """A displacement and the amplitudes."""

    u: Vector = field(repr=False)
    mu: dict[str, float]

    def with_(self, u: Vector, name: str, value: float) -> "State":
        return State(u, {**self.mu, name: value})

    def equals(self, other: "State", comm: MPI.Comm) -> bool:
        """Whether it is the same state, on all ranks."""
        equal = self.mu == other.mu and np.array_equal(self.u, other.u)
        return bool(comm.allreduce(equal, MPI.LAND))


def dot(comm: MPI.Comm, a: Vector, b: Vector) -> float:
    """Inner product over all ranks."""
    return float(comm.allreduce(float(a @ b)))


def max_abs(comm: MPI.Comm, a: Vector) -> float:
    """Largest entry in magnitude over all ranks."""
    return float(comm.allreduce(float(np.abs(a).max(initial=0.0)), MPI.MAX))

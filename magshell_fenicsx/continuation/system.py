"""The interface between a discrete system and the solvers: vectors, a tangent, named amplitudes.

The solvers know nothing of finite elements. They see a distributed vector of unknowns u, amplitudes
mu (load parameters and prescribed positions), and the residual and tangent of a potential
Pi(u; mu). This module defines that interface and the forms that a tangent may have.

An amplitude's conjugate -dPi/dmu is the displacement on which it does work, or the force if the
amplitude is a position. A lagged part of a tangent, from terms that couple all unknowns, belongs to
an earlier state.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

Vector = NDArray[np.float64]  # the part of a distributed vector that this rank owns
Amplitudes = Mapping[str, float]
WeightedDisplacement = tuple[float, Vector]
Direction = tuple[Vector, float]  # (du, dmu)


class DenseCorrection(Protocol):
    """A constant symmetric matrix D with all entries, which is added to a sparse matrix."""

    def times(self, v: Vector) -> Vector:
        """Return D v. Collective."""

    def scaled(self, factor: float) -> "DenseCorrection":
        """Return the matrix `factor` D."""

    def multiple_of(self, other: "DenseCorrection") -> float:
        """Return c if D is c times another matrix; 0 if it is no multiple, or this is unknown."""

    def added_to(self, K: PETSc.Mat) -> PETSc.Mat:
        """Return K + D with all entries; the next call overwrites the result. Collective."""


@dataclass(frozen=True)
class CorrectedTangent:
    """The symmetric matrix K + D, with all entries: K sparse, D mostly small compared with K.

    Attributes
    ----------
    lagged
        The part of K + D that may belong to an earlier state: D and its share of K. None stands
        for D alone.
    present_product
        Product of a vector with the same part at the present state: expensive. None if no part is
        lagged. Collective.
    extrapolated_product
        The same product, extrapolated from states at which forces were computed: cheap. None if no
        part is lagged. Collective.
    """

    K: PETSc.Mat
    D: DenseCorrection
    lagged: DenseCorrection | None = None
    present_product: Callable[[Vector], Vector] | None = None
    extrapolated_product: Callable[[Vector], Vector] | None = None

    def missing_product(self, v: Vector) -> Vector:
        """Return a vector times the difference of the present and the lagged part, as extrapolated.

        It is zero if no part is lagged. Collective.
        """
        if self.extrapolated_product is None or self.lagged is None:
            return np.zeros_like(v)
        return np.asarray(self.extrapolated_product(v) - self.lagged.times(v))


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

    K: "PETSc.Mat | CorrectedTangent | SkewedTangent"
    C: Sequence[Vector]
    D: NDArray[np.float64]
    multipliers: int


Tangent: TypeAlias = PETSc.Mat | CorrectedTangent | SkewedTangent | BorderedTangent


def symmetric_part(tangent: Tangent) -> PETSc.Mat:
    """Return the symmetric matrix of PETSc in a tangent: K or, for a corrected one, K + D.

    A border and a skew part are left out. K is the matrix itself, not a copy; K + D has all entries
    and is overwritten by the next call.
    """
    while isinstance(tangent, SkewedTangent | BorderedTangent):
        tangent = tangent.K
    return tangent.D.added_to(tangent.K) if isinstance(tangent, CorrectedTangent) else tangent


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


@runtime_checkable
class InexactSystem(Protocol):
    """A system whose dense terms may be lagged or extrapolated from earlier states.

    Dense terms couple all unknowns. They are expensive, and mostly small compared with the others.

    Attributes
    ----------
    has_dense_terms
        Whether the system has such terms.
    """

    @property
    def has_dense_terms(self) -> bool: ...

    def residual(self, u: Vector, mu: Amplitudes, *, inexact: bool = False) -> Vector:
        """Return R = dPi/du. Collective.

        Parameters
        ----------
        inexact
            Whether forces of the dense terms may be extrapolated from earlier states.
        """

    def extrapolation_holds_along(self, u: Vector, mu: Amplitudes, du: Vector) -> bool:
        """Return whether extrapolated forces near a state are accurate along the direction du."""

    def tangent(
        self,
        u: Vector,
        mu: Amplitudes,
        stress: Sequence[WeightedDisplacement] = (),
        *,
        inexact: bool = False,
    ) -> Tangent:
        """Assemble K = d2Pi/du2, or dR/du where a load has no potential. Collective.

        Parameters
        ----------
        stress
            Displacements with weights, whose stress may replace that of u.
        inexact
            Whether its dense terms may be those of an earlier state.
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

"""The tangent of a system in which all unknowns act on each other: the sparse matrix and what
stands beside it.

What a term adds is stored between nodes that are near each other, and known by its products with
vectors between others. Of what is stored, the entries that the sparse matrix has too are added to
it: the rest is then small beside it, and factors of the sparse one mostly serve
(`continuation.beside`). The sum is a matrix of PETSc with all entries, of which factors, inertia,
folds and modes are those of any system. Its memory and its factors grow with the square and the
cube of the number of unknowns.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from scipy.sparse import bsr_array, csr_array

from magshell_fenicsx.assembly.terms import Term
from magshell_fenicsx.continuation.system import Beside, Rest, Vector
from magshell_fenicsx.platform.native import native

Array = NDArray[np.float64]
Indices = NDArray[np.int32]
COLUMNS = 128  # for which products are computed at once where all entries are needed
FUNCTIONS = """
    void of_doubles(int64_t, const int32_t *, const int32_t *, const double *, const double *, double *);
    void of_floats(int64_t, const int32_t *, const int32_t *, const float *, const double *, double *);
    void of_upper(int64_t, const int32_t *, const int32_t *, const float *, const double *, double *);
"""


class Acting(Protocol):
    """This rank's part of a second derivative, without supports; it does not change.

    Attributes
    ----------
    stored
        (3 local nodes with ghosts, 3 all nodes) the blocks between nodes near each other, each
        row's columns in order.
    """

    @property
    def stored(self) -> bsr_array: ...

    def times_others(self, v: Array) -> Array:
        """The product (3 local nodes, n) of all other entries with the same changes (3 all nodes,
        n) on every rank.
        """


@runtime_checkable
class WholeTerm(Term, Protocol):
    """A term whose tangent couples nodes that share no cell and no edge."""

    def acting(self, *, rough: bool = False) -> Acting:
        """d2Pi/du2; if `rough`, it may be that of an earlier state. Collective."""

    def add_foreseen(self, b: Array, factor: float) -> None:
        """As `add_residual`, by what is known of states near by; collective."""

    def knows_along(self, step: Array) -> bool:
        """Whether what is known of states near by is right along a change of all unknowns;
        collective.
        """


@dataclass(frozen=True)
class Singles:
    """A matrix of (3, 3) blocks in single precision; of a symmetric one only the blocks on and
    above the diagonal.

    Attributes
    ----------
    starts, columns, values
        Of rows of blocks, each row's columns in order.
    upper
        Whether the blocks below the diagonal are left out.
    """

    starts: Indices
    columns: Indices
    values: NDArray[np.float32]
    upper: bool

    @classmethod
    def of(cls, A: bsr_array, *, upper: bool) -> "Singles":
        """A matrix, if `upper` a symmetric one."""
        if not upper:
            starts, columns = (np.asarray(each, dtype=np.int32) for each in (A.indptr, A.indices))
            return cls(starts, columns, A.data.astype(np.float32), upper)
        kept = np.repeat(np.arange(len(A.indptr) - 1), np.diff(A.indptr)) <= A.indices
        starts = np.append(0, np.cumsum(kept, dtype=np.int32))[A.indptr].astype(np.int32)
        return cls(starts, A.indices[kept].astype(np.int32), A.data[kept].astype(np.float32), upper)


class Blocks:
    """Products of matrices of (3, 3) blocks with vectors; the constructor is collective."""

    def __init__(self, comm: MPI.Comm) -> None:
        self._ffi, self._lib = native(Path(__file__).with_name("whole.c"), FUNCTIONS, comm)

    def times(self, A: bsr_array | Singles, v: Array) -> Array:
        """A v."""
        p, lib, upper = self._ffi.from_buffer, self._lib, isinstance(A, Singles) and A.upper
        x = np.ascontiguousarray(v) if upper else np.tile(v.reshape(-1, 3), 3)
        if isinstance(A, Singles):
            starts, columns = A.starts, A.columns
            values, of_these = p("float[]", A.values), lib.of_upper if upper else lib.of_floats
        else:
            starts, columns = (np.asarray(each, dtype=np.int32) for each in (A.indptr, A.indices))
            values, of_these = p("double[]", np.ascontiguousarray(A.data)), lib.of_doubles
        product = np.empty(3 * (len(starts) - 1))
        arrays = p("int32_t[]", starts), p("int32_t[]", columns), values, p("double[]", x)
        of_these(len(starts) - 1, *arrays, p("double[]", product))
        return product


@dataclass(frozen=True)
class OfTerm:
    """A second derivative times a factor.

    Attributes
    ----------
    stored
        What is stored of this rank's own unknowns.
    singles
        The same for products that need not be better.
    left_out
        Entries that are not counted.
    """

    factor: float
    stored: bsr_array
    singles: Singles
    acting: Acting
    left_out: csr_array | None = None


@dataclass(frozen=True)
class Rows:
    """Terms times factors, without the rows and columns of supports: a `continuation.system.Rest`."""

    matrix: "WholeMatrix"
    parts: Sequence[OfTerm]

    def times(self, v: Vector) -> Vector:
        """See `Rest`."""
        own, everywhere = self.matrix.held
        whole = np.where(everywhere, 0.0, np.concatenate(self.matrix.comm.allgather(v)))
        return np.where(own, 0.0, self.matrix.product(self.parts, whole, singles=True))

    def scaled(self, factor: float) -> "Rows":
        """See `Rest`."""
        return Rows(
            self.matrix, [replace(part, factor=factor * part.factor) for part in self.parts]
        )

    def over(self, other: Rest) -> float:
        """See `Rest`."""
        if not isinstance(other, Rows) or len(other.parts) != len(self.parts):
            return 0.0
        pairs = list(zip(self.parts, other.parts, strict=True))
        factors = {mine.factor / theirs.factor for mine, theirs in pairs}
        return (
            factors.pop()
            if len(factors) == 1 and all(a.acting is b.acting for a, b in pairs)
            else 0.0
        )

    def added_to(self, K: PETSc.Mat) -> PETSc.Mat:
        """See `Rest`."""
        return self.matrix.sum(K, self.parts)


class WholeMatrix:
    """A symmetric matrix with all entries, always the same object; clamped unknowns as in
    `scatter.BlockMatrix`.

    Parameters
    ----------
    clamped
        Homogeneous Dirichlet conditions.
    """

    def __init__(self, V: fem.FunctionSpace, clamped: Sequence[fem.DirichletBC]) -> None:
        comm, nodes = V.mesh.comm, V.dofmap.index_map
        self._owned, self._ghosts = nodes.size_local, nodes.num_ghosts
        self._first, self._count = nodes.local_range[0], nodes.size_global
        self._numbers = nodes.local_to_global(
            np.arange(self._owned, self._owned + self._ghosts, dtype=np.int32)
        )
        self._owners = nodes.owners
        n = 3 * self._owned
        held = np.zeros(n, dtype=bool)
        for bc in clamped:
            dofs = bc.dof_indices()[0]
            held[dofs[dofs < n]] = True
        self._blocks = Blocks(comm)
        self.comm, self.held = comm, (held, np.concatenate(comm.allgather(held)))
        self._whole: tuple[Array, Array, PETSc.Mat] | None = None
        self._stored: dict[str, tuple[Acting, bsr_array, Singles]] = {}
        self._found: tuple[bsr_array, csr_array] | None = None

    def _made(self) -> tuple[Array, Array, PETSc.Mat]:
        """The entries in columns of own nodes and in others, which the third, their matrix, shares."""
        n, first, whole = 3 * self._owned, 3 * self._first, 3 * self._count
        kind = PETSc.IntType
        inner, outer = np.zeros((n, n)), np.zeros((n, whole - n))
        outside = np.delete(np.arange(whole, dtype=kind), np.s_[first : first + n])
        starts = [
            np.arange(0, n * width + 1, width or 1, dtype=kind)[: n + 1] for width in (n, whole - n)
        ]
        starts[1] = starts[1] if whole > n else np.zeros(n + 1, dtype=kind)
        parts = [(starts[0], np.tile(np.arange(n, dtype=kind), n), inner.reshape(-1))]
        if self.comm.size > 1:
            parts.append((starts[1], np.tile(outside, n), outer.reshape(-1)))
        size = ((n, None), (n, None))
        K = PETSc.Mat().createAIJWithArrays(
            size, parts[0] if len(parts) == 1 else tuple(parts), comm=self.comm
        )
        self._kept = parts  # the arrays that PETSc shares
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            K.setOption(option, True)
        return inner, outer, K

    def beside(
        self, K: PETSc.Mat, terms: Sequence[tuple[float, WholeTerm]], *, rough: bool = False
    ) -> Beside:
        """A sparse matrix, to which its own entries of terms times factors are added, and the rest.

        Collective.
        """
        starts, columns, values = K.getValuesCSR()
        whole = [self.of_term(factor, term, rough=rough) for factor, term in terms]
        kept = list[OfTerm]()
        for part in whole:
            left_out = self._in(starts, columns, part)
            values += part.factor * left_out.data
            kept.append(replace(part, left_out=left_out))
        K.setValuesCSR(starts, columns, values)
        K.assemble()
        return Beside(K, Rows(self, kept), Rows(self, whole))

    def _in(self, starts: NDArray[np.intp], columns: NDArray[np.intp], part: OfTerm) -> csr_array:
        """What a sparse matrix has entries for, of a term without its factor; found once for each
        pattern.
        """
        found = self._found
        same = (
            found is not None
            and found[0] is part.stored
            and np.array_equal(found[1].indices, columns)
        )
        if found is None or not same or not np.array_equal(found[1].indptr, starts):
            rows = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
            free = ~(self.held[0][rows] | self.held[1][columns])
            given = np.where(free, _entries(part.stored, rows, columns), 0.0)
            found = part.stored, csr_array((given, columns, starts), part.stored.shape)
            self._found = found
        return found[1]

    def sum(self, K: PETSc.Mat, parts: Sequence[OfTerm]) -> PETSc.Mat:
        """A sparse matrix plus terms times factors. Collective."""
        n, first, (own, everywhere) = 3 * self._owned, 3 * self._first, self.held
        self._whole = inner, outer, matrix = self._whole or self._made()
        rows = inner if self.comm.size == 1 else np.empty((n, 3 * self._count))  # nothing is copied
        rows[:] = 0.0
        for part in parts:
            rows += part.factor * self._all(part)
        rows[own], rows[:, everywhere] = 0.0, 0.0
        starts, columns, values = K.getValuesCSR()
        rows[np.repeat(np.arange(n), np.diff(starts)), columns] += values
        if self.comm.size > 1:
            inner[:] = rows[:, first : first + n]
            outer[:] = np.delete(rows, np.s_[first : first + n], axis=1)
        matrix.stateIncrease()
        return matrix

    def of_term(self, factor: float, term: WholeTerm, *, rough: bool = False) -> OfTerm:
        """A term, what it stores summed over the ranks. Collective."""
        acting, known = term.acting(rough=rough), self._stored.get(term.name)
        if known is None or known[0] is not acting:
            stored = self._own_blocks(acting.stored)
            known = self._stored[term.name] = (
                acting,
                stored,
                Singles.of(stored, upper=self.comm.size == 1),
            )
        return OfTerm(factor, *known[1:], acting)

    def rows(self, term: WholeTerm) -> Array:
        """The rows (own unknowns, all) of a term, supports too. Collective."""
        return self._all(self.of_term(1.0, term))

    def product(self, parts: Sequence[OfTerm], whole: Array, *, singles: bool = False) -> Array:
        """Terms times factors, supports too, with changes of all unknowns; of own unknowns.

        Collective.
        """
        product = np.zeros(3 * self._owned)
        for part in parts:
            others = part.acting.times_others(whole[:, None]).reshape(-1, 3)
            stored = self._blocks.times(part.singles if singles else part.stored, whole)
            product += part.factor * (stored + self._own(others).ravel())
            if part.left_out is not None:
                product -= part.factor * (part.left_out @ whole)
        return product

    def times(self, terms: Sequence[tuple[float, WholeTerm]], v: Array) -> Array:
        """The terms' product with a vector, both with ghosts, which are zero in the product.

        Collective.
        """
        whole, product = np.concatenate(self.comm.allgather(v[: 3 * self._owned])), np.zeros_like(v)
        product[: 3 * self._owned] = self.product(
            [self.of_term(factor, term) for factor, term in terms], whole
        )
        return product

    def _all(self, part: OfTerm) -> Array:
        """All entries of own rows, without the factor."""
        rows = part.stored.toarray() - (0.0 if part.left_out is None else part.left_out.toarray())
        for first in range(0, 3 * self._count, COLUMNS):
            some = np.eye(3 * self._count, min(COLUMNS, 3 * self._count - first), -first)
            others = part.acting.times_others(some)
            rows[:, first : first + COLUMNS] += self._own(
                others.reshape(-1, 3, some.shape[1])
            ).reshape(len(rows), -1)
        return np.asarray(rows)

    def _own(self, rows: Array) -> Array:
        """The rows (local nodes, ..) of own nodes, summed over the ranks."""
        if self.comm.size == 1:
            return rows
        own, ghosts = rows[: self._owned].copy(), rows[self._owned :]
        for numbers, part in self.comm.alltoall(
            [(self._numbers[i], ghosts[i]) for i in self._leaving]
        ):
            np.add.at(own, numbers - self._first, part)
        return own

    def _own_blocks(self, rows: bsr_array) -> bsr_array:
        """The rows of own unknowns, summed over the ranks."""
        if self.comm.size == 1:
            return rows
        n = 3 * self._owned
        own, ghosts, sent = (
            rows.tocsr()[:n],
            rows.tocsr()[n:].tocoo(),
            list[tuple[NDArray[np.generic], ...]](),
        )
        for nodes in self._leaving:
            leaves = np.isin(ghosts.row // 3, nodes)
            row = 3 * self._numbers[ghosts.row[leaves] // 3] + ghosts.row[leaves] % 3
            sent.append((row, ghosts.col[leaves], ghosts.data[leaves]))
        for row, column, data in self.comm.alltoall(sent):
            own = own + csr_array((data, (row - 3 * self._first, column)), own.shape)
        blocks = own.tobsr((3, 3))
        blocks.sort_indices()
        return blocks

    @cached_property
    def _leaving(self) -> list[NDArray[np.intp]]:
        """The ghosts of each rank, counted from the first ghost."""
        return [np.flatnonzero(self._owners == rank) for rank in range(self.comm.size)]


def _entries(stored: bsr_array, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Array:
    """Entries of a matrix of blocks whose columns are in order; zero where there is no block."""
    width, count = stored.shape[1] // 3, len(stored.indptr) - 1
    keys = (
        np.repeat(np.arange(count, dtype=np.int64), np.diff(stored.indptr)) * width + stored.indices
    )
    wanted = rows.astype(np.int64) // 3 * width + columns // 3
    if not len(keys):
        return np.zeros(len(wanted))
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[at] == wanted, stored.data[at, rows % 3, columns % 3], 0.0)

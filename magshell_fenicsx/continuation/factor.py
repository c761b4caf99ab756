"""Direct factorisation of tangents and of small bordered matrices, with inertia and work.

`Factorisation` factors any `Tangent` by CHOLMOD or MUMPS, counts its negative pivots and solves
with the factors. `BlockElimination` adds the border of a tangent with further scalar unknowns.

A tangent is a symmetric K, or K with a part more: skewed, K + N with N skew-symmetric, of loads
without potential; bordered, [K C; C^T D], with k further scalar unknowns y after u, on the last
rank. Inertia is the number of negative pivots of LDL^T, that is of unstable directions.
"""

import time
from collections.abc import Callable
from functools import cache
from itertools import product
from types import TracebackType

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.continuation.system import (
    BorderedTangent,
    SkewedTangent,
    Tangent,
    Vector,
    dot,
    symmetric_part,
)

PREFIX = "magshell_factor_"
# PETSc's error numbers (petscerror.h) after which MUMPS replaces CHOLMOD
INDEFINITE, MISSING = 81, 92
# number of positive definite matrices after which CHOLMOD is tried again: a change of the method
# costs an analysis of the matrix, about as long as its factors
DEFINITE_BEFORE_CHOLMOD = 2
# CHOLMOD's own error: the matrix is too large for its integers or for the memory; MUMPS is tried
REFUSED = 76
# a larger residual, relative to the right side, takes a second solve
REFINEMENT_TOLERANCE = 1e-11


class Factorisation:
    """Factors of the latest tangent; symbolic work is kept between calls.

    On one rank CHOLMOD is tried first: it takes half the time, and its success proves that there is
    no negative pivot. Otherwise MUMPS computes LDL^T and counts the negative pivots. CHOLMOD is
    tried again after `DEFINITE_BEFORE_CHOLMOD` successive matrices in which MUMPS counts none. The
    memory of the other one is released. A skewed tangent K + N takes two factorisations: that of K
    for the inertia, and LU of the sum for the solutions.

    Attributes
    ----------
    count, stopwatch
        Factorisations done and the time spent on them.
    solving
        Time spent on solving with the factors.
    matrix
        The matrix last factored; K, or K + N, if that was a bordered one.
    negative_pivots
        Number of unstable directions of the latest tangent (Sylvester's law of inertia). Of a
        skewed one that of K, less one where det (K + N) has the other sign: then it has been
        singular once less often.
    skewed
        Whether that tangent was a skewed one.
    allow
        Called before each factorisation on all ranks. It may raise an exception to stop the run.

    Private fields: of `_cholmod` and `_mumps` one is in use, as `_pc`. `_bordered` is the latest
    tangent, if it has a border, and `_border` the elimination of that. `_has_cholmod` and
    `_tries_cholmod` tell whether CHOLMOD can be used and is tried next. `_definite_count` counts
    successive matrices of MUMPS without a negative pivot, `_entries` the entries of its matrix.
    `_rhs` and `_solution` are vectors of PETSc.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        """Begin without factors; CHOLMOD is tried first where it can be used."""
        self.count, self.negative_pivots = 0, 0
        self.stopwatch, self.solving = Stopwatch(), Stopwatch()
        self.comm = comm
        self._cholmod: _CholmodFactors | None = None
        self._mumps: PETSc.PC | None = None
        self._entries = 0.0
        self._pc: PETSc.PC | None = None
        self._rhs: PETSc.Vec | None = None
        self._tries_cholmod = self._has_cholmod = comm.size == 1 and has_cholmod()
        self._definite_count = 0
        self._border: BlockElimination | None = None
        self._bordered: BorderedTangent | None = None
        self.skewed = False
        self.allow: Callable[[], None] = lambda: None

    def factor(self, tangent: Tangent) -> None:
        """Factor a matrix; a bordered one by the factors of its K and k back-solves. Collective.

        Raises
        ------
        PETSc.Error
            If MUMPS fails, for example for lack of memory, or if CHOLMOD fails for a reason other
            than the matrix.
        """
        self.allow()
        # the tangent without its border: K or K + N
        inner = tangent.K if isinstance(tangent, BorderedTangent) else tangent
        self.skewed = isinstance(inner, SkewedTangent)
        with self.stopwatch:
            self._border = None
            self._factor_symmetric(symmetric_part(inner))
            if isinstance(inner, SkewedTangent):
                self._factor_sum(inner)
        self.count += 1
        self._bordered = tangent if isinstance(tangent, BorderedTangent) else None
        if isinstance(tangent, BorderedTangent):
            self._border = BlockElimination(tangent, self.comm, self._solve_inner, self._product)
            self.negative_pivots += self._border.negative_pivots

    @property
    def habit(self) -> int:
        """The choice between CHOLMOD and MUMPS, on which rounding depends.

        -1 if CHOLMOD is tried first, else the number of successive matrices without a negative
        pivot.
        """
        return -1 if self._tries_cholmod else self._definite_count

    @habit.setter
    def habit(self, pivots: int) -> None:
        self._tries_cholmod = self._has_cholmod and pivots < 0
        self._definite_count = max(pivots, 0)

    @property
    def size(self) -> tuple[int, int]:
        """Rows of the matrix last factored, with its border: on this rank, and on all."""
        k = self._border.count if self._border else 0  # further unknowns, on the last rank
        # PETSc's sizes are (rows, columns)
        local_rows, rows = (size[0] for size in (self.matrix.getLocalSize(), self.matrix.getSize()))
        return local_rows + k * (self.comm.rank == self.comm.size - 1), rows + k

    @property
    def norm(self) -> float:
        """The largest sum of magnitudes in a row of K."""
        return float(self.matrix.norm(PETSc.NormType.NORM_INFINITY))

    def _factor_symmetric(self, K: PETSc.Mat) -> None:
        """Factor a sparse symmetric matrix, by CHOLMOD if possible, else by MUMPS."""
        self.matrix = K
        if self._rhs is None:
            self._rhs, self._solution = K.createVecs()
        if not (self._tries_cholmod and self._factor_by_cholmod(K)):
            self._factor_by_mumps(K)

    def _factor_by_cholmod(self, K: PETSc.Mat) -> bool:
        """Try to factor K by CHOLMOD.

        Returns
        -------
        Whether this succeeded; False if K is not positive definite, or CHOLMOD cannot be used.

        Raises
        ------
        PETSc.Error
            If CHOLMOD fails for another reason.
        """
        if self._cholmod is None or not self._cholmod.is_for(K):
            self._pc = self._mumps = None
            self._cholmod = _CholmodFactors(K)
        try:
            self._cholmod.factor()
        except PETSc.Error as e:
            self._cholmod, self._tries_cholmod, self._definite_count = None, False, 0
            # it is tried again later only if the matrix was the reason
            self._has_cholmod = e.ierr == INDEFINITE
            if e.ierr not in (INDEFINITE, MISSING, REFUSED):
                raise
            return False
        self._pc, self.negative_pivots = self._cholmod.pc, 0
        return True

    def _factor_by_mumps(self, K: PETSc.Mat) -> None:
        """Factor K by MUMPS as LDL^T, and count its negative pivots. Collective.

        The symbolic work is kept as long as K is the same object with the same number of entries.
        After some matrices without a negative pivot, CHOLMOD is tried again.
        """
        entries = _entry_count(K)
        is_analysed = False  # whether the symbolic work of an earlier K serves
        if self._mumps is not None:
            _, factored_matrix = self._mumps.getOperators()
            is_analysed = factored_matrix.handle == K.handle and self._entries == entries
        if self._mumps is None or not is_analysed:
            # for another pattern PETSc would make new factors itself, without the options below
            self._mumps, self._entries = _new_pc(K, "mumps"), entries
            self._mumps.setFactorSetUpSolverType()
            F = self._mumps.getFactorMatrix()
            F.setMumpsIcntl(24, 1)  # report null pivots: PETSc gives no inertia without this
            # only true zeros are null pivots: else the null vector is lost at a fold
            F.setMumpsCntl(3, -1e-100)
            # null pivots are replaced by a tiny number, for the same reason
            F.setMumpsCntl(5, 1e-17)
            if self.comm.size > 1:
                # no ScaLAPACK for the root front: its pivots must be counted too
                F.setMumpsIcntl(13, 1)
            F.setMumpsIcntl(14, 50)  # per cent of memory above the estimate
            # no scaling: a tenth faster, and the tangent's entries are of similar size
            F.setMumpsIcntl(8, 0)
        _renew(self._mumps, K)
        self._pc, self.negative_pivots = self._mumps, self._mumps.getFactorMatrix().getInertia()[0]
        self._definite_count = 0 if self.negative_pivots else self._definite_count + 1
        self._tries_cholmod = self._has_cholmod and self._definite_count >= DEFINITE_BEFORE_CHOLMOD

    def _factor_sum(self, tangent: SkewedTangent) -> None:
        """Factor K + N by LU, for the solutions and for the sign of its determinant. Collective.

        If that sign differs from that of det K, the tangent has one unstable direction less than K.
        """
        self.matrix = sum_matrix = tangent.K.copy()
        # the copy of K counts as symmetric, K + N is not
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            sum_matrix.setOption(option, False)
        sum_matrix.axpy(1.0, tangent.N, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        self._pc = pc = _new_pc(sum_matrix, "mumps", "lu")
        pc.setFactorSetUpSolverType()
        F = pc.getFactorMatrix()
        F.setMumpsIcntl(33, 1)  # the determinant, whose mantissa RINFOG(12) has the sign
        F.setMumpsIcntl(14, 50)  # per cent of memory above the estimate
        _renew(pc, sum_matrix)
        is_positive = self.comm.bcast(F.getMumpsRinfog(12) > 0.0 if self.comm.rank == 0 else None)
        # det K is positive for an even number of negative pivots. The signs differ if that number
        # is odd and det (K + N) positive, or even and not positive
        if self.negative_pivots % 2 == is_positive:
            self.negative_pivots -= 1

    def times(self, x: Vector) -> Vector:
        """Return the matrix last factored times x. Collective."""
        return self._border.times(x) if self._border else self._product(x)

    def solve(self, rhs: Vector) -> Vector:
        """Return the solution of the matrix last factored for a right side. Collective.

        Parameters
        ----------
        rhs
            This rank's part of the right side; for a bordered matrix with its unknowns on the last
            rank.
        """
        return self._border.solve(rhs) if self._border else self._solve_inner(rhs)

    def solve_transposed(self, rhs: Vector) -> Vector:
        """Return the solution of the transposed matrix for a right side. Collective."""

        def as_map(operation: Callable[[PETSc.Vec, PETSc.Vec], None]) -> Callable[[Vector], Vector]:
            """Return an operation of PETSc on two vectors as a function from arrays to arrays."""

            def applied(x: Vector) -> Vector:
                v, y = self.matrix.createVecs()
                v.setArray(x)
                operation(v, y)
                return np.array(y.array_r)

            return applied

        assert self._pc is not None
        solve, times = as_map(self._pc.applyTranspose), as_map(self.matrix.multTranspose)
        if self._bordered:  # only K changes by the transposition
            return BlockElimination(self._bordered, self.comm, solve, times).solve(rhs)
        return solve(rhs)

    def _product(self, x: Vector) -> Vector:
        """Return the inner matrix, K or K + N, times x. Collective."""
        v, y = self.matrix.createVecs()
        v.setArray(x)
        self.matrix.mult(v, y)
        return np.array(y.array_r)

    def _solve_inner(self, rhs: Vector) -> Vector:
        """Return the inverse of the inner matrix, K or K + N, times `rhs`. Collective.

        Its time is counted.
        """
        assert self._pc is not None
        assert self._rhs is not None
        with self.solving:
            self._rhs.setArray(rhs)
            self._pc.apply(self._rhs, self._solution)
            return np.array(self._solution.array_r)


@cache
def has_cholmod() -> bool:
    """Return whether PETSc was built with CHOLMOD, by setting up a factorisation.

    Without CHOLMOD, PETSc would report its options as unused.
    """
    # CHOLMOD takes a matrix in this format on one rank
    K = PETSc.Mat().createSBAIJ([1, 1], 1, nnz=1, comm=MPI.COMM_SELF)
    K.setValue(0, 0, 1.0)
    K.assemble()
    pc = PETSc.PC().create(K.comm)
    pc.setOperators(K)
    pc.setType("cholesky")
    pc.setFactorSolverType("cholmod")
    try:
        pc.setFactorSetUpSolverType()
    except PETSc.Error as e:
        if e.ierr != MISSING:
            raise
        return False
    return True


class _CholmodFactors:
    """CHOLMOD's factors of a copy of a matrix's upper triangle, on one rank.

    The copy has the format that CHOLMOD takes. From any other format PETSc itself would make such a
    copy each time, and leak it if CHOLMOD fails.

    Attributes
    ----------
    pc
        PETSc's preconditioner with the factors.

    Private fields: `_K` is the matrix, `_upper` the copy, `_entries` their number of entries when
    the copy was made.
    """

    def __init__(self, K: PETSc.Mat) -> None:
        self._K, self._entries = K, _entry_count(K)
        self._upper = self._copy_upper(PETSc.Mat())
        self.pc = _new_pc(self._upper, "cholmod")

    def is_for(self, K: PETSc.Mat) -> bool:
        """Return whether K is the same matrix, with the same number of entries."""
        return K.handle == self._K.handle and _entry_count(K) == self._entries

    def factor(self) -> None:
        """Factor the matrix with its present values; raise PETSc.Error if it is indefinite."""
        self._copy_upper(self._upper)
        _renew(self.pc, self._upper)

    def _copy_upper(self, upper: PETSc.Mat) -> PETSc.Mat:
        """Copy the upper triangle of the matrix into `upper`, and return that."""
        K = self._K
        if K.getBlockSize() > 1:  # the copy would have the blocks too
            K = PETSc.Mat().createAIJ(K.getSize(), csr=K.getValuesCSR(), comm=K.comm)
        K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        return K.convert("seqsbaij", upper)


def _entry_count(K: PETSc.Mat) -> float:
    """Return the number of entries of the pattern. Collective."""
    return float(K.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"])


def _new_pc(K: PETSc.Mat, solver: str, kind: str = "cholesky") -> PETSc.PC:
    """Return a preconditioner that factors K by a solver, `cholmod` or `mumps`.

    Parameters
    ----------
    kind
        "cholesky" for a symmetric matrix, "lu" for any.
    """
    if solver == "cholmod":  # its simplicial method factors indefinite matrices without an error
        options = PETSc.Options(PREFIX)
        options["mat_cholmod_supernodal_switch"], options["mat_cholmod_print"] = 0.0, 0
    pc = PETSc.PC().create(K.comm)
    pc.setOptionsPrefix(PREFIX)
    pc.setOperators(K)
    pc.setType(kind)
    pc.setFactorSolverType(solver)
    pc.setFromOptions()
    return pc


def _renew(pc: PETSc.PC, K: PETSc.Mat) -> None:
    """Factor K, whose values or pattern have changed, by a preconditioner."""
    pc.setReusePreconditioner(False)
    pc.setOperators(K)
    pc.setUp()
    pc.setReusePreconditioner(True)  # a solve must not factor again after K was assembled again


class BlockElimination:
    """Block elimination for a bordered matrix [K C; C^T D], with the factors of K.

    The k further unknowns y, which follow u on the last rank, have the Schur complement S = D - C^T
    K^-1 C. All methods are collective.

    Parameters
    ----------
    bordered
        The matrix, of which the border C, D and the number of Lagrange multipliers are used: each
        multiplier adds one negative pivot that is no unstable direction.
    solve, times
        K^-1 and K times a vector.

    Attributes
    ----------
    count
        k.
    negative_pivots
        Number that the border adds to that of K (Haynsworth's inertia additivity), without its
        multipliers.

    Private fields: `_C` and `_D` are parts of the matrix, `_X` are the columns of K^-1 C, `_S` is
    the Schur complement.
    """

    def __init__(
        self,
        bordered: BorderedTangent,
        comm: MPI.Comm,
        solve: Callable[[Vector], Vector],
        times: Callable[[Vector], Vector],
    ) -> None:
        """Solve for K^-1 C, and count the negative eigenvalues of the Schur complement."""
        self._C, self._D, self._comm = bordered.C, bordered.D, comm
        self._solve, self._times = solve, times
        self.count = len(bordered.C)
        # the columns of K^-1 C, and the Schur complement S of K
        self._X = [solve(column) for column in self._C]
        self._S = self._D - self._products(self._X).T
        eigenvalues = np.linalg.eigvalsh((self._S + self._S.T) / 2)
        self.negative_pivots = int(np.sum(eigenvalues < 0)) - bordered.multipliers

    def times(self, x: Vector) -> Vector:
        """Return the bordered matrix times (u, y). Collective."""
        u, y = split(x, self.count, self._comm)
        forces = np.sum([yi * column for yi, column in zip(y, self._C, strict=True)], axis=0)
        K_u = self._times(u)
        (displacements,) = self._products([u])  # C^T u
        return join(K_u + forces, displacements + self._D @ y, self._comm)

    def solve(self, rhs: Vector) -> Vector:
        """Return (u, y) for a right side, refined once if a nearly singular K loses digits."""
        x = self._eliminate(rhs)
        residual = rhs - self.times(x)
        allowed = REFINEMENT_TOLERANCE**2 * dot(self._comm, rhs, rhs)
        if dot(self._comm, residual, residual) > allowed:
            x = x + self._eliminate(residual)
        return x

    def _eliminate(self, rhs: Vector) -> Vector:
        """Return (u, y) for a right side (f, g) by S y = g - C^T K^-1 f and K u = f - C y."""
        f, g = split(rhs, self.count, self._comm)
        u = self._solve(f)
        (displacements,) = self._products([u])  # C^T K^-1 f
        y = np.linalg.solve(self._S, g - displacements)
        change = np.sum([yi * x for yi, x in zip(y, self._X, strict=True)], axis=0)
        return join(u - change, y, self._comm)

    def _products(self, vectors: list[Vector]) -> NDArray[np.float64]:
        """Return the inner products (len(vectors), k) of vectors with the columns of C."""
        products = [dot(self._comm, v, column) for v, column in product(vectors, self._C)]
        return np.array(products).reshape(len(vectors), len(self._C))


def join(u: Vector, y: Vector, comm: MPI.Comm) -> Vector:
    """Return the vector (u, y), with y on the last rank; a new array on every rank."""
    return np.concatenate([u, y if comm.rank == comm.size - 1 else y[:0]])


def split(x: Vector, k: int, comm: MPI.Comm) -> tuple[Vector, Vector]:
    """Split a vector (u, y) whose y is on the last rank. Collective.

    Parameters
    ----------
    k
        Number of entries of y.

    Returns
    -------
    u, a view of this rank's part, and a copy of y (k,) on every rank.
    """
    last_rank = comm.size - 1
    rows = x.size - k * (comm.rank == last_rank)
    return x[:rows], np.asarray(comm.bcast(x[rows:], root=last_rank))


class Stopwatch:
    """A context manager that adds up the time spent in its blocks.

    Attributes
    ----------
    seconds
        Time in all its blocks.
    """

    def __init__(self) -> None:
        self.seconds = 0.0

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.seconds += time.perf_counter() - self._start

"""Direct factorisation of the tangent, of one with an edge, and of small matrices; inertia,
condition and the work.
"""

import time
from collections.abc import Callable
from functools import cache
from types import TracebackType

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.continuation.beside import (
    ROUGH,
    TOLERANCE,
    Remembered,
    Solver,
    crossings,
    doubted,
)
from magshell_fenicsx.continuation.system import (
    Beside,
    Edged,
    Rest,
    Skewed,
    Tangent,
    Vector,
    dot,
    symmetric_part,
)

PREFIX = "magshell_factor_"
# PETSc's error numbers (petscerror.h) after which MUMPS replaces CHOLMOD
INDEFINITE, MISSING = 81, 92
# factorisations of all entries after one that the factors of the sparse part could not stand for
PATIENT = 8
CALM = 2  # a change of the method costs an analysis of the matrix, about as long as its factors
# CHOLMOD's own error: the matrix is too large for its integers or for the memory; MUMPS is tried
REFUSED = 76
ROUNDING = 1e-11  # a larger residual, relative to the right side, takes a second solve
Array = NDArray[np.float64]


class Factorisation:
    """Factors of the latest tangent; symbolic work is kept between calls.

    On one rank CHOLMOD is tried first: it takes half the time, and its success proves that there is
    no negative pivot. Otherwise MUMPS computes LDL^T and counts the negative pivots. CHOLMOD is
    tried again after `CALM` successive matrices in which MUMPS counts none. The memory of the other
    one is released. A skewed tangent K + N takes two factorisations: that of K for the inertia, and
    LU of the sum for the solutions. Of K + D, in which all unknowns act on each other, only K is
    factored where D is small beside it (`continuation.beside`).

    Attributes
    ----------
    count, stopwatch
        Factorisations done and the time spent on them.
    solving
        Time spent on solving with the factors.
    matrix
        The matrix last factored; K, or K + N, if that was an edged one.
    negative_pivots
        Unstable directions of the latest factored tangent (Sylvester's law of inertia). Of a skewed
        one those of K, less one where det (K + N) has the other sign: then it has been singular
        once less often.
    skewed
        Whether that tangent was a skewed one.
    doubt
        Where K was factored in place of K + D, the inverse of the error of D, or of what may be of
        an earlier state, relative to it, with which the pivots' signs would still be certain; else
        infinite.
    counted
        Whether both are known of the latest tangent.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self.count, self.negative_pivots = 0, 0
        self.stopwatch, self.solving = Stopwatch(), Stopwatch()
        self.comm = comm
        self._cholmod: _Definite | None = None
        self._mumps: PETSc.PC | None = None
        self._entries = 0.0  # of its matrix
        self._pc: PETSc.PC | None = None
        self._rhs: PETSc.Vec | None = None
        self._definite = self._has_cholmod = comm.size == 1 and has_cholmod()
        self._calm = 0  # successive matrices of MUMPS without a negative pivot
        self._edge: Edge | None = None
        self._edged: Edged | None = None
        self.skewed = False
        self._rest: Rest | None = None
        self._remembered: Remembered | None = None
        self._solver: Solver | None = None  # of the present K and D, from its first solution on
        self._waiting = 0  # factorisations until the factors of a sparse part are tried again
        self.doubt, self.counted = np.inf, True
        self._beside: Beside | None = None

    def factor(self, tangent: Tangent, *, counted: bool = True) -> None:
        """Factor a matrix; an edged one by the factors of its K and k back-solves; `count_beside`
        unless `counted`.

        Raises
        ------
        PETSc.Error
            If MUMPS fails, for example for lack of memory, or if CHOLMOD fails for a reason other
            than the matrix.
        """
        inner = tangent.K if isinstance(tangent, Edged) else tangent
        self.skewed = isinstance(inner, Skewed)
        with self.stopwatch:
            self._edge = self._rest = self._solver = None
            if not (
                isinstance(inner, Beside)
                and self._factor_beside(inner, counted or inner is not tangent)
            ):
                self._factor_symmetric(symmetric_part(inner))
            if isinstance(inner, Skewed):
                self._factor_sum(inner)
        self.count += 1
        self._edged = tangent if isinstance(tangent, Edged) else None
        if isinstance(tangent, Edged):
            self._edge = Edge(tangent, self.comm, self._inner, self._product)
            self.negative_pivots += self._edge.negative_pivots

    @property
    def habit(self) -> int:
        """-1 if CHOLMOD is tried first, else the number of successive matrices without a negative
        pivot.
        """
        return -1 if self._definite else self._calm

    @habit.setter
    def habit(self, pivots: int) -> None:
        self._definite, self._calm = self._has_cholmod and pivots < 0, max(pivots, 0)

    @property
    def size(self) -> tuple[int, int]:
        """Rows of the matrix last factored: on this rank, and on all."""
        edge = self._edge.count if self._edge else 0
        local, whole = (size[0] for size in (self.matrix.getLocalSize(), self.matrix.getSize()))
        return local + edge * (self.comm.rank == self.comm.size - 1), whole + edge

    @property
    def norm(self) -> float:
        """The largest sum of magnitudes in a row of K."""
        return float(self.matrix.norm(PETSc.NormType.NORM_INFINITY))

    def _factor_symmetric(self, K: PETSc.Mat) -> None:
        self.matrix, self.doubt, self.counted = K, np.inf, True
        if self._rhs is None:
            self._rhs, self._solution = K.createVecs()
        if not (self._definite and self._factor_definite(K)):
            self._factor_any(K)

    @property
    def knows(self) -> bool:
        """Whether D of the tangents so far was small beside K."""
        return self._remembered is not None and self._waiting <= 1

    def _factor_beside(self, tangent: Beside, counted: bool) -> bool:
        """Factor the sparse part of K + D; False if D is not small beside it."""
        self._waiting -= 1
        if self._waiting > 0:
            return False
        self._factor_symmetric(tangent.K)
        self._remembered = (self._remembered or Remembered(tangent.D)).of(tangent.D)
        self._rest, self._beside, self.counted = tangent.D, tangent, False
        return not counted or self.count_beside()

    def count_beside(self) -> bool:
        """Count the negative pivots of K + D by the factors of K; False if D is not small beside
        it.
        """
        tangent, remembered = self._beside, self._remembered
        if not tangent or not remembered:  # an earlier count failed
            return False
        first = self._back(
            np.random.default_rng(self.comm.rank).standard_normal(tangent.K.getLocalSize()[0])
        )
        counted = crossings(remembered.times, self._back, first, self.comm)
        if counted is None:
            self._waiting, self._remembered, self._rest = PATIENT, None, None
            return False
        counted = doubted(tangent, counted, self._back, self._sparse, first, self.comm)
        self.doubt, self.counted = counted.doubt, True
        self.negative_pivots += counted.more
        return True

    def change(self, x: Vector) -> Vector:
        """Return the product of x with what the older part of the latest tangent lacks, as
        foreseen; collective."""
        change, rows = np.zeros_like(x), self.matrix.getLocalSize()[0]
        if self._rest and self._beside:
            change[:rows] = self._beside.change(x[:rows])
        return change

    def _factor_definite(self, K: PETSc.Mat) -> bool:
        """Try CHOLMOD; False if K is not positive definite, or if CHOLMOD cannot be used."""
        if self._cholmod is None or not self._cholmod.is_of(K):
            self._pc = self._mumps = None
            self._cholmod = _Definite(K)
        try:
            self._cholmod.factor()
        except PETSc.Error as e:
            self._cholmod, self._definite, self._calm = None, False, 0
            self._has_cholmod = e.ierr == INDEFINITE
            if e.ierr not in (INDEFINITE, MISSING, REFUSED):
                raise
            return False
        self._pc, self.negative_pivots = self._cholmod.pc, 0
        return True

    def _factor_any(self, K: PETSc.Mat) -> None:
        entries = _entries(K)
        if self._mumps is None or (self._mumps.getOperators()[1].handle, self._entries) != (
            K.handle,
            entries,
        ):
            # of another pattern PETSc makes new factors itself, without the options below
            self._mumps, self._entries = _new_pc(K, "mumps"), entries
            self._mumps.setFactorSetUpSolverType()
            F = self._mumps.getFactorMatrix()
            F.setMumpsIcntl(24, 1)  # report null pivots: PETSc gives no inertia without this
            F.setMumpsCntl(
                3, -1e-100
            )  # only true zeros are null pivots: else the null vector is lost at a fold
            F.setMumpsCntl(
                5, 1e-17
            )  # null pivots are replaced by a tiny number, for the same reason
            if self.comm.size > 1:
                F.setMumpsIcntl(
                    13, 1
                )  # no ScaLAPACK for the root front: its pivots must be counted too
            F.setMumpsIcntl(14, 50)
            F.setMumpsIcntl(
                8, 0
            )  # no scaling: a tenth faster, and the tangent's entries are of similar size
        _renew(self._mumps, K)
        self._pc, self.negative_pivots = self._mumps, self._mumps.getFactorMatrix().getInertia()[0]
        self._calm = 0 if self.negative_pivots else self._calm + 1
        self._definite = self._has_cholmod and self._calm >= CALM

    def _factor_sum(self, tangent: Skewed) -> None:
        """LU of K + N, for the solutions, and the sign of its determinant."""
        self.matrix = whole = tangent.K.copy()
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            whole.setOption(option, False)
        whole.axpy(1.0, tangent.N, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        self._pc = pc = _new_pc(whole, "mumps", "lu")
        pc.setFactorSetUpSolverType()
        F = pc.getFactorMatrix()
        F.setMumpsIcntl(33, 1)  # the determinant
        F.setMumpsIcntl(14, 50)
        _renew(pc, whole)
        even = self.comm.bcast(F.getMumpsRinfog(12) > 0.0 if self.comm.rank == 0 else None)
        if self.negative_pivots % 2 == even:
            self.negative_pivots -= 1

    def times(self, x: Vector) -> Vector:
        """The matrix last factored times x."""
        return self._edge.times(x) if self._edge else self._product(x)

    def solve(self, rhs: Vector, *, rough: bool = False) -> Vector:
        """The solution with the latest factors; if `rough`, within a small part of it where D
        stands beside K.
        """
        return self._edge.solve(rhs) if self._edge else self._inner(rhs, rough=rough)

    def solve_transposed(self, rhs: Vector) -> Vector:
        """The same with the transposed matrix."""

        def of(operation: Callable[[PETSc.Vec, PETSc.Vec], None]) -> Callable[[Vector], Vector]:
            def applied(x: Vector) -> Vector:
                v, y = self.matrix.createVecs()
                v.setArray(x)
                operation(v, y)
                return np.array(y.array_r)

            return applied

        if self._rest:
            return self.solve(rhs)  # K + D is symmetric
        assert self._pc is not None
        solve, times = of(self._pc.applyTranspose), of(self.matrix.multTranspose)
        return Edge(self._edged, self.comm, solve, times).solve(rhs) if self._edged else solve(rhs)

    def _product(self, x: Vector) -> Vector:
        return self._sparse(x) + (self._rest.times(x) if self._rest else 0.0)

    def _sparse(self, x: Vector) -> Vector:
        v, y = self.matrix.createVecs()
        v.setArray(x)
        self.matrix.mult(v, y)
        return np.array(y.array_r)

    def _inner(self, rhs: Vector, *, rough: bool = False) -> Vector:
        """K^-1 rhs, or (K + D)^-1 rhs; no numbers if K + D is so nearly singular that the factors
        of K do not serve.
        """
        if self._rest is None:
            return self._back(rhs)
        assert self._remembered
        self._solver = self._solver or Solver(
            self._back, self._backs, self._remembered, self.comm, len(rhs)
        )
        return self._solver.solve(self._back(rhs), ROUGH if rough else TOLERANCE)

    def _back(self, rhs: Vector) -> Vector:
        """K^-1 rhs."""
        assert self._pc is not None
        assert self._rhs is not None
        with self.solving:
            self._rhs.setArray(rhs)
            self._pc.apply(self._rhs, self._solution)
            return np.array(self._solution.array_r)

    def _backs(self, columns: Array) -> Array:
        """K^-1 times columns, all at once."""
        assert self._pc is not None
        rows = (len(columns), PETSc.DETERMINE)
        B = PETSc.Mat().createDense(
            (rows, columns.shape[1]), array=np.array(columns, order="F"), comm=self.comm
        )
        X = B.duplicate()
        with self.solving:
            self._pc.matApply(B, X)
        solutions = np.array(X.getDenseArray())
        B.destroy()
        X.destroy()
        return solutions


@cache
def has_cholmod() -> bool:
    """Whether PETSc was built with CHOLMOD, whose options it would call unused without."""
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


class _Definite:
    """CHOLMOD's factors of a copy of a matrix's upper triangle.

    From any other format PETSc itself makes such a copy each time, and leaks it if CHOLMOD fails.
    """

    def __init__(self, K: PETSc.Mat) -> None:
        self._K, self._entries = K, _entries(K)
        self._upper = self._copied(PETSc.Mat())
        self.pc = _new_pc(self._upper, "cholmod")

    def is_of(self, K: PETSc.Mat) -> bool:
        """Whether K is the same matrix, with the same entries."""
        return K.handle == self._K.handle and _entries(K) == self._entries

    def factor(self) -> None:
        """Factor the matrix as it is now."""
        self._copied(self._upper)
        _renew(self.pc, self._upper)

    def _copied(self, upper: PETSc.Mat) -> PETSc.Mat:
        K = self._K
        if K.getBlockSize() > 1:  # the copy would have the blocks too
            K = PETSc.Mat().createAIJ(K.getSize(), csr=K.getValuesCSR(), comm=K.comm)
        K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        return K.convert("seqsbaij", upper)


def _entries(K: PETSc.Mat) -> float:
    """All entries of its pattern; collective."""
    return float(K.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"])


def _new_pc(K: PETSc.Mat, solver: str, kind: str = "cholesky") -> PETSc.PC:
    if solver == "cholmod":  # its simplicial method factors indefinite matrices without an error
        given = PETSc.Options(PREFIX)
        given["mat_cholmod_supernodal_switch"], given["mat_cholmod_print"] = 0.0, 0
    pc = PETSc.PC().create(K.comm)
    pc.setOptionsPrefix(PREFIX)
    pc.setOperators(K)
    pc.setType(kind)
    pc.setFactorSolverType(solver)
    pc.setFromOptions()
    return pc


def _renew(pc: PETSc.PC, K: PETSc.Mat) -> None:
    pc.setReusePreconditioner(False)
    pc.setOperators(K)
    pc.setUp()
    pc.setReusePreconditioner(True)  # a solve must not factor again after K was assembled again


class Edge:
    """Solves with an edged matrix [K C; C^T D] by block elimination with the factors of K.

    It has the k additional unknowns y and the Schur complement S = D - C^T K^-1 C.

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
        Number that the edge adds to that of K (Haynsworth's inertia additivity), without its
        multipliers.
    """

    def __init__(
        self,
        edged: Edged,
        comm: MPI.Comm,
        solve: Callable[[Vector], Vector],
        times: Callable[[Vector], Vector],
    ) -> None:
        self._C, self._D, self._comm, self._solve, self._times = (
            edged.C,
            edged.D,
            comm,
            solve,
            times,
        )
        self.count = len(edged.C)
        self._X = [solve(column) for column in self._C]
        self._S = self._D - self._products(self._X).T
        self.negative_pivots = (
            int(np.sum(np.linalg.eigvalsh((self._S + self._S.T) / 2) < 0)) - edged.multipliers
        )

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
        return join(
            u - np.sum([yi * x for yi, x in zip(y, self._X, strict=True)], axis=0), y, self._comm
        )

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


class Stopwatch:
    """Attributes: seconds, summed over all blocks."""

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

"""Direct factorisation of the symmetric tangent, its inertia, and a count of the work."""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.continuation.edge import Edge
from magshell_fenicsx.continuation.system import Edged, Tangent, Vector
from magshell_fenicsx.continuation.timing import Stopwatch

PREFIX = "magshell_factor_"
# PETSc's numbers of what CHOLMOD may end with where MUMPS goes on (petscerror.h)
INDEFINITE, MISSING = 81, 92
REFUSED = 76  # CHOLMOD itself: too large for its integers, or no memory, of which MUMPS decides


class Factorisation:
    """Factors of the latest tangent; symbolic work is kept between calls.

    A tangent that is expected to be positive definite is given to CHOLMOD on one rank, which takes half
    the time and, by succeeding, proves that there is no negative pivot. Else MUMPS makes LDL^T and
    counts them. After its first failure CHOLMOD is left alone, and its memory given back.

    Attributes
    ----------
    count, stopwatch
        Factorisations done and the time spent on them.
    solving
        Time spent on solving with the factors.
    matrix
        The matrix last factored; of an edged one, K.
    negative_pivots
        Unstable directions of the latest factored tangent (Sylvester's law of inertia).
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self.count, self.negative_pivots = 0, 0
        self.stopwatch, self.solving = Stopwatch(), Stopwatch()
        self.comm = comm
        self._cholmod: _Definite | None = None
        self._mumps: PETSc.PC | None = None
        self._pc: PETSc.PC | None = None
        self._rhs: PETSc.Vec | None = None
        self._definite = comm.size == 1
        self._edge: Edge | None = None

    def factor(self, tangent: Tangent) -> None:
        """Factor a matrix; an edged one by the factors of its K and k back-solves.

        Raises
        ------
        PETSc.Error
            If MUMPS fails, for want of memory for instance, or CHOLMOD in a way that says nothing of the matrix.
        """
        K = tangent.K if isinstance(tangent, Edged) else tangent
        with self.stopwatch:
            self.matrix, self._edge = K, None
            if self._rhs is None:
                self._rhs, self._solution = K.createVecs()
            if not (self._definite and self._factor_definite(K)):
                self._factor_any(K)
        self.count += 1
        if isinstance(tangent, Edged):
            self._edge = Edge(tangent, self.comm, self._inner, self._product)
            self.negative_pivots += self._edge.negative_pivots

    @property
    def size(self) -> tuple[int, int]:
        """Rows of the matrix last factored: on this rank, and in all."""
        edge = self._edge.count if self._edge else 0
        here, whole = (size[0] for size in (self.matrix.getLocalSize(), self.matrix.getSize()))
        return here + edge * (self.comm.rank == self.comm.size - 1), whole + edge

    @property
    def norm(self) -> float:
        """Of K: its largest sum of a row's magnitudes."""
        return float(self.matrix.norm(PETSc.NormType.NORM_INFINITY))

    def _factor_definite(self, K: PETSc.Mat) -> bool:
        """Try CHOLMOD; False if K is not positive definite, or CHOLMOD cannot say."""
        if self._cholmod is None or not self._cholmod.is_of(K):
            self._cholmod = _Definite(K)
        try:
            self._cholmod.factor()
        except PETSc.Error as e:
            self._cholmod, self._definite = None, False
            if e.ierr not in (INDEFINITE, MISSING, REFUSED):
                raise
            return False
        self._pc, self.negative_pivots = self._cholmod.pc, 0
        return True

    def _factor_any(self, K: PETSc.Mat) -> None:
        if self._mumps is None:
            self._mumps = _new_pc(K, "mumps")
            self._mumps.setFactorSetUpSolverType()
            F = self._mumps.getFactorMatrix()
            F.setMumpsIcntl(24, 1)  # null pivots are reported, without it there is no inertia,
            F.setMumpsCntl(3, -1e-100)  # but only true zeros: else the null vector would be lost at a fold,
            F.setMumpsCntl(5, 1e-17)  # and those are made tiny, for the same reason
            if self.comm.size > 1:
                F.setMumpsIcntl(13, 1)  # the root front too must be counted, so it is not left to ScaLAPACK
            F.setMumpsIcntl(14, 50)
            F.setMumpsIcntl(8, 0)  # unscaled: a tenth faster, the tangent's entries are of one size
        _renew(self._mumps, K)
        self._pc, self.negative_pivots = self._mumps, self._mumps.getFactorMatrix().getInertia()[0]

    def times(self, x: Vector) -> Vector:
        """The matrix last factored times x."""
        return self._edge.times(x) if self._edge else self._product(x)

    def solve(self, rhs: Vector) -> Vector:
        """The solution with the latest factors."""
        return self._edge.solve(rhs) if self._edge else self._inner(rhs)

    def _product(self, x: Vector) -> Vector:
        v, y = self.matrix.createVecs()
        v.setArray(x)
        self.matrix.mult(v, y)
        return np.array(y.array_r)

    def _inner(self, rhs: Vector) -> Vector:
        """K^-1 rhs."""
        assert self._pc is not None
        assert self._rhs is not None
        with self.solving:
            self._rhs.setArray(rhs)
            self._pc.apply(self._rhs, self._solution)
            return np.array(self._solution.array_r)


def has_cholmod() -> bool:
    """Whether PETSc was built with CHOLMOD."""
    K = PETSc.Mat().createAIJ([1, 1], nnz=1, comm=MPI.COMM_SELF)
    K.setValue(0, 0, 1.0)
    K.assemble()
    try:
        _Definite(K).factor()
    except PETSc.Error as e:
        if e.ierr != MISSING:
            raise
        return False
    return True


class _Definite:
    """CHOLMOD's factors of a matrix, by way of its upper triangle: of any other matrix PETSc copies that for
    CHOLMOD each time, and loses the copy where CHOLMOD fails.
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
        if K.getBlockSize() > 1:  # which the triangle would have too
            K = PETSc.Mat().createAIJ(K.getSize(), csr=K.getValuesCSR(), comm=K.comm)
        K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        return K.convert("seqsbaij", upper)


def _entries(K: PETSc.Mat) -> float:
    return float(K.getInfo()["nz_used"])


def _new_pc(K: PETSc.Mat, solver: str) -> PETSc.PC:
    if solver == "cholmod":  # its other method factors indefinite matrices without a word
        given = PETSc.Options(PREFIX)
        given["mat_cholmod_supernodal_switch"], given["mat_cholmod_print"] = 0.0, 0
    pc = PETSc.PC().create(K.comm)
    pc.setOptionsPrefix(PREFIX)
    pc.setOperators(K)
    pc.setType("cholesky")
    pc.setFactorSolverType(solver)
    pc.setFromOptions()
    return pc


def _renew(pc: PETSc.PC, K: PETSc.Mat) -> None:
    pc.setReusePreconditioner(False)
    pc.setOperators(K)
    pc.setUp()
    pc.setReusePreconditioner(True)  # a solve must not factor anew when K was assembled again

"""Direct factorisation of the symmetric tangent, its inertia, and a count of the work."""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.solve.system import Vector
from magshell_fenicsx.solve.timing import Stopwatch


class Factorisation:
    """MUMPS LDL^T of the latest tangent; symbolic work is kept between calls.

    Attributes
    ----------
    count, stopwatch
        Factorisations done and the time spent on them.
    solving
        Time spent on solving with the factors.
    matrix
        The matrix last factored.
    negative_pivots
        Unstable directions of the latest factored tangent (Sylvester's law of inertia).
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self.count, self.negative_pivots = 0, 0
        self.stopwatch, self.solving = Stopwatch(), Stopwatch()
        self._comm = comm
        self._pc: PETSc.PC | None = None
        self._rhs: PETSc.Vec | None = None

    def factor(self, K: PETSc.Mat) -> None:
        """Factor K.

        Raises
        ------
        PETSc.Error
            If MUMPS fails, for want of memory for instance.
        """
        with self.stopwatch:
            self._factor(K)
        self.count += 1

    def _factor(self, K: PETSc.Mat) -> None:
        self.matrix = K
        if self._pc is None:
            self._pc = self._new_pc(K)
            self._rhs, self._solution = K.createVecs()
        self._pc.setReusePreconditioner(False)
        self._pc.setOperators(K)
        self._pc.setUp()
        self._pc.setReusePreconditioner(True)  # a solve must not factor anew when K was assembled again
        self.negative_pivots = self._pc.getFactorMatrix().getInertia()[0]

    def solve(self, rhs: Vector) -> Vector:
        """K^-1 rhs with the latest factors."""
        assert self._pc is not None
        assert self._rhs is not None
        with self.solving:
            self._rhs.setArray(rhs)
            self._pc.apply(self._rhs, self._solution)
            return np.array(self._solution.array_r)

    def _new_pc(self, K: PETSc.Mat) -> PETSc.PC:
        pc = PETSc.PC().create(self._comm)
        pc.setOptionsPrefix("magshell_factor_")
        pc.setOperators(K)
        pc.setType("cholesky")
        pc.setFactorSolverType("mumps")
        pc.setFactorSetUpSolverType()
        F = pc.getFactorMatrix()
        F.setMumpsIcntl(24, 1)  # null pivots are reported, without it there is no inertia
        F.setMumpsCntl(3, -1e-100)  # but only true zeros count as null: else the null vector would be lost at a fold,
        F.setMumpsCntl(5, 1e-17)  # and those are made tiny, for the same reason
        if self._comm.size > 1:
            F.setMumpsIcntl(13, 1)  # the root front too must be counted, so it is not left to ScaLAPACK
        F.setMumpsIcntl(14, 50)
        pc.setFromOptions()
        return pc

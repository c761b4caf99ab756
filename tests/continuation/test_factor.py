"""Factors of tangents that change, banded ones against NumPy's eigenvalues, and the condition of a
known spectrum.
"""

import resource
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.continuation import factor
from magshell_fenicsx.continuation.factor import Factorisation, has_cholmod
from magshell_fenicsx.continuation.system import SkewedTangent


def matrix(diagonal: list[float]) -> PETSc.Mat:
    K = PETSc.Mat().createAIJ([len(diagonal)] * 2, comm=MPI.COMM_SELF)
    K.setUp()
    K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    fill(K, diagonal)
    return K


def fill(K: PETSc.Mat, diagonal: list[float]) -> None:
    for i, value in enumerate(diagonal):
        K.setValue(i, i, value)
    K.assemble()


def test_factors_outlive_the_matrix_they_were_made_of() -> None:
    K, factors = matrix([2.0, 4.0]), Factorisation(MPI.COMM_SELF)
    factors.factor(K)
    fill(K, [-8.0, 1.0])
    assert factors.solve(np.ones(2)) == pytest.approx([0.5, 0.25])
    factors.factor(K)
    assert factors.solve(np.ones(2)) == pytest.approx([-0.125, 1.0])
    assert (factors.negative_pivots, factors.count) == (1, 2)


def test_null_vector_survives_an_exactly_singular_matrix() -> None:
    factors = Factorisation(MPI.COMM_SELF)
    factors.factor(matrix([3.0, 0.0]))
    v = factors.solve(np.ones(2))
    assert abs(v[1]) > 1e10 * abs(v[0])


@pytest.mark.parametrize(("across", "unstable"), [(1.0, 0), (0.1, 1)])
def test_inertia_of_a_skewed_tangent(across: float, unstable: int) -> None:
    """Of [-0.1 c; -c 1], whose determinant is c^2 - 0.1: K alone has a negative pivot, a large c
    makes up for it.
    """
    N, factors = matrix([0.0, 0.0]), Factorisation(MPI.COMM_SELF)
    N.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
    N.setValue(0, 1, across)
    N.setValue(1, 0, -across)
    N.assemble()
    K = matrix([-0.1, 1.0])
    factors.factor(SkewedTangent(K, N))
    A = np.array([[-0.1, across], [-across, 1.0]])
    assert factors.negative_pivots == unstable
    assert factors.skewed
    assert factors.solve(np.array([1.0, 2.0])) == pytest.approx(np.linalg.solve(A, [1.0, 2.0]))
    assert factors.solve_transposed(np.array([1.0, 2.0])) == pytest.approx(
        np.linalg.solve(A.T, [1.0, 2.0])
    )
    factors.factor(K)
    assert (factors.skewed, factors.negative_pivots) == (False, 1)
    assert factors.solve(np.ones(2)) == pytest.approx([-10.0, 1.0])


def indefinite(n: int) -> PETSc.Mat:
    """Full, so that its triangle is 12 n^2/2 bytes; only the last pivot is negative."""
    K = PETSc.Mat().createAIJ([n, n], nnz=n, comm=MPI.COMM_SELF)
    K.setUp()
    K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    A = np.eye(n) + 0.1 / n
    A[-1, -1] = -1.0
    K.setValues(range(n), range(n), A)
    K.assemble()
    return K


def test_tangents_that_are_not_definite_leave_no_memory_behind() -> None:
    """PETSc's own copy of 0.96 MB, lost each time, made it 58 MB."""
    K = indefinite(400)
    sizes = []
    for _ in range(70):
        factors = Factorisation(MPI.COMM_SELF)
        factors.factor(K)
        assert factors.negative_pivots == 1
        sizes.append(int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize())
    assert sizes[-1] - sizes[9] < 6e6


@pytest.mark.parametrize("bs", [1, 2, 3])
def test_blocks(bs: int) -> None:
    """Dolfinx gives its matrices the field's block size."""
    A = np.diag(np.arange(1.0, 7.0)) + 0.1
    for shift, negative in ((0.0, 0), (2.5, 2)):
        K = PETSc.Mat().createAIJ([6, 6], bsize=bs, nnz=6, comm=MPI.COMM_SELF)
        K.setUp()
        K.setValues(range(6), range(6), A - shift * np.eye(6))
        K.assemble()
        factors = Factorisation(MPI.COMM_SELF)
        for _ in range(2):
            factors.factor(K)
            assert factors.solve(np.ones(6)) == pytest.approx(
                np.linalg.solve(A - shift * np.eye(6), np.ones(6))
            )
            assert factors.negative_pivots == negative


@pytest.mark.parametrize("definite", [True, False])
def test_another_matrix_or_another_pattern(monkeypatch: pytest.MonkeyPatch, definite: bool) -> None:
    """By CHOLMOD, if it is there, and by MUMPS alone."""
    monkeypatch.setattr(factor, "has_cholmod", lambda: definite and has_cholmod())
    factors = Factorisation(MPI.COMM_SELF)
    factors.factor(matrix([2.0, 4.0, 8.0]))
    K = matrix([1.0, 2.0, 4.0])
    factors.factor(K)
    assert factors.solve(np.ones(3)) == pytest.approx([1.0, 0.5, 0.25])
    K.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
    K.setValue(0, 2, 1.0)
    K.setValue(2, 0, 1.0)
    K.assemble()
    factors.factor(K)
    assert factors.solve(np.array([1.0, 0.0, 4.0])) == pytest.approx([0.0, 0.0, 1.0])


@pytest.mark.parametrize("number", [81, 92, 76])
def test_mumps_takes_over_where_cholmod_cannot(
    monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """Not positive definite; no CHOLMOD there; too large for it."""
    factors = failing(monkeypatch, number)
    factors.factor(matrix([2.0, 4.0]))
    assert factors.solve(np.ones(2)) == pytest.approx([0.5, 0.25])


def test_without_cholmod_its_options_are_not_set(monkeypatch: pytest.MonkeyPatch) -> None:
    """PETSc would call them unused at the end of the program. MUMPS alone factors."""
    monkeypatch.setattr(factor, "has_cholmod", lambda: False)
    monkeypatch.setattr(factor, "_new_pc", partial(refused, factor._new_pc))
    factors = Factorisation(MPI.COMM_SELF)
    for last in (4.0, 3.0, 2.0, -1.0):
        factors.factor(matrix([2.0, last]))
        assert factors.solve(np.ones(2)) == pytest.approx([0.5, 1 / last])


def refused(new_pc: Callable[..., PETSc.PC], K: PETSc.Mat, solver: str, *kind: str) -> PETSc.PC:
    """No factors of CHOLMOD."""
    assert solver != "cholmod"
    return new_pc(K, solver, *kind)


def test_cholmod_comes_back() -> None:
    """After two matrices that MUMPS finds definite; one that is not in between begins the count
    again.
    """
    factors, used = Factorisation(MPI.COMM_SELF), []
    K = matrix([2.0, 4.0])
    for last in (4.0, -4.0, 1.0, -2.0, 3.0, 5.0, 6.0, 7.0, -1.0):
        fill(K, [2.0, last])
        factors.factor(K)
        assert factors.solve(np.ones(2)) == pytest.approx([0.5, 1 / last])
        assert factors.negative_pivots == (last < 0)
        used.append(factors._pc.getFactorSolverType())
    if not has_cholmod():
        assert used == ["mumps"] * 9
        return
    assert used == ["cholmod", *5 * ["mumps"], "cholmod", "cholmod", "mumps"]


@pytest.mark.skipif(not has_cholmod(), reason="this PETSc has no CHOLMOD")
def test_other_errors_of_cholmod_are_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    """55: PETSc is out of memory."""
    with pytest.raises(PETSc.Error) as raised:
        failing(monkeypatch, 55).factor(matrix([2.0, 4.0]))
    assert raised.value.ierr == 55


def failing(monkeypatch: pytest.MonkeyPatch, number: int) -> Factorisation:
    """CHOLMOD ends with an error of PETSc's."""
    renew = factor._renew

    def fail(pc: PETSc.PC, K: PETSc.Mat) -> None:
        if pc.getFactorSolverType() == "cholmod":
            raise PETSc.Error(number)
        renew(pc, K)

    monkeypatch.setattr(factor, "_renew", fail)
    return Factorisation(MPI.COMM_SELF)

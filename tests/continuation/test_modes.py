"""The eigenpair nearest to zero of matrices whose spectra are known."""

import subprocess
import sys

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.continuation import modes
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.modes import NoEigenpair, nearest_to_zero

N = 60
SPECTRA = {
    "a and nearly -a": [1.0, -1.001, 5.0],
    "-a and nearly a": [-1.0, 1.001, 5.0],
    "a and -a": [1.0, -1.0],
    "both twice": [2.0, 2.0, -2.0, -2.0],
    "a and -a nearly zero": [1e-9, -1.1e-9],
    "close together": [1 + 1e-4 * i for i in range(20)],
    "five times": [1.0] * 5,
    "at a fold": [1e-10, 3.0],
}
# to the next eigenvalue of the same sign, relative
DISTANCE = {"a and nearly -a": 1.0, "a and -a": 1.0, "close together": 1e-4, "at a fold": 1.0}


def symmetric(spectrum: list[float]) -> np.ndarray:
    """A dense matrix with these eigenvalues and 10, 11, ..."""
    Q = np.linalg.qr(np.random.default_rng(0).standard_normal((N, N)))[0]
    A = (Q * np.concatenate([spectrum, 10.0 + np.arange(N - len(spectrum))])) @ Q.T
    return np.asarray((A + A.T) / 2)


def factored(A: np.ndarray, comm: MPI.Comm = MPI.COMM_SELF) -> Factorisation:
    """The factors of a matrix that the ranks share."""
    K, factors = PETSc.Mat().createAIJ(A.shape, comm=comm), Factorisation(comm)
    K.setUp()
    for i in range(*K.getOwnershipRange()):
        K.setValues(i, range(len(A)), A[i])
    K.assemble()
    K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    factors.factor(K)
    return factors


@pytest.mark.parametrize("spectrum", SPECTRA.values(), ids=SPECTRA)
def test_pair_is_an_eigenpair_and_none_is_nearer(spectrum: list[float]) -> None:
    """Of a and -a the negative one; errors are those of rounding in a matrix of norm 70."""
    A = symmetric(spectrum)
    value, v = nearest_to_zero(factored(A))
    assert value == pytest.approx(min(spectrum, key=lambda x: (abs(x), x)), rel=1e-12, abs=1e-13)
    assert np.linalg.norm(A @ v - value * v) < 2e-8 * abs(value) + 1e-13
    assert np.linalg.norm(v) == pytest.approx(1.0, rel=1e-14)


@pytest.mark.parametrize("span", [8, 12, 15])
def test_stiff_matrix_ends_at_rounding(span: int) -> None:
    """The eigenvalue is known to rounding in the largest one; its vector with it."""
    Q = np.linalg.qr(np.random.default_rng(1).standard_normal((N, N)))[0]
    A = (Q * np.concatenate([[1.0], np.geomspace(3.0, 10.0**span, N - 1)])) @ Q.T
    value, v = nearest_to_zero(factored((A + A.T) / 2))
    assert value == pytest.approx(1.0, abs=1e-12 + 1e-15 * 10.0**span)
    assert abs(v @ Q[:, 0]) == pytest.approx(1.0, abs=1e-12 + 1e-15 * 10.0**span)


@pytest.mark.parametrize("diagonal", [[5.0], [-2.0], [2.0, -1.0, 1.0, 3.0], [3.0] * 30])
def test_small_spaces(diagonal: list[float]) -> None:
    value, v = nearest_to_zero(factored(np.diag(diagonal)))
    assert value == pytest.approx(min(diagonal, key=lambda x: (abs(x), x)))
    assert diagonal * v == pytest.approx(value * v, abs=1e-12)


def test_no_answer_is_not_taken_for_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modes, "MOST_SOLVES", 3)
    with pytest.raises(NoEigenpair, match=r"not found in 3 solves: at .* the residual is still"):
        nearest_to_zero(factored(symmetric([1.0, 1.1, 1.2])))


def shared() -> None:
    """Print each spectrum's value and the magnitudes of its vector, from all ranks."""
    for name in DISTANCE:
        value, v = nearest_to_zero(factored(symmetric(SPECTRA[name]), MPI.COMM_WORLD))
        whole = np.concatenate(MPI.COMM_WORLD.allgather(v))
        if MPI.COMM_WORLD.rank == 0:
            print(value, *np.abs(whole))


@pytest.mark.slow
def test_same_on_any_number_of_ranks() -> None:
    """Value and vector, but for its sign, though the start depends on how the rows are shared out."""
    found = []
    for ranks in (1, 2, 3):
        command = ["mpirun", "--map-by", ":OVERSUBSCRIBE", "-n", str(ranks), sys.executable, __file__]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        found.append(np.loadtxt(done.stdout.splitlines()))
    for other in found[1:]:
        for one, same, distance in zip(found[0], other, DISTANCE.values(), strict=True):
            assert same[0] == pytest.approx(one[0], rel=1e-11, abs=1e-13)
            assert same[1:] == pytest.approx(one[1:], abs=2 * modes.TOLERANCE / distance)


if __name__ == "__main__":
    shared()

"""The eigenpair nearest to zero, and the lowest ones, of matrices whose spectra are known."""

import subprocess
import sys

import numpy as np
import pytest
from command import importing_environment, mpirun
from mpi4py import MPI
from petsc4py import PETSc
from toys import matrix, pitchfork, snap_through

from magshell_fenicsx.continuation import modes
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.modes import (
    ModesNotFound,
    NoEigenpair,
    lowest_mode,
    lowest_modes,
    nearest_to_zero,
    null_vector,
)

N, HELD = 60, 7
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
    monkeypatch.setattr(modes, "MAX_SOLVES", 3)
    with pytest.raises(NoEigenpair, match=r"not found in 3 solves: at .* the residual is still"):
        nearest_to_zero(factored(symmetric([1.0, 1.1, 1.2])))


def pencil(spectrum: list[float]) -> tuple[PETSc.Mat, PETSc.Mat]:
    """Dense K and M with the given lowest eigenvalues, then 10, 11, ...; one unknown is held."""
    rng = np.random.default_rng(0)
    wanted = np.concatenate([spectrum, 10.0 + np.arange(N - 1 - len(spectrum))])
    L = np.eye(N - 1) + 0.1 * np.tril(rng.standard_normal((N - 1, N - 1)))
    Q = np.linalg.qr(rng.standard_normal((N - 1, N - 1)))[0]
    K, M = np.eye(N), np.zeros((N, N))
    free = np.ix_(np.delete(np.arange(N), HELD), np.delete(np.arange(N), HELD))
    K[free], M[free] = L @ (Q * wanted) @ Q.T @ L.T, L @ L.T
    return matrix((K + K.T) / 2), matrix(M)


@pytest.mark.parametrize(
    "spectrum",
    [
        pytest.param([1.0, 2.0, 3.0, 4.0], id="stable"),
        pytest.param([-800.0, -3.0, 1e-9, 2.0], id="one far below"),
        pytest.param([-2.0, -2.0, -2.0, 0.5, 0.5], id="multiple"),
        pytest.param([1e-12, 0.3, 0.3, 5.0], id="at a fold"),
        pytest.param(list(np.linspace(-5, -0.1, 20)), id="many unstable"),
    ],
)
def test_spectrum_is_found(spectrum: list[float]) -> None:
    """The lowest four, or all negative ones, without the eigenvalue 1 of the held unknown."""
    K, M = pencil(spectrum)
    lowest = lowest_modes(K, M, 4)
    expected = sorted(spectrum)[: max(4, sum(value < 0 for value in spectrum))]
    assert [mode.eigenvalue for mode in lowest] == pytest.approx(
        expected, rel=1e-9, abs=1e-9 * np.abs(spectrum).max()
    )


def test_vectors_are_eigenvectors_of_length_one() -> None:
    K, M = pencil([-1.0, 0.5, 0.5, 2.0])
    for mode in lowest_modes(K, M, 4):
        phi, k, m = K.createVecRight(), K.createVecLeft(), K.createVecLeft()
        phi.setArray(mode.vector)
        K.mult(phi, k)
        M.mult(phi, m)
        assert phi.dot(m) == pytest.approx(1.0, rel=1e-8)
        assert np.abs(k.array - mode.eigenvalue * m.array).max() < 1e-7
        assert abs(mode.vector[HELD]) < 1e-12


def test_count_agrees_with_the_inertia() -> None:
    """More lowest than there are: all of them, as NumPy finds them."""
    K, M = pencil([-1.0, -1.0])
    lowest = lowest_modes(K, M, 2 * N)
    assert len(lowest) == N - 1
    assert sum(mode.eigenvalue < 0 for mode in lowest) == 2
    assert lowest[-1].eigenvalue == pytest.approx(10.0 + N - 4, rel=1e-9)


def test_toys() -> None:
    """Closed forms: 3 u^2 - 6 u + 2 of the arch; 1 and 1 - u of the straight column."""
    arch, column = snap_through(), pitchfork()
    for u in (0.2, 1.0, 1.8):
        (mode,) = lowest_modes(arch.tangent(np.array([u]), {"load": 0.0}), matrix(np.eye(1)), 3)
        assert mode.eigenvalue == pytest.approx(3 * u**2 - 6 * u + 2, rel=1e-12)
    for u in (0.4, 0.999, 1.5):
        first, second = lowest_modes(
            column.tangent(np.array([u, 0.0]), {"load": 0.0}), matrix(np.eye(2)), 2
        )
        assert first.eigenvalue == pytest.approx(1 - u, rel=1e-9)
        assert second.eigenvalue == pytest.approx(1.0, rel=1e-12)
        assert abs(first.vector) == pytest.approx([0, 1], abs=1e-9)


def test_null_vector_of_a_nearly_singular_matrix() -> None:
    K, M = pencil([-3.0, 1e-10, 2.0])
    v, mode = null_vector(K), lowest_modes(K, M, 2)[1]
    assert np.linalg.norm(v) == pytest.approx(1.0)
    assert abs(v @ mode.vector) == pytest.approx(np.linalg.norm(mode.vector), rel=1e-6)


def test_lowest_mode_of_an_indefinite_matrix() -> None:
    """Not the one nearest to zero; by NumPy."""
    A = symmetric([-3.0, -2.9, 1e-10, 2.0])
    v, lowest = lowest_mode(matrix(A)), np.linalg.eigh(A)[1][:, 0]
    assert abs(v @ lowest) == pytest.approx(np.linalg.norm(v), rel=1e-9)


def test_spectrum_without_a_lower_end_is_refused() -> None:
    """An unknown without mass and with negative stiffness lies below every shift."""
    with pytest.raises(ModesNotFound, match="below"):
        lowest_modes(matrix(np.diag([1.0, 2.0, -1.0])), matrix(np.diag([1.0, 1.0, 0.0])), 2)


def shared() -> None:
    """Print each spectrum's value and the magnitudes of its vector, from all ranks."""
    for name in DISTANCE:
        value, v = nearest_to_zero(factored(symmetric(SPECTRA[name]), MPI.COMM_WORLD))
        whole = np.concatenate(MPI.COMM_WORLD.allgather(v))
        if MPI.COMM_WORLD.rank == 0:
            print(value, *np.abs(whole))


@pytest.mark.slow
def test_same_on_any_number_of_ranks() -> None:
    """Value and vector, but for its sign, though the start depends on the rows of each rank."""
    found, env = [], importing_environment()
    for ranks in (1, 2):
        command = [*mpirun(ranks), sys.executable, __file__]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
        assert done.returncode == 0, done.stderr
        found.append(np.loadtxt(done.stdout.splitlines()))
    for other in found[1:]:
        for one, same, distance in zip(found[0], other, DISTANCE.values(), strict=True):
            assert same[0] == pytest.approx(one[0], rel=1e-11, abs=1e-13)
            assert same[1:] == pytest.approx(one[1:], abs=2 * modes.TOLERANCE / distance)


if __name__ == "__main__":
    shared()

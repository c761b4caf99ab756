"""Lowest eigenpairs of matrices whose spectra are known."""

import numpy as np
import pytest
from continuation.toys import pitchfork, snap_through
from petsc4py import PETSc

from magshell_fenicsx.continuation.modes import ModesNotFound, lowest_modes, null_vector

N, HELD = 60, 7


def matrix(entries: np.ndarray) -> PETSc.Mat:
    n = len(entries)
    A = PETSc.Mat().createAIJ([n, n], comm=PETSc.COMM_SELF)
    A.setUp()
    A.setValues(range(n), range(n), entries.ravel())
    A.assemble()
    A.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return A


def pencil(spectrum: list[float]) -> tuple[PETSc.Mat, PETSc.Mat]:
    """Dense K and M with the given lowest eigenvalues, the others 10, 11, ...; one unknown is held."""
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
    """The lowest four, or all negative ones; the held unknown's own eigenvalue 1 is not among them."""
    K, M = pencil(spectrum)
    modes = lowest_modes(K, M, 4)
    expected = sorted(spectrum)[: max(4, sum(value < 0 for value in spectrum))]
    assert [mode.eigenvalue for mode in modes] == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(spectrum).max())


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
    """More modes than there are: all of them, as NumPy finds them."""
    K, M = pencil([-1.0, -1.0])
    modes = lowest_modes(K, M, 2 * N)
    assert len(modes) == N - 1
    assert sum(mode.eigenvalue < 0 for mode in modes) == 2
    assert modes[-1].eigenvalue == pytest.approx(10.0 + N - 4, rel=1e-9)


def test_toys() -> None:
    """Closed forms: 3 u^2 - 6 u + 2 of the arch; 1 and 1 - u of the straight column."""
    arch, column = snap_through(), pitchfork()
    for u in (0.2, 1.0, 1.8):
        (mode,) = lowest_modes(arch.tangent(np.array([u]), {"load": 0.0}), matrix(np.eye(1)), 3)
        assert mode.eigenvalue == pytest.approx(3 * u**2 - 6 * u + 2, rel=1e-12)
    for u in (0.4, 0.999, 1.5):
        first, second = lowest_modes(column.tangent(np.array([u, 0.0]), {"load": 0.0}), matrix(np.eye(2)), 2)
        assert first.eigenvalue == pytest.approx(1 - u, rel=1e-9)
        assert second.eigenvalue == pytest.approx(1.0, rel=1e-12)
        assert abs(first.vector) == pytest.approx([0, 1], abs=1e-9)


def test_null_vector_of_a_nearly_singular_matrix() -> None:
    K, M = pencil([-3.0, 1e-10, 2.0])
    v, mode = null_vector(K), lowest_modes(K, M, 2)[1]
    assert np.linalg.norm(v) == pytest.approx(1.0)
    assert abs(v @ mode.vector) == pytest.approx(np.linalg.norm(mode.vector), rel=1e-6)


def test_spectrum_without_a_lower_end_is_refused() -> None:
    """An unknown without mass and with negative stiffness lies below every shift."""
    with pytest.raises(ModesNotFound, match="below"):
        lowest_modes(matrix(np.diag([1.0, 2.0, -1.0])), matrix(np.diag([1.0, 1.0, 0.0])), 2)

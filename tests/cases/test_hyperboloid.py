"""Lee and Bathe's hyperboloid: two discretisations, in both regimes, and what happens as it gets
thin.
"""

import pytest
from benchmarks.hyperboloid import CASE, Edge, energy, reference

from magshell_fenicsx import Case


@pytest.mark.parametrize(
    ("edge", "coarse", "fine"),
    [pytest.param("clamped", 8e-3, 2e-4, marks=pytest.mark.slow), ("free", 2e-4, 2e-5)],
)
def test_triangles_and_meridian(edge: Edge, coarse: float, fine: float) -> None:
    """The energy of "hyperboloid.yaml" at R/h = 100 on two meshes, against the meridian's waves."""
    assert Case.load(CASE).symmetry == "auto"
    exact = reference(edge, 100)
    for size, error in ((0.4, coarse), (0.2, fine)):
        assert energy(edge, 100, size) == pytest.approx(exact, rel=error)


@pytest.mark.slow
def test_thinner() -> None:
    """Bent without stretching; on a fixed mesh the error grows with R/h, here to 3e-5
    (docs/hyperboloid).
    """
    assert energy("free", 1000, 0.2) == pytest.approx(reference("free", 1000), rel=1e-4)


def test_graded_meshes_do_not_lock() -> None:
    """With clamped edges, where a uniform mesh with as many cells around has an error of 0.8 %
    (docs/hyperboloid).
    """
    for R_over_h in (10, 10000):
        assert energy("clamped", R_over_h, 0.4, graded=True) == pytest.approx(
            reference("clamped", R_over_h), rel=5e-4
        )

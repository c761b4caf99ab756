"""Random pushes of a sheet that folds on itself: it intersects itself at no accepted point, by a
test of triangles.
"""

from pathlib import Path

import numpy as np
import pytest
import pyvista
from benchmarks.pushes import distances, passing, push


def test_the_test_of_triangles() -> None:
    """Against VTK's filter for collisions."""
    one, other = np.random.default_rng(0).uniform(0, 1, (2, 60, 3, 3))
    meshes = [[pyvista.PolyData(x, faces=[3, 0, 1, 2]) for x in each] for each in (one, other)]
    collide = [a.collision(b)[1] > 0 for a, b in zip(*meshes, strict=True)]
    assert 10 < sum(collide) < 50
    assert passing(one, other).tolist() == collide


def test_the_distance_of_triangles() -> None:
    """Against the nearest of many places of both."""
    one, other = np.random.default_rng(1).uniform(0, 1, (2, 8, 3, 3)) + np.array([0, 0, 1.5])[
        None, None
    ] * [
        [[[0]]],
        [[[1]]],
    ]
    n = 40
    X = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
    apart = np.linalg.norm((X @ one)[:, :, None] - (X @ other)[:, None], axis=3).min(axis=(1, 2))
    found = distances(one, other)
    assert np.all(found <= apart + 1e-12)
    np.testing.assert_allclose(found, apart, rtol=1e-2)


@pytest.mark.slow
def test_faces_do_not_pass_through_each_other(tmp_path: Path) -> None:
    """It folds so tightly that cells that have a corner in common touch each other: once faces
    overlapped by 0.1 h.
    """
    pushed = push(tmp_path, 21)
    assert pushed.why in ("target", "fold")
    assert pushed.intersections == 0
    assert pushed.gap > -0.04

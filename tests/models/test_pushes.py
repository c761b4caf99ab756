"""Random pushes of a sheet that folds on itself: it intersects itself at no accepted point, by a test of triangles."""

from pathlib import Path

import numpy as np
import pytest
from benchmarks.pushes import crossings, push


def test_the_test_of_triangles() -> None:
    flat = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    upright = np.array([[[0.2, 0.2, -0.1], [0.3, 0.2, 0.1], [0.2, 0.3, 0.1]]])
    assert crossings(flat, upright)
    assert not crossings(flat, upright + np.array([0, 0, 0.2]))
    both, apart = np.concatenate([flat, upright]), np.array([[False, True], [False, False]])
    assert crossings(both, both, apart) == crossings(flat, upright)
    assert not crossings(both, both, np.zeros((2, 2), dtype=bool))


@pytest.mark.slow
def test_nothing_passes_through(tmp_path: Path) -> None:
    """One of those that `benchmarks.pushes` does, to its end."""
    pushed = push(tmp_path, 2)
    assert not pushed.stopped
    assert pushed.factor == 1
    assert pushed.touching >= 2  # of 16 points: steps in contact are long
    assert pushed.crossings == 0

"""Edges of elements along the rim of a dimple beside the pole, on a coarse mesh
(docs/study/rims.md).
"""

import pytest
from benchmarks.rims import knockdown


@pytest.mark.slow
def test_edges_along_the_rim() -> None:
    """A narrow dimple at 40 degrees on 100 cells, against k_d by refinement."""
    refined = 0.509727
    matched, across = (
        knockdown(1.64, 1.5, 0.35, "symmetry=half", matched=matched) for matched in (True, False)
    )
    assert matched == pytest.approx(refined, rel=8e-3)
    assert abs(across - refined) > 2 * abs(matched - refined)

"""Triangles of a contact rule."""

import numpy as np
import pytest

from magshell_fenicsx.parts.contact.segments import NOT_ON_EDGE, Triangles


def test_quarters_of_triangles_cover_them() -> None:
    """They have their areas and first moments together, and two of them an end of the side where
    the edge turns.
    """
    first, e1, e2 = np.random.default_rng(3).random((3, 5, 2))
    ends = np.array([NOT_ON_EDGE, 1, 2, 3, NOT_ON_EDGE])
    whole = Triangles(np.arange(5), 7 + np.arange(5), first, e1, e2, ends)
    quarters = whole.divide()
    middles = quarters.first + (quarters.e1 + quarters.e2) / 3
    for cell in range(5):
        of_cell = quarters.cell == cell
        assert quarters.faces[of_cell] == pytest.approx(7 + cell)
        assert quarters.size[of_cell] == pytest.approx(whole.size[cell] / 4)
        assert middles[of_cell].mean(axis=0) == pytest.approx(
            first[cell] + (e1[cell] + e2[cell]) / 3
        )
        end = ends[cell]
        at_ends = [NOT_ON_EDGE, NOT_ON_EDGE] if end == NOT_ON_EDGE else [end & 1, end & 2]
        assert sorted(quarters.ends[of_cell]) == sorted([NOT_ON_EDGE, NOT_ON_EDGE, *at_ends])

"""Where formulas are looked at more closely, on ranks that have nothing to look at."""

import basix
import numpy as np

from magshell_fenicsx.input.expressions import FormulaGroup, formula
from magshell_fenicsx.models.shell.adaptive_sampling import Lattice, SubCells, _sample


def test_a_rank_without_parts() -> None:
    """As of three ranks one often is, where few cells are divided."""
    lattice, none = (
        Lattice.make(basix.CellType.triangle, 4),
        SubCells(np.zeros(0, int), np.zeros((0, 2)), np.ones((0, 2))),
    )
    formulas = FormulaGroup([formula("exp(0.6*x + 0.8*y)"), formula("x")], None, 1.0)
    seen = _sample(
        formulas, none, lambda parts: (np.zeros((0, len(lattice.places), 3)), np.zeros(0)), lattice
    )
    assert seen.values.shape == (0, len(lattice.places), 2)
    assert seen.hidden.shape == (0,)

"""The compiled search for the places of cells that are nearest to points."""

import basix
import numpy as np
import pytest
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.parts.contact.projection import Cells, nearest_places, polynomial_bound

COUNT = 60
ELEMENT = basix.create_element(
    basix.ElementFamily.P, basix.CellType.triangle, 3, basix.LagrangeVariant.gll_warped
)
INSIDE = {"type": "ineq", "fun": lambda X: [1 - X[0] - X[1], X[0], X[1]]}


@pytest.mark.parametrize("parts", [3, 4])
def test_nearest_in_cells(parts: int) -> None:
    """Against SciPy's sequential quadratic programming, of curved cells of a constant thickness or
    of one that varies.

    Along the directions in which a place can move, the distance is stationary.
    """
    rng, k = np.random.default_rng(5), len(ELEMENT.points)
    flat = np.column_stack([ELEMENT.points, np.zeros((k, parts - 2))])
    r = (flat + 0.01 * rng.normal(size=(COUNT, k, parts))).reshape(-1, parts)
    x = rng.uniform([-0.2, -0.2, -0.1, 0.0][:parts], [0.8, 0.8, 0.1, 0.1][:parts], (COUNT, parts))
    each = np.arange(COUNT)
    cells = Cells(
        ELEMENT, np.arange(COUNT * k).reshape(COUNT, k), np.zeros((COUNT, 3), dtype=np.int64)
    )
    pair, at = nearest_places(
        cells, r, x, (each, each, np.ones(COUNT, dtype=np.int64), each), np.inf
    )
    assert list(pair) == list(each)
    kinds = at.free_directions.any(axis=1).sum(axis=1)
    assert min(np.bincount(kinds)) >= 3  # in corners, on sides, inside

    for n in each:

        def distance(X: NDArray[np.float64], n: int = n) -> float:
            y = ELEMENT.tabulate(0, X[None])[0, 0, :, 0] @ r[cells.nodes[n]]
            return float(np.linalg.norm(x[n, :3] - y[:3]) + (x[n] - y)[3:].sum())

        assert at.distance[n] == pytest.approx(distance(at.X[n]), abs=1e-13)
        best = scipy.optimize.minimize(
            distance, at.X[n], method="SLSQP", constraints=INSIDE, tol=1e-12
        )
        assert at.distance[n] < best.fun + 1e-9
        for way in at.free_directions[n].T:
            assert distance(at.X[n] + 1e-6 * way) == pytest.approx(
                distance(at.X[n] - 1e-6 * way), abs=1e-12
            )


def test_a_bound_of_polynomials() -> None:
    """Between nodes they may be larger than there; against the largest of many places."""
    cells = Cells(ELEMENT, np.zeros((1, 10), dtype=np.int64), np.zeros((1, 3), dtype=np.int64))
    X = np.random.default_rng(1).dirichlet(np.ones(3), 20000)[:, :2]
    values = np.random.default_rng(2).normal(size=(COUNT, len(ELEMENT.points)))
    largest = (values @ ELEMENT.tabulate(0, X)[0, :, :, 0].T).max(axis=1)
    bounds = [polynomial_bound(each[None], cells.lebesgue_constant) for each in values]
    assert (bounds >= largest).all()
    assert (largest > values.max(axis=1) + 0.1).any()
    assert polynomial_bound(np.full((2, 10), 0.7), cells.lebesgue_constant) == pytest.approx(0.7)

"""The lowest of several values raised: by linear programs of all planes that were seen
(studies/design/max_min.py).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.studies.design.evaluation import DesignEvaluation
from magshell_fenicsx.studies.design.max_min import raise_lowest

Array = NDArray[np.float64]
OBSERVABLES = 3  # of the values the lowest ones


@dataclass
class Eigenvalues:
    """The lowest eigenvalues of A0 + sum x_i A_i, which cross, with their slopes; `most` bounds the
    sum of x.
    """

    A: Array
    most: float

    def lowest_values(self, evaluation: DesignEvaluation) -> Array:
        return np.array([value for value, _ in evaluation.beside["all"]])

    def lowest_slopes(self, evaluation: DesignEvaluation) -> Array:
        return np.array([slope for _, slope in evaluation.beside["all"]])

    def constraints(self, evaluation: DesignEvaluation) -> Array:
        return np.array([evaluation.values["left"]])

    def constraint_slopes(self, evaluation: DesignEvaluation) -> Array:
        return -np.ones((1, len(self.A) - 1))

    def of(self, x: Array) -> Array:
        return np.asarray(np.tensordot(np.concatenate([[1.0], x]), self.A, 1))

    def evaluated(self, tried: list[Array]) -> Callable[[Array], DesignEvaluation]:
        """An evaluation; the second one is lost."""

        def evaluate(x: Array) -> DesignEvaluation:
            tried.append(x)
            if len(tried) == 2:
                return DesignEvaluation()
            values, vectors = np.linalg.eigh(self.of(x))
            slopes = [[float(v @ A @ v) for A in self.A[1:]] for v in vectors.T[:OBSERVABLES]]
            beside = [
                (float(value), slope)
                for value, slope in zip(values[:OBSERVABLES], slopes, strict=True)
            ]
            return DesignEvaluation({"left": self.most - float(x.sum())}, beside={"all": beside})

        return evaluate


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_eigenvalues_that_cross(seed: int) -> None:
    """The lowest eigenvalue is concave: the planes of all places, in all of the bounds, are a bound
    of its maximum.
    """
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(5, 8, 8))
    A = A + A.transpose(0, 2, 1)
    goal, tried = Eigenvalues(A, most=2.2), list[Array]()
    ended = raise_lowest(goal.evaluated(tried), goal, [(0.0, 1.0)] * 4, np.full(4, 0.5), 100)
    rows, sides = [np.array([1.0, 1.0, 1.0, 1.0, 0.0])], [goal.most]
    for x in tried:
        value, v = (each[..., 0] for each in np.linalg.eigh(goal.of(x)))
        slope = np.array([v @ of @ v for of in A[1:]])
        rows.append(np.append(-slope, 1.0))
        sides.append(value - slope @ x)
    most = -scipy.optimize.linprog(
        [0, 0, 0, 0, -1], rows, sides, bounds=[(0, 1)] * 4 + [(None, None)]
    ).fun
    kept = [x for x in [tried[0], *tried[2:]] if x.sum() <= goal.most + 1e-9]
    assert "foreseen" in ended
    assert max(np.linalg.eigvalsh(goal.of(x))[0] for x in kept) == pytest.approx(
        most, abs=1e-3 * abs(most)
    )
    assert np.linalg.eigvalsh(goal.of(tried[0]))[0] < most - 0.3


@dataclass
class Slight:
    """1 + x0 - 0.1 x1^2, with the constraint b (0.1 - x0) >= 0, that hardly depends on the
    variables.
    """

    b: float

    def lowest_values(self, evaluation: DesignEvaluation) -> Array:
        return np.array([evaluation.values["raised"]])

    def lowest_slopes(self, evaluation: DesignEvaluation) -> Array:
        return np.array([evaluation.gradients["raised"]])

    def constraints(self, evaluation: DesignEvaluation) -> Array:
        return np.array([evaluation.values["kept"]])

    def constraint_slopes(self, evaluation: DesignEvaluation) -> Array:
        return np.array([[-self.b, 0.0]])

    def evaluated(self, x: Array) -> DesignEvaluation:
        values = {"raised": 1 + x[0] - 0.1 * x[1] ** 2, "kept": self.b * (0.1 - x[0])}
        return DesignEvaluation(values, {"raised": [1.0, -0.2 * x[1]]})


@pytest.mark.parametrize("b", [0.2, 0.01])
def test_a_constraint_that_hardly_depends_on_the_variables(b: float) -> None:
    """The highest place is (0.1, 0), however small the slope of the constraint is."""
    goal, tried = Slight(b), list[Array]()

    def evaluate(x: Array) -> DesignEvaluation:
        tried.append(x)
        return goal.evaluated(x)

    raise_lowest(evaluate, goal, [(-1.0, 1.0)] * 2, np.array([0.0, 0.3]), 60)
    kept = [x for x in tried if x[0] <= 0.1 + 1e-6]
    assert max(1 + x[0] - 0.1 * x[1] ** 2 for x in kept) == pytest.approx(1.1, abs=1e-4)

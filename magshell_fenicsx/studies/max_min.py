"""The lowest of instabilities or frequencies raised as far as it goes, by all that is known of
each.

Their minimum has corners where two cross, and which are the lowest changes from place to place: an
optimiser of smooth functions leaps there, or stops. Here every value that was seen is a plane, by
its slope where it was seen. The highest place under the planes is tried next, in a box about the
best place so far: a bundle method with a trust region (Schramm and Zowe, SIAM J. Optim. 2, 121-152,
1992). SciPy's linear programming finds it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.studies.design_evaluation import DesignEvaluation

Array = NDArray[np.float64]

FIRST_BOX_SIZE, MAX_BOX_SIZE = (
    0.25,
    1.0,
)  # half the side of the box, over the half ranges of variables, or in radians
# an old plane is at least so many squares of the distance above the best place, over its value at
# the start
CURVATURE_BOUND = 0.3
MAX_PLANES = 60  # places whose planes count
PENALTY_RANGE = (
    10.0,
    1e6,
)  # times what a constraint is broken by counts, beside the values; as often as it must, up to this
CONSTRAINT_TOLERANCE = 1e-9  # a constraint that is broken by less is kept
ACCEPTED_GAIN_RATIO, GROWING_GAIN_RATIO = (
    0.05,
    0.7,
)  # of the gain that was foreseen: a place is taken, the box grows
MIN_GAIN = 1e-5  # a gain, over the value at the start


class MaxMinGoal(Protocol):
    """Values to be raised and constraints that must not be negative, scaled with their sizes at the
    start.
    """

    def lowest_values(self, evaluation: DesignEvaluation) -> Array: ...
    def lowest_slopes(self, evaluation: DesignEvaluation) -> Array: ...
    def constraints(self, evaluation: DesignEvaluation) -> Array: ...
    def constraint_slopes(self, evaluation: DesignEvaluation) -> Array: ...


@dataclass(frozen=True)
class _EvaluatedPoint:
    """Values (n,) and constraints (m,) at a place, and their slopes by the variables over their
    spans.
    """

    y: Array
    values: Array
    slopes: Array
    constraints: Array
    constraint_slopes: Array

    def height(self, broken: float) -> float:
        """The lowest value, less what a broken constraint counts, times a factor."""
        return float(self.values.min() + broken * self.constraints.min(initial=0.0))


def raise_lowest(
    evaluated: Callable[[Array], DesignEvaluation],
    goal: MaxMinGoal,
    limits: Sequence[tuple[float | None, float | None]],
    first: Array,
    iterations: int,
) -> str:
    """Evaluate places that raise the lowest value, each after the one before; why it ended.

    Parameters
    ----------
    evaluated
        An evaluation without values is that of a lost path.
    limits
        Bounds of the variables; None: none.
    first
        Has values.
    iterations
        The most evaluations after that of `first`.
    """
    low, high = (np.array(side, dtype=float) for side in zip(*limits, strict=True))
    low, high = np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)
    span = np.where(np.isfinite(high - low) & (high > low), (high - low) / 2, 1.0)

    def place(x: Array) -> _EvaluatedPoint | None:
        evaluation = evaluated(x)
        if not evaluation.values:
            return None
        constraints = goal.constraints(evaluation)
        constraint_slopes = (
            span * goal.constraint_slopes(evaluation) if len(constraints) else np.zeros((0, len(x)))
        )
        values, slopes = goal.lowest_values(evaluation), span * goal.lowest_slopes(evaluation)
        return _EvaluatedPoint(x / span, values, slopes, constraints, constraint_slopes)

    best, size, (broken, most_broken) = place(first), FIRST_BOX_SIZE, PENALTY_RANGE
    assert best
    others: list[_EvaluatedPoint] = []
    for _ in range(iterations):
        box = np.maximum(low / span - best.y, -size), np.minimum(high / span - best.y, size)
        step, gain, violation = _predicted_step(best, others[-MAX_PLANES:], box, broken)
        while violation > CONSTRAINT_TOLERANCE and broken < most_broken:
            further = _predicted_step(best, others[-MAX_PLANES:], box, 10 * broken)
            if (
                further[2] > violation / 2
            ):  # all is done for the constraints that can be done in the box
                break
            broken, (step, gain, violation) = 10 * broken, further
        if gain < MIN_GAIN:
            box_text = f"within {size:.2g} of the variables' ranges"
            return f"no more than {MIN_GAIN:g} of the value at the start is foreseen to be gained {box_text}"
        tried = place(np.clip(span * (best.y + step), low, high))
        part = (tried.height(broken) - best.height(broken)) / gain if tried else -np.inf
        if part > ACCEPTED_GAIN_RATIO:
            assert tried
            best, tried = tried, best
        others += [tried] if tried else []
        if part > GROWING_GAIN_RATIO:
            size = min(2 * size, MAX_BOX_SIZE)
        elif part <= ACCEPTED_GAIN_RATIO:
            size /= 2 if part > -1 else 4
    return "iteration limit reached"


def _predicted_step(
    best: _EvaluatedPoint,
    others: Sequence[_EvaluatedPoint],
    box: tuple[Array, Array],
    broken: float,
) -> tuple[Array, float, float]:
    """The step to the highest place under all planes, see `_EvaluatedPoint.height`; the gain; what
    constraints are broken by.
    """
    planes, slopes = [best.values], [best.slopes]
    for other in others:
        offset = best.y - other.y
        lowest = (
            best.values.min() + CURVATURE_BOUND * offset @ offset
        )  # values bend: a plane from afar may be below what is known
        planes.append(np.maximum(other.values + other.slopes @ offset, lowest))
        slopes.append(other.slopes)
    n, of_values, of_kept = len(best.y), sum(map(len, planes)), len(best.constraints)
    below_planes = np.column_stack([-np.vstack(slopes), np.ones(of_values), np.zeros(of_values)])
    constraint_rows = np.column_stack(
        [-best.constraint_slopes, np.zeros(of_kept), -np.ones(of_kept)]
    )
    program = (
        scipy.optimize.linprog(  # of the step, the height and what the constraints are broken by
            np.concatenate([np.zeros(n), [-1.0, broken]]),
            A_ub=np.vstack([below_planes, constraint_rows]),
            b_ub=np.concatenate([*planes, best.constraints]),
            bounds=[*zip(*box, strict=True), (None, None), (0.0, None)],
        )
    )
    return program.x[:n], float(-program.fun - best.height(broken)), float(program.x[-1])

"""Max-min optimisation: raise the lowest of several instabilities or frequencies.

The lowest value has a kink where two values cross, and which one is the lowest changes from point
to point. An optimiser of smooth functions stops there. Here every value and its slope, at every
evaluated point, define a plane. The next point is the highest one under all planes, in a box about
the best point so far. This is a bundle method with a trust region (Schramm and Zowe, SIAM J. Optim.
2, 121-152, 1992). SciPy's linear programming finds the point. See docs/theory.md.

The p variables x are scaled: y is x over half the range of each, so that the box has the side
2 `box_size` in y. The height of a point is its lowest value, less the penalty of violated
constraints; the gain of a step is the increase of the height, predicted by the planes. An
evaluation has no values if the equilibrium path is lost.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.studies.design.evaluation import DesignEvaluation

Array = NDArray[np.float64]

# half the side of the box, over half the range of a variable, or in radians for angles
FIRST_BOX_SIZE, MAX_BOX_SIZE = 0.25, 1.0
# Values are curved, so a plane from afar may lie below them: an old plane counts as at least this
# many squares of the distance above the best point, over the value at the start.
CURVATURE_BOUND = 0.3
MAX_PLANES = 60  # number of evaluated points whose planes are used
# first and largest factor of the violation of a constraint in the height of a point
PENALTY_RANGE = 10.0, 1e6
CONSTRAINT_TOLERANCE = 1e-9  # a constraint with a smaller violation is satisfied
ACCEPTED_GAIN_RATIO = 0.05  # gain over predicted gain from which a point is accepted
GROWING_GAIN_RATIO = 0.7  # gain over predicted gain from which the box grows
MIN_GAIN = 1e-5  # smallest predicted gain, over the value at the start


class MaxMinGoal(Protocol):
    """What `raise_lowest` needs of a goal: values whose lowest is raised, and constraints.

    Constraints must not be negative. All are scaled with their sizes at the start.
    """

    def lowest_values(self, evaluation: DesignEvaluation) -> Array: ...
    def lowest_slopes(self, evaluation: DesignEvaluation) -> Array: ...
    def constraints(self, evaluation: DesignEvaluation) -> Array: ...
    def constraint_slopes(self, evaluation: DesignEvaluation) -> Array: ...


@dataclass(frozen=True)
class _EvaluatedPoint:
    """A point of the search, at which values define planes.

    Attributes
    ----------
    y
        (p,) variables over half their ranges.
    values, constraints
        (n,) values, of which the lowest counts, and (m,) constraints.
    slopes, constraint_slopes
        (n, p) and (m, p) derivatives by y.
    """

    y: Array
    values: Array
    slopes: Array
    constraints: Array
    constraint_slopes: Array

    def height(self, penalty: float) -> float:
        """Return the lowest value less the penalty of the largest violation of a constraint."""
        return float(self.values.min() + penalty * self.constraints.min(initial=0.0))


def raise_lowest(
    evaluated: Callable[[Array], DesignEvaluation],
    goal: MaxMinGoal,
    limits: Sequence[tuple[float | None, float | None]],
    first: Array,
    iterations: int,
) -> str:
    """Raise the lowest value from point to point; return why the search ended.

    Parameters
    ----------
    evaluated
        Evaluates variables (p,); without values if the path is lost.
    limits
        Lower and upper bounds of the variables; None where there is none.
    first
        Variables (p,) of the first point, whose evaluation has values.
    iterations
        Largest number of evaluations after that of `first`.
    """
    low, high, span = _bounds_and_spans(limits)

    def evaluate_point(x: Array) -> _EvaluatedPoint | None:
        """Return values and slopes at variables x (p,); None if the path is lost."""
        evaluation = evaluated(x)
        if not evaluation.values:
            return None
        constraints = goal.constraints(evaluation)
        constraint_slopes = (
            span * goal.constraint_slopes(evaluation) if len(constraints) else np.zeros((0, len(x)))
        )
        values, slopes = goal.lowest_values(evaluation), span * goal.lowest_slopes(evaluation)
        return _EvaluatedPoint(x / span, values, slopes, constraints, constraint_slopes)

    best = evaluate_point(first)
    assert best
    box_size, penalty = FIRST_BOX_SIZE, PENALTY_RANGE[0]
    earlier_points: list[_EvaluatedPoint] = []
    for _ in range(iterations):
        # least and largest step within the bounds and the box about the best point
        low_step, high_step = low / span - best.y, high / span - best.y
        box = np.maximum(low_step, -box_size), np.minimum(high_step, box_size)
        step, gain, penalty = _penalised_step(best, earlier_points[-MAX_PLANES:], box, penalty)
        if gain < MIN_GAIN:
            box_text = f"within {box_size:.2g} of the variables' ranges"
            return (
                f"no more than {MIN_GAIN:g} of the value at the start is foreseen to be gained "
                f"{box_text}"
            )
        next_point = evaluate_point(np.clip(span * (best.y + step), low, high))
        gain_ratio = (
            (next_point.height(penalty) - best.height(penalty)) / gain if next_point else -np.inf
        )
        if gain_ratio > ACCEPTED_GAIN_RATIO:
            assert next_point
            best, next_point = next_point, best  # the old best is then an earlier point
        earlier_points += [next_point] if next_point else []
        # the box grows where the prediction was good, and shrinks where no point was accepted
        if gain_ratio > GROWING_GAIN_RATIO:
            box_size = min(2 * box_size, MAX_BOX_SIZE)
        elif gain_ratio <= ACCEPTED_GAIN_RATIO:
            box_size /= 2 if gain_ratio > -1 else 4  # by more where the prediction was far off
    return "iteration limit reached"


def _bounds_and_spans(
    limits: Sequence[tuple[float | None, float | None]],
) -> tuple[Array, Array, Array]:
    """Return lower and upper bounds (p,), infinite where there is none, and half the ranges (p,).

    The latter are 1 for variables without bounds, such as angles.
    """
    low, high = (np.array(side, dtype=float) for side in zip(*limits, strict=True))
    # no bound: None has become nan
    low, high = np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)
    span = np.where(np.isfinite(high - low) & (high > low), (high - low) / 2, 1.0)
    return low, high, span


def _penalised_step(
    best: _EvaluatedPoint,
    others: Sequence[_EvaluatedPoint],
    box: tuple[Array, Array],
    penalty: float,
) -> tuple[Array, float, float]:
    """Predict the step to the highest point under all planes, with a penalty that is large enough.

    The penalty is raised as long as this helps. A larger penalty helps if it lowers the remaining
    violation to half of it or less.

    Parameters
    ----------
    others
        Earlier points, whose planes count too.
    box
        Least and largest step, (p,) each.
    penalty
        Factor of the largest violation of a constraint, to begin with.

    Returns
    -------
    step, gain
        (p,) in scaled variables, and the predicted gain.
    penalty
        The penalty with which they were predicted.
    """
    max_penalty = PENALTY_RANGE[1]
    step, gain, violation = _predicted_step(best, others, box, penalty)
    while violation > CONSTRAINT_TOLERANCE and penalty < max_penalty:
        penalised_step = _predicted_step(best, others, box, 10 * penalty)
        _, _, penalised_violation = penalised_step
        # the violation hardly falls: constraints cannot be satisfied within the box
        if penalised_violation > violation / 2:
            break
        penalty, (step, gain, violation) = 10 * penalty, penalised_step
    return step, gain, penalty


def _predicted_step(
    best: _EvaluatedPoint,
    others: Sequence[_EvaluatedPoint],
    box: tuple[Array, Array],
    penalty: float,
) -> tuple[Array, float, float]:
    """Predict the step to the highest point under all planes, by linear programming.

    Parameters
    ----------
    others
        Earlier points, whose planes count too.
    box
        Least and largest step, (p,) each.
    penalty
        Factor of the largest violation of a constraint.

    Returns
    -------
    step
        (p,) in scaled variables.
    gain
        Predicted gain of `_EvaluatedPoint.height`.
    violation
        Largest violation of constraints that remains.
    """
    # heights of the planes at the best point, and their slopes
    planes, slopes = [best.values], [best.slopes]
    for other in others:
        offset = best.y - other.y
        # the least height of an old plane, by the bound of curvature
        lowest = best.values.min() + CURVATURE_BOUND * offset @ offset
        planes.append(np.maximum(other.values + other.slopes @ offset, lowest))
        slopes.append(other.slopes)
    # unknowns of the linear programme: the step (p,), the height t, and the largest violation v,
    # at least zero. -t + penalty v is minimised, with t - slope step <= plane for each plane, and
    # -slope step - v <= constraint for each linearised constraint
    variable_count, constraint_count = len(best.y), len(best.constraints)
    value_count = sum(map(len, planes))
    below_planes = np.column_stack(
        [-np.vstack(slopes), np.ones(value_count), np.zeros(value_count)]
    )
    constraint_rows = np.column_stack(
        [-best.constraint_slopes, np.zeros(constraint_count), -np.ones(constraint_count)]
    )
    program = scipy.optimize.linprog(
        np.concatenate([np.zeros(variable_count), [-1.0, penalty]]),
        A_ub=np.vstack([below_planes, constraint_rows]),
        b_ub=np.concatenate([*planes, best.constraints]),
        bounds=[*zip(*box, strict=True), (None, None), (0.0, None)],
    )
    gain = float(-program.fun - best.height(penalty))
    return program.x[:variable_count], gain, float(program.x[-1])

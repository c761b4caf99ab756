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

from magshell_fenicsx.studies.design_evaluation import Evaluation

Array = NDArray[np.float64]

FIRST, LARGEST = (
    0.25,
    1.0,
)  # half the side of the box, over the half ranges of variables, or in radians
# an old plane is at least so many squares of the distance above the best place, over its value at
# the start
BENT = 0.3
REMEMBERED = 60  # places whose planes count
BROKEN = (
    10.0,
    1e6,
)  # times what a constraint is broken by counts, beside the values; as often as it must, up to this
KEPT = 1e-9  # a constraint that is broken by less is kept
TAKEN, GOOD = 0.05, 0.7  # of the gain that was foreseen: a place is taken, the box grows
ENOUGH = 1e-5  # a gain, over the value at the start


class Raised(Protocol):
    """What is raised, of an evaluation, and what must not become negative; over their sizes at the
    start.
    """

    def lowest_values(self, evaluation: Evaluation) -> Array: ...
    def lowest_slopes(self, evaluation: Evaluation) -> Array: ...
    def constraints(self, evaluation: Evaluation) -> Array: ...
    def constraint_slopes(self, evaluation: Evaluation) -> Array: ...


@dataclass(frozen=True)
class _Place:
    """Values (n,) and constraints (m,) at a place, and their slopes by the variables over their
    spans.
    """

    y: Array
    values: Array
    slopes: Array
    kept: Array
    kept_slopes: Array

    def height(self, broken: float) -> float:
        """The lowest value, less what a broken constraint counts, times a factor."""
        return float(self.values.min() + broken * self.kept.min(initial=0.0))


def raise_lowest(
    evaluated: Callable[[Array], Evaluation],
    goal: Raised,
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

    def place(x: Array) -> _Place | None:
        evaluation = evaluated(x)
        if not evaluation.values:
            return None
        kept = goal.constraints(evaluation)
        kept_slopes = (
            span * goal.constraint_slopes(evaluation) if len(kept) else np.zeros((0, len(x)))
        )
        values, slopes = goal.lowest_values(evaluation), span * goal.lowest_slopes(evaluation)
        return _Place(x / span, values, slopes, kept, kept_slopes)

    best, size, (broken, most_broken) = place(first), FIRST, BROKEN
    assert best
    others: list[_Place] = []
    for _ in range(iterations):
        box = np.maximum(low / span - best.y, -size), np.minimum(high / span - best.y, size)
        step, gain, left = _foreseen(best, others[-REMEMBERED:], box, broken)
        while left > KEPT and broken < most_broken:
            further = _foreseen(best, others[-REMEMBERED:], box, 10 * broken)
            if further[2] > left / 2:  # all is done for the constraints that can be done in the box
                break
            broken, (step, gain, left) = 10 * broken, further
        if gain < ENOUGH:
            near = f"within {size:.2g} of the variables' ranges"
            return (
                f"no more than {ENOUGH:g} of the value at the start is foreseen to be gained {near}"
            )
        tried = place(np.clip(span * (best.y + step), low, high))
        part = (tried.height(broken) - best.height(broken)) / gain if tried else -np.inf
        if part > TAKEN:
            assert tried
            best, tried = tried, best
        others += [tried] if tried else []
        if part > GOOD:
            size = min(2 * size, LARGEST)
        elif part <= TAKEN:
            size /= 2 if part > -1 else 4
    return "iteration limit reached"


def _foreseen(
    best: _Place, others: Sequence[_Place], box: tuple[Array, Array], broken: float
) -> tuple[Array, float, float]:
    """The step to the highest place under all planes, see `_Place.height`; the gain; what
    constraints are broken by.
    """
    planes, slopes = [best.values], [best.slopes]
    for other in others:
        away = best.y - other.y
        lowest = (
            best.values.min() + BENT * away @ away
        )  # values bend: a plane from afar may be below what is known
        planes.append(np.maximum(other.values + other.slopes @ away, lowest))
        slopes.append(other.slopes)
    n, of_values, of_kept = len(best.y), sum(map(len, planes)), len(best.kept)
    under = np.column_stack([-np.vstack(slopes), np.ones(of_values), np.zeros(of_values)])
    within = np.column_stack([-best.kept_slopes, np.zeros(of_kept), -np.ones(of_kept)])
    program = (
        scipy.optimize.linprog(  # of the step, the height and what the constraints are broken by
            np.concatenate([np.zeros(n), [-1.0, broken]]),
            A_ub=np.vstack([under, within]),
            b_ub=np.concatenate([*planes, best.kept]),
            bounds=[*zip(*box, strict=True), (None, None), (0.0, None)],
        )
    )
    return program.x[:n], float(-program.fun - best.height(broken)), float(program.x[-1])

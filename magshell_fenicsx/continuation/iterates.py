"""Convergence of Newton's method, judged by the steps alone.

The residual does not measure the error: rounding of the stiff part of a structure hides errors of its soft part.
The next step measures the error if its matrix is good: P. Deuflhard, Newton Methods for Nonlinear Problems,
Springer 2004, sec. 2.1.4 (QNERR). Sizes are in lengths of the system.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Verdict = Literal["go on", "converged", "diverged", "rounding", "too many"]
FULL = 0.5  # a step longer than this part of the one before shows no quadratic convergence
SMALL = 1e-3  # full Newton steps below this size shrink, unless they are rounding
GAIN = 0.1  # of the first step, to which steps must have shrunk after `patience` matrices
ROUNDING = 10.0  # steps up to this many times the rounding error count as rounding


@dataclass(frozen=True)
class Step:
    """The next step at an iterate.

    Attributes
    ----------
    size
        Size of the step, see `Bordered.size`.
    own
        Whether the matrix was computed at this iterate.
    """

    size: float
    own: bool


@dataclass
class Iterates:
    """The steps of one solve.

    Parameters
    ----------
    largest
        A longer step counts as divergence.
    most
        Iterations after which the solve is given up.
    patience
        Matrices after which steps must have shrunk.
    """

    largest: float = np.inf
    most: int = 0
    patience: int = 4
    steps: list[Step] = field(default_factory=list)

    def judge(self, tolerance: float, rounding: Callable[[], float]) -> Verdict:
        """The verdict on the iterate, from the last step.

        Parameters
        ----------
        tolerance
            Of the iterate's error.
        rounding
            Computes the error from rounding of the residual.
        """
        step, before = self.steps[-1], self.steps[:-1]
        if not step.size <= self.largest:
            return "diverged"
        if step.size <= tolerance:
            return "converged"
        full = [s.size for s in before if s.own]
        stalled = step.own and before and before[-1].own and FULL * before[-1].size < step.size < SMALL
        if stalled and step.size <= ROUNDING * rounding():
            return "rounding"
        if step.own and len(before) > 2 and step.size > 2 * full[-1]:
            return "diverged"
        if step.own and len(full) >= self.patience and step.size > GAIN * full[0]:
            return "diverged"
        return "too many" if len(before) >= self.most else "go on"

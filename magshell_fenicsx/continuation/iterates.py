"""When a sequence of Newton's steps has converged, judged by the steps alone.

The residual is no measure of the error: where a structure is soft, the rounding of its stiff part hides
it. The next step is one, if the matrix that it is made with is good: P. Deuflhard, Newton Methods for
Nonlinear Problems, Springer 2004, sec. 2.1.4 (QNERR). Sizes are in lengths of the system.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Verdict = Literal["go on", "converged", "diverged", "rounding", "too many"]
FULL = 0.5  # a step as long as this part of the one before has not converged quadratically
SMALL = 1e-3  # steps that small of full Newton iterations shrink, but for rounding
PATIENCE, GAIN = 4, 0.1  # after so many matrices the steps must have shrunk to this part of the first
ROUNDING = 10.0  # steps up to this many times the rounding error are taken for it


@dataclass(frozen=True)
class Step:
    """A step that an iterate asks for.

    Attributes
    ----------
    size
        Of du.
    own
        Whether the matrix is that of the iterate itself.
    """

    size: float
    own: bool


@dataclass
class Iterates:
    """The steps of one solve.

    Parameters
    ----------
    largest
        A step that is longer is a divergence.
    most
        Iterations after which the solve is given up.
    """

    largest: float = np.inf
    most: int = 0
    steps: list[Step] = field(default_factory=list)

    def judge(self, tolerance: float, rounding: Callable[[], float]) -> Verdict:
        """What the last step says of the iterate.

        Parameters
        ----------
        tolerance
            Of the iterate's error.
        rounding
            Gives the error that rounding of the residual makes.
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
        if step.own and len(full) >= PATIENCE and step.size > GAIN * full[0]:
            return "diverged"
        return "too many" if len(before) >= self.most else "go on"

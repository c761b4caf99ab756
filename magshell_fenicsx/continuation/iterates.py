"""Convergence of one Newton solve, judged by the sizes of its steps alone.

Each step has its size in lengths of the system, and whether its matrix was computed at the same
iterate. From these `Iterates.judge` decides whether the solve has converged, goes on, or is given
up (P. Deuflhard, Newton Methods for Nonlinear Problems, Springer 2004, sec. 2.1.4).

A matrix that was computed at the iterate is its own; a matrix of an earlier iterate is kept while
the steps shrink. Negative pivots of a new matrix count unstable directions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np

DIVERGENCE_RATIO = 2.0  # a step that is longer than the previous one by this factor diverges
QUADRATIC_RATIO = 0.5  # a larger ratio of successive full steps shows no quadratic convergence
SMALL_STEP = 1e-3  # full Newton steps below this size shrink, unless they are rounding
PATIENCE_RATIO = 0.1  # of the first step, to which steps must have shrunk after `patience` matrices
# matrices within which a step must be halved, or an early-stopping solve is given up
MAX_MATRICES_TO_HALVE = 5
# two successive ratios below this one allow extrapolation of the error; one may be by chance
EXTRAPOLATION_RATIO = 0.1
EXTRAPOLATED_TOLERANCE = 0.1  # fraction of the tolerance, for an error that is extrapolated
ROUNDING_FACTOR = 10.0  # steps up to this many times the rounding error count as rounding

Verdict = Literal["go on", "converged", "diverged", "far", "rounding"]


@dataclass(frozen=True)
class NewtonStep:
    """The next step at an iterate of Newton's method, by its size.

    Attributes
    ----------
    size
        Size of the step in lengths of the system: the larger one of its displacement and of its
        change of the amplitude.
    is_own
        Whether the matrix was computed at this iterate.
    pivots
        Number of negative pivots of a new matrix; 0 if the matrix was kept.
    """

    size: float
    is_own: bool
    pivots: int = 0


@dataclass
class Iterates:
    """The steps of one solve, in lengths of the system, by which its convergence is judged.

    Attributes
    ----------
    largest
        A longer step counts as divergence.
    patience
        Number of matrices after which steps must have shrunk.
    searched
        Whether a line search shortens the steps: then they may grow.
    kinks
        Whether convergence may suddenly slow down: then no error is extrapolated.
    stops_early
        Whether the solve is given up early where a shorter step of the path costs less.
    relative_tolerance
        Fraction of the first step; an error of that size is accepted.
    steps
        The next step at each iterate so far; a new one is appended before `judge` is called.
    allowed
        The extrapolated error up to which the last iterate was accepted.
    """

    largest: float = np.inf
    patience: int = 4
    searched: bool = False
    kinks: bool = False
    stops_early: bool = False
    relative_tolerance: float = 0.0
    steps: list[NewtonStep] = field(default_factory=list)
    allowed: float = 0.0

    @property
    def extrapolated_error(self) -> float:
        """The error after the last step, extrapolated from the last two ratios.

        One small ratio is not enough: bending may converge at once and hide that stretching
        converges slowly.
        """
        if self.kinks or self.searched or len(self.steps) < 3:
            return np.inf
        ratio = max(b.size / a.size for a, b in pairwise(self.steps[-3:]))
        # the sum of a geometric series, where all further steps shrink like these
        return self.steps[-1].size * ratio / (1 - ratio) if ratio <= EXTRAPOLATION_RATIO else np.inf

    @property
    def error(self) -> float:
        """The estimated error after the last step; if extrapolated, at least what was allowed."""
        if not self.steps:
            return np.inf
        return min(self.steps[-1].size, max(self.extrapolated_error, self.allowed))

    def judge(self, tolerance: float, rounding: Callable[[], float]) -> Verdict:
        """Return the verdict on the last iterate, from the sizes of all steps.

        "far" means that a shorter step of the path should be tried. "rounding" means that rounding
        hides the solution.

        Parameters
        ----------
        tolerance
            Largest error of the iterate, in lengths of the system.
        rounding
            Computes the error from rounding of the residual, in lengths; expensive.
        """
        step, earlier = self.steps[-1], self.steps[:-1]
        tolerance = max(tolerance, self.relative_tolerance * self.steps[0].size)
        if not step.size <= self.largest:
            return "far" if self.stops_early else "diverged"
        # the step is small, or the error after it is extrapolated to be small
        longest = max(step.size for step in self.steps)
        self.allowed = EXTRAPOLATED_TOLERANCE * tolerance * min(1.0, longest)
        if step.size <= tolerance or self.extrapolated_error <= self.allowed:
            return "converged"
        # only steps with a new matrix show that the solve does not converge
        if not step.is_own:
            return "go on"
        # the earlier steps with a matrix of their own
        earlier_own = [s for s in earlier if s.is_own]
        if self.stops_early and self._leads_astray(earlier_own, step):
            return "far"
        if earlier and earlier[-1].is_own:
            # two full steps in turn, small but not shrinking
            stalled = QUADRATIC_RATIO * earlier[-1].size < step.size < SMALL_STEP
            if stalled and step.size <= ROUNDING_FACTOR * rounding():
                return "rounding"
        sizes = [s.size for s in earlier_own]
        grows = bool(sizes) and step.size > DIVERGENCE_RATIO * sizes[-1]
        # the first steps, and steps that a line search shortens, may grow
        may_grow = len(earlier) <= 2 or self.searched
        if grows and not may_grow:
            return "diverged"
        if len(sizes) >= self.patience and step.size > PATIENCE_RATIO * sizes[0]:
            return "diverged"
        return "go on"

    def _leads_astray(self, earlier: Sequence[NewtonStep], step: NewtonStep) -> bool:
        """Return whether steps with own matrices lead away, past an instability, or stay long.

        Parameters
        ----------
        earlier
            Earlier steps with own matrices.
        step
            The last step, with its own matrix.
        """
        if len(earlier) == 1 and step.pivots != earlier[0].pivots:
            # the iterate has other unstable directions than the first one. If they are more, it is
            # past an instability, and its step must shrink; if they are fewer, its step must only
            # stay bounded
            is_past = step.pivots > earlier[0].pivots
            allowed_ratio = QUADRATIC_RATIO if is_past else DIVERGENCE_RATIO
            return step.size > allowed_ratio * earlier[0].size
        # after some matrices the step must be half as long
        if len(earlier) < MAX_MATRICES_TO_HALVE:
            return False
        return step.size > QUADRATIC_RATIO * earlier[-MAX_MATRICES_TO_HALVE].size

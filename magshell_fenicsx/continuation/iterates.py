"""The steps of one solve by Newton's method, from which alone its convergence is judged."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np

GROWN = 2.0  # times as long as the one before, a step leads away
FULL = 0.5  # a step longer than this part of the one before shows no quadratic convergence
SMALL = 1e-3  # full Newton steps below this size shrink, unless they are rounding
GAIN = 0.1  # of the first step, to which steps must have shrunk after `patience` matrices
STUCK = 5  # matrices after which a step is not half as long: a hasty solve is given up
# steps that twice shrink more than to this part foresee the next ones; once may be by chance
STEADY = 0.1
SURE = 0.1  # part of the tolerance, for an error that is foreseen
ROUNDING = 10.0  # steps up to this many times the rounding error count as rounding

Verdict = Literal["go on", "converged", "diverged", "far", "rounding"]


def foreseen(sizes: Sequence[float], ratios: int) -> float:
    """The error after the last of some steps, if all further ones shrink as so many did; infinite
    if one shrank little.

    See P. Deuflhard, Newton Methods for Nonlinear Problems, Springer 2004, sec. 2.1.4.
    """
    rate = max(b / a for a, b in pairwise(sizes[-1 - ratios :])) if len(sizes) > ratios else np.inf
    return sizes[-1] * rate / (1 - rate) if rate <= STEADY else np.inf


@dataclass(frozen=True)
class Step:
    """The next step at an iterate.

    Attributes
    ----------
    size
        Size of the step, see `Bordered.size`.
    own
        Whether the matrix was computed at this iterate.
    pivots
        Its negative ones.
    """

    size: float
    own: bool
    pivots: int = 0


@dataclass
class Iterates:
    """The steps of one solve, in lengths of the system, from which alone its convergence is judged.

    Parameters
    ----------
    largest
        A longer step counts as divergence.
    patience
        Matrices after which steps must have shrunk.
    searched
        Whether a line search shortens them: then they may grow.
    kinks
        Whether steps may shrink suddenly less: then none is foreseen.
    hasty
        Whether the solve is given up early where a shorter step of the path costs less.
    rough
        Part of the first step up to which the error need not fall below.
    allowed
        The foreseen error up to which the last iterate was accepted.
    """

    largest: float = np.inf
    patience: int = 4
    searched: bool = False
    kinks: bool = False
    hasty: bool = False
    rough: float = 0.0
    steps: list[Step] = field(default_factory=list)
    allowed: float = 0.0

    @property
    def foreseen(self) -> float:
        """The error after the last step, where the last two ratios foresee it.

        Bending may converge at once and hide stretching, which converges slowly: so one small ratio
        foresees nothing.
        """
        return (
            np.inf
            if self.kinks or self.searched
            else foreseen([step.size for step in self.steps], 2)
        )

    @property
    def error(self) -> float:
        """The estimated error after the last step; where that was foreseen, no less than what was
        allowed.
        """
        return min(self.steps[-1].size, max(self.foreseen, self.allowed)) if self.steps else np.inf

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
        tolerance = max(tolerance, self.rough * self.steps[0].size)
        if not step.size <= self.largest:
            return "far" if self.hasty else "diverged"
        self.allowed = SURE * tolerance * min(1.0, max(step.size for step in self.steps))
        if step.size <= tolerance or self.foreseen <= self.allowed:
            return "converged"
        own = [s for s in before if s.own]
        full = [s.size for s in own]
        if self.hasty and step.own and self._astray(own, step):
            return "far"
        stalled = (
            step.own and before and before[-1].own and FULL * before[-1].size < step.size < SMALL
        )
        if stalled and step.size <= ROUNDING * rounding():
            return "rounding"
        if (
            step.own
            and len(before) > 2
            and full
            and step.size > GROWN * full[-1]
            and not self.searched
        ):
            return "diverged"
        if step.own and len(full) >= self.patience and step.size > GAIN * full[0]:
            return "diverged"
        return "go on"

    def _astray(self, before: Sequence[Step], step: Step) -> bool:
        """Whether steps with matrices of their own lead away, past an instability, or stay long."""
        if len(before) == 1 and step.pivots != before[0].pivots:
            past = (
                step.pivots > before[0].pivots
            )  # a shorter step of the path sees the instability, too
            return step.size > (FULL if past else GROWN) * before[0].size
        return len(before) >= STUCK and step.size > FULL * before[-STUCK].size

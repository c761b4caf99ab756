"""Steps in time up to a given time, of a fixed length or for a tolerance."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from magshell_fenicsx.continuation.motion import Motion
from magshell_fenicsx.continuation.transient import Integrator

ATONCE = 0.1  # part of what the balance may lack that one step may make
SPENT = 0.3  # of its share: a step after one that leaks more is not longer
SMALLEST = 1e-6  # of the first step
FINEST = 1e-9  # tolerance of a step


@dataclass(frozen=True)
class TimeSteps:
    """How long steps are.

    Attributes
    ----------
    fixed
        The longest step, which is halved where Newton's method fails, and doubled again after two
        steps that succeed; None: steps for the tolerance.
    tolerance
        Largest estimated error of a step, over the system's length (O. C. Zienkiewicz and Y. M.
        Xie, Earthquake Engineering and Structural Dynamics 20, 1991).
    first
        First step without `fixed`.
    balance
        Beside a body: what the balance of energy may lack, over its turnover.
    longest, fastest
        The longest step for the tolerance up to a time, as a rule that at which a motion is
        fastest.
    """

    fixed: float | None
    tolerance: float
    first: float
    balance: float = 1e-2
    longest: float = np.inf
    fastest: float = -np.inf

    def refined(self, part: float) -> "TimeSteps":
        """Steps that are shorter by this factor; below `FINEST` estimated errors are of the
        iterations.
        """
        return replace(
            self, tolerance=max(part**3 * self.tolerance, FINEST), longest=part * self.longest
        )

    def share(self, now: Motion) -> float:
        """What the last step may have added to the imbalance."""
        return ATONCE * self.balance * now.turnover


class TimeStopped(RuntimeError):
    """The motion could not be followed; `motion` is its last state."""

    def __init__(self, reason: str, motion: Motion) -> None:
        super().__init__(reason)
        self.motion = motion


def advance(
    integrator: Integrator,
    now: Motion,
    end: float,
    steps: TimeSteps,
    dt: float,
    between: Callable[[], None] = lambda: None,
) -> tuple[Motion, float]:
    """The motion at a later time, and the step to go on with.

    Parameters
    ----------
    dt
        The step to begin with.
    between
        Called before every step; may raise an exception to stop.

    Raises
    ------
    TimeStopped
        If even a tiny step fails.
    """
    begin, failed, now = now.t, False, integrator.balanced(now) if np.isnan(now.imbalance) else now
    while end - now.t > 1e-9 * (end - begin):
        between()
        way = end - now.t
        dt = min(dt, steps.fixed or dt, steps.longest if now.t < steps.fastest else dt)
        length = way / np.ceil(way / dt * (1 - 1e-9))
        trial = integrator.step(now, length)
        if isinstance(trial, str):
            dt, failed = length / 2, True
            if dt < SMALLEST * steps.first:
                raise TimeStopped(f"the time step has become too small: {trial}", now)
            continue
        if steps.fixed is None:
            change = 0.9 * (steps.tolerance / max(trial.error, 1e-300)) ** (1 / 3)
            if trial.error > steps.tolerance and length > SMALLEST * steps.first:
                dt = max(0.3, change) * length
                continue
            leak = abs(trial.imbalance - now.imbalance) / steps.share(
                trial
            )  # nan where it is not checked
            if leak > 1 and abs(trial.imbalance) > abs(now.imbalance):
                if length <= SMALLEST * steps.first:
                    raise TimeStopped(unbalanced(now, trial), now)
                dt = max(0.3, 0.8 / leak**0.5) * length
                continue
            change = min(change, 1.0) if leak > SPENT else change
            dt = (
                length * min(change, 2.0)
                if change > 1.3
                else max(length, dt if change > 1 else 0.0)
            )
        elif not failed:
            dt = max(dt, 2 * length)
        failed = False
        now = trial
    return replace(now, t=end), dt


def unbalanced(now: Motion, after: Motion) -> str:
    """What the balance of energy lacks between two motions, in words."""
    leak = after.imbalance - now.imbalance
    return (
        f"the balance of energy {'gains' if leak > 0 else 'loses'} {abs(leak) / after.turnover:.2g} of the energies in "
        f"a step of {after.t - now.t:.2g}, whatever its length: give a body less stiffness, or a larger balance"
    )

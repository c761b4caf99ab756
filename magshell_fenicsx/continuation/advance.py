"""Time steps up to a given time, of a fixed length or adapted to a tolerance.

`advance` repeats the steps of an `Integrator`, and shortens them where Newton's method fails, where
the estimated error is too large, or where contact makes the balance of energy leak.

A `Motion` is a moving state; mu are its load parameters. Its imbalance is kinetic + stored +
dissipated energy - work since the begin, zero in an exact solution, and its turnover the sum of
their magnitudes. A step leaks by the change of the imbalance in it. Lengths and errors are in units
of the system's length.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from magshell_fenicsx.continuation.motion import Motion
from magshell_fenicsx.continuation.transient import Integrator

MAX_LEAK_OF_STEP = 0.1  # fraction of the allowed imbalance that one step may contribute
# fraction of that: a step after one that leaks more does not grow
MAX_LEAK_FOR_GROWTH = 0.3
MIN_STEP_RATIO = 1e-6  # the smallest step over the first
MIN_TOLERANCE = 1e-9  # of a step; below it estimated errors are those of the iterations
END_TOLERANCE = 1e-9  # of an interval: what is left of it then is rounding


@dataclass(frozen=True)
class TimeSteps:
    """Options of the step lengths.

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
        In contact with a body: the allowed imbalance of energy, over its turnover.
    longest, fastest
        The longest step for the tolerance up to the time `fastest`, at which as a rule a motion is
        fastest.
    """

    fixed: float | None
    tolerance: float
    first: float
    balance: float = 1e-2
    longest: float = np.inf
    fastest: float = -np.inf

    def refined(self, factor: float) -> "TimeSteps":
        """Return options for steps that are shorter by a factor below 1.

        The tolerance falls with its third power, as errors do, but not below `MIN_TOLERANCE`.
        """
        return replace(
            self,
            tolerance=max(factor**3 * self.tolerance, MIN_TOLERANCE),
            longest=factor * self.longest,
        )

    def allowed_leak(self, motion: Motion) -> float:
        """Return the largest change of the imbalance of energy in the last step of a motion."""
        return MAX_LEAK_OF_STEP * self.balance * motion.turnover


class TimeStopped(RuntimeError):
    """The motion could not be followed; `motion` is its last state."""

    def __init__(self, reason: str, motion: Motion) -> None:
        super().__init__(reason)
        self.motion = motion


def advance(
    integrator: Integrator,
    motion: Motion,
    end: float,
    steps: TimeSteps,
    dt: float,
    before_step: Callable[[], None] = lambda: None,
) -> tuple[Motion, float]:
    """Return the motion at a later time, and the step to continue with. Collective.

    A step that fails, has too large an error or leaks is repeated with a shorter length.

    Parameters
    ----------
    integrator
        Makes one step of a given length, or returns why it fails.
    end
        The later time.
    dt
        The length of the first step, from an earlier call or `TimeSteps.first`.
    before_step
        Called before every step; may raise an exception to stop.

    Returns
    -------
    The motion, whose time is exactly `end`, and the length of the next step.

    Raises
    ------
    TimeStopped
        If even a tiny step fails, or loses its balance of energy.
    """
    begin, failed = motion.t, False
    if np.isnan(motion.imbalance):
        motion = integrator.with_imbalance(motion)
    smallest = MIN_STEP_RATIO * steps.first
    while end - motion.t > END_TOLERANCE * (end - begin):
        before_step()
        remaining = end - motion.t
        # dt is the length to which the step has adapted so far. `longest` limits it up to the time
        # `fastest` alone
        longest = steps.longest if motion.t < steps.fastest else dt
        dt = min(dt, steps.fixed or dt, longest)
        # steps of equal length up to the end, none of them tiny; rounding must not add one
        step_count = np.ceil(remaining / dt * (1 - 1e-9))
        length = remaining / step_count
        trial = integrator.step(motion, length)
        if isinstance(trial, str):  # the reason why Newton's method fails
            dt, failed = length / 2, True
            if dt < smallest:
                raise TimeStopped(f"the time step has become too small: {trial}", motion)
            continue
        if steps.fixed is None:
            dt, is_accepted = _adapted_length(steps, motion, trial, length, dt, smallest)
            if not is_accepted:
                continue
        elif not failed:  # after a failure the length grows at the second success in turn
            dt = max(dt, 2 * length)
        failed = False
        motion = trial
    return replace(motion, t=end), dt


def _adapted_length(
    steps: TimeSteps, motion: Motion, trial: Motion, length: float, dt: float, smallest: float
) -> tuple[float, bool]:
    """Return the length of the next step, and whether the trial of this step is accepted.

    It is not accepted if its error is too large or it leaks: then it is repeated.

    Parameters
    ----------
    motion, trial
        The motion before and after the step.
    length, dt
        The length of the step, and the length to which steps had adapted before.
    smallest
        The smallest length.

    Raises
    ------
    TimeStopped
        If a step of the smallest length leaks.
    """
    # the error of a step grows with the third power of its length; 0.9 is for safety
    length_ratio = 0.9 * (steps.tolerance / max(trial.error, 1e-300)) ** (1 / 3)
    if trial.error > steps.tolerance and length > smallest:
        return max(0.3, length_ratio) * length, False
    # the leak over the allowed one. It is nan where the balance is not checked, and no comparison
    # with nan is true
    leak = abs(trial.imbalance - motion.imbalance) / steps.allowed_leak(trial)
    if leak > 1 and abs(trial.imbalance) > abs(motion.imbalance):
        if length <= smallest:
            raise TimeStopped(leak_message(motion, trial), motion)
        # as if the leak grew with the square of the length
        return max(0.3, 0.8 / leak**0.5) * length, False
    length_ratio = min(length_ratio, 1.0) if leak > MAX_LEAK_FOR_GROWTH else length_ratio
    # another length needs a new factorisation: the length grows, to twice at most, only if it can
    # grow by more than 30 %
    if length_ratio > 1.3:
        return length * min(length_ratio, 2.0), True
    return max(length, dt if length_ratio > 1 else 0.0), True


def leak_message(begin: Motion, end: Motion) -> str:
    """Return a message on how much energy a step from `begin` to `end` gains or loses."""
    leak = end.imbalance - begin.imbalance
    return (
        f"the balance of energy {'gains' if leak > 0 else 'loses'} "
        f"{abs(leak) / end.turnover:.2g} of the energies in a step of {end.t - begin.t:.2g}, "
        "whatever its length: give a body less stiffness, or a larger balance"
    )

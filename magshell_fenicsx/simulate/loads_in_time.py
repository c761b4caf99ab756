"""Loads of a step in time: its amplitudes as functions of time, from the histories of the case.

Times are over R sqrt(rho/E), the unit of time of the model.
"""

from collections.abc import Callable, Collection
from functools import partial

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.section import in_units
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.motion.history import Curve, Level, Time, curve, marks, times_of
from magshell_fenicsx.parts.motion.motion_step import TimeSection, level_in
from magshell_fenicsx.problem.problem import Problem

DIFFERENCE_STEP = 1e-5  # of the shortest time of a history: step of differences by time
JUMP_TOLERANCE = 1e-9  # relative: a smaller jump of a support at the begin is rounding


def time_in_case_unit(value: Time) -> float:
    """Return a time in the case's own unit."""
    return float(in_units("second")(value))


def dimensionless_time(problem: Problem, value: Time) -> float:
    """Return a time over R sqrt(rho/E)."""
    return time_in_case_unit(value) / (problem.time_unit or 1.0)


def amplitude_of_level(problem: Problem, name: str, value: Level) -> float:
    """Return a value of a history as an amplitude."""
    if name != "lambda_m":
        return level_in(problem.context, name, value)
    return problem.lambda_m * level_in(problem.context, "field", value)


class LoadsInTime:
    """The amplitudes of a step as functions of its time.

    Parameters
    ----------
    motions
        Amplitudes of supports, which must not jump.

    Attributes
    ----------
    marks
        Times at which loads have kinks or jumps.

    Raises
    ------
    CaseError
        If a support jumps at the begin.
    """

    def __init__(
        self, problem: Problem, load: TimeSection, state: State, motions: Collection[str]
    ) -> None:
        self._mu, time = dict(state.mu), partial(dimensionless_time, problem)
        histories = dict(zip(load.drives, load.history.values(), strict=True))
        unit, steps = problem.time_unit or 1.0, {step.name: step.load for step in problem.programme}
        self._curves, self.marks = dict[str, Curve](), set[float]()
        for name, history in histories.items():
            # histories are in the case's own unit of time
            step = steps.get(name)
            value = step.in_history(state.mu[name]) if step else state.mu[name]
            level = partial(amplitude_of_level, problem, name)
            size = problem.lambda_m if isinstance(history, str) and name == "lambda_m" else 1.0
            self._curves[name] = _scaled(
                curve(history, time_in_case_unit, level, value),
                size,
                unit,
                step.of_history if step else float,
            )
            self.marks |= set(marks(history, time, time(load.duration)))
            first, present = self._curves[name](0.0, False), state.mu[name]
            jump = abs(first - present)
            if name in motions and jump > JUMP_TOLERANCE * max(1.0, abs(present)):
                raise CaseError(
                    f"history.{name}: begins at {first:.6g}, but the support is at {present:.6g}"
                )

        times = [time(load.duration)]
        times += [time(t) for history in histories.values() for t in times_of(history)]
        self._difference_step = DIFFERENCE_STEP * min(t for t in times if t)

    def rates(
        self, t: float, before: bool, names: Collection[str]
    ) -> dict[str, tuple[float, float]]:
        """Return first and second derivatives by time of some amplitudes, to second order.

        Parameters
        ----------
        before
            Whether they are taken from values before t, which may be a jump.
        """
        backward = before and t >= 3 * self._difference_step
        rates, step = {}, -self._difference_step if backward else self._difference_step
        for name in set(self._curves) & set(names):
            a, b, c, d = (self._curves[name](t + i * step, backward) for i in range(4))
            rates[name] = (4 * b - 3 * a - c) / (2 * step), (2 * a - 5 * b + 4 * c - d) / step**2
        return rates

    def __call__(self, t: float, before: bool) -> dict[str, float]:
        """Return all amplitudes at a time, just `before` it or after it."""
        return self._mu | {name: history(t, before) for name, history in self._curves.items()}


def _scaled(history: Curve, size: float, unit: float, amplitude: Callable[[float], float]) -> Curve:
    """Return a history in the model's unit of time, times a size, as an amplitude."""
    return lambda t, before: amplitude(size * history(t * unit, before))

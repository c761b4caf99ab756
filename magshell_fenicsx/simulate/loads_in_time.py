"""Loads of a step in time: its amplitudes as functions of time, from the histories of the case.

Times are over R sqrt(rho/E), the unit of time of the model.

A history is a table or formula of the case: the values of one load at times. A level is one of its
values, in the unit of the case. A curve is a function (t, before) -> value; `before` takes the
value just before t, where it may jump. Marks are times of kinks and jumps. An amplitude is a load
parameter by name in `State.mu`; its strength is the amplitude at a factor of one.
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
    """Return a value in a history of the case as an amplitude of the model."""
    return problem.context.strengths.get(name, 1.0) * level_in(problem.context, name, value)


class LoadsInTime:
    """The amplitudes of a step as functions of its time.

    Parameters
    ----------
    load
        The section of the step, with its histories.
    state
        State where the step begins.
    motions
        Amplitudes of supports, which must not jump.

    Attributes
    ----------
    marks
        Times at which loads have kinks or jumps.
    _mu
        All amplitudes where the step begins.
    _curves
        Amplitude -> its curve in the model's time, of those that have a history.
    _difference_step
        Step of differences by time.

    Raises
    ------
    CaseError
        If a support jumps at the begin.
    """

    def __init__(
        self, problem: Problem, load: TimeSection, state: State, motions: Collection[str]
    ) -> None:
        """Make a curve for each history, collect its kinks, and check that supports do not jump."""
        self._mu, time = dict(state.mu), partial(dimensionless_time, problem)
        # amplitude -> its history
        histories = dict(zip(load.drives, load.history.values(), strict=True))
        # unit of time, and amplitude -> load of the programme's step that varies it
        strengths = problem.context.strengths
        unit, steps = problem.time_unit or 1.0, {step.name: step.load for step in problem.programme}
        self._curves, self.marks = dict[str, Curve](), set[float]()
        for name, history in histories.items():
            # a step with this load converts amplitudes to the unit of its target, and back
            step = steps.get(name)
            # the amplitude at the begin, as a value of the history
            value = step.in_history(state.mu[name]) if step else state.mu[name]
            level = partial(amplitude_of_level, problem, name)
            # a formula (text) gives a factor of the strength; levels of a table include it already
            strength = strengths.get(name, 1.0) if isinstance(history, str) else 1.0
            self._curves[name] = _scaled(
                curve(history, time_in_case_unit, level, value),  # in the case's unit of time
                size=strength,
                unit=unit,
                amplitude=step.of_history if step else float,
            )
            self.marks |= set(marks(history, time, time(load.duration)))
            # a support must begin where it is
            first_value, present_value = self._curves[name](0.0, False), state.mu[name]
            jump = abs(first_value - present_value)
            if name in motions and jump > JUMP_TOLERANCE * max(1.0, abs(present_value)):
                raise CaseError(
                    f"history.{name}: begins at {first_value:.6g}, but the support is at "
                    f"{present_value:.6g}"
                )

        # times from which the step of differences follows: the duration, and those of histories
        times = [time(load.duration)]
        times += [time(t) for history in histories.values() for t in times_of(history)]
        self._difference_step = DIFFERENCE_STEP * min(t for t in times if t)

    def rates(
        self, t: float, before: bool, names: Collection[str]
    ) -> dict[str, tuple[float, float]]:
        """Return amplitude -> first and second derivative by time, by one-sided differences.

        They are of second order, with values at four times on the side of t that is asked for.

        Parameters
        ----------
        t
            Time over the unit of time of the model.
        before
            Whether they are taken from values before t, where a jump may be.
        names
            The amplitudes; those without a history are left out.
        """
        backward = before and t >= 3 * self._difference_step  # no values before time zero
        rates, step = {}, -self._difference_step if backward else self._difference_step
        for name in set(self._curves) & set(names):
            value_0, value_1, value_2, value_3 = (
                self._curves[name](t + i * step, backward) for i in range(4)
            )
            # difference quotients of second order, of f(t), f(t + step), f(t + 2 step), ...
            rates[name] = (
                (4 * value_1 - 3 * value_0 - value_2) / (2 * step),
                (2 * value_0 - 5 * value_1 + 4 * value_2 - value_3) / step**2,
            )
        return rates

    def __call__(self, t: float, before: bool) -> dict[str, float]:
        """Return all amplitudes at a time, just before it if `before`, else after it."""
        return self._mu | {name: history(t, before) for name, history in self._curves.items()}


def _scaled(history: Curve, size: float, unit: float, amplitude: Callable[[float], float]) -> Curve:
    """Return a curve of the amplitude in the model's time, from a history in the case's time.

    Parameters
    ----------
    history
        Function of the time in the case's unit, and of whether it is just before a jump.
    size
        Factor of its values.
    unit
        Unit of time of the model, in that of the case.
    amplitude
        Function from a value in the history to the amplitude.
    """
    return lambda t, before: amplitude(size * history(t * unit, before))

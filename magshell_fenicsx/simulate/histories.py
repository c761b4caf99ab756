"""The loads of a step in time as functions of time, in the scales of the model."""

from collections.abc import Collection
from functools import partial

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.section import in_units
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.magnetism.fields import MagneticSection
from magshell_fenicsx.parts.motion.history import Curve, Level, Time, curve, marks, times_of
from magshell_fenicsx.parts.motion.step import TimeSection
from magshell_fenicsx.problem.problem import Plan

CLOSE = 1e-5  # of the shortest time of a history: a difference by time
SAME = 1e-9


def own_time(value: Time) -> float:
    """A time in the case's own unit."""
    return float(in_units("second")(value))


def time_of(plan: Plan, value: Time) -> float:
    """A time over R sqrt(rho/E)."""
    return own_time(value) / (plan.time_unit or 1.0)


def level_of(plan: Plan, name: str, value: Level) -> float:
    """A value of a history as an amplitude."""
    if name != "lambda_m":
        return float(value)
    magnetic = plan.context.of(MagneticSection)
    applied = magnetic.applied.flux_density if magnetic else None
    return plan.lambda_m * (float(in_units("tesla")(value)) / (applied or 1.0) if isinstance(value, str) else value)


def _scaled(of: Curve, size: float, unit: float) -> Curve:
    return lambda t, before: size * of(t * unit, before)


class LoadsInTime:
    """The amplitudes of a step as functions of its time.

    Parameters
    ----------
    motions
        Amplitudes of supports, which must not jump.

    Raises
    ------
    CaseError
        If one of these does at the begin.
    """

    def __init__(self, plan: Plan, load: TimeSection, state: State, motions: Collection[str]) -> None:
        self._mu, time = dict(state.mu), partial(time_of, plan)
        histories = dict(zip(load.drives, load.history.values(), strict=True))
        unit = plan.time_unit or 1.0
        self._curves, self.marks = dict[str, Curve](), set[float]()
        for name, history in histories.items():
            # histories are in the case's own unit of time
            of = curve(history, own_time, partial(level_of, plan, name), state.mu[name])
            size = plan.lambda_m if isinstance(history, str) and name == "lambda_m" else 1.0
            self._curves[name] = _scaled(of, size, unit)
            self.marks |= set(marks(history, time, time(load.duration)))
            first, here = self._curves[name](0.0, False), state.mu[name]
            if name in motions and abs(first - here) > SAME * max(1.0, abs(here)):
                raise CaseError(f"history.{name}: begins at {first:.6g}, but the support is at {here:.6g}")

        known = [time(load.duration), *(time(t) for history in histories.values() for t in times_of(history))]
        self._close = CLOSE * min(t for t in known if t)

    def rates(self, t: float, before: bool, names: Collection[str]) -> dict[str, tuple[float, float]]:
        """First and second derivatives by time of some of them, from values on one side, to second order."""
        back = before and t >= 3 * self._close
        found, step = {}, -self._close if back else self._close
        for name in set(self._curves) & set(names):
            a, b, c, d = (self._curves[name](t + i * step, back) for i in range(4))
            found[name] = (4 * b - 3 * a - c) / (2 * step), (2 * a - 5 * b + 4 * c - d) / step**2
        return found

    def __call__(self, t: float, before: bool) -> dict[str, float]:
        return self._mu | {name: of(t, before) for name, of in self._curves.items()}

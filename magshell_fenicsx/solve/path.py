"""Following an equilibrium path by load or by conjugate displacement, with adaptive steps."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Literal

import numpy as np

from magshell_fenicsx.solve.control import GivenConjugate, GivenLoad, Row
from magshell_fenicsx.solve.newton import BorderedNewton
from magshell_fenicsx.solve.system import State, Vector, dot

Control = Literal["load", "conjugate"]


@dataclass(frozen=True)
class Point:
    """An accepted point of a path.

    Attributes
    ----------
    s
        The controlled quantity: mu, or the conjugate displacement -Pi_i(u).
    du, dmu
        Tangent of the path, d(u, mu)/ds.
    negative_pivots
        Number of unstable directions at fixed amplitudes.
    iterations, factorisations
        Work since the point before.
    """

    state: State
    s: float
    du: Vector
    dmu: float
    negative_pivots: int
    iterations: int = 0
    factorisations: int = 0


@dataclass(frozen=True)
class StepOptions:
    """Adaptive step length.

    Attributes
    ----------
    first, largest, smallest
        Step lengths in units of s.
    easy, hard
        Newton iterations below which a step grows, and above which it shrinks.
    turn
        Least cosine between the tangents of successive points; a sharper turn is
        taken for a jump to another branch and tried again with a smaller step.
    """

    first: float
    largest: float
    smallest: float
    easy: int = 6
    hard: int = 12
    turn: float = 0.5


class PathStopped(RuntimeError):
    """The path could not be followed further; `point` is the last accepted one."""

    def __init__(self, reason: str, point: Point) -> None:
        super().__init__(reason)
        self.point = point


class Path:
    """An equilibrium path in one amplitude, the others being fixed.

    Parameters
    ----------
    name
        The amplitude that varies.
    control
        "load": s is the amplitude; "conjugate": s is the displacement conjugate to it.
    """

    def __init__(self, newton: BorderedNewton, name: str, control: Control, options: StepOptions) -> None:
        self.newton, self.name, self.control, self.options = newton, name, control, options
        self.system = newton.system

    def start(self, state: State) -> Point:
        """The point of a state that is in equilibrium already."""
        factors = self.newton.factorisation.count
        s = state.mu[self.name] if self.control == "load" else -self.system.potential(state.u, self.name)
        return self._point(state, s, iterations=0, factors_before=factors)

    def at(self, s: float, guess: State) -> Point | str:
        """Solve for the point at `s`, or say why that failed."""
        factors = self.newton.factorisation.count
        outcome = self.newton.solve(guess, self.name, self._row(s))
        if not outcome.converged:
            return outcome.reason
        return self._point(outcome.state, s, outcome.iterations, factors)

    def towards(self, start: Point, targets: Sequence[float]) -> Iterator[tuple[Point, bool]]:
        """Accepted points through every target in turn; the flag tells the targets.

        Raises
        ------
        PathStopped
            If a step of the smallest length fails.
        """
        before, here, step = None, start, self.options.first
        for target in targets:
            while here.s != target:
                way = target - here.s
                pieces = max(1.0, np.ceil(abs(way) / step)) if np.isfinite(way) else np.inf
                length = abs(way) / pieces if pieces < 3 else step  # no stub of a step before a target
                s = target if pieces == 1 else here.s + np.copysign(length, way)
                found = self._try(s, before, here)
                if isinstance(found, str):
                    step = length / 2
                    if step < self.options.smallest:
                        raise PathStopped(found, here)
                    continue
                if found.iterations <= self.options.easy:
                    step = min(max(step, 1.5 * length), self.options.largest)
                elif found.iterations >= self.options.hard:
                    step = 0.6 * length
                before, here = here, found
                yield here, here.s == target

    def predict(self, s: float, before: Point | None, here: Point) -> State:
        """Quadratic through the last two points with the last tangent (linear at the start)."""
        a = s - here.s
        u, mu = here.state.u + a * here.du, here.state.mu[self.name] + a * here.dmu
        if before is not None:
            b = here.s - before.s
            weight = (a / b) ** 2
            u = u + weight * (before.state.u - here.state.u + b * here.du)
            mu += weight * (before.state.mu[self.name] - here.state.mu[self.name] + b * here.dmu)
        return here.state.with_(u, self.name, mu)

    def _try(self, s: float, before: Point | None, here: Point) -> Point | str:
        found = self.at(s, self.predict(s, before, here))
        if isinstance(found, Point) and self._cosine(found, here) < self.options.turn:
            return "the path turns sharply, or the step jumped to another branch"
        return found

    def _cosine(self, a: Point, b: Point) -> float:
        comm = self.system.comm
        lengths = sqrt(dot(comm, a.du, a.du) * dot(comm, b.du, b.du))
        return dot(comm, a.du, b.du) / lengths if lengths else 1.0  # an amplitude may move nothing

    def _row(self, s: float) -> Row:
        return GivenLoad(s) if self.control == "load" else GivenConjugate(self.system, self.name, s)

    def _point(self, state: State, s: float, iterations: int, factors_before: int) -> Point:
        factors = self.newton.factor_at(state)
        load = self.system.load(state.u, self.name)
        du = -factors.solve(load)
        dmu = 1.0
        if self.control == "conjugate":
            dmu = -1.0 / dot(self.system.comm, load, du)
            du = dmu * du
        return Point(state, s, du, dmu, factors.negative_pivots, iterations, factors.count - factors_before)

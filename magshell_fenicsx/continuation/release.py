"""A guess is held by a force along a direction, which is then released: where it is zero, there is an equilibrium.

    R(u) + t b = 0,    -b . u = q

First q is that of the guess. Then the path is followed by arc length, through folds, until t is zero.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from magshell_fenicsx.continuation.control import GivenConjugate
from magshell_fenicsx.continuation.deflation import deflated
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path, StepOptions
from magshell_fenicsx.continuation.point import PathStopped
from magshell_fenicsx.continuation.system import Amplitudes, State, System, Tangent, Vector, Weighted, dot

FORCE = "holding force"
FIRST, LONGEST, SHORTEST = 0.02, 1000.0, 1e-3  # steps: the first in the metric's length, others over the first
MOST_STEPS, MOST_FORCE = 30, 10.0  # the force over the first one
SCALE = 1e6  # the force counts as nothing in the arc length


class Held:
    """A system with one more amplitude, a force along b."""

    def __init__(self, system: System, b: Vector) -> None:
        self.comm, self.size, self.length, self.coordinates = (
            system.comm,
            system.size,
            system.length,
            system.coordinates,
        )
        self._system, self._b = system, b

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        return self._system.residual(u, mu) + mu[FORCE] * self._b

    def load(self, u: Vector, mu: Amplitudes, name: str) -> Vector:
        return self._b if name == FORCE else self._system.load(u, mu, name)

    def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
        return dot(self.comm, self._b, u) if name == FORCE else self._system.potential(u, mu, name)

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        return 0.0 if FORCE in (name, other) else self._system.curvature(u, mu, name, other)

    def tangent(self, u: Vector, mu: Amplitudes, stress: Sequence[Weighted] = ()) -> Tangent:
        return self._system.tangent(u, mu, stress)


def released(newton: BorderedNewton, guess: State, b: Vector) -> Iterator[State]:
    """Guesses of equilibria on the path of a force along b that holds a guess, each where the force is zero.

    The path begins in the direction in which the force falls in size.
    """
    system = newton.system
    residual, size = system.residual(guess.u, guess.mu), dot(system.comm, b, b)
    b = np.asarray(b * (np.sqrt(dot(system.comm, residual, residual) / size) or 1.0))  # a force of order one
    holder = newton.on(Held(system, b))
    first = -dot(system.comm, b, residual) / dot(system.comm, b, b)
    row = GivenConjugate(holder.system, FORCE, -dot(system.comm, b, guess.u))
    near = deflated(holder, State(guess.u, {**guess.mu, FORCE: first}), FORCE, row)
    outcome = holder.solve(near, FORCE, row) if near else None
    if outcome is None or not outcome.converged:
        return
    path = Path(holder, FORCE, "arc", StepOptions(FIRST, LONGEST * FIRST, SHORTEST * FIRST), SCALE)
    largest = MOST_FORCE * abs(outcome.state.mu[FORCE])
    here = path.start(outcome.state, -float(np.copysign(1.0, outcome.state.mu[FORCE])))
    try:
        for count, (point, _) in enumerate(path.towards(here, [np.inf]), 1):
            before, after = (p.state.mu[FORCE] for p in (here, point))
            if before * after <= 0 and before != after:
                s = here.s + (point.s - here.s) * before / (before - after)
                near = path.between(s, here, path.seen_from(here, point))
                yield State(near.u, dict(guess.mu))
            here = point
            if count == MOST_STEPS or abs(after) > largest:
                return
    except PathStopped:
        return

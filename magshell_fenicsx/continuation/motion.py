"""A moving state, what acts on it, and what a loading device makes of it where it begins.

A device holds the conjugates q of some amplitudes: g(u, mu) = dPi/dmu + q = 0. Where g depends on
its own amplitude (a gas, a body that is pressed on) that follows from u. Otherwise g constrains u:
C.v = 0 and C.a + v.(dC/du v) = 0 with the column C = dg/du, and the amplitude is the force of this
constraint.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.device import Device
from magshell_fenicsx.continuation.system import (
    Amplitudes,
    State,
    System,
    Tangent,
    Vector,
    dot,
    max_abs,
)

Array = NDArray[np.float64]
Inverse = Callable[[Vector], Vector]
MOST = 20  # iterations
ROUNDING = 1e-13
STEP = 1e-3  # lengths that a velocity moves the system by for the change of C


@dataclass(frozen=True)
class Motion:
    """A moving state.

    Attributes
    ----------
    t
        Time.
    u, v, a
        Displacement, velocity and acceleration.
    mu
        Amplitudes.
    work, dissipated
        By the loads, and by drag and viscosity, since the begin.
    potentials
        dPi/dmu of the loads.
    error
        Estimated error of the last step, over the system's length.
    memory
        What viscous forces remember of the steps so far: a step that is refused leaves it.
    imbalance, turnover
        Kinetic + stored + dissipated - work, less its value at the begin, and the sum of their
        magnitudes; nan where the balance is not checked.
    """

    t: float
    u: Vector
    v: Vector
    a: Vector
    mu: dict[str, float]
    work: float = 0.0
    dissipated: float = 0.0
    potentials: dict[str, float] = field(default_factory=dict)
    error: float = np.inf
    memory: Any = None
    imbalance: float = np.nan
    turnover: float = np.nan


class Viscous(Protocol):
    """Forces that depend on the strains along a step.

    Attributes
    ----------
    memory
        What they remember of the steps to u0; `accept` replaces it.
    slowness
        Longest time in which they let a displacement creep to its end, so that errors of steps add
        up.
    """

    memory: Any
    slowness: float

    def force(self, u0: Vector, u1: Vector, v: Vector, part: float, dt: float) -> Vector:
        """The force at a part of the step from u0 to u1, with the velocity v there; zero at
        supports.
        """

    def tangent(self, u: Vector, mu: Amplitudes, dt: float, rate: float) -> Tangent:
        """The system's tangent with the derivative of the force by u1; dv/du at the end is `rate`."""

    def begin(self) -> None:
        """A motion begins, or a load has a corner."""

    def accept(self, u0: Vector, u1: Vector, dt: float) -> Vector:
        """Go on from u1; the latest force."""

    def doubt(self, u0: Vector, u1: Vector, dt: float) -> Vector | None:
        """The force at u1 of which an estimate of the error is made; None without an estimate."""


class Averaged(Protocol):
    """Forces of contact, which set in and cease within a step: each step takes their mean along its
    way.

    Attributes
    ----------
    names
        Amplitudes that are positions of what touches.
    settings
        Names of the stiffnesses that `harder` may give.
    """

    names: frozenset[str]
    settings: frozenset[str]

    def harder(self, begin: State, v: Vector) -> dict[str, float]:
        """Settings of what must become stiffer before a step, since it may meet too fast, and
        stores nothing yet.
        """

    def along(self, begin: State, end: State, part: float) -> None:
        """Let the system's forces at this part of a step be its mean ones, until `present`."""

    def present(self) -> None:
        """Let the system have the forces of its state again."""

    def passes(self, begin: State, end: State) -> str:
        """What passes through each other in a step, in words; empty if nothing does."""

    def stored(self, u: Vector, mu: Amplitudes) -> float:
        """The energy without the potentials of loads."""


class Ground(Protocol):
    """Supports that move; see `shells.mass`.

    Attributes
    ----------
    names
        Their amplitudes.
    """

    names: frozenset[str]

    def velocity(self, t: float, before: bool) -> Vector:
        """Of supports."""

    def acceleration(self, t: float, before: bool) -> Vector:
        """Of supports."""

    def along(self, mu: Amplitudes, name: str) -> Vector:
        """Their displacement by an amplitude."""

    def times(self, x: Vector) -> Vector:
        """The mass of all nodes times a vector."""

    def held(self, x: Vector) -> Vector:
        """With zeros at supports."""


def constrained(
    system: System, device: Device, inverse: Inverse, u: Vector, v: Vector, mu: Amplitudes
) -> tuple[Vector, Vector, dict[str, float]]:
    """The nearest displacement and velocity, in the sense of the mass, that the device allows, with
    its amplitudes.

    Parameters
    ----------
    inverse
        Of the mass.
    """
    y, comm = device.unknowns(mu), system.comm
    for _ in range(MOST):
        whole = {**mu, **device.values(y)}
        C, D = device.edge(u, whole)
        X, springs = [inverse(c) for c in C], np.diag(D) != 0
        S = np.where(springs, D, [[dot(comm, c, x) for x in X] for c in C])
        part = np.linalg.solve(S, device.rows(u, whole))
        step = _sum(np.where(springs, 0.0, part), X)
        y, u = y - np.where(springs, part, 0.0), u - step
        moved = max_abs(comm, step) / system.length
        if moved <= ROUNDING and np.abs(part[springs]).max(initial=0.0) <= ROUNDING * (
            1 + np.abs(y).max()
        ):
            break
    across = np.where(springs, 0.0, [dot(comm, c, v) for c in C])
    v = v - _sum(np.where(springs, 0.0, np.linalg.solve(S, across)), X)
    return u, v, {**mu, **device.values(y)}


def _sum(parts: Array, vectors: list[Vector]) -> Vector:
    return np.asarray(np.sum([part * x for part, x in zip(parts, vectors, strict=True)], axis=0))


def held_back(
    system: System, device: Device, inverse: Inverse, now: Motion
) -> tuple[Vector, dict[str, float]]:
    """The acceleration with the forces of constraints, and these; that of `now` is without their
    change.
    """
    C, D = device.edge(now.u, now.mu)
    free, size = np.diag(D) == 0, max_abs(system.comm, now.v)
    ahead, behind, step = C, C, 1.0
    if size:
        step = STEP * system.length / size
        ahead, behind = (device.edge(now.u + side * step * now.v, now.mu)[0] for side in (1, -1))
    X = [inverse(c) for c in C]
    S = np.where(free, [[dot(system.comm, c, x) for x in X] for c in C], np.eye(len(C)))
    bent = [dot(system.comm, a - b, now.v) / (2 * step) for a, b in zip(ahead, behind, strict=True)]
    rest = np.array([dot(system.comm, c, now.a) for c in C]) + bent
    dy = np.where(free, np.linalg.solve(S, np.where(free, rest, 0.0)), 0.0)
    return now.a - _sum(dy, X), now.mu | device.values(device.unknowns(now.mu) + dy)

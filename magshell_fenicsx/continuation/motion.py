"""A moving state, and what a loading device makes of it where it begins.

A device holds the conjugates q of some amplitudes: g(u, mu) = dPi/dmu + q = 0. Where g depends on its own amplitude (a
gas, a body that is pressed on) that follows from u. Otherwise g constrains u: C.v = 0 and C.a + v.(dC/du v) = 0 with
the column C = dg/du, and the amplitude is the force of this constraint.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.device import Device
from magshell_fenicsx.continuation.system import Amplitudes, System, Vector, dot, max_abs

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
        Kinetic + stored + dissipated - work, less its value at the begin, and the sum of their magnitudes; nan where
        the balance is not checked.
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


def constrained(
    system: System, device: Device, inverse: Inverse, u: Vector, v: Vector, mu: Amplitudes
) -> tuple[Vector, Vector, dict[str, float]]:
    """The nearest displacement and velocity, in the sense of the mass, that the device allows, with its amplitudes.

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
        if moved <= ROUNDING and np.abs(part[springs]).max(initial=0.0) <= ROUNDING * (1 + np.abs(y).max()):
            break
    across = np.where(springs, 0.0, [dot(comm, c, v) for c in C])
    v = v - _sum(np.where(springs, 0.0, np.linalg.solve(S, across)), X)
    return u, v, {**mu, **device.values(y)}


def _sum(parts: Array, vectors: list[Vector]) -> Vector:
    return np.asarray(np.sum([part * x for part, x in zip(parts, vectors, strict=True)], axis=0))


def held_back(system: System, device: Device, inverse: Inverse, now: Motion) -> tuple[Vector, dict[str, float]]:
    """The acceleration with the forces of constraints, and these; that of `now` is without their change."""
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

"""The last row of the bordered system: the quantity that is prescribed along a path."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import sqrt
from typing import Protocol

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.continuation.system import Direction, State, System, Vector, dot


class Row(Protocol):
    """g(u, mu) = 0 beside equilibrium."""

    def residual(self, state: State) -> float:
        """g."""

    def gradient(self, state: State) -> tuple[Vector | None, float]:
        """dg/du (None where it is zero) and dg/dmu."""


def slope(comm: MPI.Comm, gradient: tuple[Vector | None, float], along: Direction) -> float:
    """The derivative of g along a direction, from the gradient of its row."""
    (c, d), (du, dmu) = gradient, along
    return d * dmu + (dot(comm, c, du) if c is not None else 0.0)


@dataclass(frozen=True)
class GivenLoad:
    """Load control: mu = target."""

    name: str
    target: float

    def residual(self, state: State) -> float:
        return state.mu[self.name] - self.target

    def gradient(self, state: State) -> tuple[Vector | None, float]:
        return None, 1.0


@dataclass(frozen=True)
class GivenConjugate:
    """Displacement or volume control: -dPi/dmu = target."""

    system: System
    name: str
    target: float

    def residual(self, state: State) -> float:
        return -self.system.potential(state.u, state.mu, self.name) - self.target

    def gradient(self, state: State) -> tuple[Vector | None, float]:
        u, mu, name = state.u, state.mu, self.name
        return -self.system.load(u, mu, name), -self.system.curvature(u, mu, name, name)


@dataclass(frozen=True)
class Metric:
    """Lengths along a path of (u, mu): from the root mean square of u over the system's length, and mu over `scale`.

    So a step length means the same for a thick and a thin shell, and on any mesh.
    """

    system: System
    scale: float

    @cached_property
    def weight(self) -> float:
        """The factor of du . du."""
        return 1 / (float(self.system.comm.allreduce(self.system.size)) * self.system.length**2)

    def inner(self, a: Direction, b: Direction) -> float:
        """<a, b> of two directions (du, dmu)."""
        return self.weight * dot(self.system.comm, a[0], b[0]) + a[1] * b[1] / self.scale**2

    def norm(self, du: Vector, dmu: float) -> float:
        """Length of a direction."""
        return sqrt(self.inner((du, dmu), (du, dmu)))


def projected(metric: Metric, a: Direction, span: Sequence[Direction]) -> Direction:
    """The direction nearest to `a` among the combinations of others."""
    gram = [[metric.inner(p, q) for q in span] for p in span]
    parts = np.linalg.solve(gram, [metric.inner(p, a) for p in span])
    du = np.sum([part * p[0] for part, p in zip(parts, span, strict=True)], axis=0)
    return du, float(sum(part * p[1] for part, p in zip(parts, span, strict=True)))


@dataclass(frozen=True)
class Hyperplane:
    """Arc length: <normal, (u, mu) - base> = distance."""

    metric: Metric
    name: str
    base: State
    normal: Direction
    distance: float

    def residual(self, state: State) -> float:
        chord = (state.u - self.base.u, state.mu[self.name] - self.base.mu[self.name])
        return self.metric.inner(self.normal, chord) - self.distance

    def gradient(self, state: State) -> tuple[Vector | None, float]:
        return self.metric.weight * self.normal[0], self.normal[1] / self.metric.scale**2

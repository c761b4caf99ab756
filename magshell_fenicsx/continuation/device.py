"""Systems made of a system: a loading device that holds conjugates, amplitudes as functions of one,
a holding force.

A device holds the conjugates of some amplitudes, so these amplitudes are unknowns. For example, a
sealed volume has an unknown pressure, and a body pressed on with a given force an unknown position.
The Legendre transform

    L(u, mu_f; mu) = Pi(u; mu_f, mu) + sum_f int q_f dmu_f

is stationary in u and in the amplitudes mu_f where Pi is in equilibrium and -dPi/dmu_f = q_f(mu_f).
A constant q_f holds the conjugate; a q_f that falls with mu_f is a spring or a gas. So a device is
a system like any other, with the unknowns u and y_f = mu_f length/scale_f. Its inertia is that of
the shell in the device.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from math import log2

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.factor import Factorisation, join, split
from magshell_fenicsx.continuation.system import (
    Amplitudes,
    Edged,
    State,
    System,
    Tangent,
    Vector,
    Weighted,
    dot,
    max_abs,
)

Conjugate = Callable[[float], tuple[float, float]]  # mu -> q and dq/dmu
Held = float | Conjugate | str
Array = NDArray[np.float64]
Curve = Callable[[float], tuple[float, float, float]]  # t -> mu and its first two derivatives
FORCE = "holding force"


class Device:
    """A system under a loading device.

    Parameters
    ----------
    held
        Amplitude that becomes unknown -> its conjugate: a value of -dPi/dmu, a function q(mu) that
        does not rise, or the name of a further amplitude of the device, whose value it is.
    scale
        Amplitude -> a value that counts as of order one.

    Attributes
    ----------
    names
        The amplitudes that are unknown.
    """

    def __init__(
        self, system: System, held: Mapping[str, Held], scale: Mapping[str, float]
    ) -> None:
        self.comm, self.length, self.coordinates = system.comm, system.length, system.coordinates
        self._system, self.names = system, list(held)
        self._held = [
            q if callable(q) or isinstance(q, str) else constant(q) for q in held.values()
        ]
        self._unit = np.array([scale[name] / system.length for name in held])
        self.size = system.size + len(held) * (self.comm.rank == self.comm.size - 1)

    def on(self, system: System) -> "Device":
        """The same device on another system."""
        other = copy(self)
        other._system = system
        other.size = system.size + self.size - self._system.size
        return other

    def padded(self, u: Vector) -> Vector:
        """A vector of the inner system with zeros for the amplitudes."""
        return join(u, np.zeros(len(self.names)), self.comm)

    def enter(self, state: State) -> State:
        """A state of the inner system as a state of the device."""
        fixed = {name: value for name, value in state.mu.items() if name not in self.names}
        return State(join(state.u, self.unknowns(state.mu), self.comm), fixed)

    def leave(self, state: State) -> State:
        """A state of the device as a state of the inner system."""
        u, mu = self._split(state.u, state.mu)
        return State(u, {name: value for name, value in mu.items() if name not in self._held})

    def displacement(self, x: Vector) -> Vector:
        """u of a vector (u, y)."""
        return split(x, len(self.names), self.comm)[0]

    def rates(self, x: Vector) -> dict[str, float]:
        """The changes of the amplitudes along a vector (u, y)."""
        y = split(x, len(self.names), self.comm)[1]
        return dict(zip(self.names, (float(v) for v in y * self._unit), strict=True))

    def joined(self, u: Vector, rows: Amplitudes) -> Vector:
        """A gradient by (u, y), from those by u and by the amplitudes."""
        return join(u, np.array([rows[name] for name in self.names]) * self._unit, self.comm)

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        v, whole = self._split(u, mu)
        return join(self._system.residual(v, whole), self.rows(v, whole), self.comm)

    def rows(self, u: Vector, mu: Amplitudes) -> Array:
        """The further rows at a state of the inner system, zero where each conjugate is what it
        should be.
        """
        each = zip(self.names, self._held, strict=True)
        held = [mu[q] if isinstance(q, str) else q(mu[name])[0] for name, q in each]
        rows = np.array([self._system.potential(u, mu, name) for name in self.names]) + held
        return np.asarray(rows * self._unit)

    def load(self, u: Vector, mu: Amplitudes, name: str) -> Vector:
        v, whole = self._split(u, mu)
        if name in self._held:
            return join(
                0.0 * v, self._unit * (np.array(self._held, dtype=object) == name), self.comm
            )
        mixed = [self._system.curvature(v, whole, other, name) for other in self.names]
        return join(self._system.load(v, whole, name), np.array(mixed) * self._unit, self.comm)

    def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
        v, whole = self._split(u, mu)
        if name in self._held:
            return whole[self.names[self._held.index(name)]]
        return self._system.potential(v, whole, name)

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        if {name, other} & set(self._held):
            return 0.0
        return self._system.curvature(*self._split(u, mu), name, other)

    def tangent(self, u: Vector, mu: Amplitudes, stress: Sequence[Weighted] = ()) -> Edged:
        v, whole = self._split(u, mu)
        columns, D = self.edge(v, whole)
        below = [(weight, self.displacement(w)) for weight, w in stress]
        K = self._system.tangent(v, whole, below)
        assert not isinstance(K, Edged)  # a device of a device is one device
        return Edged(K, columns, D, self.multipliers)

    def edge(self, u: Vector, mu: Amplitudes) -> tuple[list[Vector], Array]:
        """The columns C, and D (k, k), at a state of the inner system."""
        system, names = self._system, self.names
        columns = [
            unit * system.load(u, mu, name) for name, unit in zip(names, self._unit, strict=True)
        ]
        D = np.array([[system.curvature(u, mu, i, j) for j in names] for i in names])
        each = zip(names, self._held, strict=True)
        D += np.diag([0.0 if isinstance(q, str) else q(mu[name])[1] for name, q in each])
        return columns, np.asarray(D * np.outer(self._unit, self._unit))

    @property
    def multipliers(self) -> int:
        """See `Edged`."""
        return sum(name not in self.coordinates for name in self.names)

    def values(self, y: Array) -> dict[str, float]:
        """The amplitudes of the unknowns y."""
        return dict(zip(self.names, (float(v) for v in y * self._unit), strict=True))

    def unknowns(self, mu: Amplitudes) -> Array:
        """The unknowns y of amplitudes."""
        return np.asarray(np.array([mu[name] for name in self.names]) / self._unit)

    def _split(self, x: Vector, mu: Amplitudes) -> tuple[Vector, dict[str, float]]:
        u, y = split(x, len(self.names), self.comm)
        return u, {**mu, **self.values(y)}


def constant(q: float) -> Conjugate:
    """A conjugate that is held."""
    return lambda mu: (q, 0.0)


def natural_scale(system: System, factors: Factorisation, state: State, name: str) -> float:
    """The amplitude that moves the system by about its length, as a power of two: the same on any
    number of ranks.
    """
    moved = (
        max_abs(system.comm, factors.solve(system.load(state.u, state.mu, name))) / system.length
    )
    return 2.0 ** -round(log2(moved)) if moved else 1.0


class Along:
    """A system in the amplitude t; the inner system has the amplitudes mu_i = f_i(t).

    Parameters
    ----------
    name
        Name of the amplitude t.
    curves
        Amplitude of the inner system -> f_i with its first two derivatives.
    begin
        t of the states that `contract` gets.
    """

    def __init__(
        self, system: System, name: str, curves: Mapping[str, Curve], begin: float = 0.0
    ) -> None:
        self.comm, self.size, self.length = system.comm, system.size, system.length
        self.coordinates = system.coordinates
        self._system, self._name, self._curves, self._begin = system, name, curves, begin

    def on(self, system: System) -> "Along":
        """The same curves on another system."""
        return Along(system, self._name, self._curves, self._begin)

    def contract(self, state: State) -> State:
        """A state of the inner system with t in place of its amplitudes."""
        others = {name: value for name, value in state.mu.items() if name not in self._curves}
        return State(state.u, {self._name: self._begin, **others})

    def expand(self, state: State) -> State:
        """The state with the amplitudes of the inner system."""
        return State(state.u, self._expanded(state.mu))

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        return self._system.residual(u, self._expanded(mu))

    def load(self, u: Vector, mu: Amplitudes, name: str) -> Vector:
        whole, rates = self._expanded(mu), self._rates(mu, name)
        columns = [rate * self._system.load(u, whole, i) for i, rate in rates.items()]
        return sum(columns[1:], columns[0])

    def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
        whole = self._expanded(mu)
        return sum(
            rate * self._system.potential(u, whole, i) for i, rate in self._rates(mu, name).items()
        )

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        whole, t = self._expanded(mu), mu[self._name]
        own, others = self._rates(mu, name), self._rates(mu, other)
        bends = {i: f(t)[2] for i, f in self._curves.items()} if name == other == self._name else {}
        mixed = (
            a * b * self._system.curvature(u, whole, i, j)
            for i, a in own.items()
            for j, b in others.items()
        )
        return sum(mixed) + sum(
            bend * self._system.potential(u, whole, i) for i, bend in bends.items()
        )

    def tangent(self, u: Vector, mu: Amplitudes, stress: Sequence[Weighted] = ()) -> Tangent:
        return self._system.tangent(u, self._expanded(mu), stress)

    def _expanded(self, mu: Amplitudes) -> dict[str, float]:
        others = {name: value for name, value in mu.items() if name != self._name}
        return {**others, **{i: f(mu[self._name])[0] for i, f in self._curves.items()}}

    def _rates(self, mu: Amplitudes, name: str) -> dict[str, float]:
        """Amplitude of the inner system -> dmu_i/dt for t; for one of its own amplitudes, itself ->
        1.
        """
        return (
            {i: f(mu[self._name])[1] for i, f in self._curves.items()}
            if name == self._name
            else {name: 1.0}
        )


class HeldAlong:
    """A system with one more amplitude, a force along b."""

    def __init__(self, system: System, b: Vector) -> None:
        self.comm, self.size, self.length = system.comm, system.size, system.length
        self.coordinates, self._system, self._b = system.coordinates, system, b

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

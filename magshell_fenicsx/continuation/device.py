"""Systems built on a system: a loading device, a curve of amplitudes, a holding force.

A device holds the conjugates of some amplitudes, so these amplitudes are unknowns. For example, a
sealed volume has an unknown pressure, and a body pressed on with a given force an unknown position.
The Legendre transform

    L(u, mu_f; mu) = Pi(u; mu_f, mu) + sum_f int q_f dmu_f

is stationary in u and in the amplitudes mu_f where Pi is in equilibrium and -dPi/dmu_f = q_f(mu_f).
A constant q_f holds the conjugate; a q_f that falls with mu_f is a spring or a gas. So a device is
a system like any other, with the unknowns u and y_f = mu_f length/scale_f. Its inertia is that of
the shell in the device.

An amplitude mu is a load parameter, or a prescribed position, by name. Its conjugate q = -dPi/dmu
is the displacement on which it does work, or for a position the force. The free amplitudes mu_f are
those that the device makes unknown; all others are given. R = dPi/du; a load vector is R_mu, the
derivative of R by an amplitude; `stress` are weighted displacements whose stress replaces that of u
in a tangent. Vectors (u, y) have the k unknowns y on the last rank.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from itertools import product
from math import log2

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.factor import Factorisation, join, split
from magshell_fenicsx.continuation.system import (
    Amplitudes,
    BorderedTangent,
    State,
    System,
    Tangent,
    Vector,
    WeightedDisplacement,
    dot,
    max_abs,
)

Conjugate = Callable[[float], tuple[float, float]]  # mu -> q and dq/dmu
HeldConjugate = float | Conjugate | str
Array = NDArray[np.float64]
Curve = Callable[[float], tuple[float, float, float]]  # t -> mu and its first two derivatives
FORCE = "holding force"


class Device:
    """A system under a loading device, which is a `System` again.

    Its unknowns are u, and on the last rank y_f = mu_f length/scale_f of the free amplitudes mu_f.

    Parameters
    ----------
    system
        The inner system, without the device.
    held_conjugates_of_step
        Amplitude that becomes unknown -> its conjugate, which the step of loading prescribes: a
        value of -dPi/dmu, a function from mu to q and dq/dmu <= 0, or the name of a further
        amplitude of the device, whose value it is.
    scale
        Amplitude -> a value that counts as of order one; it scales the unknown y.

    Attributes
    ----------
    names
        The amplitudes that are unknown.

    Private fields, both in the order of `names`: `_conjugates` are functions of the amplitude that
    return q and dq/dmu, or names of further amplitudes, whose value is q; `_units` are the changes
    of the amplitudes per unit of y. `_system` is the inner system.
    """

    def __init__(
        self,
        system: System,
        held_conjugates_of_step: Mapping[str, HeldConjugate],
        scale: Mapping[str, float],
    ) -> None:
        """Take over the interface of the inner system, with further unknowns on the last rank."""
        self.comm, self.length, self.coordinates = system.comm, system.length, system.coordinates
        self._system, self.names = system, list(held_conjugates_of_step)
        self._conjugates = [
            conjugate if callable(conjugate) or isinstance(conjugate, str) else constant(conjugate)
            for conjugate in held_conjugates_of_step.values()
        ]
        self._units = np.array([scale[name] / system.length for name in held_conjugates_of_step])
        # the further unknowns are on the last rank
        self.size = system.size + len(held_conjugates_of_step) * (
            self.comm.rank == self.comm.size - 1
        )

    def for_system(self, system: System) -> "Device":
        """Return the same device on another system."""
        device = copy(self)
        device._system = system
        # the unknowns on this rank: those of the system, and the device's own
        device.size = system.size + self.size - self._system.size
        return device

    def padded(self, u: Vector) -> Vector:
        """Return a vector of the inner system with zeros appended for the amplitudes."""
        return join(u, np.zeros(len(self.names)), self.comm)

    def enter(self, state: State) -> State:
        """Return a state of the inner system as a state of the device: mu_f become unknowns y."""
        fixed = {name: value for name, value in state.mu.items() if name not in self.names}
        return State(join(state.u, self.unknowns(state.mu), self.comm), fixed)

    def leave(self, state: State) -> State:
        """Return a state of the device as a state of the inner system, with all its amplitudes."""
        u, mu = self._split(state.u, state.mu)
        # amplitudes that name a conjugate are the device's alone
        return State(u, {name: value for name, value in mu.items() if name not in self._conjugates})

    def displacement(self, x: Vector) -> Vector:
        """Return the part u of a vector (u, y) of the device's unknowns."""
        u, _ = split(x, len(self.names), self.comm)
        return u

    def rates(self, x: Vector) -> dict[str, float]:
        """Return the changes of the unknown amplitudes by name along a vector (u, y)."""
        _, y = split(x, len(self.names), self.comm)
        return dict(zip(self.names, (float(v) for v in y * self._units), strict=True))

    def gradient(self, by_u: Vector, by_amplitude: Amplitudes) -> Vector:
        """Return a gradient by the unknowns (u, y).

        Parameters
        ----------
        by_u
            The gradient by u.
        by_amplitude
            Amplitude -> the derivative by it; it has all unknown ones.
        """
        by_y = np.array([by_amplitude[name] for name in self.names]) * self._units
        return join(by_u, by_y, self.comm)

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        """Return R of the inner system, followed by the residuals dPi/dmu + q of the device."""
        v, amplitudes = self._split(u, mu)
        rows = self.rows(v, amplitudes)
        return join(self._system.residual(v, amplitudes), rows, self.comm)

    def rows(self, u: Vector, mu: Amplitudes) -> Array:
        """Return the residuals dPi/dmu + q of the unknown amplitudes; zero in equilibrium.

        Parameters
        ----------
        u, mu
            A state of the inner system.

        Returns
        -------
        (k,) numbers, as derivatives by y.
        """
        # q of each unknown amplitude; a function returns q, then its slope
        held_values = [
            mu[conjugate] if isinstance(conjugate, str) else conjugate(mu[name])[0]
            for name, conjugate in zip(self.names, self._conjugates, strict=True)
        ]
        rows = np.array([self._system.potential(u, mu, name) for name in self.names]) + held_values
        return np.asarray(rows * self._units)

    def load(self, u: Vector, mu: Amplitudes, name: str) -> Vector:
        """Return the derivative of the residual (u, y) by the amplitude `name`.

        That may be an amplitude of the inner system, or one whose value is a held conjugate: it
        enters the row of each free amplitude with that conjugate, with the derivative 1.
        """
        v, amplitudes = self._split(u, mu)
        if name in self._conjugates:
            # the rows of the free amplitudes whose conjugate has the value of this amplitude
            is_held_by_name = np.array(self._conjugates, dtype=object) == name
            return join(0.0 * v, self._units * is_held_by_name, self.comm)
        # R_mu, then the changes of the rows: the second derivatives of Pi
        mixed = [self._system.curvature(v, amplitudes, free_name, name) for free_name in self.names]
        load = self._system.load(v, amplitudes, name)
        return join(load, np.array(mixed) * self._units, self.comm)

    def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
        """Return the derivative of the Legendre transform L by an amplitude.

        An amplitude whose value is a held conjugate q_f multiplies mu_f in L, so the derivative is
        mu_f.
        """
        v, amplitudes = self._split(u, mu)
        if name in self._conjugates:
            return amplitudes[self.names[self._conjugates.index(name)]]
        return self._system.potential(v, amplitudes, name)

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        """Return the second derivative of L by two amplitudes; zero by a held conjugate."""
        if {name, other} & set(self._conjugates):
            return 0.0
        return self._system.curvature(*self._split(u, mu), name, other)

    def tangent(
        self, u: Vector, mu: Amplitudes, stress: Sequence[WeightedDisplacement] = ()
    ) -> BorderedTangent:
        """Assemble the tangent of the inner system, bordered by the unknown amplitudes."""
        v, amplitudes = self._split(u, mu)
        columns, D = self.border(v, amplitudes)
        # without the unknowns y of the device
        inner_stress = [
            (weight, self.displacement(displacement)) for weight, displacement in stress
        ]
        K = self._system.tangent(v, amplitudes, inner_stress)
        assert not isinstance(K, BorderedTangent)  # a device of a device is one device
        return BorderedTangent(K, columns, D, self.multipliers)

    def border(self, u: Vector, mu: Amplitudes) -> tuple[list[Vector], Array]:
        """Return the border of the tangent at a state of the inner system.

        Returns
        -------
        The k columns R_mu, each the part of this rank, and D (k, k): the second derivatives by the
        amplitudes with the slopes dq/dmu. Both are by y.
        """
        system, names = self._system, self.names
        columns = [
            unit * system.load(u, mu, name) for name, unit in zip(names, self._units, strict=True)
        ]
        curvatures = [system.curvature(u, mu, i, j) for i, j in product(names, repeat=2)]
        D = np.array(curvatures).reshape(len(names), len(names))
        # dq/dmu, which a function returns after q
        slopes = [
            0.0 if isinstance(conjugate, str) else conjugate(mu[name])[1]
            for name, conjugate in zip(names, self._conjugates, strict=True)
        ]
        D += np.diag(slopes)
        return columns, np.asarray(D * np.outer(self._units, self._units))

    @property
    def multipliers(self) -> int:
        """The number of unknown amplitudes that multiply their term, as Lagrange multipliers do.

        All are multipliers but those that are positions.
        """
        return sum(name not in self.coordinates for name in self.names)

    def values(self, y: Array) -> dict[str, float]:
        """Return the unknown amplitudes by name, from the unknowns y (k,)."""
        return dict(zip(self.names, (float(v) for v in y * self._units), strict=True))

    def unknowns(self, mu: Amplitudes) -> Array:
        """Return the unknowns y (k,) of the device, from amplitudes by name."""
        return np.asarray(np.array([mu[name] for name in self.names]) / self._units)

    def _split(self, x: Vector, mu: Amplitudes) -> tuple[Vector, dict[str, float]]:
        """Return u and all amplitudes of the inner system, from a state (u, y) of the device."""
        u, y = split(x, len(self.names), self.comm)
        return u, {**mu, **self.values(y)}


def constant(q: float) -> Conjugate:
    """Return a conjugate that does not depend on its amplitude."""
    return lambda mu: (q, 0.0)


def natural_scale(system: System, factors: Factorisation, state: State, name: str) -> float:
    """Return the amplitude that moves the system by about its length. Collective.

    It is rounded to a power of two, so that it is the same on any number of ranks.

    Parameters
    ----------
    factors
        Factors of the tangent at the state.
    """
    response = factors.solve(system.load(state.u, state.mu, name))
    lengths = max_abs(system.comm, response) / system.length
    return 2.0 ** -round(log2(lengths)) if lengths else 1.0


class ParametrisedSystem:
    """A system in one amplitude t; the inner system has the amplitudes mu_i = f_i(t).

    It is a `System` again: a path in t follows a curve in the space of amplitudes.

    Parameters
    ----------
    name
        Name of the amplitude t.
    curves
        Amplitude of the inner system -> function that returns f_i with its first two derivatives.
    begin
        The value of t at the states that `contract` gets.

    The private fields have the names of the parameters.
    """

    def __init__(
        self, system: System, name: str, curves: Mapping[str, Curve], begin: float = 0.0
    ) -> None:
        self.comm, self.size, self.length = system.comm, system.size, system.length
        self.coordinates = system.coordinates
        self._system, self._name, self._curves, self._begin = system, name, curves, begin

    def for_system(self, system: System) -> "ParametrisedSystem":
        """Return the same curves on another system."""
        return ParametrisedSystem(system, self._name, self._curves, self._begin)

    def contract(self, state: State) -> State:
        """Return a state of the inner system with t in place of the amplitudes of the curves."""
        others = {name: value for name, value in state.mu.items() if name not in self._curves}
        return State(state.u, {self._name: self._begin, **others})

    def expand(self, state: State) -> State:
        """Return a state of the inner system, with the amplitudes f_i(t) in place of t."""
        return State(state.u, self._expanded(state.mu))

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        return self._system.residual(u, self._expanded(mu))

    def load(self, u: Vector, mu: Amplitudes, name: str) -> Vector:
        """Return d2Pi/du dt by the chain rule, or the load vector of another amplitude."""
        # all amplitudes of the inner system, and dmu_i/dt of those that change
        amplitudes, rates = self._expanded(mu), self._rates(mu, name)
        columns = [rate * self._system.load(u, amplitudes, i) for i, rate in rates.items()]
        return sum(columns[1:], columns[0])

    def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
        """Return dPi/dt by the chain rule, or dPi/dmu of another amplitude."""
        amplitudes, rates = self._expanded(mu), self._rates(mu, name)
        return sum(rate * self._system.potential(u, amplitudes, i) for i, rate in rates.items())

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        """Return a second derivative of Pi by t and other amplitudes, by the chain rule."""
        amplitudes, t = self._expanded(mu), mu[self._name]
        # amplitude of the inner system -> its derivative by `name`, and by `other`
        rates, other_rates = self._rates(mu, name), self._rates(mu, other)
        mixed = (
            rate * other_rate * self._system.curvature(u, amplitudes, i, j)
            for i, rate in rates.items()
            for j, other_rate in other_rates.items()
        )
        # d2mu_i/dt2, if both amplitudes are t: the third result of a curve
        second_derivatives = dict[str, float]()
        if name == other == self._name:
            second_derivatives = {i: f(t)[2] for i, f in self._curves.items()}
        return sum(mixed) + sum(
            derivative * self._system.potential(u, amplitudes, i)
            for i, derivative in second_derivatives.items()
        )

    def tangent(
        self, u: Vector, mu: Amplitudes, stress: Sequence[WeightedDisplacement] = ()
    ) -> Tangent:
        return self._system.tangent(u, self._expanded(mu), stress)

    def _expanded(self, mu: Amplitudes) -> dict[str, float]:
        """Return the amplitudes of the inner system, from those with t."""
        others = {name: value for name, value in mu.items() if name != self._name}
        # a curve returns mu_i, then its two derivatives
        return {**others, **{i: f(mu[self._name])[0] for i, f in self._curves.items()}}

    def _rates(self, mu: Amplitudes, name: str) -> dict[str, float]:
        """Return the derivatives of the inner system's amplitudes by the amplitude `name`.

        They are dmu_i/dt by t. An amplitude of the inner system changes only itself, with the rate
        1.
        """
        if name != self._name:
            return {name: 1.0}
        # a curve returns mu_i, then dmu_i/dt
        return {i: f(mu[self._name])[1] for i, f in self._curves.items()}


class HoldingForceSystem:
    """A system with one more amplitude, `FORCE`: the factor of a force along a vector b.

    It is a `System` again, and serves solves in which this force holds a displacement.
    """

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

    def tangent(
        self, u: Vector, mu: Amplitudes, stress: Sequence[WeightedDisplacement] = ()
    ) -> Tangent:
        return self._system.tangent(u, mu, stress)

"""A system with one amplitude t in place of several others, which are functions of t."""

from collections.abc import Callable, Mapping, Sequence

from magshell_fenicsx.continuation.system import Amplitudes, State, System, Tangent, Vector, Weighted

Curve = Callable[[float], tuple[float, float, float]]  # t -> mu and its first two derivatives


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

    def __init__(self, system: System, name: str, curves: Mapping[str, Curve], begin: float = 0.0) -> None:
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
        return sum(rate * self._system.potential(u, whole, i) for i, rate in self._rates(mu, name).items())

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        whole, t = self._expanded(mu), mu[self._name]
        here, there = self._rates(mu, name), self._rates(mu, other)
        bends = {i: f(t)[2] for i, f in self._curves.items()} if name == other == self._name else {}
        mixed = (a * b * self._system.curvature(u, whole, i, j) for i, a in here.items() for j, b in there.items())
        return sum(mixed) + sum(bend * self._system.potential(u, whole, i) for i, bend in bends.items())

    def tangent(self, u: Vector, mu: Amplitudes, stress: Sequence[Weighted] = ()) -> Tangent:
        return self._system.tangent(u, self._expanded(mu), stress)

    def _expanded(self, mu: Amplitudes) -> dict[str, float]:
        others = {name: value for name, value in mu.items() if name != self._name}
        return {**others, **{i: f(mu[self._name])[0] for i, f in self._curves.items()}}

    def _rates(self, mu: Amplitudes, name: str) -> dict[str, float]:
        """Amplitude of the inner system -> dmu_i/dt for t; for one of its own amplitudes, itself -> 1."""
        return {i: f(mu[self._name])[1] for i, f in self._curves.items()} if name == self._name else {name: 1.0}

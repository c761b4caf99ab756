"""A system with another amplitude than those underneath: several moved together."""

from collections.abc import Mapping, Sequence

from petsc4py import PETSc

from magshell_fenicsx.continuation.system import Amplitudes, System, Vector, Weighted


class Along:
    """A system in the amplitude t, which stands for mu_i = base_i + t direction_i of another.

    Parameters
    ----------
    name
        Of the amplitude t.
    base, direction
        Amplitudes at t = 0, and their change to t = 1.
    """

    def __init__(self, system: System, name: str, base: Mapping[str, float], direction: Mapping[str, float]) -> None:
        self.comm, self.size, self.length = system.comm, system.size, system.length
        self._system, self._name, self._base, self._direction = system, name, base, direction

    def expand(self, mu: Amplitudes) -> dict[str, float]:
        """The amplitudes of the system underneath."""
        t = mu[self._name]
        others = {name: value for name, value in mu.items() if name != self._name}
        return {**others, **{name: self._base[name] + t * rate for name, rate in self._direction.items()}}

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        return self._system.residual(u, self.expand(mu))

    def load(self, u: Vector, name: str) -> Vector:
        columns = [rate * self._system.load(u, i) for i, rate in self._direction.items()]
        return sum(columns[1:], columns[0])

    def potential(self, u: Vector, name: str) -> float:
        return sum(rate * self._system.potential(u, i) for i, rate in self._direction.items())

    def tangent(self, u: Vector, mu: Amplitudes, stress: Sequence[Weighted] = ()) -> PETSc.Mat:
        return self._system.tangent(u, self.expand(mu), stress)

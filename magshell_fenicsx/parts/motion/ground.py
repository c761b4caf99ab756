"""The inertia that the motion of supports gives to what they hold.

With the displacement u + E(mu(t)), E at nodes that move, the mass is that of all nodes: M (u'' + E'') and M (u' + E').
"""

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from petsc4py import PETSc

from magshell_fenicsx.assembly.problem import FiniteElementSystem
from magshell_fenicsx.continuation.system import Amplitudes, Vector

Rates = Mapping[str, tuple[float, float]]  # of each motion: first and second derivative by time


class Ground:
    """Supports that move in time; a `continuation.transient.Ground`.

    Parameters
    ----------
    mass
        Of all nodes, supports too.
    at
        Amplitudes and their rates at a time, at a kink before or after it.
    carried
        The velocity of the supports before the begin; None: they were at rest.

    Attributes
    ----------
    names
        Amplitudes of the motions.
    """

    def __init__(
        self,
        system: FiniteElementSystem,
        mass: PETSc.Mat,
        at: Callable[[float, bool], tuple[Amplitudes, Rates]],
        carried: Vector | None = None,
    ) -> None:
        assert system.moving
        self._system, self._moving, self._mass, self._at, self._carried = system, system.moving, mass, at, carried
        self.names = system.moving.names
        self._x, self._y = mass.createVecs()

    def velocity(self, t: float, before: bool) -> Vector:
        """Of nodes that move, zero elsewhere."""
        if t <= 0 and before:
            return np.zeros(self._system.size) if self._carried is None else self._carried
        mu, rates = self._at(t, before)
        return self._sum(rate * self._moving.rate(mu, name) for name, (rate, _) in rates.items())

    def acceleration(self, t: float, before: bool) -> Vector:
        """Likewise."""
        mu, rates = self._at(t, before)
        direct = self._sum(bend * self._moving.rate(mu, name) for name, (_, bend) in rates.items())
        pairs = ((a, b, rates[a][0] * rates[b][0]) for a in rates for b in rates)
        return direct + self._sum(product * self._moving.bend(mu, a, b) for a, b, product in pairs)

    def along(self, mu: Amplitudes, name: str) -> Vector:
        """dE/dmu of a motion."""
        return self._sum([self._moving.rate(mu, name)])

    def times(self, x: Vector) -> Vector:
        """The mass of all nodes times a vector."""
        self._x.setArray(x)
        self._mass.mult(self._x, self._y)
        return np.array(self._y.array_r)

    def held(self, x: Vector) -> Vector:
        """With zeros at supports."""
        return self._system.held(x)

    def _sum(self, parts: Iterable[Vector]) -> Vector:
        whole = np.sum([np.zeros(len(self._system.u.x.array)), *parts], axis=0)
        return np.array(whole[: self._system.size])

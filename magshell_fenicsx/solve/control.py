"""The last row of the bordered system: what is prescribed along a path."""

from dataclasses import dataclass
from typing import Protocol

from magshell_fenicsx.solve.system import System, Vector


class Row(Protocol):
    """g(u, mu) = 0 beside equilibrium."""

    def residual(self, u: Vector, mu: float) -> float:
        """g."""

    def gradient(self, u: Vector) -> tuple[Vector | None, float]:
        """dg/du (None where it is zero) and dg/dmu."""


@dataclass(frozen=True)
class GivenLoad:
    """Load control: mu = target."""

    target: float

    def residual(self, u: Vector, mu: float) -> float:
        return mu - self.target

    def gradient(self, u: Vector) -> tuple[Vector | None, float]:
        return None, 1.0


@dataclass(frozen=True)
class GivenConjugate:
    """Displacement or volume control: -Pi_i(u) = target."""

    system: System
    name: str
    target: float

    def residual(self, u: Vector, mu: float) -> float:
        return -self.system.potential(u, self.name) - self.target

    def gradient(self, u: Vector) -> tuple[Vector | None, float]:
        return -self.system.load(u, self.name), 0.0

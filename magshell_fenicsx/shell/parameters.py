"""What a shell is made of and what loads it, dimensionless."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.shell.patterns import Pattern

Condition = Literal["clamped", "simply supported", "free", "symmetry"]
MagneticEnergy = Literal["full", "first", "torque", "second", "second_consistent"]
MIRROR_NORMAL = np.array([0.0, 1.0, 0.0])  # half models are the part y >= 0


@dataclass(frozen=True)
class Material:
    """nu, and h over R."""

    nu: float
    h: float

    @property
    def bending_stiffness(self) -> float:
        """D/(E h R^2)."""
        return self.h**2 / (12 * (1 - self.nu**2))

    @property
    def classical_pressure(self) -> float:
        """p_c/E = 2/sqrt(3 (1 - nu^2)) (h/R)^2, of the perfect sphere."""
        return float(2 / np.sqrt(3 * (1 - self.nu**2)) * self.h**2)


@dataclass(frozen=True)
class Force:
    """A dead force along the undeformed normal at a vertex, F > 0 pushing in.

    Attributes
    ----------
    point
        Name of the vertex.
    patch
        Radius over R of the smooth patch that it is spread over; 0 for a point.
    """

    point: str
    patch: float = 0.0


@dataclass(frozen=True)
class Magnetisation:
    """What is magnetised and how it is modelled.

    Attributes
    ----------
    remanent, applied
        The flux densities over their magnitudes: vectors (3,), or a pattern for the remanent one.
    gradient
        (3, 3) of the applied flux density, which is applied + gradient . r; None if uniform.
    across
        Unit vector (3,) normal to `applied` that the field turns towards, with the amplitude
        "lambda_across"; None if it does not turn.
    energy
        The full energy, or which of the paper's approximations takes its place.
    """

    remanent: NDArray[np.float64] | Pattern
    applied: NDArray[np.float64]
    energy: MagneticEnergy = "full"
    gradient: NDArray[np.float64] | None = None
    across: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Loads:
    """What loads the shell; None or False: no term, no kernel."""

    pressure: bool = False
    force: Force | None = None
    magnetic: Magnetisation | None = None


def default_penalty(degree: int) -> float:
    """sigma of the C0 interior penalty (over half the height of the triangles).

    It grows with degree squared, as the inverse inequality asks.
    """
    return 5.0 * degree**2

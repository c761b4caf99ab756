"""Material, supports and loads of a shell, dimensionless.

Energies are over E h R², lengths over R. E, h and R are Young's modulus, thickness and reference
length of the shell, or of the first of several shells. A pattern is a function of undeformed places
and normals that gives vectors. A dead load keeps its direction.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.rigid_motion import RigidMotion
from magshell_fenicsx.models.shell.laminate import Laminate, Laminated
from magshell_fenicsx.models.shell.law import Koiter, Law, LawByShell
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.spatial_fields import Pattern


@dataclass(frozen=True)
class HeldComponents:
    """Support that holds some components (0 to 2) of the displacement; rotations are free."""

    components: tuple[int, ...]


# "symmetry" is the mirror plane of a half model, "plane" one that belongs to the shell as it is
# described
Condition = Literal["clamped", "simply supported", "free", "symmetry", "plane"] | HeldComponents


@dataclass(frozen=True)
class ShellMaterial:
    """The material of one of several shells: modulus and density over those of the first shell,
    Poisson's ratio, and the number of its law in `Material.laws`.

    >>> ShellMaterial(2.0, 0.3).numbers
    (2.0, 0.3, 1.0, 0)
    """

    modulus: float
    nu: float
    density: float = 1.0
    law: int = 0

    @property
    def numbers(self) -> tuple[float, float, float, int]:
        """`modulus`, `nu`, `density` and `law`, the components of `thickness.material_field`."""
        return self.modulus, self.nu, self.density, self.law


@dataclass(frozen=True)
class Material:
    """The material of a shell, dimensionless.

    Attributes
    ----------
    nu
        Poisson's ratio: 1/2 for rubber, that of the units for plies, that of the first of several
        shells.
    h
        Thickness over R.
    elastic_law
        The law without plies; None for Koiter's.
    laminate
        Plies; None without.
    shells
        Name of each of several shells -> its material; None if all have the same.
    laws
        The law of each of several shells, in their order.
    laminates
        Name of a shell -> its plies.
    """

    nu: float
    h: float
    elastic_law: Law | None = None
    laminate: Laminate | None = None
    shells: Mapping[str, ShellMaterial] | None = None
    laws: tuple[Law, ...] = ()
    laminates: Mapping[str, Laminate] = field(default_factory=dict)

    @property
    def law(self) -> Law:
        """The law of the material: energies, stresses and moments as functions of strains.

        Several shells have their laws in `laws`; else plies take the place of `elastic_law`.
        """
        if self.laws:
            if len(self.laws) > 1:
                return LawByShell(self.h, laws=self.laws)
            return self.laws[0]
        if self.laminate:
            return Laminated.from_laminate(self.laminate, self.h, self.nu)
        return self.elastic_law or Koiter(self.h, self.nu)

    @property
    def laminate_by_shell(self) -> dict[str, Laminate]:
        """Name of a shell -> its plies; the name is empty if there is one shell."""
        return {**({"": self.laminate} if self.laminate else {}), **self.laminates}

    def law_in(self, cells: NDArray[np.float64] | None) -> Law:
        """Return the law in cells, for arrays (cells, n) of values at n points of each cell.

        `cells` (cells, 4) are `ShellMaterial.numbers`: modulus, nu, density and number of the law.
        None if all shells have one material.
        """
        if cells is None:
            return self.law
        # each is (cells, 1), to multiply values at points; the density is not used
        modulus_factor, nu, _, law_number = np.moveaxis(cells[:, None], -1, 0)
        return self.law.with_material(modulus_factor, nu, law_number)

    @property
    def bending_stiffness(self) -> float:
        """D/(E h R^2)."""
        return float(self.law.bending_stiffness)

    @property
    def classical_pressure(self) -> float:
        """p_c/E = 2/sqrt(3 (1 - nu^2)) (h/R)^2, the buckling pressure of the perfect sphere."""
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
class PointForce:
    """A dead force (3,) over E h R at a named vertex."""

    point: str
    force: NDArray[np.float64]


@dataclass(frozen=True)
class EdgeForce:
    """A dead force (3,), or a pattern, on a named edge.

    It is per length over E h; if `total`, it is the whole force over E h R.
    """

    edge: str
    force: NDArray[np.float64] | Pattern
    total: bool


@dataclass(frozen=True)
class EdgeMoment:
    """A moment per length over E h R on a named edge, about the edge's tangent."""

    edge: str
    moment: float


@dataclass(frozen=True)
class AreaForce:
    """A dead force (3,), or a pattern, per undeformed area over E h/R.

    It acts on a named patch, or with None on the whole shell. A number in place of the vector is a
    pressure along the undeformed normal, positive from outside.
    """

    patch: str | None
    force: NDArray[np.float64] | float | Pattern


@dataclass(frozen=True)
class Potential:
    """An energy per undeformed area that depends on the deformed place.

    Its amplitude is "load".
    """

    term: OwnTerm


DeadLoad = PointForce | EdgeForce | EdgeMoment | AreaForce | Potential


@dataclass(frozen=True)
class Move:
    """A motion of supports: of the named edges, points or patches that are held."""

    names: tuple[str, ...]
    motion: RigidMotion


def default_penalty(degree: int) -> float:
    """Return sigma of the C0 interior penalty, over half the height of the triangles.

    It grows with degree squared, as the inverse inequality requires.
    """
    return 5.0 * degree**2

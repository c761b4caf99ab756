"""What a shell is made of and what loads it, dimensionless."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.motion import Motion
from magshell_fenicsx.mesh.patch import Deviation, GivenField
from magshell_fenicsx.models.shell.law import Koiter, Law
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.patterns import Pattern, by_patch
from magshell_fenicsx.models.shell.rubber import Rubber
from magshell_fenicsx.parts.bodies.contact import Contact
from magshell_fenicsx.parts.magnetism.driven import Driven, FieldInSpace
from magshell_fenicsx.parts.magnetism.soft import Soft
from magshell_fenicsx.parts.natural.shape import Natural

if TYPE_CHECKING:
    from magshell_fenicsx.parts.magnetism.sensors import Sensor
    from magshell_fenicsx.parts.touching.touching import Pair


@dataclass(frozen=True)
class Held:
    """These components of the displacement are zero, rotations are free."""

    components: tuple[int, ...]


# "symmetry" is the mirror plane of a half model, "plane" one that belongs to the shell as it is described
Condition = Literal["clamped", "simply supported", "free", "symmetry", "plane"] | Held
ACROSS = ("lambda_across", "lambda_third")
MagneticEnergy = Literal["full", "first", "torque", "second", "second_consistent"]
RemanenceLaw = Literal["deformation", "rotation"]


@dataclass(frozen=True)
class Material:
    """nu, and h over R; of rubber C01/(C10 + C01), and nu is 1/2."""

    nu: float
    h: float
    rubber: float | None = None

    @property
    def law(self) -> Law:
        """How a shell of it resists strains."""
        return Koiter(self.h, self.nu) if self.rubber is None else Rubber(self.h, self.rubber)

    @property
    def bending_stiffness(self) -> float:
        """D/(E h R^2)."""
        return float(self.law.bending_stiffness)

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
    in_space
        The applied flux density as a function of the deformed place, in place of `applied` and `gradient`.
    driven
        Fields that amplitudes drive, added to `in_space`.
    across
        Vectors (3,), normal to `applied` and to each other, that the field turns towards, with the amplitudes of
        `ACROSS`.
    axes
        Unit vectors along `applied` and `across`.
    turns
        Rotations of all of a field in space, which are motions of `driven`, in their order.
    given
        Vectors that were given on the mesh, in place of `remanent`; None without.
    energy
        The full energy, or which of the paper's approximations takes its place.
    patches
        Vectors (3,) on named patches of a mesh, in place of `remanent`; None without.
    layers
        Fractions of the thickness and vectors (3,), from the inner face outwards, of which `remanent` is the average.
    law
        Whether the remanence moves with F, as in the paper, or with its rotation R.
    soft
        What is soft; None without. Alone, it leaves `remanent` zero.
    tesla
        What a remanence of length one is, in T; 1 if the case has no flux densities.
    metres
        R in m; 0 if the case has no lengths with units, or no flux densities.
    """

    remanent: NDArray[np.float64] | Pattern
    applied: NDArray[np.float64]
    energy: MagneticEnergy = "full"
    gradient: NDArray[np.float64] | None = None
    across: tuple[NDArray[np.float64], ...] = ()
    patches: Mapping[str, NDArray[np.float64]] | None = None
    layers: tuple[tuple[float, NDArray[np.float64]], ...] = ()
    law: RemanenceLaw = "deformation"
    in_space: FieldInSpace | None = None
    axes: tuple[NDArray[np.float64], ...] = ()
    driven: tuple[Driven, ...] = ()
    turns: tuple[Motion, ...] = ()
    given: GivenField | None = None
    soft: Soft | None = None
    tesla: float = 1.0
    metres: float = 0.0

    @property
    def uniform(self) -> bool:
        """Whether the applied flux density is."""
        return self.gradient is None and self.in_space is None

    def at(self, mu: Mapping[str, float], r: NDArray[np.float64]) -> NDArray[np.float64]:
        """The applied flux density (..., 3) at points r (..., 3), so that of a uniform one lambda_m is the size."""
        along = mu.get("lambda_m", 0.0)
        if self.in_space and not along:
            return np.zeros_like(r)
        if self.in_space:
            x = r.reshape(-1, 3)
            B = self.in_space(x)[0] + sum((each.at(x, mu).value[0] for each in self.driven), np.zeros(3))
            return np.asarray(along * B.reshape(r.shape))
        uniform = along * self.applied
        for name, across in zip(ACROSS, self.across, strict=False):
            uniform = uniform + mu.get(name, 0.0) * across
        if self.gradient is None:
            return np.broadcast_to(uniform, r.shape)
        return np.asarray(uniform + along * r @ self.gradient.T)

    def on(self, patches: Mapping[str, NDArray[np.bool_]], cells: int) -> "Magnetisation":
        """With patterns in place of what is given by named patches of a mesh with so many cells on this rank.

        Raises
        ------
        MeshError
            If there is no such patch.
        """
        remanent = by_patch(self.patches, patches, cells) if self.patches else self.remanent
        soft = self.soft and self.soft.on(lambda of: by_patch(of, patches, cells, "magnetic.susceptibility"))
        return replace(self, remanent=remanent, soft=soft)


@dataclass(frozen=True)
class PointForce:
    """A dead force (3,) over E h R at a named vertex."""

    point: str
    force: NDArray[np.float64]


@dataclass(frozen=True)
class EdgeForce:
    """A dead force (3,), or a pattern, on a named edge: per length over E h or, if `total`, in all over E h R."""

    edge: str
    force: NDArray[np.float64] | Pattern
    total: bool


@dataclass(frozen=True)
class EdgeMoment:
    """A moment per length over E h R on a named edge; see `edges.turning`."""

    edge: str
    moment: float


@dataclass(frozen=True)
class AreaForce:
    """A dead force (3,), or a pattern, per undeformed area over E h/R, on a patch, or on all.

    A number in place of the vector is a pressure along the undeformed normal, positive from outside.
    """

    patch: str | None
    force: NDArray[np.float64] | float | Pattern


@dataclass(frozen=True)
class Potential:
    """An energy per undeformed area that depends on the deformed place, with the amplitude "load"."""

    term: OwnTerm


DeadLoad = PointForce | EdgeForce | EdgeMoment | AreaForce | Potential


@dataclass(frozen=True)
class Move:
    """A motion of supports: edges, points or patches that are held."""

    names: tuple[str, ...]
    motion: Motion


@dataclass(frozen=True)
class Loads:
    """What loads the shell; what is empty, None or False has no term and no kernel.

    Attributes
    ----------
    forces, dead
        Amplitude -> the force, or the dead loads that grow together.
    growing
        Amplitude -> imperfections that grow.
    remanence
        What is magnetised where no field is applied: it loads nothing, and is drawn.
    sensors
        Where its magnetic field is read.
    pairs
        What may touch: the shell itself, or parts of it.
    """

    pressure: bool = False
    forces: Mapping[str, Force] = field(default_factory=dict)
    magnetic: Magnetisation | None = None
    dead: Mapping[str, tuple[DeadLoad, ...]] = field(default_factory=dict)
    own: tuple[OwnTerm, ...] = ()
    natural: Natural | None = None
    moves: tuple[Move, ...] = ()
    contacts: tuple[Contact, ...] = ()
    pairs: tuple["Pair", ...] = ()
    growing: Mapping[str, tuple[Deviation, ...]] = field(default_factory=dict)
    remanence: Magnetisation | None = None
    sensors: tuple["Sensor", ...] = ()

    @property
    def all_dead(self) -> tuple[DeadLoad, ...]:
        """The dead loads of all amplitudes."""
        return tuple(load for loads in self.dead.values() for load in loads)

    @property
    def displaced(self) -> str | None:
        """The amplitude with the displacement that the column w_over_h has; None if that is the pole's."""
        return next(iter((*self.forces, *self.dead)), None)


def default_penalty(degree: int) -> float:
    """sigma of the C0 interior penalty (over half the height of the triangles).

    It grows with degree squared, as the inverse inequality asks.
    """
    return 5.0 * degree**2

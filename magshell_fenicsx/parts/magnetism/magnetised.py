"""The magnetisation of a model, and the applied field, in the model's frame.

- The strength of the applied field is an amplitude (load parameter). A uniform field that turns has
  further amplitudes for directions across its first one; mu holds all amplitudes by name.
- A pattern is a function of undeformed places and normals that gives vectors. A field in space is a
  function of the deformed place that gives flux density and derivatives. Places are over R.
- An image is the mirror image of the modelled half, or a copy of a sector.
- A patch is a named part of a mesh, given by flags of its cells.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.rigid_motion import RigidMotion
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.mesh.patch import UserField
from magshell_fenicsx.models.shell.spatial_fields import Pattern, by_patch
from magshell_fenicsx.parts.magnetism.fields import FIELD
from magshell_fenicsx.parts.magnetism.moving_source import FieldInSpace, MovingField
from magshell_fenicsx.parts.magnetism.soft_magnet import SoftMagnet

MagneticEnergy = Literal["full", "first", "torque", "second", "second_consistent"]
RemanenceLaw = Literal["deformation", "rotation"]
PLACES = 50  # on each rank, where a field and its images are compared
# amplitudes of a field's uniform parts -> what the names of their energies end in
SUFFIXES = dict(zip((FIELD.name, *FIELD.components), ("", " across", " third"), strict=True))


class UniformPart(NamedTuple):
    """A uniform part of the applied field.

    Attributes
    ----------
    amplitude
        Name of its amplitude.
    suffix
        What the names of its energies end in.
    vector
        (3,) the part at an amplitude of one.
    """

    amplitude: str
    suffix: str
    vector: NDArray[np.float64]


@dataclass(frozen=True)
class Magnetisation:
    """Remanence, susceptibility and applied field of a model, with the law of their energy.

    Attributes
    ----------
    remanent, applied
        The flux densities over their magnitudes: vectors (3,), or a pattern for the remanent one.
    gradient
        (3, 3) of the applied flux density, which is applied + gradient . r; None if uniform.
    in_space
        The applied flux density as a function of the deformed place, in place of `applied` and
        `gradient`.
    driven
        Fields that amplitudes drive, added to `in_space`.
    across
        Vectors (3,), normal to `applied` and to each other, that the field turns towards, with
        amplitudes of their own.
    axes
        Unit vectors along `applied` and `across`.
    turns
        Rotations of all of a field in space, which are motions of `driven`, in their order.
    given
        Vectors that were given on the mesh, in place of `remanent`; None without.
    energy
        The full energy, or which of the paper's approximations takes its place.
    patches
        Vectors (3,) or patterns on named patches of a mesh, in place of `remanent`; None without.
    layers
        Fractions of the thickness and vectors (3,), from the inner face outwards, of which
        `remanent` is the average.
    law
        Whether the remanence moves with F, as in the paper, or with its rotation R.
    soft
        The soft-magnetic material; None without one. Alone, it leaves `remanent` zero.
    tesla
        The flux density of a remanence of length one in T; 1 if the case has no flux densities.
    metres
        R in m; 0 if the case has no lengths with units, or no flux densities.
    absent
        Whether the case says that nothing is magnetised, though it has a direction: the strength of
        the field is 0, and nothing reads.
    """

    remanent: NDArray[np.float64] | Pattern
    applied: NDArray[np.float64]
    energy: MagneticEnergy = "full"
    gradient: NDArray[np.float64] | None = None
    across: tuple[NDArray[np.float64], ...] = ()
    patches: Mapping[str, NDArray[np.float64] | Pattern] | None = None
    layers: tuple[tuple[float, NDArray[np.float64]], ...] = ()
    law: RemanenceLaw = "deformation"
    in_space: FieldInSpace | None = None
    axes: tuple[NDArray[np.float64], ...] = ()
    driven: tuple[MovingField, ...] = ()
    turns: tuple[RigidMotion, ...] = ()
    given: UserField | None = None
    soft: SoftMagnet | None = None
    tesla: float = 1.0
    metres: float = 0.0
    absent: bool = False

    @property
    def uniform(self) -> bool:
        """Whether the applied flux density is uniform."""
        return self.gradient is None and self.in_space is None

    @property
    def uniform_parts(self) -> list[UniformPart]:
        """The uniform parts of the field, along its first direction and across it."""
        vectors = (self.applied, *self.across)
        return [
            UniformPart(amplitude, suffix, vector)
            for (amplitude, suffix), vector in zip(SUFFIXES.items(), vectors, strict=False)
        ]

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Names of the amplitudes of the field: of its uniform parts, and of its rotations."""
        parts = (part.amplitude for part in self.uniform_parts)
        return (*parts, *(motion.name for motion in self.turns))

    def field_at(self, mu: Mapping[str, float], r: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the applied flux density (..., 3) at deformed places r (..., 3) over R.

        A uniform field has the magnitude of its strength. `mu` are all amplitudes by name.
        """
        strength = mu.get(FIELD.name, 0.0)
        if self.in_space and not strength:  # it multiplies all of the field
            return np.zeros_like(r)
        # a field in space, with what is driven: the first entries are B, without derivatives
        if self.in_space:
            x = r.reshape(-1, 3)
            B_at_rest, *_ = self.in_space(x)
            B = B_at_rest + sum(
                (field.field_at(x, mu).value[0] for field in self.driven), np.zeros(3)
            )
            return np.asarray(strength * B.reshape(r.shape))
        # a uniform field by its components, and perhaps a gradient
        uniform = strength * self.applied
        for name, component in zip(FIELD.components, self.across, strict=False):
            uniform = uniform + mu.get(name, 0.0) * component
        if self.gradient is None:
            return np.broadcast_to(uniform, r.shape)
        return np.asarray(uniform + strength * r @ self.gradient.T)

    def sign_of_images(self, mu: Mapping[str, float], r0: fem.Function, mirror: Mirror) -> float:
        """Return 1 if the field's mirror images continue it, -1 if their opposites do; collective.

        The applied field at some nodes of the placement r0 is compared with the reflected field at
        their mirror images, by the sign of the sum of scalar products over all ranks.
        """
        x = r0.x.array.reshape(-1, 3)
        x = x[:: len(x) // PLACES + 1]
        # the field at the mirror images, reflected back
        images = self.field_at(mu, mirror.image(x)) @ mirror.reflection
        scalar_products = float(np.sum(images * self.field_at(mu, x)))
        return float(np.sign(r0.function_space.mesh.comm.allreduce(scalar_products)))

    def on_cells(self, patches: Mapping[str, NDArray[np.bool_]], cells: int) -> "Magnetisation":
        """Return the magnetisation with patterns of cells in place of values on named patches.

        Parameters
        ----------
        patches
            Name of each patch -> which of this rank's cells are in it.
        cells
            Number of this rank's cells, with ghosts.

        Raises
        ------
        MeshError
            If there is no such patch.
        """
        remanent = by_patch(self.patches, patches, cells) if self.patches else self.remanent
        # the soft material in the same way: its values on patches become a pattern of cells
        soft = self.soft and self.soft.with_patches(
            lambda values: by_patch(values, patches, cells, "magnetic.susceptibility")
        )
        return replace(self, remanent=remanent, soft=soft)

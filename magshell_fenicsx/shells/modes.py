"""The lowest modes of a shell, with those that break the symmetry of its reduced model.

Each solves K phi = lambda M phi with M the inner product of displacements over the undeformed
mid-surface: lambda is the stiffness per area with which the shell resists phi. Lengths in R and
energies in E h R^2 make its unit E h/R^2. A shallow wave of the best length on a sphere under
pressure has lambda = 1 - (p/p_c)^2 in this unit, but for its tangential part.

With the mass of the shell as M, lambda is omega^2 rho R^2/E of small vibrations.

A reduced model (meridian, half or sector) has only some modes of the shell: those with its own
symmetry. The others come from further tangents: antisymmetric displacements of a half, or waves
cos(m theta) of a meridian, with coefficients (U + V, V, W) at nodes. A family is all modes that
share a tangent, constraints and an inner product. A state is a displacement u with amplitudes mu,
the load parameters. Rigid motions that nothing holds are the tangent's kernel at the undeformed
state; there they are modes with eigenvalue zero.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.assembly.oblique_supports import Projection
from magshell_fenicsx.continuation.modes import lowest_modes, null_vector
from magshell_fenicsx.continuation.system import State, Tangent, Vector, symmetric_part
from magshell_fenicsx.models.shell.antisymmetric import AntisymmetricModes
from magshell_fenicsx.parts.supports.supports import rigid_motions
from magshell_fenicsx.quantities.mode_labels import TORSION, breaks_symmetry, wave_label
from magshell_fenicsx.shells.mass import (
    Model,
    displacement_product,
    mass_factor,
    mass_matrix,
    wave_product,
)
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.shells.sector_modes import SectorModes
from magshell_fenicsx.shells.waves import Waves


@dataclass(frozen=True)
class ModeSpace:
    """The model whose displacements can show every mode of a shell, symmetric or not.

    Of a sector it is the model of its half.

    Attributes
    ----------
    model
        That model.
    displacement
        Function from a displacement of the given model to one of this model; collective.
    """

    model: Model
    displacement: Callable[[Vector], Vector] = lambda u: u

    def state(self, state: State) -> State:
        """Return a state of the given model as a state of this one; collective."""
        return State(self.displacement(state.u), dict(state.mu))


def mode_space(model: Model) -> ModeSpace:
    """Return the space of all modes of a model; collective.

    Of a sector, the first call compiles kernels.
    """
    modes = None if isinstance(model, MeridianModel) else model.symmetry_breaking_modes
    if isinstance(modes, SectorModes):
        return ModeSpace(modes.half_model, modes.unfold)
    return ModeSpace(model)


@dataclass(frozen=True)
class ShellMode:
    """A mode of the whole shell.

    Attributes
    ----------
    label
        "" if the model sees it itself, else "antisymmetric" or "m = 7", as in `Record.mode`.
    eigenvalue
        Over E h/R^2, of vibrations omega^2 rho R^2/E; negative for an unstable direction.
    vector
        Mode in the model's space; of a wave the coefficients (U + V, V, W).
    """

    label: str
    eigenvalue: float
    vector: Vector


@dataclass(frozen=True)
class _Family:
    """Modes that share a tangent, constraints, and an inner product.

    Attributes
    ----------
    label
        Label of its modes: "", "antisymmetric", "torsion", or "m = 7".
    tangent
        Function from a state to its tangent.
    constraints
        Conditions of its displacements.
    product
        Name and form of the inner product.
    projection
        Projection onto oblique supports; None without.
    contains
        Function that tells whether a mode belongs to the family.
    rigid
        Dimension of the kernel: rigid motions of the undeformed shell that nothing holds.
    motions
        Rigid motions that the family contains, where these are not all of the kernel.
    """

    label: str
    tangent: Callable[[State], Tangent]
    constraints: list[fem.DirichletBC]
    product: tuple[str, ufl.Form]
    projection: Projection | None = None
    contains: Callable[[Vector], bool] = lambda vector: True
    rigid: int = 0
    motions: Sequence[Vector] = ()


@dataclass
class ShellModes:
    """Modes of a model at any of its states.

    Computing them overwrites the model's tangent, on which a path relies.

    Attributes
    ----------
    model
        The model; of a sector, that of its half, which `mode_space` gives.
    _products
        Name of an inner product -> its compiled form.
    """

    model: Model
    _products: dict[str, fem.Form] = field(default_factory=dict)

    def lowest(
        self, state: State, count: int, *, allows_rigid_motion: bool = False
    ) -> list[ShellMode]:
        """Return the lowest modes, ascending: of every family `count`, and all that are negative.

        If the tangent is not symmetric, they are modes of its symmetric part. Waves count once,
        though each has a twin turned by a quarter of its length. The first call compiles a mass
        matrix and the waves' kernels.

        Parameters
        ----------
        state
            Equilibrium whose tangent is taken.
        count
            Number of modes of each family.
        allows_rigid_motion
            Whether the state is the undeformed one of a shell that nothing holds. Its rigid motions
            are then among the modes, with an eigenvalue of exactly zero.

        Raises
        ------
        ModesNotFound
            If the iteration for the eigenvalues does not find them.
        """
        return self._lowest(
            _families(self.model, rest=state if allows_rigid_motion else None), state, count
        )

    def vibrations(
        self, state: State, count: int, *, allows_rigid_motion: bool = False
    ) -> list[ShellMode]:
        """Return the `count` lowest natural modes, ascending, and all that are unstable.

        Eigenvalues are omega^2 rho R^2/E. The mass is consistent, without rotary inertia, and that
        of the undeformed shell. On the meridian vibrations around the axis are among them.

        Parameters
        ----------
        state
            Equilibrium whose tangent is taken.
        count
            Number of modes.
        allows_rigid_motion
            Whether the state is the undeformed one of a shell that nothing holds, whose rigid
            motions are then among the modes.

        Raises
        ------
        ModesNotFound
            If the iteration for the eigenvalues does not find them.
        """
        families = _families(
            self.model, vibrating=True, rest=state if allows_rigid_motion else None
        )
        modes = self._lowest(families, state, count)
        unstable_count = sum(mode.eigenvalue < 0 for mode in modes)
        return modes[: max(count, unstable_count)]

    def _lowest(self, families: Iterable[_Family], state: State, count: int) -> list[ShellMode]:
        """Return the lowest `count` modes of each family, ascending over all families.

        Rigid motions come with an eigenvalue of zero; negative eigenvalues are all included.
        """
        shell_modes = []
        for family in families:
            M = mass_matrix(self._product(family), family.constraints)
            M = family.projection.mass(M) if family.projection else M
            modes = lowest_modes(symmetric_part(family.tangent(state)), M, count, family.rigid)
            # The first `family.rigid` modes are rigid motions, in any combination. In the family of
            # torsion the motion along the axis is among them, which is none of its modes. So they
            # are left out there, and `family.motions` has those around the axis.
            if family.contains is _turns:
                modes = modes[family.rigid :]
            shell_modes += [
                ShellMode(family.label, 0.0, _normalised(motion, M)) for motion in family.motions
            ]
            shell_modes += [
                ShellMode(family.label, mode.eigenvalue, mode.vector)
                for mode in modes
                if family.contains(mode.vector)
            ]
        return sorted(shell_modes, key=lambda mode: mode.eigenvalue)

    def null_vector(self, state: State, label: str) -> Vector:
        """Return the mode whose stiffness is nearest to zero, at an instability the null vector.

        Parameters
        ----------
        state
            State at or near an instability.
        label
            `Record.mode` of the instability, such as "m = 7"; other labels stand for the model's
            own modes.

        Raises
        ------
        ModesNotFound
            If the iteration does not find it.
        """
        # "" is the label of the model's own family
        label = label if breaks_symmetry(label) else ""
        family = next(family for family in _families(self.model) if family.label == label)
        return null_vector(family.tangent(state))

    def _product(self, family: _Family) -> fem.Form:
        """Return the compiled inner product of a family, kept by its name."""
        name, form = family.product
        if name not in self._products:
            self._products[name] = self.model.kernels.compile(name, form)
        return self._products[name]


def _families(
    model: Model, *, vibrating: bool = False, rest: State | None = None
) -> Iterator[_Family]:
    """Yield the families of the model's own modes, then of those that break its symmetry.

    A family's kernels are compiled when it is yielded.

    Parameters
    ----------
    vibrating
        Whether the inner product is that of the mass; torsion is then a family of the meridian.
    rest
        Undeformed state of a shell that nothing holds, whose rigid motions are counted; else None.
    """
    mass_weight = mass_factor(model) if vibrating else None
    factor, prefix = (1.0, "") if mass_weight is None else (mass_weight, "weighted ")
    mass = f"{prefix}mass", displacement_product(model, factor)  # name and form
    if isinstance(model, MeridianModel):
        free_motions = model.rigid_motions(rest.mu) if rest else None
        axial_count = len(free_motions.axial) if free_motions else 0
        yield _family_of_system("", model.system, mass, axial_count)
        waves = model.waves
        wave_mass = f"{prefix}wave mass", wave_product(model, factor)
        if vibrating:
            torsions = [*free_motions.torsional] if free_motions else []
            yield _family_of_torsion(waves, wave_mass, torsions, axial_count)
        for m in range(1, waves.largest + 1):
            # motions across the axis are waves m = 1
            rigid = len(free_motions.transverse) if free_motions and m == 1 else 0
            yield _Family(
                wave_label(m),
                partial(waves.tangent, m=m),
                waves.constraints(m),
                wave_mass,
                rigid=rigid,
            )
        return

    def free_motion_count(system: FiniteElementSystem) -> int:
        """Return the number of rigid motions that nothing in a system holds, at rest."""
        return rigid_motions(system, model.r0, rest.mu) if rest else 0

    yield _family_of_system("", model.system, mass, free_motion_count(model.system))
    if isinstance(modes := model.symmetry_breaking_modes, AntisymmetricModes):
        rigid = free_motion_count(modes.system)
        yield _family_of_system(modes.label, modes.system, mass, rigid)


def _family_of_system(
    label: str, system: FiniteElementSystem, mass: tuple[str, ufl.Form], rigid: int
) -> _Family:
    """Return the family of all modes of a system, of which `rigid` are rigid motions.

    `mass` is the name and the form of the inner product.
    """
    return _Family(
        label,
        lambda state: system.tangent(state.u, state.mu),
        system.clamped,
        mass,
        system.projection,
        rigid=rigid,
    )


def _family_of_torsion(
    waves: Waves, mass: tuple[str, ufl.Form], torsions: Sequence[Vector], axial_count: int
) -> _Family:
    """Return the family of vibrations around the axis, which are waves m = 0.

    Parameters
    ----------
    mass
        Name and form of the inner product of waves.
    torsions
        Rigid turns about the axis that nothing holds.
    axial_count
        Number of rigid motions along the axis that nothing holds; waves m = 0 have these, too.
    """
    return _Family(
        TORSION,
        partial(waves.tangent, m=0),
        waves.constraints(0),
        mass,
        contains=_turns,
        rigid=len(torsions) + axial_count,
        motions=torsions,
    )


def _normalised(vector: Vector, M: PETSc.Mat) -> Vector:
    """Return a vector scaled so that phi . M phi = 1; on one rank alone."""
    phi, product = M.createVecs()
    phi.setArray(vector)
    M.mult(phi, product)
    return np.asarray(vector / np.sqrt(phi.dot(product)))


def _turns(coefficients: Vector) -> bool:
    """Return whether a wave m = 0, with coefficients (P, V, W), turns around the axis.

    Then V is its largest part. Other waves m = 0 are displacements of the meridian itself. P is
    U + V.
    """
    P, V, W = coefficients.reshape(-1, 3).T
    return bool(V @ V > (P - V) @ (P - V) + W @ W)

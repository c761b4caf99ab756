"""Plies of a shell: their section, the stiffnesses of a laminate, and the symmetry that it
preserves.

Classical lamination theory (R. M. Jones, *Mechanics of Composite Materials*, 1999, chapters 2 and
4): each ply is in plane stress and orthotropic, and the layer at the height z above the middle has
the strain E - z K.

E11, E22, 2 E12 are strains of the mid-surface, K changes of its curvature, Q the stiffness of a
ply. A, B and D are the stiffnesses of membrane, coupling and bending. Entries 16 and 26 couple
stretching with shear. Angles are from the direction `along`. E (a number) and h are Young's modulus
of the shell and its thickness, the units of stiffnesses. e3 is the axis of the case.
"""

from dataclasses import dataclass
from math import isnan
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ModelWrapValidatorHandler, PrivateAttr, model_validator

from magshell_fenicsx.input.section import Section, case_sizes, or_number
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.parts.ability import GEOMETRIES_WITHOUT_MERIDIAN, Ability, Context
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint, no_plane, unit

if TYPE_CHECKING:
    from magshell_fenicsx.models.shell.laminate import Laminate
    from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
Positive = Annotated[float, Field(gt=0)]
Modulus = Annotated[float, or_number("pascal", Positive), Field(gt=0)]
MERIDIAN = "meridian"
STIFFNESS_TOLERANCE = 1e-12  # over the largest stiffness: what is left where plies cancel
VOIGT_INDICES = ([0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2])  # of the entries 11, 12, 22, 16, 26, 66
TWISTING_ENTRIES = [3, 4]  # 16 and 26
MIN_MODULUS_RATIO, MAX_MODULUS_RATIO = 1e-9, 1e9  # of a modulus over E


class PlySection(Section):
    """An orthotropic ply."""

    _with_units: frozenset[bool] = PrivateAttr(default=frozenset())

    angle: float = Field(default=0.0, ge=-360, le=360)
    """From the direction `along` to the fibres, counterclockwise about the normal [degree]"""
    E1: Modulus
    """Young's modulus along the fibres, in the unit of youngs_modulus; without one over E
    [force/length²]"""
    E2: Modulus
    """Young's modulus across the fibres [force/length²]"""
    nu12: float = Field(gt=-10, lt=10)
    """Poisson's ratio: how it shrinks across the fibres when it is pulled along them; ν12² <
    E1/E2"""
    G12: Modulus
    """Shear modulus in the plane [force/length²]"""
    fraction: float = Field(gt=0, le=1)
    """Of the thickness; all add up to one [h]"""

    @model_validator(mode="wrap")
    @classmethod
    def _units(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Validate a ply, and note whether its moduli were given with units."""
        section = handler(data)
        if isinstance(data, dict):
            section._with_units = frozenset(
                isinstance(data[key], str) for key in ("E1", "E2", "G12")
            )
        return section

    @model_validator(mode="after")
    def _positive(self) -> Self:
        """Check that every strain costs energy: the stiffness must be positive definite."""
        if self.nu12**2 * self.E2 >= self.E1:
            raise ValueError(
                f"nu12: {self.nu12:g}: allowed is nu12^2 < E1/E2 = {self.E1 / self.E2:.4g}: else "
                "a strain costs no energy"
            )
        return self

    @property
    def stiffness(self) -> Array:
        """Stiffness Q (3, 3) with S = Q (E_11, E_22, 2 E_12), in the axes along and across `along`.

        S are the stresses of plane stress; Q has the unit of the moduli.
        """
        # in the axes along and across the fibres, symmetric
        nu21 = self.nu12 * self.E2 / self.E1
        Q_in_ply_axes = np.array(
            [[self.E1, nu21 * self.E1, 0], [nu21 * self.E1, self.E2, 0], [0, 0, 0]]
        ) / (1 - self.nu12 * nu21)
        Q_in_ply_axes[2, 2] = self.G12
        c, s = np.cos(np.radians(self.angle)), np.sin(np.radians(self.angle))
        c, s = (0.0 if abs(v) < 1e-15 else float(v) for v in (c, s))  # 90 degrees are exact
        # from (E_11, E_22, 2 E_12) along `along` to those along the fibres
        strain_transformation = np.array(
            [[c * c, s * s, c * s], [s * s, c * c, -c * s], [-2 * c * s, 2 * c * s, c * c - s * s]]
        )
        return np.asarray(strain_transformation.T @ Q_in_ply_axes @ strain_transformation)


class LaminateSection(Section):
    """Orthotropic plies in place of one isotropic material, in Koiter's law: membrane, bending, and
    both coupled.

    youngs_modulus and poisson_ratio of the shell are then those of its units alone: energies over E
    h R², p/p_c, forces over 2πD/R, moments over D/R.
    """

    along: (
        Literal["meridian"] | Annotated[list[float], Field(min_length=3, max_length=3)] | None
    ) = None
    """Direction of the angle 0: away from the pole on the meridians of e3, or the part in the
    surface of a vector; by default [1, 0, 0] of a strip, a plate and a mesh, meridian of all
    else"""
    plies: list[PlySection] = Field(min_length=1, max_length=200)
    """From the inner face outwards"""

    @model_validator(mode="after")
    def _fractions_add_up(self) -> Self:
        """Check the plies together: fractions, units of moduli, and the direction `along`."""
        if abs(sum(ply.fraction for ply in self.plies) - 1) > 1e-6:
            raise ValueError("plies: their fractions must add up to 1")
        if len(frozenset[bool]().union(*(ply._with_units for ply in self.plies))) > 1:
            raise ValueError("plies: give each of E1, E2, G12 a unit, or none of them")
        if isinstance(self.along, list) and not np.any(self.along):
            raise ValueError("along: a vector of length zero is no direction")
        return self

    @property
    def with_units(self) -> bool:
        """Whether moduli are in pascals."""
        return True in self.plies[0]._with_units

    @property
    def twists(self) -> bool:
        """Whether stretching or bending along or across `along` also shears or twists the shell."""
        return bool(np.any(self.matrices(1.0)[:, TWISTING_ENTRIES]))

    @property
    def isotropic(self) -> bool:
        """Whether the laminate is equally stiff in all directions."""
        # entries of A, B and D; the differences are zero if A11 = A22 and (A11 - A12)/2 = A66, and
        # likewise for B and D
        matrices = self.matrices(1.0)
        of_11, of_12, of_22, _, _, of_66 = matrices.T
        differences = np.stack([of_11 - of_22, (of_11 - of_12) / 2 - of_66])
        return not self.twists and bool(
            np.all(np.abs(differences) <= STIFFNESS_TOLERANCE * np.abs(matrices).max())
        )

    def matrices(self, E: float) -> Array:
        """Return the stiffnesses A, B and D of the laminate in units of E h, E h² and E h³.

        B has the sign of the strain E + z k.

        Parameters
        ----------
        E
            Young's modulus of the units, in the unit of the plies' moduli.

        Returns
        -------
        Array
            (3, 6): A, B and D, each with the entries 11, 12, 22, 16, 26, 66.
        """
        fractions = np.array([ply.fraction for ply in self.plies])
        # bounds of the plies over h, from -1/2 to 1/2
        heights = np.concatenate([[0.0], np.cumsum(fractions) / fractions.sum()]) - 0.5
        Q = np.array([ply.stiffness[VOIGT_INDICES] for ply in self.plies]) / E
        # integrals of Q, Q z and Q z^2 over the thickness
        stiffnesses = np.array([np.diff(heights**n) @ Q / n for n in (1, 2, 3)])
        # A, B and D are at most as large as these; much smaller values are rounding, where plies
        # cancel, and become zero
        largest_values = np.abs(Q).max() / np.array([1, 4, 12])[:, None]
        return np.where(
            np.abs(stiffnesses) <= STIFFNESS_TOLERANCE * largest_values, 0.0, stiffnesses
        )

    def direction(self, geometry: str) -> Array | None:
        """Return the unit vector (3,) whose part in the surface has the angle 0.

        It is None if the angle 0 is along the meridians. The default depends on the shell's
        `geometry`.
        """
        is_meridian_by_default = self.along is None and geometry not in GEOMETRIES_WITHOUT_MERIDIAN
        if self.along == MERIDIAN or is_meridian_by_default:
            return None
        return unit(np.array([1.0, 0.0, 0.0] if self.along is None else self.along))

    def refuse_unfit_sizes(self, E: float) -> None:
        """Check that the plies' moduli are not absurdly small or large against Young's modulus E.

        Raises
        ------
        ValueError
            With the key of the first such modulus.
        """
        for i, ply in enumerate(self.plies):
            for key in ("E1", "E2", "G12"):
                if not MIN_MODULUS_RATIO <= (ratio := getattr(ply, key) / E) <= MAX_MODULUS_RATIO:
                    raise ValueError(
                        f"shell.laminate.plies.{i}.{key}: is {ratio:.4g} times youngs_modulus: "
                        f"allowed {MIN_MODULUS_RATIO:g} to {MAX_MODULUS_RATIO:g}"
                    )


def laminate_of(shell: Any, turn: float) -> "Laminate | None":
    """Return the laminate of a shell for its model; None without plies.

    `turn` is the angle about e3 (rad) of the model's frame.
    """
    from magshell_fenicsx.models.shell.laminate import Laminate  # the solver takes long to import

    section: LaminateSection | None = shell.laminate
    if section is None:
        return None
    direction = section.direction(shell.geometry)
    direction_in_model = None if direction is None else rotation(turn) @ direction
    return Laminate(
        section.matrices(shell.youngs_modulus or 1.0), direction_in_model, section.isotropic
    )


@dataclass(frozen=True)
class ShellLaminate(Ability):
    """The laminate of a shell."""

    section: LaminateSection

    @classmethod
    def from_context(cls, context: Context) -> "ShellLaminate | None":
        return cls(context.shell.laminate) if context.shell.laminate else None

    def refuse_unfit(self, context: Context) -> None:
        """Check that the laminate goes with the shell.

        Moduli and youngs_modulus must both have units, or none. A laminate that twists needs the
        whole shell, since no plane mirrors it.

        Raises
        ------
        ValueError
            With the key and what is allowed.
        """
        section = self.section
        # both must have units, or neither; E is nan where youngs_modulus has none
        modulus_has_unit = not isnan(case_sizes(context.shell).E)
        if section.with_units != modulus_has_unit:
            moduli = (
                "have a unit: youngs_modulus has none"
                if section.with_units
                else "have none: youngs_modulus has one"
            )
            raise ValueError(
                f"shell.laminate.plies: their moduli {moduli}: give all of them a unit, or none"
            )
        section.refuse_unfit_sizes(context.shell.youngs_modulus or 1.0)
        context.needs("shell.laminate", "a mid-surface")  # refuses a solid
        if section.twists:
            context.needs(
                "shell.laminate",
                "the whole shell",
                hint="no plane of boundary: symmetry mirrors a laminate that twists: for each ply "
                "lay one at -angle, at the same distance from the middle",
            )

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return the symmetry that the plies preserve; all symmetry if they are isotropic."""
        return (
            []
            if self.section.isotropic
            else [_laminate_symmetry(self.section, context.shell.geometry)]
        )


def _laminate_symmetry(section: LaminateSection, geometry: str) -> SymmetryConstraint:
    """Return the symmetry that an anisotropic laminate preserves on a geometry.

    No plane mirrors a laminate that twists. Other laminates are mirrored by planes that keep the
    direction of the angle 0; they are axisymmetric if this is along the meridians.
    """
    direction = section.direction(geometry)  # of the angle 0; None along the meridians
    # why it is not axisymmetric; None if it is
    reason = None
    if section.twists:
        reason = (
            "the laminate is not balanced about the meridian, and twists the shell: lay a ply at "
            "-angle for each"
        )
    elif direction is not None and np.hypot(*direction[:2]) > STIFFNESS_TOLERANCE:
        reason = (
            "the angle 0 of the plies is not along the meridians: give laminate.along: meridian"
        )
    if section.twists:
        return SymmetryConstraint(reason, mirrors=no_plane)
    # if the angle 0 is along a vector, the planes through e3 along and across it may be planes of
    # symmetry; if it is along the meridians, no plane through e3 is preferred
    azimuths: tuple[float, ...] = ()
    if direction is not None:
        azimuth = float(np.arctan2(direction[1], direction[0]))
        azimuths = tuple(azimuth + turn for turn in (0.0, np.pi / 2))
    return SymmetryConstraint(
        reason, mirrors=lambda mirror: mirror.keeps_lines(direction), azimuths=azimuths
    )


def laminate_account(section: LaminateSection, shell: Any) -> str:
    """Return the line of `magshell check` on a laminate: plies and main stiffnesses."""
    A, B, D = section.matrices(shell.youngs_modulus or 1.0)
    # the angles of the first twelve plies
    angles = "/".join(f"{ply.angle:g}" for ply in section.plies[:12])
    if len(section.plies) > 12:
        angles += "/..."
    vector = section.direction(shell.geometry)
    direction_words = (
        "the meridian" if vector is None else f"[{', '.join(f'{v:g}' for v in vector)}]"
    )
    coupled = f"B up to {np.abs(B).max():.4g} E h^2 couples both" if B.any() else "not coupled"
    # the first and third of the six entries are 11 and 22
    return (
        f"membrane and bending energy of a laminate [{angles}] with 0 along {direction_words}: "
        f"A11, A22 = {A[0]:.4g}, {A[2]:.4g} E h, D11, D22 = {D[0]:.4g}, {D[2]:.4g} E h^3, "
        f"{coupled}"
    )

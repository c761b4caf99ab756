"""Motions of supports: edges, points and patches that are held and move as rigid bodies.

A step of the load programme moves them. Its amplitude (load parameter) is the factor of all its
motions; the conjugate of the factor, on which it does work, is the reaction. A `RigidMotion` is a
shift (translation), a turn (rotation vector) and a centre, a point of the axis, over R and in the
frame of the model, which may be turned about e3. R is the reference length of the shell.
"""

from math import copysign, radians
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from magshell_fenicsx.assembly.rigid_motion import RigidMotion
from magshell_fenicsx.input.section import AboutAxis, Lengths, Name, Section, or_number
from magshell_fenicsx.mesh.mirror import ROUNDING, Mirror, rotation
from magshell_fenicsx.parts.ability import Context, Modelled
from magshell_fenicsx.parts.path_step import Count, PathStep
from magshell_fenicsx.parts.step_course import (
    LONG_TUBE_SIZE,
    LoadStart,
    MeshHints,
    SizingContext,
    Target,
    Until,
)
from magshell_fenicsx.parts.supports.boundary import BoundarySection
from magshell_fenicsx.quantities.registry import QUANTITIES, RESERVED_NAMES
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint

if TYPE_CHECKING:
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
UNHELD_CONDITIONS = ("free", "symmetry")


class TurnSection(AboutAxis):
    """A rotation about an axis through a point."""

    point: Lengths
    """On the axis, where the shell is undeformed [the shell's length; over R if that has no
    unit]"""


class MoveSection(Section):
    """A rigid motion of supports: first a rotation, then a translation, for a factor of one.

    A clamped edge turns with its normal. The angle, and the translation, are proportional to the
    factor.
    """

    supports: list[str] = Field(min_length=1, max_length=1000)
    """Names of `boundary` that hold displacements: edges, points or patches"""
    translation: Lengths | None = None
    """For a factor of one [the shell's length; over R if that has no unit]"""
    rotation: TurnSection | None = None
    """About a fixed axis"""

    @model_validator(mode="after")
    def _it_moves(self) -> Self:
        if self.rotation is None and not any(self.translation or []):
            raise ValueError("give a translation that is not zero, a rotation, or both")
        return self


class EdgeSection(PathStep):
    """Supports that move, all in proportion to one factor.

    Its conjugate is the reaction: the forces of the supports along their translations (their work
    over the sum of the lengths of these), without translations the moments about the axes; with a
    pressure, that on the rigid lids which close such edges counts. Later steps may move the same
    supports again, from where they are then.
    """

    conjugate: ClassVar[str] = "reaction"
    released: ClassVar[str] = "a support that is free to move has a mass, which is not known"
    jumps: ClassVar[bool] = False
    conjugate_control: ClassVar[str] = "reaction"
    targets: ClassVar[dict[str, Target]] = {
        "factor": Target("load", "motion"),
        "reaction": Target("conjugate", "reaction"),
    }
    kind: Literal["edge"]
    name: Name = "motion"
    """Name of the factor, which is its column in path.csv"""
    moves: list[MoveSection] = Field(min_length=1, max_length=100)
    """Motions of supports"""
    control: Literal["load", "reaction", "arc"] = "arc"
    """What is prescribed step by step: the factor, the reaction, or arc length, which passes every
    fold"""
    until: Until = "target"
    factor: float | None = Field(default=None, ge=-1e9, le=1e9)
    """Target of the factor, 1 by default; with control: load or arc"""
    reaction: Annotated[float, or_number("newton"), Field(ge=-1e30, le=1e30)] | None = None
    """Target of the reaction; with control: reaction or arc [force; of rotations alone force times
    length]"""
    points: Count = 10

    @model_validator(mode="after")
    def _each_once(self) -> Self:
        """Check that the factor's name is free, and that no support moves twice in the step."""
        # "motion" is the column of a motion without a name of its own
        if self.name in ({*RESERVED_NAMES, *QUANTITIES} - {"motion"}):
            raise ValueError(
                f"name: {self.name}: is taken; choose another name for the factor of the motion"
            )
        supports = [name for move in self.moves for name in move.supports]
        if repeated := next((name for name in supports if supports.count(name) > 1), None):
            raise ValueError(
                f"moves: {repeated}: moves twice in one step; let a later step move it again"
            )
        return self

    @property
    def amplitude(self) -> str:  # type: ignore[override]  # each motion has a name of its own
        return self.name

    @property
    def place(self) -> Any:
        return self.moves

    @property
    def _end(self) -> float | None:
        return 1.0 if self.reaction is None and self.control != "reaction" else None

    def first_change(self, change: float, load_start: LoadStart, *, by_load: bool) -> float:
        if by_load:
            return change / self.points
        # the reaction, -dPi/d(factor), falls where the factor grows: the signs are opposite
        return copysign(1e-3 * self.scale(load_start), -change)

    def step(self, change: float | None, load_start: LoadStart) -> float | None:
        return abs(change) / self.points if self.control == "reaction" and change else None

    def scale(self, load_start: LoadStart) -> float:
        return abs(self.factor or 1.0)

    def mesh_hints(self, sizing: SizingContext) -> MeshHints:
        """Return the element sizes for the motions: torsion makes long waves along a tube."""
        is_torsion = all(_turns_about_e3(move) for move in self.moves)
        return MeshHints(along_tube=LONG_TUBE_SIZE) if is_torsion else MeshHints()

    def refuse_unfit(self, context: Context) -> None:
        """Check that `boundary` holds all supports that move.

        Raises
        ------
        ValueError
            With the key, and the supports that can move.
        """
        boundary = context.section_of(BoundarySection)
        conditions = boundary.conditions() if boundary else {}
        held_names = sorted(
            name for name, condition in conditions.items() if condition not in UNHELD_CONDITIONS
        )
        for i, move in enumerate(self.moves):
            for name in move.supports:
                if name not in held_names:
                    raise ValueError(
                        f"{context.step.key}.moves.{i}.supports: {name}: only what boundary holds "
                        f"(clamped, hinged or held) can move: {', '.join(held_names) or 'nothing'}"
                    )

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return the symmetry that the motions of supports preserve."""
        R = context.shell.reference
        return [
            SymmetryConstraint(
                sideways(self), held_vectors(self), lambda mirror: mirrored(self, R, mirror)
            )
        ]

    def contribution(self, context: Context, modelled: Modelled) -> "Loads":
        """Return the motions of supports over R."""
        # the solver takes long to import
        from magshell_fenicsx.models.shell.parameters import Move
        from magshell_fenicsx.parts.loads import Loads

        R, turn, name = context.shell.reference, modelled.turn, context.step.name
        moves = (Move(tuple(move.supports), motion(move, name, R, turn)) for move in self.moves)
        return Loads(moves=tuple(moves))


def _turns_about_e3(move: MoveSection) -> bool:
    """Return whether supports turn about the axis e3, and do nothing else."""
    if move.rotation is None or any(move.translation or []):
        return False
    axis, point = move.rotation.axis, move.rotation.point
    return not any((*axis[:2], *point[:2]))


def motion(move: MoveSection, name: str, R: float, turn: float = 0.0) -> RigidMotion:
    """Return the rigid motion of a section for a factor of one, in the frame of a model.

    Parameters
    ----------
    name
        Name of the amplitude.
    R
        Reference length, in the unit of the section's lengths.
    turn
        Angle of the model's frame about e3 (rad).
    """
    # Q turns the frame of the case into that of the model
    Q, rotation_section, zero = rotation(turn), move.rotation, np.zeros(3)
    shift = Q @ (np.array(move.translation) / R) if move.translation else zero
    if rotation_section is None:
        return RigidMotion(name, shift, turn=zero, centre=zero)
    axis = np.array(rotation_section.axis) / np.linalg.norm(rotation_section.axis)
    return RigidMotion(
        name,
        shift,
        turn=radians(rotation_section.angle) * (Q @ axis),
        centre=Q @ (np.array(rotation_section.point) / R),
    )


def sideways(load: EdgeSection) -> str | None:
    """Return why the motion of supports is not axisymmetric about e3; None if it is."""
    for move in load.moves:
        has_shift_across = any((move.translation or [])[:2])
        if move.rotation or has_shift_across:
            return f"the motion of {move.supports[0]} is not along e3"
    return None


def held_vectors(load: EdgeSection) -> list[Array]:
    """Return unit vectors (3,) that a mirror plane through e3 must contain.

    They are the directions of translations, and the normals of e3 and the axes of rotation.
    """
    vectors = [np.array(move.translation) for move in load.moves if move.translation]
    vectors += [
        np.cross([0.0, 0.0, 1.0], move.rotation.axis) for move in load.moves if move.rotation
    ]
    return [v / np.linalg.norm(v) for v in vectors if v.any()]


def mirrored(load: EdgeSection, R: float, mirror: Mirror) -> bool:
    """Return whether a plane maps the motions of all supports onto each other.

    `R` is the reference length in the unit of the section's lengths.
    """
    # the name of the amplitude is not compared
    motions = {name: motion(move, "", R) for move in load.moves for name in move.supports}
    for name, rigid_motion in motions.items():
        image = motions.get(mirror.image_of_edge(name))
        if image is None or not _is_image(rigid_motion, image, mirror):
            return False
    return True


def _is_image(first: RigidMotion, second: RigidMotion, mirror: Mirror) -> bool:
    """Return whether the second rigid motion is the mirror image of the first.

    A mirrored rotation runs the other way about the mirrored axis. Its centre may be any point of
    that axis.
    """
    S, largest = mirror.reflection, max(np.abs([first.shift, first.turn]).max(), ROUNDING)
    # a rotation vector changes its sign beside its reflection, as the rotation runs the other way
    has_shift = np.abs(S @ first.shift - second.shift).max() < ROUNDING * largest
    has_turn = np.abs(S @ first.turn + second.turn).max() < ROUNDING * largest
    # way between the centres, whose part across the axis must be zero; the axis is a unit vector,
    # or zero without a rotation
    axis = second.turn / (np.linalg.norm(second.turn) or 1.0)
    offset = mirror.image(first.centre) - second.centre
    has_axis = not second.turns or np.abs(offset - (offset @ axis) * axis).max() < ROUNDING
    return all((has_shift, has_turn, has_axis))

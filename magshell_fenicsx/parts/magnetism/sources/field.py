"""The whole applied field where it is known by its values: formulas, sources, and what is uniform
beside these.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import acos, radians

import numpy as np

from magshell_fenicsx.assembly.rigid_motion import RigidMotion, apply_motions
from magshell_fenicsx.input.expressions import FormulasInSpace, formula_with_derivatives
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.magnetism.field_step import RotationSection, turn_name
from magshell_fenicsx.parts.magnetism.fields import AppliedSection, MagneticSection
from magshell_fenicsx.parts.magnetism.moving_source import FieldInSpace, MovingField
from magshell_fenicsx.parts.magnetism.source_step import SourceStep
from magshell_fenicsx.parts.magnetism.sources.source import Array, PlacedSource
from magshell_fenicsx.parts.step import ProgrammeStep

HALFWAY = 0.371  # of a motion: no symmetric place


@dataclass(frozen=True)
class Linear:
    """A field b + G x."""

    b: Array
    G: Array

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        n = len(x)
        return self.b + x @ self.G.T, np.broadcast_to(self.G, (n, 3, 3)), np.zeros((n, 3, 3, 3))


@dataclass(frozen=True)
class FieldSum:
    """The sum of some fields, perhaps of none."""

    parts: Sequence[FieldInSpace]

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        n = len(x)
        B, G, H = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3, 3, 3))
        for part in self.parts:
            for total, addend in zip((B, G, H), part(x), strict=True):
                total += addend
        return B, G, H


def placed_sources(context: Context, turn: float = 0.0) -> list[PlacedSource]:
    """Return the sources of a case, in a frame turned by `turn` about e3 (rad).

    Raises
    ------
    CaseError
        If magpylib is missing, or a file is no grid.
    """
    applied = _applied(context)
    if applied is None or not applied.sources:
        return []
    R, unit, Q = context.shell.reference, applied.reference, rotation(turn)
    assert unit
    sources = list[PlacedSource]()
    for i, section in enumerate(applied.sources):
        key = f"magnetic.applied.sources.{i}"
        position = [x / R for x in section.position]
        field_of_source = section.field(key, R)
        sources.append(
            PlacedSource(
                field_of_source, Q @ position, Q @ section.axes, R, section.strength / unit, key
            )
        )
    return sources


def _applied(context: Context) -> AppliedSection | None:
    magnetic = context.section_of(MagneticSection)
    return magnetic.applied if magnetic else None


def turns(context: Context, turn: float = 0.0) -> tuple[RigidMotion, ...]:
    """Return the rotations of the whole field about the origin, one for each step that rotates it.

    There are none for a uniform field, which has components instead.
    """
    applied = _applied(context)
    if applied is None or not (applied.components or applied.sources or applied.gradient):
        return ()
    rotations, start, zero = list[RigidMotion](), applied.vector(turn), np.zeros(3)
    for step in context.steps:
        if isinstance(step.load, RotationSection):
            end = step.load.to.vector(turn)
            axis = np.cross(start, end)
            angle = acos(float(start @ end))
            rotations.append(
                RigidMotion(turn_name(step), zero, angle * axis / np.linalg.norm(axis), zero)
            )
            start = end
    return tuple(rotations)


def in_space(
    context: Context, turn: float = 0.0
) -> tuple[FieldInSpace | None, tuple[MovingField, ...]]:
    """Return the field at rest, None if it is uniform or linear, and the moving fields.

    Both are in a frame turned by `turn` about e3 (rad).

    Raises
    ------
    CaseError
        If a source cannot be built.
    """
    applied, Q = _applied(context), rotation(turn)
    if applied is None:
        return None, ()
    formulas = [formula_with_derivatives(text) for text in applied.components or []]
    by_formula = FormulasInSpace(formulas, Q) if formulas else None
    rotations = turns(context, turn)
    if not applied.sources and not rotations:
        return by_formula, ()
    parts = list[FieldInSpace]()
    if applied.has_field_beside_sources:
        G = Q @ np.array(applied.gradient or np.zeros((3, 3))) @ Q.T
        parts.append(by_formula or Linear(applied.uniform * applied.vector(turn), G))
    moving_fields = list[MovingField]()
    for number, source in enumerate(placed_sources(context, turn)):
        moving_field = _moving_source(applied, context.steps, number, source, rotations, Q)
        if moving_field.names:
            moving_fields.append(moving_field)
        else:
            parts.append(source)
    if rotations:
        moving_fields += [MovingField(part, rotations) for part in parts]
        parts = []
    return FieldSum(parts), tuple(moving_fields)


def _moving_source(
    applied: AppliedSection,
    steps: Sequence[ProgrammeStep],
    number: int,
    source: PlacedSource,
    rotations: Sequence[RigidMotion],
    Q: Array,
) -> MovingField:
    """Return a source with the amplitudes of its steps.

    Rotations about its own position come before all other motions.
    """
    spins, moves, factors, zero = (
        list[RigidMotion](),
        list[RigidMotion](),
        dict[str, float](),
        np.zeros(3),
    )
    rotation_of = {motion.name: motion for motion in rotations}
    loads = {step.name: step.load for step in steps if isinstance(step.load, SourceStep)}
    steps_of_source = {
        name for name, load in loads.items() if load.number(applied.sources or []) == number
    }
    for step in steps:
        if isinstance(step.load, RotationSection):
            moves.append(rotation_of[turn_name(step)])
        if step.name not in steps_of_source:
            continue
        steps_of_source.remove(step.name)
        load, name = loads[step.name], step.name
        if load.turn:
            axis = np.array(load.turn.axis) / np.linalg.norm(load.turn.axis)
            spins.append(
                RigidMotion(name, zero, radians(load.turn.angle) * (Q @ axis), source.position)
            )
        elif load.strength is not None:
            factors[name] = load.strength - 1
        else:
            end = np.array(load.move or load.to) / source.length
            begin = apply_motions(
                moves, dict.fromkeys((m.name for m in moves), 1.0), source.position[None]
            ).x[0]
            moves.append(RigidMotion(name, Q @ end - (begin if load.to else zero), zero, zero))
    return MovingField(source, [*spins, *moves], factors)


def values(context: Context) -> list[Callable[[Array], Array]]:
    """Return functions of places (n, 3) -> B over |B^a|, for sources at several amplitudes.

    The first is for the sources as they begin; the others have one amplitude changed each.
    """
    field_at_rest, moving_fields = in_space(context)
    if field_at_rest is None:
        return []
    names = [name for field in moving_fields for name in field.names]
    mus = [dict.fromkeys(names, 0.0)]
    mus += [{**mus[0], name: mu} for name in names for mu in (HALFWAY, 1.0)]

    def field_at(mu: dict[str, float]) -> Callable[[Array], Array]:
        return lambda x: np.asarray(
            field_at_rest(x)[0]
            + sum((field.field_at(x, mu).value[0] for field in moving_fields), np.zeros(3))
        )

    return [field_at(mu) for mu in mus]

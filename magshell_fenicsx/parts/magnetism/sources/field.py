"""The whole applied field where it is known by its values: formulas, sources, and a uniform part.

Fields are `FieldInSpace`: functions of places over R that return B over |B^a|, the applied field's
reference, with its first and second derivatives.

A context holds the sections and steps of a case. A field at rest is one without amplitudes; a
moving field has amplitudes (factors, by name) that shift, turn or multiply it, and is at rest where
they are zero. Each step that moves a source has one amplitude, which is one at the end of the full
motion; so has each step that turns the whole field. The frame of a model is that of the case,
turned by an azimuth about e3.
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

HALFWAY = 0.371  # fraction of a motion, at no symmetric place


@dataclass(frozen=True)
class Linear:
    """The field B = b + G x with its derivatives, a `FieldInSpace`."""

    b: Array
    G: Array

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        """Return B (n, 3) at places x (n, 3) with its first and second derivatives."""
        n = len(x)
        return self.b + x @ self.G.T, np.broadcast_to(self.G, (n, 3, 3)), np.zeros((n, 3, 3, 3))


@dataclass(frozen=True)
class FieldSum:
    """The sum of some fields, each a `FieldInSpace`; zero of none."""

    parts: Sequence[FieldInSpace]

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        """Return B (n, 3) at places x (n, 3) with its first and second derivatives."""
        n = len(x)
        B, G, H = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3, 3, 3))
        for part in self.parts:
            for total, addend in zip((B, G, H), part(x), strict=True):
                total += addend
        return B, G, H


def placed_sources(context: Context, turn: float = 0.0) -> list[PlacedSource]:
    """Return the sources of a case, each at its place in the frame of a model.

    `turn` is the azimuth of that frame about e3 in radians.

    Raises
    ------
    CaseError
        If magpylib is missing, or a file is no grid.
    """
    applied = _applied(context)
    if applied is None or not applied.sources:
        return []
    # unit: |B^a| in T
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
    """Return the section of the applied field; None without one."""
    magnetic = context.section_of(MagneticSection)
    return magnetic.applied if magnetic else None


def turns(context: Context, turn: float = 0.0) -> tuple[RigidMotion, ...]:
    """Return the rotations of the whole field about the origin, one for each step that rotates it.

    A uniform field has none: its components are amplitudes instead. `turn` is the azimuth of the
    model's frame about e3 in radians.
    """
    applied = _applied(context)
    if applied is None or applied.is_uniform:
        return ()
    # each step turns the field's axis from where the last one left it, by the shortest way
    rotations, start, zero = list[RigidMotion](), applied.vector(turn), np.zeros(3)
    for step in context.steps:
        if isinstance(step.load, RotationSection):
            end = step.load.to.vector(turn)
            axis = np.cross(start, end)
            angle = acos(float(start @ end))
            rotation_vector = angle * axis / np.linalg.norm(axis)
            # no shift, about the origin
            rotations.append(RigidMotion(turn_name(step), zero, rotation_vector, zero))
            start = end
    return tuple(rotations)


def in_space(
    context: Context, turn: float = 0.0
) -> tuple[FieldInSpace | None, tuple[MovingField, ...]]:
    """Return the field that is known by values, at rest and moving, in the frame of a model.

    `turn` is the azimuth of that frame about e3 in radians.

    Returns
    -------
    at_rest
        The field that no amplitude moves; None if all of it is uniform or linear.
    moving_fields
        Fields with the amplitudes that move or multiply them.

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
    fields_at_rest = list[FieldInSpace]()
    # formulas, or a uniform field with its gradient
    if applied.has_field_beside_sources:
        G = Q @ np.array(applied.gradient or np.zeros((3, 3))) @ Q.T
        fields_at_rest.append(by_formula or Linear(applied.uniform * applied.vector(turn), G))
    moving_fields = list[MovingField]()
    for number, source in enumerate(placed_sources(context, turn)):
        moving_field = _moving_source(applied, context.steps, number, source, rotations, Q)
        if moving_field.names:
            moving_fields.append(moving_field)
        else:
            fields_at_rest.append(source)
    # rotations of the whole field move all that rests, too
    if rotations:
        moving_fields += [MovingField(field_at_rest, rotations) for field_at_rest in fields_at_rest]
        fields_at_rest = []
    return FieldSum(fields_at_rest), tuple(moving_fields)


def _moving_source(
    applied: AppliedSection,
    steps: Sequence[ProgrammeStep],
    number: int,
    source: PlacedSource,
    rotations: Sequence[RigidMotion],
    Q: Array,
) -> MovingField:
    """Return a source as a field with the amplitudes of all steps that move it.

    Motions are carried out one after the other: first all rotations about the source's own position
    at rest (`spins`), then shifts and rotations of the whole field (`moves`) in the order of the
    steps.

    Parameters
    ----------
    applied
        Section of the applied field, with the list of sources.
    steps
        Steps of the programme.
    number
        Number of the source in the list of sources.
    rotations
        Rotations of the whole field about the origin, one for each step that rotates it.
    Q
        Rotation (3, 3) from the frame of the case to that of the model.
    """
    spins, moves, factors = list[RigidMotion](), list[RigidMotion](), dict[str, float]()
    zero = np.zeros(3)
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
        # later steps of the same amplitude continue this motion, which is added once
        steps_of_source.remove(step.name)
        load, name = loads[step.name], step.name
        if load.turn:
            axis = np.array(load.turn.axis) / np.linalg.norm(load.turn.axis)
            spins.append(
                RigidMotion(name, zero, radians(load.turn.angle) * (Q @ axis), source.position)
            )
        elif load.strength is not None:
            factors[name] = load.strength - 1  # the change of the factor, from one
        elif load.move:
            shift = np.array(load.move) / source.length
            moves.append(RigidMotion(name, Q @ shift, zero, zero))
        else:
            # from where all motions before this step have taken the source, in full
            full_motions = dict.fromkeys((motion.name for motion in moves), 1.0)
            begin = apply_motions(moves, full_motions, source.position[None]).x[0]
            end = np.array(load.to) / source.length
            moves.append(RigidMotion(name, Q @ end - begin, zero, zero))
    return MovingField(source, [*spins, *moves], factors)


def values(context: Context) -> list[Callable[[Array], Array]]:
    """Return functions of places x (n, 3) over R that give B (n, 3) over |B^a|.

    The first is the field as it begins. Each further one has one amplitude changed, halfway or to
    one. The list is empty for a uniform or linear field.
    """
    field_at_rest, moving_fields = in_space(context)
    if field_at_rest is None:
        return []
    names = [name for field in moving_fields for name in field.names]
    mus = [dict.fromkeys(names, 0.0)]
    mus += [{**mus[0], name: mu} for name in names for mu in (HALFWAY, 1.0)]

    def field_at(mu: dict[str, float]) -> Callable[[Array], Array]:
        """Return the function of places that gives B for amplitudes mu."""

        def B_at(x: Array) -> Array:
            # [0]: B without its derivatives
            B = field_at_rest(x)[0]
            moving = (field.field_at(x, mu).value[0] for field in moving_fields)
            return np.asarray(B + sum(moving, np.zeros(3)))

        return B_at

    return [field_at(mu) for mu in mus]

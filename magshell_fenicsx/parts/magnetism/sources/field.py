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
from magshell_fenicsx.parts.magnetism.field_step import RotationSection, turn_name
from magshell_fenicsx.parts.magnetism.fields import AppliedSection, MagneticSection
from magshell_fenicsx.parts.magnetism.moving_source import FieldInSpace, MovingField
from magshell_fenicsx.parts.magnetism.source_step import SourceStep
from magshell_fenicsx.parts.magnetism.sources.source import Array, PlacedSource
from magshell_fenicsx.parts.part import Context
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
class Sum:
    """The sum of some fields, perhaps of none."""

    parts: Sequence[FieldInSpace]

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        n = len(x)
        B, G, H = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3, 3, 3))
        for part in self.parts:
            for whole, own in zip((B, G, H), part(x), strict=True):
                whole += own
        return B, G, H


def placed(context: Context, turn: float = 0.0) -> list[PlacedSource]:
    """The sources of a case, in a frame turned about e3 (rad).

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
        own = section.field(key, R)
        sources.append(
            PlacedSource(own, Q @ position, Q @ section.axes, R, section.strength / unit, key)
        )
    return sources


def _applied(context: Context) -> AppliedSection | None:
    magnetic = context.of(MagneticSection)
    return magnetic.applied if magnetic else None


def turns(context: Context, turn: float = 0.0) -> tuple[RigidMotion, ...]:
    """The rotations of all of the field about the origin, of a field that is known by values, or
    has a gradient.
    """
    applied = _applied(context)
    if applied is None or not (applied.components or applied.sources or applied.gradient):
        return ()
    rotations, before, zero = list[RigidMotion](), applied.vector(turn), np.zeros(3)
    for step in context.steps:
        if isinstance(step.load, RotationSection):
            after = step.load.to.vector(turn)
            axis = np.cross(before, after)
            angle = acos(float(before @ after))
            rotations.append(
                RigidMotion(turn_name(step), zero, angle * axis / np.linalg.norm(axis), zero)
            )
            before = after
    return tuple(rotations)


def in_space(
    context: Context, turn: float = 0.0
) -> tuple[FieldInSpace | None, tuple[MovingField, ...]]:
    """The field that stays, None if it is built in, and the fields that steps drive, in a frame
    turned about e3 (rad).

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
    if applied.beside:
        G = Q @ np.array(applied.gradient or np.zeros((3, 3))) @ Q.T
        parts.append(by_formula or Linear(applied.uniform * applied.vector(turn), G))
    driven = list[MovingField]()
    for number, source in enumerate(placed(context, turn)):
        one = _driven(applied, context.steps, number, source, rotations, Q)
        if one.names:
            driven.append(one)
        else:
            parts.append(source)
    if rotations:
        driven += [MovingField(part, rotations) for part in parts]
        parts = []
    return Sum(parts), tuple(driven)


def _driven(
    applied: AppliedSection,
    steps: Sequence[ProgrammeStep],
    number: int,
    source: PlacedSource,
    rotations: Sequence[RigidMotion],
    Q: Array,
) -> MovingField:
    """A source with the amplitudes of its steps; turns about its own position come before all other
    motions.
    """
    spins, moves, factors, zero = (
        list[RigidMotion](),
        list[RigidMotion](),
        dict[str, float](),
        np.zeros(3),
    )
    of_all = {motion.name: motion for motion in rotations}
    loads = {step.name: step.load for step in steps if isinstance(step.load, SourceStep)}
    own = {name for name, load in loads.items() if load.number(applied.sources or []) == number}
    for step in steps:
        if isinstance(step.load, RotationSection):
            moves.append(of_all[turn_name(step)])
        if step.name not in own:
            continue
        own.remove(step.name)
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
    """B over |B^a| at places (n, 3) as the sources are at first, and where each amplitude of them
    has changed.
    """
    still, driven = in_space(context)
    if still is None:
        return []
    names = [name for each in driven for name in each.names]
    mus = [dict.fromkeys(names, 0.0)]
    mus += [{**mus[0], name: mu} for name in names for mu in (HALFWAY, 1.0)]

    def at(mu: dict[str, float]) -> Callable[[Array], Array]:
        return lambda x: np.asarray(
            still(x)[0] + sum((each.at(x, mu).value[0] for each in driven), np.zeros(3))
        )

    return [at(mu) for mu in mus]

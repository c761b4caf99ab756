"""The steps of a programme: what is held, what is driven, and the records of the way."""

from dataclasses import replace
from math import acos

import numpy as np

from magshell_fenicsx.continuation.device import Conjugate
from magshell_fenicsx.continuation.path import StepOptions
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.continuation.walk import MOST_STEPS, Goal
from magshell_fenicsx.parts.bodies.press import ContactSection
from magshell_fenicsx.parts.bodies.touch import touched
from magshell_fenicsx.parts.magnetism.direction import as_a_whole, circle, components, field_angle, field_at, straight
from magshell_fenicsx.parts.magnetism.field_step import FieldBefore, FieldSection, RotationSection
from magshell_fenicsx.parts.magnetism.sources.field import turn_name
from magshell_fenicsx.parts.motion.step import TimeSection
from magshell_fenicsx.parts.pressure.gas import gas
from magshell_fenicsx.parts.step import Drive, Gas, Now, PathStep, ProgrammeStep
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage, staged
from magshell_fenicsx.simulate.transient import motion
from magshell_fenicsx.simulate.walked import Records, Walked, followed

LOCATED = ("fold", "bifurcation")
SHARP = 1e-9  # least step along a contact: folds are as sharp as the penalty's stiffness changes, over 1e-3 h of gap
EASY, HARD = 4, 8  # matrices of a step along a contact, whose rim moves from point to point before it settles


def records_of(scene: Scene, step: ProgrammeStep, state: State) -> Records:
    """The records of a step; its return value is the state at its end.

    Raises
    ------
    Stopped
        If the path is lost, or a field that should be stable is not.
    """
    load = step.load
    if isinstance(load, TimeSection):
        return (yield from motion(scene, load, state, held_by(scene, step, state)))
    if isinstance(load, RotationSection):
        return (yield from _rotation(scene, step, load, state))
    assert isinstance(load, PathStep)
    if isinstance(load, ContactSection):
        state = touched(scene, step, state)
    stage = stage_of(scene, step, state)
    drive = load.drive(_now(scene, step, state))
    if step.name in load.hold:
        return (yield from _at_held_conjugate(scene, step, state, drive))
    if step.name == "pressure" and scene.model.without_potential and "control" not in load.model_fields_set:
        drive = replace(drive, control="arc")
    path, start = stage.begin(step.name, drive.control, state, drive.first, drive.scale)
    if drive.step is not None:
        path = path.in_steps(StepOptions(drive.step, 2 * drive.step, 1e-4 * drive.step))
    if isinstance(load, ContactSection):
        o = path.options
        path = path.in_steps(replace(o, easy=EASY, few=EASY, hard=HARD, smallest=min(o.smallest, SHARP)))
    if drive.end is not None and not drive.targets and load.until == "target":  # it is there
        yield Record("target", step.name, stage.point(start))
        return state
    steps = load.points if load.until == "points" else MOST_STEPS
    until = "target" if load.until == "zero" else load.until
    goal = Goal(until, drive.targets, drive.quantity, steps, drive.first)
    if not isinstance(load, FieldBefore):
        return (yield from followed(stage, path, start, goal, branches=load))
    return (yield from _field_before(followed(stage, path, start, replace(goal, until="limit")), drive.end or 0.0))


def _at_held_conjugate(scene: Scene, step: ProgrammeStep, state: State, drive: Drive) -> Records:
    """The records to the first instability of a shell whose conjugate the step drives, and not the load itself."""
    held, name = held_by(scene, step, state), step.name
    q = -scene.model.system.potential(state.u, state.mu, name)
    others = {key: how for key, how in held.items() if key != name}
    steps = staged(scene, state, others).begin(name, "arc", state, drive.first, drive.scale)[0].options
    driven = f"conjugate of {name}"
    stage = staged(scene, state, {**others, name: driven})
    path, start = stage.begin(driven, "arc", State(state.u, state.mu | {driven: q}), drive.first)
    walked = Walked(followed(stage, path.in_steps(steps), start, Goal("limit", sense=drive.first)))
    for record in walked:
        yield replace(record, amplitude=name)
    return walked.end


def stage_of(scene: Scene, step: ProgrammeStep, state: State) -> Stage:
    """The solver of a step, from any state of it."""
    direction = components(scene.directions[step.number - 1], scene.plan.loads.magnetic)
    curves = None
    if isinstance(step.load, FieldSection) and direction[1:].any():
        curves = (step.name, straight(direction), float(direction @ field_at(state)))
    return staged(scene, state, held_by(scene, step, state), curves)


def held_by(scene: Scene, step: ProgrammeStep, state: State) -> dict[str, float | Conjugate]:
    """What is held besides loads, with the values of a state."""
    held = dict[str, float | Conjugate]()
    for name, how in step.load.hold.items():
        if isinstance(how, Gas):
            held[name] = gas(scene, how.gas, state)
        elif how == "conjugate":
            held[name] = -scene.model.system.potential(state.u, state.mu, name)
    return held


def _now(scene: Scene, step: ProgrammeStep, state: State) -> Now:
    """The amplitude of a step where it begins."""
    driven = any(step.name == other.name for other in scene.case.programme[: step.number - 1])
    if isinstance(step.load, FieldSection):
        value = float(components(scene.directions[step.number - 1], scene.plan.loads.magnetic) @ field_at(state))
        return Now(value, 0.0, 0.0, driven, scene.case.lambda_m)
    conjugate = -scene.model.system.potential(state.u, state.mu, step.name)
    return Now(state.mu[step.name], conjugate, scene.conjugate_unit(step.name), driven, 1.0)


def _field_before(records: Records, target: float) -> Records:
    """The records of a field that must not make the shell unstable."""
    instability, walked = None, Walked(records)
    for record in walked:
        located = record.label in LOCATED
        instability = instability or (record if located else None)
        yield record if located else replace(record, label="field")
    if instability is not None:
        raise Stopped(
            f"the field alone makes the shell unstable: critical field lambda_m = "
            f"{instability.point.state.mu['lambda_m']:.9g} of {target:g} ({instability.mode or instability.label})"
        )
    return walked.end


def _rotation(scene: Scene, step: ProgrammeStep, load: RotationSection, state: State) -> Records:
    ends, field = scene.directions[step.number - 1 : step.number + 1], scene.plan.loads.magnetic
    before, after = (components(end, field) for end in ends)
    size, total = float(before @ field_at(state)), acos(float(ends[0] @ ends[1]))
    if size == 0:
        raise Stopped("the field is zero and cannot turn")
    whole = field and field.turns
    curves = as_a_whole(turn_name(step), total) if whole else circle(size, before, after)
    stage = staged(scene, state, held_by(scene, step, state), ("angle", curves, 0.0))
    path, start = stage.begin("angle", "arc", state, total / load.points, total / load.points)
    targets = [float(t) for t in np.linspace(0.0, total, load.points + 1)[1:]]
    walked = Walked(followed(stage, path, start, Goal("limit", targets)))
    for record in walked:
        yield record
        if record.label in LOCATED:
            angle, kind = field_angle(record.point.state.mu, field) % 360, record.mode or record.label
            raise Stopped(f"the turning field makes the shell unstable at {angle:.4g} degrees: {kind}")
    return walked.end

"""Steps of a programme: what each holds and drives, and the records of its path.

Words and symbols:

- The programme is the list of a case's steps. A step has a name: the amplitude that it drives, a
  load parameter in `State.mu`. `step.load` is its section of the case.
- The conjugate q = -dPi/dmu of an amplitude mu is the displacement on which it does work, with the
  potential energy Pi. A step may hold conjugates; their amplitudes are then unknowns.
- A course says how a step goes on from where it begins: `until` is the event at which its path
  ends, `impossible` why there is no path, `forbidden` the function that gives a message about an
  instability that must not be on the way, `at_once` whether such an instability ends the step at
  once. Its `drive` has the targets on the way, the last one (`end`), the quantity that has them
  (`quantity`), the quantity that is prescribed (`control`), and the first change of the amplitude
  (`first`). The scale of an amplitude is a value of order one.
- A stage is the scene with the solver of one step. Curves are amplitudes that the step varies
  together, as functions of its own one.
- A located record is a fold or a bifurcation. Own modes are those that the model itself has.
"""

import warnings
from dataclasses import replace

from magshell_fenicsx.continuation.continuation_run import MAX_STEPS, ContinuationGoal
from magshell_fenicsx.continuation.device import Conjugate
from magshell_fenicsx.continuation.fold import Fold, FoldGuess, find_fold
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import StepOptions
from magshell_fenicsx.continuation.stability_monitor import unstable_count
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.parts.bodies.contact_step import contact_step_options as along_contact
from magshell_fenicsx.parts.motion.motion_step import TimeSection
from magshell_fenicsx.parts.pressure.pressure import EnclosedGas
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.parts.step_course import Drive, Gas, GasSection, StepCourse, StepStart
from magshell_fenicsx.quantities.registry import OWN_MODES
from magshell_fenicsx.simulate.contact_control import state_at_first_contact, support_motion_limit
from magshell_fenicsx.simulate.path_records import (
    LOCATED,
    Records,
    RecordStream,
    follow_path,
    off_path,
    with_fit_contact,
)
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage, load_stage, make_stage
from magshell_fenicsx.simulate.symmetry_switch import (
    SymmetrySwitch,
    amount_of,
    follow_switched_branch,
    switch_symmetry,
)


def records_of(scene: Scene, step: ProgrammeStep, state: State) -> Records:
    """Yield the records of a step of the programme; collective.

    Parameters
    ----------
    state
        State of the model where the step begins.

    Returns
    -------
    State
        State of the model at its end (the generator's return value).

    Raises
    ------
    Stopped
        If the path is lost, or the shell becomes unstable where it must not.
    """
    load = step.load
    if isinstance(load, TimeSection):
        from magshell_fenicsx.simulate.transient import motion_records  # steps at rest do without

        held_conjugates = held_conjugates_of_step(scene, step, state)
        return (yield from motion_records(scene, load, state, held_conjugates))
    if load.touches:
        # what the step holds is held from here on, also at the first touch
        stage = make_stage(scene, state, held_conjugates_of_step(scene, step, state))
        state = state_at_first_contact(stage, step, state)
    course = load.course(_step_start(scene, step, state))
    if course.impossible:
        raise Stopped(course.impossible)
    if step.name in load.hold:  # the step's own load is then an unknown
        return (yield from _at_held_conjugate(scene, step, state, course.drive))
    return (yield from _along_course(scene, step, state, course))


def _along_course(scene: Scene, step: ProgrammeStep, state: State, course: StepCourse) -> Records:
    """Yield the records of a step at rest that drives its own load; collective.

    Returns
    -------
    State
        State of the model at its end (the generator's return value).

    Raises
    ------
    Stopped
        If the path is lost, an instability is on it that must not be, or it ends before its target.
    """
    load = step.load
    # the targets that moving supports can reach, and why not all; "" if all
    drive, limit_reason = _within_support_limits(scene, step, state, course.drive)
    held_conjugates = held_conjugates_of_step(scene, step, state)
    stage = make_stage(scene, state, held_conjugates, course.curves and (step.name, *course.curves))
    path, start = stage.begin(step.name, drive.control, state, drive.first, drive.scale)
    path = _with_step_options(scene, path, course, drive)
    is_to_target = course.until == "target" or load.end.bound
    is_at_end = drive.end is not None and not drive.targets
    if is_at_end and is_to_target:
        yield Record("target", step.name, stage.point(start))
        return state
    goal = ContinuationGoal(
        course.until, drive.targets, drive.quantity, course.steps or MAX_STEPS, drive.first
    )
    stream = RecordStream(follow_path(stage, path, start, goal, load.end.branch_points))
    forbidden, first_instability = "", None
    for record in stream:
        is_located = record.label in LOCATED
        is_instability_of_path = is_located and not record.branch
        if is_instability_of_path and first_instability is None:
            first_instability = record
        yield replace(record, label=course.label) if course.label and not is_located else record
        if is_located and not forbidden:
            forbidden = _words_if_forbidden(course, record)
        if forbidden and course.at_once:
            raise Stopped(forbidden)
    if forbidden or limit_reason:
        raise Stopped(forbidden or limit_reason)
    if not (load.end.branch_points and first_instability):
        return stream.end
    if is_symmetry_breaking(first_instability):
        branch_goal, scale = off_path(goal, load.end.branch_points), abs(drive.scale)
        # as branch 1, beside the path of the step
        yield from follow_switched_branch(stage, first_instability, branch_goal, scale, number=1)
    return stream.end


def _words_if_forbidden(course: StepCourse, record: Record) -> str:
    """Return words for an instability if its step does not allow it; "" if it does."""
    if not course.forbidden:
        return ""
    return course.forbidden(record.point.state.mu, record.mode or record.label)


def _within_support_limits(
    scene: Scene, step: ProgrammeStep, state: State, drive: Drive
) -> tuple[Drive, str]:
    """Return a drive that ends before moving supports make shells overlap, and why it ends there.

    Parameters
    ----------
    drive
        How the step drives its amplitude.

    Returns
    -------
    drive, reason
        The drive with its targets within the limit; "" as the reason where nothing limits it.

    Raises
    ------
    Stopped
        If no target is within the limit.
    """
    # without a target, or with one of the conjugate, the way of the supports is not known
    if drive.end is None or drive.quantity != "load":
        return drive, ""
    limit, shells = support_motion_limit(scene, state, step.name, drive.end)
    if not shells:
        return drive, ""
    reason = (
        f"supports hold {shells} in each other from {step.name} = {limit:.4g} on, where their "
        "faces meet"
    )
    sign = 1.0 if drive.end > state.mu[step.name] else -1.0
    targets = [target for target in drive.targets if sign * target <= sign * limit]
    if not targets:
        raise Stopped(reason)
    return replace(drive, targets=targets, end=targets[-1]), reason


def _with_step_options(scene: Scene, path: Path, course: StepCourse, drive: Drive) -> Path:
    """Return a path with lengths of steps that suit its course, and contact between shells."""
    if drive.step is not None:  # first, longest and shortest step
        path = path.with_step_options(StepOptions(drive.step, 2 * drive.step, 1e-4 * drive.step))
    if course.finer:
        path = path.with_step_options(course.finer(path.options))
    if scene.model.all_contacts:
        path = path.with_step_options(along_contact(path.options))
    return path


def follow_branch_of_step(scene: Scene, step: ProgrammeStep, bifurcation: Record) -> Records:
    """Yield the records of the branch at the bifurcation that ends a step; collective.

    It goes to the step's target, or for its `points` steps, in the smallest model that has the
    mode.

    Returns
    -------
    State
        State of this model at the end (the generator's return value).

    Raises
    ------
    Stopped
        If the branch is not found, or lost.
    """
    state = bifurcation.point.state
    stage, drive = stage_of_step(scene, step, state), _drive(scene, step, state)
    if drive.end is None:
        goal = ContinuationGoal("points", steps=step.load.points)
    else:  # to the target of the amplitude or of its conjugate
        goal = ContinuationGoal("target", [drive.end], drive.quantity)
    scale = abs(drive.scale)
    # 0: its records are those of the path itself, which goes on here
    return (yield from follow_switched_branch(stage, bifurcation, goal, scale, number=0))


def symmetry_switch_of_step(
    scene: Scene, step: ProgrammeStep, bifurcation: Record
) -> SymmetrySwitch:
    """Return the bifurcation that ends a step, in the smallest model with its mode; collective."""
    scale = abs(_drive(scene, step, bifurcation.point.state).scale)
    return switch_symmetry(stage_of_step(scene, step, bifurcation.point.state), bifurcation, scale)


def leaves_path(step: ProgrammeStep) -> bool:
    """Return whether a step leaves its path at its bifurcation, for a branch or a snap."""
    if step.until != "bifurcation":
        return False
    return step.load.end.follows_branch or step.load.end.snap is not None


def is_symmetry_breaking(record: Record) -> bool:
    """Return whether a record is a bifurcation into a mode that the model excludes."""
    return record.label == "bifurcation" and record.mode not in OWN_MODES


def _at_held_conjugate(scene: Scene, step: ProgrammeStep, state: State, drive: Drive) -> Records:
    """Yield the records to the first instability, where the step drives a held conjugate.

    The conjugate of the step's load varies as an amplitude with a name of its own, and the load is
    an unknown. Records have the name of the load, as records of other steps.

    Parameters
    ----------
    drive
        How the step drives its amplitude; the sign of its first change is the direction.

    Returns
    -------
    State
        State of the model at the end (the generator's return value).
    """
    held_conjugates, name = held_conjugates_of_step(scene, step, state), step.name
    q = -scene.model.system.potential(state.u, state.mu, name)  # where the step begins
    # conjugates besides that of the step's own load
    other_conjugates = {key: conjugate for key, conjugate in held_conjugates.items() if key != name}
    # the path under the load itself says how long steps are
    path_of_load, _ = make_stage(scene, state, other_conjugates).begin(
        name, "arc", state, drive.first, drive.scale
    )
    conjugate_name = f"conjugate of {name}"
    stage = make_stage(scene, state, {**other_conjugates, name: conjugate_name})
    start_state = State(state.u, state.mu | {conjugate_name: q})
    path, start = stage.begin(conjugate_name, "arc", start_state, drive.first)
    path = path.with_step_options(path_of_load.options)
    goal = ContinuationGoal("limit", sense=drive.first)
    stream = RecordStream(follow_path(stage, path, start, goal))
    for record in stream:
        yield replace(record, amplitude=name)
    return stream.end


def stage_of_step(scene: Scene, step: ProgrammeStep, state: State) -> Stage:
    """Return the stage of a step, a scene with its solver, from any state of the step."""
    # amplitudes that are functions of the step's own one, and the value of this; None without
    course = step.load.course(_step_start(scene, step, state))
    # those of a field that turns are known at the begin of its step alone
    curves = None if course.at_once else course.curves
    held_conjugates = held_conjugates_of_step(scene, step, state)
    return make_stage(scene, state, held_conjugates, curves and (step.name, *curves))


def stage_of_record(scene: Scene, record: Record) -> Stage:
    """Return the stage of a record's step: the scene with the solver of this step.

    It holds the conjugates that the step holds, at the values of the record.
    """
    if not record.step:
        return load_stage(scene)
    return stage_of_step(scene, scene.problem.programme[record.step - 1], record.point.state)


def fold_at(scene: Scene, record: Record) -> Fold:
    """Return the fold at a record with the label "fold", with its null vector; collective.

    Parameters
    ----------
    record
        Row of the history of this scene.

    Raises
    ------
    ValueError
        If the record has another label.
    FoldLost
        If Newton's method for the fold fails.
    """
    if record.label != "fold":
        raise ValueError(f"this record is no fold, but a {record.label}")
    scene.refuse_foreign(record.point.state)
    stage = stage_of_record(scene, record)
    return find_fold(stage.newton, FoldGuess(stage.enter(record.point.state)), record.amplitude)


def first_records_of_branches(bifurcation: Record) -> list[Record]:
    """Return the first records of the branches at a bifurcation, for `Record.branches`; collective.

    A mode that the model excludes has one: the other direction is the same shape, turned or
    mirrored.

    Raises
    ------
    ValueError
        If the record is no bifurcation, or was pickled.
    Stopped
        If no branch is found.
    """
    if bifurcation.label != "bifurcation":
        raise ValueError(
            f"branches: this record is no bifurcation, but a {bifurcation.label}: "
            "ms.trace(..., until='bifurcation') ends at one"
        )
    scene, name = bifurcation.known_scene("branches"), bifurcation.amplitude
    state, mode = bifurcation.point.state, bifurcation.mode
    scale = abs(amount_of(name, state)) or 1.0
    switch = switch_symmetry(stage_of_record(scene, bifurcation), bifurcation, scale)
    starts = switch.starts_of_branch(mode)
    new_scene, records = switch.scene, list[Record]()
    for number, start in enumerate(starts if mode in OWN_MODES else starts[:1], 1):
        point = switch.stage.point(with_fit_contact(switch.stage, switch.path, start))
        point = replace(point, state=new_scene.model.system.advance(point.state, state.mu))
        unstable = unstable_count(new_scene.model.symmetry_breaking_modes, point.state)
        record = Record(
            "step", name, point, branch=number, excluded_pivots=unstable, said=switch.said
        )
        records.append(record.with_scene(new_scene, bifurcation.step))
    if switch.said:
        warnings.warn(switch.said, stacklevel=3)
    return records


def held_conjugates_of_step(
    scene: Scene, step: ProgrammeStep, state: State
) -> dict[str, float | Conjugate]:
    """Return amplitude -> its conjugate that a step holds, at the value of a state.

    The conjugate of a gas is a function of the amplitude; others are numbers, -dPi/dmu.
    """
    held_conjugates = dict[str, float | Conjugate]()
    for name, law in step.load.hold.items():
        if isinstance(law, Gas):
            held_conjugates[name] = enclosed_gas(scene, law.gas, state).law()
        elif law == "conjugate":
            held_conjugates[name] = -scene.model.system.potential(state.u, state.mu, name)
    return held_conjugates


def enclosed_gas(scene: Scene, section: GasSection, state: State) -> EnclosedGas:
    """Return the gas that is enclosed at a state in equilibrium.

    By Boyle's law the change of volume, the conjugate of the pressure, is a function of the
    pressure; the gas fits pressure and volume of the state.

    Parameters
    ----------
    section
        The section of the gas in the case.
    """
    problem, system, unit = scene.problem, scene.model.system, scene.conjugate_unit("pressure")
    q = -system.potential(state.u, state.mu, "pressure")
    shell, p_c = problem.context.shell, problem.material.classical_pressure
    return EnclosedGas(section, shell, p_c, unit, state.mu["pressure"], q)


def _drive(scene: Scene, step: ProgrammeStep, state: State) -> Drive:
    """Return how a step drives its amplitude, if it begins at a state."""
    return step.load.course(_step_start(scene, step, state)).drive


def _step_start(scene: Scene, step: ProgrammeStep, state: State) -> StepStart:
    """Return the begin of a step at a state: model, problem and state as its section reads them."""
    model, problem = scene.model, scene.problem

    def potential(name: str) -> float:
        """Return dPi/dmu of an amplitude at the state."""
        return model.system.potential(state.u, state.mu, name)

    return StepStart(
        step=step,
        context=problem.context,
        loads=problem.loads,
        turn=problem.azimuth,
        h=problem.material.h,
        mu=state.mu,
        potential=potential,
        unit=scene.conjugate_unit,
        open=bool(model.without_potential),  # edges whose pressure has no potential
    )

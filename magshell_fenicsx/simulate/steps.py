"""The steps of a programme: what is held, what is driven, and the records of the way."""

from dataclasses import replace

from magshell_fenicsx.continuation.continuation_run import MAX_STEPS, ContinuationGoal
from magshell_fenicsx.continuation.device import Conjugate
from magshell_fenicsx.continuation.point import StepOptions
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.parts.bodies.press import finer as along_contact
from magshell_fenicsx.parts.course import Drive, Gas, GasSection, Here
from magshell_fenicsx.parts.pressure.pressure import Enclosed
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.quantities.registry import OWN_MODES
from magshell_fenicsx.simulate.handover import Departure, departed, leaving
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage, staged
from magshell_fenicsx.simulate.touch import blocked, touched
from magshell_fenicsx.simulate.walked import Records, Walked, followed, off_path

LOCATED = ("fold", "bifurcation")


def records_of(scene: Scene, step: ProgrammeStep, state: State) -> Records:
    """The records of a step; its return value is the state at its end.

    Raises
    ------
    Stopped
        If the path is lost, or the shell becomes unstable where it must not.
    """
    load = step.load
    if load.motion:
        from magshell_fenicsx.simulate.transient import motion  # steps at rest do without

        return (yield from motion(scene, load.motion, state, held_by(scene, step, state)))
    if load.touches:
        state = touched(scene, step, state)
    course = load.course(_here(scene, step, state))
    drive = course.drive
    if course.impossible:
        raise Stopped(course.impossible)
    if step.name in load.hold:
        return (yield from _at_held_conjugate(scene, step, state, drive))
    meeting = ""
    if drive.end is not None and drive.quantity == "load":
        most, meeting = blocked(scene, state, step.name, drive.end)
        if meeting:
            meeting = f"supports hold {meeting} in each other from {step.name} = {most:.4g} on, where their faces meet"
            sign = 1.0 if drive.end > state.mu[step.name] else -1.0
            left = [target for target in drive.targets if sign * target <= sign * most]
            if not left:
                raise Stopped(meeting)
            drive = replace(drive, targets=left, end=left[-1])
    stage = staged(
        scene, state, held_by(scene, step, state), course.curves and (step.name, *course.curves)
    )
    path, start = stage.begin(step.name, drive.control, state, drive.first, drive.scale)
    if drive.step is not None:
        path = path.with_step_options(StepOptions(drive.step, 2 * drive.step, 1e-4 * drive.step))
    for finer in (course.finer, along_contact if scene.model.touchings else None):
        path = path.with_step_options(finer(path.options)) if finer else path
    if (
        drive.end is not None and not drive.targets and (course.until == "target" or load.bound)
    ):  # it is there
        yield Record("target", step.name, stage.point(start))
        return state
    goal = ContinuationGoal(
        course.until, drive.targets, drive.quantity, course.steps or MAX_STEPS, drive.first
    )
    walked = Walked(followed(stage, path, start, goal, load.branch_points))
    wrong, first = "", None
    for record in walked:
        located = record.label in LOCATED
        if located and not record.branch and first is None:
            first = record
        yield replace(record, label=course.label) if course.label and not located else record
        if located and course.forbidden and not wrong:
            wrong = course.forbidden(record.point.state.mu, record.mode or record.label)
        if wrong and course.at_once:
            raise Stopped(wrong)
    if wrong or meeting:
        raise Stopped(wrong or meeting)
    if load.branch_points and first and excluded(first):
        yield from leaving(stage, first, off_path(goal, load.branch_points), abs(drive.scale), 1)
    return walked.end


def followed_on(scene: Scene, step: ProgrammeStep, bifurcation: Record) -> Records:
    """The records of the branch at the bifurcation that ends a step, to its target or for `points`
    steps.

    The model is the smallest that has the mode, and so is that of the state at the end.

    Raises
    ------
    Stopped
        If the branch is not found, or lost.
    """
    stage, drive = (
        stage_of(scene, step, bifurcation.point.state),
        _drive(scene, step, bifurcation.point.state),
    )
    end = drive.end
    goal = (
        ContinuationGoal("points", steps=step.load.points)
        if end is None
        else ContinuationGoal("target", [end], drive.quantity)
    )
    return (yield from leaving(stage, bifurcation, goal, abs(drive.scale), 0))


def departure_of(scene: Scene, step: ProgrammeStep, bifurcation: Record) -> Departure:
    """The bifurcation that ends a step, in the model that has its mode."""
    scale = abs(_drive(scene, step, bifurcation.point.state).scale)
    return departed(stage_of(scene, step, bifurcation.point.state), bifurcation, scale)


def leaves_path(step: ProgrammeStep) -> bool:
    """Whether what follows the bifurcation that ends a step is not on the path: a branch, or a
    snap.
    """
    return step.until == "bifurcation" and (
        step.load.follows_branch or step.load.released_by is not None
    )


def _drive(scene: Scene, step: ProgrammeStep, state: State) -> Drive:
    return step.load.course(_here(scene, step, state)).drive


def excluded(record: Record) -> bool:
    """Whether it is a bifurcation into a mode that the model excludes."""
    return record.label == "bifurcation" and record.mode not in OWN_MODES


def _at_held_conjugate(scene: Scene, step: ProgrammeStep, state: State, drive: Drive) -> Records:
    """The records to the first instability of a shell whose conjugate the step drives, and not the
    load itself.
    """
    held, name = held_by(scene, step, state), step.name
    q = -scene.model.system.potential(state.u, state.mu, name)
    others = {key: how for key, how in held.items() if key != name}
    steps = (
        staged(scene, state, others).begin(name, "arc", state, drive.first, drive.scale)[0].options
    )
    driven = f"conjugate of {name}"
    stage = staged(scene, state, {**others, name: driven})
    path, start = stage.begin(driven, "arc", State(state.u, state.mu | {driven: q}), drive.first)
    walked = Walked(
        followed(
            stage,
            path.with_step_options(steps),
            start,
            ContinuationGoal("limit", sense=drive.first),
        )
    )
    for record in walked:
        yield replace(record, amplitude=name)
    return walked.end


def stage_of(scene: Scene, step: ProgrammeStep, state: State) -> Stage:
    """The solver of a step, from any state of it."""
    curves = step.load.curves(_here(scene, step, state))
    return staged(scene, state, held_by(scene, step, state), curves and (step.name, *curves))


def held_by(scene: Scene, step: ProgrammeStep, state: State) -> dict[str, float | Conjugate]:
    """What is held besides loads, with the values of a state."""
    held = dict[str, float | Conjugate]()
    for name, how in step.load.hold.items():
        if isinstance(how, Gas):
            held[name] = enclosed(scene, how.gas, state).law()
        elif how == "conjugate":
            held[name] = -scene.model.system.potential(state.u, state.mu, name)
    return held


def enclosed(scene: Scene, section: GasSection, state: State) -> Enclosed:
    """The gas that is closed in at an equilibrium."""
    problem, system, unit = scene.problem, scene.model.system, scene.conjugate_unit("pressure")
    q = -system.potential(state.u, state.mu, "pressure")
    shell, p_c = problem.context.shell, problem.material.classical_pressure
    return Enclosed(section, shell, p_c, unit, state.mu["pressure"], q)


def _here(scene: Scene, step: ProgrammeStep, state: State) -> Here:
    """Where a step begins."""
    model, problem = scene.model, scene.problem

    def potential(name: str) -> float:
        return model.system.potential(state.u, state.mu, name)

    return Here(
        step,
        scene.problem.context,
        problem.loads,
        problem.azimuth,
        problem.material.h,
        state.mu,
        potential,
        scene.conjugate_unit,
        bool(model.without_potential),
    )

"""The history of a case: the steps of its programme, one after the other."""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace

from magshell_fenicsx.continuation.path import SEEN, NotANumber
from magshell_fenicsx.continuation.point import Finding, Point
from magshell_fenicsx.continuation.system import State, max_abs
from magshell_fenicsx.continuation.walk import Goal
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.quantities.registry import OWN_MODES
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import plain
from magshell_fenicsx.simulate.steps import LOCATED, departure_of, followed_on, held_by, records_of
from magshell_fenicsx.simulate.touch import penetration_refused
from magshell_fenicsx.simulate.walked import Records, Walked, amount, followed

RISES = 4  # first steps of an energy that moves the undeformed shell
# how the remark of a path begins that has its answer
BEYOND = "beyond the first instability the path stopped: "


def warned(remark: str) -> None:
    """Say it as a warning."""
    warnings.warn(remark, stacklevel=3)


def follow(
    scene: Scene, *, search: bool = True, remark: Callable[[str], None] = warned
) -> Iterator[Record]:
    """Compute the history of a scene; yields every accepted point.

    With `until: limit` as its end, a history has its answer at the first instability: what stops it
    beyond that is a remark.

    Parameters
    ----------
    search
        Whether steps search for the further solutions that they request.
    remark
        Called with one sentence on what the result must not be read without.

    Raises
    ------
    Stopped
        If a path is lost, a step before the last ends at an instability, or the field alone makes
        the shell unstable.
    """
    state, steps = scene.unloaded(), scene.problem.programme
    own = pulling(scene, state)
    state = replace(state, mu=state.mu | dict.fromkeys(own, 0.0))
    try:
        _refuse_not_numbers(scene, state, "")
    except Stopped:
        yield Record(
            "start",
            "",
            Point(state, 0.0, 0.0 * state.u, 0.0, 0, 0),
            scene=scene,
            shown=scene.displacement,
        )
        raise
    pivots = (
        0 if scene.loose or scene.free_in_time else scene.newton.factor_at(state).negative_pivots
    )
    start = Point(state, 0.0, 0.0 * state.u, 0.0, pivots, pivots, 0, 1)
    clock = dict[str, float]()
    if steps and (first_motion := steps[0].load.motion) and not own:
        from magshell_fenicsx.simulate.transient import thrown

        clock = thrown(scene, first_motion, state)
    yield Record("start", "", start, clock=clock, scene=scene, shown=scene.displacement)
    if pivots:
        why = scene.flat_triangle or "mesh.penalty is too small or the mesh too coarse"
        raise Stopped(f"the undeformed shell is unstable in {pivots} directions: {why}")
    for name, value in own.items():
        rise = Walked(_under(scene, name, value, state))
        yield from (replace(risen, scene=scene, shown=scene.displacement) for risen in rise)
        state = rise.end
    for step in steps:
        where = (
            f"step {step.number} of {len(steps)} ({step.kind}): " if scene.problem.listed else ""
        )
        scene.progress.beginning(step.number)
        _refuse_not_numbers(scene, state, where)
        walked, last, record, first = Walked(records_of(scene, step, state)), "", None, None
        unstable = False
        try:
            for record in walked:
                last = record.label
                yield _recorded(scene, step, record, remark, where)
                unstable = unstable or last in LOCATED
                if last in LOCATED and not (first or record.branch or scene.watch.unlocated):
                    first = record
            if step.load.bound and not unstable:
                remark(
                    f"{where}there is no instability up to the target, where until: limit ends too"
                )
            release = step.load.released_by
            if release and record and step.until == "bifurcation" and last == "bifurcation":
                record = departure_of(scene, step, record).record(0)
                scene = record.scene or scene
                yield _recorded(scene, step, record, remark, where)
            elif release and record:
                if record.label != "fold" or record.mode:
                    at = record.mode or record.label
                    raise Stopped(
                        f"then: snap: the step ends at a {at}, not at a fold of the model itself"
                    )
                if record.excluded_pivots:
                    remark(where + _buckled(scene, record, first))
            further = None
            if release and record:
                from magshell_fenicsx.simulate.transient import released

                further = released(scene, release, record, held_by(scene, step, record.point.state))
            elif step.load.follows_branch and record and last == "bifurcation":
                further = followed_on(scene, step, record)
            if further:
                walked = Walked(further)
                for record in walked:
                    last, scene = record.label, record.scene or scene
                    yield _recorded(scene, step, record, remark, where)
        except (Stopped, NotANumber) as e:
            _say_of_point_forces(scene, remark, where)
            names = scene.model.system.strange
            strange = (
                f"; where it was tried last, {' and '.join(names)} was not a number"
                if names
                else ""
            )
            if not (
                first and step is steps[-1] and step.until == "limit" and not step.load.released_by
            ):
                raise Stopped(f"{where}{e}{strange}") from None
            remark(f"{BEYOND}{where}{e}{strange}")
            return
        begin, state = state, walked.end
        if search and step.load.search:
            from magshell_fenicsx.simulate.search import searched

            for record in searched(scene, step, begin, state):
                yield replace(record, step=step.number, scene=scene, shown=scene.displacement)
        if step is not steps[-1] and step.until in ("limit", "bifurcation") and last in LOCATED:
            raise Stopped(f"{where}ends at a {last}, from which the next step cannot start")


def follow_alone(
    scene: Scene, *, search: bool = False, remark: Callable[[str], None] = warned
) -> Iterator[Record]:
    """The history of a scene for what reads all of it in the scene itself; see `follow`.

    Raises
    ------
    Stopped
        Also where it would go on in another model.
    """
    for record in follow(scene, search=search, remark=remark):
        if record.scene is not None and record.scene is not scene:
            raise Stopped(
                "here the path goes on in another model, in which nothing is read for this command: leave out then and "
                "branches, or take symmetry: none"
            )
        yield record


def _recorded(
    scene: Scene, step: ProgrammeStep, record: Record, remark: Callable[[str], None], where: str
) -> Record:
    """A record as a history gives it."""
    at = record.scene or scene
    if record.said:
        remark(where + record.said)
    _say_of_point_forces(at, remark, where)
    state, moving = record.point.state, bool((record.clock or {}).get("kinetic"))
    refused = scene.journal.noted(
        lambda: Finding({"said": penetration_refused(at, state, moving=moving)})
    ).values
    if refused["said"]:
        raise Stopped(refused["said"])
    return replace(record, step=step.number, scene=at, shown=at.displacement)


def _say_of_point_forces(scene: Scene, remark: Callable[[str], None], where: str) -> None:
    for said in scene.at_point_forces.taken():
        remark(where + said)


def pulling(scene: Scene, state: State) -> dict[str, float]:
    """Amplitude -> value of the energies that move the undeformed shell, such as a surface tension."""
    system, own = scene.model.system, dict[str, float]()
    for term in scene.problem.loads.own:
        load = system.load(state.u, state.mu, term.name) if term.value else 0.0 * state.u
        if max_abs(scene.comm, load) == 0:
            continue
        moved = term.value * scene.newton.factor_at(state).solve(load)
        if max_abs(scene.comm, moved) > SEEN * system.length:
            own[term.name] = term.value
    return own


def _under(scene: Scene, name: str, value: float, state: State) -> Records:
    """The records of a shell that comes to rest under an energy whose amplitude rises from zero."""
    stage = plain(scene)
    path, start = stage.begin(name, "load", state, value / RISES, value)
    try:
        return (yield from followed(stage, path, start, Goal("target", [value])))
    except Stopped as e:
        raise Stopped(f"on the way to rest under the energy {name}: {e}") from None


def _buckled(scene: Scene, fold: Record, first: Record | None) -> str:
    """What a snap begins at, where modes that the model excludes are unstable before it."""
    count = fold.excluded_pivots
    since = "from the start of the step on"
    if first and first.mode not in OWN_MODES:
        value = amount(scene, first.amplitude, first.point.state.mu[first.amplitude])
        since = f"the first of them ({first.mode}) since {value}"
    return (
        f"the snap starts from a shell that has buckled before: at its fold {count} mode{'s' * (count != 1)} that the "
        f"model excludes {'are' if count != 1 else 'is'} unstable, {since}; symmetry: none follows them"
    )


def _refuse_not_numbers(scene: Scene, state: State, where: str) -> None:
    """See that the forces at a state are numbers: no step could be small enough.

    Raises
    ------
    Stopped
        With the terms that are not.
    """
    system = scene.model.system
    system.strange = []
    system.residual(state.u, state.mu)
    if system.strange:
        raise Stopped(
            f"{where}{' and '.join(system.strange)} is not a number at its begin, in value or derivative"
        )

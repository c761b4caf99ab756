"""History of a case: the records of the steps of its programme, one step after the other.

Words and symbols:

- The programme is the list of the case's steps. A record is a point of a path with its label; a
  located one is a fold or a bifurcation.
- An amplitude is a load parameter, by name in `State.mu`. Own energies are those that a program
  defines for its case; each has an amplitude with a given value.
- A remark is a sentence that the result must not be read without.
- Excluded modes break a symmetry that the reduced model has. Behind a bifurcation into one of them
  the history may go on in a larger model: a symmetry switch.
- A step may release the shell at its instability (`end.snap`), to snap to rest.
- Pivots count unstable directions.
"""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace

from magshell_fenicsx.continuation.continuation_run import ContinuationGoal
from magshell_fenicsx.continuation.path import ZERO_DISPLACEMENT, NotANumber
from magshell_fenicsx.continuation.point import Point, RecordedValues
from magshell_fenicsx.continuation.system import State, max_abs
from magshell_fenicsx.parts.motion.motion_step import TimeSection
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.quantities.registry import OWN_MODES
from magshell_fenicsx.simulate.contact_control import penetration_message
from magshell_fenicsx.simulate.path_records import (
    LOCATED,
    Records,
    RecordStream,
    amount,
    follow_path,
)
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import load_stage
from magshell_fenicsx.simulate.steps import (
    follow_branch_of_step,
    held_conjugates_of_step,
    records_of,
    symmetry_switch_of_step,
)
from magshell_fenicsx.simulate.undeformed_instability import cause_of_instability

STEPS_OF_RISE = 4  # first steps in which an energy rises that moves the undeformed shell
# begin of the remark on a path that stops beyond the instability that answers it
BEYOND_INSTABILITY = "beyond the first instability the path stopped: "


def warn_of(remark: str) -> None:
    """Give a remark as a warning of Python."""
    warnings.warn(remark, stacklevel=3)


def follow(
    scene: Scene, *, search: bool = True, remark: Callable[[str], None] = warn_of
) -> Iterator[Record]:
    """Compute the history of a scene; yield the record of every accepted point; collective.

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
    scene.read_functions()
    state, steps = scene.unloaded(), scene.problem.programme
    if any(getattr(step.load, "event", None) for step in steps):
        # steps at rest do without
        from magshell_fenicsx.simulate.transient import refuse_unknown_events

        refuse_unknown_events(scene, state)
    # energies that are there before any load, and rise from zero first
    energies = energies_moving_the_shell(scene, state)
    state = replace(state, mu=state.mu | dict.fromkeys(energies, 0.0))
    yield from _start(scene, state, has_rise=bool(energies))
    for name, value in energies.items():
        rise = RecordStream(_rise(scene, name, value, state))
        yield from (record.with_scene(scene) for record in rise)
        state = rise.end
    for step in steps:
        run = _StepRun(scene, step, remark)
        scene.progress.beginning(step.number)
        _refuse_not_numbers(scene, state, run.place)
        try:
            yield from run.path(state)
            if step.load.end.bound and not run.is_unstable:
                event = "instability" if step.until == "limit" else "bifurcation"
                remark(
                    f"{run.place}there is no {event} up to the target, where until: {step.until} "
                    "ends too"
                )
            if text := run.remark_on_release():
                remark(run.place + text)
            yield from run.records_beyond()
        except (Stopped, NotANumber) as e:
            run.remark_on_point_forces(run.scene)
            # beyond the instability that was asked for, a stop is a remark alone
            if not run.has_answer or step is not steps[-1]:
                raise Stopped(run.reason(e)) from None
            remark(f"{BEYOND_INSTABILITY}{run.reason(e)}")
            return
        begin, state, scene = state, run.end, run.scene
        if search and step.load.search:
            yield from _search_records(scene, step, begin, state)
        ends_at_event = step.until in ("limit", "bifurcation") and run.is_at_event
        if step is not steps[-1] and ends_at_event:
            raise Stopped(
                f"{run.place}ends at a {run.label}, from which the next step cannot start: with "
                "then: snap it starts where the shell comes to rest, and with until: target this "
                "one goes on"
            )


def follow_alone(
    scene: Scene, *, search: bool = False, remark: Callable[[str], None] = warn_of
) -> Iterator[Record]:
    """Yield the records of a history that stays in one scene; collective.

    It is for callers that read results in the scene itself.

    Parameters
    ----------
    search
        Whether steps search for the further solutions that they request.
    remark
        Called with one sentence on what the result must not be read without.

    Raises
    ------
    Stopped
        Also where the history would go on in another model.
    """
    for record in follow(scene, search=search, remark=remark):
        if record.scene is not None and record.scene is not scene:
            raise Stopped(
                "here the path goes on in another model, in which nothing is read for this "
                "command: leave out then and branches, or take symmetry: none"
            )
        yield record


def _search_records(
    scene: Scene, step: ProgrammeStep, begin: State, end: State
) -> Iterator[Record]:
    """Yield the records of further solutions that a step searches for at its end; collective.

    `begin` and `end` are the states at both ends of the step.
    """
    from magshell_fenicsx.simulate.search import search_at_end_of_step

    for record in search_at_end_of_step(scene, step, begin, end):
        yield record.with_scene(scene, step.number)


def _start(scene: Scene, state: State, *, has_rise: bool) -> Iterator[Record]:
    """Yield the record of the undeformed shell; collective.

    Parameters
    ----------
    state
        State of the undeformed shell, without loads.
    has_rise
        Whether an energy moves the shell before the first step.

    Raises
    ------
    Stopped
        After the record, if forces are no numbers, or the undeformed shell is unstable.
    """

    def record(pivots: int, factorisations: int, clock: dict[str, float]) -> Record:
        """Return the record of the undeformed shell with so many unstable directions."""
        zero = 0.0 * state.u
        point = Point(state, 0.0, zero, 0.0, pivots, pivots, 0, factorisations)
        return Record("start", "", point, clock=clock).with_scene(scene)

    try:
        _refuse_not_numbers(scene, state, "")
    except Stopped:  # the history has its start even then
        yield record(0, 0, {})
        raise
    pivots = 0
    # free rigid motions have no stiffness: the sign of their pivots is rounding
    if not (scene.allows_rigid_motion or scene.free_in_time):
        pivots = scene.newton.factor_at(state).negative_pivots
    clock = dict[str, float]()
    steps = scene.problem.programme
    first_load = steps[0].load if steps else None
    if isinstance(first_load, TimeSection) and not has_rise:
        from magshell_fenicsx.simulate.transient import initial_clock

        clock = initial_clock(scene, first_load, state)
    yield record(pivots, 1, clock)
    if pivots:
        raise Stopped(
            f"the undeformed shell is unstable in {pivots} directions: "
            f"{cause_of_instability(scene, state)}"
        )


class _StepRun:
    """Run of one step of a programme: its path, and what follows an instability at its end.

    `path` and then `records_beyond` are iterated over, once each.

    Parameters
    ----------
    scene
        The scene where the step begins.
    step
        Step of the programme.
    remark
        Called with one sentence on what the result must not be read without.

    Attributes
    ----------
    scene
        The scene at the present end of the run; another one behind a symmetry switch.
    end
        State at the end, after `records_beyond`.
    label
        Label of the last record.
    is_unstable
        Whether there was an instability.
    place
        Begin of a message that says which step of a list this is; empty for a single load.
    _step, _remark
        The parameters.
    _last, _first_instability
        The last record of the path, and the first one of an instability on it that is known to be
        the first; None so far.
    """

    def __init__(self, scene: Scene, step: ProgrammeStep, remark: Callable[[str], None]) -> None:
        """Prepare the run; the path is followed by `path`."""
        self.scene, self.end, self.label, self.is_unstable = scene, scene.unloaded(), "", False
        self.place, problem = "", scene.problem
        if problem.listed:
            self.place = f"step {step.number} of {len(problem.programme)} ({step.kind}): "
        self._step, self._remark = step, remark
        self._last: Record | None = None
        self._first_instability: Record | None = None

    @property
    def is_at_event(self) -> bool:
        """Whether the last record is an instability."""
        return self.label in LOCATED

    @property
    def has_answer(self) -> bool:
        """Whether the step has found the instability that it looks for, whatever stops it later."""
        is_to_limit = self._step.until == "limit" and not self._step.load.end.snap
        return self._first_instability is not None and is_to_limit

    def reason(self, error: Exception) -> str:
        """Return the reason why the step has stopped, with terms that were not a number."""
        names = self.scene.model.system.nan_terms
        nan_text = ""
        if names:
            nan_text = f"; where it was tried last, {' and '.join(names)} was not a number"
        return f"{self.place}{error}{nan_text}"

    def path(self, state: State) -> Iterator[Record]:
        """Yield the records of the step's path from a state."""
        stream = RecordStream(records_of(self.scene, self._step, state))
        for record in stream:
            self._last, self.label = record, record.label
            yield self._completed(record)
            if not self.is_at_event:
                continue
            self.is_unstable = True
            # an excluded mode may have become unstable before, at a point that was not located
            is_uncertain = bool(self.scene.stability_monitor.unlocated)
            if record.branch or is_uncertain:
                continue
            self._first_instability = self._first_instability or record
        self.end = stream.end

    def remark_on_release(self) -> str:
        """Return a remark on a shell that has buckled before it is released to snap; "" for others.

        Raises
        ------
        Stopped
            If a shell is released elsewhere than at a fold or a bifurcation of its path.
        """
        fold = self._last
        # nothing is released
        if not (self._step.load.end.snap and fold):
            return ""
        # it is released in the larger model, which has the mode of the bifurcation
        if self._is_released_at_bifurcation:
            return ""
        if fold.label != "fold" or fold.mode:  # a mode: one that the model excludes
            raise Stopped(
                f"then: snap: the step ends at a {fold.mode or fold.label}, not at a fold of the "
                "model itself"
            )
        if not fold.excluded_pivots:
            return ""
        return _buckled_text(self.scene, fold, self._first_instability)

    def records_beyond(self) -> Iterator[Record]:
        """Yield the records of the branch or the snap from an instability at the end of the path.

        There are none where the step does not ask for them.
        """
        step, record = self._step, self._last
        if record is None:
            return
        records: Records | None = None
        if snap := step.load.end.snap:
            # the snap starts in the larger model; its first record is still on the path (branch 0)
            if self._is_released_at_bifurcation:
                record = symmetry_switch_of_step(self.scene, step, record).record(number=0)
                self.scene = record.scene or self.scene
                yield self._completed(record)
            from magshell_fenicsx.simulate.transient import snap_records

            held_conjugates = held_conjugates_of_step(self.scene, step, record.point.state)
            records = snap_records(self.scene, snap, record, held_conjugates)
        elif step.load.end.follows_branch and self.label == "bifurcation":
            records = follow_branch_of_step(self.scene, step, record)
        if records is None:
            return
        stream = RecordStream(records)
        for record in stream:
            self.label, self.scene = record.label, record.scene or self.scene
            yield self._completed(record)
        self.end = stream.end

    def remark_on_point_forces(self, scene: Scene) -> None:
        """Give remarks on the instabilities at point forces left out since the last call."""
        for sentence in scene.point_force_modes.take():
            self._remark(self.place + sentence)

    @property
    def _is_released_at_bifurcation(self) -> bool:
        """Whether the shell snaps from a bifurcation, and so in the model that has its mode."""
        return self._step.until == "bifurcation" and self.label == "bifurcation"

    def _completed(self, record: Record) -> Record:
        """Return a record with its step, scene and function of the displacement; give its remarks.

        Raises
        ------
        Stopped
            If a body or a shell penetrates too much there.
        """
        scene, state = record.scene or self.scene, record.point.state
        if record.said:
            self._remark(self.place + record.said)
        self.remark_on_point_forces(scene)
        # shells that hit each other, in a motion with kinetic energy, may penetrate more for a
        # moment
        is_moving = bool((record.clock or {}).get("kinetic"))
        recorded = scene.journal.recorded_values(
            lambda: RecordedValues({"said": penetration_message(scene, state, moving=is_moving)})
        )
        if message := recorded.values["said"]:
            raise Stopped(message)
        return record.with_scene(scene, self._step.number)


def energies_moving_the_shell(scene: Scene, state: State) -> dict[str, float]:
    """Return amplitude -> value of the own energies that move the undeformed shell; collective.

    An example is a surface tension. An energy moves the shell if the displacement of the linear
    response to it is not zero.
    """
    system, energies = scene.model.system, dict[str, float]()
    for term in scene.problem.loads.user_terms:
        load = system.load(state.u, state.mu, term.name) if term.value else 0.0 * state.u
        if max_abs(scene.comm, load) == 0:
            continue
        displacement = term.value * scene.newton.factor_at(state).solve(load)
        if max_abs(scene.comm, displacement) > ZERO_DISPLACEMENT * system.length:
            energies[term.name] = term.value
    return energies


def _rise(scene: Scene, name: str, value: float, state: State) -> Records:
    """Yield the records of a shell that comes to rest under an energy that rises from zero.

    Parameters
    ----------
    name, value
        The amplitude of the energy, and its value at the end.
    state
        State of the undeformed shell.

    Returns
    -------
    State
        State at rest (the generator's return value).

    Raises
    ------
    Stopped
        If the path to rest is lost.
    """
    stage = load_stage(scene)
    # about a quarter of the value in the first step; the value is the scale of the amplitude
    path, start = stage.begin(name, "load", state, value / STEPS_OF_RISE, value)
    try:
        return (yield from follow_path(stage, path, start, ContinuationGoal("target", [value])))
    except Stopped as e:
        raise Stopped(f"on the way to rest under the energy {name}: {e}") from None


def _buckled_text(scene: Scene, fold: Record, first_instability: Record | None) -> str:
    """Return a remark on a snap from a fold at which modes that the model excludes are unstable.

    Parameters
    ----------
    fold
        Record of the fold, with the number of these modes.
    first_instability
        Record of the first instability of the step; None if none was located.
    """
    count = fold.excluded_pivots
    since = "from the start of the step on"
    if first_instability and first_instability.mode not in OWN_MODES:
        name = first_instability.amplitude
        value = amount(scene, name, first_instability.point.state.mu[name])
        since = f"the first of them ({first_instability.mode}) since {value}"
    return (
        "the snap starts from a shell that has buckled before: at its fold "
        f"{count} mode{'s' * (count != 1)} that the "
        f"model excludes {'are' if count != 1 else 'is'} unstable, {since}; symmetry: none follows "
        "them"
    )


def _refuse_not_numbers(scene: Scene, state: State, place: str) -> None:
    """Check that the forces at a state are numbers; collective.

    Otherwise no step is small enough.

    Parameters
    ----------
    place
        Begin of the message.

    Raises
    ------
    Stopped
        With the terms whose forces are not numbers.
    """
    system = scene.model.system
    system.nan_terms = []
    system.residual(state.u, state.mu)
    if system.nan_terms:
        raise Stopped(
            f"{place}{' and '.join(system.nan_terms)} is not a number at its begin, in value or "
            "derivative"
        )

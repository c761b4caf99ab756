"""Records of a path of a scene, with the modes that the model excludes, and of its branches.

A continuation run gives points. Between each two of them contact is checked; at each of them the
modes that the model excludes are watched; and where load control fails, the path goes on by arc
length.

Words and symbols:

- A path varies one amplitude (`path.name`), a load parameter mu. Its control is "load" (mu itself
  is prescribed), "conjugate" (the displacement on which the load does work) or "arc" (arc length);
  s is the controlled quantity. A goal says where the path ends (`until`, `targets`).
- A model with symmetry excludes modes that would break it. The stability monitor counts the
  unstable ones of these, and locates crossings, where one becomes neutral: excluded instabilities.
- Located points are folds and bifurcations of the model itself.
- `low` and `high`, or low and high points, are two successive points of a run.
- Settings are entries of `State.mu` that are no loads: penalties of contact, and numbers of cuts.
  Cuts divide cells of shells that touch, for quadrature of their contact.
- A stage is the scene with the solver of one step; `leave` converts its states to the model's.
- A generator of records returns the state at its end.
- `path.recorded_values(f)` returns the values that f finds, and keeps them in the run's journal. A
  resumed run takes them from there and does not call f.
- `unlocated` of the monitor says where a mode became unstable at a place that is not known.
"""

from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np

from magshell_fenicsx.continuation.bifurcation import BranchSwitch, switch_branch
from magshell_fenicsx.continuation.continuation_run import ContinuationGoal, ContinuationRun
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import (
    PathStopped,
    Point,
    RecordedValues,
    StepOptions,
    StepTooLong,
)
from magshell_fenicsx.continuation.stability_monitor import Crossing
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.quantities.registry import amplitude
from magshell_fenicsx.simulate.contact_control import (
    better_cuts,
    closer_points,
    passes,
    penetration_message,
    raised_stiffnesses,
    recall_cuts,
    refuse_crossing,
    refuse_passing,
    refuse_pressed_support,
    refuse_return,
    with_own_contact,
)
from magshell_fenicsx.simulate.point_forces import point_of_crossing, point_of_instability
from magshell_fenicsx.simulate.record import AT_POINT_FORCES, Label, Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import LONGEST, Stage

# load at which a path ends, over that of the first excluded instability
MAX_RATIO_TO_EXCLUDED = 2.0
LOCATED = ("fold", "bifurcation")
TINY_STEP = 1e-3  # over the way of a path
TINY_STEPS = 15  # successive tiny steps after which a path in contact is said to creep
RESOLVING_SIZE = 0.25  # of elements that resolve a contact, over sqrt(R h)
MAX_CONTACT_CHANGES = 10  # times that a first point gets stiffer penalties or new cuts
FIRST_STEP_REDUCTION = (
    1 / 16
)  # of the first step: where load control fails in so short a step, a fold is looked for first


Records = Generator[Record, None, State]  # records, and the model's state at the end


class RecordStream:
    """Records of a path, to iterate over once; afterwards the state at their end is known.

    Parameters
    ----------
    records
        Generator of records that returns the model's state after the last one.

    Attributes
    ----------
    end
        State of the model after the last record; without unknowns before the iteration ends.
    _records
        The parameter `records`.
    """

    def __init__(self, records: Records) -> None:
        self._records, self.end = records, State(np.empty(0), {})

    def __iter__(self) -> Iterator[Record]:
        self.end = yield from self._records


def follow_path(
    stage: Stage, path: Path, start: Point, goal: ContinuationGoal, branches: int = 0
) -> Records:
    """Yield the records of a path: its points, instabilities that the model excludes, and branches.

    With `until: bifurcation` an excluded instability ends the path. With `until: limit` the path
    continues to the first instability of the model itself, up to `MAX_RATIO_TO_EXCLUDED` times the
    load of the first excluded one. Collective.

    Parameters
    ----------
    stage
        Scene with the solver of the step.
    start
        First point of the path.
    goal
        Where the path ends.
    branches
        Number of steps for each direction of the branch at the first bifurcation; a goal with a
        target replaces this number. 0: no branch is followed.

    Returns
    -------
    State
        State of the model at the end of the path (the generator's return value).

    Raises
    ------
    Stopped
        If the path is lost.
    """
    run = checked_run(stage, path, start, goal)
    records = RecordStream(_StageRecords(stage, run, branches).records())
    # `advance` gives a state the history that follows from the state before: angles of edges
    advance = stage.scene.model.system.advance
    earlier_mu = start.state.mu
    for record in records:
        point = stage.point(record.point)
        state = advance(point.state, earlier_mu)
        earlier_mu = state.mu
        yield replace(record, point=replace(point, state=state))
    return advance(stage.leave(records.end), earlier_mu)


def checked_run(stage: Stage, path: Path, start: Point, goal: ContinuationGoal) -> ContinuationRun:
    """Return a continuation run that checks contact between each two successive points.

    Penalties of bodies and shells become stiffer on this run. Shells are cut anew, and get closer
    points of contact where these move an instability. A shell that passes through a magnet, or a
    body that goes back the way it came, ends the run.
    """
    # a run of a given number of points may go back on its way
    checks = _Checks(stage, path, returns=goal.until != "points")
    # the run calls the checks after each step, and the checks read the points of the run
    checks.walk = ContinuationRun(path, start, goal, checks, checks.too_deep)
    return checks.walk


class _Checks:
    """Checks of contact between each two successive points of a run.

    An instance is the hook `renew` of a `ContinuationRun`, which calls it after each step.

    Parameters
    ----------
    returns
        Whether a body that goes back the way it came ends the run.

    Attributes
    ----------
    walk
        The run that is checked.
    _stage, _path, _returns
        The parameters; the path is that of the run.
    _step_begin
        s of the first point of the present step. A step leads from one point to the next, and may
        be solved several times, each time with changed settings.
    _pivots_at_begin
        Negative pivots of this point before settings were changed.
    _last_cut_step
        s of the first point of the step in which cuts were last made anew.
    """

    walk: ContinuationRun

    def __init__(self, stage: Stage, path: Path, returns: bool) -> None:
        self._stage, self._path, self._returns = stage, path, returns
        self._step_begin, self._last_cut_step = np.nan, np.nan
        self._pivots_at_begin = 0

    def __call__(self, low: Point, high: Point) -> State | None:
        """Return the state to solve again with changed penalties or cuts; None if they are fit.

        Parameters
        ----------
        low, high
            Two successive points; the state that is returned is that of `low`, with changed
            settings.

        Raises
        ------
        PathStopped, StepTooLong
            If the second point must not follow the first one.
        """
        if low.s != self._step_begin:  # a new step; otherwise the same one is solved again
            self._step_begin, self._pivots_at_begin = low.s, low.negative_pivots
        # the keys are those of `_finding`: why the step is refused, or which settings change
        findings = self._path.recorded_values(partial(self._finding, low, high)).values
        if "too_long" in findings:
            raise StepTooLong(findings["too_long"])
        if "stopped" in findings:
            raise PathStopped(
                findings["stopped"], high if findings["at_high"] else low, final=findings["final"]
            )
        changed = findings["stiffer"]
        if not changed:  # penalties come first: a new depth may need other cuts
            self._last_cut_step, changed = low.s, findings["cuts"]
            # a resumed run has the numbers of the cuts alone: it makes the cuts again
            recall_cuts(self._stage, high, changed)
        return State(low.state.u, {**low.state.mu, **changed}) if changed else None

    def too_deep(self, point: Point) -> str:
        """Return a message on contacts that are too deep at a point between two points of the run.

        It is "" where no penetration is beyond its bound, or no penalty could become stiffer.
        Collective.
        """
        scene = self._stage.scene
        if not scene.model.all_contacts:
            return ""

        def message_of_point() -> RecordedValues:
            """Return the message under the key "said"."""
            state = self._stage.leave(point.state)
            message = penetration_message(scene, state)
            # if a penalty can become stiffer, the run shall stop before and solve again with it
            may_rise = bool(message) and bool(raised_stiffnesses(scene, state))
            return RecordedValues({"said": message if may_rise else ""})

        return str(self._path.recorded_values(message_of_point).values["said"])

    def _finding(self, low: Point, high: Point) -> RecordedValues:
        """Return why the second of two points is refused, or which settings of contact change.

        The keys are `too_long` (reason for a shorter step); or `stopped`, `at_high` and `final`
        (reason for the end of the path); or `stiffer` and `cuts`, each amplitude -> new value,
        empty without a change.
        """
        stage = self._stage
        try:
            refuse_crossing(stage, low, high)
            refuse_passing(stage, low, high)
            refuse_pressed_support(stage, low, high)
            if self._returns:
                refuse_return(stage, self._path.name, self.walk.points, high)
        except StepTooLong as e:
            return RecordedValues({"too_long": str(e)})
        except PathStopped as e:
            return RecordedValues({"stopped": str(e), "at_high": e.point is high, "final": e.final})
        state = stage.leave(high.state)
        stiffer = raised_stiffnesses(stage.scene, state)
        # new cuts once in a step: points of contact that have slid are better than no solution
        may_recut = not stiffer and low.s != self._last_cut_step
        cuts = better_cuts(stage.scene, state) if may_recut else {}
        # the instability is between the points; or changed settings have moved it before the first
        # point, whose pivots then differ
        has_instability = (
            high.has_instability_since(low) or low.negative_pivots != self._pivots_at_begin
        )
        # cuts with closer points of contact, where these would change the instability
        is_unchanged = not (stiffer or cuts)
        needs_closer_points = has_instability and is_unchanged
        closer = closer_points(stage, low, high) if needs_closer_points else {}
        return RecordedValues({"stiffer": stiffer, "cuts": cuts or closer})


class _StageRecords:
    """Records of `follow_path`, with points of the stage's system.

    Where load control fails, another run continues the path: in shorter steps, or by arc length.

    Parameters
    ----------
    stage
        Scene with the solver of the step.
    run
        First run.
    branches
        Number of steps for each direction of the branch at the first bifurcation; 0: no branch.

    Attributes
    ----------
    _stage, _first_run, _branches
        The parameters.
    _goal, _monitor
        Where the path ends, and the monitor of excluded modes.
    _branch_switch
        The first bifurcation with its branch; None so far.
    _fold_text
        Words on the last fold, for a message; "" so far.
    _furthest
        Largest amplitude at which the path goes on; finite once an excluded mode is unstable.
    _tiny_steps
        The last points, each a tiny step after the one before.
    _stop_reason, _is_final
        Why the last run has stopped, "" if it has not; and whether no run may go on from there.
    """

    def __init__(self, stage: Stage, run: ContinuationRun, branches: int) -> None:
        """Prepare the records; the path is followed as `records` is iterated over."""
        self._stage, self._first_run, self._branches = stage, run, branches
        self._goal, self._monitor = run.goal, stage.scene.stability_monitor
        self._branch_switch: BranchSwitch | None = None
        self._fold_text = ""
        self._furthest = np.inf
        self._tiny_steps: list[Point] = []
        self._stop_reason, self._is_final = "", False

    def records(self) -> Records:
        """Yield the records of the path, of all its runs and of its branches.

        Returns
        -------
        State
            State of the stage's system at the end of the last run (the generator's return value).

        Raises
        ------
        Stopped
            If the path has stopped before its goal.
        """
        stage, goal, run = self._stage, self._goal, self._first_run
        stage.scene.progress.doing("looking for modes that the model excludes")
        path, shortest_step = run.path, run.path.options.smallest
        if path.control == "load" and goal.targets:  # a fold may come before the target
            run.path = _ending_early(path, path.options.first, shortest_step)
        for applied in stage.scene.model.fields:
            applied.lost = ""  # so far the field is known at all places
        self._monitor.begin(path, run.points[0], stage.leave)
        records_ahead: list[Record] = []  # a fold that load control cannot pass
        next_run: ContinuationRun | None = run
        while next_run:
            run, next_run = next_run, None
            path = run.path
            goal_precedes_stop = yield from self._records_of_run(run, path)
            if goal_precedes_stop:
                break
            # if the run has stopped: a fold that explains it, or the run that goes on
            if self._stop_reason:
                records_ahead, next_run = _after_stop(
                    stage, run, finest=shortest_step, final=self._is_final
                )
            if next_run:
                is_by_arc = next_run.path.control == "arc"
                stage.scene.progress.doing(
                    "going on by arc length" if is_by_arc else "in shorter steps"
                )
                self._stop_reason = ""
                self._monitor.begin(next_run.path, next_run.points[0], stage.leave)
        yield from records_ahead
        reason = self._reason(path, records_ahead)
        if reason:
            raise Stopped(reason)
        if self._branches and self._branch_switch:
            yield from _branches(stage, path, self._branch_switch, goal, self._branches)
        return run.points[-1].state

    def _records_of_run(self, run: ContinuationRun, path: Path) -> Generator[Record, None, bool]:
        """Yield the records of one run, and set `_stop_reason` if it stops.

        Returns
        -------
        bool
            Whether the run has stopped, but its goal, an excluded instability, lies before the stop
            (the generator's return value). Then no other run follows.
        """
        stage, goal = self._stage, self._goal
        try:
            for label, point in run:
                is_located = label in LOCATED
                is_last = run.done or abs(point.state.mu[path.name]) > self._furthest
                # the monitor may skip points, but not located ones and the last one
                crossings = self._monitor.pass_to(point, evaluate=is_located or is_last)
                excluded = list(_excluded_records(stage, path, crossings))
                if excluded and goal.until == "bifurcation":
                    yield excluded[0]
                    break
                yield from excluded
                self._limit_amplitude(path, excluded)
                yield self._record(run, path, label, point)
                if abs(point.state.mu[path.name]) > self._furthest:
                    break
        except PathStopped as e:
            message = _stop_message(stage.scene, path, e, run.points)
            self._stop_reason = message + self._fold_text + stage.scene.lost_field_text()
            self._is_final = e.final
        # crossings on the last part of the way, after the monitor's last evaluation
        excluded = list(_excluded_records(stage, path, self._monitor.end()))
        has_reached_goal = excluded and goal.until == "bifurcation"
        if has_reached_goal and self._stop_reason:
            yield excluded[0]
            self._stop_reason = ""  # the goal lies before the stop
            return True
        yield from excluded
        self._limit_amplitude(path, excluded)
        return False

    def _limit_amplitude(self, path: Path, excluded: Sequence[Record]) -> None:
        """Let a path with `until: limit` end soon after its first excluded instability.

        Its amplitude may reach `MAX_RATIO_TO_EXCLUDED` times that of the instability.

        Parameters
        ----------
        excluded
            New records of excluded instabilities; may be empty.
        """
        if excluded and self._goal.until == "limit":
            amplitude_there = abs(excluded[0].point.state.mu[path.name])
            self._furthest = min(self._furthest, MAX_RATIO_TO_EXCLUDED * amplitude_there)

    def _record(self, run: ContinuationRun, path: Path, label: Label, point: Point) -> Record:
        """Return the record of a point; the branch of the first bifurcation is kept for later."""
        stage, mode = self._stage, ""
        # "step" in place of the label, if the instability is local to a point force
        label = _label_of(stage, path, label, point, ends=run.done)
        if label == "bifurcation":
            by_arc = _arc_length_path(stage, path)
            branch_switch = switch_branch(by_arc, point, partial(passes, stage))
            self._branch_switch = self._branch_switch or branch_switch
            if branch_switch:  # None: the branch is not found
                mode = "symmetric" if branch_switch.symmetric else "asymmetric"
        if label == "fold":
            value = amount(stage.scene, path.name, point.state.mu[path.name])
            self._fold_text = f"; the last fold is at {value}"
        remark = cluster_remark(stage.scene, run, point) or self._remark_on_tiny_steps(run, point)
        unstable = self._monitor.unstable
        return Record(label, path.name, point, mode, excluded_pivots=unstable, said=remark)

    def _remark_on_tiny_steps(self, run: ContinuationRun, point: Point) -> str:
        """Return a remark on a path that creeps since something touches; else "".

        It stands once, at the point where so many steps were tiny against the way of the run: so
        far, or up to its target where that is a value of s.
        """
        earlier, begin = self._tiny_steps, run.points[0].s
        ends = [point.s] if run.path.control == "arc" else [point.s, *run.goal.targets[-1:]]
        tiny = TINY_STEP * max(abs(end - begin) for end in ends)
        is_tiny = bool(earlier) and abs(point.s - earlier[-1].s) < tiny
        self._tiny_steps = [*earlier, point] if is_tiny else [point]
        if len(self._tiny_steps) != TINY_STEPS + 1 or not self._stage.scene.model.all_contacts:
            return ""
        remark = creeping_remark(self._stage.scene)
        is_load_by_arc = run.path.control == "arc" and not run.path.name.startswith("approach")
        return f"{remark}; or control: load" if is_load_by_arc else remark

    def _reason(self, path: Path, records_ahead: Sequence[Record]) -> str:
        """Return the reason why the path has stopped, in words; "" if it has reached its goal.

        Parameters
        ----------
        records_ahead
            A fold that load control cannot pass, with excluded instabilities before it; may be
            empty.
        """
        scene, reason = self._stage.scene, self._stop_reason
        if records_ahead:
            at = amount(scene, path.name, records_ahead[-1].point.state.mu[path.name])
            target = amount(scene, path.name, self._goal.targets[-1])
            reason = (
                f"load control cannot pass the fold at {at}, before its target, {target}; {reason}"
            )
        if self._monitor.unlocated:
            unlocated_text = (
                "a mode that the reduced model excludes is unstable from an unknown point on: "
                f"{self._monitor.unlocated}"
            )
            reason = f"{reason}; {unlocated_text}" if reason else unlocated_text
        return reason


def _after_stop(
    stage: Stage, walk: ContinuationRun, finest: float, *, final: bool
) -> tuple[list[Record], ContinuationRun | None]:
    """Return how a path goes on after a run that has stopped.

    Under load control with a target, a fold may explain why the last step failed: then the path
    ends at the fold. Without such a fold a new run takes shorter steps, down to `finest`. A path
    without a target goes on by arc length.

    Parameters
    ----------
    walk
        The run that has stopped.
    finest
        Shortest step that any run may take, as a change of the load. The shortest step of `walk`
        may be longer.
    final
        Whether the reason forbids that the path goes on.

    Returns
    -------
    records_ahead
        The fold that ends the path, after excluded instabilities on the way; else empty.
    next_run
        The run that goes on; None if the path ends.
    """
    path, goal, last_point = walk.path, walk.goal, walk.points[-1]
    if path.control != "load" or not goal.targets:
        return [], None if final else _onward_by_arc(stage, walk)
    shortest = path.options.smallest
    last_resort = final or shortest <= finest  # no run in shorter steps follows
    # largest change of the load at which a fold is looked for
    reach = abs(goal.targets[-1] - last_point.s)
    if not last_resort:  # the fold must be within the failed step, which ends at the next target
        sense = np.sign(goal.targets[-1] - last_point.s)
        # positive where the target is ahead
        distances = [(target - last_point.s) * sense for target in goal.targets]
        reach = min(2 * shortest, *(distance for distance in distances if distance > 0))
    records_ahead = _fold_ahead(stage, walk, reach)
    if records_ahead or last_resort:
        return records_ahead, None
    return [], checked_run(stage, _ending_early(path, shortest, finest), last_point, goal)


def _ending_early(path: Path, first: float, finest: float) -> Path:
    """Return the path with another first step, and with a shortest step not far below it.

    So a failing step is halved a few times only before the run ends and a fold is looked for.

    Parameters
    ----------
    first, finest
        First step, and least value of the shortest step, in the controlled quantity.
    """
    return path.with_step_options(
        replace(path.options, first=first, smallest=max(finest, FIRST_STEP_REDUCTION * first))
    )


def _onward_by_arc(stage: Stage, walk: ContinuationRun) -> ContinuationRun | None:
    """Return a run by arc length from where another run stopped; None if there is none.

    There is none where the run was by arc length already, or has a target. Without a target the run
    looks for an instability, which is at the same load under any control. A target is a value of
    the controlled quantity, and so needs this control. The first step is as long as the median step
    of the run that stopped.
    """
    path, goal, points = walk.path, walk.goal, walk.points
    if path.control == "arc" or goal.targets:
        return None
    last_point, name, metric = points[-1], path.name, path.metric
    step_lengths = [
        metric.norm(
            next_point.state.u - point.state.u, next_point.state.mu[name] - point.state.mu[name]
        )
        for point, next_point in pairwise(points)
    ]
    # without a step so far: the length of the first step that was tried
    lengths = step_lengths or [path.options.first * metric.norm(last_point.du, last_point.dmu)]
    first_length = float(np.median(lengths))
    by_arc = stage.path(
        name,
        "arc",
        StepOptions(first_length, LONGEST * first_length, 1e-6 * first_length),
        metric.scale,
    )
    # The run starts in the direction of the last step. Of the product of d mu/ds and the change of
    # s the sign alone counts: whether the amplitude first grows or falls.
    change_of_s = last_point.s - points[-2].s if step_lengths else goal.sense
    start = by_arc.start(last_point.state, last_point.dmu * change_of_s)
    return checked_run(stage, by_arc, start, goal)


def _branches(
    stage: Stage, path: Path, branch_switch: BranchSwitch, goal: ContinuationGoal, steps: int
) -> Iterator[Record]:
    """Yield the records of both directions of a branch.

    Each ends at the target of the path, or after `steps` steps. The second direction is followed
    also if the first one is lost. `branch_switch` has the first points of both.

    Raises
    ------
    Stopped
        After both, with the reasons, if a direction is lost.
    """
    stop_reasons = []
    for number, start in enumerate(branch_switch.starts, 1):
        try:
            yield from follow_branch(
                stage, _arc_length_path(stage, path), start, off_path(goal, steps), number
            )
        except Stopped as e:
            stop_reasons.append(f"branch {number}: {e}")
    if stop_reasons:
        raise Stopped("; ".join(stop_reasons))


def off_path(goal: ContinuationGoal, steps: int) -> ContinuationGoal:
    """Return the goal of a branch: the target of its path if it has one, else a number of steps."""
    return goal if goal.until == "target" else ContinuationGoal("points", steps=steps)


def follow_branch(
    stage: Stage, path: Path, start: Point, goal: ContinuationGoal, number: int
) -> Records:
    """Yield the records of a branch, by arc length.

    Parameters
    ----------
    path
        Path with arc-length control.
    start
        First point of the branch; it is corrected again until its contacts are fit.
    number
        Number of the branch; the two directions at a bifurcation have 1 and 2.

    Returns
    -------
    State
        State of the step's system at the end (the generator's return value).

    Raises
    ------
    Stopped
        If the branch is lost.
    """
    start = with_fit_contact(stage, path, start)
    walk, monitor = checked_run(stage, path, start, goal), stage.scene.stability_monitor
    stop_reason = ""
    monitor.begin(path, start, stage.leave, evaluate=True)
    yield Record("step", path.name, start, branch=number, excluded_pivots=monitor.unstable)
    try:
        for label, point in walk:
            crossings = monitor.pass_to(point, evaluate=walk.done or label in LOCATED)
            for record in _excluded_records(stage, path, crossings):
                yield replace(record, branch=number)
            record_label = _label_of(stage, path, label, point, ends=walk.done)
            remark = cluster_remark(stage.scene, walk, point)
            yield Record(
                record_label,
                path.name,
                point,
                branch=number,
                excluded_pivots=monitor.unstable,
                said=remark,
            )
    except PathStopped as e:
        stop_reason = _stop_message(stage.scene, path, e, walk.points)
    for record in _excluded_records(stage, path, monitor.end()):
        yield replace(record, branch=number)
    if stop_reason:
        raise Stopped(stop_reason)
    return walk.points[-1].state


def with_fit_contact(stage: Stage, path: Path, start: Point) -> Point:
    """Return the first point of a branch, corrected again with contact that fits it; collective.

    Penalties become stiffer, and shells are cut anew, until both fit the displacement of the point.

    Raises
    ------
    Stopped
        If there is no such point.
    """
    try:
        for _ in range(MAX_CONTACT_CHANGES):
            # the model's state with changed settings; None if they are fit
            state_to_solve = with_own_contact(stage.scene, stage.leave(start.state))
            if not state_to_solve:
                break
            settings = {**start.state.mu, **state_to_solve.mu}
            start = path.recorrected(start, State(start.state.u, settings))
    except PathStopped as e:
        raise Stopped(f"no first point of the branch with contact of its own: {e}") from None
    return start


def _arc_length_path(stage: Stage, path: Path) -> Path:
    """Return the path with arc-length control and the steps of a branch: first, longest, least.

    Arc lengths are over the scales of the path's displacement and amplitude, so 0.1 is a short step
    for any case.
    """
    scale = path.metric.scale
    return stage.path(path.name, "arc", StepOptions(0.1, LONGEST * 0.1, 1e-6), scale)


def _fold_ahead(stage: Stage, walk: ContinuationRun, reach: float) -> list[Record]:
    """Return the fold that ended a path under load control, located by arc length.

    Parameters
    ----------
    walk
        The run under load control that has stopped.
    reach
        Largest change of the load to the fold.

    Returns
    -------
    list of Record
        The fold, after excluded instabilities on the way; empty if there is no fold within reach.
    """
    path, points, name = walk.path, walk.points, walk.path.name
    last_point = points[-1]
    # the change of the load in the last step; without one, a first step towards the target
    first_change = np.copysign(path.options.first, walk.goal.targets[-1] - last_point.s)
    load_change = last_point.s - points[-2].s if len(points) > 1 else float(first_change)
    by_arc, start = stage.resume(name, "arc", last_point.state, load_change, path.metric.scale)
    stage.scene.stability_monitor.begin(by_arc, start, stage.leave)
    excluded: list[Record] = []
    try:
        for label, point in ContinuationRun(by_arc, start, ContinuationGoal("limit", steps=20)):
            crossings = stage.scene.stability_monitor.pass_to(point, evaluate=label == "fold")
            excluded += _excluded_records(stage, by_arc, crossings)
            if abs(point.state.mu[name] - last_point.s) > reach:
                return []
            if label == "fold":
                return [
                    *excluded,
                    Record(
                        label, name, point, excluded_pivots=stage.scene.stability_monitor.unstable
                    ),
                ]
    except PathStopped:  # then no fold is known, as if there were none
        pass
    return []


def _label_of(stage: Stage, path: Path, label: Label, point: Point, *, ends: bool) -> Label:
    """Return the label of a point; an instability local to a point force is labelled as a step.

    Such an instability depends on the mesh. It is noted, and the history gives a remark on it.

    Parameters
    ----------
    ends
        Whether the point is the last of its run.

    Raises
    ------
    Stopped
        If such an instability ends the run.
    """
    if label not in LOCATED:
        return label
    force_point = point_of_instability(stage, path, label, point)
    if not force_point:
        return label
    value = amount(stage.scene, path.name, point.state.mu[path.name])
    if ends:
        raise Stopped(
            f"at {value} the shell gives way within a thickness of the point force at "
            f"{force_point}: {AT_POINT_FORCES}"
        )
    stage.scene.point_force_modes.note(force_point, value, f"a {label}")
    return "step"


def _excluded_records(stage: Stage, path: Path, crossings: Iterable[Crossing]) -> Iterator[Record]:
    """Yield records of the points where excluded modes become unstable or stable.

    Crossings of modes that are local to a point force depend on the mesh. They are left out and
    noted, and the history gives a remark on them.
    """
    for crossing in crossings:
        force_point = point_of_crossing(stage, path, crossing)
        if force_point:
            value = amount(stage.scene, path.name, crossing.point.state.mu[path.name])
            stage.scene.point_force_modes.note(force_point, value, crossing.label)
            continue
        yield Record(
            "bifurcation",
            path.name,
            crossing.point,
            crossing.label,
            excluded_pivots=crossing.unstable,
        )


def cluster_remark(scene: Scene, walk: ContinuationRun, point: Point) -> str:
    """Return a remark on instabilities too close to each other to be located one by one.

    It stands at the first point of each such cluster of a run; at other points it is "". Where the
    number of unstable directions changes by one, there is one alone, between two branches that pass
    near each other; where it does not change, one of two is a fold.
    """
    # a cluster has a first and a last point
    other_end = next(
        (high_point for low_point, high_point in walk.clusters if low_point is point), None
    )
    if other_end is None:
        return ""
    name, count = walk.path.name, abs(other_end.negative_pivots - point.negative_pivots)
    first_amount, last_amount = (
        amount(scene, name, end.state.mu[name]) for end in (point, other_end)
    )
    if count > 1:
        return (
            f"instabilities in {count} directions between {first_amount} and {last_amount} are "
            "too close to be located one by one"
        )
    if count:
        return (
            f"an instability between {first_amount} and {last_amount} cannot be located more "
            "closely: an imperfection parts the branches there, and they pass too near each other"
        )
    return (
        f"a fold and another instability between {first_amount} and {last_amount} are too close "
        "to be located one by one"
    )


def creeping_remark(scene: Scene) -> str:
    """Return the remark on a path whose steps stay tiny since something touches a shell."""
    problem = scene.problem
    h, given_size = problem.material.h, problem.mesh.size
    size = RESOLVING_SIZE * np.sqrt(h) * problem.length
    if given_size:
        size = min(size, given_size / 2)
    unit, way_on = scene.sizes.column("w_over_h"), f"mesh.size: {size:.2g}"
    if unit:  # w_over_h has the thickness as its unit
        measured = size / (h * problem.length) * scene.sizes.size("w_over_h")
        way_on = f"mesh.size: {measured:.2g} {unit.si}"
    if problem.axisymmetric:  # its elements are smaller than these
        way_on = f"mesh.refinement: {2 * problem.mesh.refinement:g}"
    return (
        "the steps stay tiny where the shell touches something, most often since its elements are "
        f"too large there: give {way_on}"
    )


def amount(scene: Scene, name: str, value: float) -> str:
    """Return the value of an amplitude, as "pressure = 0.326233 (53.7 Pa)"."""
    column = amplitude(name).column
    unit_column = scene.sizes.column(column)
    measured = unit_column and f" ({value * scene.sizes.size(column):.6g} {unit_column.si})"
    return f"{name} = {value:.6g}{measured or ''}"


def _stop_message(scene: Scene, path: Path, stop: PathStopped, points: list[Point]) -> str:
    """Return the message for a lost path.

    Under a controlled displacement it names a fold ahead, if the tangents of the last points show
    one.

    Parameters
    ----------
    stop
        Reason and last point.
    points
        Points of the run up to there.
    """
    last_point = stop.point
    place = f"the last point has {amount(scene, path.name, last_point.state.mu[path.name])}: {stop}"
    if path.control == "load":
        return f"load control stopped; {place}. To pass a limit point, use control: arc"
    previous = points[-2] if len(points) > 1 else last_point
    if path.control == "arc" or previous.dmu == last_point.dmu:
        return f"the controlled path stopped; {place}"
    # near a fold in the controlled s, (ds/dmu)^2 falls linearly to zero with s: extrapolate it
    squared_slope_before, squared_slope_last = previous.dmu**-2, last_point.dmu**-2
    distance_ahead = (
        squared_slope_last
        * (last_point.s - previous.s)
        / (squared_slope_before - squared_slope_last)
        if squared_slope_before > squared_slope_last
        else np.inf
    )
    if 0 < distance_ahead / (last_point.s - previous.s) < 10:  # ahead, and not many steps away
        return (
            "the path turns back in the controlled displacement, "
            f"{distance_ahead / last_point.s:.2%} "
            "beyond the last point: a fold that displacement control cannot pass, but control: arc "
            f"can; {place}"
        )
    return f"the controlled path stopped; {place}"

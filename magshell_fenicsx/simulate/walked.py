"""A walk along a path of a scene: its records, the modes that the model excludes, and branches."""

from collections.abc import Generator, Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np

from magshell_fenicsx.continuation.bifurcation import Branching, branching
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import (
    Finding,
    PathStopped,
    Point,
    StepOptions,
    StepTooLong,
)
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.continuation.walk import Goal, Label, Walk
from magshell_fenicsx.continuation.watch import Crossing
from magshell_fenicsx.quantities.registry import amplitude
from magshell_fenicsx.simulate.point_forces import point_of_crossing, point_of_instability
from magshell_fenicsx.simulate.record import AT_POINT_FORCES, Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import LONGEST, Stage
from magshell_fenicsx.simulate.touch import (
    better_cuts,
    closer_points,
    of_its_own,
    passes,
    penetration_refused,
    recall_cuts,
    refuse_crossing,
    refuse_passing,
    refuse_return,
    stiffnesses,
)

BEYOND = 2.0  # a walk ends at this multiple of the load of the first excluded instability
MOST_CHANGED = 10  # times that a first point gets stiffer penalties or new cuts
ASKED = (
    1 / 16
)  # of the first step: where load control fails in so short a step, a fold is looked for first


Records = Generator[Record, None, State]  # records, and the model's state at the end


class Walked:
    """Records to iterate over once; `end` is the state at their end."""

    def __init__(self, records: Records) -> None:
        self._records, self.end = records, State(np.empty(0), {})

    def __iter__(self) -> Iterator[Record]:
        self.end = yield from self._records


def followed(stage: Stage, path: Path, start: Point, goal: Goal, branches: int = 0) -> Records:
    """The records of a walk, with instabilities that the reduced model excludes, and of branches.

    Each direction of the branch at the first bifurcation is followed for that number of steps, or
    to the target.

    With `until: bifurcation` an excluded instability ends the walk. With `until: limit` the walk
    continues to the first instability of the model itself, up to `BEYOND` times the load of the
    first excluded one.

    Raises
    ------
    Stopped
        If the path is lost.
    """
    records = Walked(_followed(stage, _walk(stage, path, start, goal), branches))
    advance = stage.scene.model.system.advance
    past = start.state.mu
    for record in records:
        point = stage.point(record.point)
        past = (state := advance(point.state, past)).mu
        yield replace(record, point=replace(point, state=state))
    return advance(stage.leave(records.end), past)


def _walk(stage: Stage, path: Path, start: Point, goal: Goal) -> Walk:
    """A walk on which bodies become stiffer, and shells are cut anew and get closer points where
    these move an instability; magnets on the way and returning bodies end it."""
    checks = _Checks(stage, path, goal.until != "points")
    checks.walk = walk = Walk(path, start, goal, checks, checks.too_deep)
    return walk


class _Checks:
    """What is seen to between each two successive points of a walk, as `renew` of a `Walk`.

    Parameters
    ----------
    returns
        Whether a body that goes back the way it came ends the walk.

    Attributes
    ----------
    walk
        The one that they are of.
    """

    walk: Walk

    def __init__(self, stage: Stage, path: Path, returns: bool) -> None:
        self._stage, self._path, self._returns = stage, path, returns
        self._cut_at = np.nan  # s of the point behind which cuts were last made anew: once for each
        # s of the first point, and its negative pivots before anything was changed there
        self._begin = np.nan, 0

    def __call__(self, low: Point, high: Point) -> State | None:
        """See `Walk`.

        Raises
        ------
        PathStopped, StepTooLong
            If the second point must not follow the first one.
        """
        if low.s != self._begin[0]:
            self._begin = low.s, low.negative_pivots
        found = self._path.noted(partial(self._finding, low, high)).values
        if "too_long" in found:
            raise StepTooLong(found["too_long"])
        if "stopped" in found:
            raise PathStopped(
                found["stopped"], high if found["at_high"] else low, final=found["final"]
            )
        changed, of_cuts = found["stiffer"], not found["stiffer"]
        if of_cuts:
            self._cut_at, changed = low.s, found["cuts"]
            recall_cuts(self._stage, high, changed)
        return State(low.state.u, {**low.state.mu, **changed}) if changed else None

    def too_deep(self, point: Point) -> str:
        """How deep what touches is at a point between two of the walk, where a penalty would rise;
        "" where none is beyond its bound."""
        scene = self._stage.scene
        if not (scene.model.contacts or scene.model.touchings):
            return ""

        def find() -> Finding:
            state = self._stage.leave(point.state)
            said = penetration_refused(scene, state)
            return Finding({"said": said if said and stiffnesses(scene, state) else ""})

        return str(self._path.noted(find).values["said"])

    def _finding(self, low: Point, high: Point) -> Finding:
        """Find out why the second of two points is refused, or which amplitudes change before it is
        solved again."""
        stage = self._stage
        try:
            refuse_crossing(stage, low, high)
            refuse_passing(stage, low, high)
            if self._returns:
                refuse_return(stage, self._path.name, self.walk.points, high)
        except StepTooLong as e:
            return Finding({"too_long": str(e)})
        except PathStopped as e:
            return Finding({"stopped": str(e), "at_high": e.point is high, "final": e.final})
        state = stage.leave(high.state)
        raised = stiffnesses(stage.scene, state)
        anew = not raised and low.s != self._cut_at  # slid points are better than none
        cuts = better_cuts(stage.scene, state) if anew else {}
        turned = high.turned_from(low) or low.negative_pivots != self._begin[1]
        closer = closer_points(stage, low, high) if turned and not (raised or cuts) else {}
        return Finding({"stiffer": raised, "cuts": cuts or closer})


def _followed(stage: Stage, walk: Walk, branches: int) -> Records:
    """The same with the points of the stage's system; the state at the end of the last walk."""
    stage.scene.progress.doing("looking for modes that the model excludes")
    path, start, goal = walk.path, walk.points[0], walk.goal
    finest = path.options.smallest
    if path.control == "load" and goal.targets:
        walk.path = _asking(path, path.options.first, finest)
    ahead: list[Record] = []  # a fold that load control cannot pass
    crossing, fold, lost, final, watch = None, "", "", False, stage.scene.watch
    furthest = np.inf  # amplitude, once an excluded mode is unstable
    for applied in stage.scene.model.fields:
        applied.lost = ""
    watch.begin(path, start, stage.leave)
    onward: Walk | None = walk
    while onward:
        walk, path, onward = onward, onward.path, None
        try:
            for label, point in walk:
                mode, located = "", label in ("fold", "bifurcation")
                beyond = walk.done or abs(point.state.mu[path.name]) > furthest
                excluded = list(
                    _excluded(stage, path, watch.pass_to(point, look=located or beyond))
                )
                if excluded and goal.until == "bifurcation":
                    yield excluded[0]
                    break
                yield from excluded
                if excluded and goal.until == "limit":
                    furthest = min(furthest, BEYOND * abs(excluded[0].point.state.mu[path.name]))
                label = _label_of(stage, path, label, point, ends=walk.done)
                if label == "bifurcation":
                    crossing_at_point = branching(
                        _by_arc(stage, path), point, partial(passes, stage)
                    )
                    crossing = crossing or crossing_at_point
                    mode = (
                        ("symmetric" if crossing_at_point.symmetric else "asymmetric")
                        if crossing_at_point
                        else ""
                    )
                if label == "fold":
                    fold = f"; the last fold is at {amount(stage.scene, path.name, point.state.mu[path.name])}"
                said = words_of_cluster(stage.scene, walk, point)
                yield Record(
                    label, path.name, point, mode, excluded_pivots=watch.unstable, said=said
                )
                if abs(point.state.mu[path.name]) > furthest:
                    break
        except PathStopped as e:
            lost, final = (
                _why(stage.scene, path, e, walk.points) + fold + stage.scene.nowhere(),
                e.final,
            )
        excluded = list(_excluded(stage, path, watch.end()))
        if excluded and lost and goal.until == "bifurcation":
            yield excluded[0]
            lost = ""
            break
        yield from excluded
        if excluded and goal.until == "limit":
            furthest = min(furthest, BEYOND * abs(excluded[0].point.state.mu[path.name]))
        if lost:
            ahead, onward = _beyond(stage, walk, finest, final=final)
        if onward:
            stage.scene.progress.doing(
                "going on by arc length" if onward.path.control == "arc" else "in shorter steps"
            )
            lost = ""
            watch.begin(onward.path, onward.points[0], stage.leave)
    yield from ahead
    if ahead:
        at = amount(stage.scene, path.name, ahead[-1].point.state.mu[path.name])
        target = amount(stage.scene, path.name, goal.targets[-1])
        lost = f"load control cannot pass the fold at {at}, before its target, {target}; {lost}"
    if watch.unlocated:
        why = f"a mode that the reduced model excludes is unstable from an unknown point on: {watch.unlocated}"
        lost = f"{lost}; {why}" if lost else why
    if lost:
        raise Stopped(lost)
    if branches and crossing:
        yield from _branches(stage, path, crossing, goal, branches)
    return walk.points[-1].state


def _beyond(
    stage: Stage, walk: Walk, finest: float, *, final: bool
) -> tuple[list[Record], Walk | None]:
    """What ends a walk that has stopped, a fold with the excluded instabilities before it; or the
    walk that goes on.

    Under load control it goes on in steps down to `finest`, unless a fold explains why the last
    step failed.
    """
    path, goal, last = walk.path, walk.goal, walk.points[-1]
    if path.control != "load" or not goal.targets:
        return [], None if final else _onward(stage, walk)
    shortest = path.options.smallest
    last_resort = final or shortest <= finest
    within = abs(goal.targets[-1] - last.s)
    if not last_resort:  # the step that failed ends at the next target, or before
        ways = [(target - last.s) * np.sign(goal.targets[-1] - last.s) for target in goal.targets]
        within = min(2 * shortest, *(way for way in ways if way > 0))
    ahead = _fold_ahead(stage, walk, within)
    if ahead or last_resort:
        return ahead, None
    return [], _walk(stage, _asking(path, shortest, finest), last, goal)


def _asking(path: Path, first: float, finest: float) -> Path:
    """The path in steps that end early, to look for a fold."""
    return path.in_steps(replace(path.options, first=first, smallest=max(finest, ASKED * first)))


def _onward(stage: Stage, walk: Walk) -> Walk | None:
    """A walk by arc length from where another one stopped; None if it must not or cannot be.

    An instability is where it is however the path is controlled: only a target belongs to its
    control.
    """
    path, goal, points = walk.path, walk.goal, walk.points
    if path.control == "arc" or goal.targets:
        return None
    last, name, metric = points[-1], path.name, path.metric
    moved = [
        metric.norm(b.state.u - a.state.u, b.state.mu[name] - a.state.mu[name])
        for a, b in pairwise(points)
    ]
    first = float(np.median(moved or [path.options.first * metric.norm(last.du, last.dmu)]))
    by_arc = stage.path(
        name, "arc", StepOptions(first, LONGEST * first, 1e-6 * first), metric.scale
    )
    start = by_arc.start(last.state, last.dmu * (last.s - points[-2].s if moved else goal.sense))
    return _walk(stage, by_arc, start, goal)


def _branches(
    stage: Stage, path: Path, crossing: Branching, goal: Goal, steps: int
) -> Iterator[Record]:
    """Follow both directions of a branch, to the target of the path or for a number of steps."""
    lost = []
    for number, start in enumerate(crossing.starts, 1):
        try:
            yield from branch(stage, _by_arc(stage, path), start, off_path(goal, steps), number)
        except Stopped as e:
            lost.append(f"branch {number}: {e}")
    if lost:
        raise Stopped("; ".join(lost))


def off_path(goal: Goal, steps: int) -> Goal:
    """Where a branch ends: at the target of the path, or after a number of steps."""
    return goal if goal.until == "target" else Goal("points", steps=steps)


def branch(stage: Stage, path: Path, start: Point, goal: Goal, number: int) -> Records:
    """The records of a branch, by arc length, with its `number`; the state at the end of the step's
    system.

    Raises
    ------
    Stopped
        If the branch is lost.
    """
    try:
        for _ in range(MOST_CHANGED):
            if not (own := of_its_own(stage.scene, stage.leave(start.state))):
                break
            start = path.renewed(start, State(start.state.u, {**start.state.mu, **own.mu}))
    except PathStopped as e:
        raise Stopped(f"no first point of the branch with contact of its own: {e}") from None
    walk, watch, lost = _walk(stage, path, start, goal), stage.scene.watch, ""
    watch.begin(path, start, stage.leave, look=True)
    yield Record("step", path.name, start, branch=number, excluded_pivots=watch.unstable)
    try:
        for label, point in walk:
            look = walk.done or label in ("fold", "bifurcation")
            for record in _excluded(stage, path, watch.pass_to(point, look=look)):
                yield replace(record, branch=number)
            label = _label_of(stage, path, label, point, ends=walk.done)
            said = words_of_cluster(stage.scene, walk, point)
            yield Record(
                label, path.name, point, branch=number, excluded_pivots=watch.unstable, said=said
            )
    except PathStopped as e:
        lost = _why(stage.scene, path, e, walk.points)
    for record in _excluded(stage, path, watch.end()):
        yield replace(record, branch=number)
    if lost:
        raise Stopped(lost)
    return walk.points[-1].state


def _by_arc(stage: Stage, path: Path) -> Path:
    """The same path with arc-length control; its steps are as long as the first step on a branch."""
    scale = path.metric.scale
    return stage.path(path.name, "arc", StepOptions(0.1, LONGEST * 0.1, 1e-6), scale)


def _fold_ahead(stage: Stage, walk: Walk, within: float) -> list[Record]:
    """The fold that ended a path under load control, located by arc length, after any excluded
    instabilities.

    None if there is none `within` so small a change of the load.
    """
    path, points, name = walk.path, walk.points, walk.path.name
    last = points[-1]
    first = np.copysign(path.options.first, walk.goal.targets[-1] - last.s)
    onward = last.s - points[-2].s if len(points) > 1 else float(first)
    by_arc, start = stage.resume(name, "arc", last.state, onward, path.metric.scale)
    stage.scene.watch.begin(by_arc, start, stage.leave)
    passed: list[Record] = []
    try:
        for label, point in Walk(by_arc, start, Goal("limit", steps=20)):
            passed += _excluded(
                stage, by_arc, stage.scene.watch.pass_to(point, look=label == "fold")
            )
            if abs(point.state.mu[name] - last.s) > within:
                return []
            if label == "fold":
                return [
                    *passed,
                    Record(label, name, point, excluded_pivots=stage.scene.watch.unstable),
                ]
    except PathStopped:
        pass
    return []


def _label_of(stage: Stage, path: Path, label: Label, point: Point, *, ends: bool) -> Label:
    """The label of a point of a walk: that of a step where an instability is one of a point force.

    Raises
    ------
    Stopped
        If such an instability ends the walk.
    """
    if label not in ("fold", "bifurcation"):
        return label
    at = point_of_instability(stage, path, label, point)
    value = amount(stage.scene, path.name, point.state.mu[path.name])
    if at and ends:
        raise Stopped(
            f"at {value} the shell gives way within a thickness of the point force at {at}: {AT_POINT_FORCES}"
        )
    if at:
        stage.scene.at_point_forces.note(at, value, f"a {label}")
    return "step" if at else label


def _excluded(stage: Stage, path: Path, crossings: Iterable[Crossing]) -> Iterator[Record]:
    """Records of the points where excluded modes become unstable or stable, but for those of a
    point force."""
    for crossing in crossings:
        if at := point_of_crossing(stage, path, crossing):
            value = amount(stage.scene, path.name, crossing.point.state.mu[path.name])
            stage.scene.at_point_forces.note(at, value, crossing.label)
            continue
        yield Record(
            "bifurcation",
            path.name,
            crossing.point,
            crossing.label,
            excluded_pivots=crossing.unstable,
        )


def words_of_cluster(scene: Scene, walk: Walk, point: Point) -> str:
    """Return what is said of instabilities that were not parted, at the point that stands for them;
    "" at others."""
    behind = next((high for low, high in walk.clusters if low is point), None)
    if behind is None:
        return ""
    name, count = walk.path.name, abs(behind.negative_pivots - point.negative_pivots)
    first, last = (amount(scene, name, end.state.mu[name]) for end in (point, behind))
    if count > 1:
        return f"instabilities in {count} directions between {first} and {last} are too close to be located one by one"
    return f"a fold and another instability between {first} and {last} are too close to be located one by one"


def amount(scene: Scene, name: str, value: float) -> str:
    """The value of an amplitude, as "pressure = 0.326233 (53.7 Pa)"."""
    column = amplitude(name).column
    in_units = scene.sizes.column(column)
    measured = in_units and f" ({value * scene.sizes.size(column):.6g} {in_units.si})"
    return f"{name} = {value:.6g}{measured or ''}"


def _why(scene: Scene, path: Path, stop: PathStopped, points: list[Point]) -> str:
    """The message for a lost path; it names a fold in the controlled quantity."""
    last = stop.point
    where = f"the last point has {amount(scene, path.name, last.state.mu[path.name])}: {stop}"
    if path.control == "load":
        return f"load control stopped; {where}. To pass a limit point, use control: arc"
    before = points[-2] if len(points) > 1 else last
    if path.control == "arc" or before.dmu == last.dmu:
        return f"the controlled path stopped; {where}"
    # near a fold in the controlled s, (ds/dmu)^2 falls linearly to zero with s
    a, b = before.dmu**-2, last.dmu**-2
    ahead = b * (last.s - before.s) / (a - b) if a > b else np.inf
    if 0 < ahead / (last.s - before.s) < 10:
        return (
            f"the path turns back in the controlled displacement, {ahead / last.s:.2%} beyond the last point: "
            f"a fold that displacement control cannot pass, but control: arc can; {where}"
        )
    return f"the controlled path stopped; {where}"

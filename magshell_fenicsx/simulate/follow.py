"""The history of a case: the field first, then the load; every accepted point, and what stopped it."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from magshell_fenicsx.case.loading import (
    DeadSection,
    FieldSection,
    IndentationSection,
    PathSection,
    PressureSection,
    RotationSection,
)
from magshell_fenicsx.continuation.along import Along
from magshell_fenicsx.continuation.branch import Branching, branching
from magshell_fenicsx.continuation.path import Control, Path, StepOptions
from magshell_fenicsx.continuation.point import PathStopped, Point
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.continuation.walk import MOST_STEPS, Goal, Quantity, Walk
from magshell_fenicsx.continuation.watch import Crossing
from magshell_fenicsx.models.observed import Observed
from magshell_fenicsx.simulate.scene import Scene

Label = Literal["start", "field", "step", "target", "fold", "bifurcation"]
CONTROLS: dict[str, Control] = {"volume": "conjugate", "displacement": "conjugate", "load": "load", "arc": "arc"}
LONGEST = 50.0  # step by arc length, over the first


@dataclass(frozen=True)
class Record:
    """A point of the history and how it came about.

    Attributes
    ----------
    label
        "field": while the field grows; "step": on the way; "target": asked for;
        "fold" and "bifurcation": a located instability.
    amplitude
        The amplitude that varied ("" at the start).
    mode
        Of an instability that a reduced model excludes: "antisymmetric" to the mirror plane of a
        half shell, or "m = 7" waves around an axisymmetric one. There such a mode becomes unstable,
        or stable again.
        Of a bifurcation in the model itself: "symmetric" if the load changes alike in both
        directions of the branch (a pitchfork), or "asymmetric".
    branch
        0 on the path itself, 1 and 2 in the two directions of the branch at its first bifurcation.
    excluded_pivots
        Number of unstable directions that the model excludes; see `solve.watch.Watch`.
    """

    label: Label
    amplitude: str
    point: Point
    mode: str = ""
    branch: int = 0
    excluded_pivots: int = 0


class Stopped(RuntimeError):
    """The history ended before its target; the message says where and why."""


def follow(scene: Scene) -> Iterator[Record]:
    """Run through the history of a scene.

    Raises
    ------
    Stopped
        If the path is lost, or the field alone makes the shell unstable.
    """
    state = scene.unloaded()
    pivots = scene.newton.factor_at(state).negative_pivots
    yield Record("start", "", Point(state, 0.0, 0.0 * state.u, 0.0, pivots, pivots, 0, 1))
    if pivots:
        raise Stopped(
            f"the undeformed shell is unstable in {pivots} directions: mesh.penalty is too small or the mesh too coarse"
        )
    loading = scene.case.loading
    if isinstance(loading, FieldSection):
        yield from _field_as_load(scene, loading, state)
        return
    if scene.model.loads.magnetic:
        for record in _field(scene, state):
            yield record
            state = record.point.state
    if isinstance(loading, PressureSection):
        yield from _pressure(scene, loading, state)
    elif isinstance(loading, IndentationSection):
        yield from _indentation(scene, loading, state)
    elif isinstance(loading, DeadSection):
        yield from _dead(scene, loading, state)
    elif isinstance(loading, RotationSection):
        yield from _rotation(scene, loading, state)


def _field(scene: Scene, state: State) -> Iterator[Record]:
    """The field, up to lambda_m; where it makes the shell unstable, the critical field."""
    target, instability = scene.case.lambda_m, None
    path, start = begin(scene, "lambda_m", "arc", state, target / 2, target)
    for record in followed(scene, path, start, Goal("limit", [target])):
        located = record.label in ("fold", "bifurcation")
        instability = instability or (record if located else None)
        yield record if located else replace(record, label="field")
    if instability is not None:
        raise Stopped(
            f"the field alone makes the shell unstable: critical field lambda_m = "
            f"{instability.point.state.mu['lambda_m']:.9g} of {target:g} ({instability.mode or instability.label})"
        )


def _field_as_load(scene: Scene, loading: FieldSection, state: State) -> Iterator[Record]:
    target = scene.case.lambda_m
    path, start = begin(scene, "lambda_m", CONTROLS[loading.control], state, target / loading.points, target)
    targets = _divided(0.0, target, loading.points) if loading.until == "target" else []
    yield from followed(scene, path, start, _goal(loading, targets, "load", target), branches=loading)


def _pressure(scene: Scene, loading: PressureSection, state: State) -> Iterator[Record]:
    path, start = begin(scene, "pressure", CONTROLS[loading.control], state, 0.1)
    targets: list[float] = []
    if loading.pressure is not None:
        targets = _divided(0.0, loading.pressure, loading.points)
    elif loading.volume_change is not None:
        unit = -scene.plan.material.classical_pressure / scene.plan.material.h / scene.model.multiplicity
        now = -scene.newton.system.potential(state.u, "pressure")
        targets = _divided(now, loading.volume_change * unit, loading.points)
    quantity: Quantity = "load" if loading.pressure is not None else "conjugate"
    yield from followed(scene, path, start, _goal(loading, targets, quantity), branches=loading)


def _indentation(scene: Scene, loading: IndentationSection, state: State) -> Iterator[Record]:
    unit = scene.model.force_unit * scene.plan.material.h  # of -Pi_F = F w at F R/(2 pi D) = 1, w = h
    asked = next((value for value in (loading.force, loading.depth) if value is not None), 1.0)
    quantity: Quantity = "conjugate" if loading.force is None else "load"
    first = asked / loading.points if loading.control == "load" else float(np.copysign(1.0, asked))
    path, start = begin(scene, "force", CONTROLS[loading.control], state, first)
    if loading.control == "displacement":
        path.options = StepOptions(unit, 2 * unit, 1e-3 * unit)
    targets: list[float] = []
    if loading.until == "target":
        end = asked if quantity == "load" else unit * asked
        # the field may have moved the point past the first targets already
        now = 0.0 if quantity == "load" else -scene.newton.system.potential(state.u, "force")
        targets = [t for t in _divided(0.0, end, loading.points) if (t - now) * end > 0]
    yield from followed(scene, path, start, _goal(loading, targets, quantity, asked), branches=loading)


def _dead(scene: Scene, loading: DeadSection, state: State) -> Iterator[Record]:
    assert isinstance(scene.model, Observed)
    quantity: Quantity = "load" if loading.displacement is None else "conjugate"
    asked = next((value for value in (loading.factor, loading.displacement) if value is not None), 1.0)
    # a displacement is told as the work of the loads at it
    end = asked if quantity == "load" else asked / scene.plan.length * scene.model.load_size
    by_load = quantity == "load"
    first = asked / loading.points if by_load else float(np.copysign(1e-3, asked))
    path, start = begin(scene, "load", CONTROLS[loading.control], state, first)
    if loading.control == "displacement" and not by_load:
        step = abs(end) / loading.points
        path.options = StepOptions(step, 2 * step, 1e-4 * step)
    targets = _divided(0.0, end, loading.points) if loading.until == "target" else []
    yield from followed(scene, path, start, _goal(loading, targets, quantity, asked), branches=loading)


def _rotation(scene: Scene, loading: RotationSection, state: State) -> Iterator[Record]:
    magnetic = scene.case.magnetic
    assert magnetic is not None
    total = float(np.arccos(magnetic.applied.vector() @ loading.to.vector()))
    watch, system = scene.watch, scene.newton.system
    for angle in _divided(0.0, total, loading.points):
        end = {name: scene.case.lambda_m * f(angle) for name, f in (("lambda_m", np.cos), ("lambda_across", np.sin))}
        scene.newton.system = chord = Along(
            system, "turn", state.mu, {name: value - state.mu[name] for name, value in end.items()}
        )
        label: Label = "start"
        try:
            path, start = begin(scene, "turn", "arc", State(state.u, {**state.mu, "turn": 0.0}), 1.0)
            watch.begin(path, start, partial(_expanded, chord))
            for label, point in Walk(path, start, Goal("limit", [1.0])):
                for found in _excluded(path, watch.pass_to(point, look=label != "step")):
                    yield replace(found, amplitude="angle", point=_turned(chord, found.point))
                here = _turned(chord, point)
                state = here.state
                yield Record(label, "angle", here, excluded_pivots=watch.unstable)
        except PathStopped as e:
            raise Stopped(f"the turning field stopped before {np.degrees(angle):.4g} degrees: {e}") from None
        finally:
            scene.newton.system = system
        if label != "target":
            raise Stopped(f"the turning field makes the shell unstable before {np.degrees(angle):.4g} degrees: {label}")
        if watch.unstable:
            raise Stopped(f"an antisymmetric instability lies before {np.degrees(angle):.4g} degrees of the field")


def _expanded(chord: Along, state: State) -> State:
    """A state on the chord between two angles, with the amplitudes of the model."""
    return State(state.u, chord.expand(state.mu))


def _turned(chord: Along, point: Point) -> Point:
    return replace(point, state=_expanded(chord, point.state))


def _divided(start: float, end: float, points: int) -> list[float]:
    """`points` equidistant targets, the last of them `end`."""
    return [float(t) for t in np.linspace(start, end, points + 1)[1:]]


def begin(
    scene: Scene, name: str, control: Control, state: State, first: float, scale: float = 1.0
) -> tuple[Path, Point]:
    """A path from a state in equilibrium; its first step changes the amplitude by about `first`.

    `scale` is as that of `Path`.
    """
    path = Path(scene.newton, name, control, StepOptions(1.0, 1.0, 1.0), abs(scale), scene.journal, scene.progress)
    start = path.start(state, first)
    step = abs(first / start.dmu)
    path.options = StepOptions(step, (LONGEST if control == "arc" else 2) * step, 1e-5 * step)
    return path, start


def _goal(loading: PathSection, targets: Sequence[float], quantity: Quantity, sense: float = 1.0) -> Goal:
    steps = loading.points if loading.until == "points" else MOST_STEPS
    return Goal(loading.until, targets, quantity, steps, sense)


def followed(
    scene: Scene, path: Path, start: Point, goal: Goal, branches: PathSection | None = None
) -> Iterator[Record]:
    """A walk, what the reduced model excludes on it, and the branches if they are asked for."""
    scene.progress.doing("looking for modes that the model excludes")
    walk, crossing, lost, watch = Walk(path, start, goal), None, "", scene.watch
    watch.begin(path, start)
    try:
        for label, point in walk:
            mode, located = "", label in ("fold", "bifurcation")
            yield from _excluded(path, watch.pass_to(point, look=located))
            if label == "bifurcation":
                here = branching(_by_arc(scene, path), point)
                crossing = crossing or here
                mode = ("symmetric" if here.symmetric else "asymmetric") if here else ""
            yield Record(label, path.name, point, mode, excluded_pivots=watch.unstable)
    except PathStopped as e:
        lost = _why(path, e, walk.points)
    yield from _excluded(path, watch.end())
    if lost and path.control == "load":
        for found in _fold_ahead(scene, path, walk.points):
            yield found
            if found.label == "fold":
                at = f"{path.name} = {found.point.state.mu[path.name]:.9g}"
                lost = f"load control cannot pass the fold at {at}; {lost}"
    if watch.unlocated:
        why = f"a mode that the reduced model excludes is unstable, but where is not known: {watch.unlocated}"
        lost = f"{lost}; {why}" if lost else why
    if lost:
        raise Stopped(lost)
    if branches and branches.branches and crossing:
        yield from _branches(scene, path, crossing, goal, branches.points)


def _branches(scene: Scene, path: Path, crossing: Branching, goal: Goal, steps: int) -> Iterator[Record]:
    """Both directions of a branch, to the same target as the path or for a number of steps."""
    lost, watch = [], scene.watch
    if goal.until != "target":
        goal = Goal("points", steps=steps)
    for number, start in enumerate(crossing.starts, 1):
        by_arc = _by_arc(scene, path)
        walk = Walk(by_arc, start, goal)
        watch.begin(by_arc, start, look=True)
        yield Record("step", path.name, start, branch=number, excluded_pivots=watch.unstable)
        try:
            for label, point in walk:
                for found in _excluded(by_arc, watch.pass_to(point, look=label in ("fold", "bifurcation"))):
                    yield replace(found, branch=number)
                yield Record(label, path.name, point, branch=number, excluded_pivots=watch.unstable)
        except PathStopped as e:
            lost.append(f"branch {number}: {_why(by_arc, e, walk.points)}")
        for found in _excluded(by_arc, watch.end()):
            yield replace(found, branch=number)
    if lost:
        raise Stopped("; ".join(lost))


def _by_arc(scene: Scene, path: Path) -> Path:
    """The same path by arc length, in steps as long as the one off it at a bifurcation."""
    scale = path.metric.scale
    options = StepOptions(0.1, LONGEST * 0.1, 1e-6)
    return Path(scene.newton, path.name, "arc", options, scale, scene.journal, scene.progress)


def _fold_ahead(scene: Scene, path: Path, points: list[Point]) -> list[Record]:
    """The fold that ended a path under load control, by arc length from its last point, and what comes before it."""
    onward = points[-1].s - points[-2].s if len(points) > 1 else 1.0
    by_arc, start = begin(scene, path.name, "arc", points[-1].state, onward, path.metric.scale)
    scene.watch.begin(by_arc, start)
    found: list[Record] = []
    try:
        for label, point in Walk(by_arc, start, Goal("limit", steps=20)):
            found += _excluded(by_arc, scene.watch.pass_to(point, look=label == "fold"))
    except PathStopped:
        return []
    return [*found, Record(label, path.name, point, excluded_pivots=scene.watch.unstable)] if label == "fold" else []


def _excluded(path: Path, crossings: Iterable[Crossing]) -> Iterator[Record]:
    """Where modes that a reduced model does not see become unstable or stable."""
    for found in crossings:
        yield Record("bifurcation", path.name, found.point, found.label, excluded_pivots=found.unstable)


def _why(path: Path, stop: PathStopped, points: list[Point]) -> str:
    """What the user reads when a path is lost, with the fold in the control named if it is one."""
    here = stop.point
    said = f"the last point has {path.name} = {here.state.mu[path.name]:.6g}: {stop}"
    if path.control == "load":
        return f"load control stopped; {said}. Past a limit point only control: arc or by displacement can follow"
    before = points[-2] if len(points) > 1 else here
    if path.control == "arc" or before.dmu == here.dmu:
        return f"the controlled path stopped; {said}"
    # near a fold in the controlled s, (ds/dmu)^2 falls linearly to zero with s
    a, b = before.dmu**-2, here.dmu**-2
    ahead = b * (here.s - before.s) / (a - b) if a > b else np.inf
    if 0 < ahead / (here.s - before.s) < 10:
        return (
            f"the path turns back in the controlled displacement, {ahead / here.s:.2%} beyond the last point: "
            f"a fold that displacement control cannot pass, but control: arc can; {said}"
        )
    return f"the controlled path stopped; {said}"

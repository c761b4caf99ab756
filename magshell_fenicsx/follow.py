"""The history of a case: the field first, then the load; every accepted point, and what stopped it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from magshell_fenicsx.case.loading import FieldSection, IndentationSection, PressureSection, RotationSection
from magshell_fenicsx.scene import Scene
from magshell_fenicsx.shell.antisymmetric import AntisymmetricModes
from magshell_fenicsx.solve.along import Along
from magshell_fenicsx.solve.events import locate
from magshell_fenicsx.solve.path import Path, PathStopped, Point, StepOptions
from magshell_fenicsx.solve.system import State, max_abs

Label = Literal["start", "field", "step", "target", "fold", "bifurcation"]
MOST_POINTS = 1000


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
        half shell, or "m = 7" waves around an axisymmetric one. Such a record comes last, at its
        place on the path.
    """

    label: Label
    amplitude: str
    point: Point
    mode: str = ""


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
    factors = scene.newton.factor_at(state)
    yield Record("start", "", Point(state, 0.0, 0.0 * state.u, 0.0, factors.negative_pivots, 0, 1))
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
    elif isinstance(loading, RotationSection):
        yield from _rotation(scene, loading, state)


def _field(scene: Scene, state: State) -> Iterator[Record]:
    """The field, up to lambda_m; where it makes the shell unstable, the critical field is located."""
    target = scene.case.lambda_m
    path = Path(scene.newton, "lambda_m", "load", StepOptions(abs(target) / 2, abs(target), abs(target) * 1e-4))
    points, trouble = [path.start(state)], False
    try:
        for point, _ in path.towards(points[0], [target]):
            if trouble := point.negative_pivots > 0:
                break
            points.append(point)
            yield Record("field", "lambda_m", point)
    except PathStopped:
        trouble = True
    instability = None
    search = _to_critical_field(scene, points[-1].state) if trouble else _excluded(scene, path, points)
    for instability in search:
        yield instability
    if instability is not None:
        raise Stopped(
            f"the field alone makes the shell unstable: critical field lambda_m = "
            f"{instability.point.state.mu['lambda_m']:.9g} of {target:g} ({instability.mode or instability.label})"
        )


def _to_critical_field(scene: Scene, state: State) -> Iterator[Record]:
    """From a stable state under part of the field to the first instability in lambda_m."""
    target, system = scene.case.lambda_m, scene.newton.system
    part = 0.1 * abs(target)
    path = Path(scene.newton, "lambda_m", "load", StepOptions(part, part, 1e-5 * part))
    if max_abs(system.comm, system.load(state.u, "lambda_m")) > 0:  # else the field does no work to control by
        path = Path(scene.newton, "lambda_m", "conjugate", path.options)
        first = part / abs(path.start(state).dmu)
        path.options = StepOptions(first, 2 * first, 1e-5 * first)
    yield from _until_limit(scene, path, path.start(state), float(np.copysign(np.inf, target)))


def _field_as_load(scene: Scene, loading: FieldSection, state: State) -> Iterator[Record]:
    target = scene.case.lambda_m
    part = abs(target) / loading.points
    path = Path(scene.newton, "lambda_m", "load", StepOptions(part, part, 1e-5 * part))
    if loading.until == "target":
        yield from _through(scene, path, path.start(state), _divided(0.0, target, loading.points))
    elif loading.control == "load":
        yield from _until_limit(scene, path, path.start(state), float(np.copysign(np.inf, target)))
    else:
        yield from _to_critical_field(scene, state)


def _pressure(scene: Scene, loading: PressureSection, state: State) -> Iterator[Record]:
    material = scene.plan.material
    if loading.control == "load":
        path = Path(scene.newton, "pressure", "load", StepOptions(0.1, 0.2, 1e-6))
        start, end = path.start(state), loading.pressure
    else:
        path = Path(scene.newton, "pressure", "conjugate", StepOptions(1.0, 1.0, 1.0))
        start, end = path.start(state), loading.volume_change
        first = abs(0.1 / start.dmu)  # as long as a tenth of p_c is at the start
        path.options = StepOptions(first, 2 * first, 1e-5 * first)
        if end is not None:
            end *= -material.classical_pressure / material.h / scene.model.multiplicity
    if end is None:
        yield from _until_limit(scene, path, start)
    else:
        yield from _through(scene, path, start, _divided(start.s, end, loading.points))


def _indentation(scene: Scene, loading: IndentationSection, state: State) -> Iterator[Record]:
    h, model = scene.plan.material.h, scene.model
    if loading.control == "load":
        assert loading.force is not None
        size = abs(loading.force) / loading.points
        path = Path(scene.newton, "force", "load", StepOptions(size, size, 1e-5 * size))
        targets = _divided(0.0, loading.force, loading.points)
    else:
        assert loading.depth is not None
        unit = model.force_unit * h  # of -Pi_F = F w at F R/(2 pi D) = 1, w = h
        path = Path(scene.newton, "force", "conjugate", StepOptions(unit, 2 * unit, 1e-3 * unit))
        targets = _divided(0.0, unit * loading.depth, loading.points)
    start = path.start(state)
    # the field may have moved the point past the first targets already
    forward = [t for t in targets if (t - start.s) * targets[-1] > 0]
    yield from _through(scene, path, start, forward)


def _rotation(scene: Scene, loading: RotationSection, state: State) -> Iterator[Record]:
    magnetic = scene.case.magnetic
    assert magnetic is not None
    total = float(np.arccos(magnetic.applied.vector() @ loading.to.vector()))
    modes, system = scene.model.excluded_modes, scene.newton.system
    for angle in _divided(0.0, total, loading.points):
        end = {name: scene.case.lambda_m * f(angle) for name, f in (("lambda_m", np.cos), ("lambda_across", np.sin))}
        scene.newton.system = chord = Along(
            system, "turn", state.mu, {name: value - state.mu[name] for name, value in end.items()}
        )
        path = Path(scene.newton, "turn", "load", StepOptions(1.0, 1.0, 1e-4))
        here = path.start(State(state.u, {**state.mu, "turn": 0.0}))
        try:
            for point, reached in path.towards(here, [1.0]):
                state = State(point.state.u, chord.expand(point.state.mu))
                yield Record("target" if reached else "step", "angle", replace(point, state=state))
        except PathStopped as e:
            raise Stopped(f"the turning field stopped before {np.degrees(angle):.4g} degrees: {e}") from None
        finally:
            scene.newton.system = system
        if isinstance(modes, AntisymmetricModes) and modes.factor_at(state).negative_pivots:
            raise Stopped(f"an antisymmetric instability lies before {np.degrees(angle):.4g} degrees of the field")


def _divided(start: float, end: float, points: int) -> list[float]:
    """`points` equidistant targets, the last of them `end`."""
    return [float(t) for t in np.linspace(start, end, points + 1)[1:]]


def _until_limit(scene: Scene, path: Path, start: Point, end: float = np.inf) -> Iterator[Record]:
    """Accepted points in the direction of `end` up to the first instability."""
    points, options = [start], path.options
    try:
        while True:
            for point, _ in path.towards(points[-1], [end]):
                if point.negative_pivots > start.negative_pivots:
                    break
                if len(points) > MOST_POINTS:
                    raise Stopped(f"no instability found in {MOST_POINTS} steps; {_where(path, point)}")
                points.append(point)
                yield Record("step", path.name, point)
            try:
                found = locate(path, points[-1], point)
                break
            except PathStopped:  # the step had left the branch: come nearer in shorter ones
                path.options = replace(path.options, first=abs(point.s - points[-1].s) / 4)
                if path.options.first < options.smallest:
                    raise
    except PathStopped as e:
        raise Stopped(_why(path, e, None)) from None
    yield Record(found.kind, path.name, found.point)
    yield from _excluded(scene, path, [*points, found.point])


def _through(scene: Scene, path: Path, start: Point, targets: list[float]) -> Iterator[Record]:
    """Accepted points through all targets, with the first instability on the way located."""
    before, here, points = None, start, [start]
    try:
        for point, reached in path.towards(start, targets):
            if here.negative_pivots == 0 < point.negative_pivots and path.control == "conjugate":
                found = locate(path, here, point)
                yield Record(found.kind, path.name, found.point)
            before, here = here, point
            points.append(point)
            yield Record("target" if reached else "step", path.name, point)
        yield from _excluded(scene, path, points)
    except PathStopped as e:
        raise Stopped(_why(path, e, before)) from None


def _excluded(scene: Scene, path: Path, points: list[Point]) -> Iterator[Record]:
    """The first instability among the modes that a reduced model does not see, if there is one."""
    modes = scene.model.excluded_modes
    try:
        found = modes.first_instability(path, points) if modes else None
    except PathStopped as e:
        raise Stopped(f"a mode that the reduced model excludes is unstable, but where is not known: {e}") from None
    if found:
        mode, point = found
        yield Record("bifurcation", path.name, point, mode)


def _where(path: Path, point: Point) -> str:
    return f"the last point has {path.name} = {point.state.mu[path.name]:.6g}"


def _why(path: Path, stop: PathStopped, before: Point | None) -> str:
    """What the user reads when a path is lost, with the fold in the control named if it is one."""
    here = stop.point
    said = f"{_where(path, here)}: {stop}"
    if path.control == "load":
        return f"load control stopped; {said}. Past a limit point only displacement or volume control can follow"
    if before is None or before.dmu == here.dmu:
        return f"the controlled path stopped; {said}"
    # near a fold in the controlled s, (ds/dmu)^2 falls linearly to zero with s
    a, b = before.dmu**-2, here.dmu**-2
    ahead = b * (here.s - before.s) / (a - b) if a > b else np.inf
    if 0 < ahead / (here.s - before.s) < 10:
        return (
            f"the path turns back in the controlled displacement, {ahead / here.s:.2%} beyond the last point: "
            f"a fold that displacement control cannot pass; {said}"
        )
    return f"the controlled path stopped; {said}"

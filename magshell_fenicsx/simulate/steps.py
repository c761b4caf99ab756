"""The steps of a history, one for each kind of load."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

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
from magshell_fenicsx.continuation.path import Control, Quantity, StepOptions
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.continuation.walk import MOST_STEPS, Goal
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage, plain
from magshell_fenicsx.simulate.walked import followed

CONTROLS: dict[str, Control] = {"volume": "conjugate", "displacement": "conjugate", "load": "load", "arc": "arc"}


def field(scene: Scene, state: State) -> Iterator[Record]:
    """Increase the field to lambda_m; stop at the critical field if the shell becomes unstable."""
    target, instability = scene.case.lambda_m, None
    path, start = plain(scene).begin("lambda_m", "arc", state, target / 2, target)
    for record in followed(plain(scene), path, start, Goal("limit", [target])):
        located = record.label in ("fold", "bifurcation")
        instability = instability or (record if located else None)
        yield record if located else replace(record, label="field")
    if instability is not None:
        raise Stopped(
            f"the field alone makes the shell unstable: critical field lambda_m = "
            f"{instability.point.state.mu['lambda_m']:.9g} of {target:g} ({instability.mode or instability.label})"
        )


def field_as_load(scene: Scene, loading: FieldSection, state: State) -> Iterator[Record]:
    target = scene.case.lambda_m
    path, start = plain(scene).begin("lambda_m", CONTROLS[loading.control], state, target / loading.points, target)
    targets = _divided(0.0, target, loading.points) if loading.until == "target" else []
    yield from followed(plain(scene), path, start, _goal(loading, targets, "load", target), branches=loading)


def pressure(scene: Scene, loading: PressureSection, state: State) -> Iterator[Record]:
    chosen = "control" in loading.model_fields_set or not scene.model.without_potential
    path, start = plain(scene).begin("pressure", CONTROLS[loading.control] if chosen else "arc", state, 0.1)
    targets: list[float] = []
    if loading.pressure is not None:
        targets = _divided(0.0, loading.pressure, loading.points)
    elif loading.volume_change is not None:
        unit = -scene.plan.material.classical_pressure / scene.plan.material.h / scene.model.multiplicity
        now = -scene.newton.system.potential(state.u, state.mu, "pressure")
        targets = _divided(now, loading.volume_change * unit, loading.points)
    quantity: Quantity = "load" if loading.pressure is not None else "conjugate"
    yield from followed(plain(scene), path, start, _goal(loading, targets, quantity), branches=loading)


def indentation(scene: Scene, loading: IndentationSection, state: State) -> Iterator[Record]:
    unit = scene.model.force_unit * scene.plan.material.h  # of -Pi_F = F w at F R/(2 pi D) = 1, w = h
    asked = next((value for value in (loading.force, loading.depth) if value is not None), 1.0)
    quantity: Quantity = "conjugate" if loading.force is None else "load"
    first = asked / loading.points if loading.control == "load" else float(np.copysign(1.0, asked))
    path, start = plain(scene).begin("force", CONTROLS[loading.control], state, first)
    if loading.control == "displacement":
        path = path.in_steps(StepOptions(unit, 2 * unit, 1e-3 * unit))
    targets: list[float] = []
    if loading.until == "target":
        end = asked if quantity == "load" else unit * asked
        # the field may have moved the point past the first targets already
        now = 0.0 if quantity == "load" else -scene.newton.system.potential(state.u, state.mu, "force")
        targets = [t for t in _divided(0.0, end, loading.points) if (t - now) * end > 0]
    yield from followed(plain(scene), path, start, _goal(loading, targets, quantity, asked), branches=loading)


def dead(scene: Scene, loading: DeadSection, state: State) -> Iterator[Record]:
    quantity: Quantity = "load" if loading.displacement is None else "conjugate"
    asked = next((value for value in (loading.factor, loading.displacement) if value is not None), 1.0)
    # a displacement is prescribed through the work of the loads
    end = asked if quantity == "load" else asked / scene.plan.length * scene.model.load_size
    by_load = quantity == "load"
    first = asked / loading.points if by_load else float(np.copysign(1e-3, asked))
    path, start = plain(scene).begin("load", CONTROLS[loading.control], state, first)
    if loading.control == "displacement" and not by_load:
        step = abs(end) / loading.points
        path = path.in_steps(StepOptions(step, 2 * step, 1e-4 * step))
    targets = _divided(0.0, end, loading.points) if loading.until == "target" else []
    yield from followed(plain(scene), path, start, _goal(loading, targets, quantity, asked), branches=loading)


def rotation(scene: Scene, loading: RotationSection, state: State) -> Iterator[Record]:
    magnetic = scene.case.magnetic
    assert magnetic is not None
    total = float(np.arccos(magnetic.applied.vector() @ loading.to.vector()))
    step, circle = total / loading.points, _circle(scene)
    stage = Stage(scene, scene.newton.on(circle), along=circle)
    others = {name: mu for name, mu in state.mu.items() if not name.startswith("lambda")}
    path, start = stage.begin("angle", "arc", State(state.u, {"angle": 0.0, **others}), step, step)
    for record in followed(stage, path, start, Goal("limit", _divided(0.0, total, loading.points))):
        yield record
        if record.label in ("fold", "bifurcation"):
            mu, kind = record.point.state.mu, record.mode or record.label
            angle = np.degrees(np.arctan2(mu["lambda_across"], mu["lambda_m"]) % (2 * np.pi))
            raise Stopped(f"the turning field makes the shell unstable at {angle:.4g} degrees: {kind}")


def _circle(scene: Scene) -> Along:
    """The amplitudes of the applied field as functions of its angle, at constant magnitude."""
    lambda_m, system = scene.case.lambda_m, scene.model.system
    return Along(
        system,
        "angle",
        {
            "lambda_m": lambda t: (lambda_m * np.cos(t), -lambda_m * np.sin(t), -lambda_m * np.cos(t)),
            "lambda_across": lambda t: (lambda_m * np.sin(t), lambda_m * np.cos(t), -lambda_m * np.sin(t)),
        },
    )


def _divided(start: float, end: float, points: int) -> list[float]:
    """`points` equidistant targets, the last of them `end`."""
    return [float(t) for t in np.linspace(start, end, points + 1)[1:]]


def _goal(loading: PathSection, targets: Sequence[float], quantity: Quantity, sense: float = 1.0) -> Goal:
    steps = loading.points if loading.until == "points" else MOST_STEPS
    return Goal(loading.until, targets, quantity, steps, sense)

"""A step in time: the records of a motion, with its energies, from any state, to its end or to rest."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.history import Curve, Level, Time, curve, marks
from magshell_fenicsx.case.loads.time import PushSection, TimeSection
from magshell_fenicsx.continuation.control import GivenLoad
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import State, Vector, dot, max_abs
from magshell_fenicsx.continuation.transient import Integrator, Motion, TimeSteps, TimeStopped, advance
from magshell_fenicsx.models.mass import mass
from magshell_fenicsx.models.modes import ShellModes
from magshell_fenicsx.models.shell.model import ShellModel
from magshell_fenicsx.models.shell.viscous import Branch, Viscosity
from magshell_fenicsx.parts.section import in_units
from magshell_fenicsx.simulate.record import Label, Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.walked import Records

AWAY = 0.05  # displacement from a fold, in lengths
DAMPED = 0.1  # part of the critical drag of a mode
LONGEST, MOST = 2000.0, 500  # of a snap, in radians of that mode, and its rows
QUIET = 1e-6  # kinetic energy over its largest value below which a shell may be at rest
SMALL = 1e-6  # deflection of a mode of size one that does not give its sign
NEAR = 1e-2  # distance to the equilibrium, in lengths, below which it is


@dataclass(frozen=True)
class Moving(State):
    """A state with a velocity."""

    v: Vector


def own_time(value: Time) -> float:
    """A time in the case's own unit."""
    return float(in_units("second")(value))


def time_of(case: Case, value: Time) -> float:
    """A time over R sqrt(rho/E)."""
    return own_time(value) / (case.time_unit or 1.0)


def level_of(case: Case, name: str, value: Level) -> float:
    """A value of a history as an amplitude."""
    if name != "lambda_m":
        return float(value)
    applied = case.magnetic.applied.flux_density if case.magnetic else None
    return case.lambda_m * (float(in_units("tesla")(value)) / (applied or 1.0) if isinstance(value, str) else value)


def _scaled(of: Curve, size: float, unit: float) -> Curve:
    return lambda t, before: size * of(t * unit, before)


class LoadsInTime:
    """The amplitudes of a step as functions of its time."""

    def __init__(self, case: Case, load: TimeSection, state: State) -> None:
        self._mu, time = dict(state.mu), partial(time_of, case)
        histories = dict(zip(load.drives, load.history.values(), strict=True))
        unit = case.time_unit or 1.0
        self._curves, self.marks = dict[str, Curve](), set[float]()
        for name, history in histories.items():
            # histories are in the case's own unit of time
            of = curve(history, own_time, partial(level_of, case, name), state.mu[name])
            size = case.lambda_m if isinstance(history, str) and name == "lambda_m" else 1.0
            self._curves[name] = _scaled(of, size, unit)
            self.marks |= set(marks(history, time, time(load.duration)))

    def __call__(self, t: float, before: bool) -> dict[str, float]:
        return self._mu | {name: of(t, before) for name, of in self._curves.items()}


def motion(scene: Scene, load: TimeSection, state: State) -> Records:
    """The records of a step in time; its return value is the state at its end.

    Raises
    ------
    Stopped
        If steps in time become too small, or the shell does not come to rest.
    """
    case, system = scene.case, scene.model.system
    loads = LoadsInTime(case, load, state)
    drag = float(in_units("1/second")(load.drag)) * (case.time_unit or 1.0)
    integrator = Integrator(system, mass(scene.model), loads, load.rho_inf, drag, viscosity(scene, state), load.drives)
    u, v = state.u, state.v if isinstance(state, Moving) else 0.0 * state.u
    if load.push:
        u, v = _pushed(scene, load.push, state, v)
    now, duration = integrator.begin(0.0, u, v), time_of(case, load.duration)
    fixed = None if load.step is None else time_of(case, load.step)
    steps = TimeSteps(fixed, load.tolerance, fixed or duration / load.points / 10)
    dt, most = steps.first, integrator.kinetic(now)
    outputs = [duration * i / load.points for i in range(1, load.points + 1)]
    for end in outputs:
        ends = [*sorted(t for t in loads.marks if now.t < t < end), end]
        now, dt, point = _journalled(scene, integrator, now, dt, ends, steps, loads.marks)
        kinetic = integrator.kinetic(now)
        most = max(most, kinetic)
        clock = {
            "time": now.t * (case.time_unit or 1.0),
            "kinetic": scene.model.multiplicity * kinetic,
            "dissipated": scene.model.multiplicity * now.dissipated,
            "work": scene.model.multiplicity * now.work,
        }
        excluded = scene.model.excluded_modes
        unseen = sum(excluded.counts(point.state)) if excluded else 0
        rest = load.until == "rest" and kinetic <= QUIET * most and _rest(scene, point.state)
        label: Label = "target" if end == outputs[-1] and load.until == "duration" else "step"
        yield Record(label, "time", point, excluded_pivots=unseen, clock=clock)
        if rest:
            still = {**clock, "kinetic": 0.0}
            yield Record("target", "time", replace(point, state=rest), excluded_pivots=unseen, clock=still)
            return rest
    if load.until == "rest":
        raise Stopped(
            f"the shell still moves at the end of its duration, kinetic energy {kinetic / most:.2g} of its largest"
        )
    return Moving(point.state.u, point.state.mu, now.v)


def viscosity(scene: Scene, state: State) -> Viscosity | None:
    """Of the shell at rest in a state; None without."""
    case, shell = scene.case, scene.case.shell
    if shell.viscosity is None and not shell.relaxation:
        return None
    assert isinstance(scene.model, ShellModel)
    found = []
    for branch in shell.relaxation:
        size = float(in_units("pascal")(branch.modulus))
        ratio = size / (shell.youngs_modulus or 1.0) if isinstance(branch.modulus, str) else size
        found.append(Branch(ratio, time_of(case, branch.time)))
    return Viscosity(scene.model, state.mu, time_of(case, shell.viscosity or 0.0), found)


def released(scene: Scene, fold: Record) -> Records:
    """The records of a snap from a fold to rest, all loads being constant; its return value is the state at its end.

    The shell leaves the fold along the path's direction there, and is damped as its second mode of vibration, in part
    of the critical drag: the first one has no frequency at a fold.

    Raises
    ------
    Stopped
        If the point is no fold of the model itself, or the shell does not come to rest.
    """
    if fold.label != "fold" or fold.mode:
        raise Stopped(f"then: snap: the step ends at a {fold.mode or fold.label}, not at a fold of the model itself")
    state, system, unit = fold.point.state, scene.model.system, scene.case.time_unit or 1.0
    own = [mode.eigenvalue for mode in ShellModes(scene.model).lowest(state, 3) if not mode.label]
    omega = float(np.sqrt(max(own[1:])))
    load = TimeSection(
        kind="time",
        duration=LONGEST * unit / omega,
        points=MOST,
        drag=2 * DAMPED * omega / unit,
        until="rest",
    )
    away = scene.model.system.held(fold.point.du)
    size = AWAY * system.length / max_abs(system.comm, away)
    return (yield from motion(scene, load, State(state.u + size * away, state.mu)))


def _journalled(
    scene: Scene, integrator: Integrator, now: Motion, dt: float, ends: list[float], steps: TimeSteps, jumps: set[float]
) -> tuple[Motion, float, Point]:
    """The motion at the last of some times, from the journal if it is there, as two of its points."""
    memory = integrator.viscous is not None  # of a branch's strains, which the journal has no place for: computed again
    first, second = (None if memory else scene.journal.replay()), None
    if isinstance(first, Point):
        second = scene.journal.replay()
    if isinstance(first, Point) and isinstance(second, Point):
        mu, potentials = dict(first.state.mu), dict(second.state.mu)
        u, v, a = first.state.u, first.du, second.state.u
        return Motion(first.s, u, v, a, mu, second.s, second.dmu, potentials, second.error), first.dmu, first
    before = integrator.steps, integrator.iterations, integrator.factorisation.count
    scene.progress.trying(Point(State(now.u, now.mu), now.t, now.v, 0.0, 0, 0), ends[-1] - now.t)
    try:
        for end in ends:
            now, dt = advance(integrator, now, end, steps, dt)
            if end in jumps:  # a jump: the acceleration after it
                now = integrator.begin(end, now.u, now.v, now)
    except TimeStopped as e:
        raise Stopped(str(e)) from None
    spent = integrator.iterations - before[1], integrator.factorisation.count - before[2]
    state = scene.model.system.placed(State(now.u, now.mu))
    pivots = scene.newton.factor_at(state).negative_pivots
    point = Point(state, now.t, now.v, dt, pivots, pivots, *spent)
    rest = Point(State(now.a, now.potentials), now.work, 0.0 * now.a, now.dissipated, 0, 0, error=now.error)
    for part in () if memory else (rest,) if isinstance(first, Point) else (point, rest):
        scene.journal.record(part)
    return now, dt, point


def _pushed(scene: Scene, push: PushSection, state: State, v: Vector) -> tuple[Vector, Vector]:
    """Displacement and velocity with a natural mode of the model itself, inward at the pole."""
    comm = scene.model.system.comm
    found = ShellModes(scene.model)
    own = [mode for mode in found.vibrations(state, push.mode) if not mode.label]
    if len(own) < push.mode:  # modes of other symmetries were lower
        own = [mode for mode in found.lowest(state, push.mode) if not mode.label]
    mode = own[push.mode - 1].vector
    phi = np.asarray(mode / max_abs(comm, mode))
    inward = scene.model.deflection(phi, "pole")
    if abs(inward) < SMALL:
        inward = dot(comm, phi, phi**2)
    h = np.copysign(scene.plan.material.h, inward)
    return state.u + push.displacement * h * phi, v + push.velocity * (scene.case.time_unit or 1.0) * h * phi


def _rest(scene: Scene, state: State) -> State | None:
    """The equilibrium near a state; None if there is none near, or an unstable one."""
    name = next(iter(state.mu))
    outcome = scene.newton.solve(state, name, GivenLoad(name, state.mu[name]))
    moved = max_abs(scene.model.system.comm, outcome.state.u - state.u) / scene.model.system.length
    if not outcome.converged or moved > NEAR or scene.newton.factor_at(outcome.state).negative_pivots:
        return None
    return outcome.state

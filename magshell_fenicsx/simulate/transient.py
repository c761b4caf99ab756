"""A step in time: the records of a motion, with its energies, from any state, to its end or to rest."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from magshell_fenicsx.case.loads.time import PushSection, TimeSection
from magshell_fenicsx.continuation.advance import TimeSteps, TimeStopped, advance
from magshell_fenicsx.continuation.control import GivenLoad
from magshell_fenicsx.continuation.device import Held
from magshell_fenicsx.continuation.motion import Motion
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import State, Vector, dot, max_abs
from magshell_fenicsx.continuation.transient import Integrator
from magshell_fenicsx.models.mass import mass
from magshell_fenicsx.models.modes import ShellModes
from magshell_fenicsx.models.shell.model import ShellModel
from magshell_fenicsx.models.shell.viscous import Branch, Viscosity
from magshell_fenicsx.parts.section import in_units
from magshell_fenicsx.simulate.histories import LoadsInTime, time_of
from magshell_fenicsx.simulate.record import Label, Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import staged
from magshell_fenicsx.simulate.walked import Records

AWAY = 0.05  # displacement from a fold, in lengths
DAMPED = 0.1  # part of the critical drag of a mode
LONGEST, MOST = 2000.0, 500  # of a snap, in radians of that mode, and its rows
QUIET = 1e-6  # kinetic energy over its largest value below which a shell may be at rest
SMALL = 1e-6  # deflection of a mode of size one that does not give its sign
IDLE = ""  # an amplitude of no load
NEAR = 1e-2  # distance to the equilibrium, in lengths, below which it is


@dataclass(frozen=True)
class Moving(State):
    """A state with a velocity."""

    v: Vector


def motion(scene: Scene, load: TimeSection, state: State, held: Mapping[str, Held]) -> Records:
    """The records of a step in time; its return value is the state at its end.

    Parameters
    ----------
    held
        Amplitude -> its conjugate, as of `staged`.

    Raises
    ------
    Stopped
        If steps in time become too small, or the shell does not come to rest.
    """
    case, system = scene.case, scene.model.system
    loads = LoadsInTime(case, load, state)
    drag = float(in_units("1/second")(load.drag)) * (case.time_unit or 1.0)
    viscous, device = viscosity(scene, state), staged(scene, state, held).device
    integrator = Integrator(system, mass(scene.model), loads, load.rho_inf, drag, viscous, load.drives, device)
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
        now, dt, point = _journalled(scene, integrator, held, now, dt, ends, steps, loads.marks)
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
        rest = load.until == "rest" and kinetic <= QUIET * most and _rest(scene, held, point.state)
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


def released(scene: Scene, fold: Record, held: Mapping[str, Held]) -> Records:
    """The records of a snap from a fold to rest; its return value is the state at its end.

    Loads are constant, except those whose conjugates are `held`.

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
    return (yield from motion(scene, load, State(state.u + size * away, state.mu), held))


def _journalled(
    scene: Scene,
    integrator: Integrator,
    held: Mapping[str, Held],
    now: Motion,
    dt: float,
    ends: list[float],
    steps: TimeSteps,
    jumps: set[float],
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
    stage = staged(scene, state, held)
    pivots = stage.newton.factor_at(stage.enter(state)).negative_pivots
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


def _rest(scene: Scene, held: Mapping[str, Held], state: State) -> State | None:
    """The equilibrium near a state; None if there is none near, or an unstable one."""
    stage = staged(scene, state, held)
    start = stage.enter(state)
    start = start.with_(start.u, IDLE, 0.0)
    outcome = stage.newton.solve(start, IDLE, GivenLoad(IDLE, 0.0))
    moved = max_abs(scene.model.system.comm, outcome.state.u - start.u) / scene.model.system.length
    if not outcome.converged or moved > NEAR or stage.newton.factor_at(outcome.state).negative_pivots:
        return None
    found = stage.leave(outcome.state)
    return State(found.u, state.mu | {name: found.mu[name] for name in held})

"""A step in time: the records of a motion, with its energies, from any state, to its end or to
rest.

It begins along a mode of vibration or with a velocity by formulas; its loads are functions of time
in the scales of the model.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.assembly.prescribed_motion import vectors_in_space
from magshell_fenicsx.continuation.advance import TimeSteps
from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.device import HeldConjugate
from magshell_fenicsx.continuation.motion import Motion
from magshell_fenicsx.continuation.system import Amplitudes, State, Vector, dot, max_abs
from magshell_fenicsx.continuation.transient import Integrator, Surroundings
from magshell_fenicsx.input.section import in_units
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.parts.bodies.body_contact import Pressing
from magshell_fenicsx.parts.contact.time_averaging import TimeAveragedContact, samples_of_step
from magshell_fenicsx.parts.motion.history import Curve, Level, Time, curve, marks, times_of
from magshell_fenicsx.parts.motion.motion_step import (
    EventSection,
    PushSection,
    TimeSection,
    level_in,
)
from magshell_fenicsx.parts.step_control import SnapSection
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.shape.meridian_chart import vector_function
from magshell_fenicsx.shells.mass import SupportInertia, mass, mass_with_supports
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.shells.viscous import Branch, Viscosity
from magshell_fenicsx.simulate.contact_control import raised_stiffnesses, stiff_for
from magshell_fenicsx.simulate.motion_rows import MotionRows, StepRefinement
from magshell_fenicsx.simulate.path_records import Records
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import make_stage

Array = NDArray[np.float64]
SMALL = 1e-6  # deflection of a mode of size one that does not give its sign
CLOSE = 1e-5  # of the shortest time of a history: a difference by time
SAME = 1e-9
LONGEST, MOST = 2000.0, 500  # of a snap, in radians of that mode, and its rows
QUIET = 1e-6  # kinetic energy over its largest value below which a shell may be at rest
IDLE = ""  # an amplitude of no load
NEAR = 1e-2  # distance to the equilibrium, in lengths, below which it is


def pushed_along_mode(
    scene: Scene, push: PushSection, state: State, v: Vector
) -> tuple[Vector, Vector]:
    """Displacement and velocity with a natural mode of the model itself, inward at the pole."""
    comm = scene.model.system.comm
    modes = ShellModes(scene.model)
    own = [mode for mode in modes.vibrations(state, push.mode) if not mode.label]
    if len(own) < push.mode:  # modes of other symmetries were lower
        own = [mode for mode in modes.lowest(state, push.mode) if not mode.label]
    mode = own[push.mode - 1].vector
    phi = np.asarray(mode / max_abs(comm, mode))
    inward = scene.model.deflection(phi, "pole")
    if abs(inward) < SMALL:
        inward = dot(comm, phi, phi**2)
    h = np.copysign(scene.problem.material.h, inward)
    return state.u + push.displacement * h * phi, v + push.velocity * (
        scene.problem.time_unit or 1.0
    ) * h * phi


def velocity_by_formula(scene: Scene, components: Sequence[str]) -> Vector:
    """The velocity with these components, formulas of the undeformed place, at the nodes; zero at
    supports.
    """
    model, R, Q = scene.model, scene.problem.length, rotation(scene.problem.azimuth)
    axes = model.axes
    places = vectors_in_space(model.r0.x.array, len(axes))
    velocity = (
        vector_function(components)(R * places @ Q) @ Q.T * (scene.problem.time_unit or 1.0) / R
    )
    return np.asarray(
        model.system.zero_at_supports(
            np.ascontiguousarray(velocity[:, axes]).ravel()[: model.system.size]
        )
    )


def initial_clock(scene: Scene, load: TimeSection, state: State) -> dict[str, float]:
    """The clock of the state before a step, with the energy of its initial velocity; empty without
    one.
    """
    v = velocity_by_formula(scene, load.velocity) if load.velocity else 0.0 * state.u
    if load.push and load.push.velocity:
        v = pushed_along_mode(scene, load.push, state, v)[1]
    if not max_abs(scene.comm, v):
        return {}
    x, Mx = (M := mass(scene.model)).createVecs()
    x.setArray(v)
    M.mult(x, Mx)
    return {"kinetic": scene.model.multiplicity * dot(scene.comm, v, np.array(Mx.array_r)) / 2}


def time_in_case_unit(value: Time) -> float:
    """A time in the case's own unit."""
    return float(in_units("second")(value))


def dimensionless_time(problem: Problem, value: Time) -> float:
    """A time over R sqrt(rho/E)."""
    return time_in_case_unit(value) / (problem.time_unit or 1.0)


def amplitude_of_level(problem: Problem, name: str, value: Level) -> float:
    """A value of a history as an amplitude."""
    if name != "lambda_m":
        return level_in(problem.context, name, value)
    return problem.lambda_m * level_in(problem.context, "field", value)


def _scaled(of: Curve, size: float, unit: float, amplitude: Callable[[float], float]) -> Curve:
    return lambda t, before: amplitude(size * of(t * unit, before))


class LoadsInTime:
    """The amplitudes of a step as functions of its time.

    Parameters
    ----------
    motions
        Amplitudes of supports, which must not jump.

    Raises
    ------
    CaseError
        If one of these does at the begin.
    """

    def __init__(
        self, problem: Problem, load: TimeSection, state: State, motions: Collection[str]
    ) -> None:
        self._mu, time = dict(state.mu), partial(dimensionless_time, problem)
        histories = dict(zip(load.drives, load.history.values(), strict=True))
        unit, steps = problem.time_unit or 1.0, {step.name: step.load for step in problem.programme}
        self._curves, self.marks = dict[str, Curve](), set[float]()
        for name, history in histories.items():
            # histories are in the case's own unit of time
            driven = steps.get(name)
            value = driven.in_history(state.mu[name]) if driven else state.mu[name]
            of = curve(
                history, time_in_case_unit, partial(amplitude_of_level, problem, name), value
            )
            size = problem.lambda_m if isinstance(history, str) and name == "lambda_m" else 1.0
            self._curves[name] = _scaled(of, size, unit, driven.of_history if driven else float)
            self.marks |= set(marks(history, time, time(load.duration)))
            first, given = self._curves[name](0.0, False), state.mu[name]
            if name in motions and abs(first - given) > SAME * max(1.0, abs(given)):
                raise CaseError(
                    f"history.{name}: begins at {first:.6g}, but the support is at {given:.6g}"
                )

        times = [
            time(load.duration),
            *(time(t) for history in histories.values() for t in times_of(history)),
        ]
        self._close = CLOSE * min(t for t in times if t)

    def rates(
        self, t: float, before: bool, names: Collection[str]
    ) -> dict[str, tuple[float, float]]:
        """First and second derivatives by time of some of them, from values on one side, to second
        order.
        """
        back = before and t >= 3 * self._close
        slopes, step = {}, -self._close if back else self._close
        for name in set(self._curves) & set(names):
            a, b, c, d = (self._curves[name](t + i * step, back) for i in range(4))
            slopes[name] = (4 * b - 3 * a - c) / (2 * step), (2 * a - 5 * b + 4 * c - d) / step**2
        return slopes

    def __call__(self, t: float, before: bool) -> dict[str, float]:
        return self._mu | {name: of(t, before) for name, of in self._curves.items()}


@dataclass(frozen=True)
class _Ends:
    """Where bodies press, and the displacements of shells that may touch, at one end of a step."""

    of_bodies: list[tuple[Array, float | Array]]
    nodes_by_shell: list[Array]


class ContactsInTime:
    """All contacts of a system in steps in time, with bodies and between shells; a
    `continuation.motion.AveragedContact`.

    Attributes
    ----------
    names
        The approaches.
    settings
        Names of the stiffnesses between shells.
    """

    def __init__(
        self,
        system: FiniteElementSystem,
        pressings: Mapping[str, Pressing],
        between: Sequence[TimeAveragedContact],
    ) -> None:
        self._system, self._pressings, self._between = system, list(pressings.values()), between
        self.names = frozenset(pressings)
        self.settings = frozenset(contact.pair.setting for contact in between)
        self._begin: tuple[Vector, _Ends] | None = None

    def stiffened_settings(self, begin: State, v: Vector) -> dict[str, float]:
        """Settings of pairs of shells that do not touch, and may meet too fast for their penalty."""
        if not self._between:
            return {}
        comm, nodes = self._system.comm, v.reshape(-1, self._system.u.function_space.dofmap.bs)
        fastest = np.max(comm.allgather(np.max([nodes, -nodes], axis=1, initial=0.0)), axis=0)
        speed = float(
            np.linalg.norm(fastest.sum(axis=0))
        )  # of no two places relative to each other is it larger
        wanted = {
            each.pair: stiff_for(each.pair, speed, self._system.length) for each in self._between
        }
        at, found = self._system.at_state(begin), dict[str, float]()
        for each in self._between:
            k = begin.mu.get(each.pair.setting, each.pair.stiffness)
            if wanted[each.pair] > k and not each.pair.given and at.evaluate(each.penetration) <= 0:
                found[each.pair.setting] = wanted[each.pair]
        return found

    def average_along(self, begin: State, end: State, part: float) -> None:
        """Take the forces of a step at a part of it."""
        before, after = self._at_begin(begin), self._places(end)
        for pressing, low, high in zip(
            self._pressings, before.of_bodies, after.of_bodies, strict=True
        ):
            pressing.average(low, high, part)
        for contact, u, v in zip(
            self._between, before.nodes_by_shell, after.nodes_by_shell, strict=True
        ):
            contact.samples = ()
            contact.samples = samples_of_step(contact, u, v, part)

    def use_state_forces(self) -> None:
        """Take the present forces again."""
        for pressing in self._pressings:
            pressing.present()
        for contact in self._between:
            contact.samples = ()

    def penetration_message(self, begin: State, end: State) -> str:
        """Which shells pass through each other in a step."""
        ends = zip(
            self._between,
            self._at_begin(begin).nodes_by_shell,
            self._places(end).nodes_by_shell,
            strict=True,
        )
        through = [
            contact.pair.words for contact, before, after in ends if contact.passes(before, after)
        ]
        return f"{through[0]} pass through each other" if through else ""

    def stored_energy(self, u: Vector, mu: Amplitudes) -> float:
        """The energy of the shell itself with that of the contacts."""
        self.use_state_forces()
        return self._system.stored_energy(u, mu)

    def _at_begin(self, begin: State) -> _Ends:
        if self._begin is None or self._begin[0] is not begin.u:
            self._begin = begin.u, self._places(begin)
        return self._begin[1]

    def _places(self, state: State) -> _Ends:
        return self._system.at_state(state).evaluate(
            lambda: _Ends(
                [each.where for each in self._pressings], [each.where for each in self._between]
            )
        )


@dataclass(frozen=True)
class MovingState(State):
    """A state with a velocity, and perhaps one of its supports."""

    v: Vector
    ground: Vector | None = None


def motion(
    scene: Scene, load: TimeSection, state: State, held: Mapping[str, HeldConjugate]
) -> Records:
    """The records of a step in time; its return value is the state at its end.

    Parameters
    ----------
    held
        Amplitude -> its conjugate, as of `make_stage`.

    Raises
    ------
    Stopped
        If steps in time become too small, or the shell does not come to rest.
    """
    problem, system = scene.problem, scene.model.system
    loads = LoadsInTime(problem, load, state, scene.motions)
    drag = float(in_units("1/second")(load.drag)) * (problem.time_unit or 1.0)
    u, v = state.u, state.v if isinstance(state, MovingState) else 0.0 * state.u
    if load.push:
        u, v = pushed_along_mode(scene, load.push, state, v)
    if load.velocity:
        v = v + velocity_by_formula(scene, load.velocity)

    def begin() -> tuple[Integrator, Motion]:
        viscous, device, ground = (
            viscosity(scene, state),
            make_stage(scene, state, held).device,
            None,
        )
        if moving := scene.motions & set(load.drives):
            if viscous:
                raise CaseError(
                    f"history.{next(iter(moving))}: a viscous shell needs supports that are at rest"
                )
            carried = state.ground if isinstance(state, MovingState) else None
            ground = SupportInertia(
                system,
                mass_with_supports(scene.model),
                lambda t, b: (loads(t, b), loads.rates(t, b, moving)),
                carried,
            )
        pressings = {name: pressing for name, (pressing, _) in scene.model.contacts.items()}
        between = scene.model.shell_contacts
        touching = ContactsInTime(system, pressings, between) if pressings or between else None
        integrator = Integrator(
            system,
            mass(scene.model),
            loads,
            load.rho_inf,
            drag,
            viscous,
            Surroundings(load.drives, device, ground, touching),
        )
        return integrator, integrator.begin(0.0, u, v)

    integrator, now = begin()
    ground, duration = integrator.supports, dimensionless_time(problem, load.duration)
    fixed = None if load.step is None else dimensionless_time(problem, load.step)
    steps = TimeSteps(fixed, load.tolerance, fixed or duration / load.points / 10, load.balance)
    dt, most = steps.first, integrator.kinetic(now)
    total = most + system.stored_energy(now.u, now.mu)
    outputs = [duration * i / load.points for i in range(1, load.points + 1)]
    watched, ended, size = _watched(scene, load.event, state), "", scene.model.multiplicity

    def crossed(before: Motion, now: Motion) -> bool:
        return bool(
            watched and watched(before) * watched(now) <= 0 and watched(now) != watched(before)
        )

    def over(before: Motion, now: Motion, most: float) -> bool:
        quiet = (
            load.until == "rest"
            and max(integrator.kinetic(before), integrator.kinetic(now)) <= QUIET * most
        )
        return quiet or crossed(before, now)

    whole = load.errors == "motion" and fixed is None
    rehearse = StepRefinement(scene, held, loads.marks, begin, outputs, over) if whole else None
    walk = MotionRows(scene, integrator, held, steps, loads.marks, rehearse)
    for end in outputs:
        before, first = now, dt
        now, dt, point = walk.journalled(before, first, end)
        if watched and crossed(before, now):
            now, dt, point = walk.journalled(
                before, first, walk.crossing(before, first, now, watched)
            )
            ended = "event"
        kinetic = integrator.kinetic(now)
        most = max(most, kinetic)
        clock = {
            "time": now.t * (problem.time_unit or 1.0),
            "kinetic": size * kinetic,
            "dissipated": size * now.dissipated,
            "work": size * now.work,
            "imbalance": size
            * (kinetic + system.stored_energy(now.u, now.mu) + now.dissipated - now.work - total),
        }
        excluded = None if scene.free_in_time else scene.model.excluded_modes
        unseen = sum(excluded.counts(point.state)) if excluded else 0
        rest = load.until == "rest" and kinetic <= QUIET * most and _rest(scene, held, point.state)
        if load.until == "instability" and point.negative_pivots + unseen:
            ended = "instability"
        if load.until == "duration" and end == outputs[-1]:
            ended = "duration"
        yield Record(
            "target" if ended else "step", "time", point, excluded_pivots=unseen, clock=clock
        )
        if rest:
            pull = system.coordinates  # constant loads do work on the way to rest
            moved = {
                n: system.potential(rest.u, rest.mu, n) - q
                for n, q in now.potentials.items()
                if n not in pull
            }
            work = now.work - sum(now.mu[name] * change for name, change in moved.items())
            lacks = system.stored_energy(rest.u, rest.mu) + now.dissipated - work - total
            still = {**clock, "kinetic": 0.0, "work": size * work, "imbalance": size * lacks}
            yield Record(
                "target", "time", replace(point, state=rest), excluded_pivots=unseen, clock=still
            )
            return rest
        if ended:
            return MovingState(
                point.state.u,
                point.state.mu,
                now.v,
                ground.velocity(now.t, True) if ground else None,
            )
    if load.until == "rest":
        raise Stopped(
            f"the shell still moves at the end of its duration, kinetic energy {kinetic / most:.2g} of its largest"
        )
    raise Stopped(f"until: {load.until}: it has not come within the duration")


def _watched(
    scene: Scene, event: EventSection | None, state: State
) -> Callable[[Motion], float] | None:
    """What changes its sign at an event; None without one."""
    if event is None:
        return None
    if event.column not in (columns := scene.observe(state)):
        raise CaseError(
            f"loading: event.column: {event.column}: no such column; allowed: {', '.join(columns)}"
        )

    def beyond(now: Motion) -> float:
        return (
            scene.observe(scene.model.system.with_moved_supports(State(now.u, now.mu)))[
                event.column
            ]
            - event.value
        )

    return beyond


def viscosity(scene: Scene, state: State) -> Viscosity | None:
    """Of the shell at rest in a state; None without."""
    problem, shell = scene.problem, scene.problem.context.shell
    if shell.viscosity is None and not shell.relaxation:
        return None
    model, branches = scene.model, list[Branch]()
    for branch in shell.relaxation:
        size = float(in_units("pascal")(branch.modulus))
        ratio = size / (shell.youngs_modulus or 1.0) if isinstance(branch.modulus, str) else size
        branches.append(Branch(ratio, dimensionless_time(problem, branch.time)))
    assert model.thin
    return Viscosity(model, state.mu, dimensionless_time(problem, shell.viscosity or 0.0), branches)


def snap_records(
    scene: Scene, snap: SnapSection, fold: Record, held: Mapping[str, HeldConjugate]
) -> Records:
    """The records of a snap from a fold, or a bifurcation, to rest; its return value is the state
    at its end.

    Loads are constant, except those whose conjugates are `held`.

    The shell leaves the fold along the path's direction there, a bifurcation along its mode. Its
    drag is in proportion to the frequency of its third mode of vibration: the first one has none
    there.

    Raises
    ------
    Stopped
        If the shell does not come to rest.
    """
    state, system, unit = fold.point.state, scene.model.system, scene.problem.time_unit or 1.0
    own = [mode.eigenvalue for mode in ShellModes(scene.model).lowest(state, 3) if not mode.label]
    omega = float(np.sqrt(max(own[1:])))
    load = TimeSection(
        kind="time",
        duration=LONGEST * unit / omega,
        points=MOST,
        drag=2 * snap.damping * omega / unit,
        tolerance=snap.tolerance,
        errors=snap.errors,
        until="rest",
    )
    away = scene.model.system.zero_at_supports(fold.point.du)
    size = snap.push * system.length / max_abs(system.comm, away)
    return (yield from motion(scene, load, State(state.u + size * away, state.mu), held))


def _rest(scene: Scene, held: Mapping[str, HeldConjugate], state: State) -> State | None:
    """The equilibrium near a state; None if there is none near, or an unstable one."""
    stage = make_stage(scene, state, held)
    start = stage.enter(state)
    start, raised = start.with_(start.u, IDLE, 0.0), dict[str, float]()
    while True:
        outcome = stage.newton.solve(start, IDLE, PrescribedLoad(IDLE, 0.0))
        moved = (
            max_abs(scene.model.system.comm, outcome.state.u - start.u) / scene.model.system.length
        )
        if not outcome.converged or moved > NEAR:
            return None
        stiffer = raised_stiffnesses(scene, at_rest := stage.leave(outcome.state))
        if not stiffer:
            break
        raised |= stiffer
        start = State(outcome.state.u, {**outcome.state.mu, **raised})
    if stage.newton.factor_at(outcome.state).negative_pivots:
        return None
    return State(at_rest.u, state.mu | {name: at_rest.mu[name] for name in (*held, *raised)})

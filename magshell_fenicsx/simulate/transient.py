"""Step in time: the records of a motion, from any state, to its end or to rest.

A motion begins along a mode of vibration or with a velocity by formulas. Each of its rows has the
energies since the begin, whose balance shows the error. Times are over R sqrt(rho/E), the unit of
time of the model. docs/theory.md has the integrator.

Words and symbols:

- A row is a line of the results, at a given time or at an event, where a column passes a value. Its
  columns in time are called the clock: time, and energies since the begin.
- Amplitudes mu are load parameters by name. A held conjugate is the displacement on which a load
  does work, kept constant; the load is then an unknown.
- A step in time drives amplitudes as functions of time. Marks are times at which these have kinks.
- A snap is a motion from an instability, under constant loads, to rest.
- Excluded pivots count unstable directions that the model excludes by its symmetry.
- h and R are thickness and reference length, rho the density. `time_unit` is the unit of time in
  seconds; None or 1 for a case without units.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.prescribed_motion import vectors_in_space
from magshell_fenicsx.continuation.advance import TimeSteps
from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.device import HeldConjugate
from magshell_fenicsx.continuation.motion import Motion
from magshell_fenicsx.continuation.stability_monitor import unstable_count
from magshell_fenicsx.continuation.system import State, Vector, dot, max_abs
from magshell_fenicsx.continuation.transient import Integrator, Surroundings
from magshell_fenicsx.input.section import in_units
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.parts.motion.motion_step import EventSection, PushSection, TimeSection
from magshell_fenicsx.parts.step_course import SnapSection
from magshell_fenicsx.shape.field_symmetry import formula_field
from magshell_fenicsx.shells.mass import SupportInertia, mass, mass_with_supports
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.shells.viscous import Branch, Viscosity
from magshell_fenicsx.simulate.contact_control import raised_stiffnesses
from magshell_fenicsx.simulate.contacts_in_time import ContactsInTime
from magshell_fenicsx.simulate.loads_in_time import LoadsInTime, dimensionless_time
from magshell_fenicsx.simulate.motion_rows import MotionRows, StepRefinement
from magshell_fenicsx.simulate.path_records import Records
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import make_stage

Array = NDArray[np.float64]
# amplitudes by name, and their first and second derivatives by time
AmplitudesAndRates = tuple[dict[str, float], dict[str, tuple[float, float]]]
MIN_POLE_DEFLECTION = 1e-6  # of a mode of size one: a smaller one does not give its sign
MAX_SNAP_ANGLE = 2000.0  # rad of the third mode of vibration: duration of a snap
SNAP_ROWS = 500
QUIET_ENERGY = 1e-6  # kinetic energy over its largest value below which a shell may be at rest
NO_LOAD = ""  # name of an amplitude of no load
REST_DISTANCE = 1e-2  # over the system's length: an equilibrium so near is the one at rest


@dataclass(frozen=True)
class MovingState(State):
    """A state of the model with a velocity, from which a motion can go on.

    Attributes
    ----------
    v
        Velocity of the unknowns on this rank, over R and the unit of time.
    ground
        Velocity of the supports, where these move; None where they rest.
    """

    v: Vector
    ground: Vector | None = None


def motion_records(
    scene: Scene, load: TimeSection, state: State, held_conjugates: Mapping[str, HeldConjugate]
) -> Records:
    """Yield the records of a step in time, one for each row; collective.

    Parameters
    ----------
    load
        The section of the step: its duration, rows, loads in time and end.
    state
        State where the motion begins: a `MovingState`, or a state at rest.
    held_conjugates
        Amplitude that is unknown -> its conjugate: a number, or a function of the amplitude.

    Returns
    -------
    State
        State at the end (the generator's return value): the equilibrium near a shell at rest, else
        a `MovingState`.

    Raises
    ------
    Stopped
        If steps in time become too small, or the end that the step asks for is not reached within
        its duration.
    """
    start = _MotionStart(scene, load, state, held_conjugates)
    integrator, motion = start.begin()
    duration = dimensionless_time(scene.problem, load.duration)
    steps = _time_steps(scene, load)
    energies = _Energies(scene, integrator, motion)
    row_times = [duration * i / load.points for i in range(1, load.points + 1)]
    end_of_motion = _MotionEnd(load, integrator, _event_function(scene, load.event))
    marks = start.loads.marks
    refinement = None
    if load.errors == "motion" and steps.fixed is None:  # coarser runs show the error at the rows
        refinement = StepRefinement(
            scene, held_conjugates, marks, start.begin, ends=row_times, is_over=end_of_motion
        )
    rows = MotionRows(scene, integrator, held_conjugates, steps, marks, refinement)
    time_step = steps.first
    for row_time in row_times:
        previous, first_step, has_ended = motion, time_step, False
        # motion at this time, next time step, and point for the record
        motion, time_step, point = rows.journalled(previous, first_step, row_time)
        # the row moves from its time to that of the event
        if end_of_motion.event and end_of_motion.has_event(previous, motion):
            event_time = rows.crossing(previous, first_step, motion, end_of_motion.event)
            motion, time_step, point = rows.journalled(previous, first_step, event_time)
            has_ended = True
        clock = energies.clock(motion)
        excluded_pivots = _excluded_pivots(scene, point.state)
        state_at_rest = None
        if load.until == "rest" and energies.is_quiet:
            state_at_rest = _equilibrium_near(scene, held_conjugates, point.state)
        if load.until == "instability" and point.negative_pivots + excluded_pivots:
            has_ended = True
        if load.until == "duration" and row_time == row_times[-1]:
            has_ended = True
        record = Record("step", "time", point, excluded_pivots=excluded_pivots, clock=clock)
        yield replace(record, label="target") if has_ended else record
        if state_at_rest:
            clock = energies.clock_at_rest(motion, state_at_rest, clock)
            yield replace(
                record, label="target", point=replace(point, state=state_at_rest), clock=clock
            )
            return state_at_rest
        if has_ended:
            return _moving_state(integrator, motion, point.state)
    raise _end_not_reached(load, energies)


def _end_not_reached(load: TimeSection, energies: "_Energies") -> Stopped:
    """Return the exception that a motion has not reached its end within its duration."""
    if load.until == "rest":
        return Stopped(
            "the shell still moves at the end of its duration, kinetic energy "
            f"{energies.kinetic / energies.largest_kinetic:.2g} of its largest"
        )
    return Stopped(f"until: {load.until}: it has not come within the duration")


def _moving_state(integrator: Integrator, motion: Motion, state: State) -> MovingState:
    """Return the state at the end of a motion with its velocity, and with that of the supports."""
    supports = integrator.supports
    # True: the velocity just before this time, at which it may jump
    ground_velocity = supports.velocity(motion.t, True) if supports else None
    return MovingState(state.u, state.mu, v=motion.v, ground=ground_velocity)


def snap_records(
    scene: Scene, snap: SnapSection, fold: Record, held_conjugates: Mapping[str, HeldConjugate]
) -> Records:
    """Yield the records of a snap from a fold or a bifurcation to rest; collective.

    Loads are constant, except those whose conjugates are `held_conjugates`. The shell leaves a fold
    along the path's direction there, a bifurcation along its mode. Its drag is in proportion to the
    frequency of its third mode of vibration, as the first one has frequency zero there.

    Parameters
    ----------
    snap
        The section of the snap: its push over h, damping ratio and tolerance.
    fold
        Record at the fold or bifurcation.
    held_conjugates
        Amplitude that is unknown -> its conjugate: a number, or a function of the amplitude.

    Returns
    -------
    State
        State at rest (the generator's return value).

    Raises
    ------
    Stopped
        If the shell does not come to rest.
    """
    state, system, unit = fold.point.state, scene.model.system, scene.problem.time_unit or 1.0
    lowest_modes = ShellModes(scene.model).lowest(state, 3)
    # without modes of other symmetries, which have a label; eigenvalues are squared frequencies
    eigenvalues = [mode.eigenvalue for mode in lowest_modes if not mode.label]
    # frequency of the highest mode; the first one is neutral here
    omega = float(np.sqrt(max(eigenvalues[1:])))
    load = TimeSection(
        kind="time",
        duration=MAX_SNAP_ANGLE * unit / omega,
        points=SNAP_ROWS,
        drag=2 * snap.damping * omega / unit,
        tolerance=snap.tolerance,
        errors=snap.errors,
        until="rest",
    )
    # the path's direction at a fold; the direction of a bifurcation's point is the mode
    direction = system.zero_at_supports(fold.point.du)
    push_length = snap.push * system.length / max_abs(system.comm, direction)
    pushed_state = State(state.u + push_length * direction, state.mu)
    return (yield from motion_records(scene, load, pushed_state, held_conjugates))


def _time_steps(scene: Scene, load: TimeSection) -> TimeSteps:
    """Return the options for the lengths of time steps, over the unit of time of the model."""
    duration = dimensionless_time(scene.problem, load.duration)
    fixed = None if load.step is None else dimensionless_time(scene.problem, load.step)
    first = fixed or duration / load.points / 10  # a tenth of a row; then the error controls steps
    return TimeSteps(fixed, load.tolerance, first, load.balance)


class _MotionStart:
    """Begin of a step in time: its loads, and the state with its velocity.

    A coarser run of the same motion begins again from here.

    Parameters
    ----------
    load
        The section of the step.
    state
        State where the motion begins: a `MovingState`, or a state at rest.
    held_conjugates
        Amplitude that is unknown -> its conjugate.

    Attributes
    ----------
    loads
        The amplitudes as functions of time.
    _scene, _load, _state, _held
        The parameters.
    _drag
        Drag: a force over mass and velocity, in the unit of time of the model.
    _u, _v
        Displacement and velocity at the begin, with those that the step adds.
    """

    def __init__(
        self,
        scene: Scene,
        load: TimeSection,
        state: State,
        held_conjugates: Mapping[str, HeldConjugate],
    ) -> None:
        """Find displacement and velocity at the begin, with a push and a velocity by formulas."""
        self._scene, self._load, self._state, self._held = scene, load, state, held_conjugates
        self.loads = LoadsInTime(scene.problem, load, state, scene.motions)
        unit = scene.problem.time_unit or 1.0
        self._drag = float(in_units("1/second")(load.drag)) * unit
        u, v = state.u, state.v if isinstance(state, MovingState) else 0.0 * state.u
        if load.push:
            u, v = pushed_along_mode(scene, load.push, state, v)
        if load.velocity:
            v = v + velocity_by_formula(scene, load.velocity)
        self._u, self._v = u, v

    def begin(self) -> tuple[Integrator, Motion]:
        """Return a new integrator, and the motion at time zero; collective."""
        scene, state, load = self._scene, self._state, self._load
        viscous = viscosity(scene, state)  # None of an elastic shell
        # what makes amplitudes with held conjugates unknowns; None without such
        device = make_stage(scene, state, self._held).device
        supports = self._support_inertia(is_viscous=viscous is not None)
        contact = ContactsInTime(scene.model) if scene.model.all_contacts else None
        surroundings = Surroundings(
            moving_amplitudes=load.drives, device=device, supports=supports, contact=contact
        )
        integrator = Integrator(
            scene.model.system,
            mass(scene.model),
            self.loads,
            rho=load.rho_inf,  # factor of a step by which high frequencies fade
            drag=self._drag,
            viscous=viscous,
            surroundings=surroundings,
        )
        return integrator, integrator.begin(0.0, self._u, self._v)

    def _support_inertia(self, *, is_viscous: bool) -> SupportInertia | None:
        """Return the inertia forces of supports that move; None if all supports are at rest.

        Raises
        ------
        CaseError
            If supports of a viscous shell move.
        """
        scene, state, loads = self._scene, self._state, self.loads
        moving = scene.motions & set(self._load.drives)
        if not moving:
            return None
        if is_viscous:
            raise CaseError(
                f"history.{next(iter(moving))}: a viscous shell needs supports that are at rest"
            )

        def amplitudes_and_rates(t: float, before: bool) -> AmplitudesAndRates:
            """Return amplitudes and their rates at a time; if wanted, those just before it."""
            return loads(t, before), loads.rates(t, before, moving)

        # velocity of the supports where the motion begins; None at rest
        ground_velocity = state.ground if isinstance(state, MovingState) else None
        return SupportInertia(
            scene.model.system,
            mass_with_supports(scene.model),
            amplitudes_and_rates,
            ground_velocity,
        )


@dataclass(frozen=True)
class _MotionEnd:
    """End of a motion before its duration: an event, or rest.

    Attributes
    ----------
    load
        The section of the step, which says how the motion ends.
    event
        Function of a motion that changes its sign at the event; None without an event.
    """

    load: TimeSection
    integrator: Integrator
    event: Callable[[Motion], float] | None

    def has_event(self, previous: Motion, next_motion: Motion) -> bool:
        """Return whether the event is between two motions, those of successive rows.

        The function of the event changes its sign there, or is zero at one of them alone.
        """
        if self.event is None:
            return False
        return self.event(previous) * self.event(next_motion) <= 0 and self.event(
            next_motion
        ) != self.event(previous)

    def __call__(self, previous: Motion, next_motion: Motion, largest_kinetic: float) -> bool:
        """Return whether a motion need not be followed beyond the second of two rows.

        Parameters
        ----------
        largest_kinetic
            The largest kinetic energy so far.
        """
        if self.load.until == "rest":
            kinetic = max(self.integrator.kinetic(previous), self.integrator.kinetic(next_motion))
            if kinetic <= QUIET_ENERGY * largest_kinetic:
                return True
        return self.has_event(previous, next_motion)


class _Energies:
    """Energies of a motion since its begin, as columns of its rows.

    Parameters
    ----------
    begin
        The motion at time zero.

    Attributes
    ----------
    kinetic, largest_kinetic
        Kinetic energy of the model at the last row, and the largest one so far, over E h R^2.
    _at_begin
        Kinetic and stored energy at time zero, in the same unit.
    """

    def __init__(self, scene: Scene, integrator: Integrator, begin: Motion) -> None:
        self._scene, self._integrator = scene, integrator
        self.kinetic = self.largest_kinetic = integrator.kinetic(begin)
        self._at_begin = self.kinetic + scene.model.system.stored_energy(begin.u, begin.mu)

    @property
    def is_quiet(self) -> bool:
        """Whether the shell may be at rest at the last row, as its kinetic energy is small."""
        return self.kinetic <= QUIET_ENERGY * self.largest_kinetic

    def clock(self, motion: Motion) -> dict[str, float]:
        """Return the columns of a row in time; the row then counts as the last one.

        The keys are time (in s of a case with units), and kinetic, dissipated, work and imbalance:
        energies over E h R^2 of the whole shell since the begin. Collective.
        """
        multiplicity = self._scene.model.multiplicity  # number of such models in the shell
        self.kinetic = self._integrator.kinetic(motion)
        self.largest_kinetic = max(self.largest_kinetic, self.kinetic)
        stored_energy = self._scene.model.system.stored_energy(motion.u, motion.mu)
        # of the balance of energy since the begin: the error of the time steps
        imbalance = self.kinetic + stored_energy + motion.dissipated - motion.work - self._at_begin
        return {
            "time": motion.t * (self._scene.problem.time_unit or 1.0),
            "kinetic": multiplicity * self.kinetic,
            "dissipated": multiplicity * motion.dissipated,
            "work": multiplicity * motion.work,
            "imbalance": multiplicity * imbalance,
        }

    def clock_at_rest(
        self, motion: Motion, rest: State, clock: Mapping[str, float]
    ) -> dict[str, float]:
        """Return the columns in time of the equilibrium near the last row; collective.

        Parameters
        ----------
        motion, clock
            Motion at the last row, and its columns.
        rest
            The equilibrium.
        """
        system, multiplicity = self._scene.model.system, self._scene.model.multiplicity
        # constant loads do work on the way to rest: -mu times the change of dPi/dmu
        changes = {
            name: system.potential(rest.u, rest.mu, name) - potential
            for name, potential in motion.potentials.items()
            if name not in system.coordinates
        }
        work = motion.work - sum(motion.mu[name] * change for name, change in changes.items())
        stored_energy = system.stored_energy(rest.u, rest.mu)
        imbalance = stored_energy + motion.dissipated - work - self._at_begin
        return {
            **clock,
            "kinetic": 0.0,
            "work": multiplicity * work,
            "imbalance": multiplicity * imbalance,
        }


def _excluded_pivots(scene: Scene, state: State) -> int:
    """Return the number of unstable directions at a state that the model excludes; collective.

    It is 0 for a shell that moves freely, whose rigid motions would count.
    """
    if scene.free_in_time:
        return 0
    return unstable_count(scene.model.symmetry_breaking_modes, state)


def refuse_unknown_events(scene: Scene, state: State) -> None:
    """Raise CaseError if a step in time ends at an event of an unknown column; collective.

    Any state of the scene shows which columns there are.
    """
    for step in scene.problem.programme:
        event = step.load.event if isinstance(step.load, TimeSection) else None
        if event and event.column not in (columns := _columns_of_events(scene, state)):
            raise CaseError(
                f"{step.key}.event.column: {event.column}: no such column; allowed: "
                f"{', '.join(columns)}"
            )


def _columns_of_events(scene: Scene, state: State) -> dict[str, float]:
    """Return column of path.csv, also those in the case's units -> its value at a state."""
    columns = scene.observe(state)
    return columns | scene.sizes.values(columns)


def _event_function(scene: Scene, event: EventSection | None) -> Callable[[Motion], float] | None:
    """Return the function of a motion that changes its sign at an event; None without an event.

    It is the excess of a column over the value of the event.
    """
    if event is None:
        return None

    def excess(motion: Motion) -> float:
        """Return the column at a motion less the value of the event; collective."""
        moved_state = scene.model.system.with_moved_supports(State(motion.u, motion.mu))
        return _columns_of_events(scene, moved_state)[event.column] - event.value

    return excess


def _equilibrium_near(
    scene: Scene, held_conjugates: Mapping[str, HeldConjugate], state: State
) -> State | None:
    """Return the stable equilibrium near a state, under the same loads; None if there is none.

    Penalties of contact become stiffer until nothing penetrates too much. Collective.
    """
    # the stage translates states between the model and the solver's system
    stage, comm = make_stage(scene, state, held_conjugates), scene.model.system.comm
    start = stage.enter(state)
    # the solver needs an amplitude to prescribe: here one that no load has
    start = start.with_(start.u, NO_LOAD, 0.0)
    new_settings = dict[str, float]()  # penalties that have become stiffer
    while True:
        outcome = stage.newton.solve(start, NO_LOAD, PrescribedLoad(NO_LOAD, 0.0))
        distance = max_abs(comm, outcome.state.u - start.u) / scene.model.system.length
        if not outcome.converged or distance > REST_DISTANCE:
            return None
        state_at_rest = stage.leave(outcome.state)
        stiffer = raised_stiffnesses(scene, state_at_rest)
        if not stiffer:
            break
        new_settings |= stiffer
        start = State(outcome.state.u, {**outcome.state.mu, **new_settings})
    if stage.newton.factor_at(outcome.state).negative_pivots:  # unstable
        return None
    # new values of unknown amplitudes and of penalties, without the solver's own amplitude
    changed = {name: state_at_rest.mu[name] for name in (*held_conjugates, *new_settings)}
    return State(state_at_rest.u, state.mu | changed)


def viscosity(scene: Scene, state: State) -> Viscosity | None:
    """Return the viscous forces of a shell that is at rest at a state; None of an elastic shell.

    Times of viscosity and relaxation are over the unit of time of the model, and moduli over E.
    """
    problem, shell = scene.problem, scene.problem.context.shell
    if shell.viscosity is None and not shell.relaxation:
        return None
    model, branches = scene.model, list[Branch]()
    for branch in shell.relaxation:  # springs with dashpots in series
        modulus = float(in_units("pascal")(branch.modulus))
        relative_modulus = (  # a text has a unit; a number is over E already
            modulus / (shell.youngs_modulus or 1.0) if isinstance(branch.modulus, str) else modulus
        )
        branches.append(Branch(relative_modulus, dimensionless_time(problem, branch.time)))
    assert model.thin
    return Viscosity(model, state.mu, dimensionless_time(problem, shell.viscosity or 0.0), branches)


def pushed_along_mode(
    scene: Scene, push: PushSection, state: State, v: Vector
) -> tuple[Vector, Vector]:
    """Return displacement and velocity with a natural mode added, inward at the pole; collective.

    Parameters
    ----------
    push
        Number of the mode among those of the model's symmetry, its displacement over h and its
        velocity.
    v
        Velocity before, over R and the unit of time.
    """
    comm = scene.model.system.comm
    modes = ShellModes(scene.model)
    # modes of other symmetries have a label; `vibrations` gives so many modes in all, `lowest` so
    # many of each symmetry
    symmetric_modes = [mode for mode in modes.vibrations(state, push.mode) if not mode.label]
    if len(symmetric_modes) < push.mode:  # those of other symmetries were lower
        symmetric_modes = [mode for mode in modes.lowest(state, push.mode) if not mode.label]
    mode = symmetric_modes[push.mode - 1].vector
    phi = np.asarray(mode / max_abs(comm, mode))
    deflection = scene.model.deflection(phi, "pole")
    if abs(deflection) < MIN_POLE_DEFLECTION:
        # where the pole rests, the larger crests give the sign: the sum of cubes
        deflection = dot(comm, phi, phi**2)
    signed_thickness = np.copysign(scene.problem.material.h, deflection)
    unit = scene.problem.time_unit or 1.0
    return (
        state.u + push.displacement * signed_thickness * phi,
        v + push.velocity * unit * signed_thickness * phi,
    )


def velocity_by_formula(scene: Scene, components: Sequence[str]) -> Vector:
    """Return the velocity of the nodes by formulas of the undeformed place; zero at supports.

    Parameters
    ----------
    components
        Three formulas of x, y, z, in the case's frame and units.

    Returns
    -------
    Vector
        Unknowns of this rank, over R and the unit of time.
    """
    # Q turns vectors of the case's frame into the model's
    model, R, Q = scene.model, scene.problem.length, rotation(scene.problem.azimuth)
    unit, axes = scene.problem.time_unit or 1.0, model.axes
    places = vectors_in_space(model.r0.x.array, len(axes))
    # the formulas take places in the case's frame and units, and give velocities in these
    velocity = formula_field(components)(R * places @ Q) @ Q.T * unit / R
    owned = np.ascontiguousarray(velocity[:, axes]).ravel()[: model.system.size]
    return np.asarray(model.system.zero_at_supports(owned))


def initial_clock(scene: Scene, load: TimeSection, state: State) -> dict[str, float]:
    """Return the columns in time of the state before a step in time: its kinetic energy.

    The dictionary is empty if the step has no initial velocity. The energy is v . M v/2 of the
    whole shell, over E h R^2, with the mass matrix M. Collective.
    """
    velocity = velocity_by_formula(scene, load.velocity) if load.velocity else 0.0 * state.u
    if load.push and load.push.velocity:
        _, velocity = pushed_along_mode(scene, load.push, state, velocity)
    if not max_abs(scene.comm, velocity):
        return {}
    # momentum M v
    M = mass(scene.model)
    mass_argument, momentum = M.createVecs()
    mass_argument.setArray(velocity)
    M.mult(mass_argument, momentum)
    # the model may be one of several equal parts of the shell
    multiplicity = scene.model.multiplicity
    return {"kinetic": multiplicity * dot(scene.comm, velocity, np.array(momentum.array_r)) / 2}

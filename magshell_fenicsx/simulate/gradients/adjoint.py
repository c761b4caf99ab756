"""Gradients of a result with respect to amplitudes, numbers of the case, and fields.

With R(x; p) = 0 for the state x under the loading device in use, and K = R_x,

    dJ/dp = J_p + w . R_p,    K^T w = -J_x

takes one solve for all parameters. For the amplitude at a fold w = -phi/(phi . R_mu) with the left
null vector phi. Where a wave phi is neutral that a meridian does not see, Q(phi; u, mu, p) = 0 for
its second variation, and

    dmu/dp = -(Q_p + w . R_p)/(Q_mu + w . R_mu),    K w = -Q_u.

The equations of vibrations and of energy barriers are contracted at several displacements:
`AdjointState`.
So are those of states under a conjugate q that a step holds: it is q = -Pi_mu of the state where
the step began, which p changes too. So are loads that a step leaves and was not controlled by, as a
force at a depth.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from magshell_fenicsx.assembly.free_parameters import derived
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.terms import FormTerm, factor_of
from magshell_fenicsx.continuation.device import Conjugate, Device
from magshell_fenicsx.continuation.fold import Fold
from magshell_fenicsx.continuation.modes import nearest_to_zero
from magshell_fenicsx.continuation.system import State, System, Vector, dot
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.observables import Slope
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.parts.step_course import Gas
from magshell_fenicsx.shells.mass import mass_along
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.shells.model_base import ModelBase
from magshell_fenicsx.simulate.contact_control import refuse_touching_shells
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import Functional, Target, force_unit, functional, in_units
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.sensitivity import fold_at, stage_of_record
from magshell_fenicsx.simulate.steps import enclosed_gas, held_conjugates_of_step
from magshell_fenicsx.simulate.transfer import transfer

WAVE = "m = "  # what the mode of a wave begins with
CONJUGATE_TOLERANCE = (
    1e-5  # a conjugate is still the one that was held, relative to the larger of it and its unit
)

Begins: TypeAlias = Mapping[int, Record]  # number of a step -> the last record before it
NO_BEGINS: Begins = MappingProxyType({})


@dataclass(frozen=True)
class AdjointState:
    """A state at which w . R + c Pi + sum_i c_i dPi/dmu_i, functions of (u, mu; p), are
    differentiated by p.

    Attributes
    ----------
    w
        Multiplier of the residual R; at supports that of a reaction, otherwise zero there.
    rows
        c_i of the rows of the device: of amplitudes that are unknown there, as their conjugates are
        held.
    energy, potentials
        c, and the part of c_i that J itself contains.
    follows
        Amplitudes of the rows whose conjugates are those of a later place.
    steps
        How many steps of the programme led to this place, where a later step began; None: all of
        the record's.
    driven
        Amplitudes that have changed since.
    gas
        Whether the conjugate of a gas is held there.
    """

    state: State
    w: Vector
    rows: Mapping[str, float] = field(default_factory=dict)
    energy: float = 0.0
    potentials: Mapping[str, float] = field(default_factory=dict)
    follows: frozenset[str] = frozenset()
    steps: int | None = None
    driven_amplitudes: frozenset[str] = frozenset()
    gas: bool = False

    @property
    def conjugates(self) -> dict[str, float]:
        """All c_i."""
        names = {**self.rows, **self.potentials}
        return {name: self.rows.get(name, 0.0) + self.potentials.get(name, 0.0) for name in names}


@dataclass(frozen=True)
class EnergyDirection:
    """A vector phi whose energies at the first place are differentiated by p, times factors.

    Attributes
    ----------
    wave
        m of phi, which is in the space of waves; None of a displacement.
    stiffness
        Factor of the second variation Q_m(phi) of a wave.
    inertia
        Factor of phi . M phi.
    """

    phi: Vector
    wave: int | None
    stiffness: float = 0.0
    inertia: float = 0.0


@dataclass(frozen=True)
class Adjoint:
    """Adjoint of a result J: dJ/dp is J_p plus the contracted derivatives of the equations at all
    places.

    Attributes
    ----------
    places
        The first is the state itself.
    by_mu
        dJ/dmu_i where J contains the amplitude itself.
    by_itself
        What J of a scene and a state is by p alone; None if energies and potentials of the places
        say it.
    directions
        Vectors whose energies J contains.
    value
        J.
    gas
        Whether a conjugate is that of a gas, whose law has numbers of the case.
    free
        The amplitude that J is; "" where it is given.
    scale
        Name of the unit (`Quantity.scale`) in which `derivative` gives dJ/dp; "" without a unit.
    left
        Amplitudes that are loads as an earlier step has left them, which was not controlled by
        them.
    slope
        What J is of a room, with its own derivatives by a field.
    forms, deflections
        As of a `Functional`.
    about
        The state about which contact between shells is a polynomial at all places; None: about each
        place's own.
    """

    scene: Scene
    places: Sequence[AdjointState]
    by_mu: Mapping[str, float] = field(default_factory=dict)
    by_itself: Callable[[Scene, State], float] | None = None
    directions: Sequence[EnergyDirection] = ()
    value: float = 0.0
    gas: bool = False
    free_amplitude: str = ""
    scale: str = ""
    left_loads: frozenset[str] = frozenset()
    slope: Slope | None = None
    forms: Sequence[tuple[FormTerm, float]] = ()
    deflections: Mapping[str, float] = field(default_factory=dict)
    contact_state: State | None = None

    @property
    def size(self) -> float:
        """Size of the unit of J, in J's own numbers."""
        return self.scene.sizes.by_unit[self.scale] if self.scale else 1.0

    @property
    def value_in_unit(self) -> float:
        """J in its unit."""
        return self.value * self.size

    @property
    def state(self) -> State:
        return self.places[0].state


def adjoint_of_instability(
    scene: Scene, record: Record, fold: Fold | None = None, begins: Begins = NO_BEGINS
) -> Adjoint:
    """The adjoint of the amplitude where a fold or a neutral wave is.

    A fold takes no factorisation but its own, a wave one of the tangent and one of its second
    variation; a conjugate that the step holds takes one where the step began.

    Raises
    ------
    CaseError
        If the record is another instability, or what it holds has no derivative.
    """
    if record.mode.startswith(WAVE):
        return _of_wave(scene, record)
    if record.label != "fold":
        raise CaseError(
            f"instability: this is a {record.label} {record.mode}".rstrip()
            + ": only of folds, and of waves"
        )
    fold = fold or fold_at(scene, record)
    stage = stage_of_record(scene, record)
    system = stage.newton.system
    pull = dot(
        system.comm, fold.left_null_vector, system.load(fold.state.u, fold.state.mu, fold.name)
    )
    left_null_vector = np.asarray(-fold.left_null_vector / pull)
    rows = stage.device.rates(left_null_vector) if stage.device else {}
    w = stage.device.displacement(left_null_vector) if stage.device else left_null_vector
    place = AdjointState(stage.leave(fold.state), np.array(w), rows)
    gas = with_gas(held_at(scene, record, record.point.state))
    return with_begins(
        Adjoint(scene, [place], value=fold.value, gas=gas, free_amplitude=fold.name), record, begins
    )


def _of_wave(scene: Scene, record: Record) -> Adjoint:
    model, m = scene.model, int(record.mode.removeprefix(WAVE))
    if record.step and scene.problem.programme[record.step - 1].load.hold:
        raise CaseError(f"instability: {record.mode}: not while a conjugate is held")
    assert model.axisymmetric
    if model.t_junction_terms:
        raise CaseError(
            f"instability: {record.mode}: has no gradient at a T-junction: take symmetry: half"
        )
    system, waves, state = (
        model.system,
        model.waves,
        model.system.with_moved_supports(record.point.state),
    )
    refuse_touching_shells(scene, state, f"instability: {record.mode}")
    phi = nearest_to_zero(waves.factor_at(state, m))[1]
    Q = variation(model, state, phi, m, [record.amplitude])
    w, _ = solved(scene, state, Q, {})
    rate = Q.by_mu[record.amplitude] + w @ system.load(state.u, state.mu, record.amplitude)
    # what locating it has left, to second order
    value = state.mu[record.amplitude] - Q.value / rate
    direction = EnergyDirection(phi, m, stiffness=float(-1 / rate))
    return Adjoint(
        scene,
        [AdjointState(state, -w / rate)],
        directions=[direction],
        value=float(value),
        free_amplitude=record.amplitude,
    )


def variation(
    model: MeridianModel, state: State, phi: Vector, m: int, names: Iterable[str]
) -> Functional:
    """Q_m(phi) of a wave, with its derivatives by u and by some amplitudes."""
    terms, system, mu = model.waves.energies_along(phi, m), model.system, state.mu
    rates = {name: by_amplitude(model, terms, name, mu) for name in names}

    def present() -> Functional:
        by_u = np.zeros(system.size)
        for term in terms:
            term.add_residual(by_u, factor_of(term.amplitude, mu))
        value = sum((factor_of(term.amplitude, mu) * term.energy() for term in terms), 0.0)
        by_mu = {
            name: sum((c * term.energy() for term, c in weighted_terms), 0.0)
            for name, weighted_terms in rates.items()
        }
        return Functional(value, system.zero_at_supports(by_u), by_mu)

    return system.at_state(state).evaluate(present)


def by_amplitude(
    model: ModelBase, terms: Sequence[FormTerm], name: str, mu: Mapping[str, float]
) -> list[tuple[FormTerm, float]]:
    """The derivatives of energies by an amplitude that multiplies some of them and may enter
    others; with factors.
    """
    factors = [(term, 1.0) for term in terms if term.amplitude == name]
    p = model.system.parameters[name].constant if name in model.system.parameters else None
    for term in terms:
        if p in term.form.constants():
            slope = FormTerm(
                f"{term.name} by {name}",
                derived(term.form, p),
                model.u,
                KernelLog(),
                term.amplitude,
            )
            factors.append((slope, factor_of(term.amplitude, mu)))
    return factors


def adjoint(
    scene: Scene,
    record: Record,
    of: str | Target,
    hold: Mapping[str, str] | None = None,
    begins: Begins = NO_BEGINS,
) -> Adjoint:
    """The adjoint of a result at a regular state; one factorisation and one solve, and these of a
    step's begin again.

    Raises
    ------
    CaseError
        If the scene has no such result, or what the step holds has no derivative.
    """
    state = scene.model.system.with_moved_supports(record.point.state)
    column, scale = in_units(scene, state, of) if isinstance(of, str) else (of, "")
    result = functional(scene, state, column)
    held_conjugates = held_at(scene, record, state, hold)
    if free_amplitudes := [
        name for name in result.by_mu if name not in held_conjugates and not result.slope
    ]:
        raise CaseError(
            f"{free_amplitudes[0]}: is a load here, which no parameter changes: hold its conjugate"
        )
    w, rows = solved(scene, state, result, held_conjugates)
    by_itself = None if result.energy else lambda there, at: functional(there, at, column).value
    if result.reaction is not None:
        unit = force_unit(scene)
        by_itself = lambda there, _: result.value * force_unit(there) / unit  # noqa: E731
        w = w + result.reaction
    place = AdjointState(state, w, rows, result.energy, result.potentials)
    result_adjoint = Adjoint(
        scene,
        [place],
        result.by_mu,
        by_itself,
        value=result.value,
        gas=with_gas(held_conjugates),
        scale=scale,
        slope=result.slope,
        forms=result.forms,
        deflections=result.deflections,
    )
    return with_begins(result_adjoint, record, begins) if hold is None else result_adjoint


def with_begins(adjoint: Adjoint, record: Record, begins: Begins) -> Adjoint:
    """An adjoint at a record with the places where steps began whose state it depends on;
    collective.

    It depends on conjugates that a step holds, and on loads as a step has left them by which it was
    not controlled.

    Raises
    ------
    CaseError
        If it is not known where a step began.
    """
    scene, places, left_loads = adjoint.scene, list(adjoint.places), set[str]()
    part: Adjoint | None = adjoint
    place_number = 0  # of the place at the record
    # dJ/dmu of loads as earlier steps have left them
    loads, driven_amplitudes = dict[str, float](), set[str]()
    while record.step:
        place, step, system = (
            part.places[0] if part else None,
            scene.problem.programme[record.step - 1],
            scene.model.system,
        )
        earlier = scene.problem.programme[: record.step - 1]
        driven_amplitudes |= _driven_amplitudes(step, record.point.state.mu)
        held_conjugates = _rows_of_held(step, place) if place else {}
        if record.step not in begins:
            if held_conjugates:
                raise CaseError(
                    f"{step.key}.hold: {', '.join(held_conjugates)}: give begin, the record before "
                    "this step"
                )
            break
        begin, c, by_mu = begins[record.step], dict[str, float](), dict[str, float]()
        if begin.scene and begin.scene is not scene:
            if held_conjugates or loads:
                names = ", ".join({*held_conjugates, *loads})
                raise CaseError(
                    f"{names}: as they were before {step.key}, in another model: no gradient"
                )
            break
        state_before = system.with_moved_supports(begin.point.state)
        held_before = held_at(scene, begin, state_before)
        if part and place:
            reused_amplitudes = _amplitudes_of_steps(earlier) & place.state.mu.keys()
            for name in reused_amplitudes - place.rows.keys() - driven_amplitudes:
                loads[name] = loads.get(name, 0.0) + by_load(part, name)
        if place:
            c, by_mu = _terms_of_held(scene, step, place.state, state_before, held_conjugates)
        for name in loads.keys() & held_before.keys():
            by_mu[name] = by_mu.get(name, 0.0) + loads.pop(name)
            left_loads.add(name)
        if place and held_conjugates:
            places[place_number] = replace(place, follows=frozenset(held_conjugates))
        part = None
        if c or any(by_mu.values()):
            slope_u = _sum_of_loads(scene, state_before, c)
            w, rows = solved(scene, state_before, Functional(0.0, slope_u, by_mu, c), held_before)
            gas = with_gas(held_before)
            place_at_begin = AdjointState(
                state_before,
                w,
                rows,
                potentials=c,
                steps=begin.step,
                driven_amplitudes=frozenset(driven_amplitudes),
                gas=gas,
            )
            place_number = len(places)
            places.append(place_at_begin)
            part = Adjoint(scene, [place_at_begin])
        record = begin
    return replace(adjoint, places=places, left_loads=frozenset(left_loads))


def _sum_of_loads(scene: Scene, state: State, factors: Mapping[str, float]) -> Vector:
    """Return the sum of the load vectors at a state, each times the factor of its amplitude."""
    system, total = scene.model.system, np.zeros(scene.model.system.size)
    for name, factor in factors.items():
        total += factor * system.load(state.u, state.mu, name)
    return total


def _rows_of_held(step: ProgrammeStep, place: AdjointState) -> dict[str, float]:
    """Return amplitude whose conjugate a step holds -> adjoint of that equation, where not zero."""
    return {name: place.rows[name] for name in held_by_step(step) if place.rows.get(name)}


def _amplitudes_of_steps(steps: Sequence[ProgrammeStep]) -> set[str]:
    """Return the amplitudes that steps drive, or whose conjugates they hold."""
    return {name for step in steps for name in (step.name, *held_by_step(step))}


def _terms_of_held(
    scene: Scene,
    step: ProgrammeStep,
    state: State,
    state_before: State,
    rows: Mapping[str, float],
) -> tuple[dict[str, float], dict[str, float]]:
    """Return how a place depends on the state before its step, by conjugates that the step holds.

    Parameters
    ----------
    state, state_before
        The states at the place, and where the step began.
    rows
        Amplitude whose conjugate is held -> adjoint of the equation that holds it.

    Returns
    -------
    c, by_mu
        Amplitude -> factor of dPi/dmu of the state before, and derivative by its amplitude.

    Raises
    ------
    CaseError
        If one is not held from the state before on.
    """
    system, c, by_mu = scene.model.system, dict[str, float](), dict[str, float]()
    for name, row in rows.items():
        law = step.load.hold[name]
        if isinstance(law, Gas):
            gas = enclosed_gas(scene, law.gas, state_before)
            share, slope = gas.by_begin(state.mu[name])
            c[name], by_mu[name] = -row * share, row * slope
            continue
        potential = system.potential(state.u, state.mu, name)
        change = potential - system.potential(state_before.u, state_before.mu, name)
        scale = max(abs(potential), abs(scene.conjugate_unit(name)))
        if abs(change) > CONJUGATE_TOLERANCE * scale:
            raise CaseError(
                f"{step.key}.hold.{name}: no gradient, as it is not held from the last point "
                "before the step"
            )
        c[name] = -row
    return c, by_mu


def _driven_amplitudes(step: ProgrammeStep, mu: Mapping[str, float]) -> set[str]:
    """The amplitudes that a step changes as it is given."""
    return step.load.changes(step.name, mu)


def by_load(adjoint: Adjoint, name: str) -> float:
    """dJ/dmu of an amplitude that is given at all places where it is the same."""
    scene, system, total = adjoint.scene, adjoint.scene.model.system, adjoint.by_mu.get(name, 0.0)
    for place in adjoint.places:
        if name in place.rows or name in place.driven_amplitudes:
            continue
        u, mu = place.state.u, place.state.mu
        total += dot(system.comm, place.w, system.load(u, mu, name, constrained=False))
        total += place.energy and place.energy * system.potential(u, mu, name)
        total += sum(c * system.curvature(u, mu, i, name) for i, c in place.conjugates.items())
    if adjoint.directions:
        mu = adjoint.state.mu
        terms = [
            (slope, c * factor)
            for term, c in energies_along(scene, adjoint)
            for slope, factor in by_amplitude(scene.model, [term], name, mu)
        ]
        energy_rate = system.at_state(adjoint.state).evaluate(
            lambda: sum(c * term.energy() for term, c in terms)
        )
        total += system.comm.allreduce(energy_rate)
    return float(total)


def held_by_step(step: ProgrammeStep) -> list[str]:
    """The amplitudes whose conjugates a step holds as they are where it begins."""
    return [name for name, how in step.load.hold.items() if how != "load" and name != step.name]


Held: TypeAlias = Mapping[str, float | Conjugate]  # amplitude -> its conjugate


def with_gas(held_conjugates: Held) -> bool:
    """Whether a conjugate is that of a gas."""
    return any(callable(q) for q in held_conjugates.values())


def solved(
    scene: Scene, state: State, functional: Functional, held_conjugates: Held
) -> tuple[Vector, dict[str, float]]:
    """w of a number, and of the rows of the device; one factorisation and one solve."""
    system: System = scene.model.system
    device = (
        Device(system, held_conjugates, dict.fromkeys(held_conjugates, system.length))
        if held_conjugates
        else None
    )
    extended_state = device.enter(state) if device else state
    factors = (scene.newton.for_system(device) if device else scene.newton).factor_at(
        extended_state
    )
    slope = functional.by_u
    if device:
        slope = device.gradient(
            functional.by_u,
            {
                name: functional.by_mu.get(name, 0.0) + mixed(scene, state, functional, name)
                for name in held_conjugates
            },
        )
    w = factors.solve_transposed(-slope) if factors.skewed else factors.solve(-slope)
    return np.array(device.displacement(w) if device else w), device.rates(w) if device else {}


def mixed(scene: Scene, state: State, functional: Functional, name: str) -> float:
    """Return the derivative of the potentials and the reaction in J by an amplitude."""
    system = scene.model.system
    changes = sum(
        c * system.curvature(state.u, state.mu, i, name) for i, c in functional.potentials.items()
    )
    if functional.reaction is not None:
        changes += dot(
            system.comm,
            functional.reaction,
            system.load(state.u, state.mu, name, constrained=False),
        )
    return float(
        changes
        + (functional.energy and functional.energy * system.potential(state.u, state.mu, name))
    )


def held_at(
    scene: Scene, record: Record, state: State, hold: Mapping[str, str] | None = None
) -> dict[str, float | Conjugate]:
    """Amplitude -> its conjugate, of those that are unknown."""
    held_conjugates = dict[str, float | Conjugate]()
    step = scene.problem.programme[record.step - 1] if record.step else None
    if hold is None and step:
        held_conjugates |= held_conjugates_of_step(scene, step, state)
        if step.load.by_conjugate(at_target=record.label == "target"):
            held_conjugates[step.name] = -scene.model.system.potential(state.u, state.mu, step.name)
    for name, how in (hold or {}).items():
        if name not in state.mu or how not in ("load", "conjugate"):
            raise CaseError(
                f"hold: {name}: {how}: allowed are load and conjugate of {', '.join(state.mu)}"
            )
        if how == "conjugate":
            held_conjugates[name] = -scene.model.system.potential(state.u, state.mu, name)
    return held_conjugates


def energies_along(scene: Scene, adjoint: Adjoint) -> list[tuple[FormTerm, float]]:
    """The energies of the directions, and their factors."""
    model, energies = scene.model, list[tuple[FormTerm, float]]()
    for d in adjoint.directions:
        phi = d.phi if d.wave is not None else transfer(adjoint.scene, scene, d.phi)
        if d.stiffness:
            assert model.axisymmetric
            energies += [
                (term, d.stiffness) for term in model.waves.energies_along(phi, d.wave or 0)
            ]
        if d.inertia:
            energies.append((mass_along(model, phi, d.wave), d.inertia))
    return energies

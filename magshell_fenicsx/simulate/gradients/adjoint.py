"""Gradients of a result with respect to amplitudes, numbers of the case, and fields.

With R(x; p) = 0 for the state x under the loading device in use, and K = R_x,

    dJ/dp = J_p + w . R_p,    K^T w = -J_x

takes one solve for all parameters. For the amplitude at a fold w = -phi/(phi . R_mu) with the left
null vector phi. Where a wave phi is neutral that a meridian does not see, Q(phi; u, mu, p) = 0 for
its second variation, and

    dmu/dp = -(Q_p + w . R_p)/(Q_mu + w . R_mu),    K w = -Q_u.

Some results depend on several states, as those of vibrations and energy barriers. Then the
multipliers w are taken at each state: its place in the adjoint, an `AdjointState`. A further place
is the state where a step began: the step may hold a conjugate q = -Pi_mu of that state, which p
changes too, and loads stay at values that the step before has found, as a force at a depth.

Words and symbols:

- Pi is the potential energy. mu holds the amplitudes of a state, by name; an amplitude is a load
  parameter or a prescribed position. R = Pi_u, and R_mu is the load vector `system.load`.
- The conjugate q = -Pi_mu of an amplitude is the displacement on which the amplitude does work. A
  step that holds it makes the amplitude an unknown; the `Device` adds this unknown and its
  equation, a row. A gas gives q as a function of its amplitude.
- The device takes vectors over its unknowns apart: `displacement` gives the part of the
  displacement, `rates` that of the amplitudes, by name.
- A stage is a scene with the solver of one step; `enter` and `leave` convert states of the model to
  states of the step's system and back. Step 0 of a record is the part before all steps.
- A wave is a displacement with m waves around a meridian, in a space of its own.
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
from magshell_fenicsx.continuation.fold import Fold, residual_multiplier
from magshell_fenicsx.continuation.modes import nearest_to_zero
from magshell_fenicsx.continuation.system import State, System, Vector, dot
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.observables import Slope
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.parts.step_course import Gas
from magshell_fenicsx.quantities.mode_labels import waves_of_label
from magshell_fenicsx.shells.mass import mass_along
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.shells.model_base import ModelBase
from magshell_fenicsx.simulate.contact_control import refuse_touching_shells
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import Functional, Target, force_unit, functional, in_units
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage
from magshell_fenicsx.simulate.steps import (
    enclosed_gas,
    fold_at,
    held_conjugates_of_step,
    stage_of_record,
)
from magshell_fenicsx.simulate.transfer import transfer

CONJUGATE_TOLERANCE = (
    1e-5  # a conjugate is still the one that was held, relative to the larger of it and its unit
)

Begins: TypeAlias = Mapping[int, Record]  # number of a step -> the last record before it
NO_BEGINS: Begins = MappingProxyType({})


@dataclass(frozen=True)
class AdjointState:
    """A place of an adjoint: one state with the multipliers of its equations.

    Here w . R + c Pi + sum_i c_i dPi/dmu_i, a function of (u, mu; p), is differentiated by p.

    Attributes
    ----------
    state
        State of the model, with the displacement of moved supports.
    w
        Multiplier of the residual R; at supports that of a reaction, otherwise zero there.
    rows
        Amplitude that is unknown at this place, as its conjugate is held -> c_i of the equation
        (row of the device) that holds it.
    energy
        The factor c of Pi.
    potentials
        Amplitude -> the part of c_i that J itself contains.
    follows
        Amplitudes of `rows` whose conjugates the step holds as they were at its begin, which is a
        later place of the adjoint.
    steps
        How many steps of the programme led to this place, where a later step began; None: all steps
        of the record.
    driven_amplitudes
        Amplitudes that steps after this place have changed.
    gas
        Whether the conjugate of a gas is held here.
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
        """Amplitude -> c_i, the sum of its factors in `rows` and in `potentials`."""
        names = {**self.rows, **self.potentials}
        return {name: self.rows.get(name, 0.0) + self.potentials.get(name, 0.0) for name in names}


@dataclass(frozen=True)
class EnergyDirection:
    """A vector phi whose energies enter J, with the factors of these energies.

    The energies are those at the first place of an `Adjoint`; they are differentiated by p.

    Attributes
    ----------
    phi
        Unknowns on this rank: of the space of waves, or of the displacement.
    wave
        Number m of waves around a meridian; None: phi is a displacement.
    stiffness
        Factor of the second variation Q_m(phi) of a wave.
    inertia
        Factor of phi . M phi, with the mass matrix M.
    """

    phi: Vector
    wave: int | None
    stiffness: float = 0.0
    inertia: float = 0.0


@dataclass(frozen=True)
class Adjoint:
    """Adjoint of a result J, a number of a solved state.

    dJ/dp is J_p plus the derivatives of the equations at all places, times their multipliers.

    Attributes
    ----------
    places
        The first place is the state of J itself; the others are states where steps began.
    by_mu
        Amplitude -> dJ/dmu_i where J contains the amplitude itself.
    by_itself
        Function of a scene and a state with the value of J, for the explicit derivative J_p; None
        where energies and potentials of the places contain it.
    directions
        Vectors whose energies J contains.
    value
        J.
    gas
        Whether the conjugate of a gas is held, whose law has numbers of the case.
    free_amplitude
        The amplitude that J is, as at a fold; "" where J is another number.
    scale
        Name of the unit (`Quantity.scale`) in which `derivative` gives dJ/dp; "" without a unit.
    left_loads
        Amplitudes that act as loads with the value that an earlier step has left, and that did not
        control this step.
    slope
        The observable of a part that J is, with its own derivatives by a field; None for other
        results.
    forms
        Further energies in J that depend on the placement, and their factors.
    deflections
        Name of a point -> the factor in J of the deflection u . n0 there.
    contact_state
        State about which contact between shells is expanded into a polynomial at all places; None:
        at each place about its own state.
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
        """The state of J, that of the first place."""
        return self.places[0].state


def adjoint_of_instability(
    scene: Scene, record: Record, fold: Fold | None = None, begins: Begins = NO_BEGINS
) -> Adjoint:
    """Return the adjoint of the amplitude at a fold, or where a wave is neutral; collective.

    A fold takes no factorisation but its own; a wave takes one of the tangent and one of its second
    variation. A conjugate that the step holds takes one more where the step began.

    Parameters
    ----------
    record
        Row of the history at the instability.
    fold
        The located fold; None: it is located again from the record.
    begins
        Number of a step -> the last record before it.

    Raises
    ------
    CaseError
        If the record is another instability, or a conjugate that its step holds has no derivative.
    """
    if m := waves_of_label(record.mode):
        return _of_wave(scene, record, m)
    if record.label != "fold":
        raise CaseError(
            f"instability: this is a {record.label} {record.mode}".rstrip()
            + ": only of folds, and of waves"
        )
    fold = fold or fold_at(scene, record)
    adjoint = adjoint_of_fold(stage_of_record(scene, record), fold)
    gas = with_gas(held_at(scene, record, record.point.state))
    return with_begins(replace(adjoint, gas=gas), record, begins)


def adjoint_of_fold(stage: Stage, fold: Fold) -> Adjoint:
    """Return the adjoint of a fold's amplitude, while what its step holds keeps its values.

    Parameters
    ----------
    stage
        Stage of the step; the fold is one of its system. Collective.
    """
    # they consist of w and, where conjugates are held, multipliers of the rows
    multipliers = residual_multiplier(stage.newton.system, fold)
    rows = stage.device.rates(multipliers) if stage.device else {}
    w = stage.device.displacement(multipliers) if stage.device else multipliers
    place = AdjointState(stage.leave(fold.state), np.array(w), rows)
    return Adjoint(stage.scene, [place], value=fold.value, free_amplitude=fold.name)


def _of_wave(scene: Scene, record: Record, m: int) -> Adjoint:
    """Return the adjoint of the amplitude at which m waves around a meridian are neutral.

    Q(phi) is the second variation of the neutral wave phi, and dQ/dmu = Q_mu + w . R_mu its total
    derivative along the path, with the solution w of K w = -Q_u. Collective. The derivative of J is

        dJ/dp = -(Q_p + w . R_p)/(dQ/dmu).

    So in the adjoint the energy Q has the factor -1/(dQ/dmu), and w is multiplied by it.

    Raises
    ------
    CaseError
        If the step holds a conjugate, shells touch, or the meridian has a T-junction.
    """
    model = scene.model
    if record.step and scene.problem.programme[record.step - 1].load.hold:
        raise CaseError(f"instability: {record.mode}: not while a conjugate is held")
    assert model.axisymmetric
    if model.t_junction_terms:
        raise CaseError(
            f"instability: {record.mode}: has no gradient at a T-junction: take symmetry: half"
        )
    system, waves = model.system, model.waves
    state = model.system.with_moved_supports(record.point.state)
    refuse_touching_shells(scene, state, f"instability: {record.mode}")
    _, phi = nearest_to_zero(waves.factor_at(state, m))
    # Q(phi) with its derivatives by u and mu; w; and the total derivative dQ/dmu
    Q = variation(model, state, phi, m, [record.amplitude])
    w, _ = solved(scene, state, Q, held_conjugates={})
    rate = Q.by_mu[record.amplitude] + w @ system.load(state.u, state.mu, record.amplitude)
    # one Newton step towards Q = 0, as the record is there up to the tolerance of locating it
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
    """Return the second variation Q_m(phi) of a wave as a functional of the state; collective.

    Its derivatives are those by u and by the amplitudes `names`.

    Parameters
    ----------
    phi
        The wave, in the unknowns of the space of waves.
    m
        Number of waves around the meridian.
    """
    # energies of phi, which depend on the axisymmetric displacement u
    terms, system, mu = model.waves.energies_along(phi, m), model.system, state.mu
    # amplitude -> terms with factors, whose sum is the derivative of Q_m by it
    rates = {name: by_amplitude(model, terms, name, mu) for name in names}

    def functional_here() -> Functional:
        """Return the functional at the present displacement of the model."""
        by_u = np.zeros(system.size)
        for term in terms:
            term.add_residual(by_u, factor_of(term.amplitude, mu))
        value = sum((factor_of(term.amplitude, mu) * term.energy() for term in terms), 0.0)
        by_mu = {name: _weighted_energy(weighted_terms) for name, weighted_terms in rates.items()}
        return Functional(value, system.zero_at_supports(by_u), by_mu)

    return system.at_state(state).evaluate(functional_here)


def _weighted_energy(weighted_terms: Iterable[tuple[FormTerm, float]]) -> float:
    """Return the sum of energies times factors at the present displacement."""
    return sum((c * term.energy() for term, c in weighted_terms), 0.0)


def by_amplitude(
    model: ModelBase, terms: Sequence[FormTerm], name: str, mu: Mapping[str, float]
) -> list[tuple[FormTerm, float]]:
    """Return terms whose weighted sum is the derivative of a sum of energies by an amplitude.

    Parameters
    ----------
    terms
        Each stands in the sum with its own amplitude as a factor.
    name
        The amplitude mu_i. It may multiply a term, and may enter the form of a term as a constant.
    mu
        Values of all amplitudes.

    Returns
    -------
    list of (term, factor)
        By the product rule: each term that mu_i multiplies, with the factor 1; and for each form
        with mu_i as a constant the derivative of this form, with the amplitude of its term as the
        factor.
    """
    weighted_terms = [(term, 1.0) for term in terms if term.amplitude == name]
    constant = model.system.parameters[name].constant if name in model.system.parameters else None
    for term in terms:
        if constant in term.form.constants():
            derivative = FormTerm(
                f"{term.name} by {name}",
                derived(term.form, constant),
                model.u,
                KernelLog(),
                term.amplitude,
            )
            weighted_terms.append((derivative, factor_of(term.amplitude, mu)))
    return weighted_terms


def adjoint(
    scene: Scene,
    record: Record,
    of: str | Target,
    hold: Mapping[str, str] | None = None,
    begins: Begins = NO_BEGINS,
) -> Adjoint:
    """Return the adjoint of a result at a regular state; collective.

    It takes one factorisation and one solve, and one more of each for every begin of a step on
    which the result depends.

    Parameters
    ----------
    record
        Row of the history at whose state the result is read.
    of
        Column of path.csv, also in units; or a target shape, whose mean square distance is the
        result.
    hold
        Amplitude -> "load" or "conjugate": which of the two stays as p changes. None: the one that
        the record's step holds; the derivative then includes the begins of steps.
    begins
        Number of a step -> the last record before it.

    Raises
    ------
    CaseError
        If the scene has no such result, or a held conjugate has no derivative.
    """
    state = scene.model.system.with_moved_supports(record.point.state)
    column, scale = in_units(scene, state, of) if isinstance(of, str) else (of, "")
    result = functional(scene, state, column)
    held_conjugates = held_at(scene, record, state, hold)
    _refuse_prescribed_load(result, held_conjugates)
    # multipliers of the residual, and of the equations that hold conjugates
    w, rows = solved(scene, state, result, held_conjugates)
    # where J is c Pi, the energy of the place gives J_p
    by_itself = None if result.energy else lambda there, at: functional(there, at, column).value
    if result.reaction is not None:
        # The result is a force e . R, with unit motions e of supports. So e is a multiplier of R.
        # Of J_p there remains what comes from the unit of forces.
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


def _refuse_prescribed_load(result: Functional, held_conjugates: "Held") -> None:
    """Check that a result is no prescribed amplitude, which has no derivative by a parameter.

    What a sensor reads depends on amplitudes too, but is no amplitude itself.

    Raises
    ------
    CaseError
        With the name of the amplitude.
    """
    if prescribed_amplitudes := [
        name for name in result.by_mu if name not in held_conjugates and not result.slope
    ]:
        raise CaseError(
            f"{prescribed_amplitudes[0]}: is a load here, which no parameter changes: hold its "
            "conjugate"
        )


def with_begins(adjoint: Adjoint, record: Record, begins: Begins) -> Adjoint:
    """Return an adjoint with further places, the states where steps began; collective.

    J depends on the state where a step began in two ways: the step holds a conjugate at its value
    there; or a load keeps the value that was found there as an unknown. The loop goes back from
    step to step and solves for multipliers at each begin on which J depends.

    Parameters
    ----------
    adjoint
        Adjoint with the record's state as its first place; of a barrier, which is a difference, the
        begin of the step may follow as a second one.
    record
        The record of this state.
    begins
        Number of a step -> the last record before it.

    Raises
    ------
    CaseError
        If a held conjugate needs a step's begin that `begins` lacks, or the model changed in
        between.
    """
    scene, places, left_loads = adjoint.scene, list(adjoint.places), set[str]()
    # adjoint with the places at the present record alone; None: J does not depend on this record
    newest_adjoint: Adjoint | None = adjoint
    place_number = 0  # index in `places` of the place at the present record
    # dJ/dmu of loads that keep their value from an earlier step, which is not yet found
    loads = dict[str, float]()
    driven_amplitudes = set[str]()  # that the steps passed so far change
    while record.step:
        place = newest_adjoint.places[0] if newest_adjoint else None
        step = scene.problem.programme[record.step - 1]
        earlier_steps = scene.problem.programme[: record.step - 1]
        driven_amplitudes |= _driven_amplitudes(step, record.point.state.mu)
        held_conjugates = _rows_of_held(step, place) if place else {}
        begin = _begin_of_step(scene, record, begins, held_conjugates, loads)
        if begin is None:
            break
        state_before = scene.model.system.with_moved_supports(begin.point.state)
        held_before = held_at(scene, begin, state_before)
        if newest_adjoint:
            _add_kept_loads(loads, newest_adjoint, earlier_steps, driven_amplitudes)
        # how J depends on the begin: by conjugates that the step holds as they were there,
        potentials_at_begin, by_mu = dict[str, float](), dict[str, float]()
        if place:
            potentials_at_begin, by_mu = _terms_of_held(
                scene, step, place.state, state_before, held_conjugates
            )
        # and by loads that were unknowns there, as their conjugates were held
        for name in sorted(loads.keys() & held_before.keys()):
            by_mu[name] = by_mu.get(name, 0.0) + loads.pop(name)
            left_loads.add(name)
        if place and held_conjugates:
            places[place_number] = replace(place, follows=frozenset(held_conjugates))
        newest_adjoint = None
        if potentials_at_begin or any(by_mu.values()):
            place_at_begin = _place_at_begin(
                scene, state_before, held_before, potentials_at_begin, by_mu
            )
            place_at_begin = replace(
                place_at_begin, steps=begin.step, driven_amplitudes=frozenset(driven_amplitudes)
            )
            place_number = len(places)
            places.append(place_at_begin)
            newest_adjoint = Adjoint(scene, [place_at_begin])
        record = begin
    return replace(adjoint, places=places, left_loads=frozenset(left_loads))


def _add_kept_loads(
    loads: dict[str, float],
    newest_adjoint: Adjoint,
    earlier_steps: Sequence[ProgrammeStep],
    driven_amplitudes: set[str],
) -> None:
    """Add dJ/dmu at a place to `loads`, for loads that an earlier step has set, and no step since.

    Collective.

    Parameters
    ----------
    loads
        Amplitude -> dJ/dmu at the places so far.
    newest_adjoint
        Adjoint with the places at the present record alone, its state first.
    driven_amplitudes
        Amplitudes that later steps change.
    """
    place, *_ = newest_adjoint.places
    reused_amplitudes = _amplitudes_of_steps(earlier_steps) & place.state.mu.keys()
    # in the same order on all ranks
    for name in sorted(reused_amplitudes - place.rows.keys() - driven_amplitudes):
        loads[name] = loads.get(name, 0.0) + by_load(newest_adjoint, name)


def _begin_of_step(
    scene: Scene,
    record: Record,
    begins: Begins,
    held_conjugates: Mapping[str, float],
    loads: Mapping[str, float],
) -> Record | None:
    """Return the record before the step of a record; None if it is not known or in another model.

    Parameters
    ----------
    held_conjugates
        Amplitude whose conjugate the step holds and on which J depends -> its multiplier.
    loads
        Loads that keep a value of an earlier step on which J depends -> dJ/dmu.

    Raises
    ------
    CaseError
        If J depends on a begin that is not known, or in another model.
    """
    step = scene.problem.programme[record.step - 1]
    if record.step not in begins:
        if held_conjugates:
            raise CaseError(
                f"{step.key}.hold: {', '.join(held_conjugates)}: give begin, the record before "
                "this step"
            )
        return None
    begin = begins[record.step]
    if begin.scene and begin.scene is not scene:
        if held_conjugates or loads:
            names = ", ".join({*held_conjugates, *loads})
            raise CaseError(
                f"{names}: as they were before {step.key}, in another model: no gradient"
            )
        return None
    return begin


def _place_at_begin(
    scene: Scene,
    state: State,
    held_conjugates: "Held",
    potentials: Mapping[str, float],
    by_mu: Mapping[str, float],
) -> AdjointState:
    """Return the place of an adjoint where a step began, with its multipliers; collective.

    Parameters
    ----------
    held_conjugates
        Amplitude that is unknown there -> its conjugate.
    potentials, by_mu
        How J depends on the state there: amplitude -> factor of dPi/dmu, and amplitude -> dJ/dmu.
    """
    by_u = _sum_of_loads(scene, state, potentials)
    w, rows = solved(scene, state, Functional(0.0, by_u, by_mu, potentials), held_conjugates)
    return AdjointState(state, w, rows, potentials=potentials, gas=with_gas(held_conjugates))


def _sum_of_loads(scene: Scene, state: State, factors: Mapping[str, float]) -> Vector:
    """Return the sum of the load vectors at a state, each times the factor of its amplitude."""
    system, total = scene.model.system, np.zeros(scene.model.system.size)
    for name, factor in factors.items():
        total += factor * system.load(state.u, state.mu, name)
    return total


def _rows_of_held(step: ProgrammeStep, place: AdjointState) -> dict[str, float]:
    """Return amplitude whose conjugate a step holds -> nonzero multiplier of that equation."""
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
        Amplitude whose conjugate is held -> multiplier of the equation that holds it.

    Returns
    -------
    c, by_mu
        Amplitude -> factor c of dPi/dmu at the state before, and amplitude -> derivative by the
        amplitude at that state, which only the law of a gas has.

    Raises
    ------
    CaseError
        If a conjugate at the place differs from that of the state before.
    """
    system, c, by_mu = scene.model.system, dict[str, float](), dict[str, float]()
    for name, multiplier in rows.items():
        law = step.load.hold[name]
        if isinstance(law, Gas):
            gas = enclosed_gas(scene, law.gas, state_before)
            # derivatives of the gas's conjugate, by the conjugate and by the amplitude at the state
            # before
            potential_factor, rate_by_amplitude = gas.by_begin(state.mu[name])
            c[name], by_mu[name] = -multiplier * potential_factor, multiplier * rate_by_amplitude
            continue
        # the equation is Pi_mu(state) - Pi_mu(state before) = 0, if the step holds this value
        potential = system.potential(state.u, state.mu, name)
        change = potential - system.potential(state_before.u, state_before.mu, name)
        scale = max(abs(potential), abs(scene.conjugate_unit(name)))
        if abs(change) > CONJUGATE_TOLERANCE * scale:
            raise CaseError(
                f"{step.key}.hold.{name}: no gradient, as it is not held from the last point "
                "before the step"
            )
        c[name] = -multiplier
    return c, by_mu


def _driven_amplitudes(step: ProgrammeStep, mu: Mapping[str, float]) -> set[str]:
    """Return the amplitudes that a step changes along its course."""
    return {step.name} | (mu.keys() & step.load.alters)


def by_load(adjoint: Adjoint, name: str) -> float:
    """Return dJ/dmu of an amplitude that is prescribed, with one value at all places; collective.

    It is the sum over places of w . R_mu + c Pi_mu + sum_i c_i d2Pi/dmu_i dmu, and the derivative
    of the energies of directions. Places where the amplitude is an unknown, or where a later step
    still changes it, do not count.
    """
    scene, system, total = adjoint.scene, adjoint.scene.model.system, adjoint.by_mu.get(name, 0.0)
    for place in adjoint.places:
        if name in place.rows or name in place.driven_amplitudes:
            continue
        u, mu = place.state.u, place.state.mu
        total += dot(system.comm, place.w, system.load(u, mu, name, constrained=False))
        # c Pi_mu; without c the potential, an integral, is not computed
        total += place.energy and place.energy * system.potential(u, mu, name)
        total += sum(
            factor_in_J * system.curvature(u, mu, i, name)
            for i, factor_in_J in place.conjugates.items()
        )
    if adjoint.directions:
        mu = adjoint.state.mu
        terms = [
            (slope, factor_in_J * factor_of_derivative)
            for term, factor_in_J in energies_along(scene, adjoint)
            for slope, factor_of_derivative in by_amplitude(scene.model, [term], name, mu)
        ]
        energy_rate = system.at_state(adjoint.state).evaluate(
            lambda: sum(factor_in_J * term.energy() for term, factor_in_J in terms)
        )
        total += system.comm.allreduce(energy_rate)
    return float(total)


def held_by_step(step: ProgrammeStep) -> list[str]:
    """Return the amplitudes whose conjugates a step holds at the values where it begins."""
    return [name for name, law in step.load.hold.items() if law != "load" and name != step.name]


Held: TypeAlias = Mapping[str, float | Conjugate]  # amplitude -> its conjugate


def with_gas(held_conjugates: Held) -> bool:
    """Return whether a held conjugate is that of a gas, which is a function of its amplitude."""
    return any(callable(q) for q in held_conjugates.values())


def solved(
    scene: Scene, state: State, functional: Functional, held_conjugates: Held
) -> tuple[Vector, dict[str, float]]:
    """Return the multipliers of a functional J at a state; collective.

    They solve K^T x = -J_x with one factorisation. K is that of the device's system, whose unknowns
    are the displacement and the amplitudes with held conjugates.

    Parameters
    ----------
    functional
        J with its derivatives by u and by amplitudes.
    held_conjugates
        Amplitude that is unknown -> its conjugate; empty: all amplitudes are loads.

    Returns
    -------
    w, rows
        Multiplier of the residual, and amplitude -> multiplier of the equation that holds its
        conjugate.
    """
    system: System = scene.model.system
    device = (
        Device(system, held_conjugates, dict.fromkeys(held_conjugates, system.length))
        if held_conjugates
        else None
    )
    extended_state = device.enter(state) if device else state
    newton = scene.newton.for_system(device) if device else scene.newton
    factors = newton.factor_at(extended_state)
    # J_x: dJ/du, and dJ/dmu of the unknown amplitudes
    by_unknowns = functional.by_u
    if device:
        by_unknowns = device.gradient(
            functional.by_u,
            {
                name: functional.by_mu.get(name, 0.0) + mixed(scene, state, functional, name)
                for name in held_conjugates
            },
        )
    multipliers = (  # a symmetric K is its own transpose
        factors.solve_transposed(-by_unknowns) if factors.skewed else factors.solve(-by_unknowns)
    )
    # they consist of those of the residual and those of the rows
    w = np.array(device.displacement(multipliers) if device else multipliers)
    rows = device.rates(multipliers) if device else {}
    return w, rows


def mixed(scene: Scene, state: State, functional: Functional, name: str) -> float:
    """Return the derivative by an amplitude of those parts of J that contain Pi or derivatives.

    They are sum_i c_i dPi/dmu_i (`potentials`), e . R with unit motions e of supports (`reaction`),
    and c Pi (`energy`). Collective.
    """
    system = scene.model.system
    derivative = sum(
        potential_factor * system.curvature(state.u, state.mu, i, name)
        for i, potential_factor in functional.potentials.items()
    )
    if functional.reaction is not None:
        derivative += dot(
            system.comm,
            functional.reaction,
            system.load(state.u, state.mu, name, constrained=False),
        )
    return float(
        derivative
        + (functional.energy and functional.energy * system.potential(state.u, state.mu, name))
    )


def held_at(
    scene: Scene, record: Record, state: State, hold: Mapping[str, str] | None = None
) -> dict[str, float | Conjugate]:
    """Return amplitude -> its conjugate, for the amplitudes that are unknown at a record.

    Collective.

    Parameters
    ----------
    state
        The record's state, with the displacement of moved supports.
    hold
        Amplitude -> "load" or "conjugate", what is held; None: what the record's step holds.

    Raises
    ------
    CaseError
        If `hold` has another amplitude or word.
    """
    held_conjugates = dict[str, float | Conjugate]()
    step = scene.problem.programme[record.step - 1] if record.step else None
    if hold is None and step:
        held_conjugates |= held_conjugates_of_step(scene, step, state)
        # a step may prescribe the conjugate of its own amplitude, at least at its target
        if step.load.end.by_conjugate(at_target=record.label == "target"):
            held_conjugates[step.name] = -scene.model.system.potential(state.u, state.mu, step.name)
    for name, held_quantity in (hold or {}).items():
        if name not in state.mu or held_quantity not in ("load", "conjugate"):
            raise CaseError(
                f"hold: {name}: {held_quantity}: allowed are load and conjugate of "
                f"{', '.join(state.mu)}"
            )
        if held_quantity == "conjugate":
            held_conjugates[name] = -scene.model.system.potential(state.u, state.mu, name)
    return held_conjugates


def energies_along(scene: Scene, adjoint: Adjoint) -> list[tuple[FormTerm, float]]:
    """Return the energies of an adjoint's directions with their factors, on the forms of a scene.

    Directions that are displacements are transferred to the mesh of `scene`, which may be another
    scene than that of the adjoint.
    """
    model, energies = scene.model, list[tuple[FormTerm, float]]()
    for direction in adjoint.directions:
        phi = (
            direction.phi
            if direction.wave is not None
            else transfer(adjoint.scene, scene, direction.phi)
        )
        if direction.stiffness:
            assert model.axisymmetric
            energies += [
                (term, direction.stiffness)
                for term in model.waves.energies_along(phi, direction.wave or 0)
            ]
        if direction.inertia:
            energies.append((mass_along(model, phi, direction.wave), direction.inertia))
    return energies

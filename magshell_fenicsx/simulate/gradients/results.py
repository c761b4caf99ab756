"""Results that can be differentiated, by name: columns, shapes, vibrations and barriers at the end
of a history.

Before anything is built names alone say what a problem will have.

Words and symbols:

- J is a result; its `Adjoint` has what derivatives by any parameter p need: at several places,
  which are states, multipliers w of the residual R, factors of dPi/dmu_i and of Pi.
- Pi is the potential energy of the modelled part; the whole shell has `multiplicity` such parts.
- An amplitude mu is a load parameter by name, its conjugate q = -dPi/dmu the displacement on which
  it does work. A step may hold conjugates at their values where it begins.
- A history has the records of a run on which its end depends. `begins` has for each step the last
  record before it.
- The barrier is the work that a probing force does in a step at whose end it is zero again.
"""

from collections.abc import Iterable, Mapping, Sequence
from types import SimpleNamespace

import numpy as np

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.loads import forces
from magshell_fenicsx.parts.shell_sections import MeshSurface
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.quantities.registry import AMPLITUDES
from magshell_fenicsx.simulate.adapt.ending import History
from magshell_fenicsx.simulate.contact_control import stiffened_equilibrium
from magshell_fenicsx.simulate.gradients.adjoint import (
    NO_BEGINS,
    Adjoint,
    AdjointState,
    Begins,
    adjoint,
    held_at,
    solved,
    with_begins,
)
from magshell_fenicsx.simulate.gradients.fields import FIELDS, MASS
from magshell_fenicsx.simulate.gradients.instabilities import FOLDS, refuse_unitless
from magshell_fenicsx.simulate.gradients.vibration import (
    FIRST_FREQUENCIES,
    NAMES,
    adjoints_of_vibrations,
    frequency,
    refuse_no_vibration,
    vibration,
)
from magshell_fenicsx.simulate.perturbation import number_at_key
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import Functional, Target, barrier, differentiable
from magshell_fenicsx.simulate.scene import Scene

BARRIER = "barrier"


def refuse_no_barrier(problem: Problem) -> None:
    """Check that a case ends where a probing force is zero again.

    Raises
    ------
    CaseError
        If its last step has not `until: zero`.
    """
    if not problem.programme or problem.programme[-1].until != "zero":
        raise CaseError("barrier: needs a last step with until: zero")


def adjoint_of_barrier(
    scene: Scene, begin: Record | None, end: Record, begins: Begins = NO_BEGINS
) -> Adjoint:
    """Return the adjoint of the energy barrier between begin and end of the last step; collective.

    Both states are in equilibrium without the probing force, so that the first variation of Pi is
    zero, and p changes the energy explicitly alone:

        dJ/dp = Pi_p(end) - Pi_p(begin) + sum_i (mu_i(end) - mu_i(begin)) dq_i/dp,

    with the conjugates q_i that the step holds. As q_i are functions of the state at the begin, one
    solve there gives their derivatives.

    Parameters
    ----------
    begin, end
        Last record before the step, and its last record.
    begins
        Number of a step -> the last record before it.

    Raises
    ------
    CaseError
        If the last step does not end at zero force, or holds a gas.
    """
    refuse_no_barrier(scene.problem)
    if begin is None:
        raise CaseError("barrier: give the record before the last step")
    step, multiplicity = scene.problem.programme[-1], scene.model.multiplicity
    state_before, state_after = (
        scene.model.system.with_moved_supports(record.point.state) for record in (begin, end)
    )
    # mu_i(end) - mu_i(begin), of the whole shell
    held_conjugates, amplitude_changes = held_at(scene, end, state_after), dict[str, float]()
    for name, conjugate in held_conjugates.items():
        if callable(conjugate):
            raise CaseError(f"barrier: {name}: no gradient while a gas is held")
        amplitude_changes[name] = multiplicity * (state_after.mu[name] - state_before.mu[name])
    # how the conjugates depend on the begin, and on earlier begins
    at_begin = _place_before_barrier(scene, begin, state_before, amplitude_changes)
    adjoint_of_conjugates = with_begins(Adjoint(scene, [at_begin]), begin, begins)
    # Pi at both ends. Rows have the factor zero: they only say that the amplitudes are unknown.
    zero_vector, zero_rows = 0.0 * state_after.u, dict.fromkeys(held_conjugates, 0.0)
    places_at_ends = [
        AdjointState(state_after, zero_vector, zero_rows, energy=multiplicity),
        AdjointState(state_before, zero_vector, zero_rows, energy=-multiplicity),
    ]
    # further places for loads that keep values which earlier steps have found
    adjoint_with_begins = with_begins(Adjoint(scene, places_at_ends), end, begins)
    _, _, *further_places = adjoint_with_begins.places
    # `at_begin`, in `adjoint_of_conjugates`, replaces the second end: it has -Pi too
    places = [places_at_ends[0], *adjoint_of_conjugates.places, *further_places]
    value = barrier(scene, step, state_before, state_after)
    left_loads = adjoint_of_conjugates.left_loads | adjoint_with_begins.left_loads
    return Adjoint(scene, places, value=value, left_loads=left_loads)


def _place_before_barrier(
    scene: Scene, begin: Record, state: State, amplitude_changes: Mapping[str, float]
) -> AdjointState:
    """Return the place at the begin of a barrier, with -Pi and the conjugates there; collective.

    Its functional is -sum_i (mu_i(end) - mu_i(begin)) dPi/dmu_i, for the amplitudes whose
    conjugates the step holds.

    Parameters
    ----------
    begin, state
        Last record before the step, and its state with moved supports.
    amplitude_changes
        Amplitude -> its change in the step, times the multiplicity.
    """
    system = scene.model.system
    potential_factors = {
        name: -amplitude_change for name, amplitude_change in amplitude_changes.items()
    }
    w, rows = 0.0 * state.u, dict[str, float]()
    if amplitude_changes:
        by_u = -np.sum(
            [
                amplitude_change * system.load(state.u, state.mu, name)
                for name, amplitude_change in amplitude_changes.items()
            ],
            axis=0,
        )
        functional = Functional(0.0, by_u, potentials=potential_factors)
        w, rows = solved(scene, state, functional, held_at(scene, begin, state))
    return AdjointState(
        state,
        w,
        rows,
        energy=-scene.model.multiplicity,
        potentials=potential_factors,
        steps=begin.step,
    )


def refuse_no_result(
    scene: Scene, results: Iterable[str], key: str, *, extra_results: Sequence[str] = ()
) -> None:
    """Check, before a history is computed, that results of a scene have gradients.

    Parameters
    ----------
    results
        Names of results.
    key
        Key of the case that has them, for messages.
    extra_results
        Further names that are allowed.

    Raises
    ------
    CaseError
        With the names that are allowed.
    """
    start = scene.unloaded()
    columns = differentiable(scene, start)
    for result in results:
        try:
            refuse_unitless(scene, result)
            if result == BARRIER:
                refuse_no_barrier(scene.problem)
            elif NAMES.fullmatch(result):
                refuse_no_vibration(scene.problem, result)
            elif not any(result in names for names in (FOLDS, columns, start.mu)):
                allowed = ", ".join((*FOLDS, *columns, BARRIER, *FIRST_FREQUENCIES, *extra_results))
                raise CaseError(f"{result}: has no gradient here; allowed are {allowed}")
        except CaseError as e:
            raise CaseError(f"{key}: {e}") from None


def refuse_unknown_parameters(context: Context, names: Iterable[str], start: State) -> None:
    """Check that gradients can be taken by fields, amplitudes and numbers with these names.

    Parameters
    ----------
    names
        Each is a field of `FIELDS`, an amplitude, or the key of a number.
    start
        State whose amplitudes are allowed.

    Raises
    ------
    CaseError
        If the case does not have one of them.
    """
    try:
        for name in names:
            if name in FIELDS or name in start.mu:
                continue
            if name in AMPLITUDES:
                raise CaseError(
                    f"{name}: nothing in the case has this amplitude; it has {', '.join(start.mu)}"
                )
            number_at_key(context, name)
    except CaseError as e:
        raise CaseError(f"gradients.by: {e}") from None


def adjoint_at_end(
    scene: Scene, history: History, result: str | Target, hold: Mapping[str, str] | None = None
) -> tuple[str, Adjoint]:
    """Return the kind of a result at the end of a history, and its adjoint; collective.

    The kind of a vibration is the name of its mode in words; that of other results is "".

    Parameters
    ----------
    scene
        The first scene of the history; the end may be in another one.
    result
        Name of a column, a vibration or the barrier; or a target shape.
    hold
        Amplitude -> "load" or "conjugate", what stays as parameters change; None: as the last step
        holds.

    Raises
    ------
    CaseError
        If there is no such result.
    """
    assert history.end
    scene = history.end.scene or scene
    if result == BARRIER:
        return "", adjoint_of_barrier(scene, history.begin, history.end, history.begins)
    if isinstance(result, str) and NAMES.fullmatch(result):
        lowest, *_ = adjoints_of_vibrations(scene, history.end, result, hold, begins=history.begins)
        return lowest  # the vibration of this name, with its kind
    return "", adjoint(scene, history.end, result, hold, history.begins)


def vibration_at_end(scene: Scene, history: History, result: str) -> float | None:
    """Return a result such as "omega2_1" or "hertz_1" at the end of a history; collective.

    None if the name is not one of a vibration. Bodies that touch the shell are taken so stiff that
    their stiffness does not matter.

    Raises
    ------
    LostResult
        If the frequency cannot be computed.
    """
    if not NAMES.fullmatch(result):
        return None
    assert history.end
    scene = history.end.scene or scene
    state = stiffened_equilibrium(
        scene, scene.model.system.with_moved_supports(history.end.point.state)
    )
    return frequency(scene.problem, result, vibration(scene, state, result).value)


class NamesOnlyScene(Scene):
    """A stand-in for a scene, without mesh and model: it has names of amplitudes and results."""

    def __init__(self, problem: Problem) -> None:
        """Put names alone in place of a model: a value of 1 says that a name exists."""
        loads = problem.loads
        unit_load_sizes = {name: 1.0 for name, several in loads.dead.items() if forces(several)}
        # a mesh from a file has a pole of its own; other shapes have it among their points
        highest_point = ["pole"] if isinstance(problem.context.shell, MeshSurface) else []
        model = SimpleNamespace(
            loads=loads,
            normals=dict.fromkeys([*problem.points, *highest_point]),
            contacts=dict.fromkeys(contact.amplitude for contact in loads.contacts),
            load_size=unit_load_sizes,
            force_unit=1.0,
            system=SimpleNamespace(history={}),
        )
        vars(self).update(problem=problem, model=model)

    def unloaded(self) -> State:
        """Return all amplitudes with value zero, and a displacement without unknowns."""
        loads = self.problem.loads
        field = loads.magnetic
        field_amplitudes = field.amplitudes if field else ()
        names = [
            *(["pressure"] if loads.pressure else []),
            *field_amplitudes,
            *loads.forces,
            *loads.dead,
            *self._own_amplitudes,
        ]
        names += [*self.motions, *self.sources, *self.model.contacts]
        return State(np.zeros(0), dict.fromkeys(names, 0.0))

    def conjugate_unit(self, name: str) -> float:
        """Return 1: without a model there is no unit."""
        return 1.0


def refuse_unknown_results(problem: Problem, designed: Mapping[str, str]) -> None:
    """Check by name that results and parameters of gradients, and results of a design, exist.

    Parameters
    ----------
    designed
        Result of the design -> key of the case that names it.

    Raises
    ------
    CaseError
        If a name is unknown.
    """
    if not (problem.gradients or designed):
        return
    scene = NamesOnlyScene(problem)
    if requested := problem.gradients:
        refuse_no_result(scene, requested.of, "gradients.of")
        refuse_unknown_parameters(problem.context, requested.by, scene.unloaded())
    for result, key in designed.items():
        if result != MASS:
            refuse_no_result(scene, [result], key, extra_results=[MASS])

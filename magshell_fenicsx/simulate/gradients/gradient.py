"""Gradients of a result with respect to amplitudes, numbers of the case, and fields.

Words and symbols:

- J is the result, p the parameter. An `Adjoint` has J with the multipliers of its equations at
  several places, which are states: the state of J, and states where steps began.
- Pi is the potential energy, R = Pi_u the residual. An amplitude mu is a load parameter by name;
  its conjugate -dPi/dmu is the displacement on which it does work. Where a step holds a conjugate
  the amplitude is unknown, and the equation that holds it is a row with a multiplier.
- Contracted equations are equations times their multipliers, summed.
- A key is the path of a number in the case's file. h and R are thickness and reference length, E is
  Young's modulus.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import TypeAlias

import numpy as np

from magshell_fenicsx.assembly.field_gradient import FieldGradient
from magshell_fenicsx.assembly.terms import factor_of
from magshell_fenicsx.continuation.fold import Fold
from magshell_fenicsx.continuation.system import State, dot
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.problem.columns import sizes_of
from magshell_fenicsx.simulate.adapt.ending import History
from magshell_fenicsx.simulate.contact_control import contact_expanded_about
from magshell_fenicsx.simulate.gradients.adjoint import (
    Adjoint,
    AdjointState,
    adjoint_of_instability,
    by_load,
    energies_along,
)
from magshell_fenicsx.simulate.gradients.fields import FIELDS, by_field
from magshell_fenicsx.simulate.gradients.instabilities import FOLDS, as_asked
from magshell_fenicsx.simulate.gradients.results import adjoint_at_end
from magshell_fenicsx.simulate.perturbation import (
    expand_contact,
    number_at_key,
    perturbed_scene,
    scale_at_key,
    state_with_new_loads,
    target_ratios,
)
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import Target
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.scene_cache import SceneCache
from magshell_fenicsx.simulate.sensitivity import sensitivities
from magshell_fenicsx.simulate.steps import fold_at
from magshell_fenicsx.simulate.transfer import transfer

STEP = 1e-4  # of what a change of a number is small against
# of a difference: what it changes by over a step where one of second order is exact to some 1e-8
STRAIGHT = 1e-3
BOTH, FOUR = (-1, 1), (-2, -1, 1, 2)  # places of differences of second and fourth order, in steps
ONE_SIDE = ((0, 1, 2, 3, 4), (0, -1, -2, -3, -4))  # where numbers on the other side are not allowed
Gradient: TypeAlias = float | FieldGradient


def by_amplitude(adjoint: Adjoint, name: str) -> float:
    """Return the derivative of a result by an amplitude that is prescribed.

    Raises
    ------
    CaseError
        If the amplitude is unknown, as its conjugate is held, or is left by an earlier step.
    """
    # at no place of the adjoint is it a load that stays up to the result
    if name in adjoint.places[0].follows or all(
        name in {*place.rows, *place.driven_amplitudes} for place in adjoint.places
    ):
        raise CaseError(f"{name}: is unknown here, as its conjugate is held")
    if name in adjoint.left_loads:
        raise CaseError(
            f"{name}: is a load here as an earlier step has left it, which was not controlled by it"
        )
    return by_load(adjoint, name)


def by_number(adjoint: Adjoint, key: str, scenes: SceneCache | None = None) -> float:
    """Return the derivative of a result J by a number of the case, without a solve; collective.

    It is a difference of the sum of J and the contracted equations between two scenes on the same
    mesh. The states stay, but for loads that the number changes.

    Parameters
    ----------
    adjoint
        J with the multipliers of its equations.
    key
        Key of the number in the case.
    scenes
        Scenes on the mesh of the adjoint's scene, for further results; None: new ones.

    Raises
    ------
    CaseError
        If the number has no derivative here.
    """
    scene, scene_cache = adjoint.scene, scenes or SceneCache(base=adjoint.scene)
    value = number_at_key(scene.problem.context, key)
    _refuse_shell_number(adjoint, key)

    def contracted(p: float) -> float:
        """Return J plus equations times multipliers, at fixed states, for a value of the number."""
        other = scene if p == value else perturbed_scene(scene_cache, key, p)
        return _contracted_equations(adjoint, other)

    return _slope(contracted, value, scale_at_key(scene.problem.context, key))


def _refuse_shell_number(adjoint: Adjoint, key: str) -> None:
    """Check that a number of the shell, by its key, changes no equation of a held conjugate.

    Raises
    ------
    CaseError
        If it changes the law of a gas, or the first contact with a body, on which J depends.
    """
    if not key.startswith("shell."):
        return
    if adjoint.gas or any(place.gas for place in adjoint.places):
        raise CaseError(f"{key}: has no derivative while a gas is held, whose law depends on it")
    if adjoint.scene.model.contacts and any(place.follows for place in adjoint.places):
        raise CaseError(
            f"{key}: has no derivative where a conjugate is held beside a body: the first contact "
            "shifts it"
        )


def _contracted_equations(adjoint: Adjoint, other: Scene) -> float:
    """Return J plus equations times multipliers, at fixed states, in another scene; collective.

    `other` has the mesh of the adjoint's scene and may be this scene itself.
    """
    scene, system = adjoint.scene, other.model.system
    first_place, contracted_sum = adjoint.places[0], 0.0
    # in reverse: `state` after the loop is that of the first place, the state of J
    for place in reversed(adjoint.places):
        # the state in the other scene, with the loads there
        own_amplitudes = {  # results and unknowns, which p does not scale
            *place.rows,
            *adjoint.left_loads,
            *([adjoint.free_amplitude] if place.steps is None else []),
        }
        state = state_with_new_loads(
            scene,
            other,
            _transferred_state(scene, other, place.state),
            dependent_names=own_amplitudes,
            steps=place.steps,
        )
        state = system.with_moved_supports(state)
        if other is not scene:  # places in contact stay
            expand_contact(scene, other, place.state)
        residual = _residual_at(scene, other, place, state)
        # at the first place `by_itself` gives J, if there is this function
        is_by_itself = adjoint.by_itself and place is first_place
        own_value = 0.0 if is_by_itself else _own_value(other, place, state)
        contracted_sum += residual + own_value
    if adjoint.by_itself:
        contracted_sum += adjoint.by_itself(other, state)
    # energies along directions, as of modes
    terms = [
        (factor * factor_of(term.amplitude, state.mu), term)
        for term, factor in energies_along(other, adjoint)
    ]
    energies = system.at_state(state).evaluate(
        lambda: sum(factor * term.energy() for factor, term in terms)
    )
    return float(contracted_sum + system.comm.allreduce(energies))


def _slope(f: Callable[[float], float], value: float, size: float) -> float:
    """Return df/dp at a value, by a difference between values that are allowed.

    A difference of second order, from one value at each side, is taken where three values are
    nearly on a line. Otherwise the difference is of fourth order. Where values on one side are not
    allowed, all are taken from the other side.

    The reason is the error of a second-order difference, which goes as the third derivative. At
    fixed displacements this may be large beside the derivative: a natural stretch e changes the
    energy by about E h R^2 e^2, and the derivative may be 1e-4 of that.

    Parameters
    ----------
    f
        Function of the number; it raises `CaseError` at a value that is not allowed.
    size
        Scale of the number: the step is `STEP` times it.

    Raises
    ------
    CaseError
        If no difference has allowed values alone.
    """
    step, refusals, value_at = STEP * size, list[CaseError](), cache(f)

    def difference(nodes: Sequence[int]) -> float:
        """Return the difference quotient with values at multiples `nodes` of the step."""
        values = [value_at(value + node * step) for node in nodes]
        powers = np.vander(np.array(nodes, dtype=float), increasing=True).T
        # with sum of weights times node^k = 1 for k = 1, else 0: exact of polynomials
        weights = np.linalg.solve(powers, np.eye(len(nodes))[1])
        return float(weights @ values) / step

    try:
        low, high = (value_at(value + node * step) for node in BOTH)
        is_straight = abs(low - 2 * value_at(value) + high) <= STRAIGHT * abs(high - low)
        if is_straight:
            return difference(BOTH)
    except CaseError:  # a value that is not allowed; one side may be
        pass
    for nodes in (FOUR, *ONE_SIDE):
        try:
            return difference(nodes)
        except CaseError as e:
            refusals.append(e)
    raise refusals[0]


def size_by_number(adjoint: Adjoint, key: str) -> float:
    """Return the derivative of the unit of a result by a number of the case.

    For example, one p_c is more pascals on a thicker shell. It is 0 for a result without a unit.
    """
    if not adjoint.scale:
        return 0.0
    problem = adjoint.scene.problem
    value, scale = number_at_key(problem.context, key), scale_at_key(problem.context, key)
    return _slope(
        lambda p: sizes_of(problem.with_values({key: p}).context).by_unit[adjoint.scale],
        value,
        scale,
    )


def _transferred_state(scene: Scene, other: Scene, state: State) -> State:
    """Return a state with its displacement in the unknowns of another scene on the same mesh."""
    return State(transfer(scene, other, state.u), state.mu)


def _residual_at(scene: Scene, other: Scene, place: AdjointState, state: State) -> float:
    """Return residual and rows of a place in another scene, times multipliers; collective.

    A held conjugate stays the same number in its unit, which may differ between the scenes.

    Parameters
    ----------
    scene, other
        Scene of the adjoint, and the other scene.
    place
        State in `scene` with its multipliers.
    state
        The same state in the unknowns and with the loads of `other`.
    """
    system, own_state = other.model.system, place.state
    contracted_sum = dot(
        system.comm, transfer(scene, other, place.w), system.forces(state.u, state.mu)
    )
    # amplitude -> target of the other scene over that of the first, of prescribed conjugates
    targets = target_ratios(scene, other, "conjugate", place.steps)
    for name, multiplier in place.rows.items():
        held_value = -scene.model.system.potential(own_state.u, own_state.mu, name)
        ratio_of_units = (
            other.conjugate_unit(name) / scene.conjugate_unit(name) * targets.get(name, 1.0)
        )
        # a value that follows from the begin of the step changes with that place
        unit_ratio = 1.0 if name in place.follows else ratio_of_units
        # the row: Pi_mu + q = 0
        contracted_sum += multiplier * (
            system.potential(state.u, state.mu, name) + unit_ratio * held_value
        )
    return float(contracted_sum)


def _own_value(other: Scene, place: AdjointState, state: State) -> float:
    """Return the part of J that a place contains: sum_i c_i dPi/dmu_i + c Pi; collective.

    Parameters
    ----------
    other, state
        A scene, and the state of the place in its unknowns.
    """
    system = other.model.system
    value = sum(
        potential_factor * system.potential(state.u, state.mu, name)
        for name, potential_factor in place.potentials.items()
    )
    if place.energy:
        # Pi is that of the modelled part, `energies` those of the whole shell
        value += place.energy / other.model.multiplicity * sum(other.energies(state).values())
    return float(value)


def gradient(
    scene: Scene,
    record: Record,
    *,
    of: str | Target,
    by: str | Sequence[str] | None = None,
    fold: Fold | None = None,
    hold: Mapping[str, str] | None = None,
    begin: Record | None = None,
) -> dict[str, Gradient]:
    """Return the derivatives of a result at a record; collective.

    Parameters
    ----------
    of
        "instability": the amplitude of a record that is a fold or, on a meridian, a neutral wave
        ("knockdown" and "critical_field" are names of it, also "buckling_pressure_Pa" and
        "critical_field_mT"); a column of path.csv (named points, w_over_h, reactions,
        volume_change, the load where it is not held, energy; those with units too); "omega2_1",
        "omega2_2", ...: the squared natural frequencies, ascending, and "hertz_1", ...; "barrier":
        the energy barrier of a last step with until: zero; or a function from undeformed places (n,
        3) over R to wanted ones: the mean square distance to them.
    by
        One of these, or several: amplitudes ("lambda_m", ...), keys of the case with a number
        ("magnetic.remanent.polar"), and fields: "remanence" (vectors over |B^r|, of a meridian
        along e_rho, e_theta, e_z), "magnitude" (a factor of it), "thickness" (over h), "curvature"
        (the natural one over 1/R in the case's frame: 11, 22, 12) and "deviation" (w0 over R, along
        the outward normal of the perfect shell). None: of the amplitude of a fold ("instability"),
        all that `sensitivities` has: by every other amplitude, by the numbers of imperfections, and
        by a relative change of each patch's remanence.
    fold
        The fold at the record with its null vector, of `fold_at`, if it is known.
    hold
        Amplitude -> "load" or "conjugate": what stays while p changes. By default what the record's
        step holds, and the displacement where that is its control.
    begin
        Of a barrier, and of a step that holds conjugates: the last record before the step.

    Returns
    -------
    Numbers, and `FieldGradient` of fields.

    Raises
    ------
    CaseError
        If the scene has no such result or parameter, or `by` is left out of a result that is no
        "instability".
    ValueError
        If `by` is left out at a record that is no fold.
    FoldLost
        If Newton's method for the fold fails.
    """
    Scene.refuse_other_arguments("gradient", scene, [record])
    if by is None:
        if of != "instability":
            raise CaseError(
                f"gradient: by: is left out, which needs of='instability', not {of!r}: give an "
                'amplitude, the key of a number or a field, such as "shell.poisson_ratio"'
            )
        return dict(sensitivities(scene, fold or fold_at(scene, record), record))
    fold_amplitude = FOLDS.get(of) if isinstance(of, str) else None
    if fold_amplitude and record.amplitude != fold_amplitude:
        raise CaseError(
            f"{of}: the record is of {record.amplitude or 'the start'}, not of {fold_amplitude}"
        )
    begins = {record.step: begin} if begin else {}  # of this step alone
    if of == "instability" or fold_amplitude:
        adjoint = as_asked(adjoint_of_instability(scene, record, fold, begins), of)
    else:
        history = History(last=record, end=record, begin=begin, begins=begins)
        _, adjoint = adjoint_at_end(scene, history, of, hold)
    return {name: derivative(adjoint, name) for name in ([by] if isinstance(by, str) else by)}


def derivative(adjoint: Adjoint, by: str, scenes: SceneCache | None = None) -> Gradient:
    """Return the derivative of a result by one parameter, in the unit of the result; collective.

    A number of the case changes the unit of the result too, which adds a second part.

    Parameters
    ----------
    by
        Amplitude, as "force"; key of a number in the case; or field: "remanence", "magnitude",
        "thickness", "curvature" or "deviation".
    scenes
        Scenes on the mesh of the adjoint's scene, for further results; None: new ones.
    """
    unit_size = adjoint.size
    with contact_expanded_about(adjoint.scene, adjoint.contact_state):
        if by in FIELDS:
            field_gradient = by_field(adjoint, by)
            return replace(field_gradient, forces=unit_size * field_gradient.forces)
        if by in adjoint.state.mu:
            return unit_size * by_amplitude(adjoint, by)
        # of J times the size of its unit, by the product rule
        return unit_size * by_number(adjoint, by, scenes) + adjoint.value * size_by_number(
            adjoint, by
        )

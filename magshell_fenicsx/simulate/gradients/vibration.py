"""Squared frequencies of small vibrations, and what their derivatives are contracted with.

With K phi = lambda M phi, phi . M phi = 1, about the state x with R(x; p) = 0,

    dlambda/dp = phi . K_p phi - lambda phi . M_p phi + w . R_p,    R_x^T w = -(phi . K phi)_x.

phi . K phi is the second derivative of the energy along phi. Its derivatives are differences of the
residual's between u + e phi and u - e phi, which needs no third derivative of the energy:

    (phi . K phi)_p = phi . (R_p(u + e phi) - R_p(u - e phi))/(2 e),

here of fourth order, and those by u are differences of K phi. Membrane forces are cubic in u:
without bending they are exact. Of waves around a meridian the second variation is a form of its
own.

Words and symbols:

- K is the tangent matrix, M the mass matrix, phi a mode, lambda = omega^2 in the unit E/(rho R^2)
  with Young's modulus E, density rho and reference length R. h is the thickness.
- J is the result: lambda ("omega2_1", with the number of the mode), or the frequency in hertz.
- The label of a mode is "" if it has the symmetry of the model; otherwise it names waves ("m = 3"),
  torsion, or another symmetry.
- A place of an `Adjoint` is a state with the multiplier w of its residual. Here each mode adds
  places at u + e phi.
- The conjugate of an amplitude (a load parameter) is the displacement on which it does work; where
  it is held the amplitude is unknown.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from magshell_fenicsx.assembly.evaluation import DIFFERENCE_WEIGHTS
from magshell_fenicsx.continuation.modes import ModesNotFound
from magshell_fenicsx.continuation.system import State, dot, symmetric_part
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.quantities.mode_labels import waves_of_label
from magshell_fenicsx.shells.modes import ShellMode, ShellModes, mode_space
from magshell_fenicsx.simulate.contact_control import (
    contact_expanded_about,
    refuse_touching_shells,
    stiffened_equilibrium,
    touching_bodies,
    touching_shells,
)
from magshell_fenicsx.simulate.gradients.adjoint import (
    NO_BEGINS,
    Adjoint,
    AdjointState,
    Begins,
    EnergyDirection,
    Held,
    held_at,
    solved,
    variation,
    with_begins,
    with_gas,
)
from magshell_fenicsx.simulate.gradients.instabilities import LostResult
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import Functional
from magshell_fenicsx.simulate.scene import Scene

FIRST_FREQUENCIES = ("omega2_1", "hertz_1")
NAMES = re.compile(r"(omega2|hertz)_([1-9]\d?)")
# e phi at most, over h; where shells touch
MAX_DIFFERENCE_STEP, MAX_DIFFERENCE_STEP_IN_CONTACT = 0.3, 0.003
DEGENERACY_TOLERANCE = (
    1e-4  # squared frequencies closer than this, relative, are one multiple frequency
)


@dataclass(frozen=True)
class Vibration:
    """A natural frequency, or the mean of several frequencies that are as good as equal.

    Attributes
    ----------
    modes
        Modes of these frequencies.
    numbers
        Their numbers among all vibrations, from 1, ascending.
    """

    modes: tuple[ShellMode, ...]
    numbers: tuple[int, ...]

    @property
    def value(self) -> float:
        """omega^2 rho R^2/E, the mean over the modes."""
        return float(np.mean([mode.eigenvalue for mode in self.modes]))

    @property
    def kind(self) -> str:
        """Name of the mode, or of the group of equal frequencies, in words."""
        if len(self.modes) > 1:
            numbers = ", ".join(map(str, self.numbers))
            return f"mean of the modes {numbers}, whose frequencies are equal"
        return self.modes[0].label


def refuse_no_vibration(problem: Problem, result: str) -> None:
    """Check that a case has the unit of a frequency in hertz, if one is asked for.

    Parameters
    ----------
    result
        Name such as "omega2_1" or "hertz_1".

    Raises
    ------
    CaseError
        If the frequency is in hertz and the case has no density.
    """
    if result.startswith("hertz") and problem.time_unit is None:
        raise CaseError(
            f"{result}: needs shell.density and shell.youngs_modulus; without them take "
            f"omega2{result[5:]}"
        )


def vibration(scene: Scene, state: State, result: str) -> Vibration:
    """Return the vibration of a name such as "omega2_1" at a state; collective.

    Modes with equal frequencies are one vibration. The model's tangent is overwritten.

    Raises
    ------
    LostResult
        If the model is a sector, or the vibration cannot be computed.
    """
    first, *_ = vibrations(scene, state, result)
    return first


def vibrations(
    scene: Scene, state: State, result: str, *, max_ratio: float = 1.0, max_count: int = 1
) -> list[Vibration]:
    """Return the vibration of a name such as "omega2_1" and the next higher ones; collective.

    Modes with equal frequencies are one vibration. The model's tangent is overwritten.

    Parameters
    ----------
    max_ratio
        Largest eigenvalue of a next one, over that of the first; 1: the first one alone.
    max_count
        Largest number of vibrations.

    Raises
    ------
    LostResult
        If the model is a sector, or the vibration cannot be computed.
    """
    if mode_space(scene.model).model is not scene.model:
        raise LostResult(
            f"{result}: a sector has the modes of its own planes alone: take symmetry: half or none"
        )
    number = int(result.partition("_")[2])  # of the first vibration that is asked for
    # modes are computed again with one more, until the last group is certain to be complete
    count = number + max_count
    while True:
        count += 1
        try:
            modes = ShellModes(scene.model).vibrations(
                state, count, allows_rigid_motion=scene.allows_rigid_motion
            )
        except ModesNotFound as e:
            raise LostResult(f"no frequencies here: {e}") from None
        if number > len(modes):
            raise LostResult(f"the model has {len(modes)} vibrations")
        # the group with that number, and higher ones
        groups = [group for group in _groups(modes) if group.numbers[-1] >= number]
        ratio = max(max_ratio, 1 + DEGENERACY_TOLERANCE)
        groups_within_ratio = [group for group in groups if group.value <= ratio * groups[0].value][
            :max_count
        ]
        # complete: the highest mode is not in the last group, or the model has no more modes
        if groups_within_ratio[-1].numbers[-1] < len(modes) or len(modes) < count:
            return groups_within_ratio


def _groups(modes: Sequence[ShellMode]) -> list[Vibration]:
    """Return vibrations, each of all modes with one label and equal frequencies; ascending.

    Parameters
    ----------
    modes
        Modes with ascending frequencies.
    """
    groups = list[list[int]]()
    for i, mode in enumerate(modes):
        # compared with the lowest mode of each group, the nearest group last
        matching_groups = [group for group in groups if _is_degenerate(modes[group[0]], mode)]
        if matching_groups:
            matching_groups[-1].append(i)
        else:
            groups.append([i])
    vibrations = list[Vibration]()
    for group in groups:
        modes_of_group = tuple(modes[i] for i in group)
        vibrations.append(Vibration(modes_of_group, tuple(i + 1 for i in group)))
    return vibrations


def _is_degenerate(a: ShellMode, b: ShellMode) -> bool:
    """Return whether two modes have one label, and frequencies that are as good as equal."""
    return a.label == b.label and abs(a.eigenvalue - b.eigenvalue) <= DEGENERACY_TOLERANCE * abs(
        b.eigenvalue
    )


def frequency(problem: Problem, result: str, omega2: float) -> float:
    """Return the result of a name: omega^2 rho R^2/E itself, or the frequency in hertz.

    Parameters
    ----------
    omega2
        omega^2 rho R^2/E.

    Raises
    ------
    LostResult
        If a frequency in hertz is asked for at an unstable state, which does not vibrate.
    """
    if result.startswith("omega2"):
        return omega2
    if omega2 <= 0:
        raise LostResult(f"the shell is unstable and does not vibrate (omega2 = {omega2:.6g})")
    return math.sqrt(omega2) / (2 * math.pi * (problem.time_unit or 1.0))


def adjoints_of_vibrations(
    scene: Scene,
    record: Record,
    result: str,
    hold: Mapping[str, str] | None = None,
    *,
    max_ratio: float = 1.0,
    max_count: int = 1,
    begins: Begins = NO_BEGINS,
) -> list[tuple[str, Adjoint]]:
    """Return the kinds of vibrations about a regular state, with their adjoints; collective.

    Each takes one factorisation more.

    Parameters
    ----------
    record
        Row of the history at the state.
    result
        Name such as "omega2_1".
    hold
        Amplitude -> "load" or "conjugate", what stays as parameters change; None: what the record's
        step holds, and then the begins of steps count too.
    max_ratio, max_count
        Largest eigenvalue of a higher vibration, over that of the first; and largest number of
        vibrations.
    begins
        Number of a step -> the last record before it.

    Returns
    -------
    list of (kind, adjoint)
        Words for the vibration, the label of its mode or of a group of equal frequencies, and the
        adjoint of its result.

    Raises
    ------
    LostResult
        If the state has no such vibration.
    CaseError
        If the mode leaves the symmetry of the model, a body touches the shell, or the mode is a
        wave where shells touch.
    """
    # the equilibrium with bodies so stiff that their stiffness does not matter
    state = stiffened_equilibrium(scene, scene.model.system.with_moved_supports(record.point.state))
    if bodies := touching_bodies(scene, state):
        raise CaseError(
            f"{result}: has no gradient where a body touches the shell ({bodies[0].body}): where "
            "it touches changes within "
            "far less than a difference takes; take differences of runs"
        )
    held_conjugates = held_at(scene, record, state, hold)
    found = vibrations(scene, state, result, max_ratio=max_ratio, max_count=max_count)
    adjoints_by_kind = [
        (each.kind, _adjoint(scene, state, result, each, held_conjugates)) for each in found
    ]
    if hold is not None:
        return adjoints_by_kind
    return [(kind, with_begins(adjoint, record, begins)) for kind, adjoint in adjoints_by_kind]


def _adjoint(
    scene: Scene, state: State, result: str, vibration: Vibration, held_conjugates: Held
) -> Adjoint:
    """Return the adjoint of one vibration; collective.

    Each mode adds displaced states u + e phi, as places with multipliers along phi. The sum of
    their residuals times multipliers is the difference quotient of phi . K phi, so that its
    derivative by p follows as from any other place.

    Parameters
    ----------
    held_conjugates
        Amplitude that is unknown -> its conjugate.
    """
    value = frequency(scene.problem, result, vibration.value)
    # dJ/dlambda; hertz go as its square root
    rate = 1.0 if result.startswith("omega2") else value / (2 * vibration.value)
    # factor of the eigenvalue of each mode in J, which has their mean
    factor = rate / len(vibration.modes)
    # where shells touch, differences need fixed places in contact: an expansion about the state
    shells_touch = bool(touching_shells(scene, state))
    contact_state = state if shells_touch else None
    if contact_state and waves_of_label(vibration.modes[0].label) is not None:
        refuse_touching_shells(scene, state, f"{result}: {vibration.modes[0].label}")
    largest_step = MAX_DIFFERENCE_STEP_IN_CONTACT if contact_state else MAX_DIFFERENCE_STEP
    # phi . K phi of each mode, with derivatives by u and by unknown amplitudes; and those of J
    with contact_expanded_about(scene, contact_state):
        slopes = [
            _slopes(scene, state, mode, list(held_conjugates), largest_step)
            for mode in vibration.modes
        ]
    by_u = np.sum([slope.by_u for slope in slopes], axis=0) * factor
    by_mu = {name: factor * _total_rate(slopes, name) for name in held_conjugates}
    # without loads, as where rigid motions are allowed, p does not displace the shell: w is zero
    w, rows = (
        (0.0 * by_u, {})
        if scene.allows_rigid_motion
        else solved(scene, state, Functional(value, by_u, by_mu), held_conjugates)
    )
    places, directions = [AdjointState(state, w, rows)], list[EnergyDirection]()
    for mode in vibration.modes:
        # in J there is factor (phi . K phi - lambda phi . M phi)
        inertia = -factor * mode.eigenvalue
        if (m := waves_of_label(mode.label)) is not None:  # its energies are forms of their own
            directions.append(EnergyDirection(mode.vector, m, stiffness=factor, inertia=inertia))
            continue
        places += _displaced_places(scene, state, mode, factor, rows, largest_step)
        directions.append(EnergyDirection(mode.vector, None, inertia=inertia))
    # at a fixed eigenvalue J depends on the case by the unit of time alone
    by_itself = lambda there, _: frequency(there.problem, result, vibration.value)  # noqa: E731
    gas = with_gas(held_conjugates)
    return Adjoint(
        scene,
        places,
        by_itself=by_itself,
        directions=directions,
        value=value,
        gas=gas,
        contact_state=contact_state,
    )


def _displaced_places(
    scene: Scene,
    state: State,
    mode: ShellMode,
    factor: float,
    unknown_names: Iterable[str],
    largest_step: float,
) -> list[AdjointState]:
    """Return the states u + e phi of a mode, with multipliers that are multiples of phi.

    The sum of residuals times multipliers is `factor` times the difference quotient of phi . K phi.

    Parameters
    ----------
    unknown_names
        Amplitudes that are unknown; their rows have the factor zero.
    largest_step
        Largest displacement e phi of a difference, over h.
    """
    step = scene.model.system.step_along(mode.vector, largest_step)
    places = []
    for offset, weight in DIFFERENCE_WEIGHTS.items():
        displaced_state = State(state.u + offset * step * mode.vector, state.mu)
        w = factor * weight / step * mode.vector
        places.append(AdjointState(displaced_state, w, dict.fromkeys(unknown_names, 0.0)))
    return places


def _total_rate(slopes: Iterable[Functional], name: str) -> float:
    """Return the sum of the derivatives of functionals by an amplitude."""
    return sum(slope.by_mu[name] for slope in slopes)


def _slopes(
    scene: Scene, state: State, mode: ShellMode, held_names: list[str], largest_step: float
) -> Functional:
    """Return phi . K phi of a mode, with derivatives by u and by unknown amplitudes; collective.

    They are differences of K phi and of the load vectors between states u + e phi.

    Parameters
    ----------
    held_names
        Amplitudes that are unknown.
    largest_step
        Largest displacement e phi of a difference, over h.

    Raises
    ------
    CaseError
        If the mode does not have the model's symmetry, and is no wave.
    """
    system, phi = scene.model.system, mode.vector
    if (m := waves_of_label(mode.label)) is not None:
        assert scene.model.axisymmetric
        return variation(scene.model, state, phi, m, held_names)
    if mode.label:
        raise CaseError(
            f"{mode.label}: the vibration leaves the symmetry of the model: take symmetry: none"
        )
    step = system.step_along(phi, largest_step)
    by_u, by_mu = np.zeros(system.size), dict.fromkeys(held_names, 0.0)
    # a state at each multiple (offset) of the step, and its weight in the difference quotient
    for offset, weight in DIFFERENCE_WEIGHTS.items():
        u, difference_factor = state.u + offset * step * phi, weight / step
        K = symmetric_part(system.tangent(u, state.mu))
        x, y = K.createVecs()
        x.array[:] = phi
        K.mult(x, y)  # y = K phi
        by_u += difference_factor * y.array_r
        for name in held_names:
            by_mu[name] += float(
                difference_factor * dot(system.comm, phi, system.load(u, state.mu, name))
            )
    return Functional(mode.eigenvalue, system.zero_at_supports(by_u), by_mu)

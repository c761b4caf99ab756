"""Squared frequencies of small vibrations, and what their derivatives are contracted with.

With K phi = lambda M phi, phi . M phi = 1, about the state x with R(x; p) = 0,

    dlambda/dp = phi . K_p phi - lambda phi . M_p phi + w . R_p,    R_x^T w = -(phi . K phi)_x.

phi . K phi is the second derivative of the energy along phi. Its derivatives are differences of the
residual's between u + e phi and u - e phi, which needs no third derivative of the energy:

    (phi . K phi)_p = phi . (R_p(u + e phi) - R_p(u - e phi))/(2 e),

here of fourth order, and those by u are differences of K phi. Membrane forces are cubic in u:
without bending they are exact. Of waves around a meridian the second variation is a form of its
own.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from magshell_fenicsx.assembly.evaluation import DIFFERENCE_WEIGHTS
from magshell_fenicsx.continuation.modes import ModesNotFound
from magshell_fenicsx.continuation.system import State, dot, symmetric_part
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.shells.modes import TORSION, ShellMode, ShellModes, mode_space
from magshell_fenicsx.simulate.contact_control import (
    contact_expanded_about,
    refuse_touching_shells,
    shell_penetrations,
    stiffened_equilibrium,
    touching_bodies,
)
from magshell_fenicsx.simulate.gradients.adjoint import (
    NO_BEGINS,
    WAVE,
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
    """A natural frequency, or the mean of several that are as good as equal.

    Attributes
    ----------
    value
        omega^2 rho R^2/E.
    """

    modes: tuple[ShellMode, ...]
    numbers: tuple[int, ...]

    @property
    def value(self) -> float:
        return float(np.mean([mode.eigenvalue for mode in self.modes]))

    @property
    def kind(self) -> str:
        """Name of the mode, or of the group of equal frequencies, in words."""
        if len(self.modes) > 1:
            numbers = ", ".join(map(str, self.numbers))
            return f"mean of the modes {numbers}, whose frequencies are equal"
        return self.modes[0].label


def refuse_no_vibration(problem: Problem, result: str) -> None:
    """Check that a case has a frequency in hertz.

    Raises
    ------
    CaseError
        If it has no density.
    """
    if result.startswith("hertz") and problem.time_unit is None:
        raise CaseError(
            f"{result}: needs shell.density and shell.youngs_modulus; without them take "
            f"omega2{result[5:]}"
        )


def vibration(scene: Scene, state: State, result: str) -> Vibration:
    """The vibration of a name such as "omega2_1"; see `vibrations`."""
    return vibrations(scene, state, result)[0]


def vibrations(
    scene: Scene, state: State, result: str, *, max_ratio: float = 1.0, max_count: int = 1
) -> list[Vibration]:
    """The vibration of a name such as "omega2_1", and the next ones; collective. Overwrites the
    model's tangent.

    Parameters
    ----------
    max_ratio
        The next ones have at most this multiple of its eigenvalue.
    max_count
        At most so many are returned.

    Raises
    ------
    LostResult
        If it cannot be computed.
    """
    if mode_space(scene.model).model is not scene.model:
        raise LostResult(
            f"{result}: a sector has the modes of its own planes alone: take symmetry: half or none"
        )
    number = int(result.partition("_")[2])
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
        groups = [g for g in _groups(modes) if g.numbers[-1] >= number]
        groups_near_lowest = [
            g
            for g in groups
            if g.value <= max(max_ratio, 1 + DEGENERACY_TOLERANCE) * groups[0].value
        ][:max_count]
        # the last group is complete
        if groups_near_lowest[-1].numbers[-1] < len(modes) or len(modes) < count:
            return groups_near_lowest


def _groups(modes: Sequence[ShellMode]) -> list[Vibration]:
    """Modes of one label whose frequencies are equal, ascending by their first."""
    groups = list[list[int]]()
    for i, mode in enumerate(modes):
        matching_groups = [g for g in groups if _is_degenerate(modes[g[0]], mode)]
        if matching_groups:
            matching_groups[-1].append(i)
        else:
            groups.append([i])
    return [Vibration(tuple(modes[i] for i in g), tuple(i + 1 for i in g)) for g in groups]


def _is_degenerate(a: ShellMode, b: ShellMode) -> bool:
    return a.label == b.label and abs(a.eigenvalue - b.eigenvalue) <= DEGENERACY_TOLERANCE * abs(
        b.eigenvalue
    )


def frequency(problem: Problem, result: str, omega2: float) -> float:
    """The result of a name: omega^2 rho R^2/E itself, or hertz.

    Raises
    ------
    LostResult
        If the state is unstable: it does not vibrate.
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
    """The kinds of vibrations about a regular state, and their adjoints: one factorisation more for
    each.

    Parameters
    ----------
    max_ratio, max_count
        As of `vibrations`.
    begins
        Number of a step -> the last record before it.

    Raises
    ------
    LostResult
        If the state has no such vibration.
    CaseError
        If the mode leaves the symmetry of the model, a body touches the shell, or it is a wave
        where shells touch.
    """
    state = stiffened_equilibrium(scene, scene.model.system.with_moved_supports(record.point.state))
    if bodies := touching_bodies(scene, state):
        raise CaseError(
            f"{result}: has no gradient where a body touches the shell ({bodies[0].body}): where "
            "it touches changes within "
            "far less than a difference takes; take differences of runs"
        )
    held_conjugates = held_at(scene, record, state, hold)
    kinds = vibrations(scene, state, result, max_ratio=max_ratio, max_count=max_count)
    adjoints_of_kinds = [
        (vibration_of_kind.kind, _adjoint(scene, state, result, vibration_of_kind, held_conjugates))
        for vibration_of_kind in kinds
    ]
    return (
        adjoints_of_kinds
        if hold is not None
        else [
            (kind, with_begins(vibration_of_kind, record, begins))
            for kind, vibration_of_kind in adjoints_of_kinds
        ]
    )


def _adjoint(
    scene: Scene, state: State, result: str, vibration: Vibration, held_conjugates: Held
) -> Adjoint:
    value = frequency(scene.problem, result, vibration.value)
    rate = 1.0 if result.startswith("omega2") else value / (2 * vibration.value)
    c = rate / len(vibration.modes)
    contact_state = state if any(deep > 0 for _, deep in shell_penetrations(scene, state)) else None
    if contact_state and _wave(vibration.modes[0]) is not None:
        refuse_touching_shells(scene, state, f"{result}: {vibration.modes[0].label}")
    largest_step = MAX_DIFFERENCE_STEP_IN_CONTACT if contact_state else MAX_DIFFERENCE_STEP
    with contact_expanded_about(scene, contact_state):
        slopes = [
            _slopes(scene, state, mode, list(held_conjugates), largest_step)
            for mode in vibration.modes
        ]
    by_u = np.sum([s.by_u for s in slopes], axis=0) * c
    by_mu = {name: c * sum(s.by_mu[name] for s in slopes) for name in held_conjugates}
    # nothing displaces a shell that nothing loads, whatever changes
    w, rows = (
        (0.0 * by_u, {})
        if scene.allows_rigid_motion
        else solved(scene, state, Functional(value, by_u, by_mu), held_conjugates)
    )
    places, directions = [AdjointState(state, w, rows)], list[EnergyDirection]()
    for mode in vibration.modes:
        if (m := _wave(mode)) is not None:
            directions.append(
                EnergyDirection(mode.vector, m, stiffness=c, inertia=-c * mode.eigenvalue)
            )
            continue
        step = scene.model.system.step_along(mode.vector, largest_step)
        for offset, weight in DIFFERENCE_WEIGHTS.items():
            displaced_state = State(state.u + offset * step * mode.vector, state.mu)
            places.append(
                AdjointState(
                    displaced_state, c * weight / step * mode.vector, dict.fromkeys(rows, 0.0)
                )
            )
        directions.append(EnergyDirection(mode.vector, None, inertia=-c * mode.eigenvalue))
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


def _wave(mode: ShellMode) -> int | None:
    if mode.label == TORSION:
        return 0
    return int(mode.label.removeprefix(WAVE)) if mode.label.startswith(WAVE) else None


def _slopes(
    scene: Scene, state: State, mode: ShellMode, held_names: list[str], largest_step: float
) -> Functional:
    """phi . K phi with its derivatives by u and by amplitudes that are unknown."""
    system, phi = scene.model.system, mode.vector
    if (m := _wave(mode)) is not None:
        assert scene.model.axisymmetric
        return variation(scene.model, state, phi, m, held_names)
    if mode.label:
        raise CaseError(
            f"{mode.label}: the vibration leaves the symmetry of the model: take symmetry: none"
        )
    step, by_u, by_mu = (
        system.step_along(phi, largest_step),
        np.zeros(system.size),
        dict.fromkeys(held_names, 0.0),
    )
    for offset, weight in DIFFERENCE_WEIGHTS.items():
        u, part = state.u + offset * step * phi, weight / step
        K = symmetric_part(system.tangent(u, state.mu))
        x, y = K.createVecs()
        x.array[:] = phi
        K.mult(x, y)
        by_u += part * y.array_r
        for name in held_names:
            by_mu[name] += float(part * dot(system.comm, phi, system.load(u, state.mu, name)))
    return Functional(mode.eigenvalue, system.zero_at_supports(by_u), by_mu)

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
from magshell_fenicsx.shells.modes import TORSION, ShellMode, ShellModes, seen_on
from magshell_fenicsx.simulate.gradients.adjoint import (
    NONE,
    WAVE,
    Adjoint,
    Begins,
    Direction,
    Held,
    Place,
    held_at,
    solved,
    variation,
    with_begins,
    with_gas,
)
from magshell_fenicsx.simulate.gradients.instabilities import Lost
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import Functional
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.touch import between, pressed_as_at, pressing, refuse_meeting, rigid

FIRST = ("omega2_1", "hertz_1")
NAMES = re.compile(r"(omega2|hertz)_([1-9]\d?)")
AWAY, BESIDE_CONTACT = 0.3, 0.003  # e phi at most, over h; where shells touch
SAME = 1e-4  # squared frequencies closer than this, relative, are one multiple frequency


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
        """In words."""
        if len(self.modes) > 1:
            return f"mean of the modes {', '.join(map(str, self.numbers))}, whose frequencies are equal"
        return self.modes[0].label


def refuse_no_vibration(problem: Problem, of: str) -> None:
    """See that a case has a frequency in hertz.

    Raises
    ------
    CaseError
        If it has no density.
    """
    if of.startswith("hertz") and problem.time_unit is None:
        raise CaseError(
            f"{of}: needs shell.density and shell.youngs_modulus; without them take omega2{of[5:]}"
        )


def vibration(scene: Scene, state: State, of: str) -> Vibration:
    """The vibration of a name such as "omega2_1"; see `vibrations`."""
    return vibrations(scene, state, of)[0]


def vibrations(
    scene: Scene, state: State, of: str, *, beside: float = 1.0, most: int = 1
) -> list[Vibration]:
    """The vibration of a name such as "omega2_1", and the next ones; collective. Overwrites the
    model's tangent.

    Parameters
    ----------
    beside
        The next ones have at most this multiple of its eigenvalue.
    most
        At most so many are returned.

    Raises
    ------
    Lost
        If it cannot be computed.
    """
    if seen_on(scene.model).model is not scene.model:
        raise Lost(
            f"{of}: a sector has the modes of its own planes alone: take symmetry: half or none"
        )
    number = int(of.partition("_")[2])
    count = number + most
    while True:
        count += 1
        try:
            modes = ShellModes(scene.model).vibrations(state, count, loose=scene.loose)
        except ModesNotFound as e:
            raise Lost(f"no frequencies here: {e}") from None
        if number > len(modes):
            raise Lost(f"the model has {len(modes)} vibrations")
        groups = [g for g in _groups(modes) if g.numbers[-1] >= number]
        near = [g for g in groups if g.value <= max(beside, 1 + SAME) * groups[0].value][:most]
        if near[-1].numbers[-1] < len(modes) or len(modes) < count:  # the last group is complete
            return near


def _groups(modes: Sequence[ShellMode]) -> list[Vibration]:
    """Modes of one label whose frequencies are equal, ascending by their first."""
    groups = list[list[int]]()
    for i, mode in enumerate(modes):
        same = [g for g in groups if _same(modes[g[0]], mode)]
        if same:
            same[-1].append(i)
        else:
            groups.append([i])
    return [Vibration(tuple(modes[i] for i in g), tuple(i + 1 for i in g)) for g in groups]


def _same(a: ShellMode, b: ShellMode) -> bool:
    return a.label == b.label and abs(a.eigenvalue - b.eigenvalue) <= SAME * abs(b.eigenvalue)


def frequency(problem: Problem, of: str, omega2: float) -> float:
    """The result of a name: omega^2 rho R^2/E itself, or hertz.

    Raises
    ------
    Lost
        If the state is unstable: it does not vibrate.
    """
    if of.startswith("omega2"):
        return omega2
    if omega2 <= 0:
        raise Lost(f"the shell is unstable and does not vibrate (omega2 = {omega2:.6g})")
    return math.sqrt(omega2) / (2 * math.pi * (problem.time_unit or 1.0))


def adjoints_of_vibrations(
    scene: Scene,
    record: Record,
    of: str,
    hold: Mapping[str, str] | None = None,
    *,
    beside: float = 1.0,
    most: int = 1,
    begins: Begins = NONE,
) -> list[tuple[str, Adjoint]]:
    """The kinds of vibrations about a regular state, and their adjoints: one factorisation more for
    each.

    Parameters
    ----------
    beside, most
        As of `vibrations`.
    begins
        Number of a step -> the last record before it.

    Raises
    ------
    Lost
        If the state has no such vibration.
    CaseError
        If the mode leaves the symmetry of the model, a body touches the shell, or it is a wave
        where shells touch.
    """
    state = rigid(scene, scene.model.system.with_moved_supports(record.point.state))
    if bodies := pressing(scene, state):
        raise CaseError(
            f"{of}: has no gradient where a body touches the shell ({bodies[0].body}): where it touches changes within "
            "far less than a difference takes; take differences of runs"
        )
    held = held_at(scene, record, state, hold)
    kinds = vibrations(scene, state, of, beside=beside, most=most)
    made = [(each.kind, _adjoint(scene, state, of, each, held)) for each in kinds]
    return (
        made
        if hold is not None
        else [(kind, with_begins(each, record, begins)) for kind, each in made]
    )


def _adjoint(scene: Scene, state: State, of: str, vibration: Vibration, held: Held) -> Adjoint:
    value = frequency(scene.problem, of, vibration.value)
    rate = 1.0 if of.startswith("omega2") else value / (2 * vibration.value)
    c = rate / len(vibration.modes)
    about = state if any(deep > 0 for _, deep in between(scene, state)) else None
    if about and _wave(vibration.modes[0]) is not None:
        refuse_meeting(scene, state, f"{of}: {vibration.modes[0].label}")
    away = BESIDE_CONTACT if about else AWAY
    with pressed_as_at(scene, about):
        slopes = [_slopes(scene, state, mode, list(held), away) for mode in vibration.modes]
    by_u = np.sum([s.by_u for s in slopes], axis=0) * c
    by_mu = {name: c * sum(s.by_mu[name] for s in slopes) for name in held}
    # nothing displaces a shell that nothing loads, whatever changes
    w, rows = (
        (0.0 * by_u, {})
        if scene.loose
        else solved(scene, state, Functional(value, by_u, by_mu), held)
    )
    places, directions = [Place(state, w, rows)], list[Direction]()
    for mode in vibration.modes:
        if (m := _wave(mode)) is not None:
            directions.append(Direction(mode.vector, m, stiffness=c, inertia=-c * mode.eigenvalue))
            continue
        step = scene.model.system.step_along(mode.vector, away)
        for way, weight in DIFFERENCE_WEIGHTS.items():
            moved = State(state.u + way * step * mode.vector, state.mu)
            places.append(Place(moved, c * weight / step * mode.vector, dict.fromkeys(rows, 0.0)))
        directions.append(Direction(mode.vector, None, inertia=-c * mode.eigenvalue))
    by_itself = lambda there, _: frequency(there.problem, of, vibration.value)  # noqa: E731
    gas = with_gas(held)
    return Adjoint(
        scene, places, by_itself=by_itself, directions=directions, value=value, gas=gas, about=about
    )


def _wave(mode: ShellMode) -> int | None:
    if mode.label == TORSION:
        return 0
    return int(mode.label.removeprefix(WAVE)) if mode.label.startswith(WAVE) else None


def _slopes(
    scene: Scene, state: State, mode: ShellMode, held: list[str], away: float
) -> Functional:
    """phi . K phi with its derivatives by u and by amplitudes that are unknown."""
    system, phi = scene.model.system, mode.vector
    if (m := _wave(mode)) is not None:
        assert scene.model.axisymmetric
        return variation(scene.model, state, phi, m, held)
    if mode.label:
        raise CaseError(
            f"{mode.label}: the vibration leaves the symmetry of the model: take symmetry: none"
        )
    step, by_u, by_mu = (
        system.step_along(phi, away),
        np.zeros(system.size),
        dict.fromkeys(held, 0.0),
    )
    for way, weight in DIFFERENCE_WEIGHTS.items():
        u, part = state.u + way * step * phi, weight / step
        K = symmetric_part(system.tangent(u, state.mu))
        x, y = K.createVecs()
        x.array[:] = phi
        K.mult(x, y)
        by_u += part * y.array_r
        for name in held:
            by_mu[name] += float(part * dot(system.comm, phi, system.load(u, state.mu, name)))
    return Functional(mode.eigenvalue, system.zero_at_supports(by_u), by_mu)

"""Gradients of a result with respect to amplitudes, numbers of the case, and fields.

With R(x; p) = 0 for the state x under the loading device in use, and K = R_x,

    dJ/dp = J_p + w . R_p,    K^T w = -J_x

takes one solve for all parameters. For the amplitude at a fold w = -phi/(phi . R_mu) with the left null vector phi.
Where a wave phi is neutral that a meridian does not see, Q(phi; u, mu, p) = 0 for its second variation, and

    dmu/dp = -(Q_p + w . R_p)/(Q_mu + w . R_mu),    K w = -Q_u.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from magshell_fenicsx.assembly.terms import FormTerm, factor_of
from magshell_fenicsx.case.loads.step import PathStep
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.continuation.device import Conjugate, Device
from magshell_fenicsx.continuation.fold import Fold
from magshell_fenicsx.continuation.inverse import nearest_to_zero
from magshell_fenicsx.continuation.system import State, System, Vector, dot
from magshell_fenicsx.models.axisymmetric.model import MeridianModel
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import Functional, Target, functional
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.sensitivity import fold_at, stage_at
from magshell_fenicsx.simulate.steps import held_by

WAVE = "m = "  # what the mode of a wave begins with


@dataclass(frozen=True)
class Adjoint:
    """What contracts the derivatives of a state's equations: dJ/dp = J_p + w . R_p + sum_i c_i dPi_i/dp.

    Attributes
    ----------
    w
        Of the model's residual, zero at supports.
    rows
        c_i: of the rows of the device, which hold the conjugates of the amplitudes i.
    of, explicit
        J itself; None for the amplitude at an instability, which no formula gives.
    wave
        phi, m and the factor of Q_p.
    value
        J.
    """

    scene: Scene
    state: State
    w: Vector
    rows: Mapping[str, float]
    of: str | Target = ""
    explicit: Functional | None = None
    wave: tuple[Vector, int, float] | None = None
    value: float = 0.0

    @property
    def potentials(self) -> dict[str, float]:
        """c_i of all potentials, those of J too."""
        found = dict(self.rows)
        for name, c in (self.explicit.potentials if self.explicit else {}).items():
            found[name] = found.get(name, 0.0) + c
        return found


def adjoint_of_instability(scene: Scene, record: Record, fold: Fold | None = None) -> Adjoint:
    """The adjoint of the amplitude where a fold or a neutral wave is.

    A fold takes no factorisation but its own, a wave one of the tangent and one of its second variation.

    Raises
    ------
    CaseError
        If the record is another instability.
    """
    if record.mode.startswith(WAVE):
        return _of_wave(scene, record)
    if record.label != "fold":
        raise CaseError(
            f"instability: this is a {record.label} {record.mode}".rstrip() + ": only of folds, and of waves"
        )
    fold = fold or fold_at(scene, record)
    stage = stage_at(scene, record)
    system = stage.newton.system
    pull = dot(system.comm, fold.left, system.load(fold.state.u, fold.state.mu, fold.name))
    left = np.asarray(-fold.left / pull)
    rows = stage.device.rates(left) if stage.device else {}
    w = stage.device.displacement(left) if stage.device else left
    return Adjoint(scene, stage.leave(fold.state), np.array(w), rows, value=fold.value)


def _of_wave(scene: Scene, record: Record) -> Adjoint:
    model, m = scene.model, int(record.mode.removeprefix(WAVE))
    if record.step and scene.case.programme[record.step - 1].load.hold:
        raise CaseError(f"instability: {record.mode}: not while a conjugate is held")
    assert isinstance(model, MeridianModel)
    system, waves, state = model.system, model.excluded_modes.waves, model.system.placed(record.point.state)
    phi = nearest_to_zero(waves.factor_at(state, m))[1]
    terms = waves.along(phi, m)
    system.at(state.u, state.mu)
    mu = {term.name: factor_of(term.amplitude, state.mu) for term in terms}
    Q = sum(mu[term.name] * term.energy() for term in terms)
    Q_mu = sum(term.energy() for term in terms if term.amplitude == record.amplitude)
    Q_u = np.zeros(system.size)
    for term in terms:
        term.add_residual(Q_u, mu[term.name])
    factors = scene.newton.factor_at(state)
    slope = system.held(-Q_u)
    w = factors.solve_transposed(slope) if factors.skewed else factors.solve(slope)
    rate = Q_mu + w @ system.load(state.u, state.mu, record.amplitude)
    value = state.mu[record.amplitude] - Q / rate  # what locating it has left, to second order
    return Adjoint(scene, state, -w / rate, {}, wave=(phi, m, float(-1 / rate)), value=float(value))


def adjoint(scene: Scene, record: Record, of: str | Target, hold: Mapping[str, str] | None = None) -> Adjoint:
    """The adjoint of a result at a regular state; one factorisation and one solve.

    Raises
    ------
    CaseError
        If the scene has no such result.
    """
    state = scene.model.system.placed(record.point.state)
    found = functional(scene, state, of)
    held = _held(scene, record, state, hold)
    if free := [name for name in found.by_mu if name not in held]:
        raise CaseError(f"{free[0]}: is a load here, which no parameter changes: hold its conjugate")
    system: System = scene.model.system
    device = Device(system, held, dict.fromkeys(held, system.length)) if held else None
    whole = device.enter(state) if device else state
    factors = (scene.newton.on(device) if device else scene.newton).factor_at(whole)
    slope = found.by_u
    if device:
        slope = device.joined(
            found.by_u, {name: found.by_mu.get(name, 0.0) + mixed(scene, state, found, name) for name in held}
        )
    w = factors.solve_transposed(-slope) if factors.skewed else factors.solve(-slope)
    rows = device.rates(w) if device else {}
    w = np.array(device.displacement(w) if device else w)
    return Adjoint(scene, state, w, rows, of, found, value=found.value)


def mixed(scene: Scene, state: State, of: Functional, name: str) -> float:
    """What the potentials in J change by with an amplitude."""
    system = scene.model.system
    changes = sum(c * system.curvature(state.u, state.mu, i, name) for i, c in of.potentials.items())
    return float(changes + (of.energy and of.energy * system.potential(state.u, state.mu, name)))


def _held(scene: Scene, record: Record, state: State, hold: Mapping[str, str] | None) -> dict[str, float | Conjugate]:
    """Amplitude -> its conjugate, of those that are unknown."""
    held = dict[str, float | Conjugate]()
    step = scene.case.programme[record.step - 1] if record.step else None
    if hold is None and step:
        held |= held_by(scene, step, state)
        load = step.load
        if isinstance(load, PathStep) and load.control == load.conjugate_control:
            held[step.name] = -scene.model.system.potential(state.u, state.mu, step.name)
    for name, how in (hold or {}).items():
        if name not in state.mu or how not in ("load", "conjugate"):
            raise CaseError(f"hold: {name}: {how}: allowed are load and conjugate of {', '.join(state.mu)}")
        if how == "conjugate":
            held[name] = -scene.model.system.potential(state.u, state.mu, name)
    return held


def along(scene: Scene, adjoint: Adjoint) -> list[FormTerm]:
    """The second variation along the wave, at the displacement that is set; none without a wave."""
    if adjoint.wave is None:
        return []
    assert isinstance(scene.model, MeridianModel)
    return scene.model.excluded_modes.waves.along(*adjoint.wave[:2])

"""Gradients of a result with respect to amplitudes, numbers of the case, and fields.

With R(x; p) = 0 for the state x under the loading device in use, and K = R_x,

    dJ/dp = J_p + w . R_p,    K^T w = -J_x

takes one solve for all parameters. For the amplitude at a fold w = -phi/(phi . R_mu) with the left null vector phi.
Where a wave phi is neutral that a meridian does not see, Q(phi; u, mu, p) = 0 for its second variation, and

    dmu/dp = -(Q_p + w . R_p)/(Q_mu + w . R_mu),    K w = -Q_u.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.field_derivative import FieldGradient, Share, by_field
from magshell_fenicsx.assembly.terms import FormTerm, Term
from magshell_fenicsx.case.loads.step import PathStep
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.continuation.device import Conjugate, Device
from magshell_fenicsx.continuation.fold import Fold
from magshell_fenicsx.continuation.inverse import nearest_to_zero
from magshell_fenicsx.continuation.system import State, System, Vector, dot
from magshell_fenicsx.models.axisymmetric import pattern as of_meridian
from magshell_fenicsx.models.axisymmetric.model import MeridianModel
from magshell_fenicsx.models.shell import patterns
from magshell_fenicsx.models.shell.model import ShellModel
from magshell_fenicsx.models.shell.patterns import Uniform
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.models.solid import remanence as of_body
from magshell_fenicsx.models.solid.model import SolidModel
from magshell_fenicsx.simulate.numbers import carried, number_of, scene_with
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import Functional, Target, functional
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.sensitivity import fold_at, magnetic_terms, stage_at
from magshell_fenicsx.simulate.steps import held_by
from magshell_fenicsx.simulate.transfer import transfer

Array = NDArray[np.float64]
Gradient: TypeAlias = float | FieldGradient
FIELDS = {"remanence": "Br", "thickness": "thickness"}  # name -> that of the field in the terms
WAVE = "m = "  # what the mode of a wave begins with
STEP = 1e-4  # of a number, or of one where it is smaller


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


def gradient(
    scene: Scene,
    record: Record,
    *,
    of: str | Target,
    by: Sequence[str],
    fold: Fold | None = None,
    hold: Mapping[str, str] | None = None,
) -> dict[str, Gradient]:
    """The derivatives of a result at a record; collective.

    Parameters
    ----------
    of
        "instability": the amplitude of a record that is a fold or, on a meridian, a neutral wave; a column of path.csv
        (named points, w_over_h, reactions, volume_change, the load where it is not held, energy); or a function from
        undeformed places (n, 3) over R to wanted ones: the mean square distance to them.
    by
        Amplitudes ("lambda_m", ...), keys of the case with a number ("magnetic.remanent.polar"), and fields:
        "remanence" (vectors over |B^r|, of a meridian along e_rho, e_theta, e_z) and "thickness" (over h).
    fold
        Of `fold_at`, if it is known.
    hold
        Amplitude -> "load" or "conjugate": what stays while p changes. By default what the record's step holds, and
        the displacement where that is its control.

    Returns
    -------
    Numbers, and `FieldGradient` of fields.

    Raises
    ------
    CaseError
        If the scene has no such result or parameter.
    FoldLost
        If Newton's method for the fold fails.
    """
    found = adjoint_of_instability(scene, record, fold) if of == "instability" else adjoint(scene, record, of, hold)
    return {name: derivative(found, name) for name in by}


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
    mu = {term.name: state.mu[term.amplitude] if term.amplitude else 1.0 for term in terms}
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
            found.by_u, {name: found.by_mu.get(name, 0.0) + _mixed(scene, state, found, name) for name in held}
        )
    w = factors.solve_transposed(-slope) if factors.skewed else factors.solve(-slope)
    rows = device.rates(w) if device else {}
    w = np.array(device.displacement(w) if device else w)
    return Adjoint(scene, state, w, rows, of, found, value=found.value)


def _mixed(scene: Scene, state: State, of: Functional, name: str) -> float:
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


def derivative(adjoint: Adjoint, by: str) -> Gradient:
    """The derivative by one parameter; see `gradient`."""
    if by in FIELDS:
        return _by_field(adjoint, by)
    if by in adjoint.state.mu:
        return _by_amplitude(adjoint, by)
    return _by_number(adjoint, by)


def _by_amplitude(adjoint: Adjoint, name: str) -> float:
    scene, state = adjoint.scene, adjoint.state
    if name in adjoint.rows:
        raise CaseError(f"{name}: is unknown here, as its conjugate is held")
    system, of = scene.model.system, adjoint.explicit
    found = dot(system.comm, adjoint.w, system.load(state.u, state.mu, name))
    found += sum(c * system.curvature(state.u, state.mu, i, name) for i, c in adjoint.rows.items())
    if adjoint.wave:
        system.at(state.u, state.mu)
        found += adjoint.wave[2] * sum(t.energy() for t in _along(scene, adjoint) if t.amplitude == name)
    return float(found + (_mixed(scene, state, of, name) + of.by_mu.get(name, 0.0) if of else 0.0))


def _by_number(adjoint: Adjoint, key: str) -> float:
    """By a central difference of the contracted equations, on the same mesh: nothing is solved."""
    scene, state = adjoint.scene, adjoint.state
    value = number_of(scene.case, key)
    step = STEP * (abs(value) or 1.0)

    def contracted(p: float) -> float:
        other = scene_with(scene, key, p)
        u, w = (transfer(scene, other, v) for v in (state.u, adjoint.w))
        moved, system = carried(scene, other, State(u, state.mu)), other.model.system
        moved = system.placed(moved)
        explicit = functional(other, moved, adjoint.of).value if adjoint.explicit else 0.0
        rows = sum(c * system.potential(moved.u, moved.mu, name) for name, c in adjoint.rows.items())
        total = explicit + dot(system.comm, w, system.residual(moved.u, moved.mu)) + rows
        for term in _along(other, adjoint):
            assert adjoint.wave
            mu = moved.mu[term.amplitude] if term.amplitude else 1.0
            total += adjoint.wave[2] * mu * term.energy()
        return float(total)

    return (contracted(value + step) - contracted(value - step)) / (2 * step)


def _along(scene: Scene, adjoint: Adjoint) -> list[FormTerm]:
    """The second variation along the wave, at the displacement that is set; none without a wave."""
    if adjoint.wave is None:
        return []
    assert isinstance(scene.model, MeridianModel)
    return scene.model.excluded_modes.waves.along(*adjoint.wave[:2])


def _by_field(adjoint: Adjoint, name: str) -> FieldGradient:
    scene, state = adjoint.scene, adjoint.state
    other = _with_field(adjoint, name)
    if other is not scene:
        u, w = (transfer(scene, other, v) for v in (state.u, adjoint.w))
        return _by_field(replace(adjoint, scene=other, state=State(u, state.mu), w=w), name)
    model, system = scene.model, scene.model.system
    system.at(state.u, state.mu)
    terms = _terms(scene, state, name)
    f = next((c for t in terms for c in t.form.coefficients() if c.name == FIELDS[name]), None)
    if f is None:
        raise CaseError(f"{name}: the case has no such field: no result depends on it")
    along, c = fem.Function(model.V), adjoint.potentials
    along.x.array[: system.size] = adjoint.w
    along.x.scatter_forward()
    if system.moving:
        for motion in c.keys() & system.moving.names:
            along.x.array[:] += c[motion] * system.moving.rate(state.mu, motion)
    energy = adjoint.explicit.energy if adjoint.explicit else 0.0
    shares = []
    for term in terms:
        mu = state.mu[term.amplitude] if term.amplitude else 1.0
        shares.append(Share(term, energy * mu + c.get(term.amplitude or "", 0.0), mu))
    if adjoint.wave:
        for term in _along(scene, adjoint):
            mu = state.mu[term.amplitude] if term.amplitude else 1.0
            shares.append(Share(term, adjoint.wave[2] * mu, 0.0))
    for each in c.keys() & system.parameters.keys():
        for slope in system.parameters[each].slopes:
            if not isinstance(slope, FormTerm):
                raise CaseError(f"{name}: the conjugate of {each} has no gradient by this field")
            shares.append(Share(slope, c[each] * (state.mu[slope.amplitude] if slope.amplitude else 1.0), 0.0))
    forces = by_field(shares, f, model.u, along, model.kernels)
    places, normals = _places(scene, f)
    return FieldGradient(f, forces, places[: len(forces)], normals[: len(forces)])


def _with_field(adjoint: Adjoint, name: str) -> Scene:
    """The scene, or one in whose terms a number that is the same everywhere is a field."""
    scene, plan = adjoint.scene, adjoint.scene.plan
    if name == "thickness" and not (isinstance(scene.model, SolidModel) or scene.model.thickness):
        return Scene(scene.case, scene.comm, replace(plan, thickness=Thickness()))
    magnetic = plan.loads.magnetic
    if adjoint.wave and name == "remanence" and magnetic and not callable(magnetic.remanent):
        even = replace(magnetic, remanent=Uniform(np.asarray(magnetic.remanent)))
        return Scene(scene.case, scene.comm, replace(plan, loads=replace(plan.loads, magnetic=even)))
    return scene


def _terms(scene: Scene, state: State, name: str) -> list[FormTerm]:
    """The terms with the field as a coefficient; a remanence that is the same everywhere is no field in the model's."""
    terms: list[Term] = list(scene.model.system.terms)
    magnetic = scene.model.loads.magnetic
    if name == "remanence" and magnetic and not callable(magnetic.remanent):
        terms = list(magnetic_terms(scene, state, replace(magnetic, remanent=Uniform(np.asarray(magnetic.remanent)))))
    return [term for term in terms if isinstance(term, FormTerm)]


def _places(scene: Scene, f: fem.Function) -> tuple[Array, Array]:
    """Nodes of every cell of a field and normals there, as the field's pattern is given them."""
    model, nodes = scene.model, f.function_space.element.basix_element.points
    if isinstance(model, MeridianModel):
        places, normals = of_meridian.places(model.r0, nodes)
    elif isinstance(model, ShellModel):
        places, normals = patterns.places(model.r0, nodes)
    else:
        places, normals = of_body.places(model.V)
    return patterns.inside(places), normals

"""Sensitivities of the amplitude at a fold, for instance of the buckling pressure.

The derivative d mu*/dp = -(phi . R_p)/(phi . R_mu) takes one dot product for each parameter p.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from dolfinx import fem
from dolfinx.la import InsertMode

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.continuation.fold import Fold, Guess, find_fold, sensitivity
from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.models.shell.parameters import Magnetisation
from magshell_fenicsx.models.shell.patterns import Array, Pattern, WithinRims
from magshell_fenicsx.models.shell.terms import EnergyFactory
from magshell_fenicsx.parts.magnetism.applied import AppliedField
from magshell_fenicsx.parts.magnetism.fields import MagneticSection
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.shape_sensitivity import to_imperfections
from magshell_fenicsx.simulate.stage import Stage, plain
from magshell_fenicsx.simulate.steps import stage_of

SOME_FIELD = 1e-3  # a lambda_m that is not zero; nothing is solved in it


def fold_at(scene: Scene, record: Record) -> Fold:
    """The fold of a record with the label "fold", with its null vector; collective.

    Raises
    ------
    ValueError
        If the record has another label.
    FoldLost
        If Newton's method for the fold fails.
    """
    if record.label != "fold":
        raise ValueError(f"this record is no fold, but a {record.label}")
    scene.refuse_foreign(record.point.state)
    stage = stage_at(scene, record)
    return find_fold(stage.newton, Guess(stage.enter(record.point.state)), record.amplitude)


def stage_at(scene: Scene, record: Record) -> Stage:
    """The solver of a record's step, which holds what the step holds."""
    if not record.step:
        return plain(scene)
    return stage_of(scene, scene.problem.programme[record.step - 1], record.point.state)


def sensitivities(scene: Scene, fold: Fold, record: Record | None = None) -> dict[str, float]:
    """Derivatives of a fold's amplitude (p/p_c for pressure, so d k_d); collective.

    Parameters
    ----------
    record
        The record of the fold, if its step holds conjugates.

    Returns
    -------
    Derivatives by the name of the parameter, with all others fixed:

    - every other amplitude of the scene ("lambda_m", "force", that of a user-defined term, ...);
    - "defect.amplitude", "imperfections.0.width", ...: see `shape_sensitivity`;
    - "remanence dimple", "remanence rest": a relative change of the remanence of one patch, within a
      dimple's rim or outside all ("remanence" where there is no dimple). Their sum is lambda_m times
      the derivative in lambda_m.
    """
    stage = stage_at(scene, record) if record else plain(scene)
    system, state, history = stage.newton.system, fold.state, scene.model.system.history
    columns = {name: system.load(state.u, state.mu, name) for name in state.mu if name not in (fold.name, *history)}
    by_patch = _remanence_columns(scene, replace(fold, state=stage.leave(state)))
    columns |= {name: stage.padded(column) for name, column in (by_patch | _field_column(scene, state)).items()}
    by_column = {name: sensitivity(system, fold, column) for name, column in columns.items()}
    return by_column | to_imperfections(stage, fold)


def _field_column(scene: Scene, state: State) -> dict[str, Vector]:
    """The load column of lambda_m for a problem whose field is zero: of the same shell with a field.

    Empty without a section magnetic, and where the field leaves less symmetry than the model has.
    """
    if scene.problem.context.of(MagneticSection) is None or "lambda_m" in state.mu:
        return {}
    none = dict.fromkeys(("magnetic.remanent.flux_density", "magnetic.applied.flux_density"))
    there = Scene(scene.problem.again({"magnetic.lambda_m": SOME_FIELD, **none}), scene.comm)
    if type(there.model) is not type(scene.model) or there.model.system.size != scene.model.system.size:
        return {}
    size = scene.model.system.size
    return {"lambda_m": there.model.system.load(state.u[:size], {**there.unloaded().mu, **state.mu}, "lambda_m")}


@dataclass(frozen=True)
class _Within:
    """A remanence in one patch, zero elsewhere."""

    whole: Array | Pattern
    patch: WithinRims

    def __call__(self, r0: Array, n0: Array) -> Array:
        vectors = self.whole(r0, n0) if callable(self.whole) else self.whole
        return np.asarray(vectors * self.patch(r0, n0))


def _remanence_columns(scene: Scene, fold: Fold) -> dict[str, Vector]:
    """mu_i dPi_i/du of the magnetic terms, with the remanence of one patch only."""
    field = scene.model.loads.magnetic
    if field is None or (field.soft and field.soft.alone):
        return {}
    within, one = scene.problem.within, np.ones(3)
    if not within:
        return {"remanence": _magnetic_column(scene, fold, field)}

    def only(patch: str) -> WithinRims:
        rims = tuple((inside, one if name == patch else 0 * one) for name, inside in within.items())
        return WithinRims(rims, one if patch == "rest" else 0 * one)

    patches = {patch: only(patch) for patch in (*within, "rest")}
    return {
        f"remanence {name}": _magnetic_column(scene, fold, replace(field, remanent=_Within(field.remanent, patch)))
        for name, patch in patches.items()
    }


def _magnetic_column(scene: Scene, fold: Fold, field: Magnetisation) -> Vector:
    model, system = scene.model, scene.model.system
    column, terms = fem.Function(model.V), magnetic_terms(scene, fold.state, field)

    def add() -> None:
        for term in terms:
            assert term.amplitude
            term.add_residual(column.x.array, fold.state.mu[term.amplitude])

    system.at(fold.state).of(add)
    column.x.scatter_reverse(InsertMode.add)
    for held in system.clamped:
        held.set(column.x.array)
    return np.array(column.x.array[: model.system.size])


def magnetic_terms(scene: Scene, state: State, field: Magnetisation) -> Sequence[FormTerm]:
    """The model's terms of a remanence with another one, in the fields of a state; none of what is soft alone."""
    terms, fields = _made(scene, field)
    for known in fields:
        known.mu.update({name: state.mu[name] for name in known.names})
    return terms


def _made(scene: Scene, field: Magnetisation) -> tuple[Sequence[FormTerm], Sequence[AppliedField]]:
    model, log, fields = scene.model, KernelLog(), list[AppliedField]()
    factory = replace(model.factory, log=log, fields=fields)
    if field.soft and field.soft.alone:
        return [], fields
    field = replace(field, soft=None)
    if isinstance(factory, EnergyFactory):
        return [factory.term(energy) for energy in factory.magnetic(field)], fields
    return factory.magnetic(field), fields

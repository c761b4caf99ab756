"""Sensitivities of the amplitude at a fold, for instance of the buckling pressure.

The derivative d mu*/dp = -(phi . R_p)/(phi . R_mu) takes one dot product for each parameter p.

By the numbers of an imperfection R_p is a central difference, (R(r0 + s dr0/dp) - R(r0 - s
dr0/dp))/(2 s): where the chart's nodes stay, r0 alone depends on an imperfection. A rim makes r0
rough in p beside it, but R is smooth in r0. Differences of folds converge to these derivatives on
the same mesh: for depths with the square of their step, for what moves a rim with the step itself.
Between new meshes, whose edges follow the rim, they have the meshes' noise over the step.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import degrees
from typing import Any, TypeAlias

import numpy as np
from dolfinx import fem
from dolfinx.la import InsertMode
from numpy.typing import NDArray

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.continuation.fold import Fold, Guess, find_fold, sensitivity
from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.mesh.patch import Deviated, Deviation
from magshell_fenicsx.models.shell.patterns import Pattern, WithinRims
from magshell_fenicsx.parts.imperfections.growth import grown_by
from magshell_fenicsx.parts.imperfections.imperfection import (
    ImperfectionSection,
    LocalSection,
    flaws,
    in_frame,
)
from magshell_fenicsx.parts.magnetism.applied import AppliedField
from magshell_fenicsx.parts.magnetism.fields import MagneticSection
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.shape.outline import ground_of
from magshell_fenicsx.shells.terms import EnergyFactory
from magshell_fenicsx.simulate.numbers import number_of, scene_with, size_of
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage, plain
from magshell_fenicsx.simulate.steps import stage_of
from magshell_fenicsx.simulate.transfer import same_mesh, transfer

SOME_FIELD = 1e-3  # a lambda_m that is not zero; nothing is solved in it
Array = NDArray[np.float64]
Imperfections: TypeAlias = Mapping[str, ImperfectionSection]
STEP, TINY = (
    1e-3,
    1e-6,
)  # of h, of a width or of the angle of a half-width: for the residual, and for dr0/dp


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
    - "defect.amplitude", "imperfections.0.width", ...: numbers of imperfections;
    - "remanence dimple", "remanence rest": a relative change of the remanence of one patch, within
      a
      dimple's rim or outside all ("remanence" where there is no dimple). Their sum is lambda_m
      times the derivative in lambda_m.
    """
    stage = stage_at(scene, record) if record else plain(scene)
    system, state, history = stage.newton.system, fold.state, scene.model.system.history
    columns = {
        name: system.load(state.u, state.mu, name)
        for name in state.mu
        if name not in (fold.name, *history)
    }
    by_patch = _remanence_columns(scene, replace(fold, state=stage.leave(state)))
    columns |= {
        name: stage.padded(column)
        for name, column in (by_patch | _field_column(scene, state)).items()
    }
    by_column = {name: sensitivity(system, fold, column) for name, column in columns.items()}
    return by_column | to_imperfections(stage, fold) | to_shells(stage, fold)


def _field_column(scene: Scene, state: State) -> dict[str, Vector]:
    """The load column of lambda_m for a problem whose field is zero: the slope of the magnetic
    energy in it.

    Empty without a section magnetic, and where the field leaves less symmetry than the model has.
    """
    problem = scene.problem
    if problem.context.of(MagneticSection) is None or "lambda_m" in state.mu:
        return {}
    none = dict.fromkeys(("magnetic.remanent.flux_density", "magnetic.applied.flux_density"))
    with_field = problem.again({"magnetic.lambda_m": SOME_FIELD, **none})
    whole = not problem.axisymmetric and problem.mirror is None
    alike = (with_field.axisymmetric, with_field.mirror) == (problem.axisymmetric, problem.mirror)
    assert with_field.loads.magnetic
    size = scene.model.system.size
    own = State(state.u[:size], state.mu)
    return (
        {"lambda_m": _magnetic_column(scene, own, with_field.loads.magnetic)}
        if whole or alike
        else {}
    )


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
    if field is None or (field.soft and field.soft.alone) or scene.model.loads.interaction:
        return {}
    within, one = scene.problem.within, np.ones(3)
    if field.patches and scene.problem.context.sections.get("shells"):
        return _of_shells(scene, fold.state, field, field.patches)
    if not within:
        return {"remanence": _magnetic_column(scene, fold.state, field)}

    def only(patch: str) -> WithinRims:
        rims = tuple((inside, one if name == patch else 0 * one) for name, inside in within.items())
        return WithinRims(rims, one if patch == "rest" else 0 * one)

    alone = {patch: _Within(field.remanent, only(patch)) for patch in (*within, "rest")}
    return {
        f"remanence {patch}": _magnetic_column(
            scene, fold.state, replace(field, remanent=remanence)
        )
        for patch, remanence in alone.items()
    }


def _of_shells(
    scene: Scene, state: State, field: Magnetisation, patches: Mapping[str, Array | Pattern]
) -> dict[str, Vector]:
    """That of each of several shells."""
    model = scene.model
    own: Mapping[str, NDArray[np.bool_]]
    if model.midsurface:
        cells = model.midsurface.mesh.topology.index_map(2)
        own, count = model.midsurface.patches, cells.size_local + cells.num_ghosts
    else:
        assert model.axisymmetric
        own, count = model.meridian.patches, len(model.meridian.order)
    none = dict.fromkeys(patches, np.zeros(3))
    alone = {
        name: replace(field, patches={**none, name: of}).on(own, count)
        for name, of in patches.items()
    }
    return {
        f"remanence {name}": _magnetic_column(scene, state, each) for name, each in alone.items()
    }


def _magnetic_column(scene: Scene, state: State, field: Magnetisation) -> Vector:
    """lambda_m dPi/du of a field; dPi/du where the problem has none."""
    model, system = scene.model, scene.model.system
    column, terms = fem.Function(model.V), magnetic_terms(scene, state, field)

    def add() -> None:
        for term in terms:
            assert term.amplitude
            term.add_residual(column.x.array, state.mu.get(term.amplitude, 1.0))

    system.at(state).of(add)
    column.x.scatter_reverse(InsertMode.add)
    for held in system.clamped:
        held.set(column.x.array)
    return np.array(column.x.array[: model.system.size])


def magnetic_terms(scene: Scene, state: State, field: Magnetisation) -> Sequence[FormTerm]:
    """The model's terms of a remanence with another one, in the fields of a state; none of what is
    soft alone.
    """
    terms, fields = _made(scene, field)
    for applied in fields:
        applied.mu.update({name: state.mu.get(name, 0.0) for name in applied.names})
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


def to_imperfections(stage: Stage, fold: Fold) -> dict[str, float]:
    """Derivatives by the key of each number below `shell`, angles in degrees; collective.

    A number of a rim that separates patches of a remanence or of a natural shape is left out: the
    mesh has no place for a rim that moves. What a half or a meridian excludes by symmetry is zero.
    """
    problem = stage.scene.problem
    return {
        f"{key}.{name}": _derivative(stage, fold, key, name)
        for key, section in problem.imperfections.items()
        for name in section.parameters
        if _varies(problem, section, name)
    }


def _varies(problem: Problem, section: ImperfectionSection, name: str) -> bool:
    if section.patch and problem.patched and name != "amplitude":
        return False
    if not name.startswith("at."):
        return True
    assert isinstance(section, LocalSection)
    spherical = problem.context.shell.geometry in ("hemisphere", "cap") and section.at.point is None
    return spherical and section.at.polar != 0


def _derivative(stage: Stage, fold: Fold, key: str, name: str) -> float:
    scene = stage.scene
    if scene.problem.axisymmetric and name.startswith("at."):
        return 0.0
    problem = scene.problem
    unit = _unit(problem, key, name)
    step, tiny = STEP * unit, TINY * unit
    further, back = (
        _deviation(scene, changed(problem.imperfections, key, name, c), key) for c in (tiny, -tiny)
    )

    def out_of_balance(change: float) -> float:
        return _in_other(stage, fold, reshaped(scene, Along(further, back, change / (2 * tiny))))

    grown = [
        fold.state.mu[of]
        for of, keys in grown_by(scene.problem.programme, problem.imperfections).items()
        if key in keys
    ]
    return (grown or [1.0])[0] * (out_of_balance(step) - out_of_balance(-step)) / (2 * step)


def _in_other(stage: Stage, fold: Fold, other: Scene) -> float:
    """-(left . R)/(left . R_mu) of the same state in a scene with a slightly different shell on the
    same mesh.

    What touches there is what touches in the state, see `expand`.
    """
    scene, size = stage.scene, stage.scene.model.system.size
    assert same_mesh(scene, other)
    u, left = (
        np.concatenate([transfer(scene, other, v[:size]), v[size:]])
        for v in (fold.state.u, fold.left)
    )
    expand(scene, other, stage.leave(fold.state))
    moved, system = (
        replace(fold, state=State(u, fold.state.mu), left=left),
        stage.on(other).newton.system,
    )
    return sensitivity(system, moved, system.residual(u, fold.state.mu))


def expand(scene: Scene, other: Scene, state: State) -> None:
    """Take the penalties of contact in another scene on the same mesh as polynomials about a state
    of the first one.
    """
    touch_as_in(scene, other, state)
    at = scene.model.system.at(state)
    for name, (pressing, _) in scene.model.contacts.items():
        other.model.contacts[name][0].expand_about(at.of(partial(getattr, pressing, "gap")))


def touch_as_in(scene: Scene, other: Scene, state: State) -> None:
    """Take contact between shells in another scene on the same mesh as polynomials about a state of
    the first one.
    """
    assert np.array_equal(scene.model.V.dofmap.list, other.model.V.dofmap.list), (
        "they go by numbers"
    )
    at = scene.model.system.at(state)
    of_one: Sequence[Any] = scene.model.touchings
    of_other: Sequence[Any] = other.model.touchings
    for touching, same in zip(of_one, of_other, strict=True):
        if touching.held:
            same.hold(touching.held)
        else:
            same.expand_about(at.of(touching.pressed))


def to_shells(stage: Stage, fold: Fold) -> dict[str, float]:
    """Derivatives by the numbers of imperfections of several shells, each by its key; collective."""
    context, found = stage.scene.problem.context, dict[str, float]()
    for name, member in (context.sections.get("shells") or {}).items():
        for i, section in enumerate(member.shell.imperfections):
            for number in section.parameters:
                key = f"shells.{name}.shell.imperfections.{i}.{number}"
                if not number.startswith("at."):
                    found[key] = _by_number(stage, fold, key)
    return found


def _by_number(stage: Stage, fold: Fold, key: str) -> float:
    """The derivative by a number of the case, as a central difference of the residual."""
    scene, context = stage.scene, stage.scene.problem.context
    value, step = number_of(context, key), STEP * size_of(context, key)
    ahead, back = (
        _in_other(stage, fold, scene_with(scene, key, value + change)) for change in (step, -step)
    )
    return (ahead - back) / (2 * step)


def _unit(problem: Problem, key: str, name: str) -> float:
    section, shell = problem.imperfections[key], problem.context.shell
    if name == "width":
        return float(getattr(section, name))
    if name.startswith("at."):
        assert isinstance(section, LocalSection)
        return degrees(section.half_width(shell.R_over_h, shell.poisson_ratio))
    return 1.0


def changed(sections: Imperfections, key: str, name: str, change: float) -> Imperfections:
    """Imperfections of which one has another number, such as "at.polar" of "imperfections.0"."""
    return {**sections, key: _changed(sections[key], name, change)}


def _changed(part: Any, path: str, change: float) -> Any:
    """A number, or a section or a list with another number somewhere in it."""
    if not path:
        return part + change
    first, _, rest = path.partition(".")
    if isinstance(part, list):
        return [
            _changed(item, rest, change) if i == int(first) else item for i, item in enumerate(part)
        ]
    return part.model_copy(update={first: _changed(getattr(part, first), rest, change)})


@dataclass(frozen=True)
class Along:
    """A deviation along the derivative of another one, by the difference of two of its values."""

    further: Deviation
    back: Deviation
    factor: float

    def __call__(self, places: Array) -> Array:
        return np.asarray(self.factor * (self.further(places) - self.back(places)))


@dataclass(frozen=True)
class _Mirrored:
    """The mean of a deviation and its image: what half of a shell sees of it."""

    deviation: Deviation
    mirror: Mirror

    def __call__(self, places: Array) -> Array:
        return np.asarray((self.deviation(places) + self.deviation(self.mirror.image(places))) / 2)


def _deviation(scene: Scene, sections: Imperfections, key: str) -> Deviation:
    """The deviation of one of other imperfections, in the frame of the scene's model."""
    problem, number = scene.problem, list(sections).index(key)
    flaw = list(flaws(sections, ground_of(problem.context.shell)).values())[
        number
    ]  # that has random dimples one by one
    turned = in_frame(flaw.deviation, problem.azimuth)
    return _Mirrored(turned, problem.mirror) if problem.mirror else turned


def reshaped(scene: Scene, deviation: Deviation) -> Scene:
    """The scene on the same mesh in the chart, with one more deviation."""
    problem, model = scene.problem, scene.model

    def moved(embedding: object) -> Deviated:
        assert isinstance(embedding, Deviated)
        return replace(embedding, deviations=(*embedding.deviations, deviation))

    embedding = moved(problem.embedding)
    meridian = problem.meridian and replace(
        problem.meridian, embedding=moved(problem.meridian.embedding)
    )
    shape = model.midsurface.reshaped(embedding) if model.midsurface else problem.shape
    return Scene(replace(problem, embedding=embedding, meridian=meridian, shape=shape), scene.comm)

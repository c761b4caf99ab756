"""Sensitivities of the amplitude at a fold, for instance of the buckling pressure.

The derivative d mu*/dp = -(phi . R_p)/(phi . R_mu) takes one dot product for each parameter p.

By the numbers of an imperfection R_p is a central difference, (R(r0 + s dr0/dp) - R(r0 - s
dr0/dp))/(2 s): where the chart's nodes stay, r0 alone depends on an imperfection. A rim makes r0
rough in p beside it, but R is smooth in r0. Differences of folds converge to these derivatives on
the same mesh: for depths with the square of their step, for what moves a rim with the step itself.
Between new meshes, whose edges follow the rim, they have the meshes' noise over the step.

Words and symbols:

- R is the residual Pi_u, the derivative of the potential energy by the displacement u; phi is the
  left null vector of the tangent at the fold. mu holds the amplitudes (load parameters) by name.
- A load column of a parameter p is the vector R_p, zero at supports. One dot product with phi turns
  it into the derivative of the fold's amplitude; `continuation.fold.sensitivity` does so.
- r0 is the undeformed mid-surface, a function of the chart (its coordinates). A deviation w0 is its
  distance from the perfect surface. A rim is the edge of a dimple; it may separate patches.
- h and R are thickness and reference length; lambda_m is the strength of the magnetic field.
- A stage is a scene with the solver of one step, whose system may have further unknowns; `leave`
  converts its states to states of the model.
- In a case of several shells each one is a member shell, with sections of its own.
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
from magshell_fenicsx.continuation.fold import Fold, FoldGuess, find_fold, sensitivity
from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.mesh.patch import DeviatedEmbedding, Deviation
from magshell_fenicsx.models.shell.spatial_fields import Pattern, WithinRims
from magshell_fenicsx.parts.imperfections.growth import grown_by
from magshell_fenicsx.parts.imperfections.imperfection import (
    ImperfectionSection,
    LocalSection,
    imperfection_geometries,
    in_frame,
)
from magshell_fenicsx.parts.magnetism.applied import AppliedField
from magshell_fenicsx.parts.magnetism.fields import MagneticSection
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.parts.shell_outline import reference_shell_of
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.shells.energy_factory import EnergyFactory
from magshell_fenicsx.simulate.perturbation import number_at_key, perturbed_scene, scale_at_key
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage, load_stage
from magshell_fenicsx.simulate.steps import stage_of_step
from magshell_fenicsx.simulate.transfer import same_mesh, transfer

NONZERO_FIELD = 1e-3  # a lambda_m that is not zero; nothing is solved in it
Array = NDArray[np.float64]
Imperfections: TypeAlias = Mapping[str, ImperfectionSection]
# steps of differences, of h, of a width or of the angle of a half-width
RESIDUAL_STEP = 1e-3  # for the residual
DEVIATION_STEP = 1e-6  # for dr0/dp


def fold_at(scene: Scene, record: Record) -> Fold:
    """Return the fold at a record with the label "fold", with its null vector; collective.

    Parameters
    ----------
    record
        Row of the history of this scene.

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
    stage = stage_of_record(scene, record)
    return find_fold(stage.newton, FoldGuess(stage.enter(record.point.state)), record.amplitude)


def stage_of_record(scene: Scene, record: Record) -> Stage:
    """Return the stage of a record's step: the scene with the solver of this step.

    It holds the conjugates that the step holds, at the values of the record.
    """
    if not record.step:
        return load_stage(scene)
    return stage_of_step(scene, scene.problem.programme[record.step - 1], record.point.state)


def sensitivities(scene: Scene, fold: Fold, record: Record | None = None) -> dict[str, float]:
    """Return derivatives of a fold's amplitude; collective.

    For a pressure they are derivatives of p/p_c, the knock-down factor.

    Parameters
    ----------
    record
        The record of the fold, if its step holds conjugates; None: all amplitudes are loads.

    Returns
    -------
    Derivatives by the name of the parameter, with all others fixed:

    - every other amplitude of the scene ("lambda_m", "force", that of a user-defined term, ...);
    - "defect.amplitude", "imperfections.0.width", ...: numbers of imperfections;
    - "remanence dimple", "remanence rest": a relative change of the remanence of one patch, within
      a dimple's rim or outside all ("remanence" where there is no dimple). Their sum is lambda_m
      times the derivative in lambda_m.
    """
    stage = stage_of_record(scene, record) if record else load_stage(scene)
    system, state, history = stage.newton.system, fold.state, scene.model.system.history
    # load columns of the amplitudes, then of the remanence and of a field of strength zero
    columns = {
        name: system.load(state.u, state.mu, name)
        for name in state.mu
        # entries of the history, as angles of edges, are no parameters
        if name not in (fold.name, *history)
    }
    by_patch = _remanence_columns(scene, replace(fold, state=stage.leave(state)))
    columns |= {  # columns of the model get zeros for unknown amplitudes
        name: stage.padded(column)
        for name, column in (by_patch | _field_column(scene, state)).items()
    }
    by_column = {name: sensitivity(system, fold, column) for name, column in columns.items()}
    return (
        by_column
        | imperfection_sensitivities(stage, fold)
        | member_shell_sensitivities(stage, fold)
    )


def _field_column(scene: Scene, state: State) -> dict[str, Vector]:
    """Return "lambda_m" -> R_lambda_m at lambda_m = 0, the load column of a field; collective.

    It serves a case whose section `magnetic` has the strength zero, so that the model has no such
    amplitude. Empty without this section, with another strength, and where the field would preserve
    less symmetry than the model has.

    Parameters
    ----------
    state
        State of the stage's system.
    """
    problem = scene.problem
    if problem.context.section_of(MagneticSection) is None or "lambda_m" in state.mu:
        return {}
    without_field = dict.fromkeys(  # None: not given, as lambda_m replaces them
        ("magnetic.remanent.flux_density", "magnetic.applied.flux_density")
    )
    with_field = problem.with_values({"magnetic.lambda_m": NONZERO_FIELD, **without_field})
    is_whole = not problem.axisymmetric and problem.mirror is None
    symmetry, symmetry_with_field = (
        (each.axisymmetric, each.mirror) for each in (problem, with_field)
    )
    assert with_field.loads.magnetic
    if not is_whole and symmetry != symmetry_with_field:
        return {}
    # unknown amplitudes stand behind the displacements
    model_state = State(state.u[: scene.model.system.size], state.mu)
    return {"lambda_m": _magnetic_column(scene, model_state, with_field.loads.magnetic)}


@dataclass(frozen=True)
class _RemanenceWithin:
    """A remanence in one patch, zero elsewhere.

    Attributes
    ----------
    remanence
        Vector (3,) over the largest flux density, or function of places and normals (n, 3).
    patch
        Function of places and normals that is 1 in the patch, and 0 elsewhere.
    """

    remanence: Array | Pattern
    patch: WithinRims

    def __call__(self, r0: Array, n0: Array) -> Array:
        vectors = self.remanence(r0, n0) if callable(self.remanence) else self.remanence
        return np.asarray(vectors * self.patch(r0, n0))


def _remanence_columns(scene: Scene, fold: Fold) -> dict[str, Vector]:
    """Return name of a sensitivity -> load column mu_i dPi_i/du of the remanence of one patch.

    Pi_i is the magnetic energy, mu_i its amplitude. So the column belongs to a relative change of
    the remanence in this patch. Empty without a remanence, with a soft material alone, and where
    magnets interact, as the energy then is quadratic in the remanence. Collective.

    Parameters
    ----------
    fold
        Fold with a state of the model.
    """
    field = scene.model.loads.magnetic
    if field is None or scene.model.loads.interaction:
        return {}
    if field.soft and field.soft.alone:
        return {}
    rims_by_patch = scene.problem.within
    if field.patches and scene.problem.context.sections.get("shells"):
        return _remanence_columns_of_shells(scene, fold.state, field, field.patches)
    if not rims_by_patch:
        return {"remanence": _magnetic_column(scene, fold.state, field)}

    # factors of the three components of the remanence
    ones, zeros = np.ones(3), 0 * np.ones(3)

    def factor_of(patch: str) -> WithinRims:
        """Return the factor that is 1 within a patch, and 0 elsewhere."""
        factor_within_rims = tuple(
            (rim, ones if name == patch else zeros) for name, rim in rims_by_patch.items()
        )
        factor_outside = ones if patch == "rest" else zeros
        return WithinRims(factor_within_rims, factor_outside)

    patches = (*rims_by_patch, "rest")
    field_of_patch = {
        patch: _RemanenceWithin(field.remanent, factor_of(patch)) for patch in patches
    }
    return {
        f"remanence {patch}": _magnetic_column(
            scene, fold.state, replace(field, remanent=remanence)
        )
        for patch, remanence in field_of_patch.items()
    }


def _remanence_columns_of_shells(
    scene: Scene, state: State, field: Magnetisation, patches: Mapping[str, Array | Pattern]
) -> dict[str, Vector]:
    """Return name of a sensitivity -> load column of the remanence of one of several shells.

    Collective.

    Parameters
    ----------
    patches
        Shell -> its remanence.
    """
    model = scene.model
    cells_of_patches: Mapping[str, NDArray[np.bool_]]  # shell -> which cells are its own
    if model.midsurface:
        cell_map = model.midsurface.mesh.topology.index_map(2)
        cells_of_patches = model.midsurface.patches
        cell_count = cell_map.size_local + cell_map.num_ghosts
    else:
        assert model.axisymmetric
        cells_of_patches, cell_count = model.meridian.patches, len(model.meridian.order)
    # the magnetisation with the remanence of one shell, and zero in all others
    without_remanence = dict.fromkeys(patches, np.zeros(3))
    field_of_shell = {
        name: replace(field, patches={**without_remanence, name: remanence}).on_cells(
            cells_of_patches, cell_count
        )
        for name, remanence in patches.items()
    }
    return {
        f"remanence {name}": _magnetic_column(scene, state, field)
        for name, field in field_of_shell.items()
    }


def _magnetic_column(scene: Scene, state: State, field: Magnetisation) -> Vector:
    """Return the load column lambda_m dPi/du of a magnetised shell, zero at supports; collective.

    Without an amplitude lambda_m in the state its factor is 1.

    Parameters
    ----------
    state
        State of the model.
    field
        Magnetisation, whose remanence replaces that of the model.
    """
    model, system = scene.model, scene.model.system
    column, terms = fem.Function(model.V), magnetic_terms(scene, state, field)

    def add_forces() -> None:
        """Add amplitude times dPi/du of each term to the column."""
        for term in terms:
            assert term.amplitude
            term.add_residual(column.x.array, state.mu.get(term.amplitude, 1.0))

    system.at_state(state).evaluate(add_forces)
    column.x.scatter_reverse(InsertMode.add)  # contributions of other ranks at shared nodes
    for support in system.clamped:  # zero, as u = 0 there
        support.set(column.x.array)
    return np.array(column.x.array[: model.system.size])


def magnetic_terms(scene: Scene, state: State, field: Magnetisation) -> Sequence[FormTerm]:
    """Return the magnetic terms of a model with another remanence, in the applied field of a state.

    Parameters
    ----------
    field
        Magnetisation with this remanence. A soft material alone has no terms.
    """
    terms, fields = _magnetic_terms_and_fields(scene, field)
    # fields that are known by their values have amplitudes of their own
    for applied in fields:
        applied.mu.update({name: state.mu.get(name, 0.0) for name in applied.names})
    return terms


def _magnetic_terms_and_fields(
    scene: Scene, field: Magnetisation
) -> tuple[Sequence[FormTerm], Sequence[AppliedField]]:
    """Return the magnetic terms of a remanence, and the applied fields that they read.

    A soft material alone has neither; beside a remanence it is left out.
    """
    model, log, fields = scene.model, KernelLog(), list[AppliedField]()
    # the factory appends to `fields` the applied fields of the terms that it makes
    factory = replace(model.factory, log=log, fields=fields)
    if field.soft and field.soft.alone:
        return [], fields
    field = replace(field, soft=None)
    if isinstance(factory, EnergyFactory):
        return [factory.term(energy) for energy in factory.magnetic(field)], fields
    return factory.magnetic(field), fields


def imperfection_sensitivities(stage: Stage, fold: Fold) -> dict[str, float]:
    """Return derivatives of a fold's amplitude by numbers of imperfections; collective.

    The keys are those of the case below `shell`, as "defect.amplitude"; angles are in degrees.

    Numbers that move a rim between patches of a remanence or of a natural shape are left out: edges
    of the mesh lie on this rim. A derivative is zero where its imperfection would break a symmetry
    that the half or the meridian has.
    """
    problem = stage.scene.problem
    return {
        f"{key}.{name}": _derivative(stage, fold, key, name)
        for key, section in problem.imperfections.items()
        for name in section.parameters
        if _varies(problem, section, name)
    }


def _varies(problem: Problem, section: ImperfectionSection, name: str) -> bool:
    """Return whether a number of an imperfection can vary on the mesh of the problem.

    A rim between patches cannot move. A centre must be given by angles on a sphere, and not at the
    pole.

    Parameters
    ----------
    name
        Number of the section, such as "width" or "at.polar".
    """
    # the depth of a dimple, its amplitude, leaves the rim where it is
    has_rim = section.patch and problem.patched
    if has_rim and name != "amplitude":
        return False
    if not name.startswith("at."):  # it is no number of the centre
        return True
    assert isinstance(section, LocalSection)
    spherical = problem.context.shell.geometry in ("hemisphere", "cap") and section.at.point is None
    return spherical and section.at.polar != 0


def _derivative(stage: Stage, fold: Fold, key: str, name: str) -> float:
    """Return the derivative of a fold's amplitude by one number p of an imperfection; collective.

    Two central differences are nested. The inner one, between p - `tiny` and p + `tiny`, gives
    dw0/dp, as exact as rounding allows. The outer one moves the surface along dw0/dp, once for the
    change `step` of p and once for -`step`; this is wide enough for the residual.

    Parameters
    ----------
    key, name
        Key of the imperfection, such as "imperfections.0", and its number, such as "at.polar".
    """
    scene = stage.scene
    if scene.problem.axisymmetric and name.startswith("at."):
        return 0.0  # to first order an axisymmetric shell does not feel a centre beside the axis
    problem = scene.problem
    # steps of both differences, over the scale of the number
    scale = _scale_of_number(problem, key, name)
    step, tiny = RESIDUAL_STEP * scale, DEVIATION_STEP * scale
    forward, backward = (
        _deviation(scene, with_changed_number(problem.imperfections, key, name, tiny_change), key)
        for tiny_change in (tiny, -tiny)
    )

    def amplitude_change(change: float) -> float:
        """Return the change of the fold's amplitude for a change of the number, to first order."""
        deviation = DeviationDifference(forward, backward, factor=change / (2 * tiny))
        return _amplitude_change(stage, fold, with_deviation(scene, deviation))

    # amplitude -> keys of the imperfections that it makes grow in a step. Such an amplitude
    # multiplies the deviation
    keys_of_amplitudes = grown_by(scene.problem.programme, problem.imperfections)
    factors = [
        fold.state.mu[amplitude] for amplitude, keys in keys_of_amplitudes.items() if key in keys
    ]
    factor = factors[0] if factors else 1.0
    return factor * (amplitude_change(step) - amplitude_change(-step)) / (2 * step)


def _amplitude_change(stage: Stage, fold: Fold, other: Scene) -> float:
    """Return -(phi . R)/(phi . R_mu) of a fold's state in a scene with a slightly other shell.

    It is the change of the fold's amplitude to first order: at the fold's own displacement and
    amplitudes the other shell has a residual R that is not zero. Places in contact stay the same as
    in the fold's state. Collective.

    Parameters
    ----------
    other
        Scene of the other shell on the same mesh.
    """
    scene, size = stage.scene, stage.scene.model.system.size
    assert same_mesh(scene, other)
    u, left_null_vector = (
        # unknown amplitudes of a loading device come after the displacement, and stay as they are
        np.concatenate([transfer(scene, other, vector[:size]), vector[size:]])
        for vector in (fold.state.u, fold.left_null_vector)
    )
    expand_contact(scene, other, stage.leave(fold.state))
    system = stage.on_scene(other).newton.system
    other_fold = replace(fold, state=State(u, fold.state.mu), left_null_vector=left_null_vector)
    return sensitivity(system, other_fold, system.residual(u, fold.state.mu))


def expand_contact(scene: Scene, other: Scene, state: State) -> None:
    """Expand all contact in another scene into polynomials about a state of the first scene.

    Places in contact then stay, so that differences of residuals are smooth. Both scenes have the
    same mesh. Contact of bodies is expanded about the gap at the state. Collective.
    """
    expand_shell_contact(scene, other, state)
    evaluation = scene.model.system.at_state(state)
    # the same body in both scenes
    for name, (body_contact, _) in scene.model.contacts.items():
        other_contact, _ = other.model.contacts[name]
        gap_at_state = evaluation.evaluate(partial(getattr, body_contact, "gap"))
        other_contact.expand_about(gap_at_state)


def expand_shell_contact(scene: Scene, other: Scene, state: State) -> None:
    """Expand contact between shells in another scene into polynomials about a state of the first.

    Both scenes have the same mesh. If contact of the first scene is an expansion already, the other
    scene takes this one. Collective.
    """
    assert np.array_equal(scene.model.V.dofmap.list, other.model.V.dofmap.list), (
        "contact is given by numbers of cells"
    )
    evaluation = scene.model.system.at_state(state)
    contacts: Sequence[Any] = scene.model.shell_contacts
    other_contacts: Sequence[Any] = other.model.shell_contacts
    for shell_contact, other_contact in zip(contacts, other_contacts, strict=True):
        if shell_contact.held:  # the expansion that takes its place
            other_contact.hold(shell_contact.held)
        else:
            other_contact.expand_about(evaluation.evaluate(shell_contact.freeze))


def member_shell_sensitivities(stage: Stage, fold: Fold) -> dict[str, float]:
    """Return key -> derivative of a fold's amplitude by a number of an imperfection; collective.

    The imperfections are those of several shells, each of which has its own section in the case.
    """
    context, derivatives = stage.scene.problem.context, dict[str, float]()
    for name, member in (context.sections.get("shells") or {}).items():
        for index, section in enumerate(member.shell.imperfections):
            for number in section.parameters:
                key = f"shells.{name}.shell.imperfections.{index}.{number}"
                if not number.startswith("at."):  # numbers of a centre are left out
                    derivatives[key] = _derivative_by_number(stage, fold, key)
    return derivatives


def _derivative_by_number(stage: Stage, fold: Fold, key: str) -> float:
    """Return the derivative of a fold's amplitude by a number of the case; collective.

    It is a central difference of the change of this amplitude to first order, with a scene for each
    of two values of the number.

    Parameters
    ----------
    key
        Key of the number in the case, as in "shells.upper.shell.imperfections.0.amplitude".
    """
    scene, context = stage.scene, stage.scene.problem.context
    value, step = number_at_key(context, key), RESIDUAL_STEP * scale_at_key(context, key)
    forward, backward = (
        _amplitude_change(stage, fold, perturbed_scene(scene, key, value + change))
        for change in (step, -step)
    )
    return (forward - backward) / (2 * step)


def _scale_of_number(problem: Problem, key: str, name: str) -> float:
    """Return the scale of a number of an imperfection, over which differences take their steps.

    Widths have their own value as the scale, angles of a centre the half-width of the imperfection
    in degrees, and depths the thickness h, which is 1 in their unit.
    """
    section, shell = problem.imperfections[key], problem.context.shell
    if name == "width":
        return float(getattr(section, name))
    if name.startswith("at."):
        assert isinstance(section, LocalSection)
        return degrees(section.half_width(shell.R_over_h, shell.poisson_ratio))
    return 1.0


def with_changed_number(
    sections: Imperfections, key: str, name: str, change: float
) -> Imperfections:
    """Return imperfections with one number that differs by `change`.

    Parameters
    ----------
    key, name
        Key of the imperfection, such as "imperfections.0", and its number, such as "at.polar".
    """
    return {**sections, key: _changed(sections[key], name, change)}


def _changed(part: Any, path: str, change: float) -> Any:
    """Return a section, a list or a number with a changed number in it.

    Parameters
    ----------
    path
        Keys and indices to the number, joined by dots; "": the part is the number itself.
    """
    if not path:
        return part + change
    key, _, remaining_path = path.partition(".")
    if isinstance(part, list):
        return [
            _changed(item, remaining_path, change) if i == int(key) else item
            for i, item in enumerate(part)
        ]
    return part.model_copy(update={key: _changed(getattr(part, key), remaining_path, change)})


@dataclass(frozen=True)
class DeviationDifference:
    """A deviation along the derivative of another one, by the difference of two of its values.

    Attributes
    ----------
    forward, backward
        The other deviation for two values of its number.
    factor
        Factor of their difference: a change of the number over the distance of the two values.
    """

    forward: Deviation
    backward: Deviation
    factor: float

    def __call__(self, places: Array) -> Array:
        """Return the deviation w0 (n,) at places (n, 3)."""
        return np.asarray(self.factor * (self.forward(places) - self.backward(places)))


@dataclass(frozen=True)
class _MirroredDeviation:
    """The mean of a deviation and its mirror image: the part that half of a shell has."""

    deviation: Deviation
    mirror: Mirror

    def __call__(self, places: Array) -> Array:
        """Return the deviation w0 (n,) at places (n, 3)."""
        return np.asarray((self.deviation(places) + self.deviation(self.mirror.image(places))) / 2)


def _deviation(scene: Scene, sections: Imperfections, key: str) -> Deviation:
    """Return the deviation of one imperfection, in the frame of the scene's model.

    With a mirror plane it is symmetric about this plane.

    Parameters
    ----------
    sections, key
        All imperfections, and the key of the one in question.
    """
    problem, position = scene.problem, list(sections).index(key)
    # by position, not by key: each dimple of random ones has a geometry of its own, and such
    # geometries have other keys than the sections
    geometries = imperfection_geometries(sections, reference_shell_of(problem.context.shell))
    geometry = list(geometries.values())[position]
    turned_deviation = in_frame(geometry.deviation, problem.azimuth)
    return (
        _MirroredDeviation(turned_deviation, problem.mirror) if problem.mirror else turned_deviation
    )


def with_deviation(scene: Scene, deviation: Deviation) -> Scene:
    """Return the scene on the same mesh in the chart, with one more deviation; collective.

    The deviation is added to those that the embedding, the map from the chart into space, has.
    """
    problem, model = scene.problem, scene.model

    def deviated(embedding: object) -> DeviatedEmbedding:
        """Return an embedding with the further deviation."""
        assert isinstance(embedding, DeviatedEmbedding)
        return replace(embedding, deviations=(*embedding.deviations, deviation))

    embedding = deviated(problem.embedding)
    meridian = problem.meridian and replace(
        problem.meridian, embedding=deviated(problem.meridian.embedding)
    )
    shape = model.midsurface.with_embedding(embedding) if model.midsurface else problem.shape
    return Scene(replace(problem, embedding=embedding, meridian=meridian, shape=shape), scene.comm)

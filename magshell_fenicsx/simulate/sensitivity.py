"""Sensitivities of the amplitude at a fold, for instance of the buckling pressure.

They are gradients: the `Adjoint` of the fold gives the derivative d mu*/dp = w . R_p by each
parameter p, with w = -phi/(phi . R_mu).

By the numbers of an imperfection R_p is a central difference, (R(r0 + s dr0/dp) - R(r0 - s
dr0/dp))/(2 s): where the chart's nodes stay, r0 alone depends on an imperfection. A rim makes r0
rough in p beside it, but R is smooth in r0. Differences of folds converge to these derivatives on
the same mesh: for depths with the square of their step, for what moves a rim with the step itself.
Between new meshes, whose edges follow the rim, they have the meshes' noise over the step.

Words and symbols:

- R is the residual Pi_u, the derivative of the potential energy by the displacement u; phi is the
  left null vector of the tangent at the fold. mu holds the amplitudes (load parameters) by name.
- r0 is the undeformed mid-surface, a function of the chart (its coordinates). A deviation w0 is its
  distance from the perfect surface. A rim is the edge of a dimple; it may separate patches.
- h and R are thickness and reference length.
- A stage is a scene with the solver of one step, whose system may have further unknowns.
- In a case of several shells each one is a member shell, with sections of its own.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import degrees
from typing import Any, TypeAlias

import numpy as np
from dolfinx import fem
from dolfinx.la import InsertMode
from numpy.typing import NDArray

from magshell_fenicsx.continuation.fold import Fold, residual_multiplier
from magshell_fenicsx.continuation.system import State, Vector, dot
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.mesh.patch import DeviatedEmbedding, Deviation
from magshell_fenicsx.parts.imperfections.growth import grown_by
from magshell_fenicsx.parts.imperfections.imperfection import (
    ImperfectionSection,
    LocalSection,
    imperfection_geometries,
    in_frame,
)
from magshell_fenicsx.parts.magnetism.fields import FIELD, MagneticSection
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.parts.shell_outline import reference_shell_of
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint, adjoint_of_fold, by_load
from magshell_fenicsx.simulate.gradients.fields import by_field, magnetic_terms
from magshell_fenicsx.simulate.perturbation import (
    expand_contact,
    number_at_key,
    perturbed_scene,
    scale_at_key,
)
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.scene_cache import SceneCache
from magshell_fenicsx.simulate.stage import Stage, load_stage
from magshell_fenicsx.simulate.steps import stage_of_record
from magshell_fenicsx.simulate.transfer import transfer

NONZERO_FIELD = 1e-3  # strength of a field in which nothing is solved
Array = NDArray[np.float64]
Mask: TypeAlias = NDArray[np.bool_]
Imperfections: TypeAlias = Mapping[str, ImperfectionSection]
# steps of differences, of h, of a width or of the angle of a half-width
RESIDUAL_STEP = 1e-3  # for the residual
DEVIATION_STEP = 1e-6  # for dr0/dp


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

    - every other amplitude of the scene ("force", that of the field, of a user-defined term, ...);
    - "defect.amplitude", "imperfections.0.width", ...: numbers of imperfections;
    - "remanence dimple", "remanence rest": a relative change of the remanence of one patch, within
      a dimple's rim or outside all ("remanence" where there is no dimple). Their sum is the
      strength of the field times the derivative by it.
    """
    stage = stage_of_record(scene, record) if record else load_stage(scene)
    adjoint = adjoint_of_fold(stage, fold)
    # entries of the history, as angles of edges, are no parameters
    not_varied = {fold.name, *scene.model.system.history}
    amplitudes = [name for name in fold.state.mu if name not in not_varied]
    return {
        **{name: by_load(adjoint, name) for name in amplitudes},
        **_by_remanence(adjoint),
        **_by_absent_field(adjoint),
        **_by_imperfections(stage, fold),
        **_by_imperfections_of_member_shells(stage, fold),
    }


def _by_remanence(adjoint: Adjoint) -> dict[str, float]:
    """Return name -> derivative by a relative change of the remanence of one patch; collective.

    Empty without a remanence, with a soft material alone, and where magnets interact, as the energy
    then is quadratic in the remanence.
    """
    scene, loads = adjoint.scene, adjoint.scene.model.loads
    field = loads.magnetic
    if field is None or loads.interaction:
        return {}
    if field.soft and field.soft.alone:
        return {}
    gradient = by_field(adjoint, "magnitude")
    is_of_shells = field.patches and scene.problem.context.sections.get("shells")
    if is_of_shells:
        masks = _of_shells(scene, field, len(gradient.forces))
    elif scene.problem.within:
        masks = _of_rims(scene.problem, gradient.places.mean(axis=1))
    else:
        masks = {"": np.ones(len(gradient.forces), dtype=bool)}
    return {
        f"remanence {patch}".rstrip(): float(gradient.within(cells)[0])
        for patch, cells in masks.items()
    }


def _of_rims(problem: Problem, centres: Array) -> dict[str, Mask]:
    """Return patch -> which cells are within the rim of this dimple; "rest": within none.

    Where two rims overlap, the first one counts.

    Parameters
    ----------
    centres
        Centres (cells, 3) of the cells, of which each is within a rim or outside of it.
    """
    masks = dict[str, Mask]()
    rest: Mask = np.ones(len(centres), dtype=bool)
    for name, is_inside in problem.within.items():
        masks[name] = rest & is_inside(centres)
        rest = rest & ~masks[name]
    return {**masks, "rest": rest}


def _of_shells(scene: Scene, field: Magnetisation, count: int) -> dict[str, Mask]:
    """Return patch -> which of this rank's own cells have the remanence of this patch.

    Where patches overlap, the last one counts.

    Parameters
    ----------
    count
        Number of this rank's own cells.
    """
    model, patches = scene.model, dict[str, Mask]()
    if model.midsurface:
        patches |= model.midsurface.patches
    elif model.axisymmetric:
        patches |= model.meridian.patches
    masks = dict[str, Mask]()
    rest: Mask = np.ones(count, dtype=bool)
    for name in reversed(list(field.patches or ())):
        masks[name] = rest & patches[name][:count]
        rest = rest & ~masks[name]
    return dict(reversed(masks.items()))


def _by_absent_field(adjoint: Adjoint) -> dict[str, float]:
    """Return the field's amplitude -> derivative by its strength where that is 0; collective.

    It serves a case whose section `magnetic` has the strength zero, so that the model has no such
    amplitude. Empty without this section, with another strength, and where the field would preserve
    less symmetry than the model has.
    """
    scene, problem, state = adjoint.scene, adjoint.scene.problem, adjoint.state
    if problem.context.section_of(MagneticSection) is None or FIELD.name in state.mu:
        return {}
    with_field = problem.with_values(MagneticSection.with_strength(NONZERO_FIELD))
    is_whole = not problem.axisymmetric and problem.mirror is None
    symmetry, symmetry_with_field = (
        (each.axisymmetric, each.mirror) for each in (problem, with_field)
    )
    assert with_field.loads.magnetic
    if not is_whole and symmetry != symmetry_with_field:
        return {}
    column = _magnetic_column(scene, state, with_field.loads.magnetic)
    return {FIELD.name: float(dot(scene.model.system.comm, adjoint.places[0].w, column))}


def _magnetic_column(scene: Scene, state: State, field: Magnetisation) -> Vector:
    """Return the load column of a magnetised shell in its field, zero at supports; collective.

    It is the derivative of the energy by the displacement. Without an amplitude of the field in the
    state, that of a field of strength one.

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


def _by_imperfections(stage: Stage, fold: Fold) -> dict[str, float]:
    """Return derivatives by the numbers of imperfections; collective.

    The keys are those of the case below `shell`, as "defect.amplitude"; angles are in degrees.

    Numbers that move a rim between patches of a remanence or of a natural shape are left out: edges
    of the mesh lie on this rim. A derivative is zero where its imperfection would break a symmetry
    that the half or the meridian has.
    """
    problem = stage.scene.problem
    return {
        f"{key}.{name}": _by_imperfection(stage, fold, key, name)
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


def _by_imperfection(stage: Stage, fold: Fold, key: str, name: str) -> float:
    """Return the derivative by one number p of an imperfection; collective.

    Two central differences are nested. The inner one, between p - `tiny` and p + `tiny`, gives
    dw0/dp, as exact as rounding allows. The outer one moves the surface along dw0/dp, once for the
    change `step` of p and once for -`step`; this is wide enough for the residual.

    Parameters
    ----------
    key, name
        Key of the imperfection, such as "imperfections.0", and its number, such as "at.polar".
    """
    scene, problem = stage.scene, stage.scene.problem
    if problem.axisymmetric and name.startswith("at."):
        return 0.0  # to first order an axisymmetric shell does not feel a centre beside the axis
    # steps of both differences, over the scale of the number
    scale = _scale_of_number(problem, key, name)
    step, tiny = RESIDUAL_STEP * scale, DEVIATION_STEP * scale
    forward, backward = (
        _deviation(scene, with_changed_number(problem.imperfections, key, name, tiny_change), key)
        for tiny_change in (tiny, -tiny)
    )

    def scene_at(change: float) -> Scene:
        """Return the scene for a change of the number, to first order."""
        deviation = DeviationDifference(forward, backward, factor=change / (2 * tiny))
        return with_deviation(scene, deviation)

    # amplitude -> keys of the imperfections that it makes grow in a step. Such an amplitude
    # multiplies the deviation
    keys_of_amplitudes = grown_by(problem.programme, problem.imperfections)
    factors = [
        fold.state.mu[amplitude] for amplitude, keys in keys_of_amplitudes.items() if key in keys
    ]
    factor = factors[0] if factors else 1.0
    return factor * _central_difference(stage, fold, scene_at, step)


def _by_imperfections_of_member_shells(stage: Stage, fold: Fold) -> dict[str, float]:
    """Return key -> derivative by a number of an imperfection of one of several shells; collective.

    Each of these shells has its own section in the case.
    """
    members = stage.scene.problem.context.sections.get("shells") or {}
    return {key: _by_number(stage, fold, key) for key in _numbers_of_member_shells(members)}


def _by_number(stage: Stage, fold: Fold, key: str) -> float:
    """Return the derivative by a number of the case, from scenes on the same mesh; collective."""
    scenes = SceneCache(base=stage.scene)
    context = stage.scene.problem.context
    value, step = number_at_key(context, key), RESIDUAL_STEP * scale_at_key(context, key)
    return _central_difference(
        stage, fold, lambda change: perturbed_scene(scenes, key, value + change), step
    )


def _numbers_of_member_shells(members: Mapping[str, Any]) -> Iterator[str]:
    """Yield the keys of the numbers of several shells' imperfections, but for their centres."""
    for name, member in members.items():
        for index, section in enumerate(member.shell.imperfections):
            for number in section.parameters:
                if not number.startswith("at."):
                    yield f"shells.{name}.shell.imperfections.{index}.{number}"


def _central_difference(
    stage: Stage, fold: Fold, scene_at: Callable[[float], Scene], step: float
) -> float:
    """Return the derivative of a fold's amplitude by a number, from two scenes; collective.

    Parameters
    ----------
    scene_at
        Change of the number -> scene on the same mesh.
    step
        Change of the number in the one scene; in the other one it is the negative.
    """
    forward, backward = (_amplitude_change(stage, fold, scene_at(c)) for c in (step, -step))
    return (forward - backward) / (2 * step)


def _amplitude_change(stage: Stage, fold: Fold, other: Scene) -> float:
    """Return w . R of a fold's state in a scene with a slightly other shell; collective.

    It is the change of the fold's amplitude to first order: at the fold's own displacement and
    amplitudes the other shell has a residual R that is not zero. Places in contact stay the same as
    in the fold's state.

    Parameters
    ----------
    other
        Scene of the other shell on the same mesh.
    """
    scene, size = stage.scene, stage.scene.model.system.size
    u, left_null_vector = (
        # unknown amplitudes of a loading device come after the displacement, and stay as they are
        np.concatenate([transfer(scene, other, vector[:size]), vector[size:]])
        for vector in (fold.state.u, fold.left_null_vector)
    )
    expand_contact(scene, other, stage.leave(fold.state))
    system = stage.on_scene(other).newton.system
    other_fold = replace(fold, state=State(u, fold.state.mu), left_null_vector=left_null_vector)
    residual = system.residual(u, fold.state.mu)
    return dot(system.comm, residual_multiplier(system, other_fold), residual)


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

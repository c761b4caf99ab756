"""The magnetisation and the applied field of a case, in the model's frame.

In: the section `magnetic`. Out: a `Magnetisation` for the model's loads, and the symmetries that it
leaves to a model.

- A model's frame is that of the case, turned by `turn` (rad) about e3.
- The remanence is a vector (3,) if it is uniform, else a pattern: a function of undeformed places
  and normals (both (..., 3), places over R) that gives vectors. It is over its magnitude.
- lambda_m is the amplitude (load parameter) of the applied field; a field in space, as of sources,
  is a function of the deformed place.
- A rim is the edge of a dimple, which is a patch: a part of the surface with a name. "rest" names
  everything outside all patches.
- An outline is the undeformed shape of a shell, with its meridian if it is one of revolution.
- A symmetry constraint says which mirror planes, and whether axisymmetry, a part of a case leaves
  to a model.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.expressions import FormulaVectors, formula, formula_function
from magshell_fenicsx.input.section import Direction
from magshell_fenicsx.input.tables import read_vectors
from magshell_fenicsx.mesh.mirror import Mirror, rotation
from magshell_fenicsx.mesh.patch import UserField
from magshell_fenicsx.models.shell.control_points import ControlledPattern, ControlPoints
from magshell_fenicsx.models.shell.spatial_fields import (
    Components,
    InsideRim,
    Pattern,
    PosedPattern,
    WithinRims,
    radial,
    tangential,
)
from magshell_fenicsx.parts.ability import Context, Modelled
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.field_maps import field_maps
from magshell_fenicsx.parts.magnetism.field_step import FieldSection, RotationSection
from magshell_fenicsx.parts.magnetism.fields import MU_0, MagneticSection, strength
from magshell_fenicsx.parts.magnetism.interaction import interaction
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.parts.magnetism.remanent import RemanentSection, layer_average
from magshell_fenicsx.parts.magnetism.sensors import is_read, sensors, units
from magshell_fenicsx.parts.magnetism.soft_magnet import SoftMagnet
from magshell_fenicsx.parts.magnetism.sources.field import in_space, turns, values
from magshell_fenicsx.parts.magnetism.sources.source import SourceSection
from magshell_fenicsx.parts.shell_sections import MeshSurface
from magshell_fenicsx.shape.field_symmetry import (
    FieldFunction,
    equal_to_rounding,
    formula_field,
    is_axisymmetric,
    is_mirror_image,
    with_nearby_places,
)
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.symmetry_constraint import (
    PARALLEL,
    SymmetryConstraint,
    no_plane,
    tilted,
)

Array = NDArray[np.float64]
MIRROR_TOLERANCE = 1e-10  # difference of a uniform vector from its mirror image: rounding
EQUALITY_TOLERANCE = 1e-9  # part of a direction outside a plane: rounding
NORMALS_SEED, SAMPLED_NORMALS = 7, 40  # random directions that stand for all normals


def by_points(section: RemanentSection, turn: float = 0.0) -> ControlledPattern:
    """Return a remanence given by vectors at points, in a frame turned by `turn` about e3 (rad).

    The vectors are read from the section's file, and averaged over its filter length.

    Raises
    ------
    CaseError
        If its file cannot be read.
    """
    places, vectors = read_vectors(section.path, "magnetic.remanent.file", section.files)
    assert section.filter
    return ControlledPattern(
        ControlPoints(places, section.filter), vectors, rotation(turn) if turn else None
    )


def magnetisation(
    magnetic: MagneticSection,
    context: Context,
    turn: float,
    patch_rims: Mapping[str, InsideRim],
    to: Sequence[Direction] = (),
) -> Magnetisation:
    """Return the magnetisation of a case, in a frame turned by `turn` about e3 (rad).

    Parameters
    ----------
    magnetic
        The section of the case file.
    patch_rims
        Name of the patch of each dimple -> whether places (n, 3) are within its rim.
    to
        Directions that steps turn the field to, in the order of the steps. A uniform or linear
        field needs one amplitude for each dimension that they span.

    Raises
    ------
    CaseError
        If a file of vectors or of a source cannot be read.
    """
    section = magnetic.remanent or RemanentSection.model_construct()
    # a field in space at rest (None without one), and further ones that amplitudes move
    field, moving_fields = in_space(context, turn)
    # flux densities of a remanence of length one, and of lambda_m = 1; nan if not known
    tesla_of_remanence, tesla_of_lambda = units(context)
    # unit vectors along the field's directions: the first one, and across it those it turns to. A
    # field in space has one direction and turns as a whole
    later_directions = [] if field else [direction.vector(turn) for direction in to]
    basis = _orthonormal_basis(magnetic.applied.vector(turn), later_directions)
    applied, *across = (magnetic.applied.uniform * e for e in basis)
    # remanences of the patches of a mesh; those of dimples are in the pattern of `_remanence`
    patches = _on_patches_of_mesh(section, context, turn)
    remanent = _remanence(section, context, turn, patch_rims) if magnetic.remanent else np.zeros(3)
    layers = tuple((layer.fraction, layer.vector(turn)) for layer in section.layers or [])
    has_metres = context.shell.with_units and np.isfinite(tesla_of_lambda)
    return Magnetisation(
        remanent,
        applied,
        energy=magnetic.energy,
        # a field in space has its own gradient
        gradient=None if field else _gradient(magnetic, turn),
        across=tuple(across),
        patches=patches,
        layers=layers,
        law=magnetic.remanence,
        in_space=field,
        axes=tuple(basis),
        driven=moving_fields,
        turns=turns(context, turn),
        given=section.components if isinstance(section.components, UserField) else None,
        soft=soft_magnet(context, turn, patch_rims),
        tesla=tesla_of_remanence if np.isfinite(tesla_of_remanence) else 1.0,
        metres=context.shell.reference if has_metres else 0.0,
        absent=magnetic.lambda_m == 0 and not is_read(context),
    )


def _gradient(magnetic: MagneticSection, turn: float) -> Array | None:
    """Return the gradient (3, 3) of the applied field in the turned frame; None without one."""
    gradient, Q = magnetic.applied.gradient, rotation(turn)
    return Q @ np.array(gradient) @ Q.T if gradient else None


def _on_patches_of_mesh(
    section: RemanentSection, context: Context, turn: float
) -> dict[str, Array | Pattern] | None:
    """Return name of each patch of a mesh -> its remanence; None without such patches."""
    if not (section.patches and isinstance(context.shell, MeshSurface)):
        return None
    return {name: _on_patch(patch, context, turn) for name, patch in section.patches.items()}


def _orthonormal_basis(first: Array, directions: Sequence[Array]) -> list[Array]:
    """Return unit vectors, normal to each other, that span the unit vector `first` and directions.

    They are found by Gram-Schmidt; `first` is the first of them.
    """
    basis = [first]
    for direction in directions:
        normal_part = direction - np.sum([(direction @ e) * e for e in basis], axis=0)
        if np.linalg.norm(normal_part) > EQUALITY_TOLERANCE:
            basis.append(normal_part / np.linalg.norm(normal_part))
    return basis


def soft_magnet(
    context: Context, turn: float, patch_rims: Mapping[str, InsideRim]
) -> SoftMagnet | None:
    """Return the soft-magnetic material, in a frame turned by `turn` about e3 (rad).

    None without a susceptibility. The susceptibility may be a number, a formula, or a mapping of
    patches to numbers. `patch_rims` maps the name of each dimple's patch to a function that says
    whether places (n, 3) are within its rim.
    """
    magnetic = context.section_of(MagneticSection)
    if magnetic is None or magnetic.susceptibility is None:
        return None
    chi, E, remanent = magnetic.susceptibility, context.shell.youngs_modulus, magnetic.remanent
    # a number or a pattern everywhere, or a value (1,) for each patch of a mesh
    pattern: float | Pattern = float(chi) if isinstance(chi, float | int) else 0.0
    patches = dict[str, Array]()
    if isinstance(chi, str):
        pattern = FormulaVectors([formula_function(chi)], rotation(turn), 1.0)
    elif isinstance(chi, dict) and isinstance(context.shell, MeshSurface):
        patches = {name: np.array([value]) for name, value in chi.items()}
    elif isinstance(chi, dict):
        # dimples are the only patches here
        rest_value = np.array([chi.get("rest", 0.0)])
        rims = tuple(
            (inside, np.array([chi[name]]) if name in chi else rest_value)
            for name, inside in patch_rims.items()
        )
        pattern = WithinRims(rims, rest_value) if rims else float(rest_value[0])
    # |Ba| over sqrt(mu_0 E) for lambda_m = 1: a soft energy is quadratic in the field itself
    scale = 1.0
    remanent_flux_density = remanent.flux_density if remanent else None
    if remanent_flux_density and E:
        scale = sqrt(MU_0 * E) / remanent_flux_density
    # T for lambda_m = 1
    tesla = magnetic.tesla(E) if E and magnetic.lambda_m is None else 1.0
    largest_polarisation = None if magnetic.saturation is None else magnetic.saturation / tesla
    return SoftMagnet(
        pattern, scale, tesla, remanent is None, patches or None, largest_polarisation
    )


def soft_mirrored(chi: Any, outline: Outline, mirror: Mirror) -> bool:
    """Return whether a plane mirrors the susceptibility `chi`, the value of its key.

    Only a formula can break the symmetry here: patches are mapped onto themselves.
    """
    return not isinstance(chi, str) or is_mirror_image(formula_field(chi), mirror, outline.sample())


def _on_patch(section: Direction, context: Context, turn: float) -> Array | Pattern:
    """Return the remanence on a patch, in a frame turned by `turn` about e3 (rad).

    It is a vector (3,) or a pattern. A patch may be one of several shells. Its remanence is then
    given in the shell's own frame, and moved with the shell to its pose in the model.
    """
    if not isinstance(section, RemanentSection) or section.of_shell is None:
        return section.vector(turn)
    place, factor = section.of_shell  # the pose of the shell, and a factor of its remanence
    # in the shell's own frame there is no turn and no dimple
    remanence = _remanence(section, context, turn=0.0, patch_rims={})
    return (
        factor * remanence @ place.Q.T
        if isinstance(remanence, np.ndarray)
        else PosedPattern(remanence, place, factor)
    )


def _remanence(
    section: RemanentSection, context: Context, turn: float, patch_rims: Mapping[str, InsideRim]
) -> NDArray[np.float64] | Pattern:
    """Return the remanence over its magnitude, in a frame turned by `turn` about e3 (rad).

    It is a vector (3,) or a pattern. Patches of a mesh are not included, dimples are: `patch_rims`
    maps their names to functions that say whether places (n, 3) are within the rim.
    """
    if section.kind == "radial":
        return radial
    if section.kind == "tangential":
        return tangential
    if isinstance(section.components, list):
        return Components(
            [formula(text) for text in section.components], rotation(turn) if turn else None
        )
    if section.file:
        return by_points(section, turn)
    if section.layers:
        return layer_average(section.layers, turn)
    if section.patches and not isinstance(context.shell, MeshSurface):
        vectors = {name: direction.vector(turn) for name, direction in section.patches.items()}
        rest_vector = vectors.pop("rest")
        rims = tuple(
            (inside, vectors.get(name, rest_vector)) for name, inside in patch_rims.items()
        )
        return WithinRims(rims, rest_vector) if vectors else rest_vector
    return section.vector(turn)


@dataclass(frozen=True)
class _MagneticVectors:
    """Remanence and applied field of a case, as a symmetry must preserve them.

    A plane is a mirror if it maps both to themselves, or both to their opposites: the energy is a
    product of both.

    Attributes
    ----------
    vectors
        Uniform remanences and the uniform applied field, (3,) each.
    turned_directions
        Directions (3,) to which the programme turns the uniform field.
    fields
        Remanences and applied fields that vary: places (n, 3) -> vectors (n, 3).
    sources
        Fields of sources, functions like `fields`; they are smooth.
    along_normals
        Remanences that depend on the normal alone: radial and tangential ones.
    varying_patterns
        Patch -> its remanence, if that is another pattern in the frame of the patch. These are in
        `fields` too.
    by_points
        The remanence as vectors at points in space; None without a file. It is in `fields` too.
    is_beside_surface
        Whether the applied field is a formula of the deformed place, which lies off the surface.
    """

    vectors: Sequence[Array]
    turned_directions: Sequence[Array]
    fields: Sequence[FieldFunction]
    sources: Sequence[FieldFunction]
    along_normals: Sequence[Pattern]
    varying_patterns: Mapping[str, PosedPattern]
    by_points: ControlledPattern | None
    is_beside_surface: bool

    def has_mirror(self, mirror: Mirror, outline: Outline) -> bool:
        """Return whether a plane maps remanence and field to themselves or both to opposites."""
        # places (n, 3) at which fields that vary are compared; none are needed without such fields
        x = outline.sample() if self.fields or self.sources else np.zeros((0, 3))
        if self.is_beside_surface:
            x = with_nearby_places(x)
        return self._has_images(mirror, x, sign=1.0) or self._has_images(mirror, x, sign=-1.0)

    def _has_images(self, mirror: Mirror, x: Array, sign: float) -> bool:
        """Return whether mirror images are `sign` times the vectors, at places x (n, 3)."""
        S = mirror.reflection
        some_places = x[:: len(x) // 50 + 1]  # enough for smooth fields
        places_of_fields = [
            *((field, x) for field in self.fields),
            *((field, some_places) for field in self.sources),
        ]
        vectors_have_images = all(
            np.abs(S @ v - sign * v).max() <= MIRROR_TOLERANCE
            for v in (*self.vectors, *self.turned_directions)
        )
        fields_have_images = all(
            is_mirror_image(field, mirror, places, sign=sign) for field, places in places_of_fields
        )
        if not vectors_have_images or not fields_have_images:
            return False
        return self._remanence_along_normals_has_image(S, sign)

    def _remanence_along_normals_has_image(self, S: Array, sign: float) -> bool:
        """Return whether a reflection S maps radial and tangential remanences to `sign` times them.

        They depend on the normal alone, and random directions stand for all normals.
        """
        directions = np.random.default_rng(NORMALS_SEED).normal(size=(1, SAMPLED_NORMALS, 3))
        n = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        return all(
            equal_to_rounding(pattern(0 * n, n) @ S, sign * pattern(0 * n, n @ S))
            for pattern in self.along_normals
        )


def remanence_constraints(context: Context, outline: Outline) -> list[SymmetryConstraint]:
    """Return the symmetry that the magnetisation preserves, as one constraint in a list.

    The constraint also has the reason, if any, why the problem is not axisymmetric about e3.
    """
    magnetic = context.section_of(MagneticSection)
    assert magnetic
    if magnetic.remanent and isinstance(magnetic.remanent.components, UserField):
        return [SymmetryConstraint("the remanence is a function on a mesh", mirrors=no_plane)]
    vectors = _magnetic_vectors(magnetic, context)

    def mirrors(mirror: Mirror) -> bool:
        return soft_mirrored(magnetic.susceptibility, outline, mirror) and vectors.has_mirror(
            mirror, outline
        )

    first_reason = next(_reasons_not_axisymmetric(magnetic, vectors, outline), None)
    # vectors that a mirror plane must contain
    axes_of_sources = _vectors_of_sources(magnetic.applied.sources or [], context.shell.reference)
    in_plane = [*vectors.vectors, *axes_of_sources]
    return [SymmetryConstraint(first_reason, in_plane, mirrors)]


def _magnetic_vectors(magnetic: MagneticSection, context: Context) -> _MagneticVectors:
    """Return remanence and applied field of a case, as its symmetry is judged by them."""
    applied, remanent = magnetic.applied, magnetic.remanent
    formulas = applied.components if applied.has_field_beside_sources else None
    directions = remanent.directions() if remanent else []
    remanences = [_on_patch(direction, context, turn=0.0) for direction in directions]
    # uniform vectors: of the remanence, and of a uniform applied field
    vectors = [remanence for remanence in remanences if not callable(remanence)]
    has_uniform_field = applied.has_field_beside_sources and not formulas
    if has_uniform_field and strength(context):
        vectors.append(applied.vector())
    remanent = remanent or RemanentSection.model_construct()
    assert not isinstance(remanent.components, UserField)  # has no symmetry, see the caller
    # the whole shell, or a patch, has a remanence along its normals, or one that varies otherwise
    along_normals = list[Pattern]()
    if remanent.kind in ("radial", "tangential"):
        along_normals.append(radial if remanent.kind == "radial" else tangential)
    varying_patterns = dict[str, PosedPattern]()
    for name, remanence in zip(remanent.patches or {}, remanences, strict=False):
        if not isinstance(remanence, PosedPattern):
            continue
        if remanence.pattern in (radial, tangential):
            along_normals.append(remanence)
        else:
            varying_patterns[name] = remanence
    # fields that vary: of the gradient, of formulas, of points and of patches
    G = np.array(applied.gradient or np.zeros((3, 3)))
    fields: list[FieldFunction] = [lambda x: np.asarray(x @ G.T)] if G.any() else []
    fields += [formula_field(texts) for texts in (remanent.components, formulas) if texts]
    pattern_by_points = by_points(remanent) if remanent.file else None
    if pattern_by_points:
        fields.append(partial(_at_places, pattern_by_points))
    fields += [partial(_at_places, pattern) for pattern in varying_patterns.values()]
    rotates_as_whole = turns(context)  # then the rotation is a part of the field at each place
    rotations = [] if rotates_as_whole else _rotations(context)
    return _MagneticVectors(
        vectors=vectors,
        turned_directions=[step.to.vector() for step in rotations],
        fields=fields,
        sources=values(context) if applied.sources or rotates_as_whole else [],
        along_normals=along_normals,
        varying_patterns=varying_patterns,
        by_points=pattern_by_points,
        is_beside_surface=bool(formulas),
    )


def _reasons_not_axisymmetric(
    magnetic: MagneticSection, vectors: _MagneticVectors, outline: Outline
) -> Iterator[str]:
    """Yield why remanence and field are not axisymmetric about e3, in words for the user."""
    if any(tilted(v) for v in vectors.vectors):
        yield "a field is not along e3"
    if vectors.by_points and not vectors.by_points.controls.is_axisymmetric:
        yield "the remanence is given at points in space"
    for name, pattern in vectors.varying_patterns.items():
        # the pattern of a patch is looked at on the meridian of its shell
        meridian = outline.meridian
        if meridian:
            meridians = [m for m in meridian.shell_meridians if name.startswith(m.name)]
            meridian = replace(
                meridian, shell_meridians=tuple(meridians), narrow_places=np.zeros((0, 3))
            )
        field = partial(_at_places, pattern)
        if not is_axisymmetric(field, meridian):
            yield f"the remanence of {name} differs around e3"
    for field_in_words in _what_differs_around_axis(magnetic, outline, vectors.sources):
        yield f"{field_in_words} differs around e3"
    G = np.array(magnetic.applied.gradient or np.zeros((3, 3)))
    if np.abs(G - np.diag([G[0, 0], G[0, 0], G[2, 2]])).max() > PARALLEL:
        yield "the gradient of the applied field is not diag(a, a, b)"


def _what_differs_around_axis(
    magnetic: MagneticSection, outline: Outline, sources: Sequence[FieldFunction]
) -> Iterator[str]:
    """Yield which formulas, or the field of sources, are not axisymmetric about e3, in words.

    They are compared at places of the outline's meridian; without a meridian none counts as
    axisymmetric.
    """
    meridian, chi = outline.meridian, magnetic.susceptibility
    remanence = magnetic.remanent.components if magnetic.remanent else None
    applied = magnetic.applied.components if magnetic.applied.has_field_beside_sources else None
    if isinstance(remanence, list) and not is_axisymmetric(formula_field(remanence), meridian):
        yield "the formula of the remanence"
    if applied and not is_axisymmetric(formula_field(applied), meridian, in_space=True):
        yield "the formula of the applied field"
    if isinstance(chi, str) and not is_axisymmetric(formula_field(chi), meridian):
        yield "the susceptibility"
    if not all(is_axisymmetric(field, meridian, is_smooth=True) for field in sources):
        yield "the field of a source"


def _at_places(pattern: Pattern, x: Array) -> Array:
    """Return the values (n, 3) at places x (n, 3) of a pattern that ignores the normal.

    The pattern takes places (cells, n, 3), here of one cell; zero stands for the normals.
    """
    return np.asarray(pattern(x[None], 0 * x[None])[0])


def _vectors_of_sources(sources: Sequence[SourceSection], R: float) -> list[Array]:
    """Return a vector (3,) for each source that a mirror plane through e3 must contain.

    It is the place of the source over R or, if the source is on e3, its axis.
    """
    places = [np.array(source.position) / R for source in sources]
    axes = [source.axes[:, 2] for source in sources]
    return [place if tilted(place) else axis for place, axis in zip(places, axes, strict=True)]


def contribution(context: Context, modelled: Modelled) -> Loads:
    """Return what magnetism adds to the loads of a model.

    If a step drives the field, `magnetic` is the magnetisation with the applied field. Otherwise
    `remanence` is the magnetisation alone, as sensors read it. It is left out if the modelled part
    (an axisymmetric meridian, or one side of `modelled.plane`) does not share its symmetry.
    """
    magnetic = context.section_of(MagneticSection)
    turn, patch_rims = modelled.turn, modelled.patch_rims
    assert magnetic
    driven_amplitudes = context.driven_before(len(context.steps) + 1)
    # these are added in any case
    observed = Loads(
        sensors=sensors(context, turn),
        field_maps=field_maps(context, turn),
        interaction=interaction(context),
    )
    if FieldSection.amplitude in driven_amplitudes:
        to = [step.to for step in _rotations(context)]
        return replace(observed, magnetic=magnetisation(magnetic, context, turn, patch_rims, to))
    if magnetic.remanent is None:
        return observed
    (constraint,) = remanence_constraints(context, modelled.outline)
    # whether an axisymmetric model can represent the remanence; other models always can
    is_visible = constraint.not_axisymmetric is None or not modelled.axisymmetric
    if not is_visible:
        return observed
    if modelled.plane and not constraint.mirrors(modelled.plane):
        return observed
    return replace(observed, remanence=magnetisation(magnetic, context, turn, patch_rims))


def _rotations(context: Context) -> list[RotationSection]:
    """Return the steps of a case that turn the field."""
    return [step.load for step in context.steps if isinstance(step.load, RotationSection)]

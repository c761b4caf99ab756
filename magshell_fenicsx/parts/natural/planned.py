"""The natural shape of a case in the model's frame, and the symmetry that it preserves.

The natural shape is the curvature and stretch that the shell would have without stress. It is read
from the case's `NaturalSection` and becomes a `Natural`, whose values vary as arrays, patterns or
fields of a program. A pattern is a function of places and normals. t1, t2 and the normal are the
frame in which curvature and stretch have components. The model may be turned about the axis e3
against the case. An outline has what is known of the shell before it has a mesh: its meridian, and
samples of its surface. R is the reference length of the shell, over which models measure.
"""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.expressions import FormulaVectors, formula_function
from magshell_fenicsx.mesh.mirror import Mirror, rotation
from magshell_fenicsx.mesh.patch import UserField
from magshell_fenicsx.models.shell.spatial_fields import InsideRim, Pattern, WithinRims
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.natural.section import NaturalSection, components
from magshell_fenicsx.parts.natural.shape import Natural, Varying, meridians
from magshell_fenicsx.parts.shell_sections import MeshSurface, PlateSurface, ShellSection
from magshell_fenicsx.shape.field_symmetry import formula_field, is_axisymmetric, is_mirror_image
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint, unit

Array = NDArray[np.float64]
MERIDIAN = "meridian"


def natural(context: Context, turn: float, patch_rims: Mapping[str, InsideRim]) -> Natural | None:
    """Return the natural shape of a case in the frame of its model; None without one.

    Parameters
    ----------
    turn
        Angle of the model's frame about e3 (rad).
    patch_rims
        Name of the patch of each dimple -> whether places are within the dimple's rim.
    """
    section = context.section_of(NaturalSection)
    if section is None:
        return None
    # Q turns the case's frame into the model's
    Q, R = rotation(turn), context.shell.reference

    def varying(
        value: object, components_of: Callable[[object], list[float | str]], factor: float
    ) -> Varying | None:
        """Return a curvature or stretch of the case as three numbers that may vary; None for None.

        Parameters
        ----------
        components_of
            Makes three numbers or formulas of the value, `_curvatures` or `_stretches`.
        factor
            Factor of the numbers, from the case's units to the model's: R of a curvature.
        """
        if value is None:
            return None
        # a function of a program; what makes the components tells stretches from curvatures
        if isinstance(value, UserField):
            is_stretch = components_of is _stretches
            return value.mapped(
                lambda numbers: factor * _three_numbers(numbers, stretch=is_stretch)
            )
        # one value for the whole shell, perhaps by formulas
        if not isinstance(value, dict):
            components_of_value = components_of(value)
            if any(isinstance(v, str) for v in components_of_value):
                functions = [formula_function(v) for v in components_of_value]
                return FormulaVectors(functions, frame=Q, length=R, factor=factor)
            return factor * np.array(components_of_value, dtype=float)
        # a value for each patch
        vectors = {
            name: factor * np.array(components_of(patch_value), dtype=float)
            for name, patch_value in value.items()
        }
        if isinstance(context.shell, MeshSurface):
            return vectors  # its mesh knows the cells of each patch
        return _within_rims(vectors, patch_rims)

    curvature = varying(section.curvature, _curvatures, factor=R)
    stretch = varying(section.stretch, _stretches, factor=1.0)
    return Natural(curvature, stretch, along=frame(context, turn))


def _within_rims(vectors: Mapping[str, Array], patch_rims: Mapping[str, InsideRim]) -> WithinRims:
    """Return a pattern with the vector of each dimple within its rim, and one elsewhere.

    The vector elsewhere is that of "rest", by default zero. Dimples that are not named have it too.
    """
    vector_elsewhere = vectors.get("rest", np.zeros(3))
    vectors_of_rims = tuple(
        (is_inside, vectors.get(name, vector_elsewhere)) for name, is_inside in patch_rims.items()
    )
    return WithinRims(vectors_of_rims, vector_elsewhere)


def frame(context: Context, turn: float) -> Pattern:
    """Return a pattern of vectors whose part in the surface is t1 of the natural frame.

    A pattern is a function of places and normals. The model's frame is turned by `turn` about e3
    (rad).
    """
    direction = first_direction(context)
    if direction == MERIDIAN:
        return meridians
    return FormulaVectors(
        [formula_function(v) for v in direction],
        rotation(turn),
        context.shell.reference,
        vectors=True,
    )


def first_direction(context: Context) -> list[float | str] | str:
    """Return the first direction t1 of the natural frame: three components, or "meridian".

    Without a natural shape, or without its key `along`, it is the default of the geometry.
    """
    natural = context.section_of(NaturalSection)
    if natural and natural.along:
        return natural.along
    is_strip = isinstance(context.shell, ShellSection) and context.shell.geometry == "strip"
    is_flat = is_strip or isinstance(context.shell, MeshSurface | PlateSurface)
    return [1.0, 0.0, 0.0] if is_flat else MERIDIAN


def is_anisotropic(context: Context) -> bool:
    """Return whether curvature or stretch depends on the direction, so that the frame matters."""
    section = context.section_of(NaturalSection)
    assert section
    # the two values, or those of their patches: a list has components along t1 and t2
    values = [section.curvature, section.stretch]
    patch_values = [
        v for value in values for v in (value.values() if isinstance(value, dict) else [value])
    ]
    has_list = any(isinstance(v, list) for v in patch_values)
    return has_list or any(field.size > 1 for field in section.user_fields)


def not_axisymmetric_because(context: Context, outline: Outline) -> str | None:
    """Return why the natural shape is not axisymmetric about e3, as a phrase; None if it is.

    It is if nothing twists, the frame is along the meridians or not needed, and formulas do not
    vary around e3. The twist is the third component k12 of a curvature.
    """
    section = context.section_of(NaturalSection)
    assert section
    direction, R = first_direction(context), context.shell.reference
    # a twist
    curvature = components(section.curvature)
    patch_curvatures = section.curvature.values() if isinstance(section.curvature, dict) else []
    if any(
        len(c) == 3 and c[2] not in (0, "0")
        for c in map(components, [curvature, *patch_curvatures])
    ):
        return "the natural curvature twists: k12 is not zero"
    # along the meridians are the direction "meridian" and the part of e3 in the surface
    is_vertical = [v == 0 for v in direction] == [True, True, False]
    is_along_meridians = direction == MERIDIAN or is_vertical
    if is_anisotropic(context) and not is_along_meridians:
        return "the natural shape is not along the meridians"
    if outline.meridian and not all(
        is_axisymmetric(formula_field(text, R), outline.meridian) for text in section.texts
    ):
        return "the natural shape differs around e3"
    return None


def mirrored(context: Context, outline: Outline, mirror: Mirror) -> bool:
    """Return whether a plane mirrors the natural shape onto itself.

    It is decided by values at samples of the surface; patches are taken to be their own images.
    A reflection keeps k11, k22 and the stretches, and changes the sign of the twist k12. Where the
    frame matters, its first direction must also be mirrored onto itself, or onto its opposite.
    """
    section = context.section_of(NaturalSection)
    assert section
    if section.user_fields:
        return False  # a program's function is not known off its mesh
    x, R, direction = outline.sample(), context.shell.reference, first_direction(context)

    def is_mirrored(text: float | str, sign: float = 1.0) -> bool:
        """Return whether a number or formula has the same values at images, but for the `sign`."""
        return is_mirror_image(formula_field(text, R), mirror, x, sign=sign)

    # components that keep their sign: the first two of curvature and stretch; and the twists
    curvatures = _components_of_patches(section.curvature)
    stretches = _components_of_patches(section.stretch)
    even_components = [v for c in (*curvatures, *stretches) for v in c[:2]]
    twists = [c[2] for c in curvatures if len(c) == 3]
    if not (
        all(is_mirrored(v) for v in even_components) and all(is_mirrored(v, -1.0) for v in twists)
    ):
        return False
    return not is_anisotropic(context) or _is_frame_mirrored(direction, mirror, x, R)


def _is_frame_mirrored(
    direction: list[float | str] | str, mirror: Mirror, x: Array, R: float
) -> bool:
    """Return whether a plane maps the first direction of the frame onto itself or its opposite.

    Parameters
    ----------
    direction
        Three numbers or formulas, or "meridian".
    x
        (n, 3) samples of the surface, over R.
    R
        Reference length in the unit of the formulas' places.
    """
    # meridians are mirrored by a plane that contains the axis, or is normal to it
    if direction == MERIDIAN:
        return mirror.through_e3 or bool(np.hypot(*mirror.normal[:2]) == 0)
    # t1 and -t1 are the same frame, as tensors have it
    directions = formula_field(direction, R)
    return any(is_mirror_image(directions, mirror, x, sign=sign) for sign in (1.0, -1.0))


def _components_of_patches(value: object) -> list[list[float | str]]:
    """Return the numbers and formulas of each patch, or of the one value without patches."""
    return [components(v) for v in (value.values() if isinstance(value, dict) else [value])]


def _curvatures(value: object) -> list[float | str]:
    """Return curvatures k11, k22, k12; of one number k11 and k22 are equal, and k12 is zero."""
    values = components(value)
    return values if len(values) == 3 else [*values, *values, 0.0]


def _stretches(value: object) -> list[float | str]:
    """Return stretches less one, along t1, along t2 and of the thickness.

    Of one number all three are equal; of two the thickness keeps its size.
    """
    values = components(value)
    strains = [f"{v} - 1" if isinstance(v, str) else v - 1 for v in values]
    return [*strains, 0.0] if len(values) == 2 else strains * 3


def _three_numbers(numbers: Array, *, stretch: bool) -> Array:
    """Return values (..., 1, 2 or 3) of a program's function as three numbers (..., 3).

    With `stretch` they are stretches less one, along t1, t2 and of the thickness; else curvatures
    k11, k22, k12. One number is the same in all directions, without a twist.
    """
    if stretch and numbers.shape[-1] == 2:  # along t1 and t2; the thickness keeps its size
        return np.concatenate([numbers - 1, np.zeros_like(numbers[..., :1])], axis=-1)
    if stretch:
        return np.repeat(numbers - 1, 3, axis=-1)
    return (
        numbers
        if numbers.shape[-1] == 3
        else np.concatenate([numbers, numbers, 0 * numbers], axis=-1)
    )


def natural_constraints(context: Context, outline: Outline) -> list[SymmetryConstraint]:
    """Return the symmetry that the natural shape of a case preserves.

    Its planes must contain the first direction of the frame, if the frame matters and is constant.
    A frame along meridians, or by formulas, gives no such vector.
    """
    direction = first_direction(context) if is_anisotropic(context) else MERIDIAN
    is_constant = not isinstance(direction, str) and all(
        isinstance(v, float | int) for v in direction
    )
    vectors = [unit(np.array(direction, dtype=float))] if is_constant else []
    return [
        SymmetryConstraint(
            not_axisymmetric_because(context, outline),
            vectors,
            lambda mirror: mirrored(context, outline, mirror),
        )
    ]
